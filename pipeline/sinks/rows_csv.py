"""The table's rows as a file for spreadsheets: one line a row, an interval as two columns, nothing that is nested.

What does not belong here: choosing or working out numbers (`pipeline.table`).
"""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

WITH_INTERVAL = ("first_step_mae", "at_one_second_mae")
PLAIN = ("vs_hold_still", "whole_chunk_mae", "params", "train_s", "latency_ms")


def write_rows(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write the rows of a table in their order; a number that is not there is an empty cell."""
    with path.open("w", newline="", encoding="utf-8") as file:
        flat = [_flat(row) for row in rows]
        writer = csv.DictWriter(file, list(flat[0]) if flat else ["policy"])
        writer.writeheader()
        writer.writerows(flat)


def _flat(row: Mapping[str, Any]) -> dict[str, Any]:
    found = {name: row[name] for name in ("policy", "method", "chunk", "observations", "seeds")}
    for name in WITH_INTERVAL:
        low, high = row["interval"].get(name) or (None, None)
        found |= {name: row[name], f"{name}_low": low, f"{name}_high": high}
    found |= {name: row[name] for name in PLAIN}
    found["against_hold_still"] = row["verdict"]["vs_hold_still"]
    return found | {name: (row["rollouts"] or {}).get(name) for name in ("success", "score")}

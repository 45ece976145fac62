"""What came of every table that was made: one entry a table in the store, never changed. The champion follows from it.

    datasets/<key>/benchmark_history/
      000001/made.json              what `Line` holds, and the fingerprint of the table
             errors.safetensors     the champion's errors at the first action, by seed and episode; where there is one
      history.html history.png      all entries, written again with each

The champion of a table is named beforehand: by the configuration, and from the table after on that found a policy better by
that policy. A promotion makes no table stale; it holds from the next table on, so nothing is made twice for it.
What belongs here: entries, who the champion is, and whether it got worse. What does not: statistics, drawing.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from pipeline.errors import StoreError
from pipeline.methods import EXTERNAL, METHODS
from pipeline.statistics.metrics import load_errors, save_errors
from pipeline.statistics.regression import FEWEST_SEEDS, METRIC, compare_with_before, first_step, what_changed
from pipeline.store import MADE, Made, Store
from pipeline.types import EpisodeErrors, Protocol

FOLDER = "benchmark_history"
PAGE, PICTURE = "history.html", "history.png"
ERRORS = "errors.safetensors"
NOT_WORSE = ("at_one_second_mae", "success", "score")
"""What a policy that is better at the first action must not be worse in, to be promoted: a small offline error is not success."""
SHOWN = ("policy", "observations", "method", "seeds", METRIC, "vs_hold_still")


@dataclass(frozen=True)
class Line:
    """One table that was made.

    when          UTC, to the second          table      its fingerprint
    code          version of this project, with the commit where there is one
    revision, content_hash   of the data
    named         the champion that the configuration names; None for none
    champion      the address that the table's rows were compared with, or the name of one that has no row; None for none
    conditions    what must be equal for two results to be compared (`statistics.regression.CONDITIONS`)
    rows          each policy's first-step error with its interval, and success where it was rolled out
    promotion     the policy that is champion from now on, and the comparison that made it so; None for no change
    kept          whose errors were kept: `address`, `result` (the fingerprint of its predictions), `is_trained`; None for nobody's
    regression    whether the champion got worse since it was last trained: a comparison as a dictionary; None where there is no
                  champion, or nothing earlier of it
    """

    when: str
    table: str
    code: str
    revision: str | None
    content_hash: str
    named: str | None
    champion: str | None
    conditions: Mapping[str, Any]
    rows: Sequence[Mapping[str, Any]]
    promotion: Mapping[str, Any] | None = None
    kept: Mapping[str, Any] | None = None
    regression: Mapping[str, Any] | None = None

    @property
    def got_worse(self) -> bool:
        return self.regression is not None and self.regression["word"] == "worse"

    @property
    def next_champion(self) -> str | None:
        return self.promotion["policy"] if self.promotion else self.champion


@dataclass(frozen=True)
class Result:
    """One policy's held-out errors, as the table was made from them: `fingerprint` is that of its predictions."""

    fingerprint: str
    is_trained: bool
    budget: str
    errors: EpisodeErrors = field(repr=False)


def read_history(store: Store, key: str) -> list[Line]:
    """The entries of a data set, oldest first.

    Raises:
        StoreError: one of them cannot be read.
    """
    lines = []
    for folder in _entries(store, key):
        made = store.made(folder)
        try:
            lines.append(Line(**made.summary))
        except (AttributeError, TypeError):
            raise StoreError(
                f"{folder / MADE} cannot be read, and who the champion is depends on it. Restore the file, or delete the folder: "
                "the history then lacks that table."
            ) from None
    return lines


def champion_of(lines: Sequence[Line], named: str | None) -> str | None:
    """Who the next table's rows are compared with: the last promoted since the configuration named this one, else that one."""
    last = lines[-1] if lines else None
    if named is None or last is None or last.named != named:
        return named
    return last.next_champion


def is_news(line: Line, lines: Sequence[Line]) -> bool:
    """Whether a regression was not told before: a table that is made again from the same results repeats its verdict."""
    last = lines[-1] if lines else None
    return last is None or not last.got_worse or line.kept is None or last.kept != line.kept


def describe(
    table: Mapping[str, Any],
    fingerprint: str,
    lines: Sequence[Line],
    *,
    named: str | None,
    champion: str | None,
    history: int,
    code: str,
    when: datetime,
    results: Mapping[str, Result],
    before: Mapping[int, EpisodeErrors],
) -> tuple[Line, EpisodeErrors | None]:
    """The entry of a table, and the errors to keep with it.

    Parameters
    ----------
    table : as `build_table` returns it, compared with `champion`.
    lines : the earlier entries; `before` the errors kept with them, by place in `lines`.
    history : frames of history that anchors depend on.
    results : what the rows were made from, by address; not those that were predicted elsewhere.
    """
    address = _address(table, champion)
    trained = {name for name, result in results.items() if result.is_trained}
    promotion = promoted(table, address, trained) if address in results else None
    alike = {
        "content_hash": table["dataset"]["content_hash"],
        "split": table["split"]["hash"],
        "history": history,
        "protocol": table["protocol"],
    }

    def conditions(policy: str | None) -> dict[str, Any]:
        return alike | {"budget": results[policy].budget if policy in results else None}

    to_keep = promotion["policy"] if promotion else address
    kept = None
    if to_keep in results:
        of = results[to_keep]
        kept = {"address": to_keep, "result": of.fingerprint, "is_trained": of.is_trained}
    line = Line(
        when=when.strftime("%Y-%m-%dT%H:%M:%SZ"),
        table=fingerprint,
        code=code,
        revision=table["dataset"]["revision"],
        content_hash=table["dataset"]["content_hash"],
        named=named,
        champion=address or champion,
        conditions=conditions(to_keep),
        rows=[_row(row) for row in table["policies"]],
        promotion=promotion,
        kept=kept,
        regression=_regression(address, conditions(address), results, lines, before),
    )
    return line, first_step(results[to_keep].errors) if kept else None


def promoted(table: Mapping[str, Any], champion: str, eligible: Collection[str]) -> dict[str, Any] | None:
    """The policy that takes the champion's place: of those that are better at the first action, and worse neither one second ahead
    where both reach it nor in closed loop where both were rolled out, the one with the smallest error. None where there is none.

    `eligible` are the addresses of trained policies: in a baseline there would be nothing to watch. One network is not its
    method: two seeds are needed, on both sides.
    """
    rows = {f"{row['policy']}/{row['observations']}": row for row in table["policies"]}
    driven = (table.get("closed_loop") or {}).get("comparisons", ())
    found = {(c["a"], c["metric"]): c for c in (*table["comparisons"], *driven) if c["b"] == champion}
    better = [
        c
        for (a, metric), c in found.items()
        if metric == METRIC
        and c["word"] == "better"
        and a in eligible
        and not any(found.get((a, other), {}).get("word") == "worse" for other in NOT_WORSE)
        and not any(_is_one_network(rows[address]) for address in (a, champion))
    ]
    if not better:
        return None
    best = min(better, key=lambda c: rows[c["a"]][METRIC])
    numbers = {name: best[name] for name in ("difference", "interval", "p", "p_holm")}
    errors = {METRIC: rows[best["a"]][METRIC], "champions": rows[champion][METRIC]}
    return {"policy": best["a"], "over": champion, "verdict": best["word"], "words": best["words"]} | errors | numbers


def _is_one_network(row: Mapping[str, Any]) -> bool:
    return METHODS[row["method"]].trained and row["seeds"] < FEWEST_SEEDS


def _address(table: Mapping[str, Any], champion: str | None) -> str | None:
    """The champion's row; None where it has none, or several and none is named."""
    addresses = [f"{r['policy']}/{r['observations']}" for r in table["policies"] if r["method"] != EXTERNAL]
    found = [address for address in addresses if champion in (address, address.split("/")[0])]
    return found[0] if len(found) == 1 else None


def _row(row: Mapping[str, Any]) -> dict[str, Any]:
    rolled = row["rollouts"]
    success = {name: rolled.get(name) for name in ("n", "success", "success_interval")} if rolled else None
    return {
        **{name: row[name] for name in SHOWN},
        "interval": row["interval"].get(METRIC),
        "rollouts": success,
    }


def _regression(
    address: str | None,
    conditions: Mapping[str, Any],
    results: Mapping[str, Result],
    lines: Sequence[Line],
    before: Mapping[int, EpisodeErrors],
) -> dict[str, Any] | None:
    """The champion against the last result of it that is another one."""
    if address not in results:
        return None
    now = results[address]
    for place in reversed(range(len(lines))):
        kept = lines[place].kept
        if kept and kept["address"] == address and kept["result"] != now.fingerprint and place in before:
            changed = what_changed(conditions, lines[place].conditions)
            protocol: Protocol = conditions["protocol"]
            compared = compare_with_before(
                now.errors, before[place], protocol, is_trained=now.is_trained, changed=changed, name=address
            )
            return asdict(compared) | {"since": lines[place].when, "code_then": lines[place].code}
    return None


# In words -----------------------------------------------------------------------------------------------------------


def in_words(line: Line) -> str:
    """Who the champion is, whether it got worse, and who takes its place."""
    news = news_words(line)
    return news if line.champion is None else f"The champion is {line.champion}. {news}"


def news_words(line: Line) -> str:
    """Whether the champion got worse, and who takes its place."""
    worse = regression_words(line)
    return f"{worse} {promotion_words(line)}" if line.promotion else worse


def promotion_words(line: Line) -> str:
    """Who takes the champion's place, and why."""
    p = line.promotion
    return f"From the next table on the champion is {p['policy']}: better than {p['over']} ({p['words']}, p {p['p_holm']:.2g})."


def regression_words(line: Line) -> str:
    """What the gate says."""
    if line.champion is None:
        return 'No champion is named, so nothing is watched: name one with champion = "…" in the configuration.'
    found = line.regression
    if found is None:
        return "There is no earlier result of it to compare with."
    then = f"the result of {found['since'][:10]} ({found['code_then']})"
    if found["word"] == "not comparable":
        return f"It cannot be compared with {then}: {found['words']}."
    verb = {"worse": "It got worse than", "better": "It got better than"}.get(found["word"], "It cannot be told from")
    return f"{verb} {then}: {found['words']}."


# In the store --------------------------------------------------------------------------------------------------------


def append(store: Store, key: str, line: Line, errors: EpisodeErrors | None) -> Path:
    """Write one entry whole, after all others; returns its folder."""
    there = _entries(store, key)
    number = 1 + (int(there[-1].name) if there else 0)
    folder = store.folder(key, FOLDER, f"{number:06d}")
    with store.publish(folder) as draft:
        if errors is not None:
            save_errors(errors, draft / ERRORS)
        store.write_made(draft, Made(line.table, summary=asdict(line)))
    return folder


def kept_errors(store: Store, key: str) -> dict[int, EpisodeErrors]:
    """The errors kept with entries, by place in `read_history`."""
    files = [folder / ERRORS for folder in _entries(store, key)]
    return {place: load_errors(file) for place, file in enumerate(files) if file.exists()}


def _entries(store: Store, key: str) -> list[Path]:
    return sorted(path.parent for path in (store.dataset(key) / FOLDER).glob(f"[0-9]*/{MADE}"))

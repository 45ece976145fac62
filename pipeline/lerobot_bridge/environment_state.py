"""A copy of a LeRobot v3.0 folder in which `observation.state` is also called `observation.environment_state`.

LeRobot's ACT asks for a camera or for a feature of that name; a data set of joint angles alone has neither. The copy has the
same episodes, frames and numbers, and the column twice. What belongs here: that copy, made with nothing but pyarrow.
What does not: changing, choosing or reordering what was recorded.

    python -m pipeline.lerobot_bridge.environment_state path/to/my_dataset path/to/copy
"""

import json
import os
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.errors import DatasetError, DemobenchError, StoreError

if TYPE_CHECKING:
    import pyarrow as pa

STATE, ENVIRONMENT_STATE = "observation.state", "observation.environment_state"
COPIED = "copied_features"
"""Key of the copy's info.json: feature → the column it repeats. `predict_checkpoint` finds it beside what it was trained on."""


def copy_with_environment_state(source: Path, copy: Path) -> None:
    """Write the copy. It appears under its name only when it is whole. Videos are not copied.

    Raises:
        DatasetError: the source is no v3.0 folder, has no `observation.state`, or has the second name already.
        StoreError: `copy` exists already, or cannot be written.
    """
    info = _checked_info(source)
    if copy.exists():
        raise StoreError(f"{copy} exists already. Give another folder, or remove it first.")
    draft = copy.with_name(f".{copy.name}.{os.getpid()}.tmp")
    try:
        for path in sorted((source / "data").rglob("*.parquet")):
            _copy_table(path, draft / path.relative_to(source), STATE, ENVIRONMENT_STATE)
        for path in sorted((source / "meta/episodes").rglob("*.parquet")):
            _copy_table(path, draft / path.relative_to(source), f"stats/{STATE}/", f"stats/{ENVIRONMENT_STATE}/")
        shutil.copyfile(source / "meta/tasks.parquet", draft / "meta/tasks.parquet")
        stats = json.loads((source / "meta/stats.json").read_text(encoding="utf-8"))
        _write_json(draft / "meta/stats.json", stats | {ENVIRONMENT_STATE: stats[STATE]})
        features = {key: value for key, value in info["features"].items() if value.get("dtype") != "video"}
        features[ENVIRONMENT_STATE] = features[STATE]
        notes = {"features": features, "video_path": None, COPIED: {ENVIRONMENT_STATE: STATE}}
        _write_json(draft / "meta/info.json", info | notes)
        draft.rename(copy)
    except (OSError, KeyError, ValueError) as error:
        raise StoreError(
            f"{copy} cannot be made from {source}: {type(error).__name__}: {error}. A whole LeRobot v3.0 folder has "
            "data/, meta/episodes/, meta/tasks.parquet and meta/stats.json."
        ) from None
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _checked_info(source: Path) -> dict:
    path = source / "meta/info.json"
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
        version, features = info["codebase_version"], dict(info["features"])
    except (OSError, ValueError, KeyError, TypeError):
        raise DatasetError(f"{path} is no info.json of a LeRobot data set. Give the folder that has meta/.") from None
    if version != "v3.0":
        raise DatasetError(
            f"{source} is in format {version}, and LeRobot trains on v3.0. Convert it first: "
            "python -m lerobot.scripts.convert_dataset_v21_to_v30"
        )
    if STATE not in features or ENVIRONMENT_STATE in features:
        lacks_or_has = f"has no {STATE}" if STATE not in features else f"has {ENVIRONMENT_STATE} already"
        raise DatasetError(f"{source} {lacks_or_has}: there is nothing to copy. Its features: {', '.join(features)}.")
    return info


def _copy_table(path: Path, out: Path, name: str, second: str) -> None:
    """Copy one parquet file, every column whose name starts with `name` twice."""
    import pyarrow.parquet as pq

    table: pa.Table = pq.read_table(path)
    for column in table.column_names:
        if column == name or (name.endswith("/") and column.startswith(name)):
            table = table.append_column(second + column.removeprefix(name), table[column])
    # The notes of other libraries in the schema would still list the old columns.
    out.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table.replace_schema_metadata(None), out, compression="zstd")


def _write_json(path: Path, content: dict) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


def main(words: list[str]) -> int:
    """The command of the module's docstring; returns its exit code."""
    if len(words) != 2:
        print("usage: python -m pipeline.lerobot_bridge.environment_state DATASET COPY", file=sys.stderr)
        return 2
    try:
        copy_with_environment_state(Path(words[0]), Path(words[1]))
    except DemobenchError as error:
        print(error, file=sys.stderr)
        return 1
    print(f"{words[1]}: {words[0]} with {STATE} also called {ENVIRONMENT_STATE}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

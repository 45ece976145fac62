"""Arrays → a LeRobot v3.0 folder, with the statistics and episode lists that LeRobot's own loader asks for.

What belongs here: the v3.0 layout. Older layouts are only read; videos are not written.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import StoreError
from pipeline.lerobot_format.stats import column_stats
from pipeline.store import drafted_folder

if TYPE_CHECKING:
    import pyarrow as pa

DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"
FILE_MB, FILES_PER_CHUNK = 100, 1000
"""LeRobot's own limits: megabytes of a data file, files of a chunk."""

FeatureArrays = tuple[Sequence[str] | None, np.ndarray, str]
"""Names of the D columns, values [N, D] (or [N]), dtype as LeRobot writes it ("float32", "bool", …)."""


@dataclass(frozen=True)
class _Place:
    """Where an episode goes: frames start … stop − 1 of the data set, in one file of one chunk."""

    start: int
    stop: int
    chunk: int
    file: int


def write_dataset(
    folder: Path,
    *,
    fps: float,
    features: Mapping[str, FeatureArrays],
    episode_lengths: Sequence[int],
    tasks: Sequence[str],
    robot_type: str | None = None,
    timestamps: np.ndarray | None = None,
    extra_info: Mapping[str, Any] | None = None,
    episodes_per_file: int | None = None,
    files_per_chunk: int = FILES_PER_CHUNK,
) -> None:
    """Write a data set. It appears under its name only when it is whole.

    `features` holds the episodes one after another; `tasks` has the words for each episode; `timestamps` [N] are
    seconds from the start of each episode, by default frame / fps. `extra_info` adds keys to info.json. Equal
    arguments, equal bytes.

    Raises:
        StoreError: the folder exists already and is not empty, or cannot be written.
        ValueError: the arrays do not fit each other.
    """
    _refuse_to_overwrite(folder)
    columns = _columns(features, episode_lengths, fps, tasks, timestamps)
    places = _places(columns, episode_lengths, episodes_per_file, files_per_chunk)
    try:
        with drafted_folder(folder) as draft:
            draft.mkdir(parents=True)
            _write_data(draft, columns, places)
            _write_episodes(draft, columns, places, tasks)
            _write_tasks(draft, tasks)
            _write_stats(draft, columns)
            info = _info(columns, places, fps, tasks, robot_type, files_per_chunk)
            _write_json(draft / "meta/info.json", info | dict(extra_info or {}))
    except OSError as error:
        raise StoreError(
            f"{folder} cannot be written: {error.strerror or error}. Free some room, or choose another place."
        ) from None


def _refuse_to_overwrite(folder: Path) -> None:
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise StoreError(f"{folder} exists already and is not empty. Give another folder, or remove it first.")


def _columns(
    features: Mapping[str, FeatureArrays],
    lengths: Sequence[int],
    fps: float,
    tasks: Sequence[str],
    timestamps: np.ndarray | None,
) -> dict[str, FeatureArrays]:
    """The features as [N, D] and the format's own index columns after them."""
    counts = np.asarray(lengths, np.int64)
    total = int(counts.sum())
    if len(counts) == 0 or (counts < 1).any() or len(tasks) != len(counts):
        raise ValueError(
            f"{len(counts)} episodes with lengths {list(lengths)[:5]}… and {len(tasks)} tasks do not make a data set"
        )
    columns = {}
    for key, (names, values, dtype) in features.items():
        values = np.asarray(values, dtype=dtype).reshape(len(values), -1)
        if len(values) != total or (names is not None and len(names) != values.shape[1]):
            raise ValueError(f"{key}: {values.shape} values and names {names} for {total} frames")
        columns[key] = (names, values, dtype)
    frame = np.arange(total) - np.repeat(np.cumsum(counts) - counts, counts)
    seconds = frame / fps if timestamps is None else np.asarray(timestamps, np.float64)
    numbers = {word: position for position, word in enumerate(dict.fromkeys(tasks))}
    index = {
        "timestamp": (seconds, "float32"),
        "frame_index": (frame, "int64"),
        "episode_index": (np.repeat(np.arange(len(counts)), counts), "int64"),
        "index": (np.arange(total), "int64"),
        "task_index": (np.repeat([numbers[word] for word in tasks], counts), "int64"),
    }
    return columns | {key: (None, values.astype(dtype)[:, None], dtype) for key, (values, dtype) in index.items()}


def _places(
    columns: Mapping[str, FeatureArrays], lengths: Sequence[int], episodes_per_file: int | None, files_per_chunk: int
) -> list[_Place]:
    """Episodes fill a file until it is full; an episode is never divided."""
    frame_bytes = sum(values.itemsize * values.shape[1] for _, values, _ in columns.values())
    places: list[_Place] = []
    number, in_file, start, file_start = 0, 0, 0, 0
    for length in lengths:
        stop = start + int(length)
        too_large = (stop - file_start) * frame_bytes > FILE_MB * 2**20
        if in_file and (too_large or in_file == episodes_per_file):
            number, in_file, file_start = number + 1, 0, start
        places.append(_Place(start, stop, *divmod(number, files_per_chunk)))
        in_file, start = in_file + 1, stop
    return places


def _write_data(folder: Path, columns: Mapping[str, FeatureArrays], places: list[_Place]) -> None:
    files: dict[tuple[int, int], list[_Place]] = {}
    for place in places:
        files.setdefault((place.chunk, place.file), []).append(place)
    for (chunk, file), inside in files.items():
        rows = slice(inside[0].start, inside[-1].stop)
        table = {key: _array(values[rows]) for key, (_, values, _) in columns.items()}
        _write_parquet(folder / DATA_PATH.format(chunk_index=chunk, file_index=file), table)


def _array(values: np.ndarray) -> "pa.Array":
    """[n, D] → a column of fixed-size lists, or of plain numbers where D is 1 (so LeRobot's loader has it)."""
    import pyarrow as pa

    flat = pa.array(np.ascontiguousarray(values).ravel())
    return flat if values.shape[1] == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def _write_episodes(
    folder: Path, columns: Mapping[str, FeatureArrays], places: list[_Place], tasks: Sequence[str]
) -> None:
    count = len(places)
    table: dict[str, Any] = {
        "episode_index": list(range(count)),
        "tasks": [[word] for word in tasks],
        "length": [place.stop - place.start for place in places],
        "data/chunk_index": [place.chunk for place in places],
        "data/file_index": [place.file for place in places],
        "dataset_from_index": [place.start for place in places],
        "dataset_to_index": [place.stop for place in places],
    }
    for key, (_, values, _) in columns.items():
        for place in places:
            for name, numbers in column_stats(values[place.start : place.stop]).items():
                table.setdefault(f"stats/{key}/{name}", []).append(numbers.tolist())
    table |= {"meta/episodes/chunk_index": [0] * count, "meta/episodes/file_index": [0] * count}
    _write_parquet(folder / EPISODES_PATH, table)


def _write_tasks(folder: Path, tasks: Iterable[str]) -> None:
    """meta/tasks.parquet as a pandas frame indexed by the words: that is how LeRobot looks a task up."""
    words = list(dict.fromkeys(tasks))
    column = {
        "field_name": "task_index",
        "metadata": None,
        "name": "task_index",
        "numpy_type": "int64",
        "pandas_type": "int64",
    }
    index = {"field_name": "task", "metadata": None, "name": "task", "numpy_type": "object", "pandas_type": "unicode"}
    labels = {
        "field_name": None,
        "metadata": {"encoding": "UTF-8"},
        "name": None,
        "numpy_type": "object",
        "pandas_type": "unicode",
    }
    pandas = {
        "index_columns": ["task"], "column_indexes": [labels], "columns": [column, index],
        "creator": {"library": "pyarrow", "version": "20.0.0"}, "pandas_version": "2.2.0",
    }  # fmt: skip
    table = {"task_index": list(range(len(words))), "task": words}
    _write_parquet(folder / "meta/tasks.parquet", table, {"pandas": json.dumps(pandas)})


def _write_parquet(path: Path, columns: Mapping[str, Any], metadata: Mapping[str, str] | None = None) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    path.parent.mkdir(parents=True, exist_ok=True)
    table = pa.table(dict(columns)).replace_schema_metadata(dict(metadata) if metadata else None)
    pq.write_table(table, path, compression="zstd", compression_level=9)


def _info(
    columns: Mapping[str, FeatureArrays],
    places: list[_Place],
    fps: float,
    tasks: Sequence[str],
    robot_type: str | None,
    files_per_chunk: int,
) -> dict[str, Any]:
    return {
        "codebase_version": "v3.0",
        "robot_type": robot_type,
        "total_episodes": len(places),
        "total_frames": places[-1].stop,
        "total_tasks": len(set(tasks)),
        "chunks_size": files_per_chunk,
        "data_files_size_in_mb": FILE_MB,
        "video_files_size_in_mb": 200,
        "fps": int(fps) if float(fps).is_integer() else float(fps),
        "splits": {"train": f"0:{len(places)}"},
        "data_path": DATA_PATH,
        "video_path": None,
        "features": {
            key: {"dtype": dtype, "shape": [values.shape[1]], "names": list(names) if names is not None else None}
            for key, (names, values, dtype) in columns.items()
        },
    }


def _write_stats(folder: Path, columns: Mapping[str, FeatureArrays]) -> None:
    stats = {key: column_stats(values) for key, (_, values, _) in columns.items()}
    listed = {key: {name: numbers.tolist() for name, numbers in block.items()} for key, block in stats.items()}
    _write_json(folder / "meta/stats.json", listed)


def _write_json(path: Path, content: Any) -> None:
    path.write_text(json.dumps(content, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")

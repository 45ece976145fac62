"""Parquet → arrays: every frame of every data file, only the columns that are used, into memory reserved once.

What belongs here: types, shapes and missing values of columns. What does not: whether the frames are the episodes that
meta/ lists (read.py).
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import DatasetError
from pipeline.lerobot_format.files import open_parquet
from pipeline.lerobot_format.layout import Layout
from pipeline.types import ACTION, STATE, Feature

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

EXACT_INTEGERS = 2**24
"""float32 holds every whole number up to here."""


@dataclass(frozen=True)
class Frames:
    """All frames in the order of the files.

    columns      feature key → [N, D] float32
    file_of      [N] int64, the position of each frame's file in `Layout.files`
    episode_id, frame_index, task_index   [N] int64, or None where no file has the column
    timestamps   [N] float64 s, or None
    """

    columns: dict[str, np.ndarray]
    file_of: np.ndarray
    episode_id: np.ndarray | None
    frame_index: np.ndarray | None
    task_index: np.ndarray | None
    timestamps: np.ndarray | None
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class _Survey:
    """What the footers say: frames of each file, columns of every file, values of the largest row group, notes."""

    rows: list[int]
    shared: set[str]
    largest_group: int
    notes: list[str]


_INDEX = {"episode_index": np.int64, "frame_index": np.int64, "task_index": np.int64, "timestamp": np.float64}


def read_frames(layout: Layout) -> Frames:
    """Read the data files of a layout.

    Raises:
        DatasetError: a file is missing or damaged, a column is missing, has another shape, or does not fit into memory.
    """
    survey = _survey(layout)
    total = sum(survey.rows)
    features = {key: feature for key, feature in layout.features.items() if key in survey.shared}
    _check_memory(layout, total, features, survey.largest_group)
    columns = {key: np.empty((total, len(feature.names)), np.float32) for key, feature in features.items()}
    index = {key: np.empty((total, 1), dtype) for key, dtype in _INDEX.items() if key in survey.shared}
    row, large = 0, set()
    for file in layout.files:
        for group in _row_groups(layout, file, [*columns, *index]):
            rows = slice(row, row + group.num_rows)
            for key, target in (columns | index).items():
                values = _numbers(layout, file, group, key, target.shape[1])
                if key in columns and _is_rounded_by_float32(values):
                    large.add(key)
                with np.errstate(over="ignore", invalid="ignore"):  # what comes out is checked for being finite
                    target[rows] = values
            row = rows.stop
    index = {key: values[:, 0] for key, values in index.items()}
    rounded = [
        f"Feature '{key}' holds whole numbers too large for float32; they were rounded." for key in sorted(large)
    ]
    return Frames(
        columns=columns,
        file_of=np.repeat(np.arange(len(survey.rows)), survey.rows),
        episode_id=index.get("episode_index"),
        frame_index=index.get("frame_index"),
        task_index=index.get("task_index"),
        timestamps=index.get("timestamp"),
        warnings=(*survey.notes, *rounded),
    )


def _is_rounded_by_float32(values: np.ndarray) -> bool:
    return values.dtype.kind in "iu" and values.size > 0 and bool(np.abs(values).max() > EXACT_INTEGERS)


def _survey(layout: Layout) -> _Survey:
    """Look at every footer."""
    expected: Counter[str] = Counter()
    for entry in layout.episodes:
        expected[entry.file] += entry.length
    rows: list[int] = []
    shared: set[str] | None = None
    somewhere: set[str] = set()
    largest = 0
    for file in layout.files:
        with open_parquet(layout.folder, file) as parquet:
            names = parquet.schema_arrow.names
            _check_columns(layout, file, names)
            _check_rows(layout, file, parquet.metadata.num_rows, expected[file])
            rows.append(parquet.metadata.num_rows)
            largest = max(largest, _values_of_largest_group(parquet, {*layout.features, *_INDEX}))
        shared = set(names) if shared is None else shared & set(names)
        somewhere |= set(names)
    notes = []
    for key in (*layout.features, *_INDEX):
        if key not in (shared or ()):
            where = "only in some data files" if key in somewhere else "in no data file"
            notes.append(f"Column '{key}' is {where}; it was {'derived' if key in _INDEX else 'left out'}.")
    return _Survey(rows, shared or set(), largest, notes)


def _check_columns(layout: Layout, file: str, names: list[str]) -> None:
    for key in (ACTION, STATE):
        if key not in names:
            raise DatasetError(
                f"{layout.folder / file} has no column '{key}', which meta/info.json declares. "
                f"It has: {', '.join(sorted(names))}. Record the column, or correct meta/info.json."
            )
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise DatasetError(f"{layout.folder / file} has the column '{twice}' twice. Remove one of the two.")


def _check_rows(layout: Layout, file: str, rows: int, expected: int) -> None:
    """A footer may claim any number of rows; no honest file holds other than the episodes in it."""
    if rows != expected:
        raise DatasetError(
            f"{layout.folder / file} has {rows:,} frames; the episodes that meta/ lists in it have {expected:,}. "
            "The data or the list is out of date: copy the data set again, or correct the list."
        )


def _values_of_largest_group(parquet: "pq.ParquetFile", wanted: set[str]) -> int:
    """Single values that reading the wanted columns of one row group takes into memory."""
    metadata, largest = parquet.metadata, 0
    for number in range(metadata.num_row_groups):
        group = metadata.row_group(number)
        columns = [group.column(position) for position in range(group.num_columns)]
        chosen = [column for column in columns if any(_is_part(column.path_in_schema, key) for key in wanted)]
        largest = max(largest, sum(column.num_values for column in chosen))
    return largest


def _is_part(path: str, key: str) -> bool:
    """Whether a leaf such as `action.list.element` belongs to the column `action`."""
    return path == key or path.startswith(f"{key}.")


def _check_memory(layout: Layout, total: int, features: dict[str, Feature], largest_group: int) -> None:
    import psutil

    needed = total * (4 * sum(len(feature.names) for feature in features.values()) + 40) + 8 * largest_group
    free = psutil.virtual_memory().available
    if needed > 0.8 * free:
        raise DatasetError(
            f"{layout.folder}: its {total:,} frames need {needed / 2**30:.1f} GB of memory, "
            f"{free / 2**30:.1f} GB are free. Use a part of the data set, or a machine with more memory."
        )


def _row_groups(layout: Layout, file: str, wanted: list[str]) -> Iterator["pa.Table"]:
    import pyarrow as pa

    with open_parquet(layout.folder, file) as parquet:
        for number in range(parquet.metadata.num_row_groups):
            try:
                table = parquet.read_row_group(number, columns=wanted, use_threads=False)
            except (pa.ArrowException, OSError) as error:
                raise DatasetError(
                    f"{layout.folder / file} cannot be read: it is cut off or damaged. Copy the data set again. "
                    f"(parquet says: {str(error).strip().splitlines()[0][:160]})"
                ) from None
            yield table.select(wanted)


def _numbers(layout: Layout, file: str, table: "pa.Table", key: str, width: int) -> np.ndarray:
    """One column as [rows, width]; a missing number is NaN."""
    import pyarrow as pa

    column = table.column(key)
    values: pa.Array = column.combine_chunks() if column.num_chunks != 1 else column.chunk(0)
    if isinstance(values, pa.ChunkedArray):  # no rows at all
        values = pa.array([], type=column.type)
    rows = len(values)
    if isinstance(values, pa.ExtensionArray):
        values = values.storage
    while _is_list(values.type):
        if values.null_count:
            raise _wrong(layout, file, key, width, "a frame without a value")
        lengths = values.value_lengths().unique().to_pylist() if not pa.types.is_fixed_size_list(values.type) else []
        if len(lengths) > 1:
            raise _wrong(layout, file, key, width, f"lists of {min(lengths)} to {max(lengths)}")
        values = values.flatten()
    if not (pa.types.is_floating(values.type) or pa.types.is_integer(values.type) or pa.types.is_boolean(values.type)):
        raise _wrong(layout, file, key, width, f"values of type {values.type}")
    if len(values) != rows * width:
        raise _wrong(layout, file, key, width, f"{len(values) / max(rows, 1):g} a frame")
    if pa.types.is_boolean(values.type):
        values = values.cast(pa.uint8())
    return values.to_numpy(zero_copy_only=False).reshape(rows, width)


def _is_list(kind: "pa.DataType") -> bool:
    import pyarrow as pa

    return pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)


def _wrong(layout: Layout, file: str, key: str, width: int, got: str) -> DatasetError:
    return DatasetError(
        f"{layout.folder / file}: column '{key}' has {got}; "
        f"meta/info.json declares {width} number{'s' if width > 1 else ''} a frame. "
        "Correct the shape in meta/info.json, or record the column again."
    )

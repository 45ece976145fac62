"""Parquet → arrays: every row of every data file, only the columns that are used, into memory reserved once.

What belongs here: which columns there must be, and their widths. What does not: the ways to write a column (arrays.py),
which row is which frame (placing.py).
"""

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import DatasetError
from pipeline.lerobot_format.arrays import VALUES_AT_A_TIME, NotNumbers, as_numbers, batches, check_type
from pipeline.lerobot_format.files import inside, open_parquet
from pipeline.lerobot_format.layout import Layout

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

EXACT_INTEGERS = 2**24
"""float32 holds every whole number up to here."""


@dataclass(frozen=True)
class Frames:
    """All rows in the order of the files.

    columns      feature key → [N, D] float32
    file_of      [N] int32, the position of each frame's file in `Layout.files`
    episode_id, frame_index, task_index   [N] int32 (int64 where that is too small), or None where no file has the column
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
    """What the footers say: rows of each file, columns of every file, notes."""

    rows: list[int]
    shared: set[str]
    notes: list[str]


_INDEX = {"episode_index": np.int32, "frame_index": np.int32, "task_index": np.int32, "timestamp": np.float64}


def read_frames(layout: Layout) -> Frames:
    """Read the data files of a layout: all their rows, those of episodes that are left out as well.

    Raises:
        DatasetError: a file is missing or damaged, a column is missing, has another shape, or does not fit into memory.
    """
    import pyarrow as pa

    survey = _survey(layout)
    total = sum(survey.rows)
    features = {key: feature for key, feature in layout.features.items() if key in survey.shared}
    width = sum(len(feature.names) for feature in features.values()) + len(_INDEX)
    _check_memory(layout, total, width)
    columns = {key: np.empty((total, len(feature.names)), np.float32) for key, feature in features.items()}
    index = {key: np.empty((total, 1), dtype) for key, dtype in _INDEX.items() if key in survey.shared}
    row, large = 0, set()
    for file in layout.files:
        with open_parquet(layout.folder, file) as parquet:
            for batch in batches(parquet, layout.folder / file, [*columns, *index], width):
                rows = slice(row, row + batch.num_rows)
                for key, target in (columns | index).items():
                    values = _numbers(layout, file, batch.column(key), key, target.shape[1])
                    if key in columns and _is_rounded_by_float32(values):
                        large.add(key)
                    if target.dtype == np.int32 and not _fits_int32(values):
                        target = index[key] = target.astype(np.int64)
                    with np.errstate(over="ignore", invalid="ignore"):  # what comes out is checked for being finite
                        target[rows] = values
                row = rows.stop
    pa.default_memory_pool().release_unused()
    index = {key: values[:, 0] for key, values in index.items()}
    rounded = [
        f"Feature '{key}' holds whole numbers too large for float32; they were rounded." for key in sorted(large)
    ]
    return Frames(
        columns=columns,
        file_of=np.repeat(np.arange(len(survey.rows), dtype=np.int32), survey.rows),
        episode_id=index.get("episode_index"),
        frame_index=index.get("frame_index"),
        task_index=index.get("task_index"),
        timestamps=index.get("timestamp"),
        warnings=(*survey.notes, *rounded),
    )


def _fits_int32(values: np.ndarray) -> bool:
    return not (values.max() >= 2**31 or values.min() < -(2**31))


def _is_rounded_by_float32(values: np.ndarray) -> bool:
    return values.dtype.kind in "iu" and values.size > 0 and bool(np.abs(values).max() > EXACT_INTEGERS)


def _survey(layout: Layout) -> _Survey:
    """Look at every footer."""
    rows: list[int] = []
    shared: set[str] | None = None
    somewhere: set[str] = set()
    for file in layout.files:
        _check_presence(layout, file)
        with open_parquet(layout.folder, file) as parquet:
            names = parquet.schema_arrow.names
            _check_columns(layout, file, names)
            _check_types(layout, file, parquet.schema_arrow)
            _check_widths(layout, file, names, parquet.metadata)
            rows.append(parquet.metadata.num_rows)
        shared = set(names) if shared is None else shared & set(names)
        somewhere |= set(names)
    notes = []
    for key in (*layout.features, *_INDEX):
        if key not in (shared or ()):
            where = "only in some data files" if key in somewhere else "in no data file"
            notes.append(f"Column '{key}' is {where}; it was {'derived' if key in _INDEX else 'left out'}.")
    return _Survey(rows, shared or set(), notes)


def _check_presence(layout: Layout, file: str) -> None:
    """Without a file nothing can be done but to leave its episodes out."""
    if (path := inside(layout.folder, file)).exists():
        return
    lost = [str(entry.id) for entry in layout.episodes if entry.file == file]
    out = f", or leave out what was in it: exclude = [{', '.join(lost)}]" if lost else ""
    raise DatasetError(
        f"{path} is missing, though the data set's own lists name it. Copy or download the data set again{out}."
    )


def _check_columns(layout: Layout, file: str, names: list[str]) -> None:
    for key in layout.roles.needed:
        if key in layout.features and key not in names:
            raise DatasetError(
                f"{layout.folder / file} has no column '{key}', which meta/info.json declares. "
                f"It has: {', '.join(sorted(names))}. Record the column, or correct meta/info.json."
            )
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise DatasetError(f"{layout.folder / file} has the column '{twice}' twice. Remove one of the two.")


def _check_types(layout: Layout, file: str, schema: "pa.Schema") -> None:
    widths = _widths(layout) | dict.fromkeys(_INDEX, 1)
    for field in schema:
        if field.name in widths:
            try:
                check_type(field.type)
            except NotNumbers as error:
                raise _wrong(layout, file, field.name, widths[field.name], str(error)) from None


def _widths(layout: Layout) -> dict[str, int]:
    return {key: len(feature.names) for key, feature in layout.features.items()}


def _check_widths(layout: Layout, file: str, names: list[str], metadata: "pq.FileMetaData") -> None:
    """A few kilobytes of repeated values can stand for gigabytes, so columns wider than declared are never decoded."""
    held: Counter[str] = Counter()
    for number in range(metadata.num_row_groups):
        group = metadata.row_group(number)
        for column in (group.column(position) for position in range(group.num_columns)):
            held[column.path_in_schema] += column.num_values
    # A list's path goes on after its name, as its writer pleased: .list.element, .list.item, .array.
    for path in list(held):
        owner = max((name for name in names if path.startswith(f"{name}.")), key=len, default=None)
        if owner is not None and path not in names:
            held[owner] += held[path]
    for key, width in _widths(layout).items():
        if held[key] > metadata.num_rows * width:
            raise _wrong(layout, file, key, width, f"{held[key] / metadata.num_rows:g} a frame")


def _check_memory(layout: Layout, total: int, width: int) -> None:
    """A footer may claim any number of rows, so what they would take is known before it is taken."""
    import psutil

    needed = 4 * total * width + 8 * (total + min(VALUES_AT_A_TIME, total * width))
    free = psutil.virtual_memory().available
    if needed > 0.8 * free:
        raise DatasetError(
            f"{layout.folder}: its {total:,} frames need {needed / 2**30:.1f} GB of memory, "
            f"{free / 2**30:.1f} GB are free. Use a part of the data set, or a machine with more memory."
        )


def _numbers(layout: Layout, file: str, column: "pa.Array", key: str, width: int) -> np.ndarray:
    """One column as [rows, width]; a missing number is NaN."""
    try:
        values = as_numbers(column)
    except NotNumbers as error:
        raise _wrong(layout, file, key, width, str(error)) from None
    if values.shape[1] != width:
        raise _wrong(layout, file, key, width, f"{values.shape[1]:g} a frame")
    return values


def _wrong(layout: Layout, file: str, key: str, width: int, got: str) -> DatasetError:
    return DatasetError(
        f"{layout.folder / file}: column '{key}' has {got}; "
        f"meta/info.json declares {width} number{'s' if width > 1 else ''} a frame. "
        "Correct the shape in meta/info.json, or record the column again."
    )

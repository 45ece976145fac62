"""Features of the user's own, one value a frame, joined from a parquet file by episode and frame.

The file has the columns `episode_index` (as recorded), `frame_index` (in the episode) and one more, of numbers or of
lists of one length. What does not belong here: the data set's own files (frames.py).
"""

from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import ConfigError, DatasetError
from pipeline.lerobot_format.arrays import NotNumbers, as_numbers, batches, check_type
from pipeline.lerobot_format.files import open_outside, stamp_of_file
from pipeline.lerobot_format.layout import INDEX_COLUMNS, MAX_WIDTH
from pipeline.types import ACTION, STATE, Feature

if TYPE_CHECKING:
    import pyarrow.parquet as pq

KEYS = ("episode_index", "frame_index")


def stamp_of_features(files: Mapping[str, Path]) -> dict[str, Any]:
    """Path, size and time of each file: what changes when a joined feature does (JSON-able).

    Raises:
        DatasetError: a file is not there.
    """
    stamps = {}
    for name, path in files.items():
        try:
            stamps[name] = stamp_of_file(path)
        except OSError:
            raise DatasetError(
                f"[datasets.‹name›.features] {name}: there is no file {path}. "
                "The path is relative to the configuration file; correct it, or write the file."
            ) from None
    return stamps


def check_names(names: Collection[str], recorded: Collection[str]) -> None:
    """A joined feature has a name of its own, which no recorded feature and no camera has.

    Raises:
        ConfigError: the data set has a feature of that name.
    """
    for name in names:
        if name in recorded or name in (ACTION, STATE, *INDEX_COLUMNS):
            raise ConfigError(
                f"[datasets.‹name›.features] {name}: the data set has a feature of that name already. Choose another name."
            )


def join_feature(
    name: str, path: Path, *, ids: np.ndarray, starts: np.ndarray, excluded: tuple[int, ...]
) -> tuple[Feature, np.ndarray]:
    """The feature and its values [N, D] float32 for the frames of the episodes `ids` [E], which begin at `starts` [E + 1].

    Rows of `excluded` episodes are passed over.

    Raises:
        DatasetError: a frame is missing or there twice, or a row belongs to no frame, or a value is no finite number.
    """
    frames = int(starts[-1])
    with open_outside(path) as parquet:
        key = _value_column(path, parquet)
        _check_size(path, parquet, key, frames)
        values, seen = None, np.zeros(frames, np.int32)
        for batch in batches(parquet, path, [*KEYS, key], _width(parquet, key)):
            block = _values(path, key, batch.column(key))
            if not block.shape[1]:
                raise _fault(path, f"'{key}' has empty lists")
            if values is None:
                values = np.empty((frames, block.shape[1]), np.float32)
            if block.shape[1] != values.shape[1]:
                raise _fault(path, f"'{key}' has {values.shape[1]} and {block.shape[1]} numbers a frame")
            rows, frame = _frames_of(path, batch, ids, starts, excluded)
            with np.errstate(over="ignore"):  # what comes out is checked for being finite
                values[frame] = block[rows]
            np.add.at(seen, frame, 1)
    _check_complete(path, seen, ids, starts)
    _check_finite(path, key, values, ids, starts)
    names = (name,) if values.shape[1] == 1 else tuple(map(str, range(values.shape[1])))
    return Feature(name, names, (None,) * len(names)), values


def _value_column(path: Path, parquet: "pq.ParquetFile") -> str:
    names = parquet.schema_arrow.names
    others = [name for name in names if name not in KEYS and name != "__index_level_0__"]
    if len(others) != 1 or any(names.count(key) != 1 for key in KEYS):
        raise _fault(path, f"it has the columns {', '.join(names)}")
    _numbers_only(path, others[0], lambda: check_type(parquet.schema_arrow.field(others[0]).type))
    return others[0]


def _fault(path: Path, what: str) -> DatasetError:
    return DatasetError(
        f"{path}: {what}; expected episode_index, frame_index and one column of finite numbers, or of lists of one length "
        f"(at most {MAX_WIDTH}). Write the file again."
    )


def _width(parquet: "pq.ParquetFile", key: str) -> int:
    """Single values a row, by the footer."""
    metadata, most = parquet.metadata, 1
    for number in range(metadata.num_row_groups):
        group = metadata.row_group(number)
        leaves = [group.column(position) for position in range(group.num_columns)]
        held = sum(leaf.num_values for leaf in leaves if leaf.path_in_schema.split(".")[0] == key.split(".")[0])
        most = max(most, -(-held // max(1, group.num_rows)))
    return most + 2


def _check_size(path: Path, parquet: "pq.ParquetFile", key: str, frames: int) -> None:
    """Before memory is taken: a file of few bytes can stand for many numbers."""
    import psutil

    width = _width(parquet, key) - 2
    if width > MAX_WIDTH:
        raise _fault(path, f"'{key}' has {width:,} numbers a frame")
    needed, free = 4 * frames * width, psutil.virtual_memory().available
    if needed > 0.8 * free:
        raise DatasetError(
            f"{path}: {frames:,} frames of {width} numbers need {needed / 2**30:.1f} GB of memory, {free / 2**30:.1f} GB "
            "are free. Join a narrower feature, or use a machine with more memory."
        )


def _values(path: Path, key: str, column: Any) -> np.ndarray:
    return _numbers_only(path, key, lambda: as_numbers(column))


def _numbers_only(path: Path, key: str, look: Callable[[], Any]) -> Any:
    try:
        return look()
    except NotNumbers as error:
        raise _fault(path, f"'{key}' has {error}") from None


def _frames_of(
    path: Path, batch: Any, ids: np.ndarray, starts: np.ndarray, excluded: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """The rows of a batch that belong to a frame, and which frame each belongs to."""
    episode, number = (_whole(path, key, batch.column(key)) for key in KEYS)
    position = np.minimum(np.searchsorted(ids, episode), len(ids) - 1)
    known = ids[position] == episode
    stray = ~known & ~np.isin(episode, excluded)
    if stray.any():
        some = int(episode[stray][0])
        raise DatasetError(
            f"{path} has values for episode {some}, which the data set does not have. Was it written for another one?"
        )
    rows = np.flatnonzero(known)
    position, number = position[rows], number[rows]
    length = starts[position + 1] - starts[position]
    beyond = (number < 0) | (number >= length)
    if beyond.any():
        row = int(np.flatnonzero(beyond)[0])
        raise DatasetError(
            f"{path} has values for episode {ids[position[row]]}, frame {number[row]}; the episode has frames 0 to "
            f"{length[row] - 1}. Was it written for another data set?"
        )
    return rows, starts[position] + number


def _whole(path: Path, key: str, column: Any) -> np.ndarray:
    values = _values(path, key, column)
    if values.shape[1] != 1 or values.dtype.kind not in "iu":
        raise _fault(path, f"'{key}' does not hold whole numbers")
    return values[:, 0].astype(np.int64)


def _check_complete(path: Path, seen: np.ndarray, ids: np.ndarray, starts: np.ndarray) -> None:
    """Every frame exactly once."""
    faults = []
    for what, frames in (("has no value", np.flatnonzero(seen == 0)), ("has several values", np.flatnonzero(seen > 1))):
        if len(frames):
            episode = int(np.searchsorted(starts, frames[0], side="right")) - 1
            place = f"episode {ids[episode]}, frame {frames[0] - starts[episode]}"
            faults.append(f"{what} for {len(frames):,} of {len(seen):,} frames, the first is {place}")
    if faults:
        raise DatasetError(f"{path} {'; it '.join(faults)}. Write one row for each frame.")


def _check_finite(path: Path, key: str, values: np.ndarray, ids: np.ndarray, starts: np.ndarray) -> None:
    bad = ~np.isfinite(values).all(axis=1)
    if bad.any():
        frame = int(np.flatnonzero(bad)[0])
        episode = int(np.searchsorted(starts, frame, side="right")) - 1
        raise _fault(path, f"'{key}' is not finite in episode {ids[episode]}, frame {frame - starts[episode]}")

"""A parquet file of predictions, which anybody may have written, as arrays by anchor.

What belongs here: types, sizes, and that every row is an anchor, once, with all that belongs to it. What does not: whether the
numbers make sense (`checks`).

Every refusal says what is wrong, in which row (counted from 0), what was expected and what to do.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import DatasetError, did_you_mean
from pipeline.external.anchors import anchors_of
from pipeline.types import ACTION, Demonstrations

MOST_BYTES = 8 * 2**30
"""Of actions in memory: 25,000 anchors × 5 seeds × 100 steps × 6 columns take 0.3 GB."""
MOST_STEPS = 10_000
BATCH = 4096
NEEDED, OPTIONAL = ("episode_index", "frame_index", "action"), ("seed", "fold", "sample")


@dataclass(frozen=True)
class Answers:
    """What was predicted, in the order of the anchors.

    covered   positions of the episodes predicted, ascending; every anchor of each is there
    anchors   [M] global frames, ascending
    fold      [len(covered)] the `fold` given for each episode, or None
    seeds     numbers of the networks
    actions   [S, n, M, K, A] float32, n samples
    notes     what was left out
    """

    covered: np.ndarray
    anchors: np.ndarray
    fold: np.ndarray | None
    seeds: tuple[int, ...]
    actions: np.ndarray
    notes: tuple[str, ...]


def read_answers(path: Path, demos: Demonstrations, history: int) -> Answers:
    """Read predictions for the anchors of a data set.

    Parameters
    ----------
    history : anchors are the frames from number history − 1 on; earlier rows are left out.

    Raises
    ------
    DatasetError : anything that keeps a row from being the prediction of one anchor.
    """
    rows = _read_rows(path, len(demos.features[ACTION].names), _columns_words(demos))
    anchors = _global_frames(rows, path, demos)
    wanted = rows["frame_index"] >= history - 1
    if not wanted.any():
        raise DatasetError(
            f"{path}: no row is an anchor. Anchors are the frames from number {history - 1} of each episode on; see them with: "
            f"demobench score {demos.name} --write-anchors anchors.parquet"
        )
    early = int((~wanted).sum())
    notes = [f"{early:,} rows before frame {history - 1} of their episodes are no anchors and are not scored"] * (
        early > 0
    )
    number = np.flatnonzero(wanted)  # the row in the file, for messages
    rows = {name: values[wanted] for name, values in rows.items()}
    anchors = anchors[wanted]
    order, shape, seeds = _arranged(rows, anchors, number, path, demos)
    covered, every = _require_whole_episodes(np.unique(anchors), path, demos, history)
    fold = _fold_of_covered(rows, anchors, number, covered, path, demos) if "fold" in rows else None
    actions = rows["action"][order].reshape(*shape, *rows["action"].shape[1:])
    return Answers(covered, every, fold, seeds, _no_longer_than_episodes(actions, demos, history, notes), tuple(notes))


def _columns_words(demos: Demonstrations) -> str:
    names = demos.features[ACTION].names
    shown = ", ".join(names[:12]) + (", …" if len(names) > 12 else "")
    return f"{len(names)} action columns ({shown})"


# Bytes to columns ----------------------------------------------------------------------------------------------------


def _read_rows(path: Path, width: int, columns_words: str) -> dict[str, np.ndarray]:
    """The columns of the file: whole numbers [R], and `action` [R, K, width] float32."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with pq.ParquetFile(path) as file:
            _check_schema(file.schema_arrow, path)
            _check_size(file.metadata, path)
            found = [name for name in (*NEEDED, *OPTIONAL) if name in file.schema_arrow.names]
            parts: dict[str, list[np.ndarray]] = {name: [] for name in found}
            first, steps = 0, None
            for batch in file.iter_batches(BATCH, columns=found, use_threads=False):
                for name in found:
                    if name != "action":
                        parts[name].append(_whole_numbers(batch.column(name), name, first, path))
                actions = _actions(batch.column("action"), first, width, columns_words, steps, path)
                steps = actions.shape[1]
                parts["action"].append(actions)
                first += len(batch)
    except (pa.ArrowException, OSError) as error:
        raise DatasetError(
            f"The predictions {path} cannot be read as parquet: {str(error).splitlines()[0].rstrip('.')}. Write them with pandas "
            "(to_parquet) or pyarrow."
        ) from None
    if not first:
        raise DatasetError(f"{path} has no rows. Expected one for each anchor; get them with --write-anchors.")
    return {name: np.concatenate(arrays) for name, arrays in parts.items()}


def _check_schema(schema: Any, path: Path) -> None:
    import pyarrow.types as kinds

    for name in NEEDED:
        if name not in schema.names:
            raise DatasetError(
                f"{path} has no column '{name}'. {did_you_mean(name, schema.names)} Expected episode_index, frame_index and "
                "action, and where there are several: seed, fold, sample."
            )
    for name in (*NEEDED, *OPTIONAL):
        if schema.names.count(name) > 1:
            raise DatasetError(f"{path} has {schema.names.count(name)} columns named '{name}'. Keep one.")
        if name in schema.names and name != "action" and not kinds.is_integer(schema.field(name).type):
            raise DatasetError(
                f"{path}: the column '{name}' is {schema.field(name).type}; expected whole numbers (int64). Missing values "
                "turn whole numbers into floats: look for them, then convert."
            )
    kind = schema.field("action").type
    inner = kind.value_type if _is_list(kind) else None
    number = inner.value_type if inner is not None and _is_list(inner) else None
    if number is None or not (kinds.is_floating(number) or kinds.is_integer(number)):
        raise DatasetError(
            f"{path}: the column 'action' is {kind}; expected list<list<float>>, K actions of A numbers in every row. A single "
            "action is a list in a list: [[0.1, 0.2, …]]."
        )


def _is_list(kind: Any) -> bool:
    import pyarrow.types as kinds

    return kinds.is_list(kind) or kinds.is_large_list(kind) or kinds.is_fixed_size_list(kind)


def _check_size(metadata: Any, path: Path) -> None:
    """Before memory is taken: what the file says that it holds, four bytes a number."""
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    values = sum(
        group.column(i).num_values
        for group in groups
        for i in range(group.num_columns)
        if group.column(i).path_in_schema.split(".")[0] in (*NEEDED, *OPTIONAL)
    )
    if 4 * values > MOST_BYTES:
        raise DatasetError(
            f"{path} holds {values:,} numbers, {4 * values / 2**30:.0f} GiB; at most {MOST_BYTES / 2**30:.0f} GiB are read. "
            "Predict fewer steps, seeds, samples or episodes."
        )


def _whole_numbers(column: Any, name: str, first: int, path: Path) -> np.ndarray:
    if column.null_count:
        row = first + int(np.flatnonzero(np.asarray(column.is_null()))[0])
        raise DatasetError(f"{path}: '{name}' is missing in row {row:,}. Every row needs it.")
    values = np.asarray(column)
    if values.dtype == np.uint64 and len(values) and values.max() > np.iinfo(np.int64).max:
        raise DatasetError(f"{path}: '{name}' holds {values.max()}, which is no number of anything recorded.")
    return values.astype(np.int64)


def _actions(column: Any, first: int, width: int, columns_words: str, steps: int | None, path: Path) -> np.ndarray:
    """[rows, K, width] float32 of one batch; `steps` is the K of the batches before it."""
    rows = len(column)
    _refuse_missing(column, first, 1, "an action", path)
    outer = _lengths(column)
    steps = int(outer[0]) if steps is None else steps
    if not 1 <= steps <= MOST_STEPS:
        raise DatasetError(f"{path}: row {first:,} has {steps:,} actions; expected between 1 and {MOST_STEPS:,}.")
    if (other := np.flatnonzero(outer != steps)).size:
        raise DatasetError(
            f"{path}: row {first + other[0]:,} has {outer[other[0]]} actions, earlier rows have {steps}. Every row needs the same "
            "number K of steps; what lies past the end of an episode is not scored and may hold anything finite."
        )
    inner = column.flatten()
    _refuse_missing(inner, first, steps, "one of its actions", path)
    widths = _lengths(inner)
    if (other := np.flatnonzero(widths != width)).size:
        raise DatasetError(
            f"{path}: an action in row {first + other[0] // steps:,} has {widths[other[0]]} numbers; the data set has "
            f"{columns_words}."
        )
    flat = inner.flatten()
    _refuse_missing(flat, first, steps * width, "a number", path)
    values = np.asarray(flat).astype(np.float32).reshape(rows, steps, width)
    if not np.isfinite(values).all():
        row, step, number = (int(i) for i in np.argwhere(~np.isfinite(values))[0])
        raise DatasetError(
            f"{path}: row {first + row:,} predicts {values[row, step, number]} in step {step}, column {number}. Every number must "
            "be finite, steps past the end of an episode too (repeat the last action there)."
        )
    return values


def _refuse_missing(column: Any, first: int, of_row: int, what: str, path: Path) -> None:
    """`of_row` values of the column belong to one row."""
    if column.null_count:
        missing = int(np.flatnonzero(np.asarray(column.is_null()))[0])
        raise DatasetError(
            f"{path}: {what} is missing in row {first + missing // of_row:,}. Every number must be there."
        )


def _lengths(column: Any) -> np.ndarray:
    import pyarrow.compute as pc

    return np.asarray(pc.list_value_length(column))


# Rows to anchors -----------------------------------------------------------------------------------------------------


def _place(demos: Demonstrations, anchor: int) -> str:
    episode = int(demos.episode_of_frame[anchor])
    return f"episode {demos.episode_ids[episode]}, frame {anchor - demos.episode_starts[episode]}"


def _global_frames(rows: dict[str, np.ndarray], path: Path, demos: Demonstrations) -> np.ndarray:
    """[R] the global frame of each row."""
    order = np.argsort(demos.episode_ids, kind="stable")
    sorted_ids = demos.episode_ids[order]
    at = np.minimum(np.searchsorted(sorted_ids, rows["episode_index"]), demos.episodes - 1)
    unknown = np.flatnonzero(sorted_ids[at] != rows["episode_index"])
    if unknown.size:
        number = int(rows["episode_index"][unknown[0]])
        known = f"which has {demos.episodes} episodes, numbered {sorted_ids[0]} to {sorted_ids[-1]}"
        left_out = number in getattr(demos, "excluded", ())
        why = "the configuration leaves it out (exclude)" if left_out else known
        raise DatasetError(
            f"{path}: row {unknown[0]:,} is of episode {number}, which '{demos.name}' does not have: {why}."
        )
    episode = order[at]
    lengths, frame = demos.lengths[episode], rows["frame_index"]
    outside = np.flatnonzero((frame < 0) | (frame >= lengths))
    if outside.size:
        row = int(outside[0])
        raise DatasetError(
            f"{path}: row {row:,} is of frame {frame[row]} in episode {rows['episode_index'][row]}, which has frames 0 to "
            f"{lengths[row] - 1}. frame_index counts from 0 within each episode."
        )
    return demos.episode_starts[episode] + frame


def _arranged(
    rows: dict[str, np.ndarray], anchors: np.ndarray, number: np.ndarray, path: Path, demos: Demonstrations
) -> tuple[np.ndarray, tuple[int, int, int], tuple[int, ...]]:
    """The order that sorts rows by seed, sample and anchor; (S, n, M); the seeds. Every one of them has every anchor, once."""
    zeros = np.zeros(len(anchors), np.int64)
    seed, sample = rows.get("seed", zeros), rows.get("sample", zeros)
    order = np.lexsort((anchors, sample, seed))
    keys = np.stack([seed, sample, anchors])[:, order]
    twice = np.flatnonzero((keys[:, 1:] == keys[:, :-1]).all(axis=0))
    if twice.size:
        first, second = sorted(number[order[twice[0] : twice[0] + 2]])
        several = " Number them in a column `seed` or `sample` if there are several predictions of one anchor."
        raise DatasetError(
            f"{path}: rows {first:,} and {second:,} both predict {_place(demos, int(keys[2, twice[0]]))}.{several}"
        )
    seeds, samples, every = np.unique(seed), np.unique(sample), np.unique(anchors)
    if len(order) != len(seeds) * len(samples) * len(every):
        _name_missing(keys, seeds, samples, every, path, demos)
    return order, (len(seeds), len(samples), len(every)), tuple(seeds.tolist())


def _name_missing(
    keys: np.ndarray, seeds: np.ndarray, samples: np.ndarray, every: np.ndarray, path: Path, demos: Demonstrations
) -> None:
    """Say which anchor a seed or a sample lacks that others have."""
    for seed in seeds:
        for sample in samples:
            here = keys[2, (keys[0] == seed) & (keys[1] == sample)]
            missing = np.setdiff1d(every, here)
            if missing.size:
                of = f"seed {seed}" + (f", sample {sample}," if len(samples) > 1 else "")
                raise DatasetError(
                    f"{path}: {of} has no prediction of {_place(demos, int(missing[0]))} ({len(missing):,} anchors are missing), "
                    "which others have. Every seed and every sample must predict the same anchors."
                )


def _require_whole_episodes(
    anchors: np.ndarray, path: Path, demos: Demonstrations, history: int
) -> tuple[np.ndarray, np.ndarray]:
    """The episodes predicted, and all their anchors; each must be there."""
    covered = np.unique(demos.episode_of_frame[anchors])
    every = anchors_of(demos, history, covered.tolist())
    missing = np.setdiff1d(every, anchors)
    if missing.size:
        episode = int(demos.episode_of_frame[missing[0]])
        of_it = int((demos.episode_of_frame[missing] == episode).sum())
        total = int(demos.lengths[episode]) - history + 1
        raise DatasetError(
            f"{path}: {_place(demos, int(missing[0]))} is not predicted ({of_it:,} of this episode's {total:,} anchors are "
            "missing). An episode is predicted at every frame from number "
            f"{history - 1} on, or not at all; `demobench score {demos.name} --write-anchors` lists them."
        )
    return covered, every


def _fold_of_covered(
    rows: dict[str, np.ndarray], anchors: np.ndarray, number: np.ndarray, covered: np.ndarray, path: Path, demos
) -> np.ndarray:
    """[len(covered)] the fold of each episode, which must be one."""
    at = np.searchsorted(covered, demos.episode_of_frame[anchors])
    fold = np.zeros(len(covered), np.int64)
    fold[at] = rows["fold"]
    other = np.flatnonzero(rows["fold"] != fold[at])
    if other.size:
        row = int(other[0])
        raise DatasetError(
            f"{path}: row {number[row]:,} gives episode {demos.episode_ids[covered[at[row]]]} the fold {rows['fold'][row]}, "
            f"another row gives it {fold[at[row]]}. One network predicts an episode, so it has one fold."
        )
    return fold


def _no_longer_than_episodes(
    actions: np.ndarray, demos: Demonstrations, history: int, notes: Sequence[str]
) -> np.ndarray:
    """Steps that lie past the end of every episode are cut off."""
    longest = int(demos.lengths.max()) - history + 1
    if actions.shape[3] > longest:
        notes.append(f"steps from number {longest} on lie past the end of every episode and are not scored")
    return actions[:, :, :, :longest]


def hash_file(path: Path) -> str:
    """sha256 of a file of predictions.

    Raises:
        DatasetError: it cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise DatasetError(f"The predictions {path} cannot be read: {error.strerror}.") from None

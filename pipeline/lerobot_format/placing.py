"""Which rows are which frames: the rows of the data files, put into the episodes that meta/ lists.

There are three witnesses: the list in meta/ (how long each episode is, and in which file), and the frames' own
`episode_index` and `frame_index`. Where they differ, what two of them say is believed and reported; where no two agree,
the data set is refused. What does not belong here: reading rows (frames.py), the list itself (layout.py).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.errors import DatasetError
from pipeline.lerobot_format.frames import Frames
from pipeline.lerobot_format.layout import Layout
from pipeline.lerobot_format.parts import blocks, parts

MOST_NAMED = 10


@dataclass(frozen=True)
class Places:
    """Where the frames of the episodes are.

    rows    [N] the row of each frame, episodes one after another; None where the rows are the frames as they stand
    starts  [E + 1] as `Demonstrations.episode_starts`
    """

    rows: np.ndarray | None
    starts: np.ndarray
    notes: tuple[str, ...]

    def take(self, values: np.ndarray) -> np.ndarray:
        """The values of the frames, from those of all rows."""
        return values if self.rows is None else values[self.rows]


def place_frames(layout: Layout, frames: Frames) -> Places:
    """Find the frames of every episode of the layout.

    Raises:
        DatasetError: frames are missing, twice or in doubt.
    """
    owner, notes = _owners(layout, frames)
    ids = np.array([entry.id for entry in layout.episodes], np.int64)
    position = _positions(ids, owner)
    rows = None
    if (position < 0).any() or (np.diff(position) < 0).any():
        kept = np.flatnonzero(position >= 0)
        if (np.diff(position[kept]) < 0).any():
            _refuse_without_numbers(layout, frames)
            notes.append("The data files do not hold the episodes in order; they were sorted by episode_index.")
        rows = kept[np.argsort(position[kept], kind="stable")]
    counts = np.bincount(position[position >= 0], minlength=len(ids))
    starts = np.concatenate([[0], np.cumsum(counts)])
    if frames.frame_index is None:
        _check_lengths(layout, frames, counts)
        return Places(rows, starts, tuple(notes))
    return _by_frame_index(layout, frames, rows, starts, notes)


def _positions(ids: np.ndarray, owner: np.ndarray) -> np.ndarray:
    """[rows] int32, where each row's episode stands in `ids`; −1 where it does not."""
    position = np.empty(len(owner), np.int32)
    for part in parts(len(owner)):
        at = np.minimum(np.searchsorted(ids, owner[part]), len(ids) - 1)
        position[part] = np.where(ids[at] == owner[part], at, -1)
    return position


def _owners(layout: Layout, frames: Frames) -> tuple[np.ndarray, list[str]]:
    """[rows] the recorded number of the episode that each row belongs to, and what had to be decided for it."""
    listed = _by_the_list(layout, frames)
    if frames.episode_id is None:
        if listed is None:
            raise _other_count(layout, frames)
        return listed, []
    found = set(np.unique(frames.episode_id).tolist())
    absent = [entry.id for entry in layout.episodes if entry.id not in found]
    if not absent:
        unlisted = sorted(found - {entry.id for entry in layout.listed})
        rows = int(np.isin(frames.episode_id, unlisted).sum()) if unlisted else 0
        said = f"{rows:,} frames of episodes that meta/ does not list were left out: {_numbers(unlisted)}."
        return frames.episode_id, [said] if unlisted else []
    if listed is None:
        raise _other_count(layout, frames)
    if (_boundaries(listed, frames.file_of) == _boundaries(frames.episode_id, frames.file_of)).all():
        return listed, [
            "The frames' episode_index is another than in meta/, their boundaries are the same; meta/ was believed."
        ]
    raise DatasetError(
        f"{layout.folder}: no frame has the episode_index {_numbers(absent)}, which meta/ lists, and the frames' "
        "episodes begin elsewhere than the listed lengths say. Copy the data set again, or leave the episodes out: "
        f"exclude = [{_numbers(absent)}]."
    )


def _by_the_list(layout: Layout, frames: Frames) -> np.ndarray | None:
    """What meta/ alone says: whole episodes of the listed lengths, in the order of their numbers within each file.

    None where the files do not have as many rows.
    """
    order = layout.in_files
    counts: dict[str | None, int] = {}
    for entry in order:
        counts[entry.file] = counts.get(entry.file, 0) + entry.length
    rows = np.bincount(frames.file_of, minlength=len(layout.files)) if layout.has_places else [len(frames.file_of)]
    if list(counts.values()) != list(rows):
        return None
    return np.repeat([entry.id for entry in order], [entry.length for entry in order])


def _boundaries(owner: np.ndarray, file_of: np.ndarray) -> np.ndarray:
    """[rows − 1] bool: another episode, or another file, begins after the row."""
    return (np.diff(owner) != 0) | (np.diff(file_of) != 0)


def _other_count(layout: Layout, frames: Frames) -> DatasetError:
    """The first file with another number of rows than meta/ lists in it."""
    rows = np.bincount(frames.file_of, minlength=len(layout.files))
    for position, file in enumerate(layout.files):
        expected = sum(entry.length for entry in layout.in_files if entry.file == file)
        if layout.has_places and rows[position] != expected:
            where, found = layout.folder / file, int(rows[position])
            break
    else:
        where, found = layout.folder / "data", int(rows.sum())
        expected = sum(entry.length for entry in layout.in_files)
    return DatasetError(
        f"{where} has {found:,} frames; the episodes that meta/ lists in it have {expected:,}. "
        "The data or the list is out of date: copy the data set again, or correct the list."
    )


def _refuse_without_numbers(layout: Layout, frames: Frames) -> None:
    if frames.episode_id is None:
        raise DatasetError(
            f"{layout.folder}: meta/ spreads consecutive episodes over files out of order, and the frames have no "
            "episode_index that would tell them apart. Sort the episodes by file."
        )


def _check_lengths(layout: Layout, frames: Frames, counts: np.ndarray) -> None:
    """Without `frame_index` the number of rows must be the listed length, and an episode's rows must lie together."""
    lengths = np.array([entry.length for entry in layout.episodes])
    if (counts != lengths).any():
        raise _not_listed(layout, int(np.flatnonzero(counts != lengths)[0]), counts)
    if frames.episode_id is None:
        return
    runs = frames.episode_id[np.concatenate([[True], np.diff(frames.episode_id) != 0])]
    found, times = np.unique(runs, return_counts=True)
    scattered = set(found[times > 1].tolist()) & {entry.id for entry in layout.episodes}
    if scattered:
        raise DatasetError(
            f"{layout.folder}: the frames of episode {min(scattered)} lie apart, and without a column frame_index "
            "nothing tells their order. Sort the frames, or record the episode again."
        )


def _not_listed(layout: Layout, episode: int, counts: np.ndarray) -> DatasetError:
    entry = layout.episodes[episode]
    return DatasetError(
        f"{layout.folder}: episode {entry.id} has {counts[episode]:,} frames, but meta/ lists {entry.length:,}. "
        f"Correct the list, copy the data set again, or leave the episode out: exclude = [{entry.id}]."
    )


def _by_frame_index(
    layout: Layout, frames: Frames, rows: np.ndarray | None, starts: np.ndarray, notes: list[str]
) -> Places:
    """Check, and where it is without doubt mend, the order of the frames within episodes."""
    taken: Callable = (lambda values: values) if rows is None else (lambda values: values[rows])
    numbers, counts = taken(frames.frame_index), np.diff(starts)
    wrong = np.zeros(starts[-1], bool)
    for episodes, inside in blocks(starts):
        expected = np.arange(inside.start, inside.stop) - np.repeat(starts[:-1][episodes], counts[episodes])
        wrong[inside] = numbers[inside] != expected
    lengths = np.array([entry.length for entry in layout.episodes])
    clock = None if frames.timestamps is None else taken(frames.timestamps)
    said: dict[str, list[int]] = {}
    for episode in np.unique(np.searchsorted(starts, np.flatnonzero(wrong), side="right") - 1):
        inside = slice(starts[episode], starts[episode + 1])
        order, what = _judge(layout, int(episode), numbers[inside], None if clock is None else clock[inside], lengths)
        said.setdefault(what, []).append(layout.episodes[episode].id)
        if order is not None:
            rows = np.arange(starts[-1]) if rows is None else rows
            rows[inside] = rows[inside][order]
    other = np.flatnonzero(counts != lengths)
    if len(other):
        words = ", ".join(f"{layout.episodes[e].id}: {lengths[e]:,}, found {counts[e]:,}" for e in other[:MOST_NAMED])
        more = ", …" if len(other) > MOST_NAMED else ""
        notes.append(f"meta/ lists other lengths than the data have ({words}{more}); the data were believed.")
    return Places(rows, starts, (*notes, *(f"{what}: episode {_numbers(ids)}." for what, ids in said.items())))


def _judge(
    layout: Layout, episode: int, numbers: np.ndarray, clock: np.ndarray | None, lengths: np.ndarray
) -> tuple[np.ndarray | None, str]:
    """The order of an episode's rows (None: as they are) whose `frame_index` is not 0, 1, 2, …, and what to say of it."""
    as_listed = len(numbers) == lengths[episode]
    steps = np.diff(numbers)
    if (steps == 1).all():
        return None, "frame_index does not start at 0; frames were counted anew"
    if (steps > 0).all() and as_listed:
        return None, "frame_index jumps: frames were taken out, and the rest counts as one after another"
    order = np.argsort(numbers, kind="stable")
    if (np.diff(numbers[order]) == 1).all() and (clock is None or (np.diff(clock[order]) >= 0).all()):
        return order, "Frames lay out of order and were sorted by frame_index"
    frame = int(np.flatnonzero(numbers != np.arange(len(numbers)))[0])
    number = layout.episodes[episode].id
    raise DatasetError(
        f"{layout.folder}: episode {number} has frame_index {numbers[frame]} where {frame} was expected: frames are "
        "missing, twice or out of order, and nothing tells how they belong together. Sort the frames, record the "
        f"episode again, or leave it out: exclude = [{number}]."
    )


def _numbers(ids: list[int]) -> str:
    return ", ".join(map(str, ids[:MOST_NAMED])) + (", …" if len(ids) > MOST_NAMED else "")

"""A source → Demonstrations.

What belongs here: putting frames and meta/ together, and every check between them: an error where a difference would
make a number wrong, a warning where not. What does not: what columns mean (quality.py), downloading (hub.py).
"""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import DatasetError
from pipeline.lerobot_format.frames import Frames, read_frames
from pipeline.lerobot_format.layout import Layout, read_layout
from pipeline.lerobot_format.saved import hash_demonstrations, load_demonstrations, save_demonstrations
from pipeline.types import ACTION, Demonstrations

__all__ = ["load_demonstrations", "load_source", "read_dataset", "save_demonstrations", "source_stamp"]

EMBEDDED, HUB = "embedded:", "hub:"


def read_dataset(
    folder: Path, *, name: str, source: str | None = None, revision: str | None = None, videos_expected: bool = True
) -> Demonstrations:
    """Read a LeRobot folder (v2.0, v2.1, v3.0) into memory. Pictures and videos are never read.

    `videos_expected=False` says that absent videos are no fault (a download without them).

    Raises:
        DatasetError: the folder cannot be read, or a number made from it would be wrong.
    """
    layout = read_layout(folder)
    frames = read_frames(layout)
    starts = _episode_starts(layout, frames)
    _check_numbers(layout, frames, starts)
    timestamps, clock_notes = _timestamps(layout, frames, starts)
    arrays = {
        "episode_starts": starts,
        "episode_ids": np.array([entry.id for entry in layout.episodes], np.int64),
        "timestamps": timestamps,
        "tasks": _tasks(layout, frames, starts),
    }
    features = {key: layout.features[key] for key in frames.columns}
    return Demonstrations(
        name=name,
        source=source if source is not None else str(folder),
        revision=revision,
        fps=layout.fps,
        robot_type=layout.robot_type,
        columns=frames.columns,
        features=features,
        cameras=layout.cameras,
        warnings=(*layout.warnings, *frames.warnings, *clock_notes, *_absent_videos(layout, videos_expected)),
        content_hash=hash_demonstrations(frames.columns, features, fps=layout.fps, **arrays),
        **arrays,
    )


def _episode_starts(layout: Layout, frames: Frames) -> np.ndarray:
    """[E + 1]; the frames are checked to be whole episodes, in order, one after another.

    The lists in meta/ give the lengths (`read_frames` has compared the totals of each file); index columns, where they
    are there, must agree.
    """
    lengths = np.array([entry.length for entry in layout.episodes], np.int64)
    starts = np.concatenate([[0], np.cumsum(lengths)])
    ids = np.repeat([entry.id for entry in layout.episodes], lengths)
    files = {file: position for position, file in enumerate(layout.files)}
    expected_file = np.repeat([files[entry.file] for entry in layout.episodes], lengths)
    if (expected_file != frames.file_of).any():
        raise DatasetError(
            f"{layout.folder}: meta/ spreads consecutive episodes over files out of order. Sort the episodes by file."
        )
    if frames.episode_id is not None and (frames.episode_id != ids).any():
        frame = int(np.flatnonzero(frames.episode_id != ids)[0])
        raise DatasetError(
            f"{layout.folder / layout.files[frames.file_of[frame]]}: frame {frame} of the data set belongs to episode "
            f"{frames.episode_id[frame]}, but the lengths that meta/ lists put it in episode {ids[frame]}. "
            "Episodes must lie one after another with the listed lengths: correct the list, or copy the data set again."
        )
    if frames.frame_index is not None:
        expected = np.arange(starts[-1]) - np.repeat(starts[:-1], lengths)
        if (frames.frame_index != expected).any():
            frame = int(np.flatnonzero(frames.frame_index != expected)[0])
            raise DatasetError(
                f"{layout.folder}: episode {ids[frame]} has frame_index {frames.frame_index[frame]} where "
                f"{expected[frame]} was expected: frames are missing or out of order. "
                "Sort the frames, or record the episode again."
            )
    return starts


def _check_numbers(layout: Layout, frames: Frames, starts: np.ndarray) -> None:
    """Actions and observations are finite."""
    for key, values in frames.columns.items():
        if key != ACTION and not key.startswith("observation."):
            continue
        if np.isfinite(values).all():
            continue
        frame, column = map(int, np.argwhere(~np.isfinite(values))[0])
        episode = int(np.searchsorted(starts, frame, side="right")) - 1
        raise DatasetError(
            f"{layout.folder}: {key} is {values[frame, column]} in episode {layout.episodes[episode].id}, frame "
            f"{frame - starts[episode]}, column '{layout.features[key].names[column]}'; expected a finite number. "
            "Remove the episode, or repair the recording."
        )


def _timestamps(layout: Layout, frames: Frames, starts: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """[N] seconds from the start of the episode, derived from fps where there are none."""
    lengths = np.diff(starts)
    if frames.timestamps is None:
        return (np.arange(starts[-1]) - np.repeat(starts[:-1], lengths)) / layout.fps, []
    stamps = frames.timestamps
    if not np.isfinite(stamps).all():
        frame = int(np.flatnonzero(~np.isfinite(stamps))[0])
        raise DatasetError(f"{layout.folder}: the timestamp of frame {frame} is {stamps[frame]}; expected seconds.")
    notes = []
    first = stamps[starts[:-1]]
    if np.abs(first).max() > max(1.0, 2 / layout.fps):
        stamps = stamps - np.repeat(first, lengths)
        notes.append("Timestamps did not start near 0 in every episode; they were shifted to start at 0.")
    steps = np.diff(stamps)
    steps[starts[1:-1] - 1] = 1.0
    backwards = int((steps <= 0).sum())
    if backwards:
        notes.append(f"The recorded clock stands still or runs backwards at {backwards} frames.")
    return stamps, notes


def _tasks(layout: Layout, frames: Frames, starts: np.ndarray) -> tuple[str, ...]:
    """The task of each episode in words: from meta/, else by the `task_index` of its first frame."""
    words = []
    for position, entry in enumerate(layout.episodes):
        task = entry.task
        if task is None and frames.task_index is not None:
            task = layout.tasks.get(int(frames.task_index[starts[position]]))
        words.append(task or "")
    return tuple(words)


def _absent_videos(layout: Layout, expected: bool) -> list[str]:
    if not expected:
        return []
    return [
        f"Camera '{camera.key}' is declared, but video files are absent; nothing that uses it can run."
        for camera in layout.cameras
        if not camera.present
    ]


def load_source(source: str, *, name: str, config_dir: Path, videos: bool = False) -> Demonstrations:
    """Read what `source` in demobench.toml means: `embedded:‹name›`, `hub:‹owner/name›[@revision]`, or a folder.

    A relative folder is relative to `config_dir`. `videos` asks for the videos of a Hub data set as well.

    Raises:
        DatasetError: it cannot be read; HubError where the Hub is the reason.
    """
    if source.startswith(EMBEDDED):
        from pipeline.embedded import embedded_folder

        return read_dataset(embedded_folder(source.removeprefix(EMBEDDED)), name=name, source=source)
    if source.startswith(HUB):
        from pipeline.lerobot_format.hub import fetch

        copy = fetch(source.removeprefix(HUB), videos=videos)
        demonstrations = read_dataset(
            copy.folder, name=name, source=source, revision=copy.commit, videos_expected=videos
        )
        return _with_warnings(demonstrations, copy.warnings)
    return read_dataset(_folder(source, config_dir), name=name, source=source)


def _with_warnings(demonstrations: Demonstrations, more: tuple[str, ...]) -> Demonstrations:
    from dataclasses import replace

    return replace(demonstrations, warnings=(*demonstrations.warnings, *more)) if more else demonstrations


def _folder(source: str, config_dir: Path) -> Path:
    if "://" in source:
        raise DatasetError(
            f"The source '{source}' is a URL. Give a folder, hub:owner/name[@revision], or embedded:pusht_sim."
        )
    folder = config_dir / Path(source).expanduser()
    if not folder.exists() and source.count("/") == 1 and not source.startswith((".", "~", "/")):
        raise DatasetError(
            f"The data set's folder {folder} does not exist. For a data set on the Hub write hub:{source}."
        )
    return folder


def source_stamp(source: str, config_dir: Path) -> dict[str, Any]:
    """What makes a source stale, found without reading it: JSON-able, equal while nothing has changed.

    Folder: its path and a digest of the paths, sizes and times of its files. Hub: the commit that the revision stands
    for now (as the cache last saw it where the Hub is out of reach). Embedded: the bytes themselves, which are few.

    Raises:
        DatasetError: no such folder or name.
    """
    if source.startswith(EMBEDDED):
        from pipeline.embedded import embedded_folder

        folder = embedded_folder(source.removeprefix(EMBEDDED))
        digest = hashlib.sha256()
        for path in _data_files(folder):
            digest.update(
                f"{path.relative_to(folder).as_posix()}\0".encode() + hashlib.sha256(path.read_bytes()).digest()
            )
        return {"kind": "embedded", "name": source.removeprefix(EMBEDDED), "digest": digest.hexdigest()}
    if source.startswith(HUB):
        from pipeline.lerobot_format.hub import current_commit, parse_repository

        repository, revision = parse_repository(source.removeprefix(HUB))
        return {
            "kind": "hub",
            "repository": repository,
            "revision": revision,
            "commit": current_commit(repository, revision),
        }
    folder = _folder(source, config_dir)
    if not folder.is_dir():
        read_layout(folder)  # its message says what is wrong
    digest, count, size = hashlib.sha256(), 0, 0
    for path in _data_files(folder):
        stat = path.stat()
        digest.update(f"{path.relative_to(folder).as_posix()}\0{stat.st_size}\0{stat.st_mtime_ns}\n".encode())
        count, size = count + 1, size + stat.st_size
    return {
        "kind": "folder",
        "path": str(folder.resolve()),
        "files": count,
        "bytes": size,
        "digest": digest.hexdigest(),
    }


def _data_files(folder: Path) -> list[Path]:
    return sorted(path for part in ("meta", "data", "videos") for path in (folder / part).rglob("*") if path.is_file())

"""A source → Demonstrations.

What belongs here: the steps from files to columns, and the last checks of their numbers. What does not: which row is which
frame (placing.py), which feature plays which part (columns.py), what columns mean (quality.py), downloading (hub.py).
"""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import DatasetError
from pipeline.experiment import Experiment
from pipeline.lerobot_format.archives import is_archive, unpacked
from pipeline.lerobot_format.columns import arrange, check_observation_set, names_after, set_units
from pipeline.lerobot_format.files import stamp_of_file
from pipeline.lerobot_format.frames import Frames, read_frames
from pipeline.lerobot_format.joined import check_names, join_feature, stamp_of_features
from pipeline.lerobot_format.layout import Layout, read_layout
from pipeline.lerobot_format.placing import Places, place_frames
from pipeline.lerobot_format.quality import resolve_semantics
from pipeline.lerobot_format.saved import hash_demonstrations, load_demonstrations, save_demonstrations
from pipeline.types import AS_RECORDED, ColumnChoice, Demonstrations, Feature, Semantics

__all__ = [
    "check_experiment", "load_demonstrations", "load_experiment", "load_source", "read_dataset", "save_demonstrations",
    "source_folder", "source_stamp",
]  # fmt: skip

EMBEDDED, HUB = "embedded:", "hub:"


def read_dataset(
    folder: Path,
    *,
    name: str,
    source: str | None = None,
    revision: str | None = None,
    videos_expected: bool = True,
    choice: ColumnChoice = AS_RECORDED,
) -> Demonstrations:
    """Read a LeRobot folder (v2.0, v2.1, v3.0) into memory. Pictures and videos are never read.

    `videos_expected=False` says that absent videos are no fault (a download without them). `choice` says which features are
    the action and the state, what is joined to them, and which episodes are left out.

    Raises:
        DatasetError: the folder cannot be read, or a number made from it would be wrong.
        ConfigError: the choice names something that does not exist.
    """
    layout = read_layout(folder, choice)
    check_names(choice.features, {*layout.features, *(camera.key for camera in layout.cameras)})
    frames = read_frames(layout)
    places = place_frames(layout, frames)
    timestamps, clock_notes = _timestamps(layout, frames, places)
    tasks = _tasks(layout, frames, places)
    columns, features = _columns(layout, frames, places, choice)
    arrays = {
        "episode_starts": places.starts,
        "episode_ids": _ids(layout),
        "timestamps": timestamps,
        "tasks": tasks,
    }
    warnings = (*layout.warnings, *frames.warnings, *places.notes, *clock_notes)
    return Demonstrations(
        name=name,
        source=source if source is not None else str(folder),
        revision=revision,
        fps=layout.fps,
        robot_type=layout.robot_type,
        columns=columns,
        features=features,
        cameras=layout.cameras,
        warnings=(*warnings, *_absent_videos(layout, videos_expected)),
        content_hash=hash_demonstrations(columns, features, fps=layout.fps, **arrays),
        excluded=choice.exclude,
        **arrays,
    )


def _ids(layout: Layout) -> np.ndarray:
    return np.array([entry.id for entry in layout.episodes], np.int64)


def _columns(
    layout: Layout, frames: Frames, places: Places, choice: ColumnChoice
) -> tuple[dict[str, np.ndarray], dict[str, Feature]]:
    """What the benchmark sees: the recorded columns with those joined, `action` and `observation.state` among them."""
    columns, features = {}, {key: layout.features[key] for key in frames.columns}
    for key in features:
        columns[key] = places.take(frames.columns.pop(key))  # one at a time: a copy of all would double the memory
    _check_numbers(layout, columns, features, places.starts)
    for key, path in choice.features.items():
        features[key], columns[key] = join_feature(
            key, path, ids=_ids(layout), starts=places.starts, excluded=choice.exclude
        )
    columns, features = arrange(columns, features, layout.roles)
    return columns, set_units(features, choice.units)


def _check_numbers(
    layout: Layout, columns: Mapping[str, np.ndarray], features: Mapping[str, Feature], starts: np.ndarray
) -> None:
    """Actions and observations are finite."""
    for key, values in columns.items():
        if key not in layout.roles.needed and not key.startswith("observation."):
            continue
        if np.isfinite(values).all():
            continue
        frame, column = map(int, np.argwhere(~np.isfinite(values))[0])
        episode = int(np.searchsorted(starts, frame, side="right")) - 1
        number = layout.episodes[episode].id
        raise DatasetError(
            f"{layout.folder}: {key} is {values[frame, column]} in episode {number}, frame "
            f"{frame - starts[episode]}, column '{features[key].names[column]}'; expected a finite number. "
            f"Leave the episode out (exclude = [{number}]), or repair the recording."
        )


def _timestamps(layout: Layout, frames: Frames, places: Places) -> tuple[np.ndarray, list[str]]:
    """[N] seconds from the start of the episode, derived from fps where there are none."""
    starts = places.starts
    lengths = np.diff(starts)
    if frames.timestamps is None:
        return (np.arange(starts[-1]) - np.repeat(starts[:-1], lengths)) / layout.fps, []
    stamps = places.take(frames.timestamps)
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


def _tasks(layout: Layout, frames: Frames, places: Places) -> tuple[str, ...]:
    """The task of each episode in words: from meta/, else by the `task_index` of its first frame."""
    index = None if frames.task_index is None else places.take(frames.task_index)
    words = []
    for position, entry in enumerate(layout.episodes):
        task = entry.task
        if task is None and index is not None:
            task = layout.tasks.get(int(index[places.starts[position]]))
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


def load_source(
    source: str, *, name: str, config_dir: Path, videos: bool = False, choice: ColumnChoice = AS_RECORDED
) -> Demonstrations:
    """Read what `source` in demobench.toml means: `embedded:‹name›`, `hub:‹owner/name›[@revision]`, a folder or a .zip.

    A relative path is relative to `config_dir`. `videos` asks for the videos of a Hub data set as well.

    Raises:
        DatasetError: it cannot be read; HubError where the Hub is the reason.
        ConfigError: the choice names something that does not exist.
    """
    if source.startswith(EMBEDDED):
        from pipeline.embedded import embedded_folder

        return read_dataset(embedded_folder(source.removeprefix(EMBEDDED)), name=name, source=source, choice=choice)
    if source.startswith(HUB):
        from pipeline.lerobot_format.hub import fetch

        copy = fetch(source.removeprefix(HUB), videos=videos)
        demonstrations = read_dataset(
            copy.folder, name=name, source=source, revision=copy.commit, videos_expected=videos, choice=choice
        )
        return _with_warnings(demonstrations, copy.warnings)
    return read_dataset(source_folder(source, config_dir), name=name, source=source, choice=choice)


def load_experiment(experiment: Experiment, config_dir: Path) -> tuple[Demonstrations, Semantics]:
    """The demonstrations that an experiment is about, read from their source, and what their columns mean.

    Raises:
        DatasetError, ConfigError: as `load_source` and `resolve_semantics`; an observation set names no feature.
    """
    dataset = experiment.dataset
    demos = load_source(dataset.source, name=experiment.name, config_dir=config_dir, choice=dataset.choice(config_dir))
    for observation_set in experiment.observation_sets:
        check_observation_set(observation_set, demos.columns, experiment.name)
    return demos, resolve_semantics(demos, kind=dataset.kind, circular=dataset.circular)


def check_experiment(experiment: Experiment, config_dir: Path) -> None:
    """Fail in a moment, before any work, where the source is not there or is no data set, or an observation set names a
    feature that it does not have (the Hub is not asked).
    """
    dataset = experiment.dataset
    choice = dataset.choice(config_dir)
    source_stamp(dataset.source, config_dir)
    stamp_of_features(choice.features)
    if not dataset.source.startswith((EMBEDDED, HUB)):
        layout = read_layout(source_folder(dataset.source, config_dir), choice)
        known = names_after({**layout.features, **dict.fromkeys(choice.features)}, layout.roles)
        for observation_set in experiment.observation_sets:
            check_observation_set(observation_set, known, experiment.name)


def _with_warnings(demonstrations: Demonstrations, more: tuple[str, ...]) -> Demonstrations:
    from dataclasses import replace

    return replace(demonstrations, warnings=(*demonstrations.warnings, *more)) if more else demonstrations


def source_folder(source: str, config_dir: Path) -> Path:
    """The folder that a path means; of a .zip that of its unpacked copy.

    Raises:
        DatasetError: it is a URL, or not there, or an archive that cannot be unpacked.
    """
    path = _path(source, config_dir)
    return unpacked(path) if is_archive(path) else path


def _path(source: str, config_dir: Path) -> Path:
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


def folder_of(source: str, config_dir: Path, *, commit: str | None, videos: bool) -> Path:
    """The folder with a source's files, for programs that read folders: of an archive that of its unpacked copy, on the Hub
    that of the copy in the cache (of `commit`, as it was read), with its videos where they are asked for.

    Raises:
        DatasetError: it cannot be had; HubError where the Hub is the reason.
    """
    if source.startswith(EMBEDDED):
        from pipeline.embedded import embedded_folder

        return embedded_folder(source.removeprefix(EMBEDDED))
    if source.startswith(HUB):
        from pipeline.lerobot_format.hub import fetch

        repository = source.removeprefix(HUB).split("@")[0]
        return fetch(f"{repository}@{commit}", videos=videos).folder
    return source_folder(source, config_dir)


def source_stamp(source: str, config_dir: Path) -> dict[str, Any]:
    """What makes a source stale, found without reading it: JSON-able, equal while nothing has changed.

    Folder: its path and a digest of the paths, sizes and times of its files. Archive: its path, size and time. Hub: the
    commit that the revision stands for now (as the cache last saw it where the Hub is out of reach). Embedded: the bytes
    themselves, which are few.

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
    folder = _path(source, config_dir)
    if is_archive(folder):
        return {"kind": "zip", **stamp_of_file(folder)}
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

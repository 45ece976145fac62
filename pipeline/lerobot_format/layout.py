"""What a LeRobot folder says about itself: features, episodes and the files they are in, cameras, tasks.

v2.0 and v2.1 keep one data file an episode and JSON lines; v3.0 keeps many episodes a file and parquet. From here
on they are the same `Layout`. What belongs here: meta/. What does not: the frames (frames.py), and whether frames and
meta/ agree (placing.py, read.py).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from pipeline.errors import ConfigError, DatasetError, printable
from pipeline.lerobot_format.cameras import read_camera
from pipeline.lerobot_format.columns import Roles, choose_roles
from pipeline.lerobot_format.files import fill, inside, read_json, read_json_lines, read_table
from pipeline.lerobot_format.units import column_names, unit_of
from pipeline.types import ACTION, AS_RECORDED, STATE, Camera, ColumnChoice, Feature

INFO = "meta/info.json"
INDEX_COLUMNS = ("timestamp", "frame_index", "episode_index", "index", "task_index")
"""Bookkeeping of the format, not features of the demonstrations."""

MAX_WIDTH = 4096
"""Numbers a frame of one feature may hold; what is larger is a picture in disguise, and left out."""

_NUMBERS = {
    "bool",
    "float",
    "double",
    *(f"{kind}{bits}" for kind in ("float", "int", "uint") for bits in (8, 16, 32, 64)),
}
_EPISODE_COLUMNS = {"episode_index", "length", "tasks"}


@dataclass(frozen=True)
class EpisodeEntry:
    """One episode as meta/ lists it. `task` is None where only the frames' `task_index` can say; `file` is relative, and
    None where meta/ does not say in which file the episode is.
    """

    id: int
    length: int
    file: str | None
    task: str | None


@dataclass(frozen=True)
class Layout:
    """Everything meta/ says, checked in itself.

    features  as recorded; `roles` says which of them are the action and the state
    listed    every episode with frames, in the order of their ids; `episodes` are those that are not left out
    files     the data files to read, each once, in the order of their first episode
    tasks     task_index → words
    """

    folder: Path
    fps: float
    robot_type: str | None
    features: Mapping[str, Feature]
    roles: Roles
    listed: tuple[EpisodeEntry, ...]
    episodes: tuple[EpisodeEntry, ...]
    files: tuple[str, ...]
    tasks: Mapping[int, str]
    cameras: tuple[Camera, ...]
    warnings: tuple[str, ...]

    @property
    def has_places(self) -> bool:
        """Whether meta/ says in which file each episode is."""
        return self.listed[0].file is not None

    @property
    def in_files(self) -> list[EpisodeEntry]:
        """The listed episodes in the order in which the files that are read should hold them."""
        if not self.has_places:
            return list(self.listed)
        inside: dict[str, list[EpisodeEntry]] = {file: [] for file in self.files}
        for entry in self.listed:
            inside.get(entry.file, []).append(entry)
        return [entry for file in self.files for entry in inside[file]]


@dataclass(frozen=True)
class _Info:
    """info.json as it stands in a folder; `major` is "2" or "3", the two layouts there are."""

    folder: Path
    content: Mapping[str, Any]
    major: str

    @property
    def path(self) -> Path:
        return self.folder / INFO


def read_layout(folder: Path, choice: ColumnChoice = AS_RECORDED) -> Layout:
    """Read meta/.

    Raises:
        DatasetError: no such folder, not a LeRobot data set, or meta/ contradicts itself.
        ConfigError: the choice names a feature or an episode that does not exist, or leaves nothing over.
    """
    content = _content(folder)
    major, version_notes = _major(folder, content)
    info = _Info(folder, content, major)
    declared = _declared(info)
    features, feature_notes = _features(info, declared, choice)
    joined = [name for name in choice.features if name not in features]
    roles = choose_roles([*features, *joined], choice, str(folder))
    rows = _episode_rows(info)
    listed, episode_notes = _episodes(info, rows)
    episodes = _without(listed, choice.exclude, folder)
    cameras = tuple(
        read_camera(folder, key, feature, content.get("video_path"), _video_places(info, key, rows))
        for key, feature in declared.items()
        if feature["dtype"] in ("video", "image")
    )
    robot = content.get("robot_type")
    return Layout(
        folder=folder,
        fps=_fps(info),
        robot_type=printable(robot) if isinstance(robot, str) and robot else None,
        features=features,
        roles=roles,
        listed=listed,
        episodes=episodes,
        files=_files(folder, episodes),
        tasks=_tasks(info),
        cameras=cameras,
        warnings=(*version_notes, *roles.notes, *feature_notes, *episode_notes),
    )


def _content(folder: Path) -> dict[str, Any]:
    if not folder.is_dir():
        what = "is a file, not a folder" if folder.exists() else "does not exist"
        raise DatasetError(
            f"The data set's folder {folder} {what}. Give a LeRobot folder (it holds meta/info.json), "
            "hub:owner/name[@revision], or embedded:pusht_sim."
        )
    if not (folder / INFO).exists():
        inner = sorted(child.name for child in folder.iterdir() if (child / INFO).exists())
        hint = (
            f" Did you mean {folder / inner[0]}?" if inner else " Give the folder that holds meta/, data/ and videos/."
        )
        raise DatasetError(f"{folder} is not a LeRobot data set: it has no {INFO}.{hint}")
    content = read_json(folder, INFO)
    if not isinstance(content, dict):
        raise DatasetError(
            f"{folder / INFO} holds a {type(content).__name__}; expected a JSON object. Copy the data set again."
        )
    return content


def _major(folder: Path, content: Mapping[str, Any]) -> tuple[str, list[str]]:
    said = str(content.get("codebase_version", "nothing"))
    major, _, minor = said.removeprefix("v").partition(".")
    if (major, minor) in {("2", "0"), ("2", "1"), ("3", "0")}:
        return major, []
    if major == "3":
        return "3", [f"codebase_version is '{said}', newer than v3.0; it was read as v3.0."]
    raise DatasetError(
        f"{folder / INFO}: codebase_version is '{said}'; v2.0, v2.1 and v3.0 are read. "
        "Convert the data set with LeRobot's own converter."
    )


def _fps(info: _Info) -> float:
    fps = info.content.get("fps")
    if isinstance(fps, bool) or not isinstance(fps, int | float) or not math.isfinite(fps) or fps <= 0:
        raise DatasetError(
            f"{info.path}: fps is {fps!r}; expected a number above 0. Write the recording's frame rate there."
        )
    return float(fps)


def _declared(info: _Info) -> dict[str, dict[str, Any]]:
    """`features` of info.json, each with a dtype and a shape of positive whole numbers (pictures may have another)."""
    features = info.content.get("features")
    if not isinstance(features, dict):
        raise DatasetError(f"{info.path}: 'features' is missing. It gives each column its dtype and shape.")
    for key, feature in features.items():
        if printable(key) != key:
            raise DatasetError(
                f"{info.path}: the name of the feature {key!r} holds control characters. Rename it, in the data files too."
            )
        if isinstance(feature, dict) and isinstance(shape := feature.get("shape"), int) and not isinstance(shape, bool):
            feature["shape"] = [shape]
        if _is_picture(feature) and not _has_dtype_and_shape(feature):
            feature["shape"] = []
        if not _has_dtype_and_shape(feature):
            raise DatasetError(
                f"{info.path}: feature '{key}' needs a dtype and a shape of whole numbers above 0, "
                f"got {repr(feature)[:120]}. Correct it."
            )
    return features


def _is_picture(feature: Any) -> bool:
    return isinstance(feature, dict) and feature.get("dtype") in ("video", "image")


def _has_dtype_and_shape(feature: Any) -> bool:
    if not isinstance(feature, dict) or not isinstance(feature.get("dtype"), str):
        return False
    shape = feature.get("shape")
    return isinstance(shape, list) and all(isinstance(n, int) and not isinstance(n, bool) and n > 0 for n in shape)


def _features(
    info: _Info, declared: dict[str, dict[str, Any]], choice: ColumnChoice
) -> tuple[dict[str, Feature], list[str]]:
    """The features made of numbers, and notes on what is left out."""
    features, notes = {}, []
    for key, feature in declared.items():
        dtype, width = feature["dtype"], math.prod(feature["shape"])
        if key in INDEX_COLUMNS or _is_picture(feature):
            continue
        if dtype not in _NUMBERS or width > MAX_WIDTH:
            if key in (*(choice.action or (ACTION,)), *(choice.state or (STATE,))):
                raise DatasetError(
                    f"{info.path}: '{key}' is {dtype} {feature['shape']}; expected numbers, at most {MAX_WIDTH} a "
                    "frame. Correct meta/info.json, or record the feature as numbers."
                )
            what = f"{dtype} {feature['shape']}"
            notes.append(f"Feature '{key}' ({what}) was left out: only numbers are used, at most {MAX_WIDTH} a frame.")
            continue
        names = column_names(key, feature.get("names"), width)
        if names is None:
            notes.append(f"Feature '{key}' has {width} columns but other names; its columns are numbered instead.")
            names = tuple(str(i) for i in range(width))
        features[key] = Feature(key, names, tuple(unit_of(name) for name in names))
    return features, notes


def _episode_rows(info: _Info) -> list[dict[str, Any]]:
    """One row an episode, without the statistics.

    Raises:
        DatasetError: the list is missing, or empty.
    """
    if info.major == "2":
        rows = read_json_lines(info.folder, "meta/episodes.jsonl")
    else:
        paths = sorted((info.folder / "meta/episodes").glob("chunk-*/file-*.parquet"))
        if not paths and info.content.get("total_episodes") != 0:
            raise DatasetError(
                f"{info.folder}/meta/episodes holds no chunk-*/file-*.parquet: the list of episodes is missing. "
                "Copy or download the data set again."
            )
        tables = [
            read_table(info.folder, path.relative_to(info.folder).as_posix(), _places_an_episode) for path in paths
        ]
        rows = [row for table in tables for row in table.to_pylist()]
    if not any(row.get("length") != 0 for row in rows):
        raise DatasetError(f"{info.folder} holds no episodes. Record at least one before benchmarking it.")
    return rows


def _places_an_episode(column: str) -> bool:
    return column in _EPISODE_COLUMNS or column.endswith(("/chunk_index", "/file_index"))


def _episodes(info: _Info, rows: list[dict[str, Any]]) -> tuple[tuple[EpisodeEntry, ...], list[str]]:
    has_places = info.major == "2" or all(row.get("data/file_index") is not None for row in rows)
    entries = [_entry(info, row, has_places) for row in rows]
    listed = sorted(dict.fromkeys(entries), key=lambda entry: entry.id)
    for one, other in pairwise(listed):
        if one.id == other.id:
            raise DatasetError(
                f"{info.folder}: meta/ lists episode {one.id} twice, and not alike. Remove one of the two rows."
            )
    episodes = tuple(entry for entry in listed if entry.length)
    empty = ", ".join(str(entry.id) for entry in listed if not entry.length)
    notes = [f"Episodes without frames were left out: {empty}."] if empty else []
    if len(listed) < len(entries):
        notes.append("meta/ lists some episodes several times, each time alike; they count once.")
    if not has_places:
        notes.append("meta/ does not say in which file each episode is; all files of data/ were read.")
    found = {"total_episodes": len(listed), "total_frames": sum(entry.length for entry in listed)}
    for key, count in found.items():
        if (said := info.content.get(key)) != count:
            notes.append(f"info.json says {key} = {said}, the list of episodes {count}; the list was believed.")
    return episodes, notes


def _without(listed: tuple[EpisodeEntry, ...], exclude: tuple[int, ...], folder: Path) -> tuple[EpisodeEntry, ...]:
    """The episodes that are not left out."""
    known = {entry.id for entry in listed}
    for number in exclude:
        if number not in known:
            raise ConfigError(
                f"exclude names the episode {number}, which {folder} does not have; its {len(known)} episodes are numbered "
                f"{listed[0].id} to {listed[-1].id}. Remove it from exclude."
            )
    left = tuple(entry for entry in listed if entry.id not in set(exclude))
    if not left:
        raise ConfigError(f"exclude leaves out all {len(known)} episodes of {folder}. Leave at least one in.")
    return left


def _files(folder: Path, episodes: tuple[EpisodeEntry, ...]) -> tuple[str, ...]:
    """The files of the episodes, or all there are, in LeRobot's order, where meta/ does not say."""
    named = tuple(dict.fromkeys(entry.file for entry in episodes if entry.file is not None))
    found = named or sorted(path.relative_to(folder).as_posix() for path in (folder / "data").glob("*/*.parquet"))
    if not found:
        raise DatasetError(f"{folder}/data holds no */*.parquet: the frames are missing. Copy the data set again.")
    return tuple(found)


def _entry(info: _Info, row: dict[str, Any], has_place: bool) -> EpisodeEntry:
    template = info.content.get("data_path")
    if not isinstance(template, str):
        raise DatasetError(
            f'{info.path}: data_path is {template!r}; expected a path such as "data/chunk-{{chunk_index:03d}}/…".'
        )
    file = fill(template, _path_fields(info, row, "data")) if has_place else None
    if file is not None:
        inside(info.folder, file)
    tasks = row.get("tasks")
    words = printable("; ".join(map(str, tasks)) if isinstance(tasks, list) else str(tasks)) if tasks else None
    return EpisodeEntry(_whole(info, row, "episode_index"), _whole(info, row, "length"), file, words)


def _path_fields(info: _Info, row: dict[str, Any], part: str) -> dict[str, int]:
    """What an episode's path is filled with: v3.0's columns for `part` (data, videos/‹camera›), or its number."""
    if info.major == "3":
        return {name: _whole(info, row, f"{part}/{name}") for name in ("chunk_index", "file_index")}
    number, size = _whole(info, row, "episode_index"), info.content.get("chunks_size")
    return {"episode_chunk": number // (size if isinstance(size, int) and size > 0 else 1000), "episode_index": number}


def _video_places(info: _Info, key: str, rows: list[dict[str, Any]]) -> list[dict[str, int] | None]:
    part = f"videos/{key}"
    unknown = [info.major == "3" and row.get(f"{part}/file_index") is None for row in rows]
    return [None if no else _path_fields(info, row, part) for row, no in zip(rows, unknown, strict=True)]


def _whole(info: _Info, row: dict[str, Any], key: str) -> int:
    value = row.get(key)
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**40:
        raise DatasetError(
            f"{info.folder}: the list of episodes in meta/ has {key} = {value!r}; expected a whole number, 0 or more. "
            "Copy the data set again."
        )
    return value


def _tasks(info: _Info) -> dict[int, str]:
    """task_index → words; empty where the file is absent (episodes usually carry their task in words as well)."""
    if info.major == "3" and (info.folder / "meta/tasks.parquet").exists():
        columns = read_table(info.folder, "meta/tasks.parquet").to_pydict()
        numbers = columns.pop("task_index", None)
        words = columns.get("task") or next(iter(columns.values()), [])  # the index of a pandas frame, named or not
        pairs = list(zip(range(len(words)) if numbers is None else numbers, words, strict=False))
    elif (info.folder / "meta/tasks.jsonl").exists():
        rows = read_json_lines(info.folder, "meta/tasks.jsonl")
        pairs = [(row.get("task_index"), row.get("task")) for row in rows]
    else:
        return {}
    return {number: printable(str(word)) for number, word in pairs if isinstance(number, int) and word is not None}

"""What a LeRobot folder says about itself: features, episodes and the files they are in, cameras, tasks.

v2.0 and v2.1 keep one data file an episode and JSON lines; v3.0 keeps many episodes a file and parquet. From here on they
are the same `Layout`. What belongs here: meta/. What does not: the frames (frames.py), and whether frames and meta/ agree
(read.py).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.errors import DatasetError, did_you_mean
from pipeline.lerobot_format.files import fill, inside, read_json, read_json_lines, read_table
from pipeline.lerobot_format.units import column_names, unit_of
from pipeline.types import ACTION, STATE, Camera, Feature

INFO = "meta/info.json"
INDEX_COLUMNS = ("timestamp", "frame_index", "episode_index", "index", "task_index")
"""Bookkeeping of the format, not features of the demonstrations."""

MAX_WIDTH = 4096
"""Numbers a frame of one feature may hold; what is larger is a picture in disguise, and left out."""

_NUMBERS = {f"{kind}{bits}" for kind, sizes in (("float", (16, 32, 64)), ("int", (8, 16, 32, 64)), ("uint", (8, 16, 32, 64)))
            for bits in sizes} | {"bool"}  # fmt: skip
_EPISODE_COLUMNS = ("episode_index", "length", "tasks", "dataset_from_index", "dataset_to_index")


@dataclass(frozen=True)
class EpisodeEntry:
    """One episode as meta/ lists it. `task` is None where only the frames' `task_index` can say; `file` is relative."""

    id: int
    length: int
    file: str
    task: str | None


@dataclass(frozen=True)
class Layout:
    """Everything meta/ says, checked for itself. `episodes` are in the order of their ids; `tasks` task_index → words."""

    folder: Path
    version: str
    fps: float
    robot_type: str | None
    features: Mapping[str, Feature]
    episodes: tuple[EpisodeEntry, ...]
    tasks: Mapping[int, str]
    cameras: tuple[Camera, ...]
    warnings: tuple[str, ...]

    @property
    def files(self) -> tuple[str, ...]:
        """The data files, each once, in the order of their first episode."""
        return tuple(dict.fromkeys(entry.file for entry in self.episodes))


def read_layout(folder: Path) -> Layout:
    """Read meta/.

    Raises:
        DatasetError: no such folder, not a LeRobot data set, or meta/ contradicts itself.
    """
    info = _info(folder)
    version, warnings = _version(folder, info)
    declared = _declared(folder, info)
    features, notes = _features(folder, declared)
    warnings += notes
    rows = _episode_rows_v3(folder) if version == "3" else _episode_rows_v2(folder)
    if not rows:
        raise DatasetError(f"{folder} holds no episodes. Record at least one before benchmarking it.")
    episodes, notes = _episodes(folder, info, version, rows)
    warnings += notes + _total_warnings(info, episodes)
    cameras = tuple(_camera(folder, info, version, key, feature, rows) for key, feature in declared.items()
                    if feature["dtype"] in ("video", "image"))  # fmt: skip
    return Layout(
        folder=folder,
        version=str(info["codebase_version"]),
        fps=_fps(folder, info),
        robot_type=_words(info.get("robot_type")),
        features=features,
        episodes=episodes,
        tasks=_tasks(folder, version),
        cameras=cameras,
        warnings=tuple(warnings),
    )


def _info(folder: Path) -> dict[str, Any]:
    if not folder.is_dir():
        what = "is a file, not a folder" if folder.exists() else "does not exist"
        raise DatasetError(
            f"The data set's folder {folder} {what}. Give a LeRobot folder (it holds meta/info.json), hub:owner/name, or embedded:pusht_sim."
        )
    if not (folder / INFO).exists():
        inner = sorted(child.name for child in folder.iterdir() if (child / INFO).exists())
        hint = f" Did you mean {folder / inner[0]}?" if inner else ""
        raise DatasetError(f"{folder} is not a LeRobot data set: it has no {INFO}.{hint}")
    info = read_json(folder, INFO)
    if not isinstance(info, dict):
        raise DatasetError(f"{folder / INFO} holds a {type(info).__name__}; expected a JSON object. Copy the data set again.")
    return info


def _version(folder: Path, info: dict[str, Any]) -> tuple[str, list[str]]:
    """"2" or "3": the two layouts there are."""
    said = str(info.get("codebase_version", "nothing"))
    major, _, minor = said.removeprefix("v").partition(".")
    if (major, minor) in {("2", "0"), ("2", "1"), ("3", "0")}:
        return major, []
    if major == "3":
        return "3", [f"codebase_version is '{said}', newer than v3.0; it was read as v3.0."]
    raise DatasetError(
        f"{folder / INFO}: codebase_version is '{said}'; v2.0, v2.1 and v3.0 are read. Convert the data set with LeRobot's own converter."
    )


def _fps(folder: Path, info: dict[str, Any]) -> float:
    fps = info.get("fps")
    if isinstance(fps, bool) or not isinstance(fps, int | float) or not math.isfinite(fps) or fps <= 0:
        raise DatasetError(f"{folder / INFO}: fps is {fps!r}; expected a number above 0. Write the recording's frame rate there.")
    return float(fps)


def _declared(folder: Path, info: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """`features` of info.json, each with a dtype and a shape of positive integers."""
    features = info.get("features")
    if not isinstance(features, dict):
        raise DatasetError(f"{folder / INFO}: 'features' is missing. It names each column with its dtype and shape.")
    for key, feature in features.items():
        shape = feature.get("shape") if isinstance(feature, dict) else None
        plain = isinstance(shape, list) and all(isinstance(size, int) and not isinstance(size, bool) for size in shape)
        if not plain or any(size < 1 for size in shape) or not isinstance(feature.get("dtype"), str):
            raise DatasetError(
                f"{folder / INFO}: feature '{key}' needs a dtype and a shape of whole numbers above 0, got {str(feature)[:120]}."
            )
    for key in (ACTION, STATE):
        if key not in features:
            known = ", ".join(name for name in features if name not in INDEX_COLUMNS) or "none"
            raise DatasetError(
                f"{folder} has no feature '{key}', which every policy here needs. It has: {known}. "
                f"{did_you_mean(key, features)} Rename the feature in meta/ and data/."
            )
    return features


def _features(folder: Path, declared: dict[str, dict[str, Any]]) -> tuple[dict[str, Feature], list[str]]:
    """The features made of numbers, and notes on what is left out."""
    features, notes = {}, []
    for key, feature in declared.items():
        dtype, width = feature["dtype"], math.prod(feature["shape"])
        if key in INDEX_COLUMNS or dtype in ("video", "image"):
            continue
        if dtype not in _NUMBERS or width > MAX_WIDTH:
            if key in (ACTION, STATE):
                raise DatasetError(
                    f"{folder / INFO}: '{key}' is {dtype} {feature['shape']}; expected numbers, at most {MAX_WIDTH} a frame."
                )
            notes.append(f"Feature '{key}' ({dtype} {feature['shape']}) was left out: only numbers, at most {MAX_WIDTH} a frame, are used.")
            continue
        names = column_names(key, feature.get("names"), width)
        if names is None:
            notes.append(f"Feature '{key}' has {width} columns but other names; its columns are numbered instead.")
            names = tuple(str(i) for i in range(width))
        features[key] = Feature(key, names, tuple(unit_of(name) for name in names))
    return features, notes


def _episode_rows_v2(folder: Path) -> list[dict[str, Any]]:
    return read_json_lines(folder, "meta/episodes.jsonl")


def _episode_rows_v3(folder: Path) -> list[dict[str, Any]]:
    """Rows of meta/episodes/, without the statistics."""
    paths = sorted((folder / "meta" / "episodes").glob("chunk-*/file-*.parquet"))
    if not paths:
        raise DatasetError(f"{folder}/meta/episodes holds no chunk-*/file-*.parquet, so {folder} is not a whole v3.0 data set.")
    rows = []
    for path in paths:
        relative = path.relative_to(folder).as_posix()
        table = read_table(folder, relative, keep=lambda name: name in _EPISODE_COLUMNS or name.endswith(("/chunk_index", "/file_index")))
        rows += table.to_pylist()
    return rows


def _episodes(
    folder: Path, info: dict[str, Any], version: str, rows: list[dict[str, Any]]
) -> tuple[tuple[EpisodeEntry, ...], list[str]]:
    entries, empty = [], []
    for row in rows:
        entry = _entry(folder, info, version, row)
        (entries if entry.length else empty).append(entry)
    entries.sort(key=lambda entry: entry.id)
    ids = [entry.id for entry in entries]
    if not entries:
        raise DatasetError(f"{folder} holds no episodes with frames in them. Record at least one before benchmarking it.")
    if len(set(ids)) < len(ids):
        twice = next(one for one, other in zip(ids, ids[1:], strict=False) if one == other)
        raise DatasetError(f"{folder}: meta/ lists episode {twice} twice. Remove one of the two rows.")
    notes = [f"Episodes without frames were left out: {', '.join(str(entry.id) for entry in empty)}."] if empty else []
    return tuple(entries), notes


def _entry(folder: Path, info: dict[str, Any], version: str, row: dict[str, Any]) -> EpisodeEntry:
    number, length = _whole(folder, row, "episode_index"), _whole(folder, row, "length")
    if version == "3":
        values = {
            "chunk_index": _whole(folder, row, "data/chunk_index"),
            "file_index": _whole(folder, row, "data/file_index"),
        }
    else:
        values = {"episode_chunk": number // _chunks_size(info), "episode_index": number}
    template = info.get("data_path")
    if not isinstance(template, str):
        raise DatasetError(f"{folder / INFO}: data_path is {template!r}; expected a path such as \"data/chunk-{{chunk_index:03d}}/…\".")
    file = fill(template, values)
    inside(folder, file)
    tasks = row.get("tasks")
    words = "; ".join(str(task) for task in tasks) if isinstance(tasks, list) else tasks
    return EpisodeEntry(number, length, file, words if words is None else str(words))


def _whole(folder: Path, row: dict[str, Any], key: str) -> int:
    value = row.get(key)
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**40:
        raise DatasetError(f"{folder}: the list of episodes in meta/ has {key} = {value!r} in a row; expected a whole number, 0 or more.")
    return value


def _chunks_size(info: dict[str, Any]) -> int:
    size = info.get("chunks_size", 1000)
    return size if isinstance(size, int) and size > 0 else 1000


def _total_warnings(info: dict[str, Any], episodes: tuple[EpisodeEntry, ...]) -> list[str]:
    found = {"total_episodes": len(episodes), "total_frames": sum(entry.length for entry in episodes)}
    return [
        f"info.json says {key} = {info.get(key)}, but the list of episodes gives {count}; the list was believed."
        for key, count in found.items()
        if info.get(key) != count
    ]


def _tasks(folder: Path, version: str) -> dict[int, str]:
    """task_index → words; empty where the file is absent (episodes usually carry their task in words as well)."""
    if version == "2":
        if not (folder / "meta/tasks.jsonl").exists():
            return {}
        rows = read_json_lines(folder, "meta/tasks.jsonl")
        return {row["task_index"]: str(row.get("task", "")) for row in rows if isinstance(row.get("task_index"), int)}
    if not (folder / "meta/tasks.parquet").exists():
        return {}
    columns = read_table(folder, "meta/tasks.parquet").to_pydict()
    numbers = columns.pop("task_index", [])
    words = columns.get("task") or next(iter(columns.values()), [])
    return {int(number): str(word) for number, word in zip(numbers, words, strict=False) if number is not None}


def _camera(
    folder: Path, info: dict[str, Any], version: str, key: str, feature: dict[str, Any], rows: list[dict[str, Any]]
) -> Camera:
    height, width = _picture_size(feature)
    details = feature.get("info") or feature.get("video_info") or {}
    codec = details.get("video.codec") if isinstance(details, dict) else None
    present = feature["dtype"] == "image" or _videos_present(folder, info, version, key, rows)
    return Camera(key, height, width, _words(codec), present)


def _picture_size(feature: dict[str, Any]) -> tuple[int, int]:
    """Height and width: by `names` where they say, else channels are the end that is at most 4."""
    shape, names = feature["shape"], feature.get("names")
    if isinstance(names, list) and {"height", "width"} <= set(map(str, names)) and len(names) == len(shape):
        return shape[names.index("height")], shape[names.index("width")]
    if len(shape) == 3:
        return (shape[1], shape[2]) if shape[0] <= 4 < shape[2] else (shape[0], shape[1])
    return (shape[0], shape[1]) if len(shape) == 2 else (0, 0)


def _videos_present(folder: Path, info: dict[str, Any], version: str, key: str, rows: list[dict[str, Any]]) -> bool:
    """Whether every video file that meta/ points at is there."""
    template = info.get("video_path")
    if not isinstance(template, str):
        return False
    for row in rows:
        values: dict[str, int | str] = {"video_key": key}
        if version == "3":
            chunk, file = row.get(f"videos/{key}/chunk_index"), row.get(f"videos/{key}/file_index")
            if not isinstance(chunk, int) or not isinstance(file, int):
                return False
            values |= {"chunk_index": chunk, "file_index": file}
        else:
            number = _whole(folder, row, "episode_index")
            values |= {"episode_chunk": number // _chunks_size(info), "episode_index": number}
        if not inside(folder, fill(template, values)).exists():
            return False
    return True


def _words(value: Any) -> str | None:
    return str(value) if isinstance(value, str) and value else None

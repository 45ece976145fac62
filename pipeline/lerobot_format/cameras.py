"""The camera streams that info.json declares, and whether their files are there.

What belongs here: what can be known without opening a video. What does not: pictures themselves.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pipeline.lerobot_format.files import fill, inside
from pipeline.types import Camera


def read_camera(
    folder: Path,
    key: str,
    feature: Mapping[str, Any],
    template: Any,
    places: Iterable[Mapping[str, int] | None],
) -> Camera:
    """One declared camera. `template` is `video_path` of info.json; `places` are its fields for each episode, None
    where meta/ does not say where the episode's video is.

    Raises:
        DatasetError: the path of a video leads out of the folder.
    """
    height, width = _picture_size(feature["shape"], feature.get("names"))
    details = feature.get("info") or feature.get("video_info") or {}
    codec = details.get("video.codec") if isinstance(details, dict) else None
    present = feature["dtype"] == "image" or _videos_present(folder, key, template, places)
    return Camera(key, height, width, codec if isinstance(codec, str) else None, present)


def _picture_size(shape: list[int], names: Any) -> tuple[int, int]:
    """Height and width: by `names` where they say, else channels are the end that is at most 4."""
    if isinstance(names, list) and "height" in names and "width" in names and len(names) == len(shape):
        return shape[names.index("height")], shape[names.index("width")]
    if len(shape) == 3:
        return (shape[1], shape[2]) if shape[0] <= 4 < shape[2] else (shape[0], shape[1])
    return (shape[0], shape[1]) if len(shape) == 2 else (0, 0)


def _videos_present(folder: Path, key: str, template: Any, places: Iterable[Mapping[str, int] | None]) -> bool:
    """Whether every video file that meta/ points at is there."""
    if not isinstance(template, str):
        return False
    files = {None if place is None else fill(template, {"video_key": key, **place}) for place in places}
    return None not in files and all(inside(folder, file).exists() for file in files if file is not None)

"""The frames of the video files against those that meta/ lists. Containers are opened, no picture is decoded.

What does not belong here: whether a declared camera has files at all (the reader warns of that).
"""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.inspection.finding import Finding
from pipeline.lerobot_format.files import inside
from pipeline.lerobot_format.pictures import listed_videos
from pipeline.types import Demonstrations

SLACK = 1
"""Frames that a file may have more or less: encoders drop or repeat the last one."""


@dataclass
class _File:
    """What meta/ says of one video file: its episodes, their frames together, and the end of the last in seconds."""

    episodes: list[int] = field(default_factory=list)
    frames: int = 0
    end_s: float = 0.0


def local_folder(source: str, config_dir: Path) -> Path | None:
    """Where a source's files lie; None for the Hub, whose videos are not downloaded for this, and for archives."""
    if source.startswith("hub:"):
        return None
    if source.startswith("embedded:"):
        from pipeline.embedded import embedded_folder

        return embedded_folder(source.removeprefix("embedded:"))
    folder = config_dir / Path(source).expanduser()
    return folder if folder.is_dir() else None


def no_videos(demos: Demonstrations, folder: Path | None) -> str | None:
    """Why there are no video files to look at, if so."""
    if not demos.cameras:
        return "it has no cameras"
    if folder is None:
        return "only the videos of data sets in a folder are looked at"
    if not any(camera.present for camera in demos.cameras):
        return "its video files are absent"
    return None


def check_videos(demos: Demonstrations, folder: Path | None) -> Iterator[Finding]:
    """Every file of the cameras whose files are there.

    Raises:
        DatasetError: meta/ cannot be read.
    """
    if folder is None or no_videos(demos, folder):
        return
    for camera in demos.cameras:
        if camera.present:
            for name, file in _listed(folder, camera.key).items():
                yield from _look(demos, folder, camera, name, file)


def _listed(folder: Path, key: str) -> dict[str, _File]:
    """The video files of a camera that meta/ names; empty for pictures kept in the data files."""
    files: dict[str, _File] = defaultdict(_File)
    for video in listed_videos(folder, key):
        file = files[video.file]
        file.episodes.append(video.episode)
        file.frames += video.length
        file.end_s = max(file.end_s, video.to_s)
    return files


def _look(demos: Demonstrations, folder: Path, camera: Any, name: str, file: _File) -> Iterator[Finding]:
    alone = file.episodes[0] if len(file.episodes) == 1 and file.episodes[0] in demos.episode_ids else None
    whose = "its episode" if len(file.episodes) == 1 else f"its {len(file.episodes)} episodes"
    try:
        frames, height, width, rate = _open(inside(folder, name))
    except (OSError, ValueError) as error:
        yield Finding("video", alone, camera.key, None, None, f"{name} cannot be opened as a video ({error}).")
        return
    if abs(frames - file.frames) > SLACK * len(file.episodes):
        yield Finding(
            "video", alone, camera.key, frames, file.frames,
            f"{name} holds {frames:,} frames, {whose} in meta/ {file.frames:,}: pictures and numbers drift apart.",
        )  # fmt: skip
    elif rate and file.end_s > (frames + SLACK) / rate + 0.5:
        yield Finding(
            "video", alone, camera.key, file.end_s, frames / rate,
            f"{name} lasts {frames / rate:.1f} s, but meta/ places an episode in it that ends at {file.end_s:.1f} s.",
        )  # fmt: skip
    if (height, width) != (camera.height, camera.width):
        yield Finding(
            "video", alone, camera.key, width, camera.width,
            f"{name} is {width}×{height}, meta/info.json says {camera.width}×{camera.height}.",
        )  # fmt: skip
    if rate and abs(rate - demos.fps) > 0.05 * demos.fps:
        yield Finding(
            "video",
            alone,
            camera.key,
            rate,
            demos.fps,
            f"{name} runs at {rate:.4g} frames a second, the data at {demos.fps:g}.",
        )


def _open(path: Path) -> tuple[int, int, int, float | None]:
    """Frames, height, width and frames a second: by the container's header, else by counting packets.

    Raises:
        OSError, ValueError: it is no video.
    """
    import av

    with av.open(str(path)) as container:
        if not container.streams.video:
            raise ValueError("it has no video stream")
        stream = container.streams.video[0]
        frames = stream.frames or sum(1 for packet in container.demux(stream) if packet.size)
        rate = float(stream.average_rate) if stream.average_rate else None
        return frames, stream.codec_context.height, stream.codec_context.width, rate

"""The pictures of a camera: where meta/ says each episode's video is, and frames decoded when they are first asked for.

What belongs here: from a folder and a camera to arrays of pictures. What does not: whether the files agree with meta/
(`inspection.videos`), or what a camera is declared as (`cameras`).
"""

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import DatasetError, PolicyError, did_you_mean
from pipeline.lerobot_format.files import fill, inside, read_json, read_json_lines, read_table
from pipeline.types import Demonstrations

PARTS = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")


@dataclass(frozen=True)
class EpisodeVideo:
    """Where the pictures of one episode are: `file`, relative to the folder, from `from_s` on; `to_s` is 0 where unknown."""

    episode: int
    length: int
    file: str
    from_s: float
    to_s: float


def listed_videos(folder: Path, key: str) -> list[EpisodeVideo]:
    """The episodes' videos that meta/ lists for a camera; none for pictures kept in the data files.

    Raises:
        DatasetError: meta/ cannot be read.
    """
    info = read_json(folder, "meta/info.json")
    template = info.get("video_path")
    if not isinstance(template, str) or info.get("features", {}).get(key, {}).get("dtype") != "video":
        return []
    found = []
    for row in _rows(folder, key):
        number, length = row.get("episode_index"), row.get("length")
        if not isinstance(number, int) or not isinstance(length, int) or length == 0:
            continue
        if row.get("file_index") is None:
            size = info.get("chunks_size")
            chunk = number // (size if isinstance(size, int) and size > 0 else 1000)
            place: dict[str, int | str] = {"episode_chunk": chunk, "episode_index": number}
        else:
            place = {name: row[name] for name in PARTS[:2]}
        start, end = (_seconds(row.get(name)) for name in PARTS[2:])
        found.append(EpisodeVideo(number, length, fill(template, {"video_key": key, **place}), start, end))
    return found


def _seconds(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else 0.0


def _rows(folder: Path, key: str) -> list[dict[str, Any]]:
    """One row an episode: its number and length and, in v3.0, where its video is."""
    if (folder / "meta/episodes.jsonl").exists():
        return read_json_lines(folder, "meta/episodes.jsonl")
    wanted = {"episode_index": "episode_index", "length": "length"} | {f"videos/{key}/{part}": part for part in PARTS}
    rows = []
    for path in sorted((folder / "meta/episodes").glob("chunk-*/file-*.parquet")):
        table = read_table(folder, path.relative_to(folder).as_posix(), wanted.__contains__)
        rows += table.rename_columns([wanted[name] for name in table.column_names]).to_pylist()
    return rows


class Pictures:
    """The pictures of one camera as squares of `pixels`, for global frame numbers.

    An episode is decoded when one of its frames is first asked for, into a file that is mapped and goes away with the process:
    memory is what is looked at.
    """

    def __init__(self, folder: Path, key: str, pixels: int, episode_ids: np.ndarray, episode_starts: np.ndarray):
        self._folder, self._pixels, self._starts = folder, pixels, episode_starts
        places = {video.episode: video for video in listed_videos(folder, key)}
        missing = [int(number) for number in episode_ids if int(number) not in places]
        if missing:
            raise DatasetError(
                f"{folder}: meta/ does not say where the pictures of '{key}' of episode {missing[0]} are."
            )
        self._places = [places[int(number)] for number in episode_ids]
        self._decoded = np.zeros(len(episode_ids), bool)
        with tempfile.TemporaryFile() as file:  # it has no name, and stays as long as it is mapped
            self._pictures = np.memmap(file, np.uint8, "w+", shape=(int(episode_starts[-1]), pixels, pixels, 3))

    def __call__(self, frames: np.ndarray) -> np.ndarray:
        """[…] global frames → […, pixels, pixels, 3] uint8, red first.

        Raises:
            DatasetError: a video cannot be decoded, or holds fewer frames than its episode.
        """
        episodes = np.unique(np.searchsorted(self._starts, frames, side="right") - 1)
        for episode in episodes[~self._decoded[episodes]]:
            self._pictures[self._starts[episode] : self._starts[episode + 1]] = self._decode(self._places[episode])
            self._decoded[episode] = True
        return self._pictures[frames]

    def _decode(self, video: EpisodeVideo) -> np.ndarray:
        import av

        path = inside(self._folder, video.file)
        pictures = []
        try:
            with av.open(str(path)) as container:
                for frame in self._from(container, video.from_s):
                    small = frame.reformat(
                        width=self._pixels, height=self._pixels, format="rgb24", interpolation="AREA"
                    )
                    pictures.append(small.to_ndarray())
                    if len(pictures) == video.length:
                        break
        except (OSError, ValueError, IndexError) as error:
            raise DatasetError(f"{path} cannot be decoded ({error}). Copy the data set again.") from None
        if len(pictures) < video.length - 1 or not pictures:
            raise DatasetError(
                f"{path} holds {len(pictures)} frames from {video.from_s:.1f} s on, and episode {video.episode} has "
                f"{video.length}. "
                "`demobench inspect` says which episodes are like that; leave them out with exclude."
            )
        # Encoders drop or repeat the last one.
        return np.stack(pictures + pictures[-1:] * (video.length - len(pictures)))

    @staticmethod
    def _from(container: Any, start_s: float) -> Iterator[Any]:
        stream = container.streams.video[0]
        stream.thread_type = "NONE"
        half = 0.5 / float(stream.average_rate or 30)
        if start_s > 0:
            container.seek(int((start_s - half) / stream.time_base), stream=stream)
        for frame in container.decode(stream):
            if frame.time is None or frame.time >= start_s - half:
                yield frame


def pictures_of(demos: Demonstrations, camera: str | None, pixels: int) -> Pictures:
    """The pictures of one of the data set's cameras, of the only one where it is not named.

    Raises:
        PolicyError: there is no such camera, several could be meant, or its files are not here.
    """
    known = [one.key for one in demos.cameras]
    if not known:
        raise PolicyError(f"A camera is asked for, and the data set '{demos.name}' has none.")
    if camera is None and len(known) > 1:
        raise PolicyError(
            f"'{demos.name}' has several cameras; name one in settings: camera = \"{known[0]}\". It has {known}."
        )
    key = camera or known[0]
    if key not in known:
        raise PolicyError(f"The data set '{demos.name}' has no camera '{key}'. {did_you_mean(key, known)}")
    folder = Path(demos.source)
    if not folder.is_dir():
        raise PolicyError(
            f"Pictures are read from data sets in a folder, and '{demos.name}' comes from {demos.source}. Download it with its "
            "videos, and name the folder."
        )
    if not next(one.present for one in demos.cameras if one.key == key):
        raise PolicyError(f"The videos of the camera '{key}' are not in {folder}. Copy the folder videos/ too.")
    return _opened(folder, key, pixels, demos.content_hash, tuple(demos.episode_ids), tuple(demos.episode_starts))


@cache
def _opened(folder: Path, key: str, pixels: int, content: str, episode_ids: tuple, episode_starts: tuple) -> Pictures:
    """One for each camera and size, so that every window of a data set shares what is decoded."""
    return Pictures(folder, key, pixels, np.array(episode_ids), np.array(episode_starts))

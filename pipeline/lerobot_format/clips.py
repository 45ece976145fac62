"""The pictures of one episode of a camera, still compressed: for recordings that keep them as they are.

    Clip     an mp4 of its own, cut out of the data set's without encoding anew
    Stream   a packet a frame, each to be decoded after those before it, as messages carry them
    Stills   a PNG or JPEG a frame, where the data files keep pictures

What belongs here: from a camera and an episode to bytes. What does not: arrays of pictures (`pictures`), what recordings make of
the bytes (`sinks`).

The picture of frame i is the i-th of its episode by order of time: a camera's own clock is even where the data's is not.
"""

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pipeline.errors import DatasetError
from pipeline.lerobot_format.files import damage, inside, read_json
from pipeline.lerobot_format.pictures import EpisodeVideo, listed_videos
from pipeline.types import Camera, Demonstrations

if TYPE_CHECKING:
    from av.packet import Packet

Codec = Literal["h264", "h265", "av1", "vp9"]
_CODECS: dict[str, Codec] = {"h264": "h264", "hevc": "h265", "av1": "av1", "vp9": "vp9"}
_ANNEX_B = {"h264": "h264_mp4toannexb", "h265": "hevc_mp4toannexb"}
_MARKS = {"png": b"\x89PNG\r\n\x1a\n", "jpeg": b"\xff\xd8\xff"}

SLACK = 1
"""Pictures that an episode may have more or less than frames: encoders drop or repeat the last one."""
QUALITY = {"crf": "18", "preset": "veryfast", "bf": "0"}
"""How x264 encodes what cannot be streamed as it is: no difference to be seen, and no picture that waits for a later one."""


@dataclass(frozen=True)
class Clip:
    """An mp4 that begins at the key frame that the first picture needs; earlier pictures may come with it.

    frames  [n] which of the file's pictures, by order of time, belongs to each frame; the last frame may have none
    """

    mp4: bytes
    frames: np.ndarray


@dataclass(frozen=True)
class Stream:
    """Packets in order of time, the first one a key frame; H.264 and H.265 in Annex B, each key frame with what it takes to begin
    there. The last frame may have none.

    encoded_anew  why the packets are not the data set's own; "" where they are
    """

    codec: Codec
    packets: tuple[bytes, ...]
    encoded_anew: str = ""


@dataclass(frozen=True)
class Stills:
    """The data set's own pictures, one a frame."""

    format: Literal["png", "jpeg"]
    pictures: tuple[bytes, ...]


class Footage:
    """The pictures of one camera of a data set, an episode (position) at a time."""

    def __init__(self, demos: Demonstrations, camera: Camera):
        self._demos, self._folder, self._key, self._present = demos, Path(demos.source), camera.key, camera.present

    @cached_property
    def _videos(self) -> dict[int, EpisodeVideo]:
        """By recorded number; empty where the data files keep pictures."""
        if not self._folder.is_dir():
            raise DatasetError(
                f"Pictures are taken from data sets in a folder, and '{self._demos.name}' comes from {self._demos.source}."
            )
        if not self._present:
            raise DatasetError(
                f"The videos of '{self._key}' that meta/ declares are not in {self._folder}. Copy the folder videos/ too."
            )
        return {video.episode: video for video in listed_videos(self._folder, self._key)}

    def clip(self, position: int) -> Clip | Stills:
        """As a file of its own.

        Raises:
            DatasetError: the pictures are not there, cannot be read, or are not as many as the episode's frames.
        """
        if self._as_pictures:
            return self._stills(position)
        with self._cut(position) as cut:
            return cut.clip()

    def stream(self, position: int) -> Stream | Stills:
        """As packets; encoded anew where a picture refers to later ones, or where the episode begins in the middle of others.

        Raises:
            DatasetError: as `clip`.
        """
        if self._as_pictures:
            return self._stills(position)
        with self._cut(position) as cut:
            return cut.stream(self._demos.fps)

    @property
    def _as_pictures(self) -> bool:
        return not self._videos and self._declared == "image"

    @cached_property
    def _declared(self) -> str:
        return read_json(self._folder, "meta/info.json")["features"][self._key]["dtype"]

    @contextmanager
    def _cut(self, position: int) -> Iterator["_Cut"]:
        import av

        number, length = int(self._demos.episode_ids[position]), int(self._demos.lengths[position])
        if number not in self._videos:
            raise DatasetError(f"meta/ does not say where the pictures of '{self._key}' of episode {number} are.")
        video = self._videos[number]
        path = inside(self._folder, video.file)
        try:
            with av.open(str(path)) as container:
                yield _Cut(container, video, length, path)
        except (OSError, ValueError, IndexError) as error:
            raise DatasetError(f"{path} cannot be read as a video ({error}). Copy the data set again.") from None

    def _stills(self, position: int) -> Stills:
        number, length = int(self._demos.episode_ids[position]), int(self._demos.lengths[position])
        kept = _kept_in_data(self._folder, self._key, number)
        if len(kept) != length or not all(kept):
            raise DatasetError(
                f"{self._folder}: episode {number} has {length} frames, and {sum(map(bool, kept))} pictures of '{self._key}'."
            )
        for name, mark in _MARKS.items():
            if all(picture.startswith(mark) for picture in kept):
                return Stills(name, tuple(kept))
        raise DatasetError(
            f"{self._folder}: the pictures of '{self._key}' in episode {number} are neither PNG nor JPEG."
        )


def _kept_in_data(folder: Path, key: str, number: int) -> list[bytes | None]:
    """The pictures of an episode in the data files, in order of its frames."""
    import pyarrow as pa
    import pyarrow.dataset as arrow

    files = [inside(folder, p.relative_to(folder).as_posix()) for p in sorted(folder.glob("data/**/*.parquet"))]
    try:
        rows = arrow.dataset([str(file) for file in files], format="parquet").to_table(
            columns=["frame_index", key], filter=arrow.field("episode_index") == number, use_threads=False
        )
    except (pa.ArrowException, OSError) as error:
        raise DatasetError(f"{folder / 'data'} {damage(error)}") from None
    pictures = [picture["bytes"] if isinstance(picture, dict) else None for picture in rows[key].to_pylist()]
    return [pictures[row] for row in np.argsort(rows["frame_index"].to_numpy(), kind="stable")]


class _Cut:
    """The packets of one episode in an open file, in the order in which they are decoded.

    Raises:
        DatasetError: there are not as many as the episode has frames.
    """

    def __init__(self, container: Any, video: EpisodeVideo, length: int, path: Path):
        self._video = container.streams.video[0]
        self._video.thread_type = "NONE"
        self._rate = self._video.average_rate or Fraction(30)
        half = Fraction(1, 2) / self._rate
        first = (Fraction(video.from_s) - half) / self._video.time_base
        end = (Fraction(video.to_s) - half) / self._video.time_base if video.to_s else None
        if video.from_s > 0:
            container.seek(int(first), stream=self._video)
        packets = list(_until(container.demux(self._video), end))
        shown = sorted(p.pts for p in packets if p.pts >= first and (end is None or p.pts < end))
        if not shown or abs(len(shown) - length) > SLACK:
            raise DatasetError(
                f"{path} holds {len(shown)} pictures of episode {video.episode}, which has {length} frames: pictures and numbers "
                f"would drift apart. `demobench inspect` says which episodes are like that; record it again, or leave it out: "
                f"exclude = [{video.episode}]."
            )
        self._shown = shown[:length]
        begins = max((i for i, p in enumerate(packets) if p.is_keyframe and p.pts <= shown[0]), default=0)
        ends = max(i for i, p in enumerate(packets) if p.pts <= self._shown[-1])
        self._packets = packets[begins : ends + 1]

    def clip(self) -> Clip:
        import av

        buffer, at = io.BytesIO(), np.sort([packet.pts for packet in self._packets])
        with av.open(buffer, "w", format="mp4") as file:
            track = file.add_stream_from_template(self._video, opaque=True)
            for packet in self._packets:
                packet.stream, packet.pts, packet.dts = track, packet.pts - int(at[0]), packet.dts - int(at[0])
                file.mux(packet)
        return Clip(buffer.getvalue(), np.searchsorted(at, self._shown))

    def stream(self, fps: float) -> Stream:
        codec = _CODECS.get(self._video.codec_context.codec.canonical_name)
        why = self._not_as_they_are(codec)
        if not why:
            keys = [packet.is_keyframe for packet in self._packets]
            raw = list(self._raw(codec))
            if len(raw) == len(keys):
                packets = [_complete(codec, data, key, self._header) for data, key in zip(raw, keys, strict=True)]
                if all(_begins(codec, data) for data, key in zip(packets, keys, strict=True) if key):
                    return Stream(codec, tuple(packets))
            why = "its key frames do not say how they are decoded"
        return Stream("h264", tuple(self._encoded(fps)), why)

    def _not_as_they_are(self, codec: Codec | None) -> str:
        if codec is None:
            return f"messages do not carry {self._video.codec_context.codec.canonical_name}"
        if [packet.pts for packet in self._packets] == self._shown:
            return "" if self._packets[0].is_keyframe else "the episode begins between key frames"
        if sorted(packet.pts for packet in self._packets) == self._shown:
            return "its pictures refer to later ones"
        return "the episode begins between key frames"

    @property
    def _header(self) -> bytes:
        return bytes(self._video.codec_context.extradata or b"")

    def _raw(self, codec: Codec) -> Iterator[bytes]:
        from av.bitstream import BitStreamFilterContext

        if codec not in _ANNEX_B:
            yield from map(bytes, self._packets)
            return
        annex_b = BitStreamFilterContext(_ANNEX_B[codec], self._video)
        for packet in [*self._packets, None]:
            yield from map(bytes, annex_b.filter(packet))

    def _encoded(self, fps: float) -> Iterator[bytes]:
        import av

        if "libx264" not in av.codecs_available:
            raise DatasetError("Pictures that cannot be streamed as they are take x264, which PyAV here does not have.")
        shown, encoder = set(self._shown), av.CodecContext.create("libx264", "w")
        encoder.width, encoder.height = (side - side % 2 for side in (self._video.width, self._video.height))
        encoder.pix_fmt, encoder.time_base, encoder.thread_count = "yuv420p", Fraction(1, max(round(fps), 1)), 1
        encoder.options = QUALITY | {"g": str(max(round(fps), 1))}
        kept = (frame for frame in self._decoded() if frame.pts in shown)
        for number, frame in enumerate(kept):
            picture = frame.reformat(encoder.width, encoder.height, "yuv420p")
            picture.pts, picture.time_base, picture.pict_type = number, encoder.time_base, 0
            yield from map(bytes, encoder.encode(picture))
        yield from map(bytes, encoder.encode(None))

    def _decoded(self) -> Iterator[Any]:
        for packet in self._packets:
            yield from packet.decode()
        yield from self._video.codec_context.decode(None)


def _until(packets: Iterator["Packet"], end: Fraction | None) -> Iterator["Packet"]:
    """Those that may be shown before the end: what is decoded later is shown later."""
    for packet in packets:
        if packet.pts is None or packet.dts is None or not packet.size:
            continue
        if end is not None and packet.dts >= end:
            return
        yield packet


# What a decoder needs at a key frame ---------------------------------------------------------------------------------

_TEMPORAL_DELIMITER = b"\x12\x00"


def _complete(codec: Codec, data: bytes, key: bool, header: bytes) -> bytes:
    """AV1 in mp4 may leave out what a stream begins with: the mark between pictures, and the header of a sequence."""
    if codec != "av1":
        return data
    data = data.removeprefix(_TEMPORAL_DELIMITER)
    sequence = header[4:] if key and 1 not in _kinds(codec, data) else b""
    return _TEMPORAL_DELIMITER + sequence + data


def _begins(codec: Codec, data: bytes) -> bool:
    """Whether a decoder can begin at this packet."""
    kinds = _kinds(codec, data)
    match codec:
        case "h264":
            return {5, 7, 8} <= kinds
        case "h265":
            return {32, 33, 34} <= kinds and bool(kinds & set(range(16, 22)))
        case "av1":
            return 1 in kinds
    return True


def _kinds(codec: Codec, data: bytes) -> set[int]:
    """The types of a packet's units: NAL units of H.264 and H.265 in Annex B, OBUs of AV1."""
    if codec == "av1":
        return set(_obus(data))
    starts = [part[0] for part in data.split(b"\x00\x00\x01")[1:] if part]
    if codec == "h264":
        return {first & 0x1F for first in starts}
    return {first >> 1 & 0x3F for first in starts}


def _obus(data: bytes) -> Iterator[int]:
    """The type of each open bitstream unit (AV1 specification, section 5.3)."""
    place = 0
    while place < len(data):
        head = data[place]
        yield head >> 3 & 0xF
        place += 2 if head & 0b100 else 1
        if not head & 0b10:  # no size: it is the last one
            return
        size, place = _leb128(data, place)
        place += size


def _leb128(data: Sequence[int], place: int) -> tuple[int, int]:
    """A number of seven bits a byte, the least first, and where it ends."""
    value = 0
    for count, byte in enumerate(data[place : place + 8]):
        value |= (byte & 0x7F) << 7 * count
        if not byte & 0x80:
            return value, place + count + 1
    return value, len(data)

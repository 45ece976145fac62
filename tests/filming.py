"""Camera pictures that say their own number: eight bars, white or black, so that any codec keeps it; and data sets with them.

The picture of a frame is that of its global number.
"""

import io
from collections.abc import Callable, Sequence
from pathlib import Path

import av
import numpy as np
import pyarrow as pa

from tests.makers import Recording, edit_info, edit_table, write_v2, write_v3

KEY = "observation.images.top"
HIGH, WIDE = 48, 64
PATH_V2 = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
PATH_V3 = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
AS_LEROBOT = {"g": "2", "crf": "30", "preset": "12"}
WITH_B_FRAMES = {"g": "10", "bf": "2"}
WITHOUT = {"g": "10", "bf": "0"}


def picture(number: int) -> np.ndarray:
    bits = [number >> bit & 1 for bit in range(8)]
    return np.repeat(np.repeat(255 * np.array(bits, np.uint8), WIDE // 8)[None, :, None], HIGH, axis=0).repeat(
        3, axis=2
    )


def number_of(shown: np.ndarray) -> int:
    bars = shown.reshape(HIGH, 8, -1).mean(axis=(0, 2)) > 127
    return sum(int(bar) << bit for bit, bar in enumerate(bars))


def write_mp4(
    path: Path, numbers: Sequence[int], encoder: str = "libx264", options: dict | None = None, rate: int = 10
) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(encoder, rate=rate, options=options or WITHOUT)
        stream.height, stream.width, stream.pix_fmt = HIGH, WIDE, "yuv420p"
        for number in numbers:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture(number), format="rgb24")))
        container.mux(stream.encode())


def as_png(number: int) -> bytes:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(picture(number)).save(file, "png")
    return file.getvalue()


def numbers_in_mp4(data: bytes) -> list[int]:
    with av.open(io.BytesIO(data)) as container:
        return [number_of(frame.to_ndarray(format="rgb24")) for frame in container.decode(video=0)]


def numbers_in_packets(codec: str, packets: Sequence[bytes]) -> list[int]:
    """What a decoder that is given nothing but the packets shows; it must show one picture for each as it comes."""
    decoder = av.CodecContext.create({"h265": "hevc", "av1": "libdav1d"}.get(codec, codec), "r")
    decoder.thread_count = 1
    if codec == "av1":
        decoder.options = {"max_frame_delay": "1"}
    elif codec != "vp9":
        decoder.flags |= int(av.codec.context.Flags.low_delay)
    shown = []
    for packet in packets:
        shown.append([number_of(f.to_ndarray(format="rgb24")) for f in decoder.decode(av.Packet(packet))])
    shown.append([number_of(f.to_ndarray(format="rgb24")) for f in decoder.decode(None)])
    return [number for numbers in shown for number in numbers]


def decoded(codec: str, packets: tuple[bytes, ...]) -> list[np.ndarray]:
    decoder = av.CodecContext.create("libdav1d" if codec == "av1" else codec, "r")
    shown = [frame for packet in packets for frame in decoder.decode(av.Packet(packet))]
    return [frame.to_ndarray(format="rgb24") for frame in [*shown, *decoder.decode(None)]]


def pusher(picture: np.ndarray) -> np.ndarray:
    """Where PushT's blue disc is [2], px of the picture."""
    red, green, blue = picture.astype(int).transpose(2, 0, 1)
    rows, columns = np.nonzero((blue - red > 60) & (blue - green > 40))
    return np.array([columns.mean() + 0.5, rows.mean() + 0.5]) if len(rows) else np.full(2, np.nan)


def filmed_v2(folder: Path, recording: Recording, encoder: str = "libx264", options: dict | None = None) -> Path:
    """A video an episode."""
    write_v2(folder, recording)
    _declare(folder, "video", PATH_V2)
    for episode, frames in enumerate(recording.slices()):
        path = folder / PATH_V2.format(episode_chunk=0, video_key=KEY, episode_index=episode)
        write_mp4(path, range(frames.start, frames.stop), encoder, options, round(recording.fps))
    return folder


def filmed_v3(folder: Path, recording: Recording, encoder: str = "libx264", options: dict | None = None) -> Path:
    """One video for all episodes, encoded in one go: episodes begin wherever they begin."""
    write_v3(folder, recording)
    _declare(folder, "video", PATH_V3)
    path = folder / PATH_V3.format(video_key=KEY, chunk_index=0, file_index=0)
    write_mp4(path, range(sum(recording.lengths)), encoder, options, round(recording.fps))
    ends = np.cumsum(recording.lengths) / recording.fps
    placed = {
        "chunk_index": [0] * len(ends), "file_index": [0] * len(ends),
        "from_timestamp": [0.0, *ends[:-1]], "to_timestamp": list(ends),
    }  # fmt: skip

    def place(table: pa.Table) -> pa.Table:
        for name, values in placed.items():
            table = table.append_column(f"videos/{KEY}/{name}", pa.array(values))
        return table

    edit_table(folder / "meta/episodes/chunk-000/file-000.parquet", place)
    return folder


def with_pictures(folder: Path, recording: Recording, encode: Callable[[int], bytes] = as_png) -> Path:
    """The data files keep a PNG a frame."""
    write_v2(folder, recording)
    _declare(folder, "image", None)
    for episode, frames in enumerate(recording.slices()):
        kept = [{"bytes": encode(number), "path": None} for number in range(frames.start, frames.stop)]
        edit_table(
            folder / f"data/chunk-000/episode_{episode:06d}.parquet",
            lambda table, kept=kept: table.append_column(KEY, pa.array(kept)),
        )
    return folder


def _declare(folder: Path, dtype: str, path: str | None) -> None:
    declared = {"dtype": dtype, "shape": [HIGH, WIDE, 3], "names": ["height", "width", "channels"]}
    edit_info(folder, lambda info: info["features"].update({KEY: declared}))
    edit_info(folder, lambda info: info.update(video_path=path))

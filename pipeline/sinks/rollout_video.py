"""A video of roll-outs: a panel for each start state, side by side, as H.264 that every browser plays.

What belongs here: the panels' order and words, the file. What does not: painting a panel (`painting`), the page (`report`).

An episode that is over stands still and says how it ended. The same roll-outs give the same bytes with the same versions of Pillow
and PyAV: one thread, no dates, a font of Pillow's own.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import NotApplicableError
from pipeline.simulate.scene import Drawing, drawing_of
from pipeline.sinks import replacing
from pipeline.sinks.painting import FINER, Painter
from pipeline.sinks.palette import FAILURE, GRID, INK, MUTED, SUCCESS
from pipeline.types import Rollouts, Scenes

if TYPE_CHECKING:
    from PIL.Image import Image

SPEED = 2
"""Times as fast as it was: eight episodes are looked at side by side, and what counts is where each ends."""
MOST_FPS = 30
PANEL, GAP, HEAD, TEXT = 246, 8, 26, 13
"""Width of a panel, what lies between two, the height of the words above one and of their letters; px."""
HOLD_S = 1.5
"""How long the end is shown."""
PAGE = "#e4e7eb"
ENCODER = "libx264"
OPTIONS = {"preset": "veryfast", "crf": "29", "tune": "animation"}
WHOLE_PX = (64, 16)
"""Width and height are multiples of these: the encoder also looks at what pads a row in memory, which is anything."""


@dataclass(frozen=True)
class Video:
    """What is known of a video file: whose roll-outs it shows, and its size in px, frames and seconds."""

    policy: str
    observations: str
    seed: int
    simulator: str
    start_states: tuple[int, ...]
    succeeded: int
    done: str
    speed: float
    width: int
    height: int
    frames: int
    fps: float

    @classmethod
    def of(cls, said: Mapping[str, Any]) -> "Video":
        """The inverse of `summary`; more entries do not matter."""
        known = {field.name: said[field.name] for field in fields(cls)}
        return cls(**known | {"start_states": tuple(said["start_states"])})

    def summary(self) -> dict[str, Any]:
        return asdict(self) | {"start_states": list(self.start_states)}

    @property
    def caption(self) -> str:
        """In words, for those who see it and those who do not."""
        first, last = self.start_states[0], self.start_states[-1]
        in_order = len(self.start_states) > 2 and self.start_states == tuple(range(first, last + 1))
        numbers = f"{first} to {last}" if in_order else ", ".join(map(str, self.start_states))
        return (
            f"{self.policy} (seeing {self.observations}, training seed {self.seed}) drives by itself from start states {numbers} "
            f"of {self.simulator}: {self.succeeded} of {len(self.start_states)} end {self.done}. Played {self.speed:g} times as "
            "fast as it was; clocks show seconds of the simulator. The orange line is what the policy last said it would do, the "
            "grey one what it did."
        )


def write_video(path: Path, poster: Path, rollouts: Rollouts, scenes: Scenes) -> Video | None:
    """Write the video, and its last frame as a picture; None where the simulator has no drawing.

    Raises:
        NotApplicableError: the drawing needs a simulator that is not installed, or PyAV has no H.264 encoder.
        StoreError: a file cannot be written.
    """
    drawing = drawing_of(rollouts.simulator)
    if drawing is None or not len(scenes.chunks):
        return None
    every = max(1, math.ceil(drawing.fps * SPEED / MOST_FPS))
    fps = Fraction(drawing.fps).limit_denominator(1000) * SPEED / every
    with replacing(path) as draft:
        size, count, last = _encode(draft, _pictures(drawing, rollouts, scenes, every), fps)
    with replacing(poster) as draft:
        last.quantize(64).save(draft, format="PNG", optimize=True)
    shown = len(scenes.chunks)
    return Video(
        rollouts.policy, rollouts.observations, rollouts.seed, rollouts.simulator, tuple(rollouts.start_states[:shown].tolist()),
        int(rollouts.success[:shown].sum()), drawing.done, float(SPEED), *size, count, float(fps),
    )  # fmt: skip


def count_frames(path: Path) -> int:
    """The frames that a decoder finds."""
    import av

    with av.open(str(path)) as container:
        return sum(1 for _ in container.decode(video=0))


def _encode(path: Path, pictures: Iterator["Image"], fps: Fraction) -> tuple[tuple[int, int], int, "Image"]:
    """Size, number of frames, and the last one, which is held for a while."""
    import av

    try:
        av.codec.Codec(ENCODER, "w")
    except ValueError:
        raise NotApplicableError(
            f"This PyAV ({av.__version__}) has no encoder {ENCODER}, so no video is made. The wheels on PyPI have it: "
            "pip install --force-reinstall --only-binary av av"
        ) from None
    count = 0
    # Without "bitexact" the file would name the versions of its libraries, and with them differ where its pictures do not.
    with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart", "fflags": "+bitexact"}) as container:
        stream = None
        for picture in _held(pictures, round(HOLD_S * fps)):
            if stream is None:
                stream = container.add_stream(ENCODER, rate=fps, options=OPTIONS | {"g": str(round(4 * fps))})
                stream.width, stream.height = picture.size
                stream.pix_fmt = "yuv420p"
                stream.codec_context.thread_count = 1
                _state_colours(stream.codec_context)
            frame = av.VideoFrame.from_ndarray(np.asarray(picture), "rgb24")
            frame = frame.reformat(format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG")
            container.mux(stream.encode(frame))
            count += 1
        container.mux(stream.encode())
    return picture.size, count, picture


def _state_colours(codec: Any) -> None:
    """BT.709: a player that has to guess takes another matrix for small pictures, and every colour is a little off."""
    codec.colorspace = codec.color_primaries = codec.color_trc = 1
    codec.color_range = 1


def _held(pictures: Iterator["Image"], more: int) -> Iterator["Image"]:
    for picture in pictures:
        yield picture
    for _ in range(more):
        yield picture


def _pictures(drawing: Drawing, rollouts: Rollouts, scenes: Scenes, every: int) -> Iterator["Image"]:
    """Every so many frames of all episodes side by side, the last one included."""
    from PIL import Image

    painter = Painter(drawing, PANEL)
    panels = [_Panel(painter, drawing, rollouts, scenes, row) for row in range(len(scenes.chunks))]
    places, size = _grid(len(panels), painter.size)
    last = max(panel.last for panel in panels)
    for frame in [*range(0, last, every), last]:
        sheet = Image.new("RGB", size, PAGE)
        for panel, place in zip(panels, places, strict=True):
            sheet.paste(panel.at(frame), place)
        yield sheet


def _grid(count: int, panel: tuple[int, int]) -> tuple[list[tuple[int, int]], tuple[int, int]]:
    """Where each panel lies, and the size of all."""
    columns = count if count <= 2 else 2 if count <= 4 else 4
    wide, high = panel[0] + GAP, panel[1] + HEAD + GAP
    needed = (GAP + columns * wide, GAP + -(-count // columns) * high)
    size = tuple(-(-side // whole) * whole for side, whole in zip(needed, WHOLE_PX, strict=True))
    left, top = ((side - used) // 2 + GAP for side, used in zip(size, needed, strict=True))
    return [(left + place % columns * wide, top + place // columns * high) for place in range(count)], size


class _Panel:
    """One episode: its number and time above, what there is to see below."""

    def __init__(self, painter: Painter, drawing: Drawing, rollouts: Rollouts, scenes: Scenes, row: int):
        self._painter, self._fps, self._done = painter, drawing.fps, drawing.done
        self._seen = painter.see(drawing.shapes(scenes, row))
        self._background = painter.background(self._seen)
        self._number, self._success = int(rollouts.start_states[row]), bool(rollouts.success[row])
        self.last = int(rollouts.steps[row])
        self._end: Image | None = None

    def at(self, frame: int) -> "Image":
        if frame < self.last:
            return self._picture(frame)
        if self._end is None:
            self._end = self._picture(self.last)
        return self._end

    def _picture(self, frame: int) -> "Image":
        from PIL import Image

        width, height = self._painter.size
        picture = Image.new("RGB", (width, height + HEAD))
        picture.paste(self._head(width, frame), (0, 0))
        picture.paste(self._painter.frame(self._background, self._seen, frame), (0, HEAD))
        return picture

    def _head(self, width: int, frame: int) -> "Image":
        """The words above a panel, painted large and shrunk as it is."""
        from PIL import Image, ImageDraw

        wide, high = width * FINER, HEAD * FINER
        head = Image.new("RGB", (wide, high), "#ffffff")
        brush, font, middle, side = ImageDraw.Draw(head), _font(), (high - FINER) / 2, 8 * FINER
        brush.text((side, middle), f"start state {self._number}", INK.light, font, anchor="lm")
        brush.text((wide - side, middle), f"{frame / self._fps:.1f} s", MUTED.light, font, anchor="rm")
        brush.line((0, high - 1, wide, high - 1), fill=GRID.light, width=2 * FINER)
        if frame == self.last:
            word, colour = (self._done, SUCCESS) if self._success else ("failed", FAILURE)
            right = wide - font.getlength("000.0 s") - 2 * side
            left = right - font.getlength(word) - 1.6 * side
            brush.rounded_rectangle((left, 4 * FINER, right, high - 6 * FINER), 5 * FINER, fill=colour.light)
            brush.text(((left + right) / 2, middle), word, "#ffffff", font, anchor="mm")
        return head.reduce(FINER)


@cache
def _font() -> Any:
    from PIL import ImageFont

    return ImageFont.load_default(TEXT * FINER)

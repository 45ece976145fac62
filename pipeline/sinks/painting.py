"""Frames of a roll-out as pictures: shapes in the plane or in space onto a small panel, with Pillow alone.

What belongs here: projection, painting order, smooth edges. What does not: where things are (`simulate.scene`), several panels,
words and video (`rollout_video`). No window, display or graphics card is needed.

Everything is painted three times as large and shrunk. In space the far is painted before the near, part by part; faces that look
away are left out. Flat things lie below everything, and what stands throws a shadow straight down, which shows its height.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.simulate.scene import Camera, Drawing, Role, Shape, Window
from pipeline.sinks.palette import INK, ROLES

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw

FINER = 3
STANDING: tuple[Role, ...] = ("object", "robot")
GROUND, TABLE, EDGE = "#f3f5f7", "#ffffff", "#d5dae0"
SHADOW, WAY = "#e3e7ec", "#a3abb5"
Rgb = tuple[int, int, int]


@dataclass(frozen=True)
class Seen:
    """A shape as a picture shows it, in every frame: px of the large picture.

    corners  [n, m, p, 2]         width, depth  [n, m], the depth 0 in the plane
    shade    [n, m] the share of its colour that is seen in this light; NaN for faces that look away
    shadow   the same straight below on the table; None where nothing throws one
    """

    role: Role
    corners: np.ndarray
    width: np.ndarray
    depth: np.ndarray
    shade: np.ndarray
    shadow: "Seen | None" = None

    def parts(self, frame: int) -> Iterator[tuple[np.ndarray, float, float, float]]:
        """Corners [p, 2], width, depth and shade of what is there in a frame; after the last one what was there then."""
        at = min(frame, len(self.corners) - 1)
        for part in zip(self.corners[at], self.width[at], self.depth[at], self.shade[at], strict=True):
            corners = part[0][np.isfinite(part[0][:, 0])]
            if len(corners) > 1:
                yield corners, float(part[1]), float(part[2]), float(part[3])


class Painter:
    """Panels of one size for one drawing."""

    def __init__(self, drawing: Drawing, width: int):
        self.size = (width, round(width / drawing.aspect))
        self._view = drawing.view
        self._large = (width * FINER, self.size[1] * FINER)

    def see(self, shapes: Sequence[Shape]) -> list[Seen]:
        """An episode's shapes as this painter's panels show them, in all frames at once."""
        if isinstance(self._view, Window):
            return [_from_above(self._view, shape, self._large) for shape in shapes]
        return [_through(self._view, shape, self._large) for shape in shapes]

    def background(self, seen: Sequence[Seen]) -> "Image":
        """The ground, three times as large: painted once an episode."""
        from PIL import Image, ImageDraw

        picture = Image.new("RGB", self._large, TABLE if isinstance(self._view, Window) else GROUND)
        _flat(ImageDraw.Draw(picture), seen, "ground", TABLE, EDGE)
        return picture

    def frame(self, background: "Image", seen: Sequence[Seen], frame: int) -> "Image":
        """One frame; after an episode's end its last one."""
        from PIL import ImageDraw

        picture = background.copy()
        brush = ImageDraw.Draw(picture)
        for shape in seen:
            if shape.shadow:
                _shadow(brush, shape.shadow, frame)
        _flat(brush, seen, "target", *_target())
        for shape in seen:
            if shape.role == "way":
                corners = shape.corners[0, 0, : frame + 1]
                _line(brush, corners, max(float(shape.width[0, 0]), FINER), _rgb(WAY))
        parts = [(shape.role, *part) for shape in seen if shape.role in STANDING for part in shape.parts(frame)]
        for role, corners, width, _, shade in sorted(parts, key=lambda part: -part[3]):
            if np.isfinite(shade):
                _part(brush, role, corners, width, shade)
        for shape in seen:
            if shape.role == "plan":
                for corners, width, *_ in shape.parts(frame):
                    _line(brush, corners, width + 1.2 * FINER, _rgb(TABLE))
                    _line(brush, corners, width, _rgb(ROLES["plan"].light))
        return picture.reduce(FINER)


def _from_above(view: Window, shape: Shape, size: tuple[int, int]) -> Seen:
    scale = size[0] / (view.high[0] - view.low[0])
    same = np.ones(shape.points.shape[:2])
    return Seen(shape.role, (shape.points - view.low) * scale, shape.width * scale * same, 0 * same, 0.8 * same)


def _through(view: Camera, shape: Shape, size: tuple[int, int]) -> Seen:
    """A pinhole: x to the right, y down, the depth along where it looks."""
    eye, ahead = np.array(view.eye), np.array(view.looks_at) - np.array(view.eye)
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(ahead, right), ahead])
    focal = size[1] / 2 / np.tan(np.radians(view.view_deg) / 2)
    x, y, depth = np.moveaxis((shape.points - eye) @ axes.T, -1, 0)
    corners = focal * np.stack([x, y], axis=-1) / depth[..., None] + np.array(size) / 2
    there = np.isfinite(depth)
    middle = np.where(there, depth, 0).sum(axis=2) / np.maximum(there.sum(axis=2), 1) + ~there.any(axis=2)
    shade = np.full(middle.shape, 0.75) if shape.width else _shade(shape.points, eye)
    below = Shape(shape.name, "ground", shape.points * np.array([1.0, 1.0, 0.0]), shape.width)
    shadow = _through(view, below, size) if shape.role in STANDING else None
    return Seen(shape.role, corners, shape.width * focal / middle, middle, shade, shadow)


def _shade(points: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """[n, m] of flat faces: light comes from above and a little from ahead; NaN where a face looks away."""
    normal = np.cross(points[..., 1, :] - points[..., 0, :], points[..., 2, :] - points[..., 0, :])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True) + 1e-12
    towards = ((eye - points[..., 0, :]) * normal).sum(axis=-1) > 0
    return np.where(towards, 0.8 - 0.3 * normal[..., 2] + 0.15 * np.abs(normal[..., 1]), np.nan)


def _flat(brush: "ImageDraw", seen: Sequence[Seen], role: Role, fill: "Rgb | str", edge: "Rgb | str") -> None:
    for shape in seen:
        for corners, *_ in shape.parts(0) if shape.role == role else ():
            brush.polygon(_xy(corners), fill=fill, outline=edge, width=2 * FINER)


def _shadow(brush: "ImageDraw", shadow: Seen, frame: int) -> None:
    for corners, width, *_ in shadow.parts(frame):
        if width:
            _line(brush, corners, width, _rgb(SHADOW))
        else:
            brush.polygon(_xy(corners), fill=SHADOW)


def _part(brush: "ImageDraw", role: Role, corners: np.ndarray, width: float, shade: float) -> None:
    colour = _rgb(ROLES[role].light)
    edge, fill = _mixed(colour, _rgb(INK.light), 0.35), _mixed(_rgb(TABLE), colour, shade)
    if not width:
        brush.polygon(_xy(corners), fill=fill, outline=edge, width=FINER)
        return
    _line(brush, corners, width + 2 * FINER, edge)
    _line(brush, corners, width, fill)


def _target() -> tuple[Rgb, Rgb]:
    colour = _rgb(ROLES["target"].light)
    return _mixed(_rgb(TABLE), colour, 0.18), _mixed(_rgb(TABLE), colour, 0.8)


def _line(brush: "ImageDraw", corners: np.ndarray, width: float, colour: Rgb) -> None:
    """With round joints and ends."""
    brush.line(_xy(corners), fill=colour, width=max(round(width), 1), joint="curve")
    for x, y in corners[[0, -1]].tolist():
        radius = max(width, 1) / 2
        brush.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour)


def _xy(corners: np.ndarray) -> list[tuple[float, float]]:
    return [(x, y) for x, y in corners.tolist()]


def _rgb(colour: str) -> Rgb:
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue


def _mixed(first: Rgb, second: Rgb, share: float) -> Rgb:
    """`share` of the second colour, the rest of the first."""
    return tuple(round(a + (b - a) * min(max(share, 0), 1)) for a, b in zip(first, second, strict=True))

"""Frames of a roll-out as pictures: shapes in the plane or in space onto a small panel, with Pillow alone.

What belongs here: projection, painting order, smooth edges. What does not: where things are (`simulate.scene`), several panels,
words and video (`rollout_video`). No window, display or graphics card is needed.

Everything is painted three times as large and shrunk. In space the far is painted before the near, part by part; faces that look
away are left out. Flat things lie below everything, and what stands throws a shadow straight down, which shows its height.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pipeline.simulate.scene import Camera, Drawing, Role, Shape, Window
from pipeline.sinks.palette import INK, ROLES

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw

FINER = 3
GROUND, TABLE, EDGE = "#f3f5f7", "#ffffff", "#d5dae0"
SHADOW, WAY = "#e3e7ec", "#a3abb5"
Rgb = tuple[int, int, int]


class Painter:
    """Panels of one size for one drawing."""

    def __init__(self, drawing: Drawing, width: int):
        self.size = (width, round(width / drawing.aspect))
        self._view = drawing.view
        self._large = (width * FINER, self.size[1] * FINER)
        self._project = _from_above(drawing.view, self._large) if isinstance(drawing.view, Window) else None
        if isinstance(drawing.view, Camera):
            self._project = _through(drawing.view, self._large)

    def background(self, shapes: Sequence[Shape]) -> "Image":
        """The ground, three times as large: painted once an episode."""
        from PIL import Image, ImageDraw

        picture = Image.new("RGB", self._large, TABLE if isinstance(self._view, Window) else GROUND)
        self._flat(ImageDraw.Draw(picture), shapes, "ground", TABLE, EDGE)
        return picture

    def frame(self, background: "Image", shapes: Sequence[Shape], frame: int) -> "Image":
        """One frame; after an episode's end its last one."""
        from PIL import Image, ImageDraw

        picture = background.copy()
        brush = ImageDraw.Draw(picture)
        standing = [s for s in shapes if s.role in ("object", "robot")]
        for shape in standing if isinstance(self._view, Camera) else []:
            self._shadow(brush, shape, frame)
        self._flat(brush, shapes, "target", *_target())
        for shape in shapes:
            if shape.role == "way":
                self._way(brush, shape, frame)
        parts = [(depth, s, c, w, strength) for s in standing for c, w, depth, strength in self._parts(s, frame)]
        if isinstance(self._view, Camera):
            parts.sort(key=lambda part: -part[0])
        for _, shape, corners, width, strength in parts:
            self._part(brush, shape.role, corners, width, strength)
        for shape in shapes:
            if shape.role == "plan":
                for corners, width, *_ in self._parts(shape, frame):
                    _line(brush, corners, width + 1.2 * FINER, _rgb("#ffffff"))
                    _line(brush, corners, width, _rgb(ROLES["plan"].light))
        return picture.resize(self.size, Image.Resampling.BOX)

    def _flat(self, brush: "ImageDraw", shapes: Sequence[Shape], role: Role, fill: "Rgb | str", edge: "Rgb | str") -> None:
        for shape in shapes:
            for corners, *_ in self._parts(shape, 0) if shape.role == role else ():
                brush.polygon(_xy(corners), fill=fill, outline=edge, width=2 * FINER)

    def _parts(self, shape: Shape, frame: int) -> list[tuple[np.ndarray, float, float, float]]:
        """What is there of a shape: corners [p, 2] px, width px, depth, and the share of its colour that is seen in this light."""
        found = []
        for points in shape.points[min(frame, len(shape.points) - 1)]:
            points = points[np.isfinite(points).all(axis=1)]
            if len(points) < 2:
                continue
            corners, depth, scale = self._project(points)
            strength = 0.8
            if not shape.width and points.shape[1] == 3:
                if _area(corners) > 0 and shape.role == "object":
                    continue
                strength = _strength(points)
            found.append((corners, shape.width * scale, depth, strength))
        return found

    def _part(self, brush: "ImageDraw", role: Role, corners: np.ndarray, width: float, strength: float) -> None:
        colour = _rgb(ROLES[role].light)
        edge = _mixed(colour, _rgb(INK.light), 0.35)
        if not width:
            brush.polygon(_xy(corners), fill=_mixed(_rgb("#ffffff"), colour, strength), outline=edge, width=FINER)
            return
        _line(brush, corners, width + 2 * FINER, edge)
        _line(brush, corners, width, _mixed(_rgb("#ffffff"), colour, 0.75))

    def _shadow(self, brush: "ImageDraw", shape: Shape, frame: int) -> None:
        flat = Shape(shape.name, "ground", shape.points * np.array([1.0, 1.0, 0.0]), shape.width)
        for corners, width, *_ in self._parts(flat, frame):
            if width:
                _line(brush, corners, width, _rgb(SHADOW))
            else:
                brush.polygon(_xy(corners), fill=SHADOW)

    def _way(self, brush: "ImageDraw", shape: Shape, frame: int) -> None:
        gone = Shape(shape.name, shape.role, shape.points[:, :, : frame + 1], shape.width)
        for corners, width, *_ in self._parts(gone, 0):
            _line(brush, corners, max(width, FINER), _rgb(WAY))


def _from_above(view: Window, size: tuple[int, int]):
    low, scale = np.array(view.low), size[0] / (view.high[0] - view.low[0])
    return lambda points: ((points - low) * scale, 0.0, scale)


def _through(view: Camera, size: tuple[int, int]):
    """A pinhole: x to the right, y down, the distance along where it looks."""
    eye, ahead = np.array(view.eye), np.array(view.looks_at) - np.array(view.eye)
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(ahead, right), ahead])
    focal = size[1] / 2 / np.tan(np.radians(view.view_deg) / 2)

    def project(points: np.ndarray) -> tuple[np.ndarray, float, float]:
        x, y, depth = axes @ (points - eye).T
        depth = np.maximum(depth, 0.05)
        corners = focal * np.stack([x / depth, y / depth], axis=1) + np.array(size) / 2
        return corners, float(depth.mean()), float(focal / depth.mean())

    return project


def _area(corners: np.ndarray) -> float:
    """Of a polygon on the picture, positive where its corners go clockwise as seen."""
    x, y = corners.T
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) / 2


def _strength(points: np.ndarray) -> float:
    """Of a face's colour: light comes from above, and a little from ahead."""
    normal = np.cross(points[1] - points[0], points[2] - points[0])
    normal /= np.linalg.norm(normal) or 1.0
    return float(0.8 - 0.3 * normal[2] + 0.15 * abs(normal[1]))


def _target() -> tuple[Rgb, Rgb]:
    colour = _rgb(ROLES["target"].light)
    return _mixed(_rgb("#ffffff"), colour, 0.18), _mixed(_rgb("#ffffff"), colour, 0.8)


def _line(brush: "ImageDraw", corners: np.ndarray, width: float, colour: Rgb) -> None:
    """With round joints and ends."""
    brush.line(_xy(corners), fill=colour, width=max(round(width), 1), joint="curve")
    for x, y in corners[[0, -1]]:
        radius = max(width, 1) / 2
        brush.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour)


def _xy(corners: np.ndarray) -> list[tuple[float, float]]:
    return [(float(x), float(y)) for x, y in corners]


def _rgb(colour: str) -> Rgb:
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue


def _mixed(first: Rgb, second: Rgb, share: float) -> Rgb:
    """`share` of the second colour, the rest of the first."""
    return tuple(round(a + (b - a) * min(max(share, 0), 1)) for a, b in zip(first, second, strict=True))

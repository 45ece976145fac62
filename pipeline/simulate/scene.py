"""Roll-outs as things to see: polygons and lines in the plane or in space, the same ones for a video and for Rerun.

What belongs here: the vocabulary, what all drawings share, and finding a simulator's drawing by name. What does not: where the
things of one simulator are (`pusht_scene`, `so101_scene`), colours and pixels (`sinks`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Literal

import numpy as np

from pipeline.types import Scenes

Role = Literal["ground", "target", "object", "robot", "way", "plan"]
"""What a thing is. The way is where the effector goes, the plan what the policy said last, from where it is now."""


@dataclass(frozen=True)
class Shape:
    """One thing in every frame of an episode; in units of the simulator.

    name    of the thing, different for each of an episode
    points  [n, m, p, d] m polygons or lines of p points, in the plane (d = 2) or in space (3), NaN where a frame has fewer;
            n is 1 where it stands still
    width   of the lines, round at their ends; 0 for polygons, which are filled: in space they are convex
    """

    name: str
    role: Role
    points: np.ndarray
    width: float = 0.0


@dataclass(frozen=True)
class Window:
    """A part of the plane, seen from above; the second axis points down, as pixels do."""

    low: tuple[float, float]
    high: tuple[float, float]


@dataclass(frozen=True)
class Camera:
    """A place in space and what it looks at; z is up."""

    eye: tuple[float, float, float]
    looks_at: tuple[float, float, float]
    view_deg: float


@dataclass(frozen=True)
class Drawing:
    """How the roll-outs of one simulator are drawn.

    aspect  width over height of a picture
    done    the word for an episode that succeeded
    shapes  (scenes, row) → what there is in that episode, flat things first
    """

    view: Window | Camera
    aspect: float
    fps: float
    done: str
    shapes: Callable[[Scenes, int], list[Shape]]


DRAWINGS = {"pusht": "pipeline.simulate.pusht_scene", "so101": "pipeline.simulate.so101_scene"}
"""Simulator → the module that holds its `DRAWING`."""


def drawing_of(simulator: str) -> Drawing | None:
    """How that simulator's roll-outs are drawn; None where nobody said how."""
    return import_module(DRAWINGS[simulator]).DRAWING if simulator in DRAWINGS else None


def frames_of(scenes: Scenes, row: int, key: str) -> np.ndarray:
    """[n, D] what one feature showed from the start of an episode to its end."""
    values = scenes.shown[key][row].astype(np.float64)
    return values[: int(np.isfinite(values).all(axis=1).sum())]


def plan_ahead(
    scenes: Scenes, row: int, effector: np.ndarray, places: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """[n, 1, K + 1, d] in every frame: where the effector is, and what is left of the last answer; nothing in the last frame.

    Parameters:
        effector: [n, d] its place in every frame.
        places: actions [.., A] → places [.., d].
    """
    count, chunk = len(effector), scenes.chunks.shape[2]
    plan = np.full((count, 1, chunk + 1, effector.shape[1]), np.nan)
    said = places(scenes.chunks[row].astype(np.float64))
    for frame, answer in enumerate(np.searchsorted(scenes.asked, np.arange(count - 1), side="right") - 1):
        left = said[answer, frame - scenes.asked[answer] :]
        plan[frame, 0, 0] = effector[frame]
        plan[frame, 0, 1 : 1 + len(left)] = left
    return plan

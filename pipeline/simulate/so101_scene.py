"""SO-101 to look at: the arm by its forward kinematics, the cube and its target, in metres; nothing renders.

What belongs here: where its things are. What does not: physics (`so101`), the model (`so101_world`), colours (`sinks`).
"""

from itertools import pairwise, product
from typing import TYPE_CHECKING

import numpy as np

from pipeline.simulate.scene import Camera, Drawing, Shape, frames_of, plan_ahead
from pipeline.simulate.so101 import PLACED_M, POSE
from pipeline.simulate.so101_arm import PAN_AXIS_X_M, to_angles
from pipeline.simulate.so101_world import CUBE_M, FPS, model
from pipeline.types import STATE, Scenes

if TYPE_CHECKING:
    from mujoco import MjData, MjModel

LINK_M, JAW_M, PLAN_M, WAY_M = 0.026, 0.011, 0.005, 0.002
"""How thick links and jaws are drawn, about as thick as they are; and the lines."""
ABOVE_M = 0.001
"""The target lies a hair above the table, or the two would flicker in a viewer that renders."""
CORNERS = np.array(list(product((-0.5, 0.5), repeat=3)))
FACES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
"""The cube's corners, and its faces by them, anticlockwise from outside."""


class _Arm:
    """Forward kinematics on a state of its own."""

    def __init__(self, world: "MjModel"):
        import mujoco

        self._mujoco, self._model, self._data = mujoco, world, mujoco.MjData(world)

    def at(self, angles_rad: np.ndarray) -> "MjData":
        self._data.qpos[:6] = angles_rad
        self._mujoco.mj_kinematics(self._model, self._data)
        return self._data

    def lines(self, angles_rad: np.ndarray) -> np.ndarray:
        """[n, 6] → [n, 10, 3]: seven points from the base to the hand, the two jaws' tips, and the middle between them."""
        return np.stack([self._points(self.at(angles)) for angles in angles_rad])

    def tip(self, columns: np.ndarray) -> np.ndarray:
        """Columns [.., 6] → the middle between the fingertips [.., 3], NaN where the columns are."""
        flat = to_angles(columns.reshape(-1, 6))
        known = np.isfinite(flat).all(axis=1)
        tips = np.full((len(flat), 3), np.nan)
        if known.any():
            tips[known] = self.lines(flat[known])[:, -1]
        return tips.reshape(*columns.shape[:-1], 3)

    def _points(self, data: "MjData") -> np.ndarray:
        joints = data.xanchor[:6]
        fixed, moving = (data.geom(f"{side}_jaw_pad").xpos for side in ("fixed", "moving"))
        along, _, across = data.site("gripperframe").xmat.reshape(3, 3).T
        knuckle = joints[4] + 0.03 * along - 0.012 * across
        base = [[PAN_AXIS_X_M, 0, 0], [PAN_AXIS_X_M, 0, joints[0, 2]]]
        tips = [fixed + 0.007 * along, moving + 0.007 * along]
        return np.array([*base, *joints[1:6], knuckle, *tips, (fixed + moving) / 2])


def shapes(scenes: Scenes, row: int) -> list[Shape]:
    """The table, the target, the cube, the arm with its open or closed jaws, the fingertips' way, and where they are told to go."""
    arm = _Arm(model())
    state, pose = frames_of(scenes, row, STATE), frames_of(scenes, row, POSE)
    points = arm.lines(to_angles(state))
    tips = points[:, -1]
    target, cube = things(pose)
    return [
        TABLE,
        target,
        Shape("way", "way", tips[None, None], WAY_M),
        cube,
        Shape("arm", "robot", points[:, _pairs(0, 1, 2, 3, 4, 5)], LINK_M),
        Shape("jaws", "robot", points[:, [*_pairs(5, 7, 8), *_pairs(5, 6, 9)]], JAW_M),
        Shape("predicted_chunk", "plan", plan_ahead(scenes, row, tips, arm.tip), PLAN_M),
    ]


def things(pose: np.ndarray) -> list[Shape]:
    """The target and the cube, from the columns of `POSE` [n, 7]."""
    target = _disc(pose[0, 5:7], PLACED_M) + np.array([0.0, 0.0, ABOVE_M])
    return [Shape("target", "target", target), Shape("cube", "object", _cube(pose))]


def fingertips(columns: np.ndarray) -> np.ndarray:
    """Columns [.., 6] → the middle between the fingertips [.., 3] m, NaN where the columns are."""
    return _Arm(model()).tip(columns)


def _pairs(*places: int) -> list[list[int]]:
    return [list(pair) for pair in pairwise(places)]


def _flat(corners: list[tuple[float, float]] | np.ndarray) -> np.ndarray:
    """Corners on the table → [1, 1, p, 3]."""
    return np.pad(np.asarray(corners, dtype=np.float64), ((0, 0), (0, 1)))[None, None]


def _disc(centre: np.ndarray, radius: float) -> np.ndarray:
    around = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    return _flat(centre + radius * np.stack([np.cos(around), np.sin(around)], axis=1))


def _cube(pose: np.ndarray) -> np.ndarray:
    """[n, 7] → [n, 6, 4, 3]; only its turn about the vertical is known."""
    size = np.hypot(pose[:, 3], pose[:, 4])
    cos, sin = (pose[:, 3] / size)[:, None], (pose[:, 4] / size)[:, None]
    x, y, z = (CUBE_M * CORNERS).T
    turned = np.stack([cos * x - sin * y, sin * x + cos * y, np.broadcast_to(z, (len(pose), 8))], axis=-1)
    return (pose[:, None, :3] + turned)[:, FACES]


TABLE = Shape("table", "ground", _flat([(-0.05, -0.23), (0.31, -0.23), (0.31, 0.23), (-0.05, 0.23)]))
DRAWING = Drawing(Camera((0.82, -0.42, 0.52), (0.15, 0.0, 0.078), 29.5), 4 / 3, FPS, "placed", shapes)

"""PushT to look at: the table from above, px.

What belongs here: where its things are. What does not: physics (`pusht`), colours (`sinks`).
"""

import numpy as np

from pipeline.simulate.pusht import BLOCK, FPS, TABLE_PX
from pipeline.simulate.pusht_geometry import FINGER_PX, OUTLINE
from pipeline.simulate.scene import Drawing, Shape, Window, frames_of, plan_ahead
from pipeline.types import STATE, Scenes

GOAL = np.array([[256.0, 256.0, np.pi / 4]])
"""[1, 3] where the block should lie: x px, y px, rad."""
PLAN_PX, WAY_PX = 5.0, 2.0


def shapes(scenes: Scenes, row: int) -> list[Shape]:
    """The goal's outline, the block, the finger, its way, and where it is told to go."""
    finger, block = frames_of(scenes, row, STATE), frames_of(scenes, row, BLOCK)
    goal, pushed = things(block)
    return [
        goal,
        Shape("way", "way", finger[None, None], WAY_PX),
        pushed,
        Shape("finger", "robot", _disc(finger)),
        Shape("predicted_chunk", "plan", plan_ahead(scenes, row, finger, lambda actions: actions), PLAN_PX),
    ]


def things(block: np.ndarray) -> list[Shape]:
    """The goal and the block, from the columns of `BLOCK` [n, 3]."""
    return [Shape("goal", "target", _outline(GOAL)), Shape("block", "object", _outline(block))]


def _outline(poses: np.ndarray) -> np.ndarray:
    """[n, 3] → [n, 1, 8, 2] the T on the table."""
    x, y = np.array(OUTLINE).T
    cos, sin = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    turned = np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
    return (poses[:, None, :2] + turned)[:, None]


def _disc(centres: np.ndarray) -> np.ndarray:
    """[n, 2] → [n, 1, 24, 2]."""
    around = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    return (centres[:, None] + FINGER_PX * np.stack([np.cos(around), np.sin(around)], axis=1))[:, None]


DRAWING = Drawing(Window((0.0, 0.0), (TABLE_PX, TABLE_PX)), 1.0, FPS, "on target", shapes)

"""PushT seen from the block, in the mirror, and in hindsight: what its policies can be given by name.

What belongs here: derived features, symmetries and goals of that one task, in px of its 512 × 512 table. What does not: scaling
(`transform`), physics (`simulate`).
"""

import numpy as np

from pipeline.lerobot_format.kinds import wrap
from pipeline.types import ACTION, STATE

BLOCK = "observation.environment_state"
TABLE_PX = 512.0
TARGET = (256.0, 256.0, np.pi / 4)
"""Where the block should lie: x px, y px, rad."""
CORNERS = np.array([(-60, 0), (60, 0), (60, 30), (15, 30), (15, 120), (-15, 120), (-15, 30), (-60, 30)], np.float64)
"""The T's outline in its own frame, px."""


def block_frame(seen):
    """[B, T, 2] agent and [B, T, 3] block → [B, F]: the block's corners, all that moves, and the agent beside the block.

    Of the last frame: eight corners, the agent in the block's frame (also as a tanh, fine where they are near), the block's
    offset from its target (as a tanh), its angle error as sine and cosine; and, where two frames are seen, how far corners
    and agent moved in the last one.
    """
    agent, block = seen[STATE].astype(np.float64), seen[BLOCK].astype(np.float64)
    corners = _corners(block)
    relative = agent[:, -1] - block[:, -1, :2]
    cos, sin = np.cos(block[:, -1, 2]), np.sin(block[:, -1, 2])
    beside = np.stack(
        [cos * relative[:, 0] + sin * relative[:, 1], cos * relative[:, 1] - sin * relative[:, 0]], axis=1
    )
    error = block[:, -1, 2] - TARGET[2]
    parts = [
        corners[:, -1].reshape(len(agent), -1),
        beside,
        np.tanh(beside / 40),
        np.tanh((block[:, -1, :2] - TARGET[:2]) / 40),
        np.stack([np.sin(error), np.cos(error)], axis=1),
    ]
    if agent.shape[1] > 1:
        moved = corners[:, -1] - corners[:, -2]
        parts += [moved.reshape(len(agent), -1), agent[:, -1] - agent[:, -2]]
    return np.concatenate(parts, axis=1)


def _corners(block: np.ndarray) -> np.ndarray:
    """[B, T, 3] → [B, T, 8, 2] the corners on the table."""
    cos, sin = np.cos(block[..., 2, None]), np.sin(block[..., 2, None])
    x, y = CORNERS.T
    turned = np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
    return block[..., None, :2] + turned


def mirror(seen, actions, amount):
    """The table in the mirror that maps target and T onto themselves: (x, y) → (512 − y, 512 − x), θ → π/2 − θ.

    Its own inverse, up to whole turns; a mirror turns by no `amount`.
    """
    if {seen[STATE].shape[-1], actions.shape[-1], seen.get(BLOCK, np.empty(3)).shape[-1] - 1} != {2}:
        raise ValueError("it turns x and y of the agent and of its target, and x, y and angle of the block.")
    mirrored = {STATE: _swap(seen[STATE])}
    if BLOCK in seen:
        block = seen[BLOCK]
        angle = (np.pi / 2 - block[..., 2:]) % (2 * np.pi)
        mirrored[BLOCK] = np.concatenate([_swap(block[..., :2]), angle], axis=-1).astype(block.dtype)
    return mirrored, _swap(actions)


def end_at_goal(recorded):
    """[N, 2] agent, [N, 3] block, [N, 2] action → the episode moved and turned on the table until the block ends on its target.

    The last action's effect was not recorded: the block is taken to move on in it as in the frame before. People stop a little
    beside the target, on every side of it; told like this, they show how the last pushes get there. The table's edges move
    along, by some px.
    """
    if (recorded[STATE].shape[-1], recorded[ACTION].shape[-1], recorded[BLOCK].shape[-1]) != (2, 2, 3):
        raise ValueError("it moves x and y of the agent and of its target, and x, y and angle of the block.")
    block = recorded[BLOCK].astype(np.float64)
    moved = block[-1] - block[max(len(block) - 2, 0)]
    end = block[-1] + [moved[0], moved[1], wrap(moved[2])]
    turn = TARGET[2] - end[2]
    cos, sin = np.cos(turn), np.sin(turn)
    rotation = np.array([[cos, sin], [-sin, cos]])

    def carried(points):
        return (points - end[:2]) @ rotation + TARGET[:2]

    angle = (block[:, 2:] + turn) % (2 * np.pi)
    return {
        STATE: carried(recorded[STATE]),
        ACTION: carried(recorded[ACTION]),
        BLOCK: np.concatenate([carried(block[:, :2]), angle], axis=1),
    }


def _swap(points: np.ndarray) -> np.ndarray:
    """[..., 2] px."""
    return (TABLE_PX - points[..., ::-1]).astype(points.dtype)

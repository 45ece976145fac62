"""Roll-outs made up by hand, small and quick to draw, for whatever shows them."""

import numpy as np

from pipeline.types import STATE, Rollouts, Scenes

BLOCK = "observation.environment_state"


def make_scenes(steps: tuple[int, ...], chunk: int = 4, every: int = 4) -> Scenes:
    """A finger that walks to the right beside a block that turns; told to go on as it goes."""
    frames, count = max(steps) + 1, len(steps)
    along = np.arange(frames, dtype=np.float32)
    finger = np.stack([60 + 12 * along, np.full(frames, 400.0)], axis=1)
    block = np.stack([150 + 5 * along, np.full(frames, 180.0), 0.05 * along], axis=1)
    shown = {
        key: np.repeat(values[None], count, axis=0).astype("f4") for key, values in ((STATE, finger), (BLOCK, block))
    }
    asked = np.arange(0, frames, every)
    ahead = asked[:, None] + 1 + np.arange(chunk)
    chunks = np.repeat(np.stack([60 + 12 * ahead, np.full(ahead.shape, 400.0)], axis=-1)[None], count, axis=0).astype(
        "f4"
    )
    for row, last in enumerate(steps):
        for values in shown.values():
            values[row, last + 1 :] = np.nan
        chunks[row, asked > last] = np.nan
    return Scenes(shown, asked, chunks)


def make_driven(steps: tuple[int, ...] = (10, 6, 12), simulator: str = "pusht") -> Rollouts:
    success = np.arange(len(steps)) % 2 == 0
    return Rollouts(
        simulator, "1", "mlp_k04", "state", np.arange(len(steps)) + 7, success, np.where(success, 1.0, 0.4),
        np.where(success, 0.96, 0.4), np.array(steps), None, scenes=make_scenes(steps),
    )  # fmt: skip

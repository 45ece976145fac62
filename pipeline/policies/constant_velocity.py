"""Go on as in the last frame: a harder baseline than standing still wherever the arm is already moving."""

import numpy as np

from pipeline.policies.baseline import ColumnBaseline
from pipeline.types import Observations


class ConstantVelocity(ColumnBaseline):
    """s_t + (h + 1)(s_t − s_{t−1}) for positions, the previous action for the rest.

    With one frame of history there is no s_{t−1}, and positions stay where they are.
    """

    def answer(self, observations: Observations, horizons: np.ndarray) -> np.ndarray:
        start = np.where(self.columns.follows, self.columns.now(observations), self.columns.previous(observations))
        return start[:, None] + (horizons[:, None] + 1) * self.columns.step(observations)[:, None]

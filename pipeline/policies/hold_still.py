"""Hold still: at every horizon the action that changes nothing. A policy that has learnt to move does better."""

import numpy as np

from pipeline.policies.baseline import ColumnBaseline
from pipeline.types import Observations


class HoldStill(ColumnBaseline):
    """The state, zero or the previous action, by the kind of the column."""

    def answer(self, observations: Observations, horizons: np.ndarray) -> np.ndarray:
        return np.repeat(self.columns.now(observations)[:, None], len(horizons), axis=1)

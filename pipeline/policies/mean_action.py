"""The mean of the training actions, whatever is seen: what a policy knows that looks at nothing."""

import numpy as np

from pipeline.policies.baseline import ColumnBaseline
from pipeline.types import Observations


class MeanAction(ColumnBaseline):
    """One action for everything; for angles the mean direction."""

    def answer(self, observations: Observations, horizons: np.ndarray) -> np.ndarray:
        mean = self.columns.mean
        return np.broadcast_to(mean, (len(observations), len(horizons), len(mean)))

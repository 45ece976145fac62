"""What the policies that learn no weights have in common. What does not belong here: how any of them answers."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from pipeline.policies import Plan
from pipeline.policies.kinds import Columns, columns_of
from pipeline.types import Observations
from pipeline.windows import Windows


@dataclass(frozen=True)
class ColumnBaseline:
    """A policy without seeds, weights or chunk that answers from what each action column is."""

    columns: Columns

    seeds: ClassVar[tuple[int, ...]] = (0,)
    chunk: ClassVar[None] = None
    parameters: ClassVar[int] = 0

    @classmethod
    def fit(cls, windows: Windows, plan: Plan) -> tuple[Self, None]:
        """Look up what every column is. `plan` is not used."""
        return cls(columns_of(windows)), None

    def answer(self, observations: Observations, horizons: np.ndarray) -> np.ndarray:
        """[B, K, A] the actions at the horizons [K]."""
        raise NotImplementedError

    def predict(self, observations: Observations, horizons: int = 1) -> np.ndarray:
        """[1, B, K, A] float32, raw units, for horizons 0 … K − 1."""
        return self.answer(observations, np.arange(horizons))[None].astype(np.float32)

    def arrays(self) -> dict[str, np.ndarray]:
        return self.columns.arrays()

    def settings(self) -> dict[str, Any]:
        return {}

    @classmethod
    def restore(cls, arrays: Mapping[str, np.ndarray], settings: Mapping[str, Any]) -> Self:
        return cls(Columns.restore(arrays))

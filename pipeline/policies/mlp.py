"""A multi-layer perceptron that answers a whole chunk of actions at once.

What belongs here: its sizes and rates, and what goes in and comes out. What does not: the batched networks (`batched`)
and their training (`fitting`).
"""

from collections.abc import Mapping
from typing import Any, ClassVar, Self

import numpy as np
import torch

from pipeline.errors import PolicyError
from pipeline.normalize import Normalizer
from pipeline.policies import Curve, Plan
from pipeline.policies.batched import Stack
from pipeline.policies.fitting import Recipe, fit_stack
from pipeline.types import Observations
from pipeline.windows import Windows


class Mlp:
    """Two hidden layers of 512 with ReLU, L1 loss over the targets inside the episode, AdamW."""

    RECIPE: ClassVar[Recipe] = Recipe(hidden=(512, 512), loss="l1", batch=256, learning_rate=1e-3, weight_decay=1e-4)

    def __init__(self, stack: Stack, normalizer: Normalizer, seeds: tuple[int, ...], history: int, chunk: int):
        self.stack, self.normalizer = stack, normalizer
        self.seeds, self.history, self.chunk = seeds, history, chunk

    @property
    def parameters(self) -> int:
        """Of one network."""
        return self.stack.parameters_of_one

    @classmethod
    def fit(cls, windows: Windows, plan: Plan) -> tuple[Self, Curve]:
        """Train one network a seed.

        Raises:
            PolicyError: the loss is not finite any more.
        """
        stack, curve = fit_stack(windows, cls.RECIPE, plan)
        return cls(stack, windows.normalizer, plan.seeds, windows.history, windows.chunk), curve

    def predict(self, observations: Observations, horizons: int = 1) -> np.ndarray:
        """[S, B, K, A] float32, raw units; K is the policy's own chunk, whatever `horizons` says."""
        batch, frames = observations.values.shape[:2]
        if frames != self.history:
            raise PolicyError(f"The policy sees {self.history} frames at a time and was given {frames}.")
        encoded = self.normalizer.observations.encode(observations.values).reshape(batch, -1)
        with torch.inference_mode():
            inputs = torch.from_numpy(encoded).expand(len(self.seeds), -1, -1)
            answer = self.stack(inputs).numpy()
        return self.normalizer.actions.decode(answer.reshape(len(self.seeds), batch, self.chunk, -1))

    def one_seed(self, position: int = 0) -> Self:
        """The same policy with one of its networks only: what roll-outs ask."""
        stack = self.stack.of_seed(position)
        return type(self)(stack, self.normalizer, self.seeds[position : position + 1], self.history, self.chunk)

    def arrays(self) -> dict[str, np.ndarray]:
        return self.stack.arrays() | self.normalizer.arrays()

    def settings(self) -> dict[str, Any]:
        return {"seeds": list(self.seeds), "history": self.history, "chunk": self.chunk}

    @classmethod
    def restore(cls, arrays: Mapping[str, np.ndarray], settings: Mapping[str, Any]) -> Self:
        stack, normalizer = Stack.restore(arrays), Normalizer.from_arrays(arrays)
        return cls(stack, normalizer, tuple(settings["seeds"]), settings["history"], settings["chunk"])

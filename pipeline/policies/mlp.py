"""Multi-layer perceptrons that answer a whole chunk of actions at once: behaviour cloning as regression (Pomerleau 1989).

What belongs here: their sizes and rates, and what goes in and comes out. What does not: the batched networks (`batched`)
and their training (`fitting`), training of single networks (`networks`).

Left alone, or with other sizes and rates, it is the plain network, all seeds trained as one stack. Residual blocks, schedules
and a view of its own (relative actions, derived features, augmentation) are trained one network a seed. Departures: it answers
numbers rather than one of some directions, for a whole chunk of frames, and its loss is L1 unless told otherwise.
"""

from collections.abc import Mapping
from typing import Any, ClassVar, Self

import numpy as np
import torch

from pipeline.errors import PolicyError
from pipeline.normalize import Normalizer, check_columns
from pipeline.policies import Curve, Plan
from pipeline.policies.batched import Stack
from pipeline.policies.body import perceptron
from pipeline.policies.fitting import LOSSES, Recipe, fit_stack
from pipeline.policies.networks import Net, NetworkPolicy, Shape, masked_mean
from pipeline.settings import MlpSettings, settings_of
from pipeline.types import Observations
from pipeline.windows import Windows


class PlainMlp:
    """Hidden layers with ReLU; the recipe is the subclass's."""

    RECIPE: ClassVar[Recipe]

    def __init__(self, stack: Stack, normalizer: Normalizer, seeds: tuple[int, ...], history: int, chunk: int):
        self.stack, self.normalizer = stack, normalizer
        self.seeds, self.history, self.chunk = seeds, history, chunk

    @property
    def parameters(self) -> int:
        """Of one network."""
        return self.stack.parameters_of_one

    @classmethod
    def fit(cls, windows: Windows, plan: Plan) -> tuple[Any, Curve]:
        """Train one network a seed.

        Raises:
            PolicyError: the loss is not finite any more.
        """
        return cls._fit(windows, plan, cls.RECIPE)

    @classmethod
    def _fit(cls, windows: Windows, plan: Plan, recipe: Recipe) -> tuple[Self, Curve]:
        stack, curve = fit_stack(windows, recipe, plan)
        return cls(stack, windows.normalizer, plan.seeds, windows.history, windows.chunk), curve

    def predict(self, observations: Observations, horizons: int = 1) -> np.ndarray:
        """[S, B, K, A] float32, raw units; K is the policy's own chunk, whatever `horizons` says."""
        batch, frames = observations.values.shape[:2]
        if frames != self.history:
            raise PolicyError(f"The policy sees {self.history} frames at a time and was given {frames}.")
        check_columns(observations.values, len(self.normalizer.observations.circular))
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
    def restore(cls, arrays: Mapping[str, np.ndarray], settings: Mapping[str, Any]) -> Any:
        stack, normalizer = Stack.restore(arrays), Normalizer.from_arrays(arrays)
        widths = (settings["history"] * normalizer.observations.width, settings["chunk"] * normalizer.actions.width)
        found = (stack.weights[0].shape[1], stack.weights[-1].shape[2])
        if found != widths:
            raise ValueError(
                f"a network of {found[0]} inputs and {found[1]} outputs, expected {widths[0]} and {widths[1]}"
            )
        return cls(stack, normalizer, tuple(settings["seeds"]), settings["history"], settings["chunk"])


class Mlp(PlainMlp):
    """Two hidden layers of 512 with ReLU, L1 loss over the targets inside the episode, AdamW; or what its settings say."""

    RECIPE: ClassVar[Recipe] = Recipe(hidden=(512, 512), loss="l1", batch=256, learning_rate=1e-3, weight_decay=1e-4)

    @classmethod
    def fit(cls, windows: Windows, plan: Plan) -> tuple[Any, Curve]:
        """As for every policy; what is asked for decides which kind of network it is.

        Raises:
            PolicyError: the loss is not finite any more, or what was asked for does not fit the data.
            ConfigError: a setting that there is not.
        """
        asked = settings_of("mlp", plan.settings)
        if plan.given or not asked.is_plain:
            return MlpNetwork.fit(windows, plan)
        hidden = (asked.width, asked.width)
        return cls._fit(windows, plan, Recipe(hidden, asked.loss, asked.batch, asked.learning_rate, asked.weight_decay))

    @classmethod
    def restore(cls, arrays: Mapping[str, np.ndarray], settings: Mapping[str, Any]) -> Any:
        return MlpNetwork.restore(arrays, settings) if "made_with" in settings else super().restore(arrays, settings)


class _Regression(Net):
    def __init__(self, settings: MlpSettings, shape: Shape):
        super().__init__()
        self.size = LOSSES[settings.loss]
        self.body = perceptron(shape.inputs, shape.outputs, settings.width, settings.blocks, settings.dropout)

    def loss(self, inputs: torch.Tensor, targets: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        return masked_mean(self.size(self.body(inputs).float() - targets), mask)

    def answer(self, inputs: torch.Tensor, noise: torch.Tensor | None) -> torch.Tensor:
        return self.body(inputs)


class MlpNetwork(NetworkPolicy):
    """Regression by a residual (or plain) perceptron with everything that networks can be given."""

    method = "mlp"
    net = _Regression

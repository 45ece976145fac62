"""A mixture of Gaussians over the whole chunk (mixture density network, Bishop 1994).

What belongs here: the mixture, its likelihood, its answers. What does not: training (`networks`), the body's layers (`body`).

Departures: one mixture for the whole chunk rather than one an action, so that a component is one way of going on; deviations
have a floor, without which the likelihood runs away where an action is always the same. It acts by the mean of the heaviest
component, not by the mixture's mean, which may lie where nobody ever goes.
"""

import math

import torch

from pipeline.policies.body import perceptron
from pipeline.policies.networks import Net, NetworkPolicy, Samples, Shape
from pipeline.settings import GmmSettings

LEAST = 0.01
"""The smallest deviation of a component, in deviations of the scaled actions."""


class _Mixture(Net):
    def __init__(self, settings: GmmSettings, shape: Shape):
        super().__init__()
        self.components, self.size = settings.components, shape.outputs
        outputs = settings.components * (1 + 2 * shape.outputs)
        self.body = perceptron(shape.inputs, outputs, settings.width, settings.blocks, settings.dropout)

    def _parts(self, inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Log weights [B, C], means and deviations [B, C, K · A']."""
        answer = self.body(inputs).float()
        weights, rest = answer[:, : self.components], answer[:, self.components :]
        means, spread = rest.view(len(inputs), self.components, 2, self.size).unbind(2)
        return weights.log_softmax(1), means, torch.nn.functional.softplus(spread) + LEAST

    def loss(self, inputs: torch.Tensor, targets: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        """Minus the log likelihood, for each number inside its episode."""
        weights, means, deviations = self._parts(inputs)
        apart = (targets[:, None] - means) / deviations
        logs = -0.5 * apart.square() - deviations.log() - 0.5 * math.log(2 * math.pi)
        likelihood = (weights + (logs * mask[:, None]).sum(2)).logsumexp(1)
        return -likelihood.sum() / mask.sum().clamp(min=1)

    def answer(self, inputs: torch.Tensor, noise: torch.Tensor | None) -> torch.Tensor:
        weights, means, _ = self._parts(inputs)
        return means[torch.arange(len(inputs)), weights.argmax(1)]

    def draw(self, inputs: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """A component by its weight, then a point of it."""
        weights, means, deviations = self._parts(inputs)
        level = torch.special.ndtr(noise[:, :1])
        chosen = (weights.exp().cumsum(1) < level).sum(1).clamp(max=self.components - 1)
        rows = torch.arange(len(inputs))
        return means[rows, chosen] + deviations[rows, chosen] * noise[:, 1:]

    @property
    def noise_width(self) -> int:
        return 1 + self.size


class Gmm(Samples, NetworkPolicy):
    """Acts by the mean of the heaviest component; `sample` draws from the mixture."""

    method = "gmm"
    net = _Mixture

"""Flow matching: a velocity that carries noise to actions (Lipman et al. 2023), followed in a few Euler steps.

What belongs here: the flow, its loss, its steps. What does not: training (`networks`), the body's layers (`body`).

Departures: the path is the straight one (σ_min = 0); actions of a chunk are one vector, and the velocity is a perceptron's.
`start_noise` scales the noise that an answer starts from. Samples always start from all of it, as in the paper.
"""

import torch

from pipeline.policies.body import WAVES, perceptron, waves
from pipeline.policies.networks import Net, NetworkPolicy, Samples, Shape, masked_mean
from pipeline.settings import FlowSettings


class _Flow(Net):
    def __init__(self, settings: FlowSettings, shape: Shape):
        super().__init__()
        self.steps, self.start, self.size = settings.euler_steps, settings.start_noise, shape.outputs
        self.draws = settings.start_noise > 0
        inputs = shape.inputs + shape.outputs + WAVES
        self.body = perceptron(inputs, shape.outputs, settings.width, settings.blocks, settings.dropout)

    def velocity(self, inputs: torch.Tensor, points: torch.Tensor, time: torch.Tensor) -> torch.Tensor:
        """At points [B, K · A'] and times [B] in 0 … 1."""
        return self.body(torch.cat([inputs, points, waves(time)], dim=1)).float()

    def loss(self, inputs: torch.Tensor, targets: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        """How far the velocity is from the straight way, squared, at a random time of it."""
        noise, time = torch.randn_like(targets), torch.rand(len(targets), device=targets.device)
        points = (1 - time[:, None]) * noise + time[:, None] * targets
        return masked_mean((self.velocity(inputs, points, time) - (targets - noise)).square(), mask)

    def answer(self, inputs: torch.Tensor, noise: torch.Tensor | None) -> torch.Tensor:
        return self._follow(inputs, torch.zeros(len(inputs), self.size) if noise is None else self.start * noise)

    def draw(self, inputs: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        return self._follow(inputs, noise)

    def _follow(self, inputs: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        for step in range(self.steps):
            time = torch.full((len(inputs),), step / self.steps)
            points = points + self.velocity(inputs, points, time) / self.steps
        return points

    @property
    def noise_width(self) -> int:
        return self.size


class Flow(Samples, NetworkPolicy):
    """Acts by one draw (by none with `start_noise = 0`); `sample` draws."""

    method = "flow"
    net = _Flow

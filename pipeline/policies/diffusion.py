"""Diffusion: noise is taken away from actions step by step (Diffusion Policy, Chi et al. 2023).

What belongs here: the noise process of training (DDPM, Ho et al. 2020, with the cosine schedule of Nichol & Dhariwal 2021) and
the sampling (DDIM, Song et al. 2021, without noise on the way). What does not: training (`networks`), the body's layers
(`body`).

Departures from Diffusion Policy: a residual perceptron over the whole chunk instead of a 1-D U-Net or transformer; the
network predicts the velocity of Salimans & Ho (2022) instead of the noise, because at the first of few sampling steps clean
actions would be a difference over almost nothing; actions are scaled by deviations, so the estimate of the clean ones is
clamped at the largest of each training target rather than at ±1. The process is thirty lines; the package that others take it
from would bring more to own than that.
"""

import math

import torch

from pipeline.policies.body import WAVES, perceptron, waves
from pipeline.policies.networks import Net, NetworkPolicy, Samples, Shape, masked_mean
from pipeline.settings import DiffusionSettings


def kept_shares(steps: int) -> torch.Tensor:
    """[steps] ᾱ: the share of the clean actions' variance that is left after each step of noise."""

    def curve(step: int) -> float:
        return math.cos((step / steps + 0.008) / 1.008 * math.pi / 2) ** 2

    betas = torch.tensor([min(1 - curve(t + 1) / curve(t), 0.999) for t in range(steps)], dtype=torch.float64)
    return (1 - betas).cumprod(0).float()


class _Diffusion(Net):
    draws = True

    def __init__(self, settings: DiffusionSettings, shape: Shape):
        super().__init__()
        self.size, self.steps = shape.outputs, settings.noise_steps
        inputs = shape.inputs + shape.outputs + WAVES
        self.body = perceptron(inputs, shape.outputs, settings.width, settings.blocks, settings.dropout)
        self.register_buffer("kept", kept_shares(settings.noise_steps), persistent=False)
        self.register_buffer("limit", torch.tensor(shape.limit), persistent=False)
        self.visited = torch.linspace(self.steps - 1, 0, settings.sampling_steps).round().long().tolist()

    def velocity(self, inputs: torch.Tensor, points: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        """√ᾱ · noise − √(1 − ᾱ) · clean actions, as thought to be at points [B, K · A'] after `step` [B]."""
        return self.body(torch.cat([inputs, points, waves(step / self.steps)], dim=1)).float()

    def loss(self, inputs: torch.Tensor, targets: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        """How far that is from what it is, squared, after a random number of steps."""
        step = torch.randint(self.steps, (len(targets),), device=targets.device)
        noise, kept = torch.randn_like(targets), self.kept[step, None]
        points = kept.sqrt() * targets + (1 - kept).sqrt() * noise
        velocity = kept.sqrt() * noise - (1 - kept).sqrt() * targets
        return masked_mean((self.velocity(inputs, points, step) - velocity).square(), mask)

    def answer(self, inputs: torch.Tensor, noise: torch.Tensor | None) -> torch.Tensor:
        points = noise
        for step, then in zip(self.visited, [*self.visited[1:], None], strict=True):
            kept = self.kept[step]
            velocity = self.velocity(inputs, points, torch.full((len(inputs),), step))
            clean = kept.sqrt() * points - (1 - kept).sqrt() * velocity
            clean = torch.minimum(torch.maximum(clean, -self.limit), self.limit)
            if then is None:
                return clean
            found = (points - kept.sqrt() * clean) / (1 - kept).sqrt()
            points = self.kept[then].sqrt() * clean + (1 - self.kept[then]).sqrt() * found
        return points

    @property
    def noise_width(self) -> int:
        return self.size


class Diffusion(Samples, NetworkPolicy):
    """Acts by one draw; `sample` draws."""

    method = "diffusion"
    net = _Diffusion

"""What the networks here are built from: a residual perceptron, and a number as waves.

What belongs here: layers that several policies share. What does not: losses, sampling, training.
"""

import math

import torch
from torch import nn


class Block(nn.Module):
    """x + Linear(dropout(SiLU(Linear(LayerNorm(x))))), the last zero at first, so that a fresh network is shallow."""

    def __init__(self, width: int, dropout: float):
        super().__init__()
        self.norm, self.into = nn.LayerNorm(width), nn.Linear(width, width)
        self.drop, self.out = nn.Dropout(dropout), nn.Linear(width, width)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x + self.out(self.drop(nn.functional.silu(self.into(self.norm(x)))))


def perceptron(inputs: int, outputs: int, width: int, blocks: int, dropout: float) -> nn.Module:
    """[B, inputs] → [B, outputs]: residual blocks, or, with 0 of them, two hidden layers with ReLU."""
    if blocks:
        middle = [Block(width, dropout) for _ in range(blocks)]
        return nn.Sequential(nn.Linear(inputs, width), *middle, nn.LayerNorm(width), nn.Linear(width, outputs))
    return nn.Sequential(
        nn.Linear(inputs, width), nn.ReLU(), nn.Dropout(dropout),
        nn.Linear(width, width), nn.ReLU(), nn.Dropout(dropout), nn.Linear(width, outputs),
    )  # fmt: skip


WAVES = 64


def waves(time: torch.Tensor) -> torch.Tensor:
    """[B] in 0 … 1 → [B, WAVES]: sines and cosines from one turn to a thousand (Vaswani et al. 2017)."""
    rates = torch.exp(torch.linspace(0.0, math.log(1000.0), WAVES // 2, device=time.device))
    angles = time[:, None] * rates
    return torch.cat([angles.sin(), angles.cos()], dim=1)

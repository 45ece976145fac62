"""Regression from a camera: convolutions, where each of their channels looks (spatial softmax), and a perceptron.

What belongs here: the encoder, and how pictures enter it. What does not: decoding them (`lerobot_format.pictures`), training
(`networks`). It follows Levine et al. (2016, "End-to-end training of deep visuomotor policies"): a channel's answer is the mean
place of its activity, which is what a robot needs of a picture, and few numbers. Departures: frames are channels of one picture,
three small layers, no pretraining, and pictures are shrunk, so that a processor can train it. Columns of the observation set and
derived features enter beside the places.
"""

from typing import Any

import numpy as np
import torch
from torch import nn

from pipeline.errors import NotApplicableError
from pipeline.policies.body import perceptron
from pipeline.policies.fitting import LOSSES
from pipeline.policies.networks import Net, NetworkPolicy, Shape, masked_mean
from pipeline.policies.transform import Transform
from pipeline.settings import ImageSettings
from pipeline.types import Observations

CHANNELS = 64


class _Encoder(nn.Module):
    """[B, 3 · T, p, p] → [B, 2 · CHANNELS] places in −1 … 1."""

    def __init__(self, channels: int):
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(channels, CHANNELS // 2, 5, 2, 2), nn.ReLU(),
            nn.Conv2d(CHANNELS // 2, CHANNELS, 3, 2, 1), nn.ReLU(),
            nn.Conv2d(CHANNELS, CHANNELS, 3, 1, 1),
        )  # fmt: skip

    def forward(self, pictures: torch.Tensor) -> torch.Tensor:
        active = self.layers(pictures).float()
        share = active.flatten(2).softmax(2).view_as(active)
        down, across = (torch.linspace(-1, 1, size, device=active.device) for size in active.shape[2:])
        return torch.cat([(share.sum(3) * down).sum(2), (share.sum(2) * across).sum(2)], dim=1)


class _FromCamera(Net):
    def __init__(self, settings: ImageSettings, shape: Shape):
        super().__init__()
        self.picture = (3 * shape.history, settings.pixels, settings.pixels)
        self.numbers = shape.inputs - int(np.prod(self.picture))
        self.size, self.encoder = LOSSES[settings.loss], _Encoder(self.picture[0])
        inputs = self.numbers + 2 * CHANNELS
        self.body = perceptron(inputs, shape.outputs, settings.width, settings.blocks, settings.dropout)

    def loss(self, inputs: torch.Tensor, targets: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        return masked_mean(self.size(self.answer(inputs, None) - targets), mask)

    def answer(self, inputs: torch.Tensor, noise: torch.Tensor | None) -> torch.Tensor:
        places = self.encoder(inputs[:, self.numbers :].view(-1, *self.picture))
        return self.body(torch.cat([inputs[:, : self.numbers], places], dim=1)).float()


class Image(NetworkPolicy):
    """Sees its observation set and a camera."""

    method = "image"
    net = _FromCamera

    @classmethod
    def see(cls, settings: Any, transform: Transform, observations: Observations) -> np.ndarray:
        """[B, numbers + T · 3 · p · p]: numbers first, pictures in −½ … ½, frame after frame.

        Raises:
            NotApplicableError: there is nothing to look at.
        """
        numbers = transform.encode(observations.values)
        if observations.look is None:
            raise NotApplicableError("it sees a camera, and there is none here")
        pictures = observations.look(settings.camera, settings.pixels)
        flat = np.moveaxis(pictures, -1, -3).reshape(len(pictures), -1).astype(np.float32)
        return np.concatenate([numbers, flat / 255 - 0.5], axis=1)

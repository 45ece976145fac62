"""Action chunking with transformers (ACT, Zhao et al. 2023), for numbers instead of pictures.

What belongs here: the three transformers, the latent, their loss. What does not: training (`networks`), temporal ensembles
(`pipeline.predict`).

A transformer reads the chunk that people carried out and what was seen, and puts the style of it into a latent z; another reads
z and what is seen; a third asks for one action a query. The loss is L1 plus the divergence of z from a standard normal. It acts
with z = 0.

Departures: there is no camera, so what is seen is one token (as the paper's joint positions are); layers normalise first; sizes
are for a processor; actions past the end of an episode are hidden from the first transformer and count in no loss.
"""

import torch
from torch import nn

from pipeline.policies.body import WAVES, waves
from pipeline.policies.networks import Net, NetworkPolicy, Samples, Shape, masked_mean
from pipeline.settings import ActSettings


class _Act(Net):
    def __init__(self, settings: ActSettings, shape: Shape):
        super().__init__()
        width = settings.width
        self.chunk, self.action, self.latent, self.kl = shape.chunk, shape.width, settings.latent, settings.kl
        layer = {"d_model": width, "nhead": settings.heads, "dim_feedforward": 4 * width, "dropout": settings.dropout}
        layer |= {"batch_first": True, "norm_first": True}

        def encoder() -> nn.Module:
            return nn.TransformerEncoder(
                nn.TransformerEncoderLayer(**layer), settings.layers, nn.LayerNorm(width), enable_nested_tensor=False
            )

        self.style, self.seen = encoder(), encoder()
        self.decoder = nn.TransformerDecoder(nn.TransformerDecoderLayer(**layer), settings.layers, nn.LayerNorm(width))
        self.of_inputs, self.of_actions = nn.Linear(shape.inputs, width), nn.Linear(shape.width, width)
        self.summary = nn.Parameter(torch.randn(1, 1, width) * 0.02)
        self.queries = nn.Parameter(torch.randn(1, shape.chunk, width) * 0.02)
        self.of_place = nn.Linear(WAVES, width)
        self.to_latent, self.of_latent = nn.Linear(width, 2 * settings.latent), nn.Linear(settings.latent, width)
        self.to_actions = nn.Linear(width, shape.width)

    def loss(self, inputs: torch.Tensor, targets: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        mean, log_variance = self._style_of(inputs, targets, mask)
        latent = mean + (0.5 * log_variance).exp() * torch.randn_like(mean)
        off = masked_mean((self._act(inputs, latent) - targets).abs(), mask)
        divergence = -0.5 * (1 + log_variance - mean.square() - log_variance.exp()).sum(1).mean()
        return off + self.kl * divergence

    def _style_of(
        self, inputs: torch.Tensor, targets: torch.Tensor, mask: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and log variance [B, latent] of z, from the chunk that was carried out."""
        actions = self.of_actions(targets.view(-1, self.chunk, self.action)) + self._places(targets.device)
        seen = self.of_inputs(inputs)[:, None]
        tokens = torch.cat([self.summary.expand(len(inputs), -1, -1), seen, actions], dim=1)
        absent = mask.view(-1, self.chunk, self.action)[..., 0] == 0
        hidden = torch.cat([absent.new_zeros(len(inputs), 2), absent], dim=1)
        found = self.to_latent(self.style(tokens, src_key_padding_mask=hidden)[:, 0]).float()
        return found.chunk(2, dim=1)

    def _places(self, device: torch.device) -> torch.Tensor:
        """[1, K, width] where in the chunk an action is."""
        return self.of_place(waves(torch.arange(self.chunk, device=device) / self.chunk))[None]

    def _act(self, inputs: torch.Tensor, latent: torch.Tensor) -> torch.Tensor:
        tokens = torch.stack([self.of_latent(latent), self.of_inputs(inputs)], dim=1)
        queries = (self.queries + self._places(inputs.device)).expand(len(inputs), -1, -1)
        return self.to_actions(self.decoder(queries, self.seen(tokens))).float().flatten(1)

    def answer(self, inputs: torch.Tensor, noise: torch.Tensor | None) -> torch.Tensor:
        return self._act(inputs, torch.zeros(len(inputs), self.latent))

    def draw(self, inputs: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        return self._act(inputs, noise)

    @property
    def noise_width(self) -> int:
        return self.latent


class Act(Samples, NetworkPolicy):
    """Acts with the latent's mean; `sample` draws the latent."""

    method = "act"
    net = _Act

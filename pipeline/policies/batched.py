"""Several networks of one shape as one: each layer's weights of all seeds in one tensor, one batched product a layer.

What belongs here: building, asking and storing such a stack. What does not: what goes in and comes out, or how it is
trained.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch


@dataclass(frozen=True)
class Stack:
    """S fully connected networks with ReLU between layers.

    weights  one [S, in, out] a layer      biases  one [S, 1, out] a layer
    """

    weights: tuple[torch.Tensor, ...]
    biases: tuple[torch.Tensor, ...]

    @classmethod
    def fresh(cls, sizes: Sequence[int], seeds: Sequence[int], dtype: torch.dtype, device: str) -> "Stack":
        """Networks as `torch.nn.Linear` draws them after `torch.manual_seed(seed)`, with a generator of their own."""
        networks = [_draw(sizes, seed) for seed in seeds]
        layers = range(len(sizes) - 1)
        weights = [torch.stack([network[i][0] for network in networks]) for i in layers]
        biases = [torch.stack([network[i][1] for network in networks]) for i in layers]
        return cls(
            tuple(w.to(device, dtype).contiguous().requires_grad_() for w in weights),
            tuple(b.to(device, dtype).contiguous().requires_grad_() for b in biases),
        )

    def __call__(self, inputs: torch.Tensor) -> torch.Tensor:
        """[S, B, in] → [S, B, out]."""
        last = len(self.weights) - 1
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            inputs = torch.baddbmm(bias, inputs, weight)
            if layer < last:
                inputs = inputs.relu_()
        return inputs

    @property
    def tensors(self) -> dict[str, torch.Tensor]:
        """All parameters by name, in a fixed order."""
        named = {}
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            named |= {f"layer{layer}.weight": weight, f"layer{layer}.bias": bias}
        return named

    @property
    def parameters_of_one(self) -> int:
        return sum(tensor[0].numel() for tensor in self.tensors.values())

    def of_seed(self, position: int) -> "Stack":
        """The stack of one network alone."""
        cut = slice(position, position + 1)
        return Stack(tuple(w[cut].contiguous() for w in self.weights), tuple(b[cut].contiguous() for b in self.biases))

    def arrays(self) -> dict[str, np.ndarray]:
        return {name: tensor.detach().cpu().numpy() for name, tensor in self.tensors.items()}

    @classmethod
    def restore(cls, arrays: Mapping[str, np.ndarray]) -> "Stack":
        """The inverse of `arrays`, on the CPU and without gradients."""
        layers = range(sum(name.endswith(".weight") and name.startswith("layer") for name in arrays))
        weights = tuple(torch.tensor(arrays[f"layer{i}.weight"]) for i in layers)
        return cls(weights, tuple(torch.tensor(arrays[f"layer{i}.bias"]) for i in layers))


def _draw(sizes: Sequence[int], seed: int) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """One network's (weight [in, out], bias [1, out]) a layer: uniform within ±1/√in, float32, weight before bias."""
    generator = torch.Generator().manual_seed(seed)
    layers = []
    for inputs, outputs in pairwise(sizes):
        bound = 1 / math.sqrt(inputs)
        weight = torch.empty(outputs, inputs).uniform_(-bound, bound, generator=generator)
        bias = torch.empty(1, outputs).uniform_(-bound, bound, generator=generator)
        layers.append((weight.T, bias))
    return layers

"""A training step against its matrix products alone, and all seeds together against one after another."""

from dataclasses import replace
from itertools import pairwise

import torch

from pipeline.policies import Plan
from pipeline.policies.fitting import fit_stack
from pipeline.policies.mlp import Mlp
from pipeline.windows import Windows
from speed.timing import compare

STEPS = 40
SEEDS = tuple(range(5))
THREADS = 2


def train(windows: Windows, seeds: tuple[int, ...]) -> None:
    fit_stack(windows, Mlp.RECIPE, Plan(seeds, STEPS, threads=THREADS))


def products(sizes: list[int], batch: int) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """The factors of the products of one step: forward, the gradient of the weights, the gradient of the inputs."""
    pairs = []
    for layer, (width_in, width_out) in enumerate(pairwise(sizes)):
        inputs = torch.randn(len(SEEDS), batch, width_in)
        weights = torch.randn(len(SEEDS), width_in, width_out)
        upstream = torch.randn(len(SEEDS), batch, width_out)
        pairs += [(inputs, weights), (inputs.transpose(1, 2), upstream)]
        if layer:
            pairs.append((upstream, weights.transpose(1, 2)))
    return pairs


def measure(windows: Windows) -> list[str]:
    torch.set_num_threads(THREADS)
    width = windows.normalizer.observations.width * windows.history
    sizes = [width, *Mlp.RECIPE.hidden, windows.chunk * windows.normalizer.actions.width]
    factors = products(sizes, Mlp.RECIPE.batch)

    def multiply() -> None:
        for _ in range(STEPS):
            for a, b in factors:
                torch.bmm(a, b)

    step = compare(multiply, lambda: train(windows, SEEDS))
    single = [replace(windows) for _ in SEEDS]
    seeds = compare(
        lambda: train(windows, SEEDS), lambda: [train(w, (seed,)) for w, seed in zip(single, SEEDS, strict=True)]
    )
    return [
        f"training step, chunk {windows.chunk}, {len(SEEDS)} seeds: {1e3 * step.plain_s / STEPS:.1f} ms, {step.median:.2f} times "
        f"its matrix products alone ({step.low:.2f} to {step.high:.2f})",
        f"{len(SEEDS)} seeds together: {seeds.median:.2f} times as fast as one after another "
        f"({seeds.low:.2f} to {seeds.high:.2f})",
    ]

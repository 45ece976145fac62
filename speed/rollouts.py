"""Roll-outs side by side against one at a time, and what 500 episodes of a trained network take."""

import time

import torch

from pipeline.policies import Plan
from pipeline.policies.mlp import Mlp
from pipeline.simulate.pusht import PushT
from pipeline.simulate.rollout import BATCH, rollout
from pipeline.types import ObservationSet
from pipeline.windows import Windows
from speed.timing import compare

STEPS, FRAMES, EPISODES = 100, 100, 500
FIRST_START = 10_000


def measure(windows: Windows, seen: ObservationSet) -> list[str]:
    """`windows` are those of chunk 16; the network is trained for a moment: what it does costs the same."""
    torch.set_num_threads(1)
    policy, _ = Mlp.fit(windows, Plan((0,), STEPS, threads=2))

    def roll(episodes: int, batch: int, frames: int | None = None) -> object:
        numbers = range(FIRST_START, FIRST_START + episodes)
        options = {"name": "mlp", "history": windows.history, "batch": batch, "max_steps": frames}
        return rollout(policy.one_seed(0), PushT(), seen, numbers, **options)

    side_by_side = compare(lambda: roll(BATCH, BATCH, FRAMES), lambda: roll(BATCH, 1, FRAMES), pairs=3)
    began, cpu = time.perf_counter(), time.process_time()
    results = roll(EPISODES, BATCH)
    seconds, cpu = time.perf_counter() - began, time.process_time() - cpu
    steps = int(results.steps.sum())
    return [
        f"roll-outs, PushT, {BATCH} side by side: {side_by_side.median:.2f} times as fast as one at a time "
        f"({side_by_side.low:.2f} to {side_by_side.high:.2f})",
        f"{EPISODES} episodes of PushT, {steps:,} steps, chunk {windows.chunk}: {cpu:.1f} CPU-seconds, {seconds:.1f} s of "
        f"the clock, {steps / cpu:,.0f} steps a CPU-second",
    ]

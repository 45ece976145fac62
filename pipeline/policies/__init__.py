"""Policies: one method a file; `pipeline.methods` names them.

A method is a class whose objects are fitted policies:

    fit(windows, plan) → (policy, Curve | None)     learns from the windows' anchors, all seeds together
    predict(observations, horizons) → [S, B, K, A]  raw units in and out, float32; `horizons` is how many actions a
                                                    policy without a chunk is asked for, others answer their K
    arrays(), settings()                            all that a fitted policy is: named arrays, and JSON
    restore(arrays, settings) → policy              the inverse
    seeds, chunk, parameters                        `chunk` is None where there is none; `parameters` are one network's

A policy owns its transform, and its arrays hold it. Files are written and read by `pipeline.train`.
"""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

# PyTorch's threads wait for each other by spinning, and where other work wants the cores (a second run, the UI, a browser)
# they spin away the time of the thread they wait for: five times slower steps were measured. OpenMP reads this once, when
# PyTorch is first imported, and every module that imports it here comes after this one.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


@dataclass(frozen=True)
class Plan:
    """How much a policy may learn, and with what. Numbers depend on all of it but `checkpoint` and `on_step`.

    cpu_seconds         of each seed, instead of steps: a trial finds out how many steps that is
    recorded            a file that remembers how many it was; where it is there, no trial is made
    checkpoint          a file to go on from and to keep up to date, or None
    checkpoint_every_s  seconds between two of them
    on_step             called with (step, steps, loss) now and then
    settings            what the method is made with; of a class of the user's own, what its `__init__` takes
    given               what policies of any method can be given, as far as it is used: actions, features, noise, symmetry
    """

    seeds: tuple[int, ...]
    steps: int
    threads: int = 1
    device: str = "cpu"
    cpu_seconds: float | None = None
    recorded: Path | None = None
    checkpoint: Path | None = None
    checkpoint_every_s: float = 20.0
    on_step: Callable[[int, int, float], None] | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    given: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Curve:
    """Training losses, and what all seeds took together.

    steps [L]      losses [S, L], each the mean since the entry before
    train_s        seconds of the clock            cpu_s  of all processor cores
    vram_mb        the most memory of a GPU that was in use, 0 without one
    """

    steps: np.ndarray
    losses: np.ndarray
    train_s: float
    cpu_s: float = 0.0
    vram_mb: float = 0.0

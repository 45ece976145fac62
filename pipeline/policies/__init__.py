"""Policies: one method a file, and one explicit dictionary that names them.

A method is a class whose objects are fitted policies:

    fit(windows, plan) → (policy, Curve | None)     learns from the windows' anchors, all seeds together
    predict(observations, horizons) → [S, B, K, A]  raw units in and out, float32; `horizons` is how many actions a
                                                    policy without a chunk is asked for, others answer their K
    arrays(), settings()                            all that a fitted policy is: named arrays, and JSON
    restore(arrays, settings) → policy              the inverse
    seeds, chunk, parameters                        `chunk` is None where there is none; `parameters` are one network's

A policy owns its transform, and its arrays hold it. `METHODS` holds what the rest of the project may ask about a method
without importing torch; files are written and read by `pipeline.train`.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Literal

import numpy as np

# PyTorch's threads wait for each other by spinning, and where other work wants the cores (a second run, the UI, a browser)
# they spin away the time of the thread they wait for: five times slower steps were measured. OpenMP reads this once, when
# PyTorch is first imported, and every module that imports it here comes after this one.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


@dataclass(frozen=True)
class Plan:
    """How much a policy may learn, and with what. Numbers depend on all of it but `checkpoint` and `on_step`.

    checkpoint          a file to go on from and to keep up to date, or None
    checkpoint_every_s  seconds between two of them
    on_step             called with (step, steps, loss) now and then
    """

    seeds: tuple[int, ...]
    steps: int
    threads: int = 1
    device: str = "cpu"
    checkpoint: Path | None = None
    checkpoint_every_s: float = 20.0
    on_step: Callable[[int, int, float], None] | None = None


@dataclass(frozen=True)
class Curve:
    """Training losses, and the seconds that all seeds took together.

    steps [L]      losses [S, L], each the mean since the entry before
    """

    steps: np.ndarray
    losses: np.ndarray
    train_s: float


@dataclass(frozen=True)
class Method:
    """Where a method lives and what a benchmark must know before building it.

    chunk              "set": the config names chunk sizes, one policy each; "one": always a single action; "none": it
                       can be asked for any horizon and is scored on all
    trained            it has seeds and training steps (and is rolled out where there is a simulator)
    uses_observations  its answer depends on the observation set; else it runs once a data set
    recipe             which windows it is made for (`windows.Recipe`)
    """

    module: str
    cls: str
    chunk: Literal["set", "one", "none"] = "none"
    trained: bool = False
    uses_observations: bool = True
    recipe: Literal["arm", "every_frame"] = "arm"

    def load_class(self) -> type:
        return getattr(import_module(self.module), self.cls)


METHODS: dict[str, Method] = {
    "hold_still": Method("pipeline.policies.hold_still", "HoldStill", uses_observations=False),
    "mean_action": Method("pipeline.policies.mean_action", "MeanAction", uses_observations=False),
    "constant_velocity": Method("pipeline.policies.constant_velocity", "ConstantVelocity", uses_observations=False),
    "nearest_neighbour": Method("pipeline.policies.nearest_neighbour", "NearestNeighbour"),
    "mlp": Method("pipeline.policies.mlp", "Mlp", chunk="set", trained=True),
    "notebook_pusht": Method(
        "pipeline.policies.notebook_pusht", "NotebookPushT", chunk="one", trained=True, recipe="every_frame"
    ),
}

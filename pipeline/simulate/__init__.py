"""Simulators: one a file behind one small protocol, an explicit dictionary that names them, and the roll-out that
uses them.

What belongs here: the protocol, finding a simulator by name, and saying clearly when there is none for a data set. What
does not: policies, success statistics, pictures.

A simulator is an optional extra of the package: its module can be imported without it, and only using it needs it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Protocol

import numpy as np

from pipeline.errors import NotApplicableError, did_you_mean
from pipeline.safety import Limits
from pipeline.types import Demonstrations, ObservationSet


@dataclass(frozen=True)
class Outcome:
    """What one step gave, environment by environment: reward [R] in 0 … 1, success [R] bool.

    coverage  [R] in 0 … 1, the share of the goal that is covered; NaN where a task has no such thing
    stages    stage → [R] bool, whether the episode has come so far, each including those before; none where a task has none
    """

    reward: np.ndarray
    coverage: np.ndarray
    success: np.ndarray
    stages: Mapping[str, np.ndarray] = field(default_factory=dict)


class Environments(Protocol):
    """R environments, each from a start state of its own, that step together."""

    def observe(self) -> Mapping[str, np.ndarray]:
        """Feature key → [R, D] float32, named and measured as in the data set."""

    def step(self, actions: np.ndarray, running: np.ndarray) -> Outcome:
        """Carry out actions [R, A] for one frame where `running` [R] is true; the others stand still and score 0."""

    def standing(self) -> np.ndarray:
        """The actions [R, A] that leave every robot where it is seen to be."""

    def effector(self) -> np.ndarray | None:
        """Where the end effector is [R, 2], for pictures; None where that is not two-dimensional."""


class Simulator(Protocol):
    """A world that policies can be rolled out in.

    name          as in `demobench.toml`          max_steps  frames an episode may take
    """

    name: str
    max_steps: int

    def limits(self) -> Limits:
        """What its robot may be told; the safety layer of every roll-out keeps them."""

    def version(self) -> str:
        """Name and version of everything that the physics depends on."""

    def fits(self, demos: Demonstrations, observation_set: ObservationSet) -> str | None:
        """None where policies trained on these columns can be asked in this world; else why not, in one message."""

    def start(self, numbers: Sequence[int]) -> Environments:
        """Environments at the numbered start states. The same number is the same state, always and everywhere."""


SIMULATORS: dict[str, tuple[str, str]] = {
    "pusht": ("pipeline.simulate.pusht", "PushT"),
    "so101": ("pipeline.simulate.so101", "SO101"),
}
"""Name → module and class. A module here imports no simulator before it is used."""


def load_simulator(name: str) -> Simulator:
    """The simulator of that name, ready to use.

    Raises:
        NotApplicableError: there is no simulator of that name, or the package it needs is not installed.
    """
    if name not in SIMULATORS:
        raise NotApplicableError(f"There is no simulator '{name}'. {did_you_mean(name, SIMULATORS)}")
    module, cls = SIMULATORS[name]
    return getattr(import_module(module), cls)()


def simulator_for(name: str, demos: Demonstrations, observation_set: ObservationSet) -> Simulator:
    """The simulator of that name, once it is sure that policies of this data set and observation set can be asked in
    it.

    Raises:
        NotApplicableError: as `load_simulator`, or the columns do not fit.
    """
    simulator = load_simulator(name)
    problem = simulator.fits(demos, observation_set)
    if problem:
        raise NotApplicableError(problem)
    return simulator

"""A trained policy of a benchmark in its data set's simulator, and the files of what happened.

What belongs here: from a task and a folder of weights to `Rollouts`. What does not: the loop itself (`rollout`), success
rates and their intervals (`statistics.success`).
"""

import json
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np

from pipeline.errors import NotApplicableError
from pipeline.folds import PolicyTask
from pipeline.simulate import simulator_for
from pipeline.simulate.rollout import rollout
from pipeline.types import Rollouts

TEXTS = ("simulator", "simulator_version", "policy", "observations")
STAGE_NAMES = "stage_names"


def roll_out(task: PolicyTask, trained: Path, on_frame: Callable[[int, int], None] | None = None) -> Rollouts:
    """Seed 0 of fold 0, from the numbered start states 0 … n − 1.

    Raises:
        NotApplicableError: the data set has no simulator, or policies like this one cannot be asked in it.
    """
    from pipeline.train import load_trained

    name = task.experiment.dataset.simulator
    if name is None:
        raise NotApplicableError("no simulator for this data set")
    if not task.variant.is_trained:
        raise NotApplicableError("baselines are not rolled out")
    simulator = simulator_for(name, task.demos, task.observation_set)
    policy = load_trained(trained / "fold_0").policy
    fold = task.split.folds[0]
    return rollout(
        policy.one_seed(0),
        simulator,
        task.observation_set,
        range(task.experiment.rollouts),
        name=task.variant.name,
        history=task.windows(fold.test, fold).history,
        on_frame=on_frame,
    )


def save_rollouts(rollouts: Rollouts, folder: Path) -> None:
    """Arrays as safetensors, words as JSON."""
    from safetensors.numpy import save_file

    arrays = {f.name: getattr(rollouts, f.name) for f in fields(rollouts) if f.name not in (*TEXTS, STAGE_NAMES)}
    present = {name: np.ascontiguousarray(array) for name, array in arrays.items() if array is not None}
    save_file(present, folder / "rollouts.safetensors")
    words = {name: getattr(rollouts, name) for name in TEXTS}
    words |= {STAGE_NAMES: rollouts.stage_names} if rollouts.stage_names else {}
    (folder / "rollouts.json").write_text(json.dumps(words))


def load_rollouts(folder: Path) -> Rollouts:
    """The inverse of `save_rollouts`."""
    from safetensors.numpy import load_file

    arrays = load_file(folder / "rollouts.safetensors")
    words = json.loads((folder / "rollouts.json").read_text())
    return Rollouts(**{"paths": None, **arrays, **words, STAGE_NAMES: tuple(words.get(STAGE_NAMES, ()))})

"""A trained policy of a benchmark in its data set's simulator, and the files of what happened.

What belongs here: from a task and a folder of weights to `Rollouts`, one a training seed. What does not: the loop itself
(`rollout`), success rates and their intervals (`statistics.closed_loop`), what there was to see (`scene_files`).
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np

from pipeline.errors import NotApplicableError
from pipeline.folds import PolicyTask, load_fold
from pipeline.normalize import circular_columns
from pipeline.safety import tighter
from pipeline.simulate import simulator_for
from pipeline.simulate.rollout import SCENES, rollout
from pipeline.simulate.scene_files import save_scenes
from pipeline.types import ACTION, Execution, Rollouts

TEXTS = ("simulator", "simulator_version", "policy", "observations")
STAGE_NAMES, EXECUTION, SEED = "stage_names", "execution", "seed"


def roll_out(
    task: PolicyTask,
    trained: Path,
    on_frame: Callable[[int, int], None] | None = None,
    *,
    seeds: int | None = None,
    start_states: Sequence[int] | None = None,
    execution: Execution | None = None,
) -> list[Rollouts]:
    """The first training seeds of fold 0, each from the same start states; how many of both, and how chunks are carried out,
    is as the settings say unless told otherwise. What is not trained is rolled out once.

    `on_frame` is called with (frames done, frames at most), over all seeds.

    Raises:
        NotApplicableError: the data set has no simulator, or policies like this one cannot be asked in it.
        PolicyError: the policy cannot be loaded, or its answers cannot be carried out.
        ConfigError: its chunks cannot be carried out like that.
    """
    name = task.experiment.dataset.simulator
    if name is None:
        raise NotApplicableError("no simulator for this data set")
    if not task.variant.is_rolled_out:
        raise NotApplicableError("of the baselines only hold_still is rolled out")
    simulator = simulator_for(name, task.demos, task.observation_set)
    policy = load_fold(task, trained, 0)
    fold = task.split.folds[0]
    chosen = task.seeds[: task.experiment.rollout_seeds if seeds is None else seeds]
    return [
        rollout(
            policy.one_seed(position) if task.variant.is_trained else policy,
            simulator,
            task.observation_set,
            task.experiment.start_states if start_states is None else start_states,
            name=task.variant.name,
            seed=seed,
            history=task.windows(fold.test, fold).history,
            execution=execution or task.policy.execution,
            limits=tighter(simulator.limits(), task.experiment.dataset.safety, task.demos.features[ACTION]),
            circular=circular_columns(task.demos, task.semantics, [ACTION]),
            scenes=SCENES if position == 0 else 0,
            on_frame=on_frame and _counting_from(on_frame, position, len(chosen)),
        )
        for position, seed in enumerate(chosen)
    ]


def _counting_from(on_frame: Callable[[int, int], None], position: int, seeds: int) -> Callable[[int, int], None]:
    return lambda done, total: on_frame(position * total + done, seeds * total)


def save_rollouts(rollouts: Sequence[Rollouts], folder: Path) -> None:
    """The roll-outs of one policy, a folder `seed_0`, … each."""
    for one in rollouts:
        place = folder / f"seed_{one.seed}"
        place.mkdir()
        _save(one, place)


def load_rollouts(folder: Path) -> list[Rollouts]:
    """The inverse of `save_rollouts`, by seed, without scenes (`scene_files.load_scenes`)."""
    return sorted((_load(place) for place in folder.glob("seed_*")), key=lambda one: one.seed)


def _save(rollouts: Rollouts, folder: Path) -> None:
    """Arrays as safetensors, words as JSON."""
    from safetensors.numpy import save_file

    words_of = (*TEXTS, STAGE_NAMES, EXECUTION, SEED, "scenes")
    arrays = {f.name: getattr(rollouts, f.name) for f in fields(rollouts) if f.name not in words_of}
    present = {name: np.ascontiguousarray(array) for name, array in arrays.items() if array is not None}
    save_file(present, folder / "rollouts.safetensors")
    words = {name: getattr(rollouts, name) for name in (*TEXTS, SEED)} | {EXECUTION: asdict(rollouts.execution)}
    words |= {STAGE_NAMES: rollouts.stage_names} if rollouts.stage_names else {}
    (folder / "rollouts.json").write_text(json.dumps(words))
    if rollouts.scenes is not None:
        save_scenes(rollouts.scenes, folder)


def _load(folder: Path) -> Rollouts:
    """The inverse of `_save`."""
    from safetensors.numpy import load_file

    arrays = load_file(folder / "rollouts.safetensors")
    words = json.loads((folder / "rollouts.json").read_text())
    read = {STAGE_NAMES: tuple(words.get(STAGE_NAMES, ())), EXECUTION: Execution(**words.get(EXECUTION, {}))}
    return Rollouts(**{"paths": None, **arrays, **words, **read})

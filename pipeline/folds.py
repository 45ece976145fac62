"""One policy with one observation set over every fold of a split: training, then predictions on what was held out.

What belongs here: the loop over folds and where each fold's files are. What does not: how a policy learns (`train`), what
its errors mean (`statistics`).
"""

import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.config import PolicyConfig
from pipeline.errors import PolicyError
from pipeline.experiment import NO_BUDGET, Experiment, Variant
from pipeline.lerobot_format.quality import dead_columns
from pipeline.methods import METHODS, is_own
from pipeline.split import make_split
from pipeline.store import drafted_folder
from pipeline.types import ACTION, Demonstrations, Fold, ObservationSet, Predictions, Semantics, Split
from pipeline.windows import Windows, make_windows

if TYPE_CHECKING:
    from pipeline.train import Trained


@dataclass(frozen=True)
class PolicyTask:
    """Everything that training and scoring one policy need."""

    demos: Demonstrations
    semantics: Semantics
    split: Split
    observation_set: ObservationSet
    variant: Variant
    experiment: Experiment

    @property
    def horizons(self) -> int:
        """How many steps ahead the policy is scored: its chunk, or all that any policy here is scored on."""
        if self.variant.chunk is not None:
            return self.variant.chunk
        return max(self.experiment.largest_chunk, round(self.demos.fps) + 1)

    @property
    def seeds(self) -> tuple[int, ...]:
        return tuple(range(self.experiment.seeds)) if self.variant.is_trained else (0,)

    @property
    def policy(self) -> PolicyConfig:
        """What the configuration says of it; of predictions made elsewhere it says nothing."""
        return self.experiment.policies.get(self.variant.family) or PolicyConfig(method=self.variant.method)

    @property
    def steps(self) -> int | None:
        """Training steps; None where CPU-seconds decide."""
        if not self.variant.is_trained:
            return 0
        return None if self.policy.cpu_seconds is not None else self.policy.steps or self.experiment.steps

    @property
    def training(self) -> dict[str, Any]:
        """What `train_policy` is told beside windows."""
        return {
            "seeds": self.seeds,
            "steps": self.steps,
            "cpu_seconds": self.policy.cpu_seconds,
            "threads": self.experiment.threads,
            "device": self.experiment.device,
            "settings": self.policy.settings,
            "given": self.policy.view,
        }

    def with_steps(self, steps: int) -> "PolicyTask":
        """The same task with a budget in steps, such as CPU-seconds once came to."""
        policy = self.policy.model_copy(update=NO_BUDGET | {"steps": steps})
        policies = {**self.experiment.policies, self.variant.family: policy}
        return replace(self, experiment=self.experiment.model_copy(update={"policies": policies}))

    def windows(self, episodes: Iterable[int], fold: Fold) -> Windows:
        """The anchors of some episodes, normalised by what this fold may learn from."""
        method = METHODS[self.variant.method]
        return make_windows(
            self.demos,
            self.semantics,
            self.observation_set,
            tuple(episodes),
            statistics_episodes=fold.train,
            protocol=self.experiment.protocol,
            history=self.experiment.history,
            chunk=self.variant.chunk or 1,
            recipe=method.recipe,
            own_history=self.policy.history or self.observation_set.history if method.uses_observations else None,
        )


def split_of(experiment: Experiment, demos: Demonstrations) -> Split:
    """The folds that an experiment's settings give these demonstrations."""
    return make_split(
        demos,
        protocol=experiment.protocol,
        folds=experiment.folds,
        test_share=experiment.test_share,
        seed=experiment.split_seed,
        has_simulator=experiment.dataset.simulator is not None,
    )


def train_fold(
    task: PolicyTask,
    fold: Fold,
    *,
    checkpoint: Path | None = None,
    recorded: Path | None = None,
    on_step: Callable[[int, int, float], None] | None = None,
) -> "Trained":
    """Train on the episodes of one fold; `checkpoint`, `recorded` and `on_step` as for `train_policy`."""
    from pipeline.train import train_policy

    return train_policy(
        task.variant.method,
        task.windows(fold.train, fold),
        checkpoint=checkpoint,
        recorded=recorded,
        on_step=on_step,
        **task.training,
    )


def predict_fold(task: PolicyTask, policy: Any, number: int, held_out: Windows) -> Predictions:
    """What the policy of fold `number` answers at the windows that it held out."""
    from pipeline.predict import predict_policy

    return predict_policy(
        policy,
        held_out,
        name=task.variant.name,
        observations=task.observation_set.name,
        fold=number,
        seeds=task.seeds,
        horizons=task.horizons,
    )


def train_folds(
    task: PolicyTask,
    folder: Path,
    unfinished: Path,
    on_step: Callable[[int, int, float], None] | None = None,
    recorded: Path | None = None,
) -> "list[Trained]":
    """Train on every fold; weights go to `folder/fold_0`, ….

    What a killed run leaves in `unfinished` (finished folds and a checkpoint) the next one goes on from.
    `on_step(done, total, loss)` counts the steps of all folds. `recorded` is the file that remembers how many steps a budget in
    CPU-seconds came to: they are those of the first fold for all, and of any later training of the same result.
    """
    from pipeline.train import load_trained, save_trained

    folds = task.split.folds
    results = []
    for number, fold in enumerate(folds):
        kept = unfinished / f"fold_{number}"
        if not kept.exists():
            trained = train_fold(
                task,
                fold,
                checkpoint=unfinished / "checkpoint.safetensors",
                on_step=None if on_step is None else _counting_from(on_step, number, len(folds)),
                recorded=recorded or unfinished / "steps.json",
            )
            with drafted_folder(kept) as draft:
                save_trained(trained, draft, _data_of(task))
        shutil.copytree(kept, folder / kept.name)
        results.append(load_trained(kept))
    return results


def _data_of(task: PolicyTask) -> dict[str, Any]:
    """What weights are of, kept beside them."""
    return {"data_set": task.demos.name, "content_hash": task.demos.content_hash, "split_hash": task.split.hash}


def load_fold(task: PolicyTask, trained: Path, number: int) -> Any:
    """The policy that was trained on one fold, from the folder that `train_folds` wrote to.

    Raises:
        PolicyError: it cannot be read, or is of another method, chunk or data set than the task.
    """
    from pipeline.train import load_trained

    folder, variant = trained / f"fold_{number}", task.variant
    found = load_trained(folder)
    data, own = found.trained_on.get("content_hash"), is_own(variant.method)
    differ = [
        ("method", found.method, variant.method, not own),
        ("chunk", found.policy.chunk, variant.chunk, variant.is_trained),
        ("data set (content hash)", str(data)[:12], task.demos.content_hash[:12], data is not None),
    ]
    for what, theirs, ours, matters in differ:
        if matters and theirs != ours:
            raise PolicyError(
                f"The weights in {folder} are not those of {variant.name} on '{task.demos.name}': their {what} is {theirs}, "
                f"expected {ours}. Somebody replaced them; remove {trained} and run the benchmark again."
            )
    return found.policy


def _counting_from(
    on_step: Callable[[int, int, float], None], fold: int, folds: int
) -> Callable[[int, int, float], None]:
    return lambda done, total, loss: on_step(fold * total + done, total * folds, loss)


def predict_folds(task: PolicyTask, trained: Path) -> tuple[Predictions, dict[str, Any]]:
    """Predictions at every held-out anchor, each from the fold that did not see it.

    Also returns `latency_ms` and `latency_p99_ms` of one call, and `windows_train` and `windows_test`, summed over folds.
    """
    from pipeline.predict import join_folds, latency_ms

    parts = []
    facts: dict[str, Any] = {"windows_train": 0, "windows_test": 0}
    for number, fold in enumerate(task.split.folds):
        policy = load_fold(task, trained, number)
        held_out = task.windows(fold.test, fold)
        parts.append(predict_fold(task, policy, number, held_out))
        facts["windows_train"] += len(task.windows(fold.train, fold))
        facts["windows_test"] += len(held_out)
        if not number:
            facts["latency_ms"], facts["latency_p99_ms"] = latency_ms(policy, held_out)
    return join_folds(parts), facts


def describe_windows(
    demos: Demonstrations, semantics: Semantics, split: Split, experiment: Experiment, variants: Iterable[Variant]
) -> dict[str, Any]:
    """How many windows each fold has for every chunk size, and what they would weigh if they were copied (JSON-able).

    `statistics_finite` and `dead_columns` are of the training statistics of all observation sets.
    """
    everything = ObservationSet("all", tuple(dict.fromkeys(f for s in experiment.observation_sets for f in s.features)))
    rows: list[dict[str, Any]] = []
    finite = True
    seen = set()
    for variant in variants:
        chunk, recipe = variant.chunk or 1, METHODS[variant.method].recipe
        if (chunk, recipe) in seen:
            continue
        seen.add((chunk, recipe))
        task = PolicyTask(demos, semantics, split, everything, variant, experiment)
        for number, fold in enumerate(split.folds):
            train, test = task.windows(fold.train, fold), task.windows(fold.test, fold)
            scalers = (train.normalizer.observations, train.normalizer.actions)
            finite &= all(np.isfinite(s.mean).all() and (s.scale > 0).all() for s in scalers)
            width = train.history * train.values.shape[1] + chunk * demos.columns[ACTION].shape[1]
            rows.append(
                {
                    "chunk": chunk,
                    "recipe": recipe,
                    "fold": number,
                    "train": len(train),
                    "test": len(test),
                    "copied_mb": round(len(train) * width * 4 / 1e6, 1),
                    "hash": train.hash(),
                }
            )
    return {"windows": rows, "statistics_finite": bool(finite), "dead_columns": _dead(demos, everything)}


def _dead(demos: Demonstrations, observation_set: ObservationSet) -> list[str]:
    found = []
    for key in (*observation_set.features, ACTION):
        feature = demos.features[key]
        dead = dead_columns(demos, key)
        found += [f"{key} {name}" for name, is_dead in zip(feature.names, dead, strict=True) if is_dead]
    return found

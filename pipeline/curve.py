"""Training on parts of the training episodes: what the learning curve is made from.

What belongs here: which subsets there are, and training and asking a policy on each. What does not: what the errors say
(`statistics.curve`), or where results lie (`store`).

Subsets are nested: the first n episodes of one seeded order of a fold's training episodes, so 10 contain 5. The held-out
episodes are the same for every size. With several folds each has one order; with one fold there are `ORDERS`, so that the
luck of the draw is seen.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.errors import ConfigError, NotApplicableError
from pipeline.experiment import Variant
from pipeline.folds import PolicyTask, predict_fold, train_fold
from pipeline.methods import METHODS
from pipeline.store import drafted
from pipeline.types import Fold, Predictions, Split

ORDERS = 3
"""Orders in which the training episodes are taken where there is one fold."""

FEWEST = 4
"""The smallest subset that is chosen by itself. With fewer than twice as many training episodes there is no curve."""

Keep = Callable[[PolicyTask, Predictions, Path], None]
"""Writes to a file what is wanted of one subset's predictions."""


@dataclass(frozen=True)
class Subset:
    """The first episodes of one order of a fold's training episodes (positions, sorted)."""

    fold: int
    order: int
    episodes: tuple[int, ...]

    @property
    def size(self) -> int:
        return len(self.episodes)

    @property
    def name(self) -> str:
        return f"fold_{self.fold}_order_{self.order}_episodes_{self.size:05d}"


def full_size(split: Split) -> int:
    """The training episodes of a fold: the smallest fold's, where they differ (by one)."""
    return min(len(fold.train) for fold in split.folds)


def orders_of(split: Split) -> int:
    return ORDERS if len(split.folds) == 1 else 1


def curve_sizes(split: Split, asked: Sequence[int] = ()) -> list[int]:
    """The subset sizes below the full one, ascending: those asked for, else about an eighth, a quarter and a half.

    Raises
    ------
    NotApplicableError : fewer than eight training episodes.
    ConfigError : a size is not between 1 and the training episodes, or no size is left below them.
    """
    full = full_size(split)
    if full < 2 * FEWEST:
        raise NotApplicableError(
            f"A learning curve needs at least {2 * FEWEST} training episodes, and here "
            f"{'every fold has' if len(split.folds) > 1 else 'there are'} {full}. Record more demonstrations, or hold "
            "fewer of them out (--folds)."
        )
    if not asked:
        return sorted({max(FEWEST, round(full / part)) for part in (8, 4, 2)})
    wrong = [size for size in asked if not 1 <= size <= full]
    if wrong:
        raise ConfigError(
            f"--sizes has {wrong[0]}, and there are {full} training episodes"
            f"{' in a fold' if len(split.folds) > 1 else ''}. Sizes lie between 1 and {full}; the full one is always there."
        )
    smaller = sorted({size for size in asked if size < full})
    if not smaller:
        raise ConfigError(
            f"--sizes has only {full}, all the training episodes. A curve needs a smaller size, for example {full // 2}."
        )
    return smaller


def require_learning(variant: Variant) -> None:
    """A curve makes sense for policies whose answers come from demonstrations: what was trained, and the nearest neighbour.

    Raises:
        NotApplicableError: the policy is another baseline.
    """
    if not METHODS[variant.method].uses_observations:
        raise NotApplicableError(
            f"'{variant.name}' is a baseline that does not learn what to do from what it sees: its error does not depend on "
            "the number of demonstrations. Name a policy that learns, for example --policy nearest_neighbour or a trained one."
        )


def nested_subsets(split: Split, sizes: Sequence[int]) -> list[Subset]:
    """Every subset to train on, small ones first. Drawn from episode numbers alone, seeded like the split."""
    found = []
    for size in sorted(sizes):
        for number, fold in enumerate(split.folds):
            for order in range(orders_of(split)):
                shuffled = np.random.default_rng([split.seed, number, order]).permutation(fold.train)
                found.append(Subset(number, order, tuple(sorted(shuffled[:size].tolist()))))
    return found


def subset_task(task: PolicyTask, subset: Subset) -> PolicyTask:
    """The same task with one fold's training episodes cut down; its held-out episodes stay."""
    folds = list(task.split.folds)
    folds[subset.fold] = Fold(subset.episodes, folds[subset.fold].test)
    return replace(task, split=Split(tuple(folds), task.split.seed, task.split.hash))


def train_subsets(
    task: PolicyTask,
    sizes: Sequence[int],
    kept: Path,
    keep: Keep,
    on_step: Callable[[int, int, str], None] | None = None,
) -> None:
    """Train on every subset and keep what `keep` writes of its predictions, as `kept/‹subset's name›.safetensors`.

    A subset whose file is there is not trained again, so a killed run goes on after the last finished one, and within one
    from its checkpoint. Every size gets the same number of steps, and is scaled by its own episodes alone (except under
    `notebook`, whose statistics come from all). `on_step(done, total, words)` counts the steps of all subsets.
    """
    kept.mkdir(parents=True, exist_ok=True)
    subsets = nested_subsets(task.split, sizes)
    steps = task.steps or 1
    for number, subset in enumerate(subsets):
        report = None if on_step is None else _counting(on_step, subset, number * steps, len(subsets) * steps)
        path = kept / f"{subset.name}.safetensors"
        if not path.exists():
            part = subset_task(task, subset)
            predictions = predict_subset(part, subset, kept / "checkpoint.safetensors", report)
            with drafted(path) as draft:
                keep(part, predictions, draft)
        if report is not None:
            report(steps, steps, float("nan"))
    (kept / "checkpoint.safetensors").unlink(missing_ok=True)


def _counting(
    on_step: Callable[[int, int, str], None], subset: Subset, before: int, total: int
) -> Callable[[int, int, float], None]:
    def report(done: int, _: int, loss: float) -> None:
        words = f"{subset.size} episodes" + (f", loss {loss:.4g}" if loss == loss else "")
        on_step(before + done, total, words)

    return report


def predict_subset(
    task: PolicyTask, subset: Subset, checkpoint: Path, on_step: Callable[[int, int, float], None] | None = None
) -> Predictions:
    """Train on one subset (`task` is its `subset_task`) and predict at the held-out anchors of its fold."""
    fold = task.split.folds[subset.fold]
    trained = train_fold(task, fold, checkpoint=checkpoint, on_step=on_step)
    return predict_fold(task, trained.policy, subset.fold, task.windows(fold.test, fold))

"""The regression gate where the truth is known: how often it alarms at nothing, and how often it sees a fifth.

What belongs here: drawing data, training cheap policies twice, asking the gate. What does not: the gate
(`statistics.regression`). Not a part of the published suite: its records depend on nothing here.

Every repeat records new demonstrations. A stored result and a new one come from the same method, the new one trained with
fresh seeds and, with `resampled`, on training episodes drawn anew with replacement.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.split import make_split
from pipeline.statistics.known_truth.generators import GENERATORS
from pipeline.statistics.known_truth.studies import train_and_score
from pipeline.statistics.regression import compare_with_before
from pipeline.statistics.success import clopper_pearson
from pipeline.types import ACTION, STATE, Demonstrations, EpisodeErrors, Split

RISE = 1.2
NEIGHBOURS = 8


@dataclass(frozen=True)
class Setting:
    """What is drawn: `policy` of POLICIES on `episodes` of a generator, in five folds, so that every episode is held out."""

    policy: str
    generator: str
    episodes: int
    seeds: int
    resampled: bool

    @property
    def words(self) -> str:
        moves = "fresh seeds and resampled episodes" if self.resampled else "fresh seeds"
        return f"{self.policy}, {self.generator}, {self.episodes} episodes, {self.seeds} seeds, {moves}"


def mean_of_neighbours(
    demos: Demonstrations, split: Split, random: np.random.Generator, seeds: int, resampled: bool
) -> np.ndarray:
    """[S, E] as `train_and_score`: the mean action of the nearest frames among half of the training frames, drawn by the seed."""
    from scipy.spatial import cKDTree

    inputs, actions = (demos.columns[key].astype(np.float64) for key in (STATE, ACTION))
    frames = [np.arange(*demos.episode_starts[e : e + 2]) for e in range(demos.episodes)]
    errors = np.full((seeds, demos.episodes), np.nan)
    for fold in split.folds:
        train = random.choice(fold.train, len(fold.train)) if resampled else fold.train
        rows = np.concatenate([frames[e] for e in train])
        scaled = (inputs - inputs[rows].mean(axis=0)) / inputs[rows].std(axis=0)
        asked = np.concatenate([frames[e] for e in fold.test])
        for seed in range(seeds):
            half = random.permutation(rows)[: len(rows) // 2]
            near = cKDTree(scaled[half]).query(scaled[asked], NEIGHBOURS)[1]
            error = np.abs(actions[half][near].mean(axis=1) - actions[asked]).mean(axis=1)
            ends = np.cumsum([0, *(len(frames[e]) for e in fold.test)])
            for e, start, end in zip(fold.test, ends, ends[1:], strict=False):
                errors[seed, e] = error[start:end].mean()
    return errors[:, sorted(e for fold in split.folds for e in fold.test)]


POLICIES: Mapping[str, Callable[..., np.ndarray]] = {"ridge": train_and_score, "neighbours": mean_of_neighbours}

SETTINGS = (
    Setting("ridge", "arm", 50, 5, True),
    Setting("neighbours", "arm", 50, 5, True),
    Setting("ridge", "arm", 50, 2, True),
    Setting("ridge", "coin", 50, 5, True),
    Setting("neighbours", "arm", 50, 5, False),
    Setting("ridge", "arm", 20, 5, True),
)
"""The null that moves, from the usual to few seeds and few episodes."""


def study_gate(
    setting: Setting, repeats: Sequence[int], gate: Callable[..., object] = compare_with_before
) -> dict[str, list[bool]]:
    """For each repeat: `alarm`, the gate calls the new result worse though nothing changed; `seen`, it does so when the new
    result's errors are raised by a fifth."""
    found: dict[str, list[bool]] = {"alarm": [], "seen": []}
    for repeat in repeats:
        demos = GENERATORS[setting.generator].build(setting.episodes, repeat).demos
        random = np.random.default_rng([repeat, setting.seeds, setting.resampled, 3])
        split = make_split(demos, protocol="strict", folds=5, test_share=0.2, seed=repeat, has_simulator=False)
        train = POLICIES[setting.policy]
        before, now = (
            _as_errors(train(demos, split, random, setting.seeds, setting.resampled), split) for _ in range(2)
        )
        risen = replace(now, absolute=RISE * now.absolute)
        for name, result in (("alarm", now), ("seen", risen)):
            found[name].append(gate(result, before, "strict", is_trained=True).word == "worse")
    return found


def _as_errors(errors: np.ndarray, split: Split) -> EpisodeErrors:
    """Means [S, E] as the errors of a policy with one action column, one anchor an episode."""
    pairs = sorted((e, f) for f, fold in enumerate(split.folds) for e in fold.test)
    episodes, fold = (np.array(column) for column in zip(*pairs, strict=True))
    one = np.ones((len(episodes), 1), np.int64)
    absolute = errors[:, :, None, None]
    return EpisodeErrors(episodes, fold, one, absolute, absolute**2, errors[:, :, None], one.astype(np.float64))


def rate(found: Sequence[bool]) -> tuple[float, float, float]:
    """A share with its exact 95 % interval."""
    low, high = clopper_pearson(sum(found), len(found))
    return sum(found) / len(found), low, high

"""Which episodes train and which are held out. The unit is the episode: its frames are never on both sides.

What belongs here: drawing folds, and naming them by a hash. What does not: windows, statistics, anything that looks at
a value. Episodes are drawn from their number alone, so a split cannot depend on what was recorded.
"""

import hashlib
import json
from pathlib import Path
from typing import Literal

import numpy as np

from pipeline.errors import ConfigError, NotApplicableError
from pipeline.types import Demonstrations, Fold, Protocol, Split

SMALL = 100
"""Below this many episodes `folds = "auto"` holds every episode out once."""

AUTO_FOLDS = 5
NOTEBOOK_SHARE = 0.8


def make_split(
    demos: Demonstrations,
    *,
    protocol: Protocol,
    folds: int | Literal["auto"],
    test_share: float,
    seed: int,
    has_simulator: bool,
) -> Split:
    """Divide the episodes into folds of training and held-out episodes.

    Parameters
    ----------
    protocol : `notebook` has one fold, the first `int(0.8 · E)` episodes train; what follows is not used.
    folds : how many; `"auto"` is one from 100 episodes on and where there is a simulator, else five (fewer where
        there are fewer episodes).
    test_share : the share of episodes held out when there is one fold; at least one episode on each side.

    Raises
    ------
    NotApplicableError : fewer than two episodes.
    ConfigError : more folds than episodes.
    """
    episodes = demos.episodes
    if episodes < 2:
        raise NotApplicableError(
            f"The data set '{demos.name}' has {episodes} episode{'s' * (episodes != 1)}. A benchmark needs two: "
            "one to train on and one to hold out. Record more demonstrations."
        )
    if protocol == "notebook":
        boundary = max(1, int(NOTEBOOK_SHARE * episodes))
        drawn = [Fold(tuple(range(boundary)), tuple(range(boundary, episodes)))]
    else:
        count = _fold_count(demos, folds, has_simulator)
        drawn = _draw(episodes, count, test_share, seed)
    return Split(tuple(drawn), seed, _hash(demos.content_hash, drawn))


def _fold_count(demos: Demonstrations, folds: int | Literal["auto"], has_simulator: bool) -> int:
    if folds == "auto":
        return 1 if has_simulator or demos.episodes >= SMALL else min(AUTO_FOLDS, demos.episodes)
    if folds > demos.episodes:
        raise ConfigError(
            f"folds = {folds}, but the data set '{demos.name}' has {demos.episodes} episodes, and every fold must hold "
            f"out at least one. Ask for at most {demos.episodes} folds."
        )
    return folds


def _draw(episodes: int, folds: int, test_share: float, seed: int) -> list[Fold]:
    shuffled = np.random.default_rng(seed).permutation(episodes)
    if folds == 1:
        held_out = min(max(1, round(test_share * episodes)), episodes - 1)
        tests = [shuffled[:held_out]]
    else:
        tests = np.array_split(shuffled, folds)
    everything = set(range(episodes))
    return [Fold(tuple(sorted(everything - set(test.tolist()))), tuple(sorted(test.tolist()))) for test in tests]


def _hash(content_hash: str, folds: list[Fold]) -> str:
    described = {"content": content_hash, "folds": [[fold.train, fold.test] for fold in folds]}
    return hashlib.sha256(json.dumps(described, sort_keys=True).encode()).hexdigest()


def save_split(split: Split, path: Path) -> None:
    """Write a split as JSON."""
    folds = [{"train": fold.train, "test": fold.test} for fold in split.folds]
    path.write_text(json.dumps({"seed": split.seed, "hash": split.hash, "folds": folds}, indent=1), encoding="utf-8")


def load_split(path: Path) -> Split:
    """The inverse of `save_split`."""
    stored = json.loads(path.read_text(encoding="utf-8"))
    folds = tuple(Fold(tuple(fold["train"]), tuple(fold["test"])) for fold in stored["folds"])
    return Split(folds, stored["seed"], stored["hash"])

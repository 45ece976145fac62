"""What a policy was trained on: a split of ours, a plain list of episodes, or the configuration of LeRobot's trainer.

What belongs here: reading those files (untrusted), and which episodes of a file of predictions were held out. What does not:
scores.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import ConfigError, printable
from pipeline.types import Demonstrations

LARGEST = 20_000_000
"""Bytes: a list of a million episodes is a third of it."""
LEROBOT_FILE = "train_config.json"
EVERY_FOLD = "all"


@dataclass(frozen=True)
class Training:
    """The recorded `episode_index` numbers that each network was trained on.

    episodes  fold → numbers, or one entry `all` for networks that share them; None under `all`: every episode there is
    tests     fold → the numbers it holds out, where a split says so: they tell an episode's fold if the predictions do not
    words     where this was read from
    """

    episodes: Mapping[int | str, tuple[int, ...] | None]
    tests: Mapping[int, tuple[int, ...]]
    words: str

    @property
    def by_fold(self) -> bool:
        return EVERY_FOLD not in self.episodes

    def identity(self) -> dict[str, Any]:
        """What a score depends on, as JSON."""
        return {str(fold): None if of is None else sorted(of) for fold, of in self.episodes.items()}


def lerobot_training_file(checkpoint: Path) -> Path | None:
    """LeRobot's train_config.json beside the weights of a checkpoint (or of a run's last one), or None."""
    inside = ("", "pretrained_model", "checkpoints/last/pretrained_model")
    places = (checkpoint / folder / LEROBOT_FILE for folder in inside)
    return next((place for place in places if place.is_file()), None)


def read_training(path: Path | None, demos: Demonstrations) -> Training | None:
    """Read what a policy was trained on; without a file nothing is known.

    Raises:
        ConfigError: the file is none of the three, is of other data, or names episodes that the data set lacks.
    """
    if path is None:
        return None
    value = _read_json(path)
    if isinstance(value, list):
        found = Training({EVERY_FOLD: _numbers(value, path, "the list")}, {}, f"{path.name}, a list of episodes")
    elif isinstance(value, dict) and isinstance(value.get("folds"), list):
        found = _of_split(value, path, demos)
    elif isinstance(value, dict) and isinstance(value.get("dataset"), dict) and "episodes" in value["dataset"]:
        found = _of_lerobot(value["dataset"], path)
    else:
        raise ConfigError(
            f"{path} does not say which episodes a policy was trained on. Expected what `demobench split --format json` writes, a "
            f"JSON list of episode_index numbers, or LeRobot's {LEROBOT_FILE}."
        )
    _check_known(found, path, demos)
    return found


def _read_json(path: Path) -> Any:
    try:
        if path.stat().st_size > LARGEST:
            raise ConfigError(f"{path} has {path.stat().st_size:,} bytes; a list of episodes has at most {LARGEST:,}.")
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}, named by --trained-on, cannot be read: {error.strerror}.") from None
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}, named by --trained-on, is not JSON: {error}.") from None


def _numbers(value: Any, path: Path, where: str) -> tuple[int, ...]:
    good = isinstance(value, list) and all(type(n) is int and 0 <= n < 2**62 for n in value)
    if not good:
        raise ConfigError(f"{path}: {where} must be a list of episode_index numbers, for example [0, 1, 4].")
    return tuple(value)


def _of_split(value: Mapping[str, Any], path: Path, demos: Demonstrations) -> Training:
    """A split as `demobench split --format json` writes it, whole or with the one fold that trained."""
    if value.get("content_hash") not in (None, demos.content_hash):
        raise ConfigError(
            f"{path} is a split of other data: its content hash is {str(value['content_hash'])[:12]}, that of '{demos.name}' is "
            f"{demos.content_hash[:12]}. Make it again with: demobench split {demos.name} --format json"
        )
    folds = value["folds"]
    if not folds or not all(isinstance(fold, dict) and {"train", "test"} <= set(fold) for fold in folds):
        raise ConfigError(f"{path}: folds must be a list of objects with train and test.")
    train = {k: _numbers(fold["train"], path, f"train of fold {k}") for k, fold in enumerate(folds)}
    test = {k: _numbers(fold["test"], path, f"test of fold {k}") for k, fold in enumerate(folds)}
    chosen = value.get("fold", 0 if len(folds) == 1 else None)
    if chosen is None:
        return Training(train, test, f"{path.name}, a split of {len(folds)} folds")
    if type(chosen) is not int or chosen not in train:
        raise ConfigError(f"{path}: fold is {chosen!r}, and there are folds 0 to {len(folds) - 1}.")
    return Training({EVERY_FOLD: train[chosen]}, {}, f"{path.name}, fold {chosen} of {len(folds)}")


def _of_lerobot(dataset: Mapping[str, Any], path: Path) -> Training:
    """The `dataset` of LeRobot's train_config.json; no list of episodes means all of them."""
    episodes = dataset["episodes"]
    named = printable(str(dataset.get("repo_id") or dataset.get("root") or "a data set that it does not name"))[:200]
    words = f"{path.name} (trained on {named})"
    return Training({EVERY_FOLD: None if episodes is None else _numbers(episodes, path, "dataset.episodes")}, {}, words)


def _check_known(training: Training, path: Path, demos: Demonstrations) -> None:
    """Episodes that the configuration leaves out may be named; others mean that the list is of another data set."""
    known = {*demos.episode_ids.tolist(), *getattr(demos, "excluded", ())}
    for numbers in training.episodes.values():
        strange = sorted(set(numbers or ()) - known)
        if strange:
            raise ConfigError(
                f"{path} says that episode {strange[0]} was trained on, and '{demos.name}' has no such episode (it has "
                f"{demos.episode_ids.min()} to {demos.episode_ids.max()}). Is the list of another data set?"
            )


@dataclass(frozen=True)
class HeldOut:
    """Which of the covered episodes are scored, and what is known of the training.

    episodes    positions that are scored, ascending
    fold        [E] the fold of each, 0 throughout where one training serves all
    train       the positions that each fold was trained on; where unknown, what is not scored
    seen        True: all of them were trained on; False: none; None: nothing is known
    words       the same for people
    """

    episodes: np.ndarray
    fold: np.ndarray
    train: tuple[tuple[int, ...], ...]
    seen: bool | None
    words: str


def held_out_of(
    covered: Sequence[int], fold_column: np.ndarray | None, training: Training | None, demos: Demonstrations
) -> HeldOut:
    """Which covered episodes count, by what the policy was trained on.

    Parameters
    ----------
    covered : positions of the episodes that the predictions cover, ascending.
    fold_column : [len(covered)] the `fold` that the predictions give each, or None.

    Raises
    ------
    ConfigError : the folds of the predictions are not those of the training.
    """
    covered = np.asarray(covered, np.int64)
    fold = _folds(covered, fold_column, training, demos)
    if training is None:
        words = "nothing is known about the episodes it was trained on, so its error may be too small; name them with --trained-on"
        return _held(covered, fold, {}, None, words, demos)
    trained = {number: _positions(training, number, demos) for number in np.unique(fold).tolist()}
    seen = np.array([episode in trained[number] for episode, number in zip(covered, fold, strict=True)])
    if seen.all():
        words = f"seen in training: it was trained on all {len(covered)} episodes that it predicts ({training.words})"
        return _held(covered, fold, trained, True, words, demos)
    left_out = f"; {seen.sum()} more were predicted but trained on, and are left out" if seen.any() else ""
    words = f"{(~seen).sum()} episodes that it was not trained on ({training.words}){left_out}"
    return _held(covered[~seen], fold[~seen], trained, False, words, demos)


def _folds(
    covered: np.ndarray, column: np.ndarray | None, training: Training | None, demos: Demonstrations
) -> np.ndarray:
    """[len(covered)] which training each episode's network had."""
    if training is None or not training.by_fold:
        return np.zeros(len(covered), np.int64) if column is None else column
    known = set(training.episodes)
    if column is not None:
        if strange := sorted(set(column.tolist()) - known):
            raise ConfigError(
                f"The predictions have fold {strange[0]}, and {training.words} has folds 0 to {max(known)}. Give each row the "
                "fold of the network that predicted it, or leave the column out."
            )
        return column
    holds_out = {episode: fold for fold, tests in training.tests.items() for episode in tests}
    found = []
    for number in demos.episode_ids[covered].tolist():
        if number not in holds_out:
            raise ConfigError(
                f"The predictions cover episode {number}, which no fold of {training.words} holds out, so nobody can tell which "
                "network predicted it. Add a column `fold`, or name the one fold with: demobench split … --fold K"
            )
        found.append(holds_out[number])
    return np.array(found, np.int64)


def _positions(training: Training, fold: int, demos: Demonstrations) -> set[int]:
    numbers = training.episodes[fold if training.by_fold else EVERY_FOLD]
    if numbers is None:
        return set(range(demos.episodes))
    return set(np.flatnonzero(np.isin(demos.episode_ids, numbers)).tolist())


def _held(
    episodes: np.ndarray, fold: np.ndarray, trained: Mapping[int, set[int]], seen: bool | None, words: str, demos
) -> HeldOut:
    """Folds are numbered from 0; a fold whose training is unknown or empty counts what it does not predict, else everything."""
    used, row = np.unique(fold, return_inverse=True)
    train = []
    for number in used.tolist():
        rest = trained.get(number) or set(range(demos.episodes)) - set(episodes[fold == number].tolist())
        train.append(tuple(sorted(rest or range(demos.episodes))))
    return HeldOut(episodes, row.astype(np.int64), tuple(train), seen, words)

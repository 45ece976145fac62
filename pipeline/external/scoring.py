"""A file of predictions, scored like a policy of ours: same anchors, same errors, same intervals.

What belongs here: from the file to `Predictions`, errors and metrics. What does not: reading it (`reading`), finding faults
(`checks`), comparing it (`pairing`).
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import DatasetError
from pipeline.experiment import Experiment, Variant
from pipeline.external.anchors import require_strict
from pipeline.external.checks import check_alignment, mean_of
from pipeline.external.reading import Answers, read_answers
from pipeline.external.training import HeldOut, Training, held_out_of
from pipeline.folds import PolicyTask
from pipeline.methods import EXTERNAL
from pipeline.normalize import circular_columns
from pipeline.sampling import score_draws
from pipeline.statistics.metrics import Score, score_task
from pipeline.types import ACTION, Demonstrations, Fold, Predictions, Semantics, Split
from pipeline.windows import Windows

ELSEWHERE = "elsewhere"
"""The observation set of a row that does not say what its policy sees."""


@dataclass(frozen=True)
class Scored:
    """Predictions from elsewhere with their score.

    task       as a policy of ours would have had it
    held_out   which episodes are scored, and what is known of the training
    samples    scores of the samples at every step (JSON-able), None where there is one
    warnings   what looks wrong without keeping them from being scored
    """

    task: PolicyTask
    predictions: Predictions
    score: Score
    held_out: HeldOut
    samples: dict[str, Any] | None
    warnings: tuple[str, ...]

    def summary(self, demos: Demonstrations) -> dict[str, Any]:
        """What a table needs to know of it besides its errors (JSON-able)."""
        return {
            "metrics": self.score.metrics,
            "chunk": int(self.predictions.actions.shape[2]),
            "seeds": len(self.predictions.seeds),
            "windows_train": None,
            "windows_test": len(self.predictions.anchors),
            "latency_ms": None,
            "latency_p99_ms": None,
            "seen_in_training": self.held_out.seen,
            "training": self.held_out.words,
            "episodes": demos.episode_ids[self.held_out.episodes].tolist(),
            "samples": self.samples,
            "warnings": list(self.warnings),
        }


@dataclass(frozen=True)
class Admitted:
    """A file of predictions that was read and found aligned with what was recorded; `warnings` as in `Scored`.

    actions  [S, M, K, A] those of the answers, of several samples their mean
    """

    answers: Answers
    actions: np.ndarray
    held_out: HeldOut
    warnings: tuple[str, ...]


def admit_file(
    path: Path, *, training: Training | None, demos: Demonstrations, semantics: Semantics, experiment: Experiment
) -> Admitted:
    """Read and check a file of predictions: all that can be wrong with it, before anything is worked out.

    Raises
    ------
    DatasetError : the file cannot be read, or is not aligned with what was recorded.
    ConfigError : its folds are not those of the training.
    NotApplicableError : the protocol is not `strict`.
    """
    require_strict(experiment.protocol)
    answers = read_answers(path, demos, experiment.history)
    circular = circular_columns(demos, semantics, [ACTION])
    actions = answers.actions[:, 0] if answers.actions.shape[1] == 1 else mean_of(answers.actions, circular, (1,))
    faults = check_alignment(answers.anchors, mean_of(actions, circular, (0,)), demos, semantics)
    if faults.refuse:
        raise DatasetError(f"{path}: {'; '.join(faults.refuse)}.")
    held_out = held_out_of(answers.covered, answers.fold, training, demos)
    return Admitted(answers, actions, held_out, (*answers.notes, *faults.warn))


def score_file(
    path: Path,
    *,
    name: str,
    observations: str | None,
    training: Training | None,
    demos: Demonstrations,
    semantics: Semantics,
    split: Split,
    experiment: Experiment,
) -> Scored:
    """Read, check and score a file of predictions.

    Raises
    ------
    DatasetError, ConfigError, NotApplicableError : as `admit_file`.
    """
    admitted = admit_file(path, training=training, demos=demos, semantics=semantics, experiment=experiment)
    answers, held_out = admitted.answers, admitted.held_out
    keep = np.isin(demos.episode_of_frame[answers.anchors], held_out.episodes)
    anchors = answers.anchors[keep]
    at = np.searchsorted(held_out.episodes, demos.episode_of_frame[anchors])
    label = observations or ELSEWHERE
    predictions = Predictions(name, label, answers.seeds, anchors, held_out.fold[at], admitted.actions[:, keep])
    task = _task(name, predictions, held_out, demos, semantics, split, experiment)
    score, samples = score_task(task, predictions), _score_samples(task, answers)
    return Scored(task, predictions, score, held_out, samples, admitted.warnings)


def _task(
    name: str, predictions: Predictions, held_out: HeldOut, demos: Demonstrations, semantics: Semantics, split: Split,
    experiment: Experiment,
) -> PolicyTask:  # fmt: skip
    """The predictions as a policy of ours would have made them: a fold for each training, the scored episodes held out."""
    folds = [
        Fold(train, tuple(held_out.episodes[held_out.fold == number].tolist()))
        for number, train in enumerate(held_out.train)
    ]
    variant = Variant(name, name, EXTERNAL, int(predictions.actions.shape[2]))
    sets = {observation_set.name: observation_set for observation_set in experiment.observation_sets}
    # Which set it is decides nothing here; hold-still, which is scored beside it, needs one.
    seen = sets.get(predictions.observations) or replace(experiment.observation_sets[0], name=ELSEWHERE)
    return PolicyTask(demos, semantics, Split(tuple(folds), split.seed, split.hash), seen, variant, experiment)


def _score_samples(task: PolicyTask, answers: Answers) -> dict[str, Any] | None:
    """The scores of the samples at every step of the chunk, at all anchors that are scored; None where there is one sample."""
    count = answers.actions.shape[1]
    if count == 1:
        return None

    def draw(windows: Windows, at: np.ndarray) -> np.ndarray:
        return answers.actions[:, :, np.searchsorted(answers.anchors, windows.anchors[at])]

    return score_draws(task, lambda fold: draw, count=count)

"""Offline scores of one trained network that might say how it does in closed loop: errors over more or less of what it predicts.

What belongs here: from predictions on held-out episodes (and samples, where a policy draws) to one number a score and seed, and
which frames are near contact. What does not: whether a score predicts anything (`statistics.agreement`), roll-outs (`simulate`).

All are of fold 0, which is the fold that is rolled out, and as everywhere under `strict` an episode counts once. Errors are in
the action's own unit where its columns share one, else in deviations of the training actions (columns that do not move are left
out): degrees and per cent of a gripper have no mean.

    whole_chunk_mae   |error| over all horizons h < K. Grows with K whatever the policy is worth: not comparable between chunks
    executed_mae      |error| over the actions of a chunk that are carried out, as in the roll-outs; of a temporal ensemble the
                      error of what it averages
    energy            the fair energy score (Gneiting & Raftery 2007) of those actions as one vector, divided by the root of how
                      many there are. A policy that does not draw is a point mass, whose energy score is the length of its
                      error; so both kinds stand on one scale
    near_contact_mae  executed_mae at the anchors near contact alone (`near_contact`)
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.execution import USUAL
from pipeline.folds import PolicyTask, load_fold
from pipeline.lerobot_format.kinds import wrap
from pipeline.predict import temporal_ensemble
from pipeline.sampling import ANCHORS, ASKED, SAMPLES
from pipeline.statistics.distributions import score_samples
from pipeline.statistics.metrics import circular_actions, episode_errors, estimate, span_means
from pipeline.types import ACTION, Demonstrations, EpisodeErrors, Execution, Predictions, Semantics

SCORES = {
    "whole_chunk_mae": "whole-chunk error",
    "executed_mae": "error over the executed actions",
    "energy": "energy score of the executed actions",
    "near_contact_mae": "error near contact",
}
"""Score → what it is called, the plain one first."""

OBJECT = "observation.environment_state"
"""The feature that says where the objects are."""
AHEAD, BACK = USUAL, 3
"""Frames after and before an anchor in which an object that moves puts it near contact: the actions that are usually carried
out of one answer, and as many frames as are usually seen. The same for every policy, so that all are scored on the same anchors."""
MOVED, NOISES = 0.01, 6.0
"""An object has moved where a column has changed by more than 1 % of its deviation and more than six deviations of its noise."""

Draw = Callable[[np.ndarray], np.ndarray]
"""Samples [S, n, B, K, A] at anchors [B]."""


def offline_scores(
    task: PolicyTask, predictions: Predictions, execution: Execution, near: np.ndarray | None, draw: Draw | None
) -> dict[str, np.ndarray]:
    """Score → [S], one a seed of the predictions; NaN where a seed has no targets.

    Parameters
    ----------
    predictions : of all folds; those of fold 0 are scored.
    execution : how its chunks were carried out, `execute` known.
    near : [N] bool from `near_contact`; None leaves that score out.
    draw : where samples come from; None: the policy does not draw.
    """
    first = _at(predictions, np.asarray(predictions.fold) == 0)
    done = _carried_out(task, first, execution)
    unit = _unit(task, first)
    scores = {
        "whole_chunk_mae": _mae(task, first, unit),
        "executed_mae": _mae(task, done, unit),
        "energy": _energy(task, done, execution, draw, unit),
    }
    if near is not None:
        scores["near_contact_mae"] = _mae(task, _at(done, near[done.anchors]), unit)
    return scores


def drawing(task: PolicyTask, trained: Path) -> Draw | None:
    """How the policy of fold 0 is asked for samples at anchors; None where it does not draw."""
    policy = load_fold(task, trained, 0)
    if not hasattr(policy, "sample"):
        return None
    fold = task.split.folds[0]
    held_out = task.windows(fold.test, fold)

    def draw(anchors: np.ndarray) -> np.ndarray:
        return policy.sample(held_out.observations(np.searchsorted(held_out.anchors, anchors)), SAMPLES)

    return draw


def _at(predictions: Predictions, keep: np.ndarray) -> Predictions:
    """The predictions at some of the anchors, a mask [M] or positions."""
    parts = {name: np.asarray(getattr(predictions, name))[keep] for name in ("anchors", "fold")}
    return replace(predictions, **parts, actions=np.asarray(predictions.actions)[:, keep])


def _carried_out(task: PolicyTask, predictions: Predictions, execution: Execution) -> Predictions:
    """Only the actions that are carried out: those from the delay on, `execute` of them, or what an ensemble makes of all.

    The anchors are those of the first action that is left.
    """
    actions, anchors, delay = predictions.actions[:, :, execution.delay :], predictions.anchors, execution.delay
    if execution.ensemble:
        circular = circular_actions(task.demos, task.semantics, task.experiment.protocol)
        actions = temporal_ensemble(actions, anchors, task.demos.episode_starts, circular=circular)[:, :, None]
    later = replace(predictions, actions=actions[:, :, : execution.execute], anchors=anchors + delay)
    starts = task.demos.episode_starts
    ends = starts[np.searchsorted(starts, anchors, side="right")]
    return _at(later, later.anchors < ends)


def _unit(task: PolicyTask, predictions: Predictions) -> np.ndarray:
    """[A] what errors are divided by: 1 where all action columns share a unit, else the training deviation (NaN: left out)."""
    scale = _errors(task, predictions).scale[0]
    return np.ones_like(scale) if len(set(task.demos.features[ACTION].units)) == 1 else scale


def _errors(task: PolicyTask, predictions: Predictions) -> EpisodeErrors:
    return episode_errors(predictions, task.demos, task.semantics, task.split, protocol=task.experiment.protocol)


def _mae(task: PolicyTask, predictions: Predictions, unit: np.ndarray) -> np.ndarray:
    """[S] the mean absolute error over the horizons that the predictions hold and the columns that have a unit."""
    live = np.isfinite(unit)
    if not len(predictions.anchors) or not live.any():
        return np.full(len(predictions.actions), np.nan)
    errors = _errors(task, predictions)
    values, counts = span_means(errors, errors.absolute[..., live] / unit[live], slice(None))
    return np.array([estimate(one[None], counts, task.experiment.protocol) for one in values.mean(axis=2)])


def _energy(
    task: PolicyTask, done: Predictions, execution: Execution, draw: Draw | None, unit: np.ndarray
) -> np.ndarray:
    """[S] the energy score of what is carried out, at up to 512 anchors evenly over what is held out.

    Of a temporal ensemble, whose action is an average over answers, that of the average: a point mass.
    """
    demos, circular = task.demos, circular_actions(task.demos, task.semantics, task.experiment.protocol)
    some = np.unique(np.linspace(0, len(done.anchors) - 1, min(ANCHORS, len(done.anchors))).round().astype(np.int64))
    done = _at(done, some)
    frames = done.anchors[:, None] + np.arange(done.actions.shape[2])
    episode = demos.episode_of_frame[done.anchors]
    inside = frames < demos.episode_starts[episode + 1][:, None]
    recorded = demos.columns[ACTION][np.where(inside, frames, 0)]
    blocks = []
    for start in range(0, len(some), ASKED):
        block = slice(start, start + ASKED)
        if draw is None or execution.ensemble:
            samples = done.actions[:, None, block]
        else:
            asked = draw(done.anchors[block] - execution.delay)
            samples = asked[:, :, :, execution.delay : execution.delay + done.actions.shape[2]]
        blocks.append(energy_of_span(samples, recorded[block], inside[block], circular=circular, scale=unit))
    energy = np.concatenate(blocks, axis=1)
    _, row = np.unique(episode, return_inverse=True)
    return np.array([np.mean(np.bincount(row, one) / np.bincount(row)) for one in energy])


def energy_of_span(
    samples: np.ndarray, recorded: np.ndarray, inside: np.ndarray, *, circular: np.ndarray, scale: np.ndarray
) -> np.ndarray:
    """[S, M] the energy score of a span of actions as one vector, over the root of the number of its frames.

    Parameters
    ----------
    samples : [S, n, M, K, A]; one sample is a point mass, whose score is the length of its error.
    recorded, inside : [M, K, A], and [M, K] bool: False past the end of an episode, where nothing counts.
    circular, scale : [A], as for `score_samples`.
    """
    frames = recorded.shape[1]
    there = np.where(inside[..., None], recorded, 0.0).reshape(len(recorded), -1)
    drawn = np.where(inside[..., None], samples, 0.0).reshape(*samples.shape[:3], -1)
    if drawn.shape[1] == 1:
        drawn = np.repeat(drawn, 2, axis=1)  # two equal draws: a point mass
    scores = score_samples(drawn, there, circular=np.tile(circular, frames), scale=np.tile(scale, frames))
    return scores.energy / np.sqrt(inside.sum(axis=1))


# Near contact ---------------------------------------------------------------------------------------------------------


def near_contact(demos: Demonstrations, semantics: Semantics) -> np.ndarray | str:
    """[N] bool: frames around which an object moves; or why that cannot be said.

    A frame is near contact where an object (a column of `observation.environment_state`) is elsewhere than now within the next 8
    frames of its episode, or was within the last 3. "Elsewhere" is, column by column and in its own unit, a change of more than
    1 % of the column's deviation over the data set (on `pusht_sim` about 0.6 px and 1°, on `so101_sim` 0.3 to 0.9 mm), so that
    rounding and a block that settles do not count, and of more than six deviations of its noise, for poses that a camera
    estimates. The noise is read off second differences (Gasser, Sroka & Jennen-Steinmetz 1986): smooth motion hardly has any.
    """
    if OBJECT not in demos.columns:
        return f"the data set does not say where its objects are (no {OBJECT})"
    poses = demos.columns[OBJECT].astype(np.float64)
    circular = np.asarray(semantics.circular.get(OBJECT, (False,) * poses.shape[1]))
    least = np.maximum(MOVED * poses.std(axis=0), NOISES * _noise(demos, poses, circular))
    first = np.repeat(demos.episode_starts[:-1], demos.lengths)
    last = np.repeat(demos.episode_starts[1:], demos.lengths) - 1
    now = np.arange(demos.frames)
    near = np.zeros(demos.frames, bool)
    for apart in (*range(-BACK, 0), *range(1, AHEAD + 1)):
        there = np.clip(now + apart, first, last)
        near |= (np.abs(_change(poses[there], poses, circular)) > least).any(axis=1)
    return near if near.any() else f"no object of the data set ever moves ({OBJECT})"


def _noise(demos: Demonstrations, poses: np.ndarray, circular: np.ndarray) -> np.ndarray:
    """[D] the deviation of white noise on each column: of a second difference it makes √6 of it."""
    inner = np.flatnonzero(
        (demos.frame_in_episode > 0) & (demos.frame_in_episode < np.repeat(demos.lengths, demos.lengths) - 1)
    )
    if not len(inner):
        return np.zeros(poses.shape[1])
    second = _change(poses[inner + 1], poses[inner], circular) - _change(poses[inner], poses[inner - 1], circular)
    return np.median(np.abs(second), axis=0) / (0.6745 * np.sqrt(6))


def _change(a: np.ndarray, b: np.ndarray, circular: np.ndarray) -> np.ndarray:
    change = a - b
    change[..., circular] = wrap(change[..., circular])
    return change

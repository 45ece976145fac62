"""From predictions to errors on held-out episodes.

What belongs here: comparing predicted with recorded actions, and summing within episodes and across them. What does
not: intervals (`intervals`), floors (`floors`), the table.

Under `strict` a metric is the mean over episodes of each episode's mean, averaged over seeds: an episode counts once.
Under `notebook` it is the mean over frames.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.folds import PolicyTask
from pipeline.lerobot_format.kinds import wrap
from pipeline.lerobot_format.quality import dead_columns
from pipeline.methods import METHODS
from pipeline.normalize import circular_columns, frames_of
from pipeline.policies import Plan
from pipeline.predict import join_folds, predict_policy, temporal_ensemble
from pipeline.statistics.intervals import Mean, estimate_mean
from pipeline.types import ACTION, Demonstrations, EpisodeErrors, Predictions, Protocol, Semantics, Split


def episode_errors(
    predictions: Predictions, demos: Demonstrations, semantics: Semantics, split: Split, *, protocol: Protocol
) -> EpisodeErrors:
    """Sum the errors of predictions within each held-out episode, for every seed, horizon and action column.

    A prediction for a frame past the end of its episode counts nowhere. Errors of angles are wrapped (`strict`).
    """
    recorded = demos.columns[ACTION]
    starts = demos.episode_starts
    of_anchor = np.searchsorted(starts, predictions.anchors, side="right") - 1
    episodes, row = np.unique(of_anchor, return_inverse=True)
    fold = np.zeros(len(episodes), np.int64)
    fold[row] = predictions.fold
    seeds, _, horizons, columns = predictions.actions.shape
    anchors = np.zeros((len(episodes), horizons), np.int64)
    absolute = np.zeros((seeds, len(episodes), horizons, columns))
    squared, l2 = np.zeros_like(absolute), np.zeros((seeds, len(episodes), horizons))
    circular = circular_actions(demos, semantics, protocol)
    for horizon in range(horizons):
        inside = np.flatnonzero(predictions.anchors + horizon < starts[of_anchor + 1])
        target = recorded[predictions.anchors[inside] + horizon].astype(np.float64)
        error = predictions.actions[:, inside, horizon] - target
        error[..., circular] = wrap(error[..., circular])
        to_episode = row[inside]
        anchors[:, horizon] = np.bincount(to_episode, minlength=len(episodes))
        for seed in range(seeds):
            absolute[seed, :, horizon] = _sum_by(to_episode, np.abs(error[seed]), len(episodes))
            squared[seed, :, horizon] = _sum_by(to_episode, error[seed] ** 2, len(episodes))
            norm = np.sqrt((error[seed] ** 2).sum(axis=1))
            l2[seed, :, horizon] = np.bincount(to_episode, norm, minlength=len(episodes))
    return EpisodeErrors(episodes, fold, anchors, absolute, squared, l2, _scales(demos, split, fold, circular))


def circular_actions(demos: Demonstrations, semantics: Semantics, protocol: Protocol) -> np.ndarray:
    """[A] bool: the action columns whose errors are wrapped; the notebook wraps none."""
    return circular_columns(demos, semantics, [ACTION]) & (protocol == "strict")


def _sum_by(group: np.ndarray, values: np.ndarray, groups: int) -> np.ndarray:
    """[G, A] sums of `values` [n, A] within each group."""
    return np.stack([np.bincount(group, column, minlength=groups) for column in values.T], axis=1)


def _scales(demos: Demonstrations, split: Split, fold: np.ndarray, circular: np.ndarray) -> np.ndarray:
    """[E, A] the deviation of the training actions of each episode's fold; NaN for columns that do not move."""
    scales = {}
    for number in np.unique(fold):
        frames = frames_of(demos, split.folds[number].train)
        actions = demos.columns[ACTION][frames]
        deviation = actions.std(axis=0, dtype=np.float64)
        if circular.any():
            angles = actions[:, circular].astype(np.float64)
            middle = np.arctan2(np.sin(angles).mean(axis=0), np.cos(angles).mean(axis=0))
            deviation[circular] = np.sqrt((wrap(angles - middle) ** 2).mean(axis=0))
        deviation[dead_columns(demos, ACTION, frames)] = np.nan
        scales[number] = deviation
    return np.stack([scales[number] for number in fold])


def estimate(values: np.ndarray, counts: np.ndarray, protocol: Protocol) -> float:
    """What a protocol estimates, from episode means `values` [S, E] over `counts` [E] targets; NaN without targets."""
    use = counts > 0
    if not use.any() or np.isnan(values[:, use]).any():
        return float("nan")
    weights = counts[use] if protocol == "notebook" else None
    return float(np.average(values[:, use].mean(axis=0), weights=weights))


def summarise(errors: EpisodeErrors, *, protocol: Protocol, fps: float, chunk: int | None) -> dict[str, Any]:
    """Every metric of one policy with one observation set, and intervals over episodes.

    Parameters
    ----------
    chunk : K, or None for a policy without one: `whole_chunk_*` is None there, as is `at_one_second_*` where
        K ≤ round(fps).

    Returns
    -------
    dict : `first_step_mae|rmse|l2`, `at_one_second_mae|rmse`, `whole_chunk_mae|rmse`, `scaled` (floats or None),
        `error_by_horizon`, `rmse_by_horizon` [H], `error_by_joint`, `scaled_by_joint` [A] (NaN where dead),
        `interval`, a dict of metric → (low, high) or None, and `interval_method`, "bootstrap-t", "t" or None.
    """
    second = round(fps)
    reached = errors.anchors.shape[1]
    spans = {"first_step": slice(0, 1), "at_one_second": slice(second, second + 1), "whole_chunk": slice(0, chunk)}
    if second >= reached or not errors.anchors[:, second].any():
        del spans["at_one_second"]
    if chunk is None:
        del spans["whole_chunk"]
    optional = ("at_one_second", "whole_chunk")
    found: dict[str, Any] = {f"{name}_{kind}": None for name in optional for kind in ("mae", "rmse")}
    means: dict[str, Mean] = {}
    for name, span in spans.items():
        absolute, counts = span_means(errors, errors.absolute, span)
        squared, _ = span_means(errors, errors.squared, span)
        found[f"{name}_mae"] = estimate(absolute.mean(axis=2), counts, protocol)
        found[f"{name}_rmse"] = float(np.sqrt(estimate(squared.mean(axis=2), counts, protocol)))
        means[f"{name}_mae"] = _mean(absolute.mean(axis=2), counts, errors.fold, protocol)
    l2, counts = span_means(errors, errors.l2[..., None], slice(0, 1))
    found["first_step_l2"] = estimate(l2[..., 0], counts, protocol)
    means["first_step_l2"] = _mean(l2[..., 0], counts, errors.fold, protocol)
    return found | _by_joint(errors, protocol) | _by_horizon(errors, protocol) | _intervals(means, optional)


def span_means(errors: EpisodeErrors, sums: np.ndarray, span: slice) -> tuple[np.ndarray, np.ndarray]:
    """[S, E, A] each episode's mean over the horizons of a span, and [E] how many targets that is.

    Each horizon that an episode reaches counts once, however many anchors reach it.
    """
    counts = errors.anchors[:, span]
    means = sums[:, :, span] / np.maximum(counts, 1)[None, :, :, None]
    reached = np.maximum((counts > 0).sum(axis=1), 1)
    return means.sum(axis=2) / reached[None, :, None], counts.sum(axis=1)


def _by_horizon(errors: EpisodeErrors, protocol: Protocol) -> dict[str, np.ndarray]:
    """The errors at each horizon [H], averaged over action columns."""
    counts = errors.anchors
    absolute = errors.absolute.mean(axis=3) / np.maximum(counts, 1)
    squared = errors.squared.mean(axis=3) / np.maximum(counts, 1)
    horizons = range(counts.shape[1])
    return {
        "error_by_horizon": np.array([estimate(absolute[:, :, h], counts[:, h], protocol) for h in horizons]),
        "rmse_by_horizon": np.sqrt([estimate(squared[:, :, h], counts[:, h], protocol) for h in horizons]),
    }


def _by_joint(errors: EpisodeErrors, protocol: Protocol) -> dict[str, Any]:
    """First-step errors of each action column [A], in its unit and in deviations of the training actions."""
    absolute, counts = span_means(errors, errors.absolute, slice(0, 1))
    columns = range(absolute.shape[2])
    scaled = absolute / errors.scale
    by_joint = np.array([estimate(scaled[:, :, a], counts, protocol) for a in columns])
    live = np.isfinite(by_joint)
    return {
        "error_by_joint": np.array([estimate(absolute[:, :, a], counts, protocol) for a in columns]),
        "scaled_by_joint": by_joint,
        "scaled": float(by_joint[live].mean()) if live.any() else None,
    }


def _mean(values: np.ndarray, counts: np.ndarray, fold: np.ndarray, protocol: Protocol) -> Mean:
    """What `estimate` gives, with its interval."""
    use = counts > 0
    return estimate_mean(values[:, use], counts[use] if protocol == "notebook" else None, fold[use])


def _intervals(means: dict[str, Mean], optional: tuple[str, ...]) -> dict[str, Any]:
    """The intervals of all metrics, None for those that a policy does not have, and how that of the first step was made."""
    missing = {f"{name}_mae": None for name in optional if f"{name}_mae" not in means}
    intervals = {name: mean.interval for name, mean in means.items()} | missing
    return {"interval": intervals, "interval_method": means["first_step_mae"].method}


@dataclass(frozen=True)
class Score:
    """One policy scored: errors by episode, all metrics (JSON-able, None where not applicable), and each seed's."""

    errors: EpisodeErrors
    metrics: dict[str, Any]
    seed_metrics: list[dict[str, Any]]


def score_task(task: PolicyTask, predictions: Predictions) -> Score:
    """Score the predictions of one policy, beside hold-still's on the same anchors.

    `vs_hold_still` is hold-still's first-step error over the policy's: above 1 the policy is better. Under `notebook`
    hold-still's is that of the chunk size 1 for every chunk size.
    """
    protocol, fps, chunk = task.experiment.protocol, task.demos.fps, task.variant.chunk
    errors = _errors_of(task, predictions)
    still = _errors_of(task, _hold_still(task, predictions.actions.shape[2]))
    metrics = summarise(errors, protocol=protocol, fps=fps, chunk=chunk)
    metrics["hold_still_by_horizon"] = _by_horizon(still, protocol)["error_by_horizon"]
    reference = metrics["hold_still_by_horizon"][0]
    if protocol == "notebook" and chunk not in (None, 1):
        single = replace(task, variant=replace(task.variant, chunk=1))
        reference = _by_horizon(_errors_of(task, _hold_still(single, 1)), protocol)["error_by_horizon"][0]
    metrics["vs_hold_still"] = reference / metrics["first_step_mae"] if metrics["first_step_mae"] > 0 else None
    metrics["ensembled_first_step_mae"] = _ensembled(task, predictions) if chunk and chunk > 1 else None
    names = task.demos.features[ACTION].names
    by_seed = [
        summarise(replace(errors, **_only(errors, seed)), protocol=protocol, fps=fps, chunk=chunk)
        for seed in range(len(predictions.seeds))
    ]
    return Score(errors, _plain(metrics, names), [_plain(values, names) for values in by_seed])


def _errors_of(task: PolicyTask, predictions: Predictions) -> EpisodeErrors:
    protocol = task.experiment.protocol
    return episode_errors(predictions, task.demos, task.semantics, task.split, protocol=protocol)


def _only(errors: EpisodeErrors, seed: int) -> dict[str, np.ndarray]:
    return {name: getattr(errors, name)[seed : seed + 1] for name in ("absolute", "squared", "l2")}


def _hold_still(task: PolicyTask, horizons: int) -> Predictions:
    """Hold-still at the task's own anchors."""
    hold_still = METHODS["hold_still"].load_class()
    parts = []
    for number, fold in enumerate(task.split.folds):
        policy, _ = hold_still.fit(task.windows(fold.train, fold), Plan((0,), 0))
        held_out = task.windows(fold.test, fold)
        name, observations = "hold_still", task.observation_set.name
        parts.append(
            predict_policy(policy, held_out, name=name, observations=observations, fold=number, horizons=horizons)
        )
    return join_folds(parts)


def _ensembled(task: PolicyTask, predictions: Predictions) -> float:
    """The first-step error when a policy is asked at every frame and its chunks are averaged."""
    protocol = task.experiment.protocol
    circular = circular_actions(task.demos, task.semantics, protocol)
    starts = task.demos.episode_starts
    averaged = temporal_ensemble(predictions.actions, predictions.anchors, starts, circular=circular)
    errors = _errors_of(task, replace(predictions, actions=averaged[:, :, None]))
    return _by_horizon(errors, protocol)["error_by_horizon"][0]


def _plain(metrics: dict[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    """Metrics as JSON knows them: lists, dicts by action name, None for what is not finite; dead columns left out."""
    plain: dict[str, Any] = {}
    for metric, value in metrics.items():
        if metric == "interval":
            plain[metric] = {name: None if pair is None else list(pair) for name, pair in value.items()}
        elif metric == "interval_method":
            plain[metric] = value
        elif metric == "error_by_joint":
            plain[metric] = {name: finite(number) for name, number in zip(names, value, strict=True)}
        elif metric == "scaled_by_joint":
            live = {name: finite(number) for name, number in zip(names, value, strict=True)}
            plain[metric] = {name: number for name, number in live.items() if number is not None}
        else:
            plain[metric] = [finite(v) for v in value] if isinstance(value, np.ndarray) else finite(value)
    return plain


def finite(value: float | None) -> float | None:
    """The number as a plain float, or None where it is none."""
    return None if value is None or not np.isfinite(value) else float(value)


def save_errors(errors: EpisodeErrors, path: Path) -> None:
    """Write errors to one safetensors file."""
    from safetensors.numpy import save_file

    save_file({name: np.ascontiguousarray(array) for name, array in vars(errors).items()}, path)


def load_errors(path: Path) -> EpisodeErrors:
    """The inverse of `save_errors`."""
    from safetensors.numpy import load_file

    return EpisodeErrors(**load_file(path))

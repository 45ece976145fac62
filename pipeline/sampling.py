"""How good are samples, of policies that draw or of a file? The fair energy score beside what their mean and one of them are off.

What belongs here: asking for samples at held-out anchors, and averaging scores within episodes and over them. What does not:
the scores themselves (`statistics.distributions`), drawing (`policies`), files (`external`).
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.folds import PolicyTask
from pipeline.statistics.distributions import score_samples
from pipeline.statistics.intervals import estimate_mean
from pipeline.statistics.metrics import circular_actions
from pipeline.types import ACTION, Demonstrations
from pipeline.windows import Windows

SAMPLES, ANCHORS, ASKED = 16, 512, 64
"""Of a policy: draws at each anchor, anchors of a fold (evenly over what is held out), and anchors asked at a time."""
BLOCK = 4096
"""Anchors at a time where the samples are there already."""

Draw = Callable[[Windows, np.ndarray], np.ndarray]
"""Samples [S, n, B, K, A] at some windows [B] of what a fold holds out."""


def sampled_scores(task: PolicyTask, trained: Path) -> dict[str, Any] | None:
    """Scores of the samples of a trained policy (`score_draws`); None where the policy does not sample."""
    from pipeline.train import load_trained

    def draw_of(fold: int) -> Draw | None:
        policy = load_trained(trained / f"fold_{fold}").policy
        if not hasattr(policy, "sample"):
            return None
        return lambda windows, at: policy.sample(windows.observations(at), SAMPLES)

    return score_draws(task, draw_of, count=SAMPLES, most=ANCHORS, block=ASKED)


def score_draws(
    task: PolicyTask,
    draw_of: Callable[[int], Draw | None],
    *,
    count: int,
    most: int | None = None,
    block: int = BLOCK,
) -> dict[str, Any] | None:
    """Scores of samples over every fold (JSON-able); None where a fold has none.

    `energy`, `of_mean` and `of_one` are of the first action, with intervals over episodes and seeds; under `at_one_second` one
    second ahead (None where the chunk is shorter), under `by_horizon` of each action of the chunk. Distances are Euclidean over
    action columns; where their units differ, in deviations.

    Parameters
    ----------
    draw_of : where a fold's `count` samples come from.
    most : anchors of a fold, evenly over what is held out; all of them if left out.
    block : anchors at a time.
    """
    circular = circular_actions(task.demos, task.semantics, task.experiment.protocol)
    parts, episodes, folds = [], [], []
    for number, fold in enumerate(task.split.folds):
        draw = draw_of(number)
        if draw is None:
            return None
        held_out = task.windows(fold.test, fold)
        at = np.unique(np.linspace(0, len(held_out) - 1, most or len(held_out)).round().astype(np.int64))
        parts.append(_scores(draw, held_out, at, block, circular))
        episodes.append(task.demos.episode_of_frame[held_out.anchors[at]])
        folds.append(np.full(len(at), number))
    scores = {name: np.concatenate([part[name] for part in parts], axis=2) for name in parts[0]}
    summary = _summarise(scores, np.concatenate(episodes), np.concatenate(folds), round(task.demos.fps))
    return {"count": count, "in_deviations": deviations(task.demos) is not None, **summary}


def _summarise(
    scores: Mapping[str, np.ndarray], episode: np.ndarray, fold: np.ndarray, one_second: int
) -> dict[str, Any]:
    """Scores [K, S, M] of samples at anchors of episodes [M] and folds [M], NaN where the episode has ended."""
    reached = [k for k in range(len(scores["energy"])) if not np.isnan(scores["energy"][k]).all()]

    def at(horizon: int) -> dict[str, Any]:
        return {name: of_episodes(values[horizon], episode, fold) for name, values in scores.items()}

    return {
        **at(0),
        "at_one_second": at(one_second) if one_second in reached else None,
        "by_horizon": {
            name: [float(_by_episode(values[k], episode, fold)[0].mean()) for k in reached]
            for name, values in scores.items()
        },
    }


def _scores(draw: Draw, windows: Windows, at: np.ndarray, size: int, circular: np.ndarray) -> dict[str, np.ndarray]:
    """Each score [K, S, M] at the anchors, NaN where the episode has ended."""
    found: dict[str, list[np.ndarray]] = {}
    recorded, inside = windows.targets(at)
    scale = deviations(windows.demos)
    for start in range(0, len(at), size):
        block = slice(start, start + size)
        samples = draw(windows, at[block])
        for horizon in range(samples.shape[3]):
            scores = score_samples(
                samples[:, :, :, horizon], recorded[block, horizon], circular=circular, scale=scale
            )  # fmt: skip
            for name, values in asdict(scores).items():
                found.setdefault(name, []).append(np.where(inside[block, horizon], values, np.nan))
    chunk = recorded.shape[1]
    return {
        name: np.stack([np.concatenate(parts[horizon::chunk], axis=1) for horizon in range(chunk)])
        for name, parts in found.items()
    }


def deviations(demos: Demonstrations) -> np.ndarray | None:
    """[A] what distances are measured in where the units of the action columns differ (NaN for columns that do not move)."""
    if len(set(demos.features[ACTION].units)) == 1:
        return None
    spread = demos.columns[ACTION].std(axis=0)
    return np.where(spread > 0, spread, np.nan)


def of_episodes(values: np.ndarray, episode: np.ndarray, fold: np.ndarray) -> dict[str, Any]:
    """The mean over episodes and seeds of scores [S, M], an episode counting once, with its interval (JSON-able)."""
    means, folds = _by_episode(values, episode, fold)
    mean = estimate_mean(means, fold=folds)
    return {"value": mean.value, "interval": None if mean.interval is None else list(mean.interval)}


def _by_episode(values: np.ndarray, episode: np.ndarray, fold: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[S, E] each episode's mean over what is not NaN, and the fold [E] that held it out."""
    there = ~np.isnan(values).any(axis=0)
    names, row = np.unique(episode[there], return_inverse=True)
    counts, folds = np.bincount(row), np.zeros(len(names), np.int64)
    folds[row] = fold[there]
    return np.stack([np.bincount(row, one[there], minlength=len(names)) / counts for one in values]), folds

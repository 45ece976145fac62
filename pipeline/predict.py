"""Ask fitted policies: at every held-out anchor, once for its latency, and as a temporal ensemble.

What belongs here: asking in blocks and putting answers together. What does not: judging them (`statistics`).
"""

import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import StoreError
from pipeline.types import ACTION, Predictions
from pipeline.windows import Windows

BLOCK = 2048
"""Anchors asked at a time."""
FEWEST = 20
"""Calls that a latency is measured on, at least."""

ARRAYS = ("anchors", "fold", "actions")
"""The arrays of `Predictions`, a file each."""


def predict_policy(
    policy: Any,
    windows: Windows,
    *,
    name: str,
    observations: str,
    fold: int,
    seeds: Sequence[int] | None = None,
    horizons: int = 1,
) -> Predictions:
    """What a policy answers at every anchor of held-out windows.

    Parameters
    ----------
    name, observations : what the predictions are filed under.
    seeds : which of the policy's seeds to keep, all by default; policies without seeds have the one seed 0.
    horizons : how many actions a policy without a chunk is asked for.
    """
    chunk = policy.chunk or horizons
    columns = windows.demos.columns[ACTION].shape[1]
    kept = _positions(policy, seeds)
    actions = np.empty((len(kept), len(windows), chunk, columns), np.float32)
    for start in range(0, len(windows), BLOCK):
        block = slice(start, start + BLOCK)
        actions[:, block] = policy.predict(windows.observations(block), horizons)[kept]
    folds = np.full(len(windows), fold, np.int64)
    return Predictions(name, observations, tuple(policy.seeds[k] for k in kept), windows.anchors, folds, actions)


def _positions(policy: Any, seeds: Sequence[int] | None) -> list[int]:
    if seeds is None or len(policy.seeds) == 1:
        return list(range(len(policy.seeds)))
    return [policy.seeds.index(seed) for seed in seeds]


def join_folds(parts: Sequence[Predictions]) -> Predictions:
    """The predictions of one policy, fold after fold."""
    return replace(
        parts[0],
        anchors=np.concatenate([part.anchors for part in parts]),
        fold=np.concatenate([part.fold for part in parts]),
        actions=np.concatenate([part.actions for part in parts], axis=1),
    )


def save_predictions(predictions: Predictions, folder: Path) -> None:
    """Write predictions into a folder: one .npy an array (the actions can be mapped), the rest as JSON."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in ARRAYS:
        np.save(folder / f"{name}.npy", getattr(predictions, name))
    described = {"policy": predictions.policy, "observations": predictions.observations, "seeds": predictions.seeds}
    (folder / "predictions.json").write_text(json.dumps(described))


def load_predictions(folder: Path) -> Predictions:
    """The inverse of `save_predictions`; the actions stay on disk until they are looked at.

    Raises:
        StoreError: something is missing or damaged.
    """
    try:
        described = json.loads((folder / "predictions.json").read_text())
        arrays = {name: np.load(folder / f"{name}.npy", mmap_mode="r", allow_pickle=False) for name in ARRAYS}
        described["seeds"] = tuple(described["seeds"])
        return Predictions(**described, **arrays)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StoreError(f"The predictions in {folder} cannot be read ({error}). Run the benchmark again.") from None


def latency_ms(policy: Any, windows: Windows, calls: int = 200, most_s: float = 3.0) -> tuple[float, float]:
    """The median and the 99th percentile of the time of one call with one observation, milliseconds, one network.

    Gathering the observation is not counted. A policy so slow that `calls` would take longer than `most_s` is called less often,
    at least 20 times.
    """
    alone = policy.one_seed(0) if hasattr(policy, "one_seed") else policy
    observation = windows.observations(slice(0, 1))
    alone.predict(observation)
    times: list[float] = []
    while len(times) < calls and (len(times) < FEWEST or sum(times) < most_s):
        began = time.perf_counter()
        alone.predict(observation)
        times.append(time.perf_counter() - began)
    median, late = np.percentile(times, [50, 99]) * 1e3
    return float(median), float(late)


MEMORY = 0.01
"""m of a temporal ensemble: answers weigh exp(−m · i), i = 0 for the oldest."""


def average_answers(answers: np.ndarray, circular: np.ndarray | None = None, m: float = MEMORY) -> np.ndarray:
    """[n, ..., A] what n answers, oldest first, say of one frame → [..., A] float32, as `temporal_ensemble` averages them."""
    weights = np.exp(-m * np.arange(len(answers)))
    weights /= weights.sum()
    plain = np.asarray(answers, np.float64)
    mean = np.tensordot(weights, plain, axes=1)
    if circular is not None and circular.any():
        angles = plain[..., circular]
        sine, cosine = (np.tensordot(weights, part, axes=1) for part in (np.sin(angles), np.cos(angles)))
        mean[..., circular] = np.arctan2(sine, cosine)
    return mean.astype(np.float32)


def temporal_ensemble(
    actions: np.ndarray,
    anchors: np.ndarray,
    episode_starts: np.ndarray,
    *,
    circular: np.ndarray | None = None,
    m: float = MEMORY,
) -> np.ndarray:
    """Average, at every anchor, all that was predicted for its frame there and before (ACT, Zhao et al. 2023).

    Weights are exp(−m · i), i = 0 for the oldest prediction, as in ACT's own code. A policy that runs this way is asked
    at every frame; predictions of another episode never enter.

    Parameters
    ----------
    actions : [S, M, K, A].
    anchors : [M] global frames, in any order.
    episode_starts : [E + 1].
    circular : [A] bool, columns that are averaged as directions.

    Returns
    -------
    [S, M, A] float32.
    """
    _, positions, chunk, columns = actions.shape
    circular = np.zeros(columns, bool) if circular is None else circular
    where = np.full(int(episode_starts[-1]) + 1, -1)
    where[anchors] = np.arange(positions)
    first = episode_starts[np.searchsorted(episode_starts, anchors, side="right") - 1]
    sine, cosine = np.zeros((2, len(actions), positions, columns))
    total = np.zeros(positions)
    older = np.zeros(positions)
    for back in reversed(range(chunk)):
        asked = anchors - back
        source = np.where(asked >= first, where[np.maximum(asked, 0)], -1)
        use = source >= 0
        weight = np.where(use, np.exp(-m * older), 0.0)
        answer = actions[:, source, back].astype(np.float64)
        sine += weight[:, None] * np.where(circular, np.sin(answer), answer)
        cosine += weight[:, None] * np.cos(answer) if circular.any() else 0.0
        total += weight
        older += use
    return np.where(circular, np.arctan2(sine, cosine), sine / total[:, None]).astype(np.float32)

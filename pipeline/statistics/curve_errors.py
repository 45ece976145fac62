"""The errors of a learning curve by size, and how sure a difference between sizes is.

What belongs here: means, and weighted sums over sizes with everything paired that the sizes share. What does not: what the
curve promises beyond the data (`curve`).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pipeline.statistics.intervals import FEWEST, Interval, estimate_mean, weights_of
from pipeline.statistics.metrics import estimate
from pipeline.types import Protocol


@dataclass(frozen=True)
class CurveErrors:
    """One metric at every size, on the same held-out episodes.

    sizes    K numbers of training episodes, ascending; the last is the benchmark's own
    values   K arrays [R, S, E]: each episode's mean error for each order of the training episodes and each seed
    fold     [E]
    counts   [E] how many targets each mean is over where every target counts once (`notebook`); None: every episode does
    trained  whether seeds change anything
    """

    sizes: tuple[int, ...]
    values: tuple[np.ndarray, ...]
    fold: np.ndarray
    counts: np.ndarray | None = None
    trained: bool = True

    @property
    def weights(self) -> np.ndarray:
        """[E] what each episode counts; their mean is one."""
        return weights_of(self.counts, len(self.fold))

    @cached_property
    def by_episode(self) -> np.ndarray:
        """[K, E] over orders and seeds."""
        return np.stack([values.mean(axis=(0, 1)) for values in self.values])

    @cached_property
    def by_fold(self) -> np.ndarray:
        """[K, F] over everything in a fold."""
        groups = [self.fold == fold for fold in np.unique(self.fold)]
        return np.stack([np.average(self.by_episode[:, g], axis=1, weights=self.weights[g]) for g in groups], axis=1)

    @cached_property
    def by_seed(self) -> np.ndarray:
        """[K, S] over orders and episodes."""
        return np.stack([np.average(v.mean(axis=0), axis=1, weights=self.weights) for v in self.values])

    @cached_property
    def by_order(self) -> np.ndarray:
        """[K, R] over seeds and episodes; zero at sizes with one order (the full one), which have no luck of the draw."""
        means = [np.average(v.mean(axis=1), axis=1, weights=self.weights) for v in self.values]
        orders = max(len(m) for m in means)
        return np.stack([m if len(m) == orders > 1 else np.zeros(orders) for m in means])


@dataclass(frozen=True)
class Point:
    """One size: the error, its 95 % interval (None where there is none), and the error of every single order (of every fold's
    order where there are folds)."""

    episodes: int
    error: float
    interval: Interval | None
    orders: tuple[float, ...]


def points(curve: CurveErrors) -> list[Point]:
    """The curve as it is drawn: a point a size. An interval is over held-out episodes, seeds and orders of that size."""
    protocol: Protocol = "strict" if curve.counts is None else "notebook"
    counts = np.ones(len(curve.fold)) if curve.counts is None else curve.counts
    found = []
    for size, values in zip(curve.sizes, curve.values, strict=True):
        rows = values.reshape(-1, values.shape[-1])
        if len(np.unique(curve.fold)) > 1:
            groups = [(values, curve.fold == fold) for fold in np.unique(curve.fold)]
        else:
            groups = [(order[None], np.ones(len(curve.fold), bool)) for order in values]
        mean = estimate_mean(rows, curve.counts, curve.fold)
        orders = tuple(estimate(v.reshape(-1, v.shape[-1])[:, g], counts[g], protocol) for v, g in groups)
        found.append(Point(size, estimate(rows, counts, protocol), mean.interval, orders))
    return found


@dataclass(frozen=True)
class Contrast:
    """A weighted sum of the errors at some sizes: its value and 95 % interval, and what its variance is made of."""

    value: float
    interval: Interval | None
    variances: Mapping[str, float]


def contrast(curve: CurveErrors, weights: Mapping[int, float], *, level: float = 0.95) -> Contrast:
    """Σ weight · error(size), paired over everything that the sizes have in common.

    With folds, each is one repetition with held-out episodes, an order and networks of its own: a t interval over folds. With
    one fold the variances over held-out episodes, over seeds and over orders are added, with Welch and Satterthwaite's degrees
    of freedom (Satterthwaite 1946). No interval below five held-out episodes, or where one fold was trained with one seed.
    """
    from scipy.special import stdtrit

    row = np.zeros(len(curve.sizes))
    for size, weight in weights.items():
        row[curve.sizes.index(size)] = weight
    by_episode = row @ curve.by_episode
    value = float(np.average(by_episode, weights=curve.weights))
    if curve.by_fold.shape[1] > 1:
        parts = {"folds": _between_folds(curve, row @ curve.by_fold)}
    else:
        parts = {"episodes": _of_ratio(curve.weights * (by_episode - value))}
        repeats = {"seeds": row @ curve.by_seed, "orders": row @ curve.by_order}
        parts |= {name: _of_mean(rows) for name, rows in repeats.items() if len(rows) > 1}
    variances = {name: variance for name, (variance, _) in parts.items()}
    total = sum(variances.values())
    unknown = len(by_episode) < FEWEST or ("folds" not in parts and curve.trained and "seeds" not in parts)
    if unknown or not np.isfinite(total):
        return Contrast(value, None, variances)
    freedom = total**2 / sum(v**2 / df for v, df in parts.values()) if total > 0 else 1.0
    half = float(stdtrit(freedom, (1 + level) / 2) * np.sqrt(total))
    return Contrast(value, (value - half, value + half), variances)


def _between_folds(curve: CurveErrors, means: np.ndarray) -> tuple[float, int]:
    """The variance of a mean from the folds' own means [F], and its degrees of freedom."""
    folds = np.unique(curve.fold)
    share = np.array([curve.weights[curve.fold == fold].sum() for fold in folds]) / curve.weights.sum()
    off = share * (means - share @ means)
    return float(len(folds) / (len(folds) - 1) * (off**2).sum()), len(folds) - 1


def _of_ratio(residual: np.ndarray) -> tuple[float, int]:
    """The variance of a mean over episodes from weighted residuals [E], and its degrees of freedom."""
    freedom = max(len(residual) - 1, 1)
    return float((residual**2).sum() / (len(residual) * freedom)), freedom


def _of_mean(rows: np.ndarray) -> tuple[float, int]:
    return float(np.var(rows, ddof=1) / len(rows)), len(rows) - 1

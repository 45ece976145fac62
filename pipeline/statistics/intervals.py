"""Means over held-out episodes and training seeds, and how sure they are, behind one function.

What belongs here: the two parts of a mean's uncertainty (which episodes were held out, which seeds were trained) and the
interval made of both. What does not: what is averaged (`metrics`), whether two policies differ (`comparisons`).

The model, for the error y of seed s on episode e within one fold (Searle, Casella & McCulloch 1992, ch. 4):

    y = mean + seed_s + episode_e + both_se,        variances σ²_seed, σ²_episode, σ²_both

The mean over all of them has the variance σ²_episode / E + σ²_both / (E S) + σ²_seed / S. The first two are what the
episodes' means over seeds vary by, so the episode part holds them both; the seed part is the third alone.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

FEWEST = 5
"""Below this many held-out episodes there is no interval."""
MOST_RESAMPLED = 2_000
"""Above this many episodes skewness no longer moves the interval, and t is the same for less."""
RESAMPLES = 1_999
"""One less than a round number, so that the 2.5th percentile is one of them (the 50th)."""

Interval = tuple[float, float]
Method = Literal["bootstrap-t", "t"]


@dataclass(frozen=True)
class Mean:
    """A mean over episodes and seeds, and how sure it is.

    interval    None below five episodes, or where a value is no number; `method` is None with it
    episode_se  the standard error on account of the episodes (NaN with one), σ²_both included
    seed_se     the same on account of the seeds, as far as the episode part does not hold it already; 0.0 with one seed
    seed_df     its degrees of freedom, folds × (seeds − 1)
    """

    value: float
    interval: Interval | None
    method: Method | None
    episode_se: float
    seed_se: float
    episodes: int
    seeds: int
    seed_df: int


@dataclass(frozen=True)
class EpisodePart:
    """The mean, its standard error over episodes, and how far an interval reaches below and above it (None: no interval)."""

    value: float
    se: float
    reach: tuple[float, float] | None
    method: Method | None


def estimate_mean(
    values: np.ndarray, counts: np.ndarray | None = None, fold: np.ndarray | None = None, *, level: float = 0.95
) -> Mean:
    """A mean of episode means over episodes and seeds, with its interval.

    The episode part is bootstrap-t over episodes (Efron & Tibshirani 1993, ch. 12.5), from five episodes on: t, which is
    narrower on so few, holds 88 % of skewed errors. The seed part is a t interval from a two-way decomposition. Side by
    side they are joined as the root of the sum of squares of how far each reaches (MOVER: Zou & Donner 2008). With several
    folds all of it is conditional on the folds.

    Parameters
    ----------
    values : [S, E] each episode's mean error for each seed; one seed: the interval is for that network alone.
    counts : [E] how many targets each mean is over. Given, the mean is over targets (Σ counts · value / Σ counts), a ratio
        estimator with linearised residuals (Cochran 1977, § 6.4). Left out, every episode counts once.
    fold : [E] the fold that held each episode out: seeds are nested in folds. Left out, one fold.
    level : the coverage claimed.
    """
    values = np.asarray(values, np.float64)
    seeds, episodes = values.shape
    if not episodes or not np.isfinite(values).all():
        return Mean(np.nan, None, None, np.nan, 0.0, episodes, seeds, 0)
    weights = weights_of(counts, episodes)
    part = episode_part(values.mean(axis=0), weights, level=level)
    seed_variance, seed_df = seed_part(values, weights, fold)
    seed_se = float(np.sqrt(seed_variance))
    interval = join(part, seed_se, seed_df, level=level)
    return Mean(part.value, interval, part.method, part.se, seed_se, episodes, seeds, seed_df)


def weights_of(counts: np.ndarray | None, episodes: int) -> np.ndarray:
    """[E] how much each episode counts, 1 on average."""
    return np.ones(episodes) if counts is None else np.asarray(counts, np.float64) / np.mean(counts)


def join(part: EpisodePart, seed_se: float, seed_df: float, *, level: float = 0.95) -> Interval | None:
    """The interval of an episode part and a seed part together."""
    if part.reach is None:
        return None
    seed_reach = t_quantile((1 + level) / 2, seed_df) * seed_se if seed_se > 0 else 0.0
    below, above = (float(np.hypot(reach, seed_reach)) for reach in part.reach)
    return part.value - below, part.value + above


def episode_part(of_episode: np.ndarray, weights: np.ndarray, *, level: float = 0.95) -> EpisodePart:
    """The mean of episode values [E] (averaged over seeds) with weights [E] that are 1 on average."""
    episodes = len(of_episode)
    value = float(np.average(of_episode, weights=weights))
    off = of_episode - value
    if episodes < 2:
        return EpisodePart(value, np.nan, None, None)
    if np.abs(off).max() <= 1e-12 * abs(value):
        off = np.zeros(episodes)
    se = float(np.sqrt(((weights * off) ** 2).sum() / (episodes * (episodes - 1))))
    if episodes < FEWEST:
        return EpisodePart(value, se, None, None)
    if episodes <= MOST_RESAMPLED:
        low, high = _ends(resampled_t(off, weights), level) if se > 0 else (0.0, 0.0)
        return EpisodePart(value, se, (se * high, -se * low), "bootstrap-t")
    quantile = t_quantile((1 + level) / 2, episodes - 1)
    return EpisodePart(value, se, (se * quantile, se * quantile), "t")


def resampled_t(off: np.ndarray, weights: np.ndarray, resamples: int = RESAMPLES) -> np.ndarray:
    """[B] t of resamples of episodes, ascending; `off` [E] is what each episode is above the weighted mean.

    All sums of a resample are one row of a matrix product. Where a resample has no variance (it drew equal episodes only)
    its t is without bounds; the 97.5 % quantile of t of two values, the widest there is, stands in as the limit.
    """
    episodes = len(off)
    off = off / np.abs(off).max()
    heavy = weights**2
    columns = np.stack([weights, weights * off, heavy, heavy * off, heavy * off**2], axis=1)
    total, moved, squares, cross, spread = (_resamples(episodes, resamples) @ columns / episodes).T
    mean = moved / np.maximum(total, 1e-300)
    variance = (spread - 2 * mean * cross + mean**2 * squares) / np.maximum(total, 1e-300) ** 2 / (episodes - 1)
    has_variance = variance > 1e-14
    limit = t_quantile(0.975, 1)
    t = np.sign(mean) * limit * (np.abs(mean) > 1e-12)
    t[has_variance] = np.clip(mean[has_variance] / np.sqrt(variance[has_variance]), -limit, limit)
    t.sort()
    return t


def _ends(t: np.ndarray, level: float) -> tuple[float, float]:
    """The lower and upper quantile that leave a share of 1 − level outside."""
    tail = max(1, round((len(t) + 1) * (1 - level) / 2))
    return min(0.0, float(t[tail - 1])), max(0.0, float(t[-tail]))


@lru_cache(maxsize=4)
def _resamples(episodes: int, resamples: int) -> np.ndarray:
    """[B, E] how often each resample drew each episode; the same for everybody, so that numbers repeat."""
    generator = np.random.default_rng(episodes)
    counts = generator.multinomial(episodes, np.full(episodes, 1 / episodes), size=resamples).astype(np.float64)
    counts.flags.writeable = False
    return counts


def seed_part(values: np.ndarray, weights: np.ndarray, fold: np.ndarray | None) -> tuple[float, int]:
    """The variance of a mean on account of its seeds, and the degrees of freedom it is known with; (0.0, 0) with one seed.

    Within a fold seeds and episodes are crossed: what the seeds' means vary by is σ²_seed + σ²_both / episodes, and the
    second is taken off. Across folds seeds are nested, and folds count by their episodes. A negative σ²_seed counts as
    zero. That errs on the safe side on average (what is cut off can only raise the estimate); the cost is intervals that
    are a little wide where seeds hardly differ.
    """
    seeds, episodes = values.shape
    if seeds < 2 or episodes < 2:
        return 0.0, 0
    row = np.zeros(episodes, int) if fold is None else np.unique(fold, return_inverse=True)[1]
    held = (row == np.arange(row.max() + 1)[:, None]).astype(np.float64)
    share = held @ weights / weights.sum()
    rest = values - values.mean(axis=0)
    rest -= (rest @ held.T / held.sum(axis=1))[:, row]
    df_both = (seeds - 1) * (episodes - len(held))
    both = (rest**2).sum() / df_both if df_both else 0.0
    between = ((values * weights) @ held.T / (held @ weights)).var(axis=0, ddof=1)
    own = held @ weights**2 / (held @ weights) ** 2
    seed_variance = max(0.0, float(share @ (between - both * own)))
    return seed_variance * _not_yet_counted(share, weights, row) / seeds, (seeds - 1) * len(held)


def _not_yet_counted(share: np.ndarray, weights: np.ndarray, row: np.ndarray) -> float:
    """Which part of σ²_seed / seeds the episode part does not hold: 1 with one fold, 0 with one episode a fold.

    The mean has Σ share² of it. But each fold has seeds of its own, so they make the folds' episodes differ, and the
    variance over all episodes has seen some of that: E (A_f − Σ share A)² = 1 − 2 share_f + Σ share².
    """
    episodes, all_of_it = len(row), (share**2).sum()
    seen = (weights**2 * (1 - 2 * share[row] + all_of_it)).sum() / (episodes * (episodes - 1))
    return max(0.0, float(all_of_it - seen))


def t_quantile(probability: float, df: float) -> float:
    """Student's t; df may be any positive number."""
    from scipy.special import stdtrit

    return float(stdtrit(df, probability))

"""Intervals for means over episodes, behind one function.

What belongs here: how sure a mean over held-out episodes is. What does not: what is averaged (`metrics`).
"""

import numpy as np

FEWEST = 5
"""Below this many held-out episodes there is no interval."""

Interval = tuple[float, float]


def mean_interval(values: np.ndarray, counts: np.ndarray | None = None, *, level: float = 0.95) -> Interval | None:
    """A t interval over episodes for a mean of episode means.

    Parameters
    ----------
    values : [S, E] each episode's mean error for each seed; seeds are averaged first: the interval is for these seeds.
    counts : [E] how many targets each mean is over. Given, the mean is over targets (Σ counts · value / Σ counts) and
        the interval that of a ratio estimator (Cochran 1977, § 6.4); left out, every episode counts once.
    level : the coverage claimed.

    Returns
    -------
    (low, high), or None below five episodes. With several folds it is conditional on them.
    """
    mean_of_seeds = np.asarray(values, np.float64).mean(axis=0)
    episodes = len(mean_of_seeds)
    if episodes < FEWEST or not np.isfinite(mean_of_seeds).all():
        return None
    from scipy.special import stdtrit

    weights = np.ones(episodes) if counts is None else np.asarray(counts, np.float64) / np.mean(counts)
    centre = float(np.average(mean_of_seeds, weights=weights))
    residual = weights * (mean_of_seeds - centre)
    deviation = np.sqrt((residual**2).sum() / (episodes * (episodes - 1)))
    half = float(stdtrit(episodes - 1, (1 + level) / 2) * deviation)
    return centre - half, centre + half

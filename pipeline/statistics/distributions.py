"""How good are the samples of a policy that predicts a distribution of actions?

What belongs here: scores of samples against the one action that was recorded. What does not: point predictions (`metrics`).

The score is the energy score (Gneiting & Raftery 2007, eq. 22): in expectation only the true distribution has the smallest.
The best of k samples is no such score, since wider predictions always win it, and is not offered.
"""

from dataclasses import dataclass

import numpy as np

from pipeline.lerobot_format.kinds import wrap


@dataclass(frozen=True)
class SampleScores:
    """What samples are worth at each anchor; distances are Euclidean over action columns, all lower-is-better.

    energy    [S, M] the fair energy score
    of_mean   [S, M] the distance of the mean sample from what was recorded
    of_one    [S, M] the distance to expect of one sample, which is what a policy that acts on one risks
    """

    energy: np.ndarray
    of_mean: np.ndarray
    of_one: np.ndarray


def score_samples(
    samples: np.ndarray, recorded: np.ndarray, *, circular: np.ndarray | None = None, scale: np.ndarray | None = None
) -> SampleScores:
    """Score samples against recorded actions.

    energy = E|x − y| − ½ E|x − x′|, with the second mean over pairs of two different samples: fair, which is to say that
    its expectation does not depend on how many samples there are (Ferro 2014).

    Parameters
    ----------
    samples : [S, n, M, A] n samples of each seed at each anchor.
    recorded : [M, A].
    circular : [A] bool, columns in radians whose differences are wrapped to (−π, π].
    scale : [A] what the columns are divided by where their units differ; NaN leaves a column out (it does not move).

    Raises
    ------
    ValueError : fewer than two samples, or shapes that do not fit.
    """
    samples, recorded = np.asarray(samples, np.float64), np.asarray(recorded, np.float64)
    if samples.ndim != 4 or samples.shape[1] < 2 or samples.shape[2:] != recorded.shape:
        raise ValueError(
            f"samples [S, n, M, A] with n ≥ 2 must fit recorded [M, A], not {samples.shape}, {recorded.shape}"
        )
    columns = recorded.shape[1]
    circular = np.zeros(columns, bool) if circular is None else np.asarray(circular)
    live = np.ones(columns, bool) if scale is None else np.isfinite(scale)
    unit = np.ones(columns) if scale is None else np.asarray(scale, np.float64)
    samples, recorded, circular, unit = samples[..., live], recorded[:, live], circular[live], unit[live]

    def distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        apart = a - b
        apart[..., circular] = wrap(apart[..., circular])
        return np.sqrt(((apart / unit) ** 2).sum(axis=-1))

    of_one = distance(samples, recorded).mean(axis=1)
    count = samples.shape[1]
    # Turning the samples by 1 … n − 1 places meets every ordered pair once, with one copy of the samples in memory.
    pairs = sum(distance(samples, np.roll(samples, turn, axis=1)).sum(axis=1) for turn in range(1, count))
    energy = of_one - pairs / (2 * count * (count - 1))
    return SampleScores(energy, distance(_mean(samples, circular), recorded), of_one)


def _mean(samples: np.ndarray, circular: np.ndarray) -> np.ndarray:
    """[S, M, A] the mean over samples; of angles the direction of the mean of their unit vectors."""
    mean = samples.mean(axis=1)
    angles = samples[..., circular]
    mean[..., circular] = np.arctan2(np.sin(angles).mean(axis=1), np.cos(angles).mean(axis=1))
    return mean

"""Success rates of closed-loop trials. What does not belong here: running trials (`simulate`)."""

from typing import Any

import numpy as np

from pipeline.types import Rollouts


def clopper_pearson(successes: int, trials: int, *, level: float = 0.95) -> tuple[float, float]:
    """The exact interval of a success rate (Clopper & Pearson 1934), for trials of one model.

    Raises:
        ValueError: not 0 ≤ successes ≤ trials, or no trials.
    """
    from scipy.stats import binomtest

    bounds = binomtest(successes, trials).proportion_ci(confidence_level=level, method="exact")
    return float(bounds.low), float(bounds.high)


def summarise_rollouts(rollouts: Rollouts) -> dict[str, Any]:
    """Closed-loop results of one model (JSON-able): `success` and `score` with what they rest on.

    `score` is the mean over start states of the episode's best reward, min(1, coverage / 0.95); it is not a coverage.
    """
    n, successes = len(rollouts.success), int(rollouts.success.sum())
    return {
        "simulator": rollouts.simulator,
        "simulator_version": rollouts.simulator_version,
        "n": n,
        "successes": successes,
        "success": successes / n,
        "success_interval": list(clopper_pearson(successes, n)),
        "score": float(rollouts.best_reward.mean()),
        "best_coverage": float(rollouts.best_coverage.mean()),
        "median_steps": float(np.median(rollouts.steps)),
    }

"""What roll-outs in a simulator say of a policy.

What belongs here: summaries of `Rollouts`. What does not: rolling out (`simulate`), tests between success rates (`success`).
"""

from dataclasses import asdict
from typing import Any

import numpy as np

from pipeline.safety import NOT_FINITE, RUNS
from pipeline.statistics.success import clopper_pearson
from pipeline.types import Rollouts


def _safety(rollouts: Rollouts) -> dict[str, Any]:
    """What the safety layer did: frames in which it stepped in, as a number and a share, and episodes that it stopped."""
    count, frames = int(rollouts.interventions.sum()), int(rollouts.steps.sum())
    stopped, not_finite = (int(found.sum()) for found in (rollouts.stopped != RUNS, rollouts.stopped == NOT_FINITE))
    share = count / max(frames + stopped, 1)
    return {"interventions": count, "intervened": share, "stopped": stopped, "stopped_not_finite": not_finite}


def summarise_rollouts(rollouts: Rollouts) -> dict[str, Any]:
    """Closed-loop results of one model (JSON-able): `success` and `score` with what they rest on.

    `score` is the mean over start states of the episode's best reward (PushT: min(1, coverage / 0.95)); it is not a
    coverage. `best_coverage` is there where the task has one, `stages` and `stage_counts` where it has stages,
    `interventions` (frames in which the safety layer stepped in) where there was a safety layer.
    """
    n, successes = len(rollouts.success), int(rollouts.success.sum())
    summary = {
        "simulator": rollouts.simulator,
        "simulator_version": rollouts.simulator_version,
        "n": n,
        "successes": successes,
        "success": successes / n,
        "success_interval": list(clopper_pearson(successes, n)),
        "score": float(rollouts.best_reward.mean()),
        "median_steps": float(np.median(rollouts.steps)),
        "execution": asdict(rollouts.execution),
    }
    if rollouts.interventions is not None:
        summary |= _safety(rollouts)
    if not np.isnan(rollouts.best_coverage).any():
        summary["best_coverage"] = float(rollouts.best_coverage.mean())
    if rollouts.stage_names:
        summary |= {"stages": list(rollouts.stage_names), "stage_counts": rollouts.stage_counts}
    return summary

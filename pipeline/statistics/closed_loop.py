"""What roll-outs in a simulator say of a policy.

What belongs here: summaries of `Rollouts`. What does not: rolling out (`simulate`), tests between success rates (`success`).
"""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from pipeline.safety import NOT_FINITE, RUNS
from pipeline.statistics.success import clopper_pearson
from pipeline.types import Rollouts


def _safety(rollouts: Sequence[Rollouts]) -> dict[str, Any]:
    """What the safety layer did: frames in which it stepped in, as a number and a share, and episodes that it stopped."""
    count, frames = (int(sum(getattr(one, name).sum() for one in rollouts)) for name in ("interventions", "steps"))
    ended = np.concatenate([one.stopped for one in rollouts])
    stopped, not_finite = int((ended != RUNS).sum()), int((ended == NOT_FINITE).sum())
    share = count / max(frames + stopped, 1)
    return {"interventions": count, "intervened": share, "stopped": stopped, "stopped_not_finite": not_finite}


def summarise_rollouts(rollouts: Sequence[Rollouts]) -> dict[str, Any]:
    """Closed-loop results of one policy, a `Rollouts` a training seed (JSON-able): `success` and `score` with what they rest on.

    `n` is the number of start states, `seeds` that of networks, `episodes` n × seeds: `successes`, `stage_counts` and what the
    safety layer did are of all of them. `per_seed` holds each network's own results.

    `score` is the mean over start states of the episode's best reward (PushT: min(1, coverage / 0.95)); it is not a
    coverage. `best_coverage` is there where the task has one, `stages` and `stage_counts` where it has stages,
    `interventions` (frames in which the safety layer stepped in) where there was a safety layer.
    """
    first = rollouts[0]
    success, score, coverage, steps = (
        np.stack([getattr(one, name) for one in rollouts])
        for name in ("success", "best_reward", "best_coverage", "steps")
    )
    seeds, n = success.shape
    successes = int(success.sum())
    summary = {
        "simulator": first.simulator,
        "simulator_version": first.simulator_version,
        "first": int(first.start_states[0]),
        "n": n,
        "seeds": seeds,
        "episodes": n * seeds,
        "successes": successes,
        "success": successes / (n * seeds),
        "success_interval": list(clopper_pearson(successes, n * seeds)),
        "score": float(score.mean()),
        "median_steps": float(np.median(steps)),
        "execution": asdict(first.execution),
        "per_seed": [
            {"seed": one.seed, "successes": int(one.success.sum()), "score": float(one.best_reward.mean())}
            for one in rollouts
        ],
    }
    if first.interventions is not None:
        summary |= _safety(rollouts)
    if not np.isnan(coverage).any():
        summary["best_coverage"] = float(coverage.mean())
    if first.stage_names:
        counts = np.sum([one.stage_counts for one in rollouts], axis=0).tolist()
        summary |= {"stages": list(first.stage_names), "stage_counts": counts}
    return summary

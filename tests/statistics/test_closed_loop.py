"""Roll-outs in short, with and without stages."""

import json
from dataclasses import replace

import numpy as np

from pipeline.safety import NOT_FINITE, RUNS
from pipeline.statistics.closed_loop import summarise_rollouts
from pipeline.statistics.success import clopper_pearson
from pipeline.types import Execution, Rollouts


def rolled(coverage: np.ndarray, **stages) -> Rollouts:
    success = np.array([True, False])
    return Rollouts(
        "any", "1", "p", "pose", np.arange(2), success, np.array([1, 0.5]), coverage, np.array([9, 20]), None, **stages
    )


def test_a_task_with_a_coverage_keeps_it_and_has_no_stages():
    rollouts = rolled(np.array([0.96, 0.5]))
    summary = summarise_rollouts([rollouts])
    assert (summary["n"], summary["successes"], summary["success"], summary["score"]) == (2, 1, 0.5, 0.75)
    assert summary["success_interval"] == list(clopper_pearson(1, 2))
    assert "stages" not in summary
    assert summary["best_coverage"] == 0.73


def test_what_the_safety_layer_did_is_counted():
    guarded = rolled(
        np.array([0.96, 0.5]),
        interventions=np.array([3, 0]),
        corrections=np.array([0.5, 0.0]),
        stopped=np.array([NOT_FINITE, RUNS]),
        execution=Execution(4),
    )
    summary = summarise_rollouts([guarded])
    assert (summary["interventions"], summary["stopped"], summary["stopped_not_finite"]) == (3, 1, 1)
    assert summary["intervened"] == 3 / (9 + 20 + 1)
    # One of the three was an action that is not finite: it has no size.
    assert summary["mean_intervention"] == 0.25
    untouched = replace(guarded, interventions=np.array([1, 0]), corrections=np.zeros(2))
    assert summarise_rollouts([untouched])["mean_intervention"] is None
    assert summary["execution"] == {"execute": 4, "ensemble": False, "delay": 0}
    assert "interventions" not in summarise_rollouts([rolled(np.array([0.96, 0.5]))])


def test_a_task_with_stages_counts_them():
    stages = np.array([[True, True, True], [True, False, False]])
    rollouts = rolled(np.full(2, np.nan), stages=stages, stage_names=("reached", "grasped", "placed"))
    summary = summarise_rollouts([rollouts])
    assert "best_coverage" not in summary
    assert (summary["stages"], summary["stage_counts"]) == (["reached", "grasped", "placed"], [2, 1, 1])
    json.dumps(summary, allow_nan=False)

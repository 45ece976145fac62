"""Success rates."""

import numpy as np
import pytest

from pipeline.statistics.success import clopper_pearson, summarise_rollouts
from pipeline.types import Rollouts


def test_known_intervals():
    assert clopper_pearson(0, 50) == pytest.approx((0.0, 0.0711), abs=1e-4)
    assert clopper_pearson(18, 20) == pytest.approx((0.6830, 0.9877), abs=1e-4)


@pytest.mark.parametrize(("successes", "trials"), [(3, 2), (-1, 5)])
def test_impossible_counts_are_refused(successes, trials):
    with pytest.raises(ValueError, match=r"k|must"):
        clopper_pearson(successes, trials)


def test_rollouts_in_short():
    rollouts = Rollouts(
        simulator="pusht", simulator_version="1", policy="p", observations="pose", start_states=np.arange(4),
        success=np.array([True, False, False, True]), best_reward=np.array([1.0, 0.5, 0.0, 1.0]),
        best_coverage=np.array([0.97, 0.475, 0.0, 0.96]), steps=np.array([80, 300, 300, 120]), paths=None,
    )  # fmt: skip
    found = summarise_rollouts(rollouts)
    assert (found["n"], found["successes"], found["success"], found["score"]) == (4, 2, 0.5, 0.625)
    assert found["success_interval"] == pytest.approx(list(clopper_pearson(2, 4)))

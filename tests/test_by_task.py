"""Errors task by task."""

import numpy as np
import pytest

from pipeline.by_task import MOST_TASKS, errors_by_task
from pipeline.types import EpisodeErrors


def errors(of_episode: np.ndarray, anchors: int = 10) -> EpisodeErrors:
    """Errors [S, E] that all anchors of an episode have, at one horizon and in one column."""
    episodes = of_episode.shape[1]
    sums = anchors * of_episode[:, :, None, None]
    fold, counts = np.zeros(episodes, int), np.full((episodes, 1), anchors)
    return EpisodeErrors(np.arange(episodes), fold, counts, sums, sums, sums[..., 0], np.ones((episodes, 1)))


def test_each_task_has_its_own_mean_and_interval():
    values = np.arange(12.0)[None]
    found = errors_by_task(errors(values), ["pick", "place"] * 6, "strict")
    assert list(found) == ["pick", "place"]
    assert found["pick"]["first_step_mae"] == pytest.approx(np.mean([0, 2, 4, 6, 8, 10]))
    assert found["place"]["episodes"] == 6
    low, high = found["place"]["interval"]
    assert low < 6 < high


def test_few_episodes_have_no_interval_and_absent_tasks_no_entry():
    found = errors_by_task(errors(np.ones((1, 6))), ["pick"] * 4 + ["place"] * 2 + ["push"], "strict")
    assert found["place"] == {"first_step_mae": 1.0, "episodes": 2, "interval": None}
    assert "push" not in found


def test_one_task_or_very_many_are_no_table():
    assert errors_by_task(errors(np.ones((1, 6))), ["pick"] * 6, "strict") == {}
    many = [str(task) for task in range(MOST_TASKS + 1)]
    assert errors_by_task(errors(np.ones((1, len(many)))), many, "strict") == {}

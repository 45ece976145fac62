"""Intervals over episodes: the textbook's formula, its coverage, and silence where there are too few."""

import numpy as np
import pytest
from scipy import stats

from pipeline.statistics.intervals import mean_interval


def test_it_is_the_t_interval_of_the_textbook():
    values = np.random.default_rng(0).gamma(2.0, size=12)
    expected = stats.t.interval(0.95, 11, loc=values.mean(), scale=stats.sem(values))
    assert mean_interval(values[None]) == pytest.approx(expected)
    assert mean_interval(np.stack([values - 1, values + 1])) == pytest.approx(expected)


def test_equal_counts_change_nothing():
    values = np.random.default_rng(1).normal(size=(2, 9))
    assert mean_interval(values, np.full(9, 17)) == pytest.approx(mean_interval(values))


def test_with_counts_the_centre_is_the_mean_over_targets():
    values, counts = np.array([[1.0, 2.0, 3.0, 4.0, 10.0]]), np.array([10, 20, 30, 40, 1])
    low, high = mean_interval(values, counts)
    assert (low + high) / 2 == pytest.approx((values[0] * counts).sum() / counts.sum())


@pytest.mark.parametrize("weighted", [False, True])
def test_it_covers_the_truth_about_as_often_as_it_says(weighted):
    generator = np.random.default_rng(2)
    hits = 0
    for _ in range(2000):
        values = 5 + generator.normal(size=20)
        counts = generator.integers(20, 60, size=20) if weighted else None
        low, high = mean_interval(values[None], counts)
        hits += low < 5 < high
    assert 0.925 < hits / 2000 < 0.97


@pytest.mark.parametrize("episodes", [1, 4])
def test_below_five_episodes_there_is_none(episodes):
    assert mean_interval(np.arange(float(episodes))[None]) is None


def test_values_that_are_no_numbers_have_no_interval():
    assert mean_interval(np.array([[1.0, 2, 3, np.nan, 5, 6]])) is None

"""Means and their intervals: against slow versions, against known variances, how often they cover, and odd data."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from pipeline.statistics.intervals import MOST_RESAMPLED, RESAMPLES, _resamples, estimate_mean, seed_part

REPEATS = 2000


def test_of_very_many_episodes_it_is_the_t_interval_of_the_textbook():
    values = np.random.default_rng(0).gamma(2.0, size=MOST_RESAMPLED + 1)
    expected = stats.t.interval(0.95, len(values) - 1, loc=values.mean(), scale=stats.sem(values))
    found = estimate_mean(values[None])
    assert found.interval == pytest.approx(expected)
    assert (found.method, found.episodes, found.seeds, found.seed_se) == ("t", len(values), 1, 0.0)
    assert found.episode_se == pytest.approx(stats.sem(values))


def slow_bootstrap_t(values: np.ndarray, counts: np.ndarray) -> tuple[float, float]:
    """Resample by resample, frames of an episode together."""

    def centre_and_error(values, counts):
        centre = (values * counts).sum() / counts.sum()
        residual = counts / counts.mean() * (values - centre)
        return centre, np.sqrt((residual**2).sum() / (len(values) * (len(values) - 1)))

    centre, error = centre_and_error(values, counts)
    found = []
    for drawn in _resamples(len(values), RESAMPLES).astype(int):
        episodes = np.repeat(np.arange(len(values)), drawn)
        again, its_error = centre_and_error(values[episodes], counts[episodes])
        found.append((again - centre) / its_error)
    low, high = np.sort(found)[[49, RESAMPLES - 50]]
    return centre - high * error, centre - low * error


@pytest.mark.parametrize("weighted", [False, True])
def test_one_matrix_product_does_what_a_loop_over_resamples_does(weighted):
    generator = np.random.default_rng(3)
    values, counts = generator.exponential(size=12), generator.integers(20, 90, size=12) if weighted else None
    found = estimate_mean(values[None], counts)
    assert found.method == "bootstrap-t"
    assert found.interval == pytest.approx(slow_bootstrap_t(values, np.ones(12) if counts is None else counts))


def test_counts_move_the_centre_to_the_mean_over_targets():
    values, counts = np.array([[1.0, 2.0, 3.0, 4.0, 10.0]]), np.array([10, 20, 30, 40, 1])
    assert estimate_mean(values, counts).value == pytest.approx((values[0] * counts).sum() / counts.sum())
    equal = estimate_mean(values, np.full(5, 17))
    assert (equal.value, *equal.interval) == pytest.approx(
        (estimate_mean(values).value, *estimate_mean(values).interval)
    )


def slow_seed_part(values: np.ndarray) -> float:
    """The variance of the mean on account of its seeds, one fold, from the table of a two-way analysis of variance."""
    seeds, episodes = values.shape
    grand = values.mean()
    of_seeds = episodes * sum((values[s].mean() - grand) ** 2 for s in range(seeds)) / (seeds - 1)
    rest = sum(
        (values[s, e] - values[s].mean() - values[:, e].mean() + grand) ** 2
        for s in range(seeds)
        for e in range(episodes)
    ) / ((seeds - 1) * (episodes - 1))
    return max(0.0, (of_seeds - rest) / episodes) / seeds


def test_the_seed_part_is_that_of_a_two_way_table():
    generator = np.random.default_rng(4)
    values = generator.normal(size=(4, 9)) + generator.normal(size=(4, 1)) + generator.normal(size=(1, 9))
    variance, df = seed_part(values, np.ones(9), None)
    assert (variance, df) == (pytest.approx(slow_seed_part(values)), 3)


def draw(generator, episodes: int, seeds: int, folds: int, seed_variance: float, *, both: float = 0.3):
    """Errors around 5 of exponential episodes, of seeds that are new in every fold, and of both."""
    fold = np.arange(episodes) % folds
    values = 5 + generator.exponential(size=episodes) - 1
    values = values + np.sqrt(seed_variance) * generator.normal(size=(seeds, folds))[:, fold]
    return values + np.sqrt(both) * generator.normal(size=(seeds, episodes)), fold


@pytest.mark.parametrize(("episodes", "folds"), [(12, 1), (10, 5), (13, 3), (10, 10)])
def test_both_parts_together_are_the_variance_of_the_mean(episodes, folds):
    """Nothing is left out and nothing is counted twice, whatever the folds."""
    generator = np.random.default_rng(5)
    drawn = (draw(generator, episodes, 3, folds, 2.0) for _ in range(REPEATS))
    found = [estimate_mean(values, None, fold) for values, fold in drawn]
    claimed = np.mean([mean.episode_se**2 + mean.seed_se**2 for mean in found])
    assert claimed == pytest.approx(np.var([mean.value for mean in found]), rel=0.10)


def test_seeds_that_do_not_differ_add_nothing_or_little():
    generator = np.random.default_rng(6)
    parts = [seed_part(draw(generator, 20, 5, 1, 0.0)[0], np.ones(20), None)[0] for _ in range(500)]
    assert min(parts) == 0.0
    assert np.mean(np.array(parts) == 0) > 0.4, "a negative variance counts as zero"
    assert np.mean(parts) < 0.3 / 20 / 5, "what that adds is less than the part of both"


def covered(episodes: int, seeds: int, folds: int, seed_variance: float, repeats: int = REPEATS) -> float:
    generator = np.random.default_rng([episodes, seeds, folds])
    hits = 0
    for _ in range(repeats):
        values, fold = draw(generator, episodes, seeds, folds, seed_variance)
        low, high = estimate_mean(values, None, fold).interval
        hits += low < 5 < high
    return hits / repeats


@pytest.mark.parametrize(
    ("episodes", "seeds", "folds", "seed_variance"),
    [(10, 1, 1, 0.0), (20, 1, 1, 0.0), (50, 1, 1, 0.0), (10, 5, 5, 0.1), (50, 5, 5, 0.1), (20, 5, 1, 0.1)],
)
def test_intervals_cover_skewed_errors_about_as_often_as_they_say(episodes, seeds, folds, seed_variance):
    assert 0.92 <= covered(episodes, seeds, folds, seed_variance) <= 0.97


@pytest.mark.slow
@pytest.mark.parametrize("seed_variance", [0.0, 0.01, 1.0])
@pytest.mark.parametrize("seeds", [2, 5])
@pytest.mark.parametrize(("episodes", "folds"), [(10, 1), (10, 5), (20, 1), (50, 5)])
def test_intervals_cover_for_few_seeds_and_for_many(episodes, folds, seeds, seed_variance):
    assert 0.92 <= covered(episodes, seeds, folds, seed_variance) <= 0.98


def test_with_counts_they_cover_too():
    generator = np.random.default_rng(7)
    hits = 0
    for _ in range(REPEATS):
        counts = generator.integers(20, 80, size=12)
        low, high = estimate_mean(4 + generator.exponential(size=(1, 12)), counts).interval
        hits += low < 5 < high
    assert 0.92 <= hits / REPEATS <= 0.97


@pytest.mark.parametrize("episodes", [0, 1, 4])
def test_below_five_episodes_there_is_no_interval(episodes):
    found = estimate_mean(np.arange(float(episodes))[None])
    assert (found.interval, found.method, found.episodes) == (None, None, episodes)


def test_values_that_are_no_numbers_have_no_interval():
    found = estimate_mean(np.array([[1.0, 2, 3, np.nan, 5, 6]]))
    assert found.interval is None
    assert np.isnan(found.value)


@pytest.mark.parametrize("episodes", [5, 8, 40])
@pytest.mark.parametrize("value", [0.0, 3.1, 1e-30, 1e30])
def test_equal_values_are_certain(episodes, value):
    for seeds in (1, 3):
        assert estimate_mean(np.full((seeds, episodes), value)).interval == pytest.approx((value, value))


@pytest.mark.parametrize("episodes", [8, 10, 50])
def test_where_resamples_have_no_variance_the_interval_is_finite_and_wider_than_t_s(episodes):
    values = np.zeros(episodes)
    values[0] = 1.0
    low, high = estimate_mean(values[None]).interval
    by_t = stats.t.interval(0.95, episodes - 1, loc=values.mean(), scale=stats.sem(values))
    assert -np.inf < low <= values.mean() < by_t[1] < high < np.inf


FINITE = st.floats(-1e6, 1e6, allow_subnormal=False)


@settings(deadline=None, max_examples=60)
@given(
    values=st.tuples(st.integers(1, 3), st.integers(5, 12)).flatmap(lambda shape: arrays(float, shape, elements=FINITE))
)
def test_intervals_are_finite_hold_the_mean_and_move_with_the_data(values):
    found = estimate_mean(values, None, np.arange(values.shape[1]) % 2)
    assert np.isfinite(found.interval).all()
    assert found.interval[0] <= found.value <= found.interval[1]
    twice = estimate_mean(2 * values, None, np.arange(values.shape[1]) % 2)
    assert twice.interval == pytest.approx(2 * np.array(found.interval), rel=1e-6, abs=1e-9)


def test_the_same_data_give_the_same_interval():
    values = np.random.default_rng(8).exponential(size=(2, 15))
    first = estimate_mean(values)
    _resamples.cache_clear()
    assert estimate_mean(values) == first

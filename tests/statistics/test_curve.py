"""Would more demonstrations help? Curves whose future is known, and what is said of them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.statistics import curve as curves
from pipeline.statistics.curve import Floor, answer, exponential, gain_factor, gain_fit, power, spread_sizes
from pipeline.statistics.curve_errors import CurveErrors, contrast, points
from pipeline.statistics.curve_reading import curve_errors, join_errors
from pipeline.types import EpisodeErrors
from tests.statistics.curve_makers import FIVE_FOLDS, ONE_FOLD, Task, made_curve, words_of_many

METRIC = "first_step_mae"
DESIGNS = pytest.mark.parametrize("design", [FIVE_FOLDS, ONE_FOLD], ids=["five folds", "one fold"])


def noiseless(truth, sizes=(5, 10, 20, 40), episodes=20) -> CurveErrors:
    """Five seeds and three orders that agree, over episodes that differ."""
    level = np.linspace(0.5, 1.5, episodes)
    rows = [np.ones((1 if n == sizes[-1] else 3, 5, 1)) * truth(n) * level for n in sizes]
    return CurveErrors(tuple(sizes), tuple(rows), np.zeros(episodes, int))


# The answer: right, and given ----------------------------------------------------------------------------------------


@DESIGNS
def test_a_curve_that_falls_says_yes(design):
    """Clearly limited by data: a halving of the error for four times the episodes, or a half of it that falls like 1/n."""
    full = design["sizes"][-1]
    for truth in (lambda n: (n / full) ** -0.5, lambda n: 0.5 + 0.5 * full / n):
        words, gain, held = words_of_many(truth, 60, **design)
        assert gain > 0.1
        assert words["yes"] >= 0.8
        assert words["no"] == 0
        assert held >= 0.95


@DESIGNS
def test_a_flat_curve_says_no(design):
    words, gain, held = words_of_many(lambda n: 1.0, 60, **design)
    assert gain == 0
    assert words["no"] >= 0.8
    assert words["yes"] == 0
    assert held >= 0.9


@pytest.mark.slow
@DESIGNS
@pytest.mark.parametrize("shape", ["log", "power", "endless", "soon over", "sooner over"])
def test_wrong_answers_are_rare(design, shape):
    """No "no" where the gain exceeds 5 % a little, no "yes" where it is below a half of that: at most 5 % of 400, less noise."""
    full = design["sizes"][-1]
    grows = np.log((full + 50) / full)
    lost = 1 - ((full + 50) / full) ** -0.5
    truth = {
        "log": lambda n: 1 - 0.055 * np.log(n / full) / grows,
        "power": lambda n: 1 + 0.055 / lost * ((n / full) ** -0.5 - 1),
        "endless": lambda n: 1 + 0.024 / lost * ((n / full) ** -0.5 - 1),
        "soon over": lambda n: 1 + 4 * np.exp(-n / (0.18 * full)),
        "sooner over": lambda n: 1 + 12 * np.exp(-n / (0.14 * full)),
    }[shape]
    words, gain, _ = words_of_many(truth, 400, **design)
    wrong = words["no"] if gain > 0.05 else words["yes"]
    assert gain > 0.05 or gain < 0.025
    assert wrong <= 0.05 + 2 * np.sqrt(0.05 * 0.95 / 400)


def test_learners_with_a_known_future():
    """Ridge regression trained on real subsets; its true gain comes from fresh training sets and 300 test episodes."""
    saturated, limited = Task(1, 1.0, 0.5, features=10), Task(6, 0.6, 0.02, features=300, frames=10)
    assert saturated.true_gain(164, 50) < 0.01
    said = [answer(saturated.curve(seed, **ONE_FOLD), METRIC).word for seed in range(10)]
    assert said.count("no") >= 8
    assert limited.true_gain(40, 50, repeats=5) > 0.2
    said = [answer(limited.curve(seed, **FIVE_FOLDS, seeds=2), METRIC).word for seed in range(5)]
    assert "no" not in said
    assert "yes" in said


@given(c=st.floats(0.05, 1.95), a=st.floats(0, 0.8), more=st.integers(10, 200))
@settings(max_examples=40, deadline=None)
def test_the_limits_hold_every_power_law(c, a, more):
    """Without noise the limits hold the gain exactly, and the fit finds it."""

    def truth(n: float) -> float:
        return a + (1 - a) * (n / 40) ** -c

    curve = noiseless(truth)
    gain = truth(40) - truth(40 + more)
    said = answer(curve, METRIC, more=more)
    slack = 0.02 * abs(gain) + 0.5 * (said.interval[1] - said.interval[0])
    assert said.interval[0] - slack <= gain <= said.interval[1] + slack
    assert gain_fit(curve, more) == pytest.approx(gain, rel=0.05)


@given(c=st.just(0.0) | st.floats(0.01, 2), smaller=st.integers(2, 30), more=st.integers(1, 300))
def test_the_factor_falls_with_the_rate_and_log_n_bounds_it(c, smaller, more):
    full = 40
    factor = gain_factor(power(c), smaller, full, more)
    assert 0 < factor <= gain_factor(power(0), smaller, full, more) * (1 + 1e-9)
    assert gain_factor(power(2), smaller, full, more) <= factor * (1 + 1e-9)
    assert gain_factor(exponential(4.0), 20, full, more) < gain_factor(power(2), 20, full, more)
    a, b = 3.0, 5.0
    if c > 0:
        e = [a + b * n**-c for n in (smaller, full, full + more)]
        assert factor == pytest.approx((e[1] - e[2]) / (e[0] - e[1]), rel=1e-6)


def test_a_curve_that_only_begins_to_fall_gives_no_no():
    errors = {5: 1.0, 10: 1.0, 20: 1.0, 40: 0.97}
    said = answer(made_curve(np.random.default_rng(0), errors.get, **FIVE_FOLDS, paired=0.005, orders=0.001,
                             between_seeds=0.001), METRIC)  # fmt: skip
    assert said.word == "cannot tell"
    assert "getting steeper" in said.words


def test_two_sizes_never_say_yes_and_can_say_no():
    rng = np.random.default_rng(0)
    design = {"sizes": (20, 40), "episodes": 50, "folds": 5}
    assert answer(made_curve(rng, lambda n: (n / 40) ** -1.0, **design), METRIC).word == "cannot tell"
    assert answer(made_curve(rng, lambda n: 1.0, **design, paired=0.02), METRIC, more=20).word == "no"


def test_far_beyond_the_data_the_answer_is_more_careful_and_says_so():
    curve = noiseless(lambda n: (n / 40) ** -0.4)
    near, far = answer(curve, METRIC, more=40), answer(curve, METRIC, more=41)
    assert far.interval[0] < near.interval[0]
    assert "far beyond what was seen" in far.words
    assert "far beyond" not in near.words


def test_the_floor_caps_the_gain():
    curve = noiseless(lambda n: (n / 40) ** -0.5)
    free = answer(curve, METRIC, more=40)
    high = contrast(curve, {40: 1.0}).interval[1]
    floor = Floor(high - 0.01, high - 0.02, "the floor (1.2 px or more)")
    capped = answer(curve, METRIC, more=40, floor=floor)
    assert free.word == "yes"
    assert capped.word == "no"
    assert capped.interval[1] == pytest.approx(0.02)
    assert "cannot fall below the floor (1.2 px or more)" in capped.words
    contradicted = answer(curve, METRIC, more=40, floor=Floor(9.0, 9.0, "a floor above the error"))
    assert contradicted == free


def test_the_share_decides():
    curve = noiseless(lambda n: (n / 40) ** -0.5)
    assert answer(curve, METRIC, more=40, share=0.05).word == "yes"
    assert answer(curve, METRIC, more=40, share=0.9).word == "no"


def test_the_words_give_numbers_with_their_unit():
    said = answer(noiseless(lambda n: 2 * (n / 40) ** -0.5), METRIC, more=40, unit="deg")
    assert said.words.startswith(
        "Yes: 40 more demonstrations (40 → 80 to train on) would lower the first-step error, now 2 deg,"
    )
    assert "5 % would be worth it" in said.words
    assert answer(noiseless(lambda n: 1.0), METRIC, more=40).words.startswith("No: ")
    growing = answer(noiseless(lambda n: (n / 40) ** 0.2), METRIC, more=40)
    assert growing.words.endswith("would not lower the first-step error, now 1, at all.")


def test_nothing_is_claimed_from_one_seed_or_four_episodes():
    rng = np.random.default_rng(0)
    one = made_curve(rng, lambda n: 1.0, **ONE_FOLD, seeds=1)
    assert (
        answer(one, METRIC).words
        == "Cannot tell: one seed does not show how much training varies: train with several (--seeds 5)."
    )
    assert answer(CurveErrors(one.sizes, one.values, one.fold, trained=False), METRIC).interval is not None
    few = made_curve(rng, lambda n: 1.0, sizes=(5, 10), episodes=4, folds=1)
    said = answer(few, METRIC)
    assert (said.word, said.interval) == ("cannot tell", None)
    assert "4 held-out episodes are too few" in said.words


def test_sizes_that_lie_close_together_are_no_drop():
    assert spread_sizes([10, 20, 30, 40]) == [10, 20, 40]
    assert spread_sizes([5, 10, 20, 40]) == [5, 10, 20, 40]
    assert spread_sizes([35, 38, 40]) == [38, 40]


# How sure a difference is --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("design", "luck"), [(FIVE_FOLDS, 0.02), (FIVE_FOLDS, 0.1), (ONE_FOLD, 0.02), (ONE_FOLD, 0.1)])
def test_intervals_of_drops_hold_the_truth(design, luck):
    base, full = design["sizes"][-2:]
    rng = np.random.default_rng(1)
    held = 0
    for _ in range(600):
        curve = made_curve(rng, lambda n: (n / full) ** -0.3, **design, orders=luck)
        low, high = contrast(curve, {base: 1.0, full: -1.0}).interval
        held += low <= (base / full) ** -0.3 - 1 <= high
    assert 0.915 <= held / 600 <= 0.985


def test_what_the_sizes_share_cancels():
    """Episodes differ by 40 %, and the drop is far surer than the errors are."""
    curve = made_curve(np.random.default_rng(0), lambda n: 1.0, **ONE_FOLD)
    drop, present = contrast(curve, {82: 1.0, 164: -1.0}), contrast(curve, {164: 1.0})
    assert np.ptp(drop.interval) < np.ptp(present.interval) / 2
    assert set(drop.variances) == {"episodes", "seeds", "orders"}
    assert set(contrast(made_curve(np.random.default_rng(0), lambda n: 1.0, **FIVE_FOLDS), {40: 1.0}).variances) == {
        "folds"
    }


def test_a_contrast_the_long_way_round():
    curve = made_curve(np.random.default_rng(0), lambda n: 1 / n, **ONE_FOLD)
    by_hand = np.mean(curve.values[2].ravel()) - np.mean(curve.values[3].ravel())
    found = contrast(curve, {82: 1.0, 164: -1.0})
    assert found.value == pytest.approx(by_hand)
    per_episode = [curve.values[2][:, :, e].mean() - curve.values[3][:, :, e].mean() for e in range(42)]
    assert found.variances["episodes"] == pytest.approx(np.var(per_episode, ddof=1) / 42)
    orders = [curve.values[2][r].mean() for r in range(3)]
    assert found.variances["orders"] == pytest.approx(np.var(orders, ddof=1) / 3)
    seeds = [curve.values[2][:, s].mean() - curve.values[3][:, s].mean() for s in range(5)]
    assert found.variances["seeds"] == pytest.approx(np.var(seeds, ddof=1) / 5)


def test_under_notebook_every_target_counts_once():
    curve = made_curve(np.random.default_rng(0), lambda n: 1.0, **ONE_FOLD)
    counts = np.arange(1.0, 43)
    weighted = CurveErrors(curve.sizes, curve.values, curve.fold, counts)
    expected = np.average(curve.values[3].mean(axis=(0, 1)), weights=counts)
    assert contrast(weighted, {164: 1.0}).value == pytest.approx(expected)
    assert points(weighted)[-1].error == pytest.approx(expected)


def test_points_name_every_order_or_fold():
    one, five = (points(made_curve(np.random.default_rng(0), lambda n: 1.0, **d)) for d in (ONE_FOLD, FIVE_FOLDS))
    assert [len(p.orders) for p in one] == [3, 3, 3, 1]
    assert [len(p.orders) for p in five] == [5, 5, 5, 5]
    assert [p.episodes for p in five] == [5, 10, 20, 40]
    for point in [*one, *five]:
        assert np.mean(point.orders) == pytest.approx(point.error)
        assert point.interval[0] < point.error < point.interval[1]


# From kept errors ----------------------------------------------------------------------------------------------------


def kept(episodes, fold: int, horizons: int = 3, anchors: int = 4, value: float = 1.0) -> EpisodeErrors:
    e = len(episodes)
    counts = np.maximum(anchors - np.arange(horizons), 0) * np.ones((e, 1), np.int64)
    sums = value * counts[None, :, :, None] * np.ones((2, 1, 1, 2)) * (1 + np.arange(horizons))[:, None]
    return EpisodeErrors(np.array(episodes), np.full(e, fold), counts, sums, sums**2, sums[..., 0], np.ones((e, 2)))


def test_folds_are_joined_in_the_order_of_the_episodes():
    joined = join_errors([kept([1, 4], 0, value=2.0), kept([0, 2, 3], 1)])
    assert joined.episodes.tolist() == [0, 1, 2, 3, 4]
    assert joined.fold.tolist() == [1, 0, 1, 1, 0]
    assert joined.absolute[0, :, 0, 0].tolist() == [4, 8, 4, 4, 8]


def test_the_second_metric_is_there_where_the_chunk_reaches_one_second():
    by_size = {4: [kept(range(6), 0, value=2.0)] * 3, 8: [kept(range(6), 0)]}
    first = curve_errors(by_size, METRIC, fps=2, protocol="strict")
    later = curve_errors(by_size, "at_one_second_mae", fps=2, protocol="strict")
    assert [v.mean() for v in first.values] == [2, 1]
    assert [v.mean() for v in later.values] == [6, 3]
    assert curve_errors(by_size, "at_one_second_mae", fps=3, protocol="strict") is None
    assert first.counts is None
    assert curve_errors(by_size, METRIC, fps=2, protocol="notebook").counts.tolist() == [4] * 6


def test_constants_are_what_the_page_says():
    assert (curves.MORE, curves.WORTHWHILE) == (50, 0.05)

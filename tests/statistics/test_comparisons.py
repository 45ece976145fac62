"""Verdicts: tests against slow versions, false alarms on a null that moves, power, and every word with its reason."""

import json
from dataclasses import asdict, replace
from itertools import product

import numpy as np
import pytest
from scipy import stats

from pipeline.statistics.comparisons import (
    compare_errors,
    compare_paired,
    holm,
    horizons_in_common,
    judge,
    least_p,
    sign_flip,
    table_comparisons,
)
from pipeline.statistics.intervals import estimate_mean
from pipeline.types import EpisodeErrors


def slow_sign_flip(differences: np.ndarray) -> float:
    observed = abs(differences.sum())
    flipped = [abs(np.dot(signs, differences)) for signs in product((-1, 1), repeat=len(differences))]
    return np.mean([value >= observed - 1e-9 for value in flipped])


@pytest.mark.parametrize("episodes", [5, 8, 11])
def test_flipping_signs_tries_every_pattern(episodes):
    generator = np.random.default_rng(episodes)
    for shift in (0.0, 0.5, 3.0):
        differences = generator.normal(shift, size=episodes)
        assert sign_flip(differences) == pytest.approx(slow_sign_flip(differences))
    differences[:3] = 0.0
    assert sign_flip(differences) == pytest.approx(slow_sign_flip(differences))
    assert sign_flip(np.full(episodes, 0.1)) == least_p(episodes) == 2 / 2**episodes


def test_ten_episodes_give_two_in_1024_at_best():
    assert least_p(10) == 2 / 1024
    assert 45 * least_p(10) > 0.05


def test_random_flips_are_close_to_all_of_them_and_never_zero():
    differences = np.random.default_rng(1).normal(0.4, size=15)
    assert sign_flip(differences) == pytest.approx(slow_sign_flip(differences), abs=0.01)
    assert sign_flip(np.ones(30)) == least_p(30) == 1 / 20_001
    many = np.random.default_rng(2).normal(0.05, size=3_000)
    assert sign_flip(many) == pytest.approx(stats.ttest_1samp(many, 0).pvalue, rel=0.01)


def test_no_difference_at_all_is_no_evidence():
    assert sign_flip(np.zeros(12)) == 1.0


def test_holm_multiplies_and_never_falls():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.5, 0.9]) == pytest.approx([1.0, 1.0])
    assert len(holm([])) == 0
    p = np.random.default_rng(3).random(20) ** 3
    order, running, slow = np.argsort(p), 0.0, np.empty(20)
    for place, index in enumerate(order):
        running = max(running, min(1.0, (20 - place) * p[index]))
        slow[index] = running
    np.testing.assert_allclose(holm(p), slow)


def policy(generator, common, *, seeds=5, folds=1, seed_variance=0.05, own=0.1, both=0.1, shift=0.0):
    """Errors [S, E] of a policy: what the episodes have in common, its own part of it, fresh seeds, and both."""
    episodes = len(common)
    of_seeds = np.sqrt(seed_variance) * generator.normal(size=(seeds, folds))[:, np.arange(episodes) % folds]
    noise = np.sqrt(both) * generator.normal(size=(seeds, episodes))
    return 5 + shift + common + np.sqrt(own) * generator.normal(size=episodes) + of_seeds + noise


def alarms(episodes, folds, seeds, seed_variance, *, shift=0.0, repeats=400):
    """Share of repeats in which p ≤ 0.05, with fresh episodes and fresh seeds each time, and how often intervals cover."""
    generator = np.random.default_rng([episodes, folds, seeds, round(100 * seed_variance)])
    found, covered = 0, 0
    for _ in range(repeats):
        common = 2 * generator.exponential(size=episodes)
        a = policy(generator, common, folds=folds, seeds=seeds, seed_variance=seed_variance, shift=shift)
        b = policy(generator, common, folds=folds, seeds=seeds, seed_variance=seed_variance)
        pair = compare_paired(a, b, None, np.arange(episodes) % folds)
        found += pair.p <= 0.05
        covered += pair.interval[0] <= shift <= pair.interval[1]
    return found / repeats, covered / repeats


@pytest.mark.parametrize("seed_variance", [0.0, 0.05, 0.5])
@pytest.mark.parametrize(("episodes", "folds", "seeds"), [(10, 5, 5), (50, 5, 5), (41, 1, 5), (20, 1, 2)])
def test_a_null_that_moves_seldom_alarms_and_intervals_of_differences_cover(episodes, folds, seeds, seed_variance):
    rate, covered = alarms(episodes, folds, seeds, seed_variance)
    assert rate <= 0.05 + 2.6 * np.sqrt(0.05 * 0.95 / 400)
    assert 0.95 - 2.6 * np.sqrt(0.05 * 0.95 / 400) <= covered


@pytest.mark.slow
def test_over_many_repeats_alarms_stay_below_five_percent():
    settings = [(10, 5, 5), (50, 5, 5), (20, 1, 5), (50, 1, 2)]
    rates = [alarms(*setting, variance, repeats=1500)[0] for setting in settings for variance in (0.0, 0.02, 0.5)]
    assert np.mean(rates) <= 0.05
    assert max(rates) <= 0.065


def test_one_seed_knows_nothing_of_other_seeds_and_says_so():
    """What ignoring the seeds costs: the reason why a verdict on one seed is about that network alone."""
    rate, _ = alarms(50, 1, 1, 0.5)
    assert rate > 0.5
    generator = np.random.default_rng(4)
    pair = compare_paired(*(policy(generator, np.zeros(20), seeds=1, shift=shift) for shift in (0.0, 3.0)))
    assert pair.one_network
    (verdict,) = judge([("a", "b", "first_step_mae", pair)])
    assert verdict.word == "better"
    assert verdict.words.endswith("(one seed: about this one network)")
    baselines = compare_paired(np.ones((1, 9)), np.zeros((1, 9)), trained=(False, False))
    assert not baselines.one_network


def test_a_difference_that_should_be_seen_four_times_in_five_is():
    generator = np.random.default_rng(5)
    fold, nothing = np.arange(50) % 5, np.zeros(50)
    pairs = [[policy(generator, nothing, folds=5) for _ in "ab"] for _ in range(50)]
    smallest = np.median([compare_paired(a, b, None, fold).smallest_seen for a, b in pairs])
    rate, _ = alarms(50, 5, 5, 0.05, shift=smallest)
    assert 0.70 <= rate <= 0.90


def test_the_parts_are_those_of_the_differences_and_of_each_one_s_seeds():
    generator = np.random.default_rng(6)
    fold = np.arange(20) % 5
    a, b = (policy(generator, generator.normal(size=20), folds=5, seed_variance=2.0) for _ in "ab")
    pair = compare_paired(a, b, None, fold)
    of_difference = estimate_mean((a.mean(axis=0) - b.mean(axis=0))[None])
    of_a, of_b = (estimate_mean(side, None, fold) for side in (a, b))
    assert pair.difference == pytest.approx(of_difference.value)
    assert pair.episode_se == pytest.approx(of_difference.episode_se)
    assert pair.seed_se == pytest.approx(np.hypot(of_a.seed_se, of_b.seed_se))
    assert of_a.seed_df < pair.seed_df <= of_a.seed_df + of_b.seed_df
    mirrored = compare_paired(b, a, None, fold)
    assert mirrored.difference == -pair.difference
    assert mirrored.p == pytest.approx(pair.p)


def test_with_counts_the_difference_is_that_of_the_means_over_frames():
    generator = np.random.default_rng(7)
    a, b = generator.exponential(size=(1, 12)), generator.exponential(size=(1, 12)) + 1
    counts = generator.integers(10, 90, size=12)
    pair = compare_paired(a, b, counts)
    assert pair.difference == pytest.approx(np.average(a[0], weights=counts) - np.average(b[0], weights=counts))
    assert pair.interval == pytest.approx(estimate_mean(a - b, counts).interval)


def test_values_that_are_no_numbers_are_refused():
    with pytest.raises(ValueError, match="finite values"):
        compare_paired(np.array([[1.0, 2, 3, 4, np.nan]]), np.ones((1, 5)))


@pytest.mark.parametrize("seeds", [1, 2, 5])
@pytest.mark.parametrize("noise", [0.0, 1e-12, 1e-6])
def test_a_difference_far_beyond_doubt_is_finite_and_significant(seeds, noise):
    generator = np.random.default_rng(12)
    a, b = (level + noise * generator.normal(size=(seeds, 20)) for level in (0.0, 1.0))
    pair = compare_paired(a, b)
    assert pair.p == least_p(20)
    assert np.isfinite([pair.difference, *pair.interval, pair.smallest_seen, pair.seed_se]).all()
    assert 0 <= compare_paired(a, a + noise * generator.normal(size=a.shape)).p <= 1


# The four words ------------------------------------------------------------------------------------------------------


def pair_of(difference: float, *, episodes=30, noise=1.0, seeds=1, seed_noise=0.0, seed=0, trained=(False, False)):
    """Differences with exactly this mean and deviation over episodes, and seeds of a with exactly this deviation."""
    generator = np.random.default_rng(seed)
    spread = generator.normal(size=episodes)
    spread = noise * (spread - spread.mean()) / spread.std(ddof=1)
    of_seeds = np.linspace(-1, 1, seeds) if seeds > 1 else np.zeros(1)
    of_seeds = seed_noise * of_seeds / (of_seeds.std(ddof=1) if seeds > 1 else 1)
    return compare_paired(10 + difference + spread + of_seeds[:, None], np.full((1, episodes), 10.0), trained=trained)


def verdict_of(pair, *, metric="first_step_mae", family=1):
    others = [("x", "y", metric, pair_of(0.0, seed=i)) for i in range(1, family)]
    return judge([("a", "b", metric, pair), *others])[0]


def test_lower_errors_are_better_and_higher_success_is():
    assert verdict_of(pair_of(-2.0)).word == "better"
    assert verdict_of(pair_of(-2.0)).words == "error 20 % lower"
    assert verdict_of(pair_of(2.0)).word == "worse"
    assert verdict_of(pair_of(15.0)).words == "error 2.5 times as high"
    success = compare_paired(np.ones((1, 12)), np.zeros((1, 12)))
    assert verdict_of(success, metric="success").word == "better"
    assert verdict_of(success, metric="success").words.startswith("success 100 points higher")


def test_holm_is_over_what_was_tested_and_nothing_else():
    pair = pair_of(-0.5)
    alone, among = verdict_of(pair), verdict_of(pair, family=4)
    assert alone.p_holm == alone.p == among.p
    assert among.p_holm == pytest.approx(4 * among.p)
    same = compare_paired(np.ones((1, 30)), np.ones((1, 30)))
    untested = [("a", "c", "m", "anchors differ"), ("a", "d", "m", same), ("a", "e", "m", pair_of(1.0, episodes=4))]
    assert judge([("a", "b", "m", pair), *untested])[0].p_holm == alone.p


def test_too_few_episodes_for_any_difference_to_show():
    pair = pair_of(-9.0, episodes=10)
    assert verdict_of(pair).word == "better"
    verdict = judge([(str(i), "b", "first_step_mae", pair_of(-9.0, episodes=10)) for i in range(45)])[0]
    assert verdict.p_holm == pytest.approx(45 * 2 / 1024)
    assert (verdict.word, verdict.needs_episodes) == ("cannot tell", 11)
    assert verdict.words == "needs at least 11 held-out episodes: with fewer nothing can show among 45 comparisons"
    assert verdict_of(pair_of(-9.0, episodes=5)).needs_episodes == 6


def test_below_five_episodes_nothing_is_tested():
    pair = pair_of(-9.0, episodes=4)
    assert (pair.p, pair.interval, pair.smallest_seen) == (None, None, None)
    verdict = verdict_of(pair)
    assert (verdict.word, verdict.p_holm, verdict.needs_episodes) == ("cannot tell", None, 5)
    assert verdict.words == "needs at least 5 held-out episodes; there are 4"


def test_the_episodes_said_to_be_needed_give_the_power_that_was_said():
    verdict = verdict_of(pair_of(0.25))
    assert verdict.word == "cannot tell"
    assert verdict.words == f"about {verdict.needs_episodes} held-out episodes would show a difference this large"
    assert verdict.needs_episodes == pytest.approx(16 * (1.96 + 0.84) ** 2, rel=0.05)
    generator = np.random.default_rng(8)
    seen = [
        compare_paired(
            generator.normal(0.25, size=(1, verdict.needs_episodes)), np.zeros((1, verdict.needs_episodes))
        ).p
        for _ in range(300)
    ]
    assert np.mean(np.array(seen) <= 0.05) == pytest.approx(0.8, abs=0.06)


def test_where_seeds_differ_more_episodes_do_not_help():
    verdict = verdict_of(pair_of(0.5, noise=0.2, seeds=3, seed_noise=0.5))
    assert (verdict.word, verdict.needs_episodes) == ("cannot tell", None)
    assert verdict.words == "about 11 seeds would show a difference this large; more held-out episodes alone would not"
    both = verdict_of(pair_of(0.2, noise=1.0, seeds=3, seed_noise=0.5))
    assert both.words == (
        f"about {both.needs_episodes // 10} seeds and {both.needs_episodes} held-out episodes would show a difference this large"
    )
    assert both.needs_episodes % 30 == 0


def test_a_difference_as_good_as_none_is_called_too_small():
    assert verdict_of(pair_of(1e-6)).words == "too small a difference to show with 100,000 held-out episodes"
    seeds = verdict_of(pair_of(1e-6, seeds=3, seed_noise=0.5))
    assert (
        seeds.words == "too small a difference to show with any number of seeds and held-out episodes that people have"
    )


def test_equal_predictions_are_said_to_be_equal():
    values = np.random.default_rng(9).random((3, 12))
    verdict = verdict_of(compare_paired(values, values))
    assert (verdict.word, verdict.p, verdict.words) == ("cannot tell", 1.0, "the two predict the same")


# From errors of episodes ---------------------------------------------------------------------------------------------


def errors_of(means: np.ndarray, *, horizons=4, folds=5, anchors=None) -> EpisodeErrors:
    """Errors whose episode means are `means` [S, E] at every horizon and in both action columns."""
    seeds, episodes = means.shape
    count = np.full(episodes, 20) if anchors is None else anchors
    counts = np.maximum(count[:, None] - np.arange(horizons), 0)
    sums = np.broadcast_to((means[:, :, None] * counts)[..., None], (seeds, episodes, horizons, 2)).astype(float)
    fold = np.arange(episodes) % folds
    return EpisodeErrors(np.arange(episodes), fold, counts, sums, sums**2, sums[..., 0], np.ones((episodes, 2)))


def rows_of(policies: int, *, episodes=50, seeds=5, horizons=4):
    generator = np.random.default_rng(10)
    common = generator.exponential(size=episodes)
    rows = [("hold_still", "state", errors_of(8 + common[None] + generator.random((1, episodes)), horizons=horizons))]
    for number in range(policies):
        values = policy(generator, common, folds=5, seeds=seeds, shift=0.2 * number)
        rows.append((f"mlp_k{number + 1:02d}", "state", errors_of(values, horizons=horizons)))
    return rows


@pytest.mark.parametrize("horizon", [0, 2])
def test_errors_are_compared_by_their_episode_means_and_under_notebook_by_frames(horizon):
    generator = np.random.default_rng(11)
    a, b, anchors = generator.random((3, 12)), generator.random((2, 12)), generator.integers(10, 90, size=12)
    errors = [errors_of(side, anchors=anchors) for side in (a, b)]
    strict, frames = (compare_errors(*errors, horizon, protocol) for protocol in ("strict", "notebook"))
    expected = compare_paired(a, b, None, np.arange(12) % 5)
    assert strict.interval == pytest.approx(expected.interval)
    assert (strict.difference, strict.p, strict.seed_se) == pytest.approx(
        (expected.difference, expected.p, expected.seed_se)
    )
    counts = anchors - horizon
    assert frames.difference == pytest.approx((a.mean(axis=0) - b.mean(axis=0)) @ counts / counts.sum())


def test_what_differs_is_said():
    (_, _, errors), *_ = rows_of(0)
    fewer, other = errors_of(np.ones((1, 49))), replace(errors, anchors=errors.anchors - 1)
    assert compare_errors(errors, fewer, 0, "strict") == "held-out episodes differ: 50 and 49, 49 in common"
    assert compare_errors(errors, replace(errors, fold=errors.fold[::-1]), 0, "strict").startswith("folds differ")
    assert compare_errors(errors, other, 0, "strict") == "anchors differ: 1,000 and 950 frames"
    assert compare_errors(errors, errors_of(np.ones((1, 50)), horizons=1), 2, "strict") == (
        "horizon 2 is not reached: the shorter chunk holds 1 action"
    )
    one_column = replace(errors, absolute=errors.absolute[..., :1])
    assert compare_errors(errors, one_column, 0, "strict") == "action columns differ: 2 and 1"
    broken = replace(errors, absolute=errors.absolute * np.nan)
    assert compare_errors(errors, broken, 0, "strict") == "a prediction is no number"
    (verdict,) = judge([("a", "b", "first_step_mae", "anchors differ")])
    assert (verdict.word, verdict.words, verdict.p) == ("not comparable", "anchors differ", None)


def test_one_second_counts_where_both_reach_it():
    short, long = errors_of(np.ones((1, 9)), horizons=3), errors_of(np.ones((1, 9)), horizons=4)
    assert horizons_in_common(short, long, 2.9) == {"first_step_mae": 0}
    assert horizons_in_common(long, long, 2.9) == {"first_step_mae": 0, "at_one_second_mae": 3}


def test_a_table_holds_each_against_hold_still_and_against_the_champion():
    found = table_comparisons(rows_of(3), "mlp_k02", 3.0, "strict")
    compared = [(c.a, c.b) for c in found if c.metric == "first_step_mae"]
    assert compared == [
        ("mlp_k01/state", "hold_still/state"), ("mlp_k02/state", "hold_still/state"),
        ("mlp_k03/state", "hold_still/state"), ("mlp_k01/state", "mlp_k02/state"), ("mlp_k03/state", "mlp_k02/state"),
    ]  # fmt: skip
    assert [(c.a, c.b) for c in found if c.metric == "at_one_second_mae"] == compared
    assert [c.p_holm for c in found] == pytest.approx(holm([c.p for c in found]))
    assert all(c.word == "better" for c in found if c.b == "hold_still/state")
    assert table_comparisons(rows_of(3), "mlp_k02/state", 3.0, "strict") == found
    assert all(c.b == "hold_still/state" for c in table_comparisons(rows_of(3), None, 3.0, "strict"))
    json.dumps([asdict(c) for c in found], allow_nan=False)


def test_a_champion_without_a_row_is_said_to_have_none():
    found = table_comparisons(rows_of(2), "mlp_k09", 3.0, "strict")
    words = {c.words for c in found if c.b == "mlp_k09"}
    assert words == {"the champion 'mlp_k09' has no up-to-date result here"}
    rows = [*rows_of(1), ("mlp_k01", "pose", rows_of(1)[1][2])]
    found = table_comparisons(rows, "mlp_k01", 3.0, "strict")
    assert {c.words for c in found if c.b == "mlp_k01"} == {
        "the champion 'mlp_k01' has several observation sets: name one of mlp_k01/state, mlp_k01/pose"
    }


def test_a_baseline_has_no_seeds_to_speak_of():
    rows = [*rows_of(1, seeds=1), ("constant_velocity", "state", errors_of(np.ones((1, 50)) + np.arange(50)))]
    words = {c.a: c.words for c in table_comparisons(rows, None, 3.0, "strict")}
    assert "one network" in words["mlp_k01/state"]
    assert "one network" not in words["constant_velocity/state"]


def test_a_large_table_has_every_pair_once():
    found = table_comparisons(rows_of(19), "mlp_k01", 3.0, "strict")
    assert len(found) == 2 * (19 + 18)

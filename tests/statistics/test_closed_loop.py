"""Roll-outs in short, with and without stages, of one and of several seeds; and verdicts whose truth is known."""

import json
import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.stats import binom, norm

from pipeline.safety import NOT_FINITE, RUNS
from pipeline.statistics.closed_loop import (
    ALL_ALIKE,
    CLOPPER_PEARSON,
    Driven,
    closed_loop_verdicts,
    compare_rollouts,
    judge_with_rollouts,
    mean_interval,
    success_interval,
    summarise_rollouts,
)
from pipeline.statistics.intervals import t_quantile
from pipeline.statistics.success import clopper_pearson
from pipeline.types import Execution, Rollouts


def rolled(coverage: np.ndarray, **stages) -> Rollouts:
    success = np.array([True, False])
    return Rollouts(
        "any", "1", "p", "pose", np.arange(2), success, np.array([1, 0.5]), coverage, np.array([9, 20]), None, **stages
    )


def of_success(
    success: np.ndarray, score: np.ndarray | None = None, *, version: str = "1", first: int = 0
) -> list[Rollouts]:
    """One `Rollouts` a seed of successes [S, R]; what fails has half the reward unless told otherwise."""
    success = np.asarray(success, bool)
    score = np.where(success, 1.0, 0.5) if score is None else np.asarray(score, float)
    numbers = first + np.arange(success.shape[1])
    rest = (np.full(len(numbers), np.nan), np.full(len(numbers), 9), None)
    return [
        Rollouts("any", version, "p", "pose", numbers, success[seed], score[seed], *rest, seed=seed)
        for seed in range(len(success))
    ]


def drawn(generator, rate: float, seeds: int, starts: np.ndarray | int, *, by_seed: float) -> np.ndarray:
    """[S, R] successes: some start states are harder for everybody (given, or drawn), some seeds are better than others.

    A latent score of start state + seed + chance is above a threshold; `rate` is exact over all that is drawn.
    """
    starts = generator.normal(size=starts) if isinstance(starts, int) else starts
    seed = by_seed * generator.normal(size=(seeds, 1))
    threshold = norm.ppf(rate) * math.sqrt(2 + by_seed**2)
    return threshold + starts + seed + generator.normal(size=(seeds, len(starts))) > 0


# One policy -----------------------------------------------------------------------------------------------------------


def test_a_task_with_a_coverage_keeps_it_and_has_no_stages():
    summary = summarise_rollouts([rolled(np.array([0.96, 0.5]))])
    assert (summary["n"], summary["successes"], summary["success"], summary["score"]) == (2, 1, 0.5, 0.75)
    assert (summary["seeds"], summary["episodes"], summary["first"]) == (1, 2, 0)
    assert summary["success_interval"] == list(clopper_pearson(1, 2))
    assert summary["success_interval_method"] == CLOPPER_PEARSON
    assert summary["score_interval"] is None, "two start states are too few"
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
    assert summary["execution"] == {"execute": 4, "ensemble": False, "delay": 0, "carry_on": False}
    twice = summarise_rollouts([guarded, guarded])
    assert (twice["interventions"], twice["stopped"], twice["intervened"]) == (6, 2, 3 / (9 + 20 + 1))
    assert "interventions" not in summarise_rollouts([rolled(np.array([0.96, 0.5]))])


def test_a_task_with_stages_counts_them_over_all_seeds():
    stages = np.array([[True, True, True], [True, False, False]])
    rollouts = rolled(np.full(2, np.nan), stages=stages, stage_names=("reached", "grasped", "placed"))
    summary = summarise_rollouts([rollouts, rollouts])
    assert "best_coverage" not in summary
    assert (summary["stages"], summary["stage_counts"]) == (["reached", "grasped", "placed"], [4, 2, 2])
    assert (summary["episodes"], summary["successes"], summary["success"]) == (4, 2, 0.5)
    json.dumps(summary, allow_nan=False)


def test_seeds_stand_beside_their_mean():
    success = np.array([[1, 1, 1, 0, 1, 1], [1, 0, 1, 0, 0, 1]])
    summary = summarise_rollouts(of_success(success, np.where(success, 1, [[0.2], [0.4]]), first=40))
    assert summary["per_seed"] == [
        {"seed": 0, "successes": 5, "score": pytest.approx(5.2 / 6)}, {"seed": 1, "successes": 3, "score": pytest.approx(0.7)},
    ]  # fmt: skip
    assert (summary["n"], summary["seeds"], summary["episodes"], summary["first"]) == (6, 2, 12, 40)
    assert summary["success"] == pytest.approx(8 / 12)
    low, high = summary["success_interval"]
    assert 0 <= low < 8 / 12 < high <= 1
    assert summary["success_interval_method"] == summary["score_interval_method"] == "bootstrap-t"


@pytest.mark.parametrize(("seeds", "all_of_them"), list(product((1, 3), (0, 1))))
def test_all_or_none_is_not_certain(seeds, all_of_them):
    """One success (or failure) in fifty is still possible: the interval is that of fifty start states, however many seeds."""
    values = np.full((seeds, 50), float(all_of_them))
    interval, _ = success_interval(values)
    assert interval == pytest.approx(clopper_pearson(50 * all_of_them, 50))
    interval, method = mean_interval(values)
    assert (interval, method) == (pytest.approx(clopper_pearson(50 * all_of_them, 50)), ALL_ALIKE)


def test_equal_scores_are_not_certain_either():
    (low, high), method = mean_interval(np.full((1, 20), 0.4))
    share = clopper_pearson(0, 20)[1]  # at most so many start states give something else, at worst 0 or 1
    assert (low, high, method) == (pytest.approx(0.4 * (1 - share)), pytest.approx(0.4 + 0.6 * share), ALL_ALIKE)


def test_start_states_that_agree_do_not_hide_seeds_that_do_not():
    """One seed always succeeds and two never do: nothing is known of the next."""
    (low, high), _ = mean_interval(np.repeat([[1.0], [0.0], [0.0]], 50, axis=1))
    assert (low < 0.05, high > 0.95) == (True, True)


def test_the_seeds_part_is_a_t_interval_of_the_log_odds():
    """Beside start states in such numbers that they do not count."""
    generator = np.random.default_rng(3)
    values = (generator.random((3, 200_000)) < np.array([[0.97], [0.9], [0.8]])).astype(float)
    rates = values.mean(axis=1)
    mean = rates.mean()
    reach = t_quantile(0.975, 2) * rates.std(ddof=1) / math.sqrt(3) / (mean * (1 - mean))
    odds = mean / (1 - mean)
    expected = [odds * math.exp(way * reach) / (1 + odds * math.exp(way * reach)) for way in (-1, 1)]
    assert mean_interval(values)[0] == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize(
    ("rate", "seeds", "starts", "by_seed"),
    [(0.6, 3, 50, 0.3), (0.9, 3, 50, 0.3), (0.9, 5, 200, 0.3), (0.9, 3, 20, 0.0)],
)
def test_intervals_cover_rates_of_seeds_and_start_states_that_were_not_tried(rate, seeds, starts, by_seed):
    generator, covered, repeats = np.random.default_rng(0), 0, 400
    for _ in range(repeats):
        low, high = success_interval(drawn(generator, rate, seeds, starts, by_seed=by_seed).astype(float))[0]
        covered += low <= rate <= high
    assert covered / repeats >= 0.925


# Two policies ---------------------------------------------------------------------------------------------------------


def verdict_on(a: np.ndarray, b: np.ndarray, metric: str = "success"):
    """The verdict of `judge_with_rollouts` on one pair."""
    return judge_with_rollouts([("a", "b", metric, compare_rollouts(of_success(a), of_success(b), metric))])[0]


def test_one_network_of_each_by_mcnemar_counted_by_hand():
    a, b = np.zeros((2, 1, 30), bool)
    a[0, :5], b[0, 3:12] = True, True
    pair = compare_rollouts(of_success(a), of_success(b), "success")
    only_a, only_b = 3, 7
    assert pair.p == pytest.approx(min(1, 2 * binom.cdf(min(only_a, only_b), only_a + only_b, 0.5)))
    assert pair.difference == pytest.approx((only_a - only_b) / 30)
    assert (pair.one_network, pair.sampled) == (True, "start states")


def test_several_seeds_as_every_pattern_of_signs_says():
    """Slowly: the mean over seeds of each start state, and all 2¹⁰ ways to turn signs."""
    generator = np.random.default_rng(5)
    a, b = generator.random((3, 10)) < 0.9, generator.random((2, 10)) < 0.25
    pair = compare_rollouts(of_success(a), of_success(b), "success")
    differences = [np.mean([a[s, r] for s in range(3)]) - np.mean([b[s, r] for s in range(2)]) for r in range(10)]
    assert pair.difference == pytest.approx(np.mean(differences))
    turned = [abs(np.dot(signs, differences)) for signs in product((-1, 1), repeat=10)]
    p = np.mean([one >= abs(sum(differences)) - 1e-9 for one in turned])
    assert pair.p >= p
    assert pair.least_p == 2 / 2**10
    assert (pair.seeds, pair.one_network) == ((3, 2), False)


def test_one_seed_of_what_is_trained_is_about_one_network():
    a, b = np.ones((2, 3, 20), bool)
    b[:, ::2] = False
    assert not compare_rollouts(of_success(a), of_success(b), "success").one_network
    one, still = of_success(a[:1]), of_success(b[:1])
    assert compare_rollouts(one, still, "score", trained=(True, False)).one_network
    assert not compare_rollouts(of_success(a), still, "score", trained=(True, False)).one_network


@pytest.mark.parametrize(
    ("other", "why"),
    [
        (of_success(np.ones((1, 29))), "start states differ: 0 to 29 (30) and 0 to 28 (29)"),
        (of_success(np.ones((1, 30)), first=9), "start states differ: 0 to 29 (30) and 9 to 38 (30)"),
        (of_success(np.ones((1, 30)), version="2"), "simulator's version differs: 1 and 2"),
    ],
)
def test_what_keeps_two_from_being_compared_is_said(other, why):
    assert compare_rollouts(of_success(np.ones((1, 30))), other, "success") == why


def test_always_equal_and_always_different_have_no_interval_without_width():
    never, always = np.zeros((2, 30), bool), np.ones((2, 30), bool)
    same = compare_rollouts(of_success(never), of_success(never), "success")
    assert (same.same, same.interval, same.smallest_seen) == (True, None, None), (
        "none of thirty is no proof of being equal"
    )
    opposite = compare_rollouts(of_success(always), of_success(never), "success")
    assert opposite.interval == (pytest.approx(1 - 2 * clopper_pearson(0, 30)[1]), 1.0)
    assert opposite.smallest_seen is None
    assert verdict_on(always, never).word == "better"
    assert verdict_on(never, never).words == "equal from all 30 start states"


def test_more_is_better_of_success_and_score():
    a, b = np.ones((1, 40), bool), np.ones((1, 40), bool)
    b[:, ::2] = False
    assert verdict_on(a, b).words == "success 50 points higher (one seed: about this one network)"
    assert verdict_on(b, a).word == "worse"
    score = verdict_on(a, b, "score")
    assert (score.metric, score.word) == ("score", "better")
    assert score.words == "score 0.25 higher (one seed: about this one network)"
    assert verdict_on(b, a, "score").words.startswith("score 0.25 lower")


def test_what_cannot_be_told_says_what_it_would_take():
    generator = np.random.default_rng(1)
    starts = generator.normal(size=60)
    a, b = (drawn(generator, rate, 3, starts, by_seed=0.0) for rate in (0.7, 0.69))
    found = verdict_on(a, b)
    assert found.word == "cannot tell"
    assert found.needs_episodes > 60
    assert f"about {found.needs_episodes:,} start states would show a difference this large" in found.words


@pytest.mark.parametrize(
    ("seeds", "by_seed", "rate"), [(1, 0.0, 0.5), (1, 0.0, 0.95), (3, 0.4, 0.7), (3, 0.4, 0.95), (5, 0.4, 0.5)]
)
def test_equal_methods_are_hardly_ever_told_apart(seeds, by_seed, rate):
    """Equal on the whole: start states, seeds and chance are drawn afresh each time. On success and on score."""
    generator, wrong, repeats = np.random.default_rng(0), np.zeros(2), 300
    for _ in range(repeats):
        starts = generator.normal(size=60)
        a, b = (drawn(generator, rate, seeds, starts, by_seed=by_seed) for _ in "ab")
        wrong += [verdict_on(a, b, metric).word in ("better", "worse") for metric in ("success", "score")]
    assert (wrong / repeats <= 0.05).all(), wrong


def test_a_real_difference_is_found():
    generator, found, repeats = np.random.default_rng(0), 0, 60
    for _ in range(repeats):
        starts = generator.normal(size=60)
        a, b = (drawn(generator, rate, 3, starts, by_seed=0.2) for rate in (0.9, 0.6))
        found += verdict_on(a, b).word == "better"
    assert found / repeats >= 0.8


# A table's verdicts ---------------------------------------------------------------------------------------------------


def rows_of(**successes: np.ndarray) -> list[Driven]:
    return [Driven(f"{name}/pose", name != "hold_still", of_success(success)) for name, success in successes.items()]


@pytest.fixture
def three() -> list[Driven]:
    """50 start states: everything, half, nothing."""
    half = np.tile([True, False], 25)[None]
    return rows_of(half=half, all=np.ones((1, 50), bool), hold_still=np.zeros((1, 50), bool))


def words_of(found) -> dict[tuple[str, str], str]:
    return {(c["a"], c["metric"]): c["word"] for c in found["comparisons"]}


def test_against_the_best_all_pairs_are_in_the_family(three):
    found = closed_loop_verdicts(three, None)
    assert (found["reference"], found["chosen"], found["family"]) == ("all/pose", "best", 2 * 3)
    assert words_of(found) == {
        ("half/pose", "success"): "worse", ("half/pose", "score"): "worse",
        ("hold_still/pose", "success"): "worse", ("hold_still/pose", "score"): "worse",
    }  # fmt: skip
    assert {c["b"] for c in found["comparisons"]} == {"all/pose"}
    json.dumps(found, allow_nan=False)


@pytest.mark.parametrize("champion", ["half", "half/pose"])
def test_against_the_champion_only_those_pairs(three, champion):
    found = closed_loop_verdicts(three, champion)
    assert (found["reference"], found["chosen"], found["family"]) == ("half/pose", "champion", 2 * 2)
    assert words_of(found)["all/pose", "success"] == "better"
    assert words_of(found)["hold_still/pose", "success"] == "worse"


def test_a_champion_that_was_not_rolled_out_gives_way_to_the_best(three):
    assert closed_loop_verdicts(three, "late")["chosen"] == "best"
    assert closed_loop_verdicts(three[:1], None) is None


def test_score_decides_who_is_best_where_nothing_succeeds():
    never = np.zeros((1, 20), bool)
    scores = {"a": 0.1, "b": 0.3, "c": 0.2}
    rows = [Driven(name, True, of_success(never, np.full((1, 20), score))) for name, score in scores.items()]
    assert closed_loop_verdicts(rows, None)["reference"] == "b"


@pytest.mark.slow
@pytest.mark.parametrize(("seeds", "by_seed"), [(1, 0.0), (3, 0.4)])
def test_whoever_is_best_by_luck_beats_nobody(seeds, by_seed):
    """Five equal methods: of a hundred tables at most five call any of them worse than the best."""
    generator, wrong, repeats = np.random.default_rng(0), 0, 150
    for _ in range(repeats):
        starts = generator.normal(size=50)
        rows = rows_of(**{f"p{i}": drawn(generator, 0.7, seeds, starts, by_seed=by_seed) for i in range(5)})
        found = closed_loop_verdicts(rows, None)
        wrong += any(word in ("better", "worse") for word in words_of(found).values())
    assert wrong / repeats <= 0.05

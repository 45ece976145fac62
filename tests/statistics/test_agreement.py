"""Which offline score predicts success: by hand, and over simulated checkpoints whose truth is known."""

import math

import numpy as np
import pytest
from scipy.stats import spearmanr

from pipeline.statistics.agreement import (
    Checkpoint,
    agreements,
    answer,
    ceiling,
    correlate,
    correlate_within,
    difference_to_plain,
    methods_needed,
    mid_ranks,
    refusal,
    shuffles,
    spearman,
    within_methods,
)
from speed.agreement import drawn

SCORES = {"whole_chunk_mae": "whole-chunk error", "executed_mae": "executed error"}


def checkpoints(sizes, between, within, seed, *, seeds=2, starts=50, **more):
    """Checkpoints whose executed error is correlated with success; their whole-chunk error is not."""
    random = np.random.default_rng(seed)
    error, outcome, method, policy = drawn(sizes, between, within, random, seeds=seeds, **more)
    found = []
    for i, (e, o, m, p) in enumerate(zip(error, outcome, method, policy, strict=True)):
        reward = random.uniform(size=starts) * 0.2 + 0.8 / (1 + math.exp(-2 * o))
        offline = {"whole_chunk_mae": float(random.normal()), "executed_mae": float(e)}
        success = random.uniform(size=starts) < 1 / (1 + math.exp(-2 * o))
        found.append(Checkpoint(f"m{m}", f"p{p}", "pose", 4, i % seeds, offline, success, np.minimum(reward, 1)))
    return found


# by hand --------------------------------------------------------------------------------------------------------------


def test_mid_ranks_share():
    assert mid_ranks(np.array([3.0, 1.0, 3.0, 0.0])).tolist() == [3.0, 1.5, 3.0, 0.5]


def test_spearman_is_scipys_with_ties():
    random = np.random.default_rng(0)
    for _ in range(5):
        a, b = random.integers(0, 4, size=(2, 20)).astype(float)
        assert spearman(a, b) == pytest.approx(spearmanr(a, b).statistic)
    assert math.isnan(spearman(np.ones(5), np.arange(5.0)))


def test_within_methods_by_hand():
    method = np.array([0, 0, 0, 1, 1, 2, 2])
    a = np.array([1.0, 2.0, 3.0, 50.0, 40.0, 7.0, 7.0])
    b = np.array([0.1, 0.3, 0.2, 0.9, 0.8, 0.0, 0.5])
    # Method 0: ranks −1 0 1 and −1 1 0 over 4: product 1/16, squares 2/16. Method 1: ½ −½ both over 3: ½/9. Method 2 says nothing.
    assert within_methods(a, b, method) == pytest.approx((1 / 16 + 0.5 / 9) / (2 / 16 + 0.5 / 9))
    assert within_methods(a, -b, method) == pytest.approx(-within_methods(a, b, method))
    assert math.isnan(within_methods(a, np.zeros(7), method))


def test_a_correlation_between_methods_alone_is_none_within_them():
    method = np.repeat(np.arange(6), 4)
    error = -10.0 * method + np.tile([0.0, 1.0, 2.0, 3.0], 6)
    outcome = 10.0 * method + np.tile([1.0, 3.0, 0.0, 2.0], 6)
    overall, inside = (
        correlate(error, outcome, method),
        correlate_within(error, outcome, method, np.tile(np.arange(4), 6)),
    )
    assert overall.interval[0] > 0
    # Ranks 1.5 .5 −.5 −1.5 of minus the error and −.5 1.5 −1.5 .5 of the outcome: product −.75 + .75 + .75 − .75 = 0.
    assert inside.value == pytest.approx(0.0)
    assert inside.p == 1.0
    assert (overall.methods, inside.methods, inside.checkpoints) == (6, 6, 24)


def test_seeds_of_a_policy_stay_together_when_shuffled():
    method, policy = np.array([0, 0, 0, 0, 0, 1, 1]), np.array(["a", "a", "b", "b", "c", "d", "d"])
    dealt = shuffles(method, policy, 200)
    pairs = {tuple(row[:4]) for row in dealt.tolist()}
    assert pairs == {(0, 1, 2, 3), (2, 3, 0, 1)}
    assert (dealt[:, 4] == 4).all()  # a policy of another number of seeds changes places with none
    assert {tuple(row[5:]) for row in dealt.tolist()} == {(5, 6), (6, 5)}  # a method of one policy: its seeds do
    assert shuffles(np.array([0, 1]), np.array(["a", "b"]), 9) is None


def test_methods_needed_grow_as_the_correlation_shrinks():
    assert methods_needed(1.0, 0.4, 6) < methods_needed(0.5, 0.4, 6)
    assert methods_needed(0.0, 0.4, 6) is None


# what is refused ------------------------------------------------------------------------------------------------------


def test_refusals_say_what_there_is():
    few = checkpoints((1, 1, 1, 1, 1), 0.9, 0.9, 0)
    assert refusal(few) == "not enough: has 10 of 24 distinct checkpoints (method, chunk, seed)"
    assert refusal(few * 3).startswith("not enough: has 10 of 24")  # the same ones again are not more
    alike = checkpoints((8, 8), 0.9, 0.9, 0)
    assert "has 2 of 5 methods" in refusal(alike)
    (found, _) = agreements(few, list(SCORES), "success")
    assert found.overall is None
    assert "10 of 24" in found.refused


def test_nothing_to_predict():
    never = [
        Checkpoint(c.method, c.policy, c.observations, c.chunk, c.seed, c.offline, np.zeros(50, bool), c.best_reward)
        for c in checkpoints((3,) * 5, 0.9, 0.9, 0)
    ]
    of_success, of_score = (agreements(never, list(SCORES), target) for target in ("success", "score"))
    assert "the same success rate, 0" in of_success[0].refused
    assert of_score[1].overall.value > 0.5
    said = answer(of_success, of_success, never, SCORES)
    assert (said.word, said.named) == ("cannot tell", None)
    assert "nothing to predict" in said.words


def test_a_score_that_some_do_not_have_is_not_compared():
    some = checkpoints((3,) * 5, 0.9, 0.9, 0)
    del some[4].offline["executed_mae"]
    whole, executed = agreements(some, list(SCORES), "success")
    assert whole.overall is not None
    assert executed.refused == "1 of 30 checkpoints do not have this score"


def test_one_method_with_all_the_success_gives_no_interval():
    method = np.repeat(np.arange(5), 5)
    outcome = np.where(method == 4, np.arange(25.0), 0.0)
    found = correlate(-outcome, outcome, method)
    assert found.value == pytest.approx(1.0)
    assert found.interval is None


def test_a_perfect_order_is_not_perfectly_sure():
    method = np.repeat(np.arange(6), 4)
    found = correlate(-np.arange(24.0), np.arange(24.0), method)
    assert found.value == pytest.approx(1.0)
    assert 0.9 < found.interval[0] < 0.999


# answers --------------------------------------------------------------------------------------------------------------


def test_the_score_that_predicts_is_named_and_found_again():
    first, second = (checkpoints((3,) * 8, 0.95, 0.95, seed, starts=200) for seed in (1, 2))
    said = answer(*(agreements(one, list(SCORES), "success") for one in (first, second)), second, SCORES)
    assert (said.named, said.word, said.over_plain) == ("executed_mae", "yes", "better")
    assert said.difference_interval[0] > 0
    assert "surely above zero" in said.words
    assert "better than the whole-chunk error" in said.words


def test_what_does_not_predict_ends_in_cannot_tell():
    first, second = checkpoints((3,) * 8, 0.95, 0.95, 1), checkpoints((3,) * 5, 0.3, 0.0, 6)
    said = answer(*(agreements(one, list(SCORES), "success") for one in (first, second)), second, SCORES)
    assert said.word == "cannot tell"
    assert "methods like these would tell" in said.words


def test_the_plain_score_is_compared_with_nothing():
    some = checkpoints((3,) * 8, 0.9, 0.9, 1)
    found = agreements(some, ["whole_chunk_mae"], "success")
    said = answer(found, found, some, SCORES)
    assert (said.named, said.over_plain, said.difference) == ("whole_chunk_mae", None, None)


# how noisy success is -------------------------------------------------------------------------------------------------


def test_the_ceiling_is_what_a_perfect_predictor_reaches():
    """Rates known exactly are the perfect predictor: its correlation with what 20 start states show is the ceiling."""
    random = np.random.default_rng(5)
    reached, said = [], []
    for _ in range(40):
        rates = random.uniform(0.3, 0.7, size=40)
        shown = [random.uniform(size=20) < rate for rate in rates]
        reached.append(spearman(rates, np.array([one.mean() for one in shown])))
        said.append(ceiling([one.astype(float) for one in shown], same_starts=False))
    assert np.mean(said) == pytest.approx(np.mean(reached), abs=0.04)
    assert np.mean(said) < 0.8


def test_start_states_that_are_hard_for_all_are_no_noise():
    hard = np.tile([0.0, 1.0], 15)
    outcomes = [np.clip(hard + 0.02 * level, 0, 2) for level in range(30)]
    assert ceiling(outcomes, same_starts=True) == pytest.approx(1.0, abs=1e-6)
    assert ceiling(outcomes, same_starts=False) < 0.9


def test_no_ceiling_where_nothing_differs():
    assert ceiling([np.zeros(10)] * 5, same_starts=True) is None
    assert ceiling([np.zeros(1), np.ones(1)], same_starts=True) is None


# known truths over many sets ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ties", [False, True])
@pytest.mark.parametrize("sizes", [(3, 3, 2, 2, 2), (4,) * 6])
def test_where_nothing_predicts_a_yes_is_rare(sizes, ties):
    """One-sided at 2.5 %; with methods that differ much, where 30 checkpoints are hardly more than 5."""
    random = np.random.default_rng(7)
    sure = []
    for _ in range(300):
        error, outcome, method, _ = drawn(sizes, 0.0, 0.0, random, share=0.8, ties=ties)
        if outcome.any():
            found = correlate(error, outcome, method)
            sure.append(found.interval is not None and found.interval[0] > 0)
    assert np.mean(sure) <= 0.05


@pytest.mark.parametrize(("between", "within", "truth"), [(0.0, 0.0, 0.0), (0.7, 0.3, 0.52), (0.9, 0.9, 0.89)])
def test_intervals_cover(between, within, truth):
    """The truth is Spearman's of all checkpoints there could be: (6 / π) asin(r / 2) of a normal correlation r."""
    r = 0.6 * between + 0.4 * within
    assert 6 / math.pi * math.asin(r / 2) == pytest.approx(truth, abs=0.01)
    random = np.random.default_rng(8)
    held = []
    for _ in range(300):
        error, outcome, method, _ = drawn((4,) * 6, between, within, random)
        low, high = correlate(error, outcome, method).interval
        held.append(low <= truth <= high)
    assert 0.92 <= np.mean(held) <= 0.995


def test_shuffling_within_methods_keeps_its_level():
    random = np.random.default_rng(9)
    null, real = (
        [correlate_within(*drawn((4,) * 6, 0.9, within, random), permutations=399).p <= 0.05 for _ in range(200)]
        for within in (0.0, 0.9)
    )
    assert np.mean(null) <= 0.1
    assert np.mean(real) >= 0.95


def test_one_of_two_scores_that_are_as_good_is_rarely_called_better():
    random = np.random.default_rng(10)
    called = []
    for _ in range(200):
        error, outcome, method, policy = drawn((4,) * 6, 0.7, 0.3, random)
        noise = random.normal(size=(2, len(error))) + random.normal(size=(2, 6))[:, method]
        found = [
            Checkpoint(f"m{m}", f"p{p}", "pose", 4, i % 2, {"whole_chunk_mae": e + a, "executed_mae": e + b}, [o], [o])
            for i, (e, o, m, p, a, b) in enumerate(zip(error, outcome, method, policy, *noise, strict=True))
        ]
        value, (low, high) = difference_to_plain(found, "executed_mae", "success")
        assert low < value < high
        called.append(not low <= 0 <= high)
    assert np.mean(called) <= 0.08

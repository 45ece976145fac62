"""Success rates: intervals, tests and verdicts, against scipy's own, exact enumeration and published numbers."""

import math
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import gammaln
from scipy.stats import binom, boschloo_exact, fisher_exact

from pipeline.statistics import success
from pipeline.statistics.success import Count, clopper_pearson, compare_counts, compare_trials, mcnemar, wilson
from pipeline.statistics.trials import Trials


def count(successes: int, trials: int, name: str | None = None) -> Count:
    return Count(name or f"{successes}/{trials}", successes, trials)


def trials(rows) -> Trials:
    """Rows of (policy, start state, success[, stage])."""
    policy, start, outcome, *stage = zip(*rows, strict=True)
    return Trials(np.array(policy), np.array(start), np.array(outcome, bool), np.array(*stage) if stage else None)


def tried_once(**outcomes: str) -> Trials:
    """`a="1101"`: policy a succeeded from start states 0, 1 and 3."""
    return trials([(p, str(i), c == "1") for p, row in outcomes.items() for i, c in enumerate(row)])


# one rate -------------------------------------------------------------------------------------------------------------


def test_known_intervals():
    assert clopper_pearson(0, 50) == pytest.approx((0.0, 0.0711), abs=1e-4)
    assert clopper_pearson(18, 20) == pytest.approx((0.6830, 0.9877), abs=1e-4)
    # Newcombe 1998, Statistics in Medicine 17, table I: 81 of 263 and 15 of 148.
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert wilson(15, 148) == pytest.approx((0.0624, 0.1605), abs=1e-4)


@pytest.mark.parametrize(("successes", "trials"), [(3, 2), (-1, 5), (0, 0)])
def test_impossible_counts_are_refused(successes, trials):
    for interval in (clopper_pearson, wilson):
        with pytest.raises(ValueError, match=r"k|n|must"):
            interval(successes, trials)


@given(st.integers(1, 60).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
@settings(max_examples=60, deadline=None)
def test_what_a_count_pins_down(pair):
    found = success.describe_count(count(*pair))
    (low, high), (narrow_low, narrow_high) = found["clopper_pearson"], found["wilson"]
    assert 0 <= low <= found["rate"] <= high <= 1
    assert high - low >= narrow_high - narrow_low - 0.02
    mirrored = success.describe_count(count(pair[1] - pair[0], pair[1]))["clopper_pearson"]
    assert mirrored == pytest.approx([1 - high, 1 - low], abs=1e-9)


# two rates ------------------------------------------------------------------------------------------------------------


def test_mcnemar_by_counting_coins():
    a = np.array([1, 1, 1, 1, 1, 1, 0, 1, 0], bool)
    b = np.array([0, 0, 0, 0, 0, 1, 1, 1, 0], bool)
    coins = sum(math.comb(6, k) for k in (0, 1, 5, 6)) / 2**6
    assert mcnemar(a, b) == pytest.approx(coins)
    assert mcnemar(a, a) == 1.0
    assert mcnemar(a, b) == mcnemar(b, a)
    with pytest.raises(ValueError, match="same start states"):
        mcnemar(a, b[:3])


def test_two_counts_are_told_apart_by_boschloo():
    (pair,) = compare_counts([count(18, 20), count(9, 20)])
    table = [[18, 9], [2, 11]]
    assert (pair.word, pair.test, pair.units, pair.n) == ("better", "Boschloo", "trials", (20, 20))
    assert pair.p == pytest.approx(boschloo_exact(table).pvalue, rel=1e-6)
    assert pair.fisher == pytest.approx(fisher_exact(table).pvalue)
    assert pair.p_holm == pair.p
    (turned,) = compare_counts([count(9, 20), count(18, 20)])
    assert turned.word == "worse"
    assert turned.p == pytest.approx(pair.p)


def test_holm_over_all_pairs():
    pairs = compare_counts([count(18, 20), count(16, 20), count(5, 20)])
    assert [(pair.a, pair.b) for pair in pairs] == [("18/20", "16/20"), ("18/20", "5/20"), ("16/20", "5/20")]
    smallest = min(pairs, key=lambda pair: pair.p)
    assert smallest.p_holm == pytest.approx(3 * smallest.p)
    assert [pair.word for pair in pairs] == ["cannot tell", "better", "better"]
    alone = compare_counts([count(18, 20), count(16, 20)])[0]
    assert pairs[0].needs > alone.needs
    assert pairs[0].smallest_seen > alone.smallest_seen
    assert "after Holm over 3 pairs" in pairs[0].words


def test_equal_and_nearly_equal_counts():
    (same,) = compare_counts([count(20, 20, "a"), count(20, 20, "b")])
    assert (same.word, same.p, same.needs) == ("cannot tell", 1.0, None)
    assert "Equal rates cannot be told apart by any number" in same.words
    (close,) = compare_counts([count(180, 200), count(178, 200)])
    assert close.needs is None
    assert "more than 1,000 trials of each policy" in close.words
    (few,) = compare_counts([count(1, 1), count(0, 1)])
    assert (few.word, few.smallest_seen) == ("cannot tell", None)
    assert "no difference could have been seen" in few.words


def test_an_answer_takes_seconds_whatever_the_counts():
    began = time.perf_counter()
    (many,) = compare_counts([count(300, 500), count(262, 500)])
    assert many.test == "Boschloo"
    (more,) = compare_counts([count(30_000, 50_000), count(29_000, 50_000)])
    assert (more.test, more.p) == ("Fisher", more.fisher)
    crowd = compare_counts([count(30 + i, 100, str(i)) for i in range(12)])
    assert {pair.test for pair in crowd} == {"Fisher"}
    assert time.perf_counter() - began < 20


# how many trials ------------------------------------------------------------------------------------------------------


def boschloo_rejects(n: int, alpha: float = 0.05) -> np.ndarray:
    """[n + 1, n + 1]: is the table (x, n − x; y, n − y) significant? Slow and obvious: the largest set of tables with the
    smallest Fisher p whose probability stays below alpha / 2 for every common rate, and its mirror image."""
    k = np.arange(n + 1)
    ways = gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1)
    joint, both = ways[:, None] + ways, k[:, None] + k
    total = np.arange(2 * n + 1)
    ways_both = gammaln(2 * n + 1) - gammaln(total + 1) - gammaln(2 * n - total + 1)
    fisher = np.exp(joint - ways_both[both])
    for x in range(1, n + 1):
        fisher[x, :-1] += fisher[x - 1, 1:]
    order = np.argsort(fisher, axis=None, kind="stable")
    ranked, worst = fisher.ravel()[order], np.zeros(fisher.size)
    for rate in np.linspace(0, 1, 202)[1:-1]:
        chance = np.exp(joint + both * np.log(rate) + (2 * n - both) * np.log1p(-rate))
        np.maximum(worst, np.cumsum(chance.ravel()[order]), out=worst)
    last_of_ties = np.append(ranked[1:] > ranked[:-1] * (1 + 1e-9), True)
    allowed = np.flatnonzero((worst <= alpha / 2) & last_of_ties)
    low = fisher <= ranked[allowed[-1]] * (1 + 1e-9) if len(allowed) else np.zeros_like(fisher, bool)
    return low | low.T


def boschloo_power(n: int, rate_a: float, rate_b: float) -> float:
    k = np.arange(n + 1)
    return float(binom.pmf(k, n, rate_a) @ boschloo_rejects(n) @ binom.pmf(k, n, rate_b))


def test_the_enumeration_agrees_with_scipy():
    n = 5
    tables = [[[a, b], [n - a, n - b]] for a in range(n + 1) for b in range(n + 1)]
    assert [boschloo_exact(t).pvalue <= 0.05 for t in tables] == boschloo_rejects(n).ravel().tolist()


@pytest.mark.parametrize(
    ("rate_a", "rate_b"),
    [(1.0, 0.7), (1.0, 0.3), (0.95, 0.5), (0.95, 0.8), (0.9, 0.8), (0.9, 0.6), (0.9, 0.1), (0.7, 0.5), (0.5, 0.1), (1.0, 0.0)],
)  # fmt: skip
def test_needed_trials_have_the_power_that_is_claimed(rate_a, rate_b):
    needed = success.trials_needed(rate_a, rate_b)
    assert boschloo_power(needed, rate_a, rate_b) >= 0.78
    fewer = math.floor(0.8 * needed) - 1
    assert boschloo_power(fewer, rate_a, rate_b) < 0.8


@pytest.mark.parametrize(("successes", "n"), [(17, 20), (10, 20), (45, 50), (2, 50), (60, 100)])
def test_the_smallest_difference_is_really_seen(successes, n):
    (pair,) = compare_counts([count(successes, n, "a"), count(successes, n, "b")])
    rate, side = successes / n, -1 if successes / n >= 0.5 else 1
    assert boschloo_power(n, rate, rate + side * pair.smallest_seen) >= 0.78
    assert boschloo_power(n, rate, rate + side * 0.8 * pair.smallest_seen) < 0.8


def mcnemar_power(n: int, only_a: float, only_b: float) -> float:
    differ, power = only_a + only_b, 0.0
    for m in range(n + 1):
        k = np.arange(m + 1)
        p = np.minimum(1, 2 * np.minimum(binom.cdf(k, m, 0.5), binom.sf(k - 1, m, 0.5)))
        power += binom.pmf(m, n, differ) * binom.pmf(k[p <= 0.05], m, only_a / differ).sum()
    return power


@pytest.mark.parametrize(("only_a", "only_b"), [(4, 0), (8, 0), (6, 2), (3, 1), (10, 2), (16, 0)])
def test_needed_start_states_have_the_power_that_is_claimed(only_a, only_b):
    n = 20
    rest = n - only_a - only_b
    data = tried_once(a="1" * only_a + "0" * only_b + "1" * rest, b="0" * only_a + "1" * only_b + "1" * rest)
    (pair,) = compare_trials(data)
    needed = success._starts_needed(np.array([1.0] * only_a + [-1.0] * only_b + [0.0] * rest), 0.05)
    assert pair.needs == needed
    assert mcnemar_power(needed, only_a / n, only_b / n) >= 0.77
    assert mcnemar_power(math.floor(0.8 * needed) - 1, only_a / n, only_b / n) < 0.8


@pytest.mark.parametrize("n", [10, 20, 50])
def test_the_smallest_paired_difference_is_really_seen(n):
    seen = success._smallest_paired(np.zeros(n), True, 0.05)
    assert mcnemar_power(n, seen, 0.0) >= 0.77


# trials ---------------------------------------------------------------------------------------------------------------


def test_same_start_states_are_paired():
    a, b = "11111111110", "00000001111"
    (pair,) = compare_trials(tried_once(a=a, b=b))
    assert (pair.test, pair.units, pair.n, pair.left_out) == ("McNemar", "start states", (11, 11), 0)
    assert pair.p == pytest.approx(mcnemar(np.array(list(a)) == "1", np.array(list(b)) == "1"))
    assert (pair.word, pair.fisher) == ("cannot tell", None)
    assert pair.difference == pytest.approx(6 / 11)
    (turned,) = compare_trials(tried_once(b=b, a=a))
    assert turned.difference == pytest.approx(-pair.difference)


def test_only_shared_start_states_are_compared():
    data = trials([("a", s, s != "0") for s in "0123456789"] + [("b", s, s == "5") for s in "456789xyz"])
    (pair,) = compare_trials(data)
    assert (pair.n, pair.left_out) == ((6, 6), 7)
    assert "over the 6 start states that both were tried from, without 7 trials" in pair.words


def test_several_trials_a_start_state_are_averaged_and_flipped():
    rows = [("a", str(s), i > 0) for s in range(8) for i in range(3)] + [("b", str(s), False) for s in range(8)]
    (pair,) = compare_trials(trials(rows))
    assert (pair.test, pair.n, pair.word) == ("sign-flip", (8, 8), "better")
    assert pair.difference == pytest.approx(2 / 3)
    assert pair.p == pytest.approx(2 / 2**8)
    counts = success.counts_of(trials(rows))
    assert [c.several for c in counts] == [True, False]
    assert "tried several times" in success.describe_count(counts[0])["words"]


def test_more_trials_of_one_start_state_are_no_more_evidence():
    once = tried_once(a="1111", b="0000")
    often = trials([(p, str(s), p == "a") for p in "ab" for s in range(4) for _ in range(25)])
    assert compare_trials(often)[0].p == compare_trials(once)[0].p == pytest.approx(2 / 2**4)


def test_no_shared_start_state():
    unrelated = trials([("a", f"a{i}", True) for i in range(10)] + [("b", f"b{i}", False) for i in range(10)])
    (pair,) = compare_trials(unrelated)
    assert (pair.test, pair.units, pair.word) == ("Boschloo", "trials", "better")
    repeated = trials([("a", "x", True)] * 10 + [("b", "y", False)] * 10)
    (pair,) = compare_trials(repeated)
    assert (pair.word, pair.p, pair.test) == ("not comparable", None, None)
    assert "share no start state" in pair.words


def test_holm_counts_comparable_pairs_only():
    rows = [("a", str(i), True) for i in range(9)] + [("b", str(i), False) for i in range(9)] + [("c", "z", True)] * 5
    pairs = {(pair.a, pair.b): pair for pair in compare_trials(trials(rows))}
    assert pairs["a", "b"].p_holm == pairs["a", "b"].p
    assert {pairs["a", "c"].word, pairs["b", "c"].word} == {"not comparable"}


@given(st.integers(0, 2**20))
@settings(max_examples=25, deadline=None)
def test_turning_a_pair_turns_the_verdict(seed):
    random = np.random.default_rng(seed)
    rows = [(p, str(s), random.random() < q) for p, q in (("a", 0.9), ("b", 0.3)) for s in random.integers(9, size=12)]
    turned = [row for row in rows if row[0] == "b"] + [row for row in rows if row[0] == "a"]
    (one,), (other,) = compare_trials(trials(rows)), compare_trials(trials(turned))
    if one.word == "not comparable":
        assert other.word == "not comparable"
        return
    opposite = {"better": "worse", "worse": "better", "cannot tell": "cannot tell"}
    assert other.word == opposite[one.word]
    assert other.p == pytest.approx(one.p, rel=1e-6)
    assert other.difference == pytest.approx(-one.difference)


def test_false_verdicts_stay_rare():
    """400 pairs of equal policies from the same start states: at most 5 % called better or worse (and some are)."""
    random, wrong = np.random.default_rng(0), 0
    for _ in range(400):
        rate = random.beta(2, 1, size=20)
        a, b = (random.random((2, 20)) < rate).astype(int)
        (pair,) = compare_trials(tried_once(a="".join(map(str, a)), b="".join(map(str, b))))
        wrong += pair.word != "cannot tell"
    assert 0 < wrong <= 20


# stages, roll-outs ----------------------------------------------------------------------------------------------------


def test_numbered_stages_include_those_before():
    data = trials([("a", "0", 1, 3.0), ("a", "1", 0, 1.0), ("b", "0", 0, 0.0), ("b", "1", 0, 1.0)])
    a, b = success.describe_stages(data)
    assert a == {"policy": "a", "trials": 2, "reached": {"0": 2, "1": 2, "3": 1}, "mean_stage": 2.0}
    assert b["reached"] == {"0": 2, "1": 1, "3": 0}


def test_named_stages_are_where_trials_ended():
    data = trials(
        [("a", "0", 1, "placed"), ("a", "1", 0, "grasped"), ("b", "0", 0, "grasped"), ("b", "1", 0, "grasped")]
    )
    a, b = success.describe_stages(data)
    assert a == {"policy": "a", "trials": 2, "ended_at": {"placed": 1, "grasped": 1}, "mean_stage": None}
    assert b["ended_at"] == {"placed": 0, "grasped": 2}
    assert success.describe_stages(tried_once(a="11", b="01")) == []

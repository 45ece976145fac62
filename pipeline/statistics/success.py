"""Success rates of closed-loop trials: how sure each is, and which of two is better.

What belongs here: intervals, tests and plain verdicts from counts or trials. What does not: running trials
(`simulate`), reading a file of them (`trials`), printing (`demobench.success`).

The tests are scipy's. A success rate is better when it is higher. The needed numbers of trials are normal
approximations for a power of 80 %; the tests hold them against the exact power of Boschloo's test.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Literal

import numpy as np

from pipeline.statistics.comparisons import POWER, SURE, Word, holm, sign_flip
from pipeline.statistics.trials import Trials

MOST_TRIALS = 1000
"""Beyond this a needed number of trials is "more than 1,000"."""
BOSCHLOO_WORK = 260_000
"""Boschloo's test takes about 3 s for 500 trials against 500, as the product of the two grows; more is left to Fisher's."""


@dataclass(frozen=True)
class Count:
    """Successes of one policy. `several` says that some start state was tried more than once."""

    policy: str
    successes: int
    trials: int
    several: bool = False

    @property
    def rate(self) -> float:
        return self.successes / self.trials


@dataclass(frozen=True)
class SuccessComparison:
    """Policy a against policy b; JSON-able by `asdict`.

    difference     rate of a − rate of b (over the start states that both were tried from, where they are paired)
    p, p_holm      two-sided, alone and after Holm over all pairs; fisher beside Boschloo's, for unrelated trials
    units          what n counts: "trials" of each policy, or "start states"
    n              (of a, of b)
    left_out       trials from start states that only one of the two was tried from
    smallest_seen  the smallest difference that would have been found with a power of 80 %; None: none at all
    needs          units of each policy that would tell the observed rates apart; None: more than 1,000, or they are equal
    """

    a: str
    b: str
    word: Word
    test: Literal["Boschloo", "Fisher", "McNemar", "sign-flip"] | None
    difference: float | None
    p: float | None
    p_holm: float | None
    fisher: float | None
    units: Literal["trials", "start states"]
    n: tuple[int, int]
    left_out: int
    smallest_seen: float | None
    needs: int | None
    words: str


# one rate -------------------------------------------------------------------------------------------------------------


def clopper_pearson(successes: int, trials: int, *, level: float = 0.95) -> tuple[float, float]:
    """The exact interval of a success rate (Clopper & Pearson 1934), for trials of one model.

    Raises:
        ValueError: not 0 ≤ successes ≤ trials, or no trials.
    """
    return _interval(successes, trials, level, "exact")


def wilson(successes: int, trials: int, *, level: float = 0.95) -> tuple[float, float]:
    """Wilson's score interval (Wilson 1927): shorter, and covering too little near 0 and 1.

    Raises:
        ValueError: not 0 ≤ successes ≤ trials, or no trials.
    """
    return _interval(successes, trials, level, "wilson")


def _interval(successes: int, trials: int, level: float, method: str) -> tuple[float, float]:
    from scipy.stats import binomtest

    bounds = binomtest(successes, trials).proportion_ci(confidence_level=level, method=method)
    return float(bounds.low), float(bounds.high)


def describe_count(count: Count) -> dict[str, Any]:
    """A count with both intervals and, in words, what it pins down (JSON-able)."""
    low, high = clopper_pearson(count.successes, count.trials)
    digits = 1 if high - low < 0.05 else 0
    words = (
        f"{count.policy}: {_plural(count.trials, 'trial')}, so the rate is known to about ± {_points(50 * (high - low))}: "
        f"it lies between {100 * low:.{digits}f} and {100 * high:.{digits}f} %."
    )
    if count.several:
        words += " Some start states were tried several times; for new start states it is less certain than that."
    return {
        "policy": count.policy,
        "successes": count.successes,
        "trials": count.trials,
        "rate": count.rate,
        "clopper_pearson": [low, high],
        "wilson": list(wilson(count.successes, count.trials)),
        "words": words,
    }


# two rates ------------------------------------------------------------------------------------------------------------


def mcnemar(a: np.ndarray, b: np.ndarray) -> float:
    """The exact two-sided McNemar test of two policies tried once each from the same R start states.

    Parameters
    ----------
    a, b : [R] bool, success from each start state. Only the pairs that differ count; without one p is 1.

    Raises
    ------
    ValueError : the two are not of one length.
    """
    from scipy.stats import binomtest

    a, b = np.asarray(a, bool), np.asarray(b, bool)
    if a.shape != b.shape or a.ndim != 1:
        raise ValueError(f"a is {a.shape} and b {b.shape}; expected two arrays [R] over the same start states")
    only_a, only_b = int((a & ~b).sum()), int((b & ~a).sum())
    return float(binomtest(only_a, only_a + only_b).pvalue) if only_a + only_b else 1.0


def compare_counts(counts: Sequence[Count]) -> list[SuccessComparison]:
    """All pairs of counts from unrelated trials: Boschloo's test with Fisher's beside it, and Holm over the pairs."""
    pairs = list(combinations(counts, 2))
    return _judge([_unrelated(a, b, _boschloo_is_quick(pairs), len(pairs)) for a, b in pairs])


def compare_trials(trials: Trials) -> list[SuccessComparison]:
    """All pairs of policies, paired by start state where they share start states, and Holm over the pairs.

    Two policies tried once from each of the start states they share: exact McNemar. Several trials a start state: the
    mean for each start state, and a sign-flip over start states. No start state in common and none tried twice: trials
    drawn at random, compared as counts. No start state in common but some tried several times: not comparable.
    """
    by_start = {policy: _by_start(trials, policy) for policy in trials.policies}
    counts = {count.policy: count for count in counts_of(trials)}
    pairs = list(combinations(counts.values(), 2))
    quick = _boschloo_is_quick(pairs)
    found = []
    for a, b in pairs:
        common = [start for start in by_start[a.policy] if start in by_start[b.policy]]
        if common:
            tried = [[by_start[count.policy][start] for start in common] for count in (a, b)]
            found.append(_paired(a, b, *tried, len(pairs)))
        elif a.several or b.several:
            found.append(_no_common_start(a, b))
        else:
            found.append(_unrelated(a, b, quick, len(pairs)))
    return _judge(found)


def counts_of(trials: Trials) -> list[Count]:
    """One count a policy, in the order of the file."""
    found = []
    for policy in trials.policies:
        mine = trials.policy == policy
        several = len(np.unique(trials.start[mine])) < mine.sum()
        found.append(Count(policy, int(trials.success[mine].sum()), int(mine.sum()), bool(several)))
    return found


def _by_start(trials: Trials, policy: str) -> dict[str, list[bool]]:
    """Start state → successes of its trials, in the order of the file."""
    tried: dict[str, list[bool]] = {}
    mine = trials.policy == policy
    for start, success in zip(trials.start[mine].tolist(), trials.success[mine].tolist(), strict=True):
        tried.setdefault(start, []).append(success)
    return tried


def _boschloo_is_quick(pairs: Sequence[tuple[Count, Count]]) -> bool:
    """One test for the whole family: Boschloo's where all pairs together take a few seconds."""
    return sum(a.trials * b.trials + 2000 for a, b in pairs) <= BOSCHLOO_WORK


def _unrelated(a: Count, b: Count, boschloo: bool, pairs: int) -> SuccessComparison:
    from scipy.stats import boschloo_exact, fisher_exact

    table = [[a.successes, b.successes], [a.trials - a.successes, b.trials - b.successes]]
    fisher = float(fisher_exact(table).pvalue)
    p = float(boschloo_exact(table).pvalue) if boschloo else fisher
    pooled = (a.successes + b.successes) / (a.trials + b.trials)
    return SuccessComparison(
        a.policy, b.policy, "cannot tell", "Boschloo" if boschloo else "Fisher", a.rate - b.rate, p, None, fisher,
        "trials", (a.trials, b.trials), 0, _smallest_unrelated(pooled, a.trials, b.trials, SURE / pairs),
        trials_needed(a.rate, b.rate, alpha=SURE / pairs), "",
    )  # fmt: skip


def _paired(
    a: Count, b: Count, tried_a: Sequence[list[bool]], tried_b: Sequence[list[bool]], pairs: int
) -> SuccessComparison:
    """Over the start states that both were tried from; `tried_*` hold the successes from each."""
    once = all(len(tried) == 1 for tried in (*tried_a, *tried_b))
    means_a, means_b = (np.array([np.mean(tried) for tried in side]) for side in (tried_a, tried_b))
    differences = means_a - means_b
    if once:
        test, p = "McNemar", mcnemar(means_a > 0, means_b > 0)
    else:
        test, p = "sign-flip", float(sign_flip(differences))
    n, alpha = len(differences), SURE / pairs
    left_out = a.trials + b.trials - sum(len(tried) for tried in (*tried_a, *tried_b))
    return SuccessComparison(
        a.policy, b.policy, "cannot tell", test, float(differences.mean()), p, None, None, "start states", (n, n), left_out,
        _smallest_paired(differences, once, alpha), _starts_needed(differences, alpha), "",
    )  # fmt: skip


def _no_common_start(a: Count, b: Count) -> SuccessComparison:
    words = (
        f"{a.policy} against {b.policy}: not comparable. They share no start state, and some were tried several times: a "
        "difference may be the start states'."
    )
    return SuccessComparison(
        a.policy,
        b.policy,
        "not comparable",
        None,
        None,
        None,
        None,
        None,
        "start states",
        (0, 0),
        a.trials + b.trials,
        None,
        None,
        words,
    )


# how many trials ------------------------------------------------------------------------------------------------------


def trials_needed(rate_a: float, rate_b: float, *, alpha: float = SURE) -> int | None:
    """Trials of each policy that tell two rates apart with a power of 80 %; None: more than 1,000, or equal rates.

    The normal approximation for two independent rates (Fleiss, Levin & Paik 2003, eq. 4.14), and one trial more. Against
    the exact power of Boschloo's test it was at most 3 % of the trials short.
    """
    if math.isclose(rate_a, rate_b):
        return None
    null, other = _spreads(rate_a, rate_b, 1, 1)
    return _bounded(((_z(1 - alpha / 2) * null + _z(POWER) * other) / (rate_a - rate_b)) ** 2 + 1)


def _smallest_unrelated(rate: float, trials_a: int, trials_b: int, alpha: float) -> float | None:
    """The smallest difference from `rate`, to the side where there is more room, in whole points."""
    for points in range(1, 101):
        other = rate - points / 100 if rate >= 0.5 else rate + points / 100
        if not 0 <= other <= 1:
            return None
        null, alternative = _spreads(rate, other, max(trials_a - 1, 0.5), max(trials_b - 1, 0.5))
        if _z(1 - alpha / 2) * null + _z(POWER) * alternative <= points / 100:
            return points / 100
    return None


def _spreads(rate_a: float, rate_b: float, trials_a: float, trials_b: float) -> tuple[float, float]:
    """The standard error of a difference of rates if both are equal, and as they are."""
    pooled = (rate_a * trials_a + rate_b * trials_b) / (trials_a + trials_b)
    null = math.sqrt(pooled * (1 - pooled) * (1 / trials_a + 1 / trials_b))
    return null, math.sqrt(rate_a * (1 - rate_a) / trials_a + rate_b * (1 - rate_b) / trials_b)


def _starts_needed(differences: np.ndarray, alpha: float) -> int | None:
    """Start states that tell the observed mean difference from zero with a power of 80 % (Connor 1987).

    An exact test of few pairs is conservative: 1 / difference more makes up for it, to within 3 % of the pairs.
    """
    mean, square = float(differences.mean()), float((differences**2).mean())
    if math.isclose(mean, 0, abs_tol=1e-12):
        return None
    wanted = (_z(1 - alpha / 2) * math.sqrt(square) + _z(POWER) * math.sqrt(max(square - mean**2, 0))) / mean
    return _bounded(wanted**2 + 1 / abs(mean))


def _smallest_paired(differences: np.ndarray, once: bool, alpha: float) -> float | None:
    """Connor's formula solved for the difference, in whole points; the pairs differ as often as they were seen to."""
    n, seen = len(differences), float((differences**2).mean())
    for points in range(1, 101):
        wanted = points / 100
        square = max(seen, wanted if once else wanted**2)
        reach = _z(1 - alpha / 2) * math.sqrt(square) + _z(POWER) * math.sqrt(max(square - wanted**2, 0))
        if reach <= wanted * math.sqrt(max(n - 1 / wanted, 0)):
            return wanted
    return None


def _bounded(trials: float) -> int | None:
    return math.ceil(trials - 1e-9) if trials <= MOST_TRIALS else None


def _z(share: float) -> float:
    from scipy.special import ndtri

    return float(ndtri(share))


# verdicts -------------------------------------------------------------------------------------------------------------


def _judge(found: Sequence[SuccessComparison]) -> list[SuccessComparison]:
    """Holm over the pairs that are comparable, then a word and a sentence for each."""
    comparable = [pair for pair in found if pair.p is not None]
    adjusted = iter(holm([pair.p for pair in comparable])) if comparable else iter(())
    judged = []
    for pair in found:
        if pair.p is not None:
            pair = replace(pair, p_holm=float(next(adjusted)))
            pair = replace(pair, word=_word(pair))
            pair = replace(pair, words=_words(pair, len(comparable)))
        judged.append(pair)
    return judged


def _word(pair: SuccessComparison) -> Word:
    if pair.p_holm > SURE or pair.difference == 0:
        return "cannot tell"
    return "better" if pair.difference > 0 else "worse"


def _words(pair: SuccessComparison, pairs: int) -> str:
    size, side = _points(100 * abs(pair.difference)), "higher" if pair.difference > 0 else "lower"
    apart = "the same rate" if abs(pair.difference) < 1e-12 else f"{size} {side}"
    after = f", {pair.p_holm:.2g} after Holm over {pairs} pairs" if pairs > 1 else ""
    found = f"{pair.a} against {pair.b}: {pair.word} ({apart}, p = {pair.p:.2g} by {_test(pair)}{after})."
    return " ".join(part for part in (found, _left_out(pair), _seen(pair), _needed(pair)) if part)


def _test(pair: SuccessComparison) -> str:
    return "a sign-flip over start states" if pair.test == "sign-flip" else f"{pair.test}'s exact test"


def _left_out(pair: SuccessComparison) -> str:
    if not pair.left_out:
        return ""
    both, left = _plural(pair.n[0], "start state"), _plural(pair.left_out, "trial")
    return f"That is over the {both} that both were tried from, without {left} from other start states."


def _seen(pair: SuccessComparison) -> str:
    a, b = pair.n
    tried = _plural(a, pair.units[:-1]) if a == b else f"{a:,} and {b:,} {pair.units}"
    if pair.smallest_seen is None:
        return f"With {tried} no difference could have been seen reliably."
    return (
        f"With {tried} a difference of {100 * pair.smallest_seen:.0f} points or more would be seen four times in five."
    )


def _needed(pair: SuccessComparison) -> str:
    """Only a pair that could not be told apart needs more trials."""
    if pair.word != "cannot tell":
        return ""
    if abs(pair.difference) < 1e-12:
        return "Equal rates cannot be told apart by any number."
    number = f"more than {MOST_TRIALS:,}" if pair.needs is None else f"about {pair.needs:,}"
    each = " of each policy" if pair.units == "trials" else ""
    return f"If the rates are as observed, {number} {pair.units}{each} would tell them apart."


def _plural(count: int, word: str) -> str:
    return f"{count:,} {word}{'' if count == 1 else 's'}"


def _points(points: float) -> str:
    return f"{points:.0f} points" if points >= 2.5 else f"{points:.1f} points"


# stages and roll-outs -------------------------------------------------------------------------------------------------


def describe_stages(trials: Trials) -> list[dict[str, Any]]:
    """How far the trials of each policy came (JSON-able); empty where the file says nothing about it.

    Numbered stages: how many trials reached each (a later stage includes the earlier ones), and the mean stage. Named
    stages have no order: how many trials ended at each.
    """
    if trials.stage is None:
        return []
    numbered = trials.stage.dtype.kind == "f"
    stages = sorted(set(trials.stage.tolist())) if numbered else list(dict.fromkeys(trials.stage.tolist()))
    found = []
    for policy in trials.policies:
        mine = trials.stage[trials.policy == policy]
        counts = {f"{s:g}" if numbered else s: int(((mine >= s) if numbered else (mine == s)).sum()) for s in stages}
        mean = float(mine.mean()) if numbered else None
        found.append(
            {"policy": policy, "trials": len(mine), "reached" if numbered else "ended_at": counts, "mean_stage": mean}
        )
    return found

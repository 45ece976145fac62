"""How well does an offline score say which of two checkpoints succeeds more often in closed loop?

What belongs here: rank correlations over checkpoints with their intervals, overall and within a method, how high they could be
at all, and the answer: an offline score is named on one data set and tested on another. What does not: the offline scores
themselves (`pipeline.offline_scores`), finding checkpoints in a store (`demobench.commands.proxy`).

Correlations are Spearman's with mid-ranks, of success with *minus* the offline score: positive where a smaller error goes with
more success. Ranks, because an error's scale means nothing to success and one policy that diverges must not decide. Spearman's
rather than Kendall's tau-b: both allow for ties (many checkpoints never succeed), but only Spearman's is a correlation, so it
can be taken within methods by taking their means off, and noise lowers it by a factor that is known.

Checkpoints of one method are alike, so methods are what is drawn: intervals are Student's t on Fisher's z with a standard error
by leaving out one method after another (jackknife; Efron & Tibshirani 1993, ch. 11), G − 1 degrees of freedom, and no smaller
than that of as many independent checkpoints, 1/√(n − 3). Resampling methods (percentile) or studentising that (bootstrap-t)
covered too little with 5 to 8 methods; docs/proxy.md has the numbers.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from pipeline.statistics.intervals import Interval, t_quantile

Target = Literal["success", "score"]
TARGETS: tuple[Target, ...] = ("success", "score")
"""What is to be predicted: the success rate, and the mean best reward, which still tells checkpoints apart that never succeed."""

PLAIN = "whole_chunk_mae"
"""The offline score that any other must be better than to be worth its trouble."""

FEWEST_CHECKPOINTS, FEWEST_METHODS = 24, 5
MOST_METHODS = 100
"""Nobody has more methods; what would take more is said to be out of reach."""
SURE, POWER = 0.05, 0.80
PERMUTATIONS, SPLITS = 9_999, 200
PERFECT = 0.999
"""Fisher's z of a perfect order has no bounds; this stands in as the limit."""


@dataclass(frozen=True)
class Checkpoint:
    """One trained network, after training: what it scored offline and what it did in closed loop.

    method       what is drawn: checkpoints of one method are alike, whatever their policies are called
    offline      score → value, smaller is better; a score that it does not have is not there
    success      [R] bool, of each start state       best_reward  [R] in 0 … 1
    """

    method: str
    policy: str
    observations: str
    chunk: int
    seed: int
    offline: Mapping[str, float]
    success: np.ndarray
    best_reward: np.ndarray

    def outcome(self, target: Target) -> np.ndarray:
        """[R] what is averaged over start states."""
        return np.asarray(self.success if target == "success" else self.best_reward, np.float64)


@dataclass(frozen=True)
class Correlation:
    """A rank correlation over checkpoints, and how sure it is.

    interval  95 %, over methods; None below five of them, or where a single method carries all there is to order
    se        the standard error of its Fisher z (None with the interval)
    methods   how many it rests on: overall all of them, within methods those whose checkpoints differ in both
    p         within methods: two-sided, by shuffling policies within each method; None where nothing can be shuffled
    """

    value: float
    interval: Interval | None
    se: float | None
    checkpoints: int
    methods: int
    p: float | None = None


@dataclass(frozen=True)
class Agreement:
    """What one offline score says of one target on one data set, or why that is not said."""

    score: str
    target: Target
    overall: Correlation | None
    within: Correlation | None
    refused: str | None = None


@dataclass(frozen=True)
class Answer:
    """Does the score named on the first data set predict the target on the second?

    named        the score with the highest correlation on the first data set; None where there is none
    word         "yes": surely above zero on the second; "no": surely below; else "cannot tell"
    over_plain   the same of its correlation less that of the whole-chunk error; None where that is what was named
    difference, difference_interval   of the two correlations on the second data set
    needs_methods  how many methods would tell, if the correlation is as observed; None: more than 100, or not asked
    """

    target: Target
    named: str | None
    word: Literal["yes", "no", "cannot tell"]
    over_plain: Literal["better", "worse", "cannot tell"] | None
    difference: float | None
    difference_interval: Interval | None
    needs_methods: int | None
    words: str


# Rank correlations ----------------------------------------------------------------------------------------------------


def mid_ranks(values: np.ndarray) -> np.ndarray:
    """[n] ranks from ½ on, equal values sharing theirs."""
    values = np.asarray(values, np.float64)
    return (values < values[:, None]).sum(axis=1) + 0.5 * (values == values[:, None]).sum(axis=1)


def spearman(a: np.ndarray, b: np.ndarray) -> float:
    """Pearson's correlation of mid-ranks [n] (Spearman 1904); NaN where one of the two is all the same."""
    return _cosine(*(ranks - ranks.mean() for ranks in (mid_ranks(a), mid_ranks(b))))


def within_methods(a: np.ndarray, b: np.ndarray, method: np.ndarray) -> float:
    """The same over ranks within each method, their means taken off; methods that do not differ in both say nothing."""
    centred = within_ranks(a, b, method)
    return _cosine(*centred) if centred[0].any() else math.nan


def within_ranks(a: np.ndarray, b: np.ndarray, method: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[n] ranks of both within methods, centred, over the number of checkpoints of the method + 1; zero where it says nothing."""
    centred = np.zeros((2, len(a)))
    for name in np.unique(method):
        mine = np.flatnonzero(method == name)
        if len(np.unique(a[mine])) > 1 and len(np.unique(b[mine])) > 1:
            for row, values in enumerate((a, b)):
                ranks = mid_ranks(values[mine])
                centred[row, mine] = (ranks - ranks.mean()) / (len(mine) + 1)
    return centred[0], centred[1]


def _cosine(a: np.ndarray, b: np.ndarray) -> float:
    size = math.sqrt(float((a**2).sum() * (b**2).sum()))
    return float((a * b).sum()) / size if size > 0 else math.nan


# How sure -------------------------------------------------------------------------------------------------------------


def correlate(error: np.ndarray, outcome: np.ndarray, method: np.ndarray) -> Correlation:
    """Minus the error against the outcome, over all checkpoints [n], each counting once."""
    methods = len(np.unique(method))
    value = spearman(-error, outcome)
    least = 1 / math.sqrt(max(len(error) - 3, 1))
    se = _jackknife(lambda keep: _z(spearman(-error[keep], outcome[keep])), method)
    return _with_interval(value, se, least, len(error), methods, None)


def correlate_within(
    error: np.ndarray, outcome: np.ndarray, method: np.ndarray, policy: np.ndarray, *, permutations: int = PERMUTATIONS
) -> Correlation | None:
    """The same within methods; None where no method's checkpoints differ in both."""
    a, b = within_ranks(-error, outcome, method)
    use = np.isin(method, np.unique(method[a != 0]))
    if not use.any():
        return None
    error, outcome, method, policy, a, b = (values[use] for values in (error, outcome, method, policy, a, b))
    methods = len(np.unique(method))
    least = 1 / math.sqrt(max(len(error) - methods - 2, 1))
    se = _jackknife(lambda keep: _z(within_methods(-error[keep], outcome[keep], method[keep])), method)
    p = _shuffled_p(a, b, shuffles(method, policy, permutations))
    return _with_interval(_cosine(a, b), se, least, len(error), methods, p)


def _with_interval(
    value: float, se: float, least: float, checkpoints: int, methods: int, p: float | None
) -> Correlation:
    if methods < FEWEST_METHODS or not math.isfinite(se):
        return Correlation(value, None, None, checkpoints, methods, p)
    se = max(se, least)
    reach = t_quantile(1 - SURE / 2, methods - 1) * se
    ends = (math.tanh(_z(value) - reach), math.tanh(_z(value) + reach))
    return Correlation(value, ends, se, checkpoints, methods, p)


def _z(correlation: float) -> float:
    """Fisher's z (1915)."""
    return math.atanh(min(max(correlation, -PERFECT), PERFECT)) if math.isfinite(correlation) else math.nan


def _jackknife(statistic: Callable[[np.ndarray], float], method: np.ndarray) -> float:
    """The standard error of a statistic of checkpoints on account of their methods; NaN where one leaves nothing without it."""
    names = np.unique(method)
    without = np.array([statistic(method != name) for name in names]) if len(names) > 1 else np.array([math.nan])
    return math.sqrt((len(names) - 1) / len(names) * float(((without - without.mean()) ** 2).sum()))


def shuffles(method: np.ndarray, policy: np.ndarray, count: int) -> np.ndarray | None:
    """[B, n] ways to deal outcomes to checkpoints anew within each method; None where there is one way only.

    Networks of one policy differ by their seed alone and are near copies: they stay together, and whole policies of as many
    seeds change places. Only where a method has one policy its seeds do.
    """
    random = np.random.default_rng(len(method))
    dealt = np.tile(np.arange(len(method)), (count, 1))
    ways = 1.0
    for name in np.unique(method):
        mine = np.flatnonzero(method == name)
        names = np.unique(policy[mine])
        blocks = (
            [mine[policy[mine] == one] for one in names]
            if len(names) > 1
            else [mine[i : i + 1] for i in range(len(mine))]
        )
        for size in {len(block) for block in blocks}:
            alike = np.array([block for block in blocks if len(block) == size])
            order = np.argsort(random.random((count, len(alike))), axis=1)
            dealt[:, alike.ravel()] = alike[order].reshape(count, -1)
            ways *= math.factorial(len(alike))
    return dealt if ways > 1 else None


def _shuffled_p(a: np.ndarray, b: np.ndarray, dealt: np.ndarray | None) -> float | None:
    """Two-sided, the observed order added to the shuffled ones (Phipson & Smyth 2010); `a` and `b` as `within_ranks` gives them."""
    if dealt is None:
        return None
    observed = abs(float((a * b).sum()))
    extreme = np.count_nonzero(np.abs(b[dealt] @ a) >= observed - 1e-9)
    return (extreme + 1) / (len(dealt) + 1)


def ceiling(outcomes: Sequence[np.ndarray], *, same_starts: bool) -> float | None:
    """The most that a rank correlation could be: a success rate from few start states is a noisy one.

    How well one half of the start states orders the checkpoints as the other half does, carried on to all of them (Spearman 1910,
    Brown 1910); its root is what a perfect predictor would be correlated by. The mean over random halves.

    Parameters
    ----------
    outcomes : of each checkpoint [R], by start state.
    same_starts : they are the same start states, and are split alike: what makes them hard or easy for all moves no order.

    Returns
    -------
    None where the halves have nothing to order; 0.0 where they disagree.
    """
    if min(map(len, outcomes)) < 2:
        return None
    random = np.random.default_rng(len(outcomes))
    halves = np.empty((2, SPLITS, len(outcomes)))
    for column, one in enumerate(outcomes):
        if column == 0 or not same_starts:
            first = np.argsort(random.random((SPLITS, len(one))), axis=1) < len(one) // 2
        for half, mine in enumerate((first, ~first)):
            halves[half, :, column] = mine @ one / mine.sum(axis=1)
    found = [spearman(*pair) for pair in halves.transpose(1, 0, 2)]
    agree = float(np.mean([value for value in found if math.isfinite(value)] or [math.nan]))
    if not math.isfinite(agree):
        return None
    return math.sqrt(2 * agree / (1 + agree)) if agree > 0 else 0.0


# A data set -----------------------------------------------------------------------------------------------------------


def refusal(checkpoints: Sequence[Checkpoint]) -> str | None:
    """Why nothing is said of a data set at all; None where there are enough checkpoints of enough methods."""
    distinct = len({(c.method, c.policy, c.observations, c.seed) for c in checkpoints})
    methods = len({c.method for c in checkpoints})
    if distinct < FEWEST_CHECKPOINTS:
        return f"not enough: has {distinct} of {FEWEST_CHECKPOINTS} distinct checkpoints (method, chunk, seed)"
    if methods < FEWEST_METHODS:
        return f"not enough: has {methods} of {FEWEST_METHODS} methods, and checkpoints of one method are alike"
    return None


def agreements(checkpoints: Sequence[Checkpoint], scores: Sequence[str], target: Target) -> list[Agreement]:
    """What each offline score says of a target over all checkpoints of a data set, or why not."""
    why = refusal(checkpoints)
    outcome = np.array([c.outcome(target).mean() for c in checkpoints])
    if why is None and len(np.unique(outcome)) == 1:
        why = f"every checkpoint has the same {_called(target)}, {outcome[0]:.3g}: there is nothing to predict"
    return [_agreement(checkpoints, score, target, outcome, why) for score in scores]


def _agreement(
    checkpoints: Sequence[Checkpoint], score: str, target: Target, outcome: np.ndarray, why: str | None
) -> Agreement:
    error = np.array([c.offline.get(score, math.nan) for c in checkpoints])
    missing = int((~np.isfinite(error)).sum())
    if why is None and missing:
        why = f"{missing} of {len(checkpoints)} checkpoints do not have this score"
    if why is None and len(np.unique(error)) == 1:
        why = "every checkpoint has the same offline score"
    if why is not None:
        return Agreement(score, target, None, None, why)
    method, policy = (np.array(names) for names in zip(*((c.method, _policy_of(c)) for c in checkpoints), strict=True))
    return Agreement(score, target, correlate(error, outcome, method), correlate_within(error, outcome, method, policy))


def _policy_of(checkpoint: Checkpoint) -> str:
    return f"{checkpoint.policy}/{checkpoint.observations}"


def _called(target: Target) -> str:
    return "success rate" if target == "success" else "mean best reward"


# The answer -----------------------------------------------------------------------------------------------------------


def name_best(found: Sequence[Agreement]) -> Agreement | None:
    """The score with the highest correlation; None where every one is refused."""
    said = [one for one in found if one.overall is not None]
    return max(said, key=lambda one: one.overall.value) if said else None


def answer(
    first: Sequence[Agreement], second: Sequence[Agreement], tested_on: Sequence[Checkpoint], scores: Mapping[str, str]
) -> Answer:
    """The score named on a first data set, tested on a second.

    Only one score is tested, and it was chosen elsewhere, so there is nothing to correct for.

    Parameters
    ----------
    first, second : `agreements` of one target on both data sets.
    tested_on : the checkpoints of the second.
    scores : score → what it is called.
    """
    target = first[0].target
    named = name_best(first)
    if named is None:
        words = f"Cannot tell which offline score predicts the {_called(target)}. On the first data set: {first[0].refused}."
        return Answer(target, None, "cannot tell", None, None, None, None, words)
    here = next(one for one in second if one.score == named.score)
    name = scores[named.score]
    begins = (
        f"Named on the first data set: the {name} (correlation {named.overall.value:.2f} with the {_called(target)})."
    )
    if here.overall is None:
        words = f"{begins} Cannot tell whether it predicts on the second: {here.refused}."
        return Answer(target, named.score, "cannot tell", None, None, None, None, words)
    word, needs = _above_zero(here.overall)
    plain = next((one for one in second if one.score == PLAIN), None)
    difference = (
        difference_to_plain(tested_on, named.score, target)
        if named.score != PLAIN and plain and plain.overall
        else None
    )
    over = None if difference is None else _over_plain(*difference)
    words = " ".join(
        [begins, _tested(word, here.overall, needs), _within_words(here.within), _over_words(over, difference, scores)]
    )
    return Answer(target, named.score, word, over, *(difference or (None, None)), needs, words.strip())


def _above_zero(found: Correlation) -> tuple[Literal["yes", "no", "cannot tell"], int | None]:
    if found.interval is not None and found.interval[0] > 0:
        return "yes", None
    if found.interval is not None and found.interval[1] < 0:
        return "no", None
    return "cannot tell", None if found.se is None else methods_needed(_z(found.value), found.se, found.methods)


def methods_needed(size: float, se: float, methods: int) -> int | None:
    """Methods that would tell a z of this size from zero four times in five; None: more than 100, or it is zero."""
    for wanted in range(methods + 1, MOST_METHODS + 1):
        reach = t_quantile(1 - SURE / 2, wanted - 1) + t_quantile(POWER, wanted - 1)
        if reach * se * math.sqrt(methods / wanted) <= abs(size):
            return wanted
    return None


def difference_to_plain(checkpoints: Sequence[Checkpoint], score: str, target: Target) -> tuple[float, Interval | None]:
    """The correlation of a score less that of the whole-chunk error, over the same checkpoints, with its interval over methods."""
    outcome = np.array([c.outcome(target).mean() for c in checkpoints])
    method = np.array([c.method for c in checkpoints])
    error, plain = (np.array([c.offline[name] for c in checkpoints]) for name in (score, PLAIN))

    def apart(keep: np.ndarray) -> float:
        return spearman(-error[keep], outcome[keep]) - spearman(-plain[keep], outcome[keep])

    value, se = apart(np.ones(len(method), bool)), _jackknife(apart, method)
    if not math.isfinite(se):
        return value, None
    reach = t_quantile(1 - SURE / 2, len(np.unique(method)) - 1) * se
    return value, (value - reach, value + reach)


def _over_plain(difference: float, interval: Interval | None) -> Literal["better", "worse", "cannot tell"]:
    if interval is None or interval[0] <= 0 <= interval[1]:
        return "cannot tell"
    return "better" if difference > 0 else "worse"


def _tested(word: str, found: Correlation, needs: int | None) -> str:
    interval = (
        "no interval: one method carries all there is to order"
        if found.interval is None
        else _bracketed(found.interval)
    )
    at = f"{found.value:.2f} {interval} over {found.checkpoints} checkpoints of {found.methods} methods"
    if word == "yes":
        return f"On the second it predicts: {at}, surely above zero."
    if word == "no":
        return f"On the second it misleads: {at}, surely below zero."
    would = f"about {needs} methods" if needs else f"more than {MOST_METHODS} methods"
    return f"On the second, cannot tell: {at}. If the correlation is as observed, {would} like these would tell."


def _within_words(within: Correlation | None) -> str:
    if within is None:
        return "Within a method there is nothing to order."
    p = "" if within.p is None else f", p = {within.p:.2g}" if within.p >= 0.001 else ", p < 0.001"
    sure = within.p is not None and within.p <= SURE and within.value > 0
    says = (
        "checkpoints of one method are ordered too" if sure else "that it orders checkpoints of one method is not shown"
    )
    return f"Within a method: {within.value:.2f} ({_methods(within.methods)}{p}): {says}."


def _over_words(over: str | None, difference: tuple[float, Interval | None] | None, scores: Mapping[str, str]) -> str:
    if over is None or difference is None:
        return ""
    value, interval = difference
    at = f"{value:+.2f}" + (f" {_bracketed(interval)}" if interval else "")
    plain = scores[PLAIN]
    return {
        "better": f"It is better than the {plain}: {at}.",
        "worse": f"It is worse than the {plain}: {at}.",
        "cannot tell": f"Whether it is better than the {plain}: cannot tell ({at}).",
    }[over]


def _methods(count: int) -> str:
    return f"{count} method{'s' * (count != 1)}"


def _bracketed(interval: Interval) -> str:
    return f"[{interval[0]:.2f}, {interval[1]:.2f}]"


def describe(checkpoints: Sequence[Checkpoint]) -> dict[str, Any]:
    """How many there are of what, and how much each target differs (JSON-able)."""
    methods = sorted({c.method for c in checkpoints})
    starts = [len(c.success) for c in checkpoints]
    return {
        "checkpoints": len(checkpoints),
        "methods": {name: sum(c.method == name for c in checkpoints) for name in methods},
        "chunks": sorted({c.chunk for c in checkpoints}),
        "start_states": [min(starts), max(starts)] if starts else None,
        "never_succeeded": sum(not c.success.any() for c in checkpoints),
    }

"""The learning curve: error against training episodes, and whether more of them would help.

What belongs here: the gain that a curve still promises, and the answer in words. What does not: training on subsets
(`pipeline.curve`), how sure a difference between two sizes is (`curve_errors`).

How the answer is found. Let D be the drop of the error from about half of the training episodes (m) to all (n), on the same
held-out episodes. The gain of `more` episodes is D times a factor ρ, which lies in a narrow range whatever the curve:

- From above: where the error is convex in log n, as learning curves are once learning has begun (Hestness et al. 2017), it
  falls no further for each doubling than it did before: ρ ≤ log((n + more)/n) / log(n/m), and so for any m. The limit is taken
  from a quarter of the episodes (or the size before the last drop), where it is surest, but is never below what the last drop
  alone says. A curve that significantly gets steeper bounds nothing and gives no "no". The error cannot fall below the floor.
- From below: the least ρ of the curves n^−c, c ≤ 2, that the earlier drops allow; however slow the curve looks, n^−1 is among
  them (n^−2 beyond twice the episodes). Learning curves are found to be such power laws, or else e^(−n/τ), which ends far sooner
  (Viering & Loog 2023): a "yes" also needs half of the worthwhile gain from every e^(−n/τ) that the earlier drops allow.

"No" needs the largest gain and "yes" the smallest, both at the 95 % limits of the drop. A fit of a + b·n^−c through all sizes
gives the estimate between them: with three or four sizes it is far too loose to give the limits.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.statistics.curve_errors import Contrast, CurveErrors, contrast
from pipeline.statistics.intervals import FEWEST, Interval

MORE = 50
WORTHWHILE = 0.05
"""The share of the present error that a gain must exceed to be worth recording for."""

RATES = np.arange(0, 2.01, 0.05)
"""The exponents c of n^−c that are reckoned with; 0 is log n."""

SCALES = np.geomspace(0.03, 1, 141)
"""The scales τ of e^(−n/τ) that are reckoned with, as shares of n."""

RATE_LEVEL, SCALE_LEVEL = 0.95, 0.9
"""A shape counts as long as no earlier drop contradicts it at this level (power laws, exponentials)."""

METRIC_WORDS = {"first_step_mae": "the first-step error", "at_one_second_mae": "the error at one second"}
CurveWord = Literal["yes", "no", "cannot tell"]


@dataclass(frozen=True)
class Floor:
    """What the error cannot go below: the value to draw, its 95 % lower limit (which caps the gain), and its name."""

    value: float
    low: float
    words: str


@dataclass(frozen=True)
class Answer:
    """Would `more` demonstrations help? `gain` is the estimate of how far the error would fall, `share` the part of the
    present error that is worth it, `interval` the 95 % limits of the gain (None where none can be had)."""

    metric: str
    more: int
    share: float
    gain: float
    interval: Interval | None
    word: CurveWord
    words: str


# What more demonstrations would bring ---------------------------------------------------------------------------------

Fall = Callable[[float, float], float]
"""The shape of a curve: how far it falls between two sizes, in any unit."""


def power(c: float) -> Fall:
    """Falls like n^−c; divided by c, so that c = 0 is log n."""
    if c == 0:
        return lambda start, end: float(np.log(end / start))
    return lambda start, end: float((start**-c - end**-c) / c)


def exponential(scale: float) -> Fall:
    """Falls like e^(−n/τ); multiplied by τ, so that an endless τ is a straight line."""
    return lambda start, end: float(scale * (np.exp(-start / scale) - np.exp(-end / scale)))


def gain_factor(fall: Fall, smaller: int, full: int, more: int) -> float:
    """ρ: the fall from `full` to `full + more` over the fall from `smaller` to `full`."""
    return fall(full, full + more) / fall(smaller, full)


def gain_fit(curve: CurveErrors, more: int) -> float:
    """The gain by least squares of a + b·n^−c on the mean errors of all sizes (c = 1/2 where two sizes say nothing)."""
    errors = np.average(curve.by_episode, axis=1, weights=curve.weights)
    full = curve.sizes[-1]
    best, gain = np.inf, 0.0
    for c in RATES if len(curve.sizes) > 2 else [0.5]:
        shape = power(c)
        fall = np.array([shape(size, full) for size in curve.sizes])
        across, up = fall - fall.mean(), errors - errors.mean()
        slope = across @ up / (across @ across)
        left = float(((up - slope * across) ** 2).sum())
        if left < best:
            best, gain = left, float(slope * shape(full, full + more))
    return gain


def spread_sizes(sizes: Sequence[int]) -> list[int]:
    """The full size and those before it that are each at most 1/√2 of the next, so that a drop is more than noise.

    Where no size is that far below the full one, the last before it is taken.
    """
    chosen = [sizes[-1]]
    for size in reversed(sizes[:-1]):
        if size <= chosen[0] / np.sqrt(2):
            chosen.insert(0, size)
    return chosen if len(chosen) > 1 else list(sizes[-2:])


def bend(curve: CurveErrors, fall: Fall, first: int, middle: int, last: int, level: float = 0.95) -> Contrast:
    """How much further the error fell from `first` to `middle` than this shape says, given its fall from `middle` to `last`.

    Zero for a curve of this shape, above zero for one that flattens faster.
    """
    ratio = fall(first, middle) / fall(middle, last)
    return contrast(curve, {first: 1.0, middle: -1.0 - ratio, last: ratio}, level=level)


def _allowed(curve: CurveErrors, fall: Fall, level: float) -> bool:
    """Whether none of the earlier drops contradicts a shape."""
    sizes = spread_sizes(curve.sizes)
    bends = [bend(curve, fall, *sizes[i : i + 3], level).interval for i in range(len(sizes) - 2)]
    return all(limits is None or limits[0] <= 0 <= limits[1] for limits in bends)


def least_factor(curve: CurveErrors, more: int) -> float:
    """The smallest ρ of the last drop among the power laws that the earlier drops allow."""
    base, full = spread_sizes(curve.sizes)[-2:]
    fastest = 1.0 if more <= full else 2.0
    allowed = [c for c in RATES if c > fastest and _allowed(curve, power(c), RATE_LEVEL)]
    return gain_factor(power(max(allowed, default=fastest)), base, full, more)


def least_exponential_factor(curve: CurveErrors, more: int) -> float:
    """The smallest ρ of the last drop among the exponentials that the earlier drops allow; endless where they allow none."""
    base, full = spread_sizes(curve.sizes)[-2:]
    shapes = [exponential(float(scale) * full) for scale in SCALES]
    factors = [gain_factor(s, base, full, more) for s in shapes if _allowed(curve, s, SCALE_LEVEL)]
    return min(factors, default=np.inf)


def _limits(curve: CurveErrors, drop: Contrast, more: int) -> Interval:
    """The 95 % limits of the gain, floor apart."""
    sizes = spread_sizes(curve.sizes)
    base, full = sizes[-2:]
    steepest = gain_factor(power(0), base, full, more)
    factors = (steepest, least_factor(curve, more))
    low, high = min(drop.interval[0] * f for f in factors), max(drop.interval[1] * f for f in factors)
    if len(sizes) > 2:
        far = contrast(curve, {sizes[-3]: 1.0, full: -1.0}).interval
        high = max(far[1] * gain_factor(power(0), sizes[-3], full, more), drop.value * steepest)
    return low, max(low, high)


def _steeper(curve: CurveErrors) -> bool:
    """Whether the error fell significantly more for each doubling in the last drop than in the one before."""
    sizes = spread_sizes(curve.sizes)
    if len(sizes) < 3:
        return False
    limits = bend(curve, power(0), *sizes[-3:]).interval
    return limits is not None and limits[1] < 0


def answer(
    curve: CurveErrors,
    metric: str,
    *,
    more: int = MORE,
    share: float = WORTHWHILE,
    floor: Floor | None = None,
    unit: str | None = None,
) -> Answer:
    """Would `more` demonstrations lower the error by more than `share` of what it is now?"""
    base, full = spread_sizes(curve.sizes)[-2:]
    drop, present = contrast(curve, {base: 1.0, full: -1.0}), contrast(curve, {full: 1.0})
    worth, fit = share * present.value, gain_fit(curve, more)
    case = _Case(curve, metric, more, share, present.value, drop, unit)
    if drop.interval is None:
        return Answer(metric, more, share, fit, None, "cannot tell", case.no_interval())
    low, high = _limits(curve, drop, more)
    room = _room(present, floor)
    capped = room is not None and room < high
    if room is not None:
        low, high = min(low, room), min(high, room)
    steeper = _steeper(curve)
    word: CurveWord = "cannot tell"
    if low > worth and drop.value * least_exponential_factor(curve, more) > worth / 2:
        word = "yes"
    elif high < worth and (capped or not steeper):
        word = "no"
    gain = float(np.clip(fit, low, high))
    words = case.words(word, gain, (low, high), capped=capped, steeper=steeper, floor=floor)
    return Answer(metric, more, share, gain, (low, high), word, words)


def _room(present: Contrast, floor: Floor | None) -> float | None:
    """How far the error can fall at most; None where no floor says so, or one that the error is already below."""
    if floor is None or present.interval is None or present.interval[1] <= floor.low:
        return None
    return present.interval[1] - floor.low


@dataclass(frozen=True)
class _Case:
    """What an answer is about, for its sentences."""

    curve: CurveErrors
    metric: str
    more: int
    share: float
    present: float
    drop: Contrast
    unit: str | None

    def words(
        self, word: CurveWord, gain: float, limits: Interval, *, capped: bool, steeper: bool, floor: Floor | None
    ) -> str:
        full, name, worth = self.curve.sizes[-1], METRIC_WORDS[self.metric], f"{100 * self.share:.3g} %"
        start = f"{self.more} more demonstrations ({full} → {full + self.more} to train on)"
        now = f"{name}, now {self._number(self.present)},"
        if word == "yes":
            said = (
                f"Yes: {start} would lower {now} by about {self._part(gain)}, and by at least {self._part(limits[0])}; {worth} "
                "would be worth it."
            )
        elif word == "no" and limits[1] <= 0:
            said = f"No: {start} would not lower {now} at all."
        elif word == "no":
            said = f"No: {start} would lower {now} by at most {self._part(limits[1])}; {worth} would be worth it."
        else:
            said = (
                f"Cannot tell: {start} would change {now} by something between {self._percent(-limits[0])} and "
                f"{self._percent(-limits[1])}; a fall of {worth} would be worth it. {self._what_would_tell(steeper)}"
            )
        if capped and floor is not None and word == "no":
            said += f" It cannot fall below {floor.words}."
        if self.more > full:
            said += f" That is more than twice the present {full}: far beyond what was seen, so the limits are wide."
        return said

    def no_interval(self) -> str:
        episodes = len(self.curve.fold)
        if episodes < FEWEST:
            why = f"{episodes} held-out episode{'s' * (episodes != 1)} are too few: it takes at least {FEWEST}."
        else:
            why = "one seed does not show how much training varies: train with several (--seeds 5)."
        return f"Cannot tell: {why}"

    def _what_would_tell(self, steeper: bool) -> str:
        if steeper:
            return "The curve is still getting steeper, so it bounds nothing: record some more and ask again."
        if self._noiseless_spans():
            return "How the curve goes on beyond the data decides: record some more and ask again."
        most = max(self.drop.variances, key=lambda name: self.drop.variances[name])
        return {
            "folds": "What would tell: more held-out episodes (more demonstrations), more seeds, or more folds.",
            "episodes": f"What would tell: more held-out episodes than {len(self.curve.fold)}.",
            "seeds": "What would tell: more seeds (--seeds).",
            "orders": "Which episodes are recorded matters more than how many: record some more and ask again.",
        }[most]

    def _noiseless_spans(self) -> bool:
        """Whether the answer would be open even if the drop were known exactly."""
        base, full = spread_sizes(self.curve.sizes)[-2:]
        factors = (least_factor(self.curve, self.more), gain_factor(power(0), base, full, self.more))
        low, high = (self.drop.value * factor for factor in factors)
        return low <= self.share * self.present <= high

    def _number(self, value: float) -> str:
        return f"{value:.3g}{f' {self.unit}' if self.unit else ''}"

    def _part(self, value: float) -> str:
        return f"{self._number(value)} ({self._percent(value, signed=False)})"

    def _percent(self, value: float, signed: bool = True) -> str:
        """A change as a share of the present error."""
        percent = 100 * value / self.present if self.present else 0.0
        return (
            f"{percent:{'+' if signed else ''}.2g} %"
            if abs(percent) < 100
            else f"{percent:{'+' if signed else ''}.0f} %"
        )

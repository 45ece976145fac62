"""Between the floor and the best policy: where the truth lies, how far each policy is from it, what a sensor is worth.

What belongs here: holding errors and floors of the same loss on the same states against each other, paired by episode. What
does not: estimating either (`metrics`, `floors`).

All differences are made on the squared scale, where the jackknife works (Γ and the mean squared error; D₀² and the squared
mean error), and are then shown in the unit of the loss. An episode moves a policy's error and the floor together, so what
both share cancels.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import numpy as np

from pipeline.experiment import Variant
from pipeline.methods import METHODS
from pipeline.statistics.floors import standard_error
from pipeline.statistics.intervals import estimate_mean, t_quantile
from pipeline.types import STATE, EpisodeErrors, FloorEstimate, ObservationSet

PARTS = 5
"""With one fold the held-out episodes are dealt into so many parts: the best policy is chosen on the others."""


@dataclass(frozen=True)
class Sight:
    """What a policy or an observation set sees: features, and frames of them."""

    features: frozenset[str]
    frames: int
    previous_action: bool = False

    def within(self, other: "Sight") -> bool:
        """Whether everything seen here is seen there."""
        fewer = self.frames <= other.frames or not self.features
        return self.features <= other.features and fewer and self.previous_action <= other.previous_action


def sight_of(variant: Variant, observation_set: ObservationSet, history: int, kinds: Sequence[str]) -> Sight:
    """What a policy sees. A baseline without an observation set sees frames of the state, and for action columns that follow
    no state column the previous action, which is in no observation set."""
    method = METHODS[variant.method]
    if method.uses_observations:
        frames = 1 if method.recipe == "every_frame" else observation_set.history or history
        return Sight(frozenset(observation_set.features), frames)
    repeats = {"hold_still": "other" in kinds, "constant_velocity": set(kinds) != {"position"}}
    features = frozenset([STATE]) if method.frames else frozenset()
    return Sight(features, method.frames, repeats.get(variant.method, False))


@dataclass(frozen=True)
class Scored:
    """One row of the table: who, what it sees, and its errors on held-out episodes."""

    policy: str
    observations: str
    sight: Sight
    errors: EpisodeErrors

    def by_episode(self, loss: str, horizon: int) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """[S, E] mean error (rmse: mean squared error) of each episode, which episodes [E], their folds [E].

        None beyond the policy's chunk.
        """
        if horizon >= self.errors.anchors.shape[1]:
            return None
        counts = self.errors.anchors[:, horizon]
        there = counts > 0
        sums = {"rmse": self.errors.squared, "mae": self.errors.absolute}
        total = self.errors.l2[:, :, horizon] if loss == "l2" else sums[loss][:, :, horizon].mean(axis=2)
        return total[:, there] / counts[there], self.errors.episodes[there], self.errors.fold[there]


@dataclass(frozen=True)
class Gap:
    """How far an error lies above a floor, in the unit of the loss; intervals are None where they cannot be had."""

    error: float
    error_interval: tuple[float, float] | None
    gap: float | None
    interval: tuple[float, float] | None
    words: str


def gap_to_floor(scored: Scored, floor: FloorEstimate) -> Gap | None:
    """One policy beside the floor of its observation set; None where its chunk ends before the horizon.

    For `gamma` the gap is to the floor. For `pair_distance` it is to the lower end of where the floor lies: the most that
    could be gained.
    """
    found = scored.by_episode(floor.loss, floor.horizon)
    return None if found is None else _gap(*found, floor)


def _gap(values: np.ndarray, episodes: np.ndarray, fold: np.ndarray, floor: FloorEstimate) -> Gap:
    mean = estimate_mean(values, fold=fold)
    squared, slope = (mean.value, 1.0) if floor.loss == "rmse" else (mean.value**2, 2 * mean.value)
    error, sure = float(np.sqrt(squared)), mean.interval
    if sure and floor.loss == "rmse":
        sure = (float(np.sqrt(max(0.0, sure[0]))), float(np.sqrt(sure[1])))
    if floor.value is None:
        known = "" if floor.below is None else f"; it is at most {floor.below:.4g}"
        return Gap(error, sure, None, None, f"no floor to hold it against{known}")
    of_seeds = values.mean(axis=0)
    share = 1.0 if floor.loss == "rmse" else 0.25
    moved = -share * floor.influence
    moved[episodes] += slope * (of_seeds - mean.value) / len(episodes)
    spread = np.hypot(standard_error(moved, share**2 * floor.counted_twice), slope * mean.seed_se)
    # The policy and the floor share their noise, not what the floor's extrapolation may be wrong by.
    half = t_quantile(0.975, len(episodes) - 1) * spread + share * floor.wrong
    centre = squared - floor.value**2
    # From the squared scale to the unit: a gap x of squares is an error less the root of what is left of its square.
    low, high = (float(error - np.sqrt(max(0.0, squared - x))) for x in (centre - half, centre + half))
    if floor.estimator == "pair_distance" and sure:
        high = min(high, sure[1] - floor.interval[0])  # a span is wide beside what pairing saves
    return Gap(error, sure, error - floor.value, (low, high), _gap_words(floor, error - floor.value, low, high))


def _gap_words(floor: FloorEstimate, gap: float, low: float, high: float) -> str:
    if high < 0:
        return "below the floor, which shows that the floor's estimate is wrong for this data"
    if floor.estimator == "pair_distance":
        return f"at most {high:.3g} above the floor"
    if low <= 0:
        return f"at the floor, within ±{max(high, -low):.2g}"
    return f"{gap:.3g} [{low:.3g}, {high:.3g}] above the floor"


def form_brackets(
    floors: Sequence[FloorEstimate], rows: Sequence[Scored], sights: Mapping[str, Sight]
) -> list[dict[str, Any]]:
    """For every floor the best policy that sees no more than its observation set, and what lies between the two.

    The best is chosen on other held-out episodes than those its error is taken from (other folds, or other fifths of the
    one fold), so that choosing does not flatter it.

    Returns
    -------
    list of dict : observations, horizon, loss, lower (None where refused), upper, upper_interval,
        upper_policy, gap, interval, words.
    """
    brackets = []
    for floor in floors:
        able = [row for row in rows if row.sight.within(sights[floor.observations])]
        best = _best(able, floor)
        if best is None:
            continue
        name, errors = best
        gap = _gap(*errors, floor)
        refused = floor.refused or _contradiction(name, gap)
        brackets.append(
            {
                "observations": floor.observations, "horizon": floor.horizon, "loss": floor.loss,
                "lower": None if refused else floor.value, "upper": gap.error,
                "upper_interval": gap.error_interval, "upper_policy": name,
                "gap": None if refused else gap.gap, "interval": None if refused else gap.interval,
                "words": f"refused: {refused}" if refused else f"{name}: {gap.words}",
            }
        )  # fmt: skip
    return brackets


def _contradiction(name: str, gap: Gap) -> str | None:
    if gap.interval is not None and gap.interval[1] < 0:
        return f"{name} is significantly below the estimate ({gap.error:.4g}), so it is no floor of this data"
    return None


def _best(rows: Sequence[Scored], floor: FloorEstimate) -> tuple[str, tuple[np.ndarray, np.ndarray, np.ndarray]] | None:
    """The cross-fitted best: its name, and [1, E] errors by episode (seeds averaged), the episodes, their folds."""
    able = [(row, found) for row in rows if (found := row.by_episode(floor.loss, floor.horizon)) is not None]
    if not able:
        return None
    _, episodes, fold = able[0][1]
    able = [(row, found) for row, found in able if np.array_equal(found[1], episodes)]
    errors = np.stack([values.mean(axis=0) for _, (values, _, _) in able])
    part = fold if len(np.unique(fold)) > 1 else np.arange(len(episodes)) % PARTS
    chosen = np.empty(len(episodes), np.int64)
    for number in np.unique(part):
        elsewhere = errors[:, part != number] if (part != number).any() else errors
        chosen[part == number] = elsewhere.mean(axis=1).argmin()
    most = able[int(np.bincount(chosen).argmax())][0]
    shared = errors[chosen, np.arange(len(episodes))]
    return f"{most.policy}/{most.observations}", (shared[None], episodes, fold)


def value_of_sensors(
    floors: Iterable[FloorEstimate], sights: Mapping[str, Sight], brackets: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """How far the floor falls when more is seen (Devroye, Györfi, Lugosi & Walk 2018), for the squared error.

    Returns
    -------
    list of dict : smaller, larger (observation sets), horizon, loss, value, interval; `at_least` where the larger set's floor
        is refused but cannot exceed what a policy of that set reaches; words.
    """
    by_set = {(f.observations, f.horizon): f for f in floors if f.loss == "rmse"}
    reached = {(b["observations"], b["horizon"]): b for b in brackets if b["loss"] == "rmse"}
    pairs = [(a, b) for a, b in permutations(sights, 2) if sights[a].within(sights[b]) and sights[a] != sights[b]]
    found = []
    for smaller, larger in pairs:
        for horizon in sorted({h for name, h in by_set if name == smaller}):
            if (larger, horizon) in by_set:
                ends = (reached.get((name, horizon)) for name in (smaller, larger))
                found.append(_worth(by_set[smaller, horizon], by_set[larger, horizon], *ends))
    return found


def _worth(small: FloorEstimate, large: FloorEstimate, at_small: Mapping | None, at_large: Mapping | None) -> dict:
    described = {"smaller": small.observations, "larger": large.observations, "horizon": small.horizon, "loss": "rmse"}
    nothing = {"value": None, "interval": None, "at_least": None}
    sound = [
        f.value is not None and (b is None or b["lower"] is not None) for f, b in ((small, at_small), (large, at_large))
    ]
    if not sound[0]:
        return {**described, **nothing, "words": f"not known: there is no floor of {small.observations}"}
    if not sound[1]:
        ends = at_large and at_large["upper_interval"]
        limits = [x for x in (large.below, ends and ends[1]) if x is not None]
        if not limits or (least := small.interval[0] - min(limits)) <= 0:
            return {**described, **nothing, "words": f"not known: there is no floor of {large.observations}"}
        return {**described, **nothing, "at_least": float(least), "words": f"at least {least:.3g}"}
    value = small.value - large.value
    moved = small.influence / (2 * small.value) - large.influence / (2 * large.value)
    half = t_quantile(0.975, np.count_nonzero(moved) - 1) * standard_error(moved)
    interval = (value - half, value + half)
    if interval[0] <= 0:
        words = f"not seen: {value:.3g} [{interval[0]:.3g}, {interval[1]:.3g}]"
    else:
        words = f"{value:.3g} [{interval[0]:.3g}, {interval[1]:.3g}], {100 * value / small.value:.0f} % of the floor"
    return {**described, **nothing, "value": float(value), "interval": interval, "words": words}

"""What roll-outs in a simulator say: of one policy, and of which policy is better.

What belongs here: summaries of `Rollouts` and verdicts on them, over start states and training seeds. What does not: rolling out
(`simulate`), tests between counts and trials (`success`), the tests behind a verdict (`comparisons`).

A start state stands where elsewhere an episode stands: every seed acts from every start state, so the two are crossed, and a
mean is as sure as `intervals` says. Three things are particular to a number between 0 and 1, most of all to a success rate.

- One network's success is a count, so it has the exact interval (Clopper & Pearson 1934) and two of them the exact test (McNemar).
- Where all start states give the same, nothing varies, and an interval made of what varies would have no width. From n start states
  that all give c it is certain to 97.5 % that at most a share q = 1 − 0.025^(1/n) of start states gives something else. It lies
  between 0 and 1 itself, so the mean is between c − q c and c + q (1 − c); for c = 1 and one seed that is the exact interval.
- What seeds vary by is taken on the log odds, where it is alike at 0.5 and at 0.95: near the ends it then reaches further towards
  the middle than towards the end, as the rates of seeds do.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from pipeline.safety import NOT_FINITE, RUNS
from pipeline.statistics.comparisons import Comparison, Paired, compare_paired, judge
from pipeline.statistics.intervals import Interval, episode_part, seed_part, t_quantile
from pipeline.statistics.success import clopper_pearson, mcnemar
from pipeline.types import Rollouts

SUCCESS, SCORE = "success", "score"
METRICS = {SUCCESS: "success", SCORE: "best_reward"}
"""What policies are compared on in closed loop, and where `Rollouts` hold it; more is better of both."""
CLOPPER_PEARSON, ALL_ALIKE = "Clopper–Pearson", "all alike"


def values_of(rollouts: Sequence[Rollouts], name: str) -> np.ndarray:
    """[S, R] one number of each episode, by seed and start state."""
    return np.stack([getattr(one, name) for one in rollouts]).astype(np.float64)


# One policy -----------------------------------------------------------------------------------------------------------


def summarise_rollouts(rollouts: Sequence[Rollouts]) -> dict[str, Any]:
    """Closed-loop results of one policy, a `Rollouts` a training seed (JSON-able): `success` and `score` with what they rest on.

    `n` is the number of start states, the first of which is `first`; `seeds` that of networks, `episodes` n × seeds: `successes`,
    `stage_counts` and what the safety layer did are of all of them. `per_seed` holds each network's own results.

    `score` is the mean over start states of the episode's best reward (PushT: min(1, coverage / 0.95)); it is not a
    coverage. `best_coverage` is there where the task has one, `stages` and `stage_counts` where it has stages,
    `interventions` (frames in which the safety layer stepped in) where there was a safety layer. `success`, `score` and
    `best_coverage` each have an `_interval` and an `_interval_method` beside them.
    """
    first, success = rollouts[0], values_of(rollouts, "success")
    seeds, n = success.shape
    successes = int(success.sum())
    summary = {
        "simulator": first.simulator,
        "simulator_version": first.simulator_version,
        "first": int(first.start_states[0]),
        "n": n,
        "seeds": seeds,
        "episodes": n * seeds,
        "successes": successes,
        "success": successes / (n * seeds),
        **_interval("success", *success_interval(success)),
        **_mean("score", values_of(rollouts, "best_reward")),
        "median_steps": float(np.median(values_of(rollouts, "steps"))),
        "execution": asdict(first.execution),
        "per_seed": [
            {"seed": one.seed, "successes": int(one.success.sum()), "score": float(one.best_reward.mean())}
            for one in rollouts
        ],
    }
    if first.interventions is not None:
        summary |= _safety(rollouts)
    if not np.isnan(coverage := values_of(rollouts, "best_coverage")).any():
        summary |= _mean("best_coverage", coverage)
    if first.stage_names:
        counts = np.sum([one.stage_counts for one in rollouts], axis=0).tolist()
        summary |= {"stages": list(first.stage_names), "stage_counts": counts}
    return summary


def _mean(name: str, values: np.ndarray) -> dict[str, Any]:
    return {name: float(values.mean()), **_interval(name, *mean_interval(values))}


def _interval(name: str, interval: Interval | None, method: str | None) -> dict[str, Any]:
    return {f"{name}_interval": interval and list(interval), f"{name}_interval_method": method}


def success_interval(success: np.ndarray) -> tuple[Interval | None, str | None]:
    """The 95 % interval of the success rate of [S, R] episodes, 0 or 1, and how it was made.

    Of one network it is exact; of several it is `mean_interval`, for start states and seeds that were not tried.
    """
    if len(success) == 1:
        return clopper_pearson(int(success.sum()), success.shape[1]), CLOPPER_PEARSON
    return mean_interval(success)


def mean_interval(values: np.ndarray) -> tuple[Interval | None, str | None]:
    """The 95 % interval of a mean of values [S, R] in 0 … 1 over start states and, where there are several, seeds; and how the
    start states' part of it was made: "bootstrap-t", "t", or "all alike". None below five start states."""
    mean, starts = float(values.mean()), values.shape[1]
    part = episode_part(values.mean(axis=0), np.ones(starts))
    reach, method = part.reach, part.method
    if reach is None:
        return None, None
    if part.se == 0:
        reach, method = reach_of_alike(mean, starts), ALL_ALIKE
    below, above = (math.hypot(*parts) for parts in zip(reach, _reach_of_seeds(mean, values), strict=True))
    return (max(0.0, mean - below), min(1.0, mean + above)), method


def reach_of_alike(value: float, starts: int, least: float = 0.0, *, level: float = 0.95) -> tuple[float, float]:
    """How far below and above `value`, which all start states gave, their mean can be; values lie in `least` … 1."""
    others = 1 - ((1 - level) / 2) ** (1 / starts)
    return others * (value - least), others * (1 - value)


def _reach_of_seeds(mean: float, values: np.ndarray) -> tuple[float, float]:
    """How far the seeds' part of an interval reaches below and above a mean in 0 … 1, by t on the log odds."""
    variance, df = seed_part(values, np.ones(values.shape[1]), None)
    if variance == 0:
        return 0.0, 0.0
    odds = math.log(mean / (1 - mean))
    reach = t_quantile(0.975, df) * math.sqrt(variance) / (mean * (1 - mean))
    low, high = (0.5 * (1 + math.tanh((odds + way * reach) / 2)) for way in (-1, 1))
    return mean - low, high - mean


def _safety(rollouts: Sequence[Rollouts]) -> dict[str, Any]:
    """What the safety layer did: frames in which it stepped in, as a number and a share, how far it changed an action then (a
    mean, in ranges of a column; None where it changed none that was finite), and episodes that it stopped."""
    count, frames = (int(sum(getattr(one, name).sum() for one in rollouts)) for name in ("interventions", "steps"))
    ended = np.concatenate([one.stopped for one in rollouts])
    stopped, not_finite = int((ended != RUNS).sum()), int((ended == NOT_FINITE).sum())
    share = count / max(frames + stopped, 1)
    # Each action that is not finite ends an episode, so there are as many as episodes that they ended.
    finite = count - not_finite
    size = (
        sum(float(one.corrections.sum()) for one in rollouts) / finite
        if finite and rollouts[0].corrections is not None
        else None
    )
    return {
        "interventions": count,
        "intervened": share,
        "mean_intervention": size,
        "stopped": stopped,
        "stopped_not_finite": not_finite,
    }


# Two policies ---------------------------------------------------------------------------------------------------------


def compare_rollouts(
    a: Sequence[Rollouts], b: Sequence[Rollouts], metric: str, *, trained: tuple[bool, bool] = (True, True)
) -> Paired | str:
    """Compare two policies on success or score from the same start states, or say why they cannot be compared.

    The mean over seeds for each start state, a sign flip over start states, and what seeds vary by, as `compare_paired` does it;
    the success of one network of each by exact McNemar.
    """
    if why := _what_differs(a[0], b[0]):
        return why
    of_a, of_b = (values_of(side, METRICS[metric]) for side in (a, b))
    pair = replace(compare_paired(of_a, of_b, trained=trained), sampled="start states")
    if metric == SUCCESS and len(of_a) == len(of_b) == 1 and pair.p is not None:
        pair = replace(pair, p=mcnemar(a[0].success, b[0].success))
    if pair.interval is None or pair.episode_se > 0:
        return pair
    if pair.same:  # equal so far is not equal for ever: no interval of zero width
        return replace(pair, interval=None, smallest_seen=None)
    below, above = reach_of_alike(pair.difference, pair.episodes, -1.0)
    seeds = t_quantile(0.975, pair.seed_df) * pair.seed_se if pair.seed_se > 0 else 0.0
    low, high = pair.difference - math.hypot(below, seeds), pair.difference + math.hypot(above, seeds)
    return replace(pair, interval=(max(-1.0, low), min(1.0, high)), smallest_seen=None)


def _what_differs(a: Rollouts, b: Rollouts) -> str | None:
    """The first thing that keeps two policies' roll-outs from being compared, in words."""
    for what, of_a, of_b in (
        ("simulator", a.simulator, b.simulator),
        ("simulator's version", a.simulator_version, b.simulator_version),
        ("start states", _numbers(a), _numbers(b)),
    ):
        if of_a != of_b:
            return f"{what} differ{'s' * (what != 'start states')}: {of_a} and {of_b}"
    return None if np.array_equal(a.start_states, b.start_states) else "start states differ"


def _numbers(rollouts: Rollouts) -> str:
    numbers = rollouts.start_states
    return f"{numbers[0]} to {numbers[-1]} ({len(numbers)})"


def judge_with_rollouts(pairs: Sequence[tuple[str, str, str, Paired | str]]) -> list[Comparison]:
    """`judge`, of errors, success and score alike: of the last two more is better."""
    judged = judge([(a, b, SUCCESS if metric in METRICS else metric, pair) for a, b, metric, pair in pairs])
    return [
        _of_score(verdict, pair) if metric == SCORE else verdict
        for (_, _, metric, pair), verdict in zip(pairs, judged, strict=True)
    ]


def _of_score(verdict: Comparison, pair: Paired | str) -> Comparison:
    """A verdict on success, turned into one on the score: it is no rate, so points would mislead."""
    if verdict.word not in ("better", "worse"):
        return replace(verdict, metric=SCORE)
    direction = "higher" if verdict.word == "better" else "lower"
    about = " (one seed: about this one network)" if pair.one_network else ""
    return replace(verdict, metric=SCORE, words=f"score {abs(pair.difference):#.2g} {direction}{about}")


# A table's verdicts ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Driven:
    """A row of the table that was rolled out."""

    address: str
    trained: bool
    rollouts: Sequence[Rollouts]

    @property
    def rank(self) -> tuple[float, float]:
        return tuple(float(values_of(self.rollouts, name).mean()) for name in METRICS.values())


def closed_loop_verdicts(rows: Sequence[Driven], champion: str | None) -> dict[str, Any] | None:
    """Every rolled-out row against one of them, on success and score, in a family of its own (JSON-able); None below two rows.

    `reference` is the champion's row where one was named beforehand and rolled out (`chosen` is "champion"). Else it is the row
    that does best from these very start states ("best"), the score deciding between equal success. Whoever is picked for being
    best is partly lucky, and tests against it alone would call others worse too easily. So then **all** pairs are in the family:
    whichever row had come out best, its comparisons would have been among them, and "worse" is as sure as anywhere. What is
    kept are those with the best row. `family` is how many were tested.
    """
    if len(rows) < 2:
        return None
    named = [row for row in rows if champion in (row.address, row.address.split("/")[0])]
    reference = named[0] if len(named) == 1 else max(rows, key=lambda row: row.rank)
    ranked = sorted(rows, key=lambda row: (row is reference, row.rank))
    pairs = [(row, reference) for row in ranked[:-1]] if named == [reference] else list(combinations(ranked, 2))
    judged = judge_with_rollouts(
        [
            (a.address, b.address, m, compare_rollouts(a.rollouts, b.rollouts, m, trained=(a.trained, b.trained)))
            for a, b in pairs
            for m in METRICS
        ]
    )
    return {
        "reference": reference.address,
        "chosen": "champion" if named == [reference] else "best",
        "family": sum(verdict.p_holm is not None for verdict in judged),
        "comparisons": [asdict(verdict) for verdict in judged if verdict.b == reference.address],
    }

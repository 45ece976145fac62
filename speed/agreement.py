"""`python -m speed.agreement`: do intervals of a rank correlation over methods hold the truth? The table of docs/proxy.md.

What belongs here: checkpoints made up of effects of method, policy and seed, so that the truth is known, and the intervals that
`pipeline.statistics.agreement` was chosen from. What does not: the correlations themselves.
"""

import math
import sys
from collections import defaultdict

import numpy as np

from pipeline.statistics.agreement import correlate, correlate_within, spearman, within_methods
from pipeline.statistics.intervals import t_quantile

SIZES = {5: (3, 3, 2, 2, 2), 6: (4,) * 6, 8: (6, 4, 4, 2, 2, 1, 1, 1), 12: (4,) * 12}
"""Methods → policies of each, of two seeds."""
EFFECTS = ((0.0, 0.0, 0.8), (0.0, 0.0, 0.3), (0.7, 0.3, 0.6), (0.9, 0.9, 0.6))
"""Correlation between methods, within them, and the share of the variance that is the methods'."""
RESAMPLES, LIMIT = 999, 25.0

Drawn = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def drawn(
    sizes,
    between: float,
    within: float,
    random: np.random.Generator,
    *,
    share: float = 0.6,
    seeds: int = 2,
    ties: bool = False,
) -> Drawn:
    """Errors, outcomes, methods and policies [n] of checkpoints.

    Args:
        sizes: policies of each method.
        between, within: correlation of minus the error with the outcome, of the methods' effects and of all others.
        share: of the variance, the methods'.
        ties: outcomes are success rates over 50 start states, none at all for about half of the checkpoints.
    """

    def effect(correlation: float, variance: float) -> np.ndarray:
        good, other = random.normal(size=2)
        return math.sqrt(variance) * np.array([good, correlation * good + math.sqrt(1 - correlation**2) * other])

    rows = []
    for m, policies in enumerate(sizes):
        of_method = effect(between, share)
        for p in range(policies):
            of_policy = of_method + effect(within, 0.8 * (1 - share))
            rows += [(m, p, *(of_policy + effect(within, 0.2 * (1 - share)))) for _ in range(seeds)]
    method, policy, good, outcome = np.array(rows).T
    if ties:
        outcome = random.binomial(50, np.clip(0.35 * outcome, 0, 1) ** 1.5) / 50
    return -good, outcome, method.astype(int), policy.astype(int)


def truths(sizes, between: float, within: float, **more) -> tuple[float, float]:
    """Over all and within methods, from 2,000 (300) sets put together."""
    from scipy.stats import spearmanr

    random, parts = np.random.default_rng(1), []
    for number in range(2000):
        error, outcome, method, _ = drawn(sizes, between, within, random, **more)
        parts.append((error, outcome, method + 100 * number))
    error, outcome, method = (np.concatenate(column) for column in zip(*parts, strict=True))
    some = method < 100 * 300
    return float(spearmanr(-error, outcome).statistic), within_methods(-error[some], outcome[some], method[some])


def resampled(
    error: np.ndarray, outcome: np.ndarray, method: np.ndarray, random: np.random.Generator
) -> dict[str, tuple]:
    """Intervals by resampling methods: percentile, bootstrap-t, and t with the bootstrap's standard error; ends as correlations."""
    methods = int(method.max()) + 1
    member = (method[:, None] == np.arange(methods)).astype(float)
    value = math.atanh(np.clip(spearman(-error, outcome), -0.999, 0.999))
    below = [(v < v[:, None]) + 0.5 * (v == v[:, None]) for v in (-error, outcome)]

    def z(weights: np.ndarray) -> np.ndarray:
        """Of checkpoints that count [n, B] times."""
        ranks = [b @ weights for b in below]
        a, b = (r - (weights * r).sum(axis=0) / weights.sum(axis=0) for r in ranks)
        size = np.sqrt((weights * a * a).sum(axis=0) * (weights * b * b).sum(axis=0))
        return np.arctanh(
            np.clip(np.where(size > 1e-9, (weights * a * b).sum(axis=0) / np.maximum(size, 1e-9), 0), -0.999, 0.999)
        )

    def se(counts: np.ndarray) -> np.ndarray:
        """By leaving out one of the methods that were drawn, for each resample [B, G]."""
        without = np.stack([z(member @ np.maximum(counts - np.eye(methods)[g], 0).T) for g in range(methods)], axis=1)
        mean = (counts * without).sum(axis=1, keepdims=True) / methods
        return np.sqrt((methods - 1) / methods * (counts * (without - mean) ** 2).sum(axis=1))

    counts = random.multinomial(methods, np.full(methods, 1 / methods), size=RESAMPLES)
    again, own = z(member @ counts.T), float(se(np.ones((1, methods)))[0])
    spread = se(counts)
    t = np.clip((again - value)[spread > 1e-3] / spread[spread > 1e-3], -LIMIT, LIMIT)
    low, high = np.quantile(t, [0.025, 0.975]) if len(t) else (-LIMIT, LIMIT)
    reach = t_quantile(0.975, methods - 1) * again.std()
    ends = {
        "percentile bootstrap": np.quantile(again, [0.025, 0.975]),
        "bootstrap-t": (value - max(high, 0) * own, value - min(low, 0) * own),
        "t with the bootstrap's standard error": (value - reach, value + reach),
    }
    return {name: tuple(np.tanh(pair)) for name, pair in ends.items()}


def study(methods: int, effects: tuple[float, float, float], ties: bool, sets: int) -> dict[str, float]:
    """Shares of sets: `interval` → the truth was held; `above zero`, and `within a method` and `p ≤ 0.05` there."""
    between, within, share = effects
    setting = {"share": share, "ties": ties}
    overall, inside = truths(SIZES[methods], between, within, **setting)
    random, found = np.random.default_rng([2, methods]), defaultdict(list)
    for _ in range(sets):
        error, outcome, method, policy = drawn(SIZES[methods], between, within, random, **setting)
        if len(np.unique(outcome)) == 1 or (said := correlate(error, outcome, method)).interval is None:
            continue
        intervals = resampled(error, outcome, method, random) | {"t with the jackknife's (used)": said.interval}
        for name, (low, high) in intervals.items():
            found[name].append(low <= overall <= high)
        found["surely above zero"].append(said.interval[0] > 0)
        if (one := correlate_within(error, outcome, method, policy, permutations=399)) is None:
            continue
        if one.interval is not None:
            found["within a method"].append(one.interval[0] <= inside <= one.interval[1])
        if one.p is not None:
            found["p ≤ 0.05"].append(one.p <= 0.05)
    return {name: float(np.mean(values)) for name, values in found.items() if len(values) >= sets / 4}


COLUMNS = (
    "percentile bootstrap", "bootstrap-t", "t with the bootstrap's standard error", "t with the jackknife's (used)",
    "surely above zero where nothing predicts", "surely above zero at 0.5", "within a method", "p ≤ 0.05 where nothing predicts",
)  # fmt: skip


def main() -> None:
    """A row for each number of methods: lowest and highest share over the settings."""
    sets = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    print(
        f"{sets} sets a setting; % of them\n\n| methods | "
        + " | ".join(COLUMNS)
        + " |"
        + "\n|---"
        + "|---" * len(COLUMNS)
        + "|"
    )
    for methods in SIZES:
        found = defaultdict(list)
        for ties in (False, True):
            for effects in EFFECTS:
                for name, share in study(methods, effects, ties, sets).items():
                    found[name].append(share)
                    found[f"{name} where nothing predicts"] += [share] if effects[0] == 0 else []
                    found[f"{name} at 0.5"] += [share] if effects[0] == 0.7 else []
        spans = (f"{100 * min(found[c]):.0f}–{100 * max(found[c]):.0f}" if found[c] else "–" for c in COLUMNS)
        print(f"| {methods} | " + " | ".join(spans) + " |", flush=True)


if __name__ == "__main__":
    main()

"""Is one policy better than another? Paired tests over held-out episodes, Holm over a family, and one of four words.

What belongs here: from the errors of two policies to a verdict with its reason. What does not: reading results, drawing.

A difference must stand out three times, because each test alone is blind to something. Flipping signs over episodes is exact
for a symmetric difference of these very networks, however few episodes there are, but knows nothing of other seeds. The
interval over episodes and seeds, taken by t, knows seeds but leans on normality. Where differences are skewed (one policy
fails badly on a few episodes) both alarm too often; bootstrap-t over episodes does not. The p value is the largest of the three.
"""

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np

from pipeline.methods import METHODS
from pipeline.statistics.intervals import (
    FEWEST,
    EpisodePart,
    Interval,
    episode_part,
    join,
    resampled_t,
    seed_part,
    t_quantile,
    weights_of,
)
from pipeline.statistics.metrics import span_means
from pipeline.types import EpisodeErrors, Protocol

Word = Literal["better", "worse", "cannot tell", "not comparable"]

SURE, POWER = 0.05, 0.80
ENUMERATED = 14
"""Up to this many episodes every pattern of signs is tried."""
FLIPS = 20_000
RESAMPLES_HERE, MOST_RESAMPLED_HERE = 2 * FLIPS + 1, 500
"""So many that the smallest p is that of flipping signs. Above so many episodes skewness hardly matters."""
MOST_FLIPPED = 1_000
"""Above this many episodes the sum of flipped signs is normal for all purposes."""
MOST_EPISODES, MOST_SEEDS = 100_000, 1_000
"""Nobody records or trains more; what would take more is said to be as good as equal."""
BASELINES = tuple(name for name, method in METHODS.items() if not method.trained)
HIGHER_IS_BETTER = ("success",)

Row = tuple[str, str, EpisodeErrors]
"""A policy, the observation set it sees, and its errors."""


@dataclass(frozen=True)
class Paired:
    """One paired comparison of a with b, before it is judged beside others.

    difference      mean of a minus mean of b; `reference` is b's mean
    interval        95 %, over episodes and seeds; None below five episodes
    p               two-sided; None below five episodes, where nothing is tested
    least_p         the smallest p that so many episodes can give, whatever the difference
    smallest_seen   the difference that would be seen with 80 % power at 5 %, by its standard error; None below five
    episode_se, seed_se, seed_df   the two parts of the standard error; seed_se is 0.0 with one seed
    seeds           of a and of b
    one_network     a trained policy has one seed: the verdict is about that network, not about its method
    same            a and b are equal in every episode
    sampled         what the episodes are, in words
    """

    difference: float
    reference: float
    interval: Interval | None
    p: float | None
    least_p: float
    smallest_seen: float | None
    episodes: int
    episode_se: float
    seed_se: float
    seed_df: float
    seeds: tuple[int, int]
    one_network: bool = False
    same: bool = False
    sampled: str = "held-out episodes"


@dataclass(frozen=True)
class Comparison:
    """A verdict: a is better or worse than b, or why that cannot be said.

    p_holm          p after Holm over the family it was judged in
    needs_episodes  how many held-out episodes would do, where that is what is missing
    words           for people: how much better, what is missing, or the first thing that differs
    """

    a: str
    b: str
    metric: str
    word: Word
    difference: float | None
    interval: Interval | None
    p: float | None
    p_holm: float | None
    smallest_seen: float | None
    needs_episodes: int | None
    words: str


# Two policies --------------------------------------------------------------------------------------------------------


def compare_paired(
    a: np.ndarray,
    b: np.ndarray,
    counts: np.ndarray | None = None,
    fold: np.ndarray | None = None,
    *,
    trained: tuple[bool, bool] = (True, True),
) -> Paired:
    """Compare two policies on the same episodes.

    The episode part is that of the differences of the seeds' means, so it holds both policies' σ²_both already. Seeds of a
    and b are independent of each other: their parts add, with the degrees of freedom of Welch & Satterthwaite.

    Parameters
    ----------
    a, b : [Sa, E] and [Sb, E] each episode's mean error for each seed.
    counts, fold : as for `estimate_mean`.
    trained : whether a and b have seeds at all; a trained policy with one seed stands for that network alone.

    Raises
    ------
    ValueError : other episodes in a than in b, none, or a value that is no number.
    """
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    episodes = a.shape[1]
    if episodes != b.shape[1] or not episodes or not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError(f"a and b need the same episodes and finite values, not {a.shape} and {b.shape}")
    weights = weights_of(counts, episodes)
    difference = a.mean(axis=0) - b.mean(axis=0)
    part = episode_part(difference, weights)
    (variance_a, df_a), (variance_b, df_b) = (seed_part(values, weights, fold) for values in (a, b))
    seed_se, seed_df = math.sqrt(variance_a + variance_b), _welch((variance_a, df_a), (variance_b, df_b))
    tested = episodes >= FEWEST
    found = Paired(
        difference=part.value,
        reference=float(np.average(b.mean(axis=0), weights=weights)),
        interval=join(part, seed_se, seed_df),
        p=None,
        least_p=least_p(episodes),
        smallest_seen=None,
        episodes=episodes,
        episode_se=part.se,
        seed_se=seed_se,
        seed_df=seed_df,
        seeds=(len(a), len(b)),
        one_network=any(is_trained and len(side) == 1 for is_trained, side in zip(trained, (a, b), strict=True)),
        same=not difference.any(),
    )
    if not tested:
        return found
    p = max(sign_flip(weights * difference), _t_p(found))
    if p <= SURE:  # it can only grow, so where nothing shows already there is nothing to resample
        p = max(p, _bootstrap_p(part, difference, weights))
    return replace(found, p=p, smallest_seen=_reach(found, SURE, POWER))


def sign_flip(differences: np.ndarray) -> float:
    """Two-sided p of a sum of differences [E] that are as likely to be positive as negative (Fisher 1935, § 21).

    Every pattern of signs up to 14 episodes; beyond, 20,000 random ones with the observed one added to them, so that p is
    never too small (Phipson & Smyth 2010).
    """
    episodes, total = len(differences), abs(differences.sum())
    size = np.abs(differences).sum()
    if size == 0:
        return 1.0
    if episodes > MOST_FLIPPED:
        return math.erfc(total / math.sqrt(2 * (differences**2).sum()))
    extreme = int((np.abs(_signs(episodes) @ differences) >= total - 1e-9 * size).sum())
    patterns = len(_signs(episodes))
    return extreme / patterns if episodes <= ENUMERATED else (extreme + 1) / (patterns + 1)


def _bootstrap_p(part: EpisodePart, difference: np.ndarray, weights: np.ndarray) -> float:
    """Two-sided p of bootstrap-t over episodes, both tails as in its interval; 0 where resampling says nothing or adds nothing."""
    episodes = len(difference)
    if part.se <= 0 or not FEWEST <= episodes <= MOST_RESAMPLED_HERE:
        return 0.0
    observed = part.value / part.se
    t = resampled_t(difference - part.value, weights, RESAMPLES_HERE)
    beyond = min(np.count_nonzero(t >= observed), np.count_nonzero(t <= observed))
    return min(1.0, 2 * (beyond + 1) / (RESAMPLES_HERE + 1))


@lru_cache(maxsize=4)
def _signs(episodes: int) -> np.ndarray:
    """[F, E] of ±1. The first sign can stay +1: turning all of them gives the same absolute sum."""
    if episodes <= ENUMERATED:
        bits = np.arange(2 ** (episodes - 1))[:, None] >> np.arange(episodes)
        signs = 1.0 - 2.0 * (bits & 1)
        signs = signs[:, ::-1]
    else:
        signs = np.random.default_rng(episodes).choice([-1.0, 1.0], size=(FLIPS, episodes))
    signs.flags.writeable = False
    return signs


def least_p(episodes: int) -> float:
    """The smallest p of flipping signs: one pattern and its mirror image out of all."""
    if episodes <= ENUMERATED:
        return min(1.0, 2.0 ** (1 - episodes))
    return 1 / (FLIPS + 1) if episodes <= MOST_FLIPPED else 0.0


def _t_p(pair: Paired) -> float:
    """The p at which an interval by t on both parts just touches zero.

    One t on the joint standard error with degrees of freedom by Welch & Satterthwaite alarms too often with two seeds (6 to
    8 % where 5 % is claimed): where the two happen to agree, it takes the episodes' many degrees of freedom for its own.
    """
    size = abs(pair.difference)
    if pair.episode_se == pair.seed_se == 0:
        return float(size == 0)
    low, high = -30.0, 0.0  # of the logarithm of p; smaller ones are all the same
    while high - low > 1e-6:
        middle = (low + high) / 2
        low, high = (low, middle) if _reach(pair, 10**middle) < size else (middle, high)
    return 10**high


def _reach(pair: Paired, alpha: float, power: float = 0.5, episodes: int | None = None, seeds: float = 1.0) -> float:
    """From what size on a difference is significant at alpha (two-sided) with this power, by t on each part.

    `episodes` in place of those there are, and `seeds` times as many seeds.
    """
    episodes = episodes or pair.episodes
    parts = (
        (pair.episode_se * math.sqrt(pair.episodes / episodes), episodes - 1),
        (pair.seed_se / math.sqrt(seeds), pair.seed_df * seeds),
    )
    reaches = [(t_quantile(power, df) - t_quantile(alpha / 2, df)) * se for se, df in parts if se > 0]
    return math.hypot(*reaches)


def _welch(*parts: tuple[float, float]) -> float:
    """Degrees of freedom of a sum of variances (Welch 1947; Satterthwaite 1946); parts without variance do not count."""
    total = sum(variance for variance, _ in parts)
    if total == 0:
        return sum(df for _, df in parts)
    return total**2 / sum(variance**2 / df for variance, df in parts if variance > 0)


def compare_errors(
    a: EpisodeErrors,
    b: EpisodeErrors,
    horizon: int,
    protocol: Protocol,
    *,
    trained: tuple[bool, bool] = (True, True),
) -> Paired | str:
    """Compare the mean absolute errors of two policies at a horizon, or say why they cannot be compared.

    Under `notebook` episodes count by their anchors, as the metric does.
    """
    if why := _what_differs(a, b, horizon):
        return why
    span = slice(horizon, horizon + 1)
    (of_a, counts), (of_b, _) = (span_means(errors, errors.absolute, span) for errors in (a, b))
    use = counts > 0
    if not (np.isfinite(of_a[:, use]).all() and np.isfinite(of_b[:, use]).all()):
        return "a prediction is no number"
    return compare_paired(
        of_a[:, use].mean(axis=2),
        of_b[:, use].mean(axis=2),
        counts[use] if protocol == "notebook" else None,
        a.fold[use],
        trained=trained,
    )


def _what_differs(a: EpisodeErrors, b: EpisodeErrors, horizon: int) -> str | None:
    """The first thing that keeps two policies from being compared, in words."""
    if a.absolute.shape[3] != b.absolute.shape[3]:
        return f"action columns differ: {a.absolute.shape[3]} and {b.absolute.shape[3]}"
    if not np.array_equal(a.episodes, b.episodes):
        common = len(np.intersect1d(a.episodes, b.episodes))
        return f"held-out episodes differ: {len(a.episodes)} and {len(b.episodes)}, {common} in common"
    if not np.array_equal(a.fold, b.fold):
        return "folds differ: the same episodes are held out, but not together"
    reached = min(a.anchors.shape[1], b.anchors.shape[1])
    if horizon >= reached:
        return f"horizon {horizon} is not reached: the shorter chunk holds {reached} action{'s' * (reached != 1)}"
    if not np.array_equal(a.anchors[:, horizon], b.anchors[:, horizon]):
        of_a, of_b = (int(errors.anchors[:, horizon].sum()) for errors in (a, b))
        return f"anchors differ: {of_a:,} and {of_b:,} frames" if of_a != of_b else "anchors differ"
    return None if a.anchors[:, horizon].any() else f"no held-out episode is longer than {horizon} frames"


# A family of comparisons ---------------------------------------------------------------------------------------------


def holm(p: Sequence[float]) -> np.ndarray:
    """p values that hold for the whole family (Holm 1979): the smallest times m, the next times m − 1, …; never falling."""
    p = np.asarray(p, np.float64)
    order = np.argsort(p, kind="stable")
    stepped = np.minimum(1.0, np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1)))
    adjusted = np.empty_like(stepped)
    adjusted[order] = stepped
    return adjusted


def judge(pairs: Sequence[tuple[str, str, str, Paired | str]]) -> list[Comparison]:
    """Verdicts on (a, b, metric, comparison), Holm over all of them that were tested.

    A reason in words in place of a comparison makes it "not comparable", outside the family. So are two that never differ:
    their p can only be 1, and such a test costs the others nothing (Tarone 1990).
    """
    tested = [
        i for i, (*_, pair) in enumerate(pairs) if isinstance(pair, Paired) and pair.p is not None and not pair.same
    ]
    p = np.array([pairs[i][3].p for i in tested])
    adjusted = dict(zip(tested, holm(p), strict=True))
    place = dict(zip(tested, np.argsort(np.argsort(p, kind="stable"), kind="stable"), strict=True))
    found = []
    for i, (a, b, metric, pair) in enumerate(pairs):
        if isinstance(pair, str):
            found.append(Comparison(a, b, metric, "not comparable", None, None, None, None, None, None, pair))
            continue
        p_holm = float(adjusted[i]) if i in adjusted else None
        word, needs, words = _verdict(pair, metric, p_holm, len(tested), int(place.get(i, 0)))
        numbers = (pair.difference, pair.interval, pair.p, p_holm, pair.smallest_seen)
        found.append(Comparison(a, b, metric, word, *numbers, needs, words))
    return found


def _verdict(pair: Paired, metric: str, p_holm: float | None, family: int, place: int) -> tuple[Word, int | None, str]:
    """The word, the episodes that are missing, and the reason. `place` is where p stands in the family, 0 the smallest."""
    if pair.same:
        same = (
            "the two predict the same"
            if metric not in HIGHER_IS_BETTER
            else f"equal from all {pair.episodes} {pair.sampled}"
        )
        return "cannot tell", None, same
    if p_holm is None:
        return "cannot tell", FEWEST, f"needs at least {FEWEST} {pair.sampled}; there are {pair.episodes}"
    about = " (one seed: about this one network)" if pair.one_network else ""
    if p_holm <= SURE:
        higher = pair.difference > 0
        word: Word = "better" if higher == (metric in HIGHER_IS_BETTER) else "worse"
        return word, None, _how_much(pair, metric) + about
    needs, words = _what_is_missing(pair, family, SURE / (family - place))
    return "cannot tell", needs, words + about


def _how_much(pair: Paired, metric: str) -> str:
    direction = "higher" if pair.difference > 0 else "lower"
    if metric in HIGHER_IS_BETTER:
        return f"{metric} {100 * abs(pair.difference):.0f} points {direction}"
    if pair.reference <= 0:
        return f"error {direction}"
    share = 100 * abs(pair.difference) / pair.reference
    if pair.difference > pair.reference:
        return f"error {1 + share / 100:.3g} times as high"
    return f"error {share:.{0 if share >= 10 else 1}f} % {direction}"


def _what_is_missing(pair: Paired, family: int, alpha: float) -> tuple[int | None, str]:
    """What a difference as large as the one observed would take to be seen with 80 % power, testing at alpha."""
    if family * pair.least_p > SURE:
        needs = _fewest(lambda n: family * least_p(n) <= SURE, pair.episodes + 1, ENUMERATED + 1) or ENUMERATED + 1
        words = f"needs at least {needs} {pair.sampled}: with fewer nothing can show among {family} comparisons"
        return needs, words

    def sees(episodes: int, times_the_seeds: float = 1.0) -> bool:
        return abs(pair.difference) >= _reach(pair, alpha, POWER, episodes, times_the_seeds)

    show = "would show a difference this large"
    if episodes := _fewest(sees, pair.episodes + 1, MOST_EPISODES):
        return episodes, f"about {episodes:,} {pair.sampled} {show}"
    now = max(pair.seeds)
    if pair.seed_se == 0:
        return None, f"too small a difference to show with {MOST_EPISODES:,} {pair.sampled}"
    if seeds := _fewest(lambda s: sees(pair.episodes, s / now), now + 1, MOST_SEEDS):
        return None, f"about {seeds:,} seeds {show}; more {pair.sampled} alone would not"
    if times := _fewest(
        lambda t: sees(pair.episodes * t, t), 2, min(MOST_EPISODES // pair.episodes, MOST_SEEDS // now)
    ):
        seeds, episodes = now * times, pair.episodes * times
        return episodes, f"about {seeds:,} seeds and {episodes:,} {pair.sampled} {show}"
    return None, f"too small a difference to show with any number of seeds and {pair.sampled} that people have"


def _fewest(enough: Callable[[int], bool], low: int, high: int) -> int | None:
    """The smallest whole number in low … high for which a growing condition holds, by bisection; None where none does."""
    if low > high or not enough(high):
        return None
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if enough(middle) else (middle + 1, high)
    return low


# A table's comparisons -----------------------------------------------------------------------------------------------


def table_comparisons(
    rows: Sequence[Row],
    champion: str | None,
    fps: float,
    protocol: Protocol,
    *,
    baselines: Collection[str] = BASELINES,
) -> list[Comparison]:
    """Each row against hold-still, and each against the champion, in one family of first-step and one-second errors.

    Parameters
    ----------
    rows : (policy, observations, errors).
    champion : "policy" or "policy/observations"; None: none was named. One that has no row, or several, gives verdicts
        "not comparable" that say so.
    baselines : the policies that are not trained, and so have no seeds.
    """
    by_address = {f"{policy}/{observations}": errors for policy, observations, errors in rows}
    still = [address for address in by_address if address.split("/")[0] == "hold_still"][:1]
    best, why_not = _champion(champion, list(by_address))
    pairs: dict[tuple[str, str], str | None] = {(a, b): None for b in still for a in by_address if a != b}
    if best:
        pairs |= {(a, best): None for a in by_address if a != best and a not in still}
    elif champion:
        pairs |= {(a, champion): why_not for a in by_address if a not in still}
    listed: list[tuple[str, str, str, Paired | str]] = []
    for (a, b), why in pairs.items():
        if why:
            listed.append((a, b, "first_step_mae", why))
            continue
        trained = (a.split("/")[0] not in baselines, b.split("/")[0] not in baselines)
        errors = by_address[a], by_address[b]
        for metric, horizon in horizons_in_common(*errors, fps).items():
            listed.append((a, b, metric, compare_errors(*errors, horizon, protocol, trained=trained)))
    return judge(listed)


def horizons_in_common(a: EpisodeErrors, b: EpisodeErrors, fps: float) -> dict[str, int]:
    """What two policies are compared on: metric → horizon; one second only where both reach it."""
    second = round(fps)
    both_reach = all(second < errors.anchors.shape[1] and errors.anchors[:, second].any() for errors in (a, b))
    return {"first_step_mae": 0} | ({"at_one_second_mae": second} if both_reach else {})


def _champion(champion: str | None, addresses: Sequence[str]) -> tuple[str | None, str]:
    """The address of the champion's row, or why there is none."""
    found = [address for address in addresses if champion in (address, address.split("/")[0])]
    if len(found) == 1:
        return found[0], ""
    if found:
        return None, f"the champion '{champion}' has several observation sets: name one of {', '.join(found)}"
    return None, f"the champion '{champion}' has no up-to-date result here"

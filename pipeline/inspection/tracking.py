"""Does the arm do as it is told, and how late? By how a joint's changes go with those of its command, frames later.

The lag is where the correlation of the two is largest (cross-correlation of first differences, so that resting poses
and offsets do not matter), between the neighbouring frames by a parabola.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pipeline.inspection.finding import Finding
from pipeline.inspection.survey import Column, Survey, per_episode, robust
from pipeline.lerobot_format.parts import blocks
from pipeline.types import ACTION, STATE

EARLY, LATE_S, LONGEST = 10, 1.0, 40
"""Lags looked at: from ten frames early to a second, at most 40 frames, late."""

FOLLOWS, DOES_NOT = 0.6, 0.3
"""Correlation from which a joint follows its command, and below which it does not."""

EARLY_LIMIT = -0.75
"""Frames; velocities that were worked out between neighbouring states are half a frame early, which is nobody's fault."""

LATE_LIMIT_S = 0.5
"""A joint that is later than this is told of: a policy that learns such pairs acts half a second in the past."""

EPISODE_LAG, EPISODE_LAG_S = 2.5, 0.1
"""Frames, and seconds, by which an episode's lag may differ from that of the data set; the larger counts."""

CLEARLY = 0.05
"""By how much the correlation must be larger at an episode's own lag than at the usual one: a gripper that stops at what it
holds follows about as well at many lags. Or by as much as it falls short of 1, where that is less: smooth motion."""

WORSE, DEVIATIONS = 3.0, 8.0
"""An episode follows worse when its mean |a − s| is three times the median and eight deviations above it, and at least
2 % of the joint's span."""


@dataclass(frozen=True)
class Following:
    """How one joint follows its command: over all episodes, and in each [E].

    column  the command, without its values
    lag   frames; NaN where it does not follow       correlation  at that lag
    better  [E] how much larger the correlation is at the episode's own lag than at that of all
    gap   [E] mean |a − s| of a position command, in its unit; NaN for others
    """

    column: Column
    lag: float
    correlation: float
    lags: np.ndarray
    correlations: np.ndarray
    better: np.ndarray
    gap: np.ndarray


def follow(survey: Survey) -> Iterator[Following]:
    """One for every action column that moves and commands a state column that moves."""
    for column in survey.living(ACTION):
        if column.partner is not None and not survey.dead[STATE][column.partner]:
            yield _follow(survey, column, survey.column(STATE, column.partner))


def _follow(survey: Survey, command: Column, state: Column) -> Following:
    told = command.values if command.is_rate else survey.steps(command)
    done = survey.steps(state)
    lags, table = _correlate(survey, told, done)
    energy = np.sqrt(per_episode(told * told, survey.starts) * per_episode(done * done, survey.starts))
    with np.errstate(divide="ignore", invalid="ignore"):
        each = np.where(energy > 0, table / energy, 0.0)
        everything = table.sum(axis=1) / np.sqrt(
            float((told * told).sum(dtype=np.float64)) * float((done * done).sum(dtype=np.float64))
        )
    whole, correlation = _peak(lags, everything[:, None])
    own, correlations = _peak(lags, each)
    usual = each[np.searchsorted(lags, round(float(whole[0])))]
    moves = energy > 0.1 * energy.mean()  # not the median: most episodes may leave a joint alone
    gap = np.full(survey.demos.episodes, np.nan)
    if command.kind == "position" and not command.circular:
        gap = per_episode(np.abs(command.values - state.values), survey.starts) / survey.demos.lengths
    return Following(
        replace(command, values=np.empty(0, np.float32)),  # a view would keep them all
        float(whole[0]) if correlation[0] >= DOES_NOT else float("nan"), float(correlation[0]),
        np.where(moves, own, np.nan), np.where(moves, correlations, np.nan), correlations - usual, gap,
    )  # fmt: skip


def _correlate(survey: Survey, told: np.ndarray, done: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lags [L] and Σ told_t · done_{t + lag} [L, E] within each episode."""
    late = int(min(LONGEST, survey.frames(LATE_S, least=3), survey.demos.lengths.max()))
    lags = np.arange(-EARLY, late + 1)
    table = np.empty((len(lags), survey.demos.episodes))
    for episodes, frames in blocks(survey.starts):
        ends = np.repeat(survey.starts[1:][episodes], survey.demos.lengths[episodes])
        left = ends - np.arange(frames.start, frames.stop)  # to the end of the episode
        begins = survey.starts[:-1][episodes] - frames.start
        for row, lag in enumerate(lags):
            one, other = (told[frames], done[frames]) if lag >= 0 else (done[frames], told[frames])
            shift = abs(int(lag))
            product = np.zeros_like(one)
            if shift < len(one):
                np.multiply(one[: len(one) - shift], other[shift:], out=product[: len(one) - shift])
            product[left <= shift] = 0
            table[row, episodes] = np.add.reduceat(product, begins, dtype=np.float64)
    return lags, table


def _peak(lags: np.ndarray, table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where each column of `table` [L, n] is largest, between lags by a parabola, and how large."""
    best = np.argmax(table, axis=0)
    inner, each = np.clip(best, 1, len(lags) - 2), np.arange(table.shape[1])
    before, at, after = table[inner - 1, each], table[inner, each], table[inner + 1, each]
    bend = before - 2 * at + after
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = np.where((bend < 0) & (best == inner), 0.5 * (before - after) / bend, 0.0)
    return lags[best] + np.clip(np.nan_to_num(shift), -0.5, 0.5), table[best, each]


def check_tracking(survey: Survey, followings: list[Following]) -> Iterator[Finding]:
    for following in followings:
        yield from _whole(survey, following)
        yield from _episodes(survey, following)


def _whole(survey: Survey, following: Following) -> Iterator[Finding]:
    name, lag = following.column.key, following.lag
    if following.correlation >= FOLLOWS and lag < EARLY_LIMIT:
        yield Finding(
            "tracking", None, name, lag, EARLY_LIMIT,
            f"The state moves {-lag:.1f} frames before {name} tells it to: actions seem to be stored too late against states.",
        )  # fmt: skip
    if following.correlation >= FOLLOWS and survey.seconds(lag) > LATE_LIMIT_S:
        yield Finding(
            "tracking", None, name, survey.seconds(lag), LATE_LIMIT_S,
            f"The arm follows {name} {survey.seconds(lag):.2f} s late ({lag:.1f} frames).",
        )  # fmt: skip


def _episodes(survey: Survey, following: Following) -> Iterator[Finding]:
    column, known = following.column, np.isfinite(following.lags)
    if following.correlation < FOLLOWS or known.sum() < 3:
        return
    usual = float(np.median(following.lags[known]))
    limit = max(EPISODE_LAG, survey.frames(EPISODE_LAG_S))
    lost = known & (following.correlations < DOES_NOT)
    late = known & (following.correlations >= FOLLOWS) & (np.abs(following.lags - usual) > limit)
    late &= following.better > np.minimum(CLEARLY, 1 - following.correlations)
    for episode in np.flatnonzero(lost):
        yield Finding(
            "tracking", survey.id(episode), column.key, float(following.correlations[episode]), DOES_NOT,
            f"The state does not follow {column.key}: the correlation of their changes is {following.correlations[episode]:.2f}, "
            f"over all episodes {following.correlation:.2f}.",
        )  # fmt: skip
    for episode in np.flatnonzero(late):
        yield Finding(
            "tracking", survey.id(episode), column.key, float(following.lags[episode]), usual + limit,
            f"The state follows {column.key} {following.lags[episode]:.1f} frames late, in the other episodes {usual:.1f}.",
        )  # fmt: skip
    yield from _worse(survey, following, lost | late)


def _worse(survey: Survey, following: Following, told: np.ndarray) -> Iterator[Finding]:
    """Episodes that stay further from their commands than the others, unless that has been told already."""
    column, gap = following.column, following.gap
    if not np.isfinite(gap).all():
        return
    centre, deviation = robust(gap)
    limit = max(WORSE * centre, centre + DEVIATIONS * deviation, 0.02 * column.span)
    for episode in np.flatnonzero((gap > limit) & ~told):
        yield Finding(
            "tracking", survey.id(episode), column.key, float(gap[episode]), limit,
            f"The state stays {column.amount(gap[episode])} from {column.key} on average, in the median episode "
            f"{column.amount(centre)}.",
        )  # fmt: skip

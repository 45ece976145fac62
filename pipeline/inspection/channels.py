"""Columns that do not say what happens: dead in all episodes, stuck at an end of their range, frozen for a while."""

from collections.abc import Iterator

import numpy as np

from pipeline.inspection.finding import Finding
from pipeline.inspection.motion import is_switch
from pipeline.inspection.survey import Column, Survey, runs
from pipeline.lerobot_format.quality import ASK_UNIT, dead_by_unit
from pipeline.types import ACTION, STATE

FEW = 4
"""Dead columns of a feature that are named one by one; more are counted."""

SATURATED, AT_LEAST_S = 0.02, 0.3
"""Share of the frames that a command spends at exactly its largest or smallest value, for 0.3 s or longer at a time,
while another column moves. A folded arm that rests at a mechanical stop moves nowhere, and does not count."""

MOVES = 0.005
"""Share of its span by which a column changes in a frame when it moves."""

FROZEN_S, FROZEN = 0.3, 0.2
"""A frozen state repeats exactly for 0.3 s or longer while its command moves by a fifth of its span. Sticking joints and
coarse encoders repeat as well, while the command moves by up to 13 % of the span on the SO-101. Its gripper, closed on an
object, does so to 21 %: grippers are told apart by their name, and by how often their column does this."""

TOGETHER = 0.4
"""All of the state repeats at once for 0.3 s or longer while what the commands move by, in spans of their joints, adds up
to this. On the SO-101 at rest it adds up to 0.24."""

OFTEN = 0.2
"""Share of the episodes from which half as much is how the hardware is: a gripper, whatever its name."""


def check_dead(survey: Survey) -> Iterator[Finding]:
    for feature, dead in survey.dead.items():
        names, places = survey.demos.features[feature].names, np.flatnonzero(dead)
        by_unit = dead_by_unit(survey.demos, feature)
        if len(places) > FEW:
            ask = f" {by_unit.sum()} of them only for their unit. {ASK_UNIT}." if by_unit.any() else ""
            yield Finding(
                "dead",
                None,
                None,
                len(places),
                FEW,
                f"{len(places)} of {len(names)} columns of {feature} hardly move.{ask}",
            )
            continue
        for place in places:
            values, unit = survey.demos.columns[feature][:, place], survey.demos.features[feature].units[place]
            ask = f", next to nothing for {unit}. {ASK_UNIT}" if by_unit[place] else ""
            yield Finding(
                "dead", None, f"{feature}/{names[place]}", float(values.std(dtype=np.float64)), None,
                f"{feature}/{names[place]} hardly moves: it lies between {values.min():.4g} and {values.max():.4g} in all "
                f"frames{ask}. It cannot be learned, and is left out of errors divided by the deviation.",
            )  # fmt: skip


def check_saturated(survey: Survey) -> Iterator[Finding]:
    movers = _movers(survey)
    for column in survey.living(ACTION):
        if column.is_gripper or is_switch(column) or column.span <= 0:
            continue
        others = movers - _moves(survey, column)
        for end, extreme in (("largest", column.values.max()), ("smallest", column.values.min())):
            first, stop = runs(column.values == extreme, survey.starts)
            long = stop - first >= survey.frames(AT_LEAST_S, least=3)
            first, stop = first[long], stop[long]
            held = np.zeros(survey.demos.frames, bool)
            for one, other in zip(first, stop, strict=True):
                held[one:other] = True
            share = float((held & (others > 0)).mean())
            if share > SATURATED:
                yield _saturated(survey, column, end, float(extreme), share, first, stop)


def _saturated(
    survey: Survey, column: Column, end: str, extreme: float, share: float, first: np.ndarray, stop: np.ndarray
) -> Finding:
    longest = int(np.argmax(stop - first))
    episodes = np.searchsorted(survey.starts, first, side="right") - 1
    return Finding(
        "saturated", None, column.key, share, SATURATED,
        f"{column.key} sits at its {end} value, {extreme:.4g}, in {share:.1%} of all frames while something else moves "
        f"(in {len(np.unique(episodes))} of {survey.demos.episodes} episodes; the longest is "
        f"{survey.seconds(stop[longest] - first[longest]):.1f} s, in episode {survey.id(episodes[longest])}): is it clipped there?",
    )  # fmt: skip


def _moves(survey: Survey, column: Column) -> np.ndarray:
    return (np.abs(survey.steps(column)) > MOVES * column.span).astype(np.int16)


def _movers(survey: Survey) -> np.ndarray:
    """[N] how many action columns move at each frame."""
    count = np.zeros(survey.demos.frames, np.int16)
    for column in survey.living(ACTION):
        count += _moves(survey, column)
    return count


def check_frozen(survey: Survey) -> Iterator[Finding]:
    told: set[int | None] = set()
    for command in _commands(survey):
        for finding in _frozen(survey, command, survey.column(STATE, command.partner)):
            told.add(finding.episode)
            yield finding
    yield from (finding for finding in _together(survey) if finding.episode not in told)
    yield from _constant(survey)


def _commands(survey: Survey) -> Iterator[Column]:
    """Action columns that command a state column that moves; no grippers."""
    for command in survey.living(ACTION):
        if command.partner is not None and not survey.dead[STATE][command.partner] and not command.is_gripper:
            yield command


def _together(survey: Survey) -> Iterator[Finding]:
    """Stretches in which every state repeats exactly while the arm is told to go elsewhere: its telemetry stands still."""
    same = np.ones(survey.demos.frames, bool)
    for state in survey.living(STATE):
        same[:-1] &= state.values[1:] == state.values[:-1]
    same[survey.starts[1:] - 1] = False
    first, stop = runs(same, survey.starts)
    long = stop - first >= survey.frames(FROZEN_S, least=4)
    first, stop = first[long], stop[long]
    told = np.zeros(len(first))
    for command in _commands(survey):
        span = survey.spans[STATE][command.partner]
        told += [_told(survey, command, one, other) / span for one, other in zip(first, stop, strict=True)]
    for one, other, share in zip(first, stop, told, strict=True):
        episode = int(np.searchsorted(survey.starts, one, side="right")) - 1
        if share > TOGETHER:
            yield Finding(
                "frozen", survey.id(episode), None, float(share), TOGETHER,
                f"All of the state repeats exactly for {survey.seconds(other - one):.1f} s from frame "
                f"{one - survey.starts[episode]} on, while commands move by {share:.0%} of their joints' usual ranges, added up.",
                grave=True,
            )  # fmt: skip


def _frozen(survey: Survey, command: Column, state: Column) -> Iterator[Finding]:
    """Stretches in which one state repeats exactly while its command goes elsewhere."""
    same = np.zeros(survey.demos.frames, bool)
    same[:-1] = state.values[1:] == state.values[:-1]
    same[survey.starts[1:] - 1] = False
    first, stop = runs(same, survey.starts)
    long = stop - first >= survey.frames(FROZEN_S, least=4)
    first, stop = first[long], stop[long]
    if not len(first) or state.span <= 0:
        return
    told = np.array([_told(survey, command, one, other) for one, other in zip(first, stop, strict=True)]) / state.span
    bad = np.flatnonzero(told > FROZEN)
    episode_of = np.searchsorted(survey.starts, first, side="right") - 1
    usual = np.unique(episode_of[told > FROZEN / 2])
    if len(usual) > max(2, OFTEN * survey.demos.episodes):
        return
    for episode in np.unique(episode_of[bad]):
        mine = bad[episode_of[bad] == episode]
        worst = int(mine[np.argmax(told[mine])])
        at = first[worst] - survey.starts[episode]
        yield Finding(
            "frozen", survey.id(episode), state.key, float(told[worst]), FROZEN,
            f"{state.key} repeats exactly for {survey.seconds(stop[worst] - first[worst]):.1f} s from frame {at} on, while its "
            f"command moves by {told[worst]:.0%} of the joint's usual range.", grave=True,
        )  # fmt: skip


def _told(survey: Survey, command: Column, first: int, stop: int) -> float:
    """How far a command asks to go during a stretch of frames."""
    values = command.values[first : stop + 1].astype(np.float64)
    if not command.is_rate:
        return float(np.ptp(values))
    return float(abs(values.sum())) * (survey.tick if command.kind == "velocity" else 1.0)


def _constant(survey: Survey) -> Iterator[Finding]:
    """Columns that never change in an episode, though they do in nearly all others."""
    if survey.demos.episodes < 5:
        return
    for column in survey.living(ACTION, STATE):
        low = np.minimum.reduceat(column.values, survey.starts[:-1])
        constant = np.maximum.reduceat(column.values, survey.starts[:-1]) == low
        if not constant.any() or constant.mean() > OFTEN:
            continue
        for episode in np.flatnonzero(constant):
            yield Finding(
                "frozen", survey.id(episode), column.key, 0.0, None,
                f"{column.key} is {low[episode]:.4g} from the first frame to the last; it moves in the other episodes.",
                grave=column.feature == STATE,
            )  # fmt: skip

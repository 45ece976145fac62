"""How things move: seconds in which nothing does, and values that leap.

What does not belong here: whether the arm does as it is told (tracking.py, channels.py).
"""

from collections import defaultdict
from collections.abc import Iterator

import numpy as np

from pipeline.inspection.finding import Finding
from pipeline.inspection.survey import Column, Survey, robust
from pipeline.lerobot_format.parts import parts
from pipeline.types import ACTION, STATE

IDLE_S, IDLE_SHARE = 2.0, 0.1
"""An idle start or end is worth a word from two seconds on, where it is a tenth of the episode and unlike the others'."""

IDLE_WHOLE = 0.15
"""Share of all frames in idle starts and ends from which the data set as a whole teaches waiting."""

JUMP, JUMP_SHARE = 5.0, 0.1
"""A jump sticks out of the steps around it by five times what 99 % of the steps do, and by a tenth of the column's span.
On clean data (real arms, a mouse, the known-truth generators) the largest ratio seen above a tenth of the span was 4.3,
people flicking a mouse. The median step would be no measure: arms rest half of the time, and any motion is many times the
median then."""

LIKE = 0.25
"""Share of what is usual among columns of its kind below which a column's own usual step is not believed."""

OFTEN = 0.2
"""Share of the episodes with such leaps from which they are how the column moves: a gripper that switches."""

SWITCH = 0.8
"""Share of the frames within 5 % of either end of its range that makes a column a switch, which may leap."""


def check_idle(survey: Survey) -> Iterator[Finding]:
    lengths = survey.demos.lengths
    idle = dict(zip(("begins", "ends"), survey.moved, strict=True))
    still = idle["begins"] >= lengths
    share = float(sum(frames[~still].sum() for frames in idle.values()) / max(1, lengths.sum()))
    if share > IDLE_WHOLE:
        middle = [survey.seconds(float(np.median(frames))) for frames in idle.values()]
        yield Finding(
            "idle", None, None, share, IDLE_WHOLE,
            f"Nothing moves in {share:.0%} of all frames, at the starts (median {middle[0]:.1f} s) and ends (median "
            f"{middle[1]:.1f} s) of episodes: a policy learns to wait there.",
        )  # fmt: skip
    for where, frames in idle.items():
        centre, deviation = robust(frames)
        limit = max(survey.frames(IDLE_S), centre + 4 * deviation)
        for episode in np.flatnonzero((frames > limit) & (frames > IDLE_SHARE * lengths) & ~still):
            yield Finding(
                "idle", survey.id(episode), None, survey.seconds(frames[episode]), survey.seconds(limit),
                f"It {where} with {survey.seconds(frames[episode]):.1f} s in which nothing moves, "
                f"{frames[episode] / lengths[episode]:.0%} of the episode (the median of all is {survey.seconds(centre):.1f} s).",
            )  # fmt: skip


def check_jumps(survey: Survey) -> Iterator[Finding]:
    usual: dict[tuple[str, str | None, bool], list[float]] = defaultdict(list)
    for column in survey.living(ACTION, STATE):
        usual[_like(column)].append(_usual(_excess(survey, column)))
    for column in survey.living(ACTION, STATE):
        # A column that hardly ever moves knows nothing but noise: it is judged by its like.
        of_its_like = float(np.percentile(usual[_like(column)], 50, method="lower"))
        yield from _column_jumps(survey, column, LIKE * of_its_like)


def _like(column: Column) -> tuple[str, str | None, bool]:
    return column.feature, column.unit, column.is_rate


def _usual(excess: np.ndarray) -> float:
    """What 99 % of the steps that stick out at all do not exceed."""
    sticking_out = excess[excess > 0]
    return float(np.quantile(sticking_out, 0.99)) if len(sticking_out) else 0.0


def _column_jumps(survey: Survey, column: Column, least: float) -> Iterator[Finding]:
    excess = _excess(survey, column)
    usual = max(_usual(excess), least)
    if usual == 0 or is_switch(column):
        return
    limit = max(JUMP * usual, JUMP_SHARE * column.span)
    frames = np.flatnonzero(excess > limit)
    episode_of = np.searchsorted(survey.starts, frames, side="right") - 1
    concerned = np.unique(episode_of)
    if len(concerned) > max(2, OFTEN * survey.demos.episodes):
        return
    for episode in concerned:
        mine = frames[episode_of == episode]
        worst = int(mine[np.argmax(excess[mine])])
        at = worst - survey.starts[episode]
        more = f" ({len(mine)} such jumps)" if len(mine) > 1 else ""
        step = abs(float(column.values[worst + 1]) - float(column.values[worst]))
        around = step - float(excess[worst])
        beside = (
            f"the steps around it are {column.amount(around)}" if around > 0.01 * step else "around it it hardly moves"
        )
        yield Finding(
            "jump", survey.id(episode), column.key, float(excess[worst]), limit,
            f"{column.key} jumps by {column.amount(step)} between frames {at} and {at + 1}, {step / column.span:.0%} of its "
            f"usual range{more}; {beside}.",
        )  # fmt: skip


def _excess(survey: Survey, column: Column) -> np.ndarray:
    """[N] by how much each step is larger than the median of the two steps before and the two after it.

    Where frames were lost, a step covers more time: it is divided by the ticks that it took, unless it is a rate.
    """
    steps, stamps = survey.steps(column), survey.demos.timestamps
    np.abs(steps, out=steps)
    padded = np.pad(steps, 2)
    inner = padded[2:-2]
    for part in parts(len(steps) - 1) if not column.is_rate else ():
        ticks = np.diff(stamps[part.start : part.stop + 1]) / survey.tick
        inner[part] /= np.clip(np.nan_to_num(ticks, nan=1.0), 1.0, None).astype(np.float32)
    for part in parts(len(steps)):
        around = np.stack([padded[part.start + away : part.stop + away] for away in (0, 1, 3, 4)])
        around.sort(axis=0)
        steps[part] = inner[part] - (around[1] + around[2]) / 2
    return steps


def is_switch(column: Column) -> bool:
    """Whether the column rests at the ends of its range nearly always."""
    low, high = np.quantile(column.values, [0.005, 0.995])
    margin = 0.05 * (high - low)
    return float(((column.values <= low + margin) | (column.values >= high - margin)).mean()) >= SWITCH

"""The recorded clock against fps: another rate, an uneven tick, gaps, time that stands still or runs backwards."""

from collections.abc import Iterator

import numpy as np

from pipeline.inspection.finding import Finding
from pipeline.inspection.survey import Survey

WRONG_RATE = 0.05
"""Share by which the usual tick may differ from 1 / fps: recorders that mean 30 and reach 29.97 are fine."""

OFF, UNEVEN = 0.2, 0.01
"""A tick is off when it differs from 1 / fps by a fifth; more than one in a hundred makes an uneven clock."""

GAP, GAP_S = 3.5, 1.0
"""A gap is a tick of about four usual ones (three frames lost) or more; from a second on the episode is broken in two."""

EPISODE_RATE = 0.2
"""Share by which an episode's own usual tick may differ from that of the data set."""


def check_clock(survey: Survey) -> Iterator[Finding]:
    demos = survey.demos
    inside = np.ones(demos.frames - 1, bool)
    inside[demos.episode_starts[1:-1] - 1] = False
    seconds = np.diff(demos.timestamps)
    if not inside.any():
        return
    usual = float(np.median(seconds[inside], overwrite_input=True))
    yield from _whole(survey, seconds, inside, usual)
    if usual <= 0:
        return
    for episode in range(demos.episodes):
        first, stop = demos.episode_starts[episode : episode + 2]
        yield from _episode(survey, episode, seconds[first : stop - 1], usual)


def _whole(survey: Survey, seconds: np.ndarray, inside: np.ndarray, usual: float) -> Iterator[Finding]:
    tick, fps = survey.tick, survey.demos.fps
    if abs(usual - tick) > WRONG_RATE * tick:
        is_rate = f", which is {1 / usual:.3g} frames a second" if usual > 0 else ""
        yield Finding(
            "clock", None, "timestamp", usual, tick * (1 + WRONG_RATE),
            f"The recorded clock ticks every {usual:.3f} s{is_rate}; fps = {fps:g} says {tick:.3f} s. "
            "Everything in seconds is wrong by that factor.",
        )  # fmt: skip
        return
    off = np.abs(seconds - tick) > OFF * tick
    off &= inside
    share = float(off.sum() / inside.sum())
    if share > UNEVEN:
        lengths = survey.demos.lengths
        counts = np.add.reduceat(np.append(off, False), survey.starts[:-1], dtype=np.int64)
        worst = int(np.argmax(counts / lengths))
        low, high = seconds.min(where=inside, initial=np.inf), seconds.max(where=inside, initial=-np.inf)
        yield Finding(
            "clock", None, "timestamp", share, UNEVEN,
            f"Uneven clock: a tick lasts {low:.3f} to {high:.3f} s where fps says {tick:.3f} s, and {share:.1%} of the ticks are "
            f"off by more than a fifth (most in episode {survey.id(worst)}: {counts[worst] / lengths[worst]:.1%}). "
            "Horizons in seconds are nominal.",
        )  # fmt: skip


def _episode(survey: Survey, episode: int, seconds: np.ndarray, usual: float) -> Iterator[Finding]:
    number = survey.id(episode)
    if not len(seconds):
        return
    stuck = int((seconds <= 0).sum())
    if stuck:
        yield Finding(
            "clock", number, "timestamp", stuck, 1,
            f"The clock stands still or runs backwards at {stuck} of {len(seconds) + 1} frames.", grave=True,
        )  # fmt: skip
    own = float(np.median(seconds))
    if not stuck and abs(own - usual) > EPISODE_RATE * usual:
        yield Finding(
            "clock", number, "timestamp", own, usual * (1 + EPISODE_RATE),
            f"Its clock ticks every {own:.3f} s, that of the other episodes every {usual:.3f} s.", grave=True,
        )  # fmt: skip
        return
    longest = int(np.argmax(seconds))
    if seconds[longest] >= GAP * usual:
        gaps = int((seconds >= GAP * usual).sum())
        more = f", the longest of {gaps} gaps" if gaps > 1 else ""
        yield Finding(
            "clock", number, "timestamp", float(seconds[longest]), GAP * usual,
            f"{seconds[longest]:.2f} s pass between frames {longest} and {longest + 1}, {seconds[longest] / usual:.0f} ticks"
            f"{more}: frames are missing.", grave=bool(seconds[longest] >= GAP_S),
        )  # fmt: skip

"""All detectors in a row, the five episodes to look at, and the episodes worth leaving out."""

import shlex
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.inspection.alike import check_duplicates
from pipeline.inspection.channels import check_dead, check_frozen, check_saturated
from pipeline.inspection.clock import check_clock
from pipeline.inspection.finding import CHECKS, Finding, gather
from pipeline.inspection.labels import check_labels
from pipeline.inspection.motion import check_idle, check_jumps
from pipeline.inspection.outliers import check_outliers, check_short
from pipeline.inspection.survey import Survey
from pipeline.inspection.tracking import check_tracking, follow
from pipeline.inspection.videos import check_videos, no_videos
from pipeline.types import Demonstrations, Semantics

LOOK_AT, MOST_SAID = 5, 20
MOST_EXCLUDED = 0.5
"""Share of the episodes above which leaving them out is no remedy: the data set has the fault, not the episodes."""

_STANDS = ("short", "clock", "duplicate", "video")
"""What is said of an episode that holds no demonstration."""

Say = Callable[[str, int, int], None]
"""`say(what, done, total)`: what is being looked at."""


@dataclass(frozen=True)
class Inspection:
    """What was found.

    findings    in the order of CHECKS, the data set's before those of episodes
    look_at     (episode, what speaks for looking at it), at most LOOK_AT, the first first
    exclude     recorded numbers of the episodes with a grave fault, sorted
    lag_frames  [A] how many frames later than its command each joint moves; None where that is not known
    skipped     check → why it could not be made
    """

    findings: tuple[Finding, ...]
    look_at: tuple[tuple[int, tuple[str, ...]], ...]
    exclude: tuple[int, ...]
    lag_frames: tuple[float | None, ...]
    skipped: Mapping[str, str]

    @property
    def exclude_line(self) -> str:
        """The line for demobench.toml; empty where nothing is worth leaving out."""
        return f"exclude = [{', '.join(map(str, self.exclude))}]" if self.exclude else ""

    def verdict(self, check: str) -> tuple[bool, str]:
        """Whether a check found nothing, and what it found, in words."""
        mine = [finding for finding in self.findings if finding.check == check]
        said = [f.words if f.episode is None else f"Episode {f.episode}: {f.words}" for f in mine[:MOST_SAID]]
        more = [f"… and {len(mine) - MOST_SAID} more."] if len(mine) > MOST_SAID else []
        fine = f"not looked at: {self.skipped[check]}" if check in self.skipped else "nothing looks wrong"
        return not mine, " ".join([*said, *more]) or fine

    def as_json(self, argument: str) -> dict[str, Any]:
        """The keys that `demobench inspect --json` adds; `argument` is how the user names the data set."""
        return {
            "lag_frames": [None if lag is None else round(lag, 2) for lag in self.lag_frames],
            "findings": [finding.as_json() for finding in self.findings],
            "look_at": [
                {"episode": episode, "reasons": list(reasons), "command": view_command(argument, episode)}
                for episode, reasons in self.look_at
            ],
            "exclude": list(self.exclude),
            "exclude_line": self.exclude_line,
            "skipped": dict(self.skipped),
        }


def view_command(argument: str, episode: int) -> str:
    return f"demobench view {shlex.quote(argument)} {episode}"


def inspect(
    demos: Demonstrations, semantics: Semantics, folder: Path | None = None, say: Say | None = None
) -> Inspection:
    """Run every detector. `folder` is where the data set's files lie, for its videos; without one they are not looked at.

    Raises:
        DatasetError: meta/ cannot be read.
    """
    survey = Survey(demos, semantics)
    followings = list(follow(survey))
    detectors: dict[str, Callable[[], Iterable[Finding]]] = {
        "clock": lambda: check_clock(survey),
        "tracking": lambda: check_tracking(survey, followings),
        "idle": lambda: check_idle(survey),
        "jump": lambda: check_jumps(survey),
        "saturated": lambda: check_saturated(survey),
        "dead": lambda: check_dead(survey),
        "frozen": lambda: check_frozen(survey),
        "duplicate": lambda: check_duplicates(survey),
        "short": lambda: check_short(survey),
        "outlier": lambda: check_outliers(survey),
        "video": lambda: check_videos(demos, folder),
        "label": lambda: check_labels(survey),
    }
    found: list[Finding] = []
    for number, (name, detect) in enumerate(detectors.items()):
        if say:
            say(name, number, len(detectors))
        found += detect()
    findings = gather(_without_echoes(found), demos.episodes)
    exclude = sorted({f.episode for f in findings if f.grave and f.episode is not None})
    return Inspection(
        findings, _look_at(findings), tuple(exclude) if len(exclude) <= MOST_EXCLUDED * demos.episodes else (),
        _lags(semantics, {following.column.position: following.lag for following in followings}),
        {"video": why} if (why := no_videos(demos, folder)) else {},
    )  # fmt: skip


def _lags(semantics: Semantics, lags: Mapping[int, float]) -> tuple[float | None, ...]:
    each = [lags.get(position, np.nan) for position in range(len(semantics.kinds))]
    return tuple(float(lag) if np.isfinite(lag) else None for lag in each)


def _look_at(findings: Sequence[Finding]) -> tuple[tuple[int, tuple[str, ...]], ...]:
    """Episodes by the weight of what was found in them; one check counts once, by its weightiest finding."""
    of_episode: dict[int, list[Finding]] = defaultdict(list)
    for finding in findings:
        if finding.episode is not None:
            of_episode[finding.episode].append(finding)

    def weight(mine: list[Finding]) -> float:
        return sum(max(f.weight for f in mine if f.check == check) for check in {f.check for f in mine})

    ranked = sorted(of_episode, key=lambda episode: (-weight(of_episode[episode]), episode))[:LOOK_AT]
    return tuple((episode, _reasons(of_episode[episode])) for episode in ranked)


def _reasons(mine: Sequence[Finding]) -> tuple[str, ...]:
    """The weightiest finding of each check, and how many more it has."""
    reasons = {}
    for finding in sorted(mine, key=lambda finding: -finding.weight):
        reasons.setdefault(finding.check, []).append(finding.words)
    return tuple(
        first + (f" (And {len(more)} more of this kind.)" if more else "") for first, *more in reasons.values()
    )


def _without_echoes(findings: Sequence[Finding]) -> list[Finding]:
    """An episode that holds no demonstration is unlike the others in every way: once is enough."""
    empty = {finding.episode for finding in findings if finding.check == "short"}
    return [f for f in findings if f.episode is None or f.episode not in empty or f.check in _STANDS]


__all__ = ["CHECKS", "Inspection", "inspect", "view_command"]

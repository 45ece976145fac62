"""What a detector yields, the checks there are, and gathering what is said of many episodes into one sentence.

What does not belong here: looking at data.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

CHECKS = {
    "clock": "The recorded clock ticks as fps says, without gaps, and never backwards.",
    "tracking": "Every joint follows its command, about equally late in every episode.",
    "idle": "Episodes do not begin or end with seconds in which nothing moves.",
    "jump": "No action or state leaps from one frame to the next as nothing else in its column does.",
    "saturated": "No command sits at the end of its range while the rest of the arm moves.",
    "dead": "Every column of actions and observations moves.",
    "frozen": "No state repeats exactly while the arm is told to move.",
    "duplicate": "No recording is there twice, whole, shifted or cut.",
    "short": "Every episode holds a demonstration: it is long enough, and something moves in it.",
    "outlier": "No episode is far longer or shorter, starts elsewhere, or goes where no other goes.",
    "video": "Every video file holds the frames that meta/ lists.",
    "label": "Tasks are written alike, and actions are in the unit of the state.",
}
"""Every check by name, and what it finds when all is well."""

MANY = 0.25
"""What is said of more than this share of the episodes (and of more than four) is said once, of the data set."""

_WEIGHTS = {"tracking": 2.0, "jump": 2.0, "frozen": 3.0, "clock": 2.0, "outlier": 2.0, "duplicate": 3.0, "short": 3.0}


@dataclass(frozen=True)
class Finding:
    """One thing that looks wrong.

    episode  the recorded `episode_index`, None for the data set as a whole
    column   `feature/column`, None where no single one is meant
    value    what was measured, and `limit` what it should not pass; in the unit that `words` name
    grave    the episode is worth leaving out: it is a copy, empty, frozen, or its clock is broken
    """

    check: str
    episode: int | None
    column: str | None
    value: float | None
    limit: float | None
    words: str
    grave: bool = False

    @property
    def weight(self) -> float:
        """How much this speaks for looking at its episode."""
        far = abs(self.value / self.limit) if self.value and self.limit else 1.0
        return (10.0 if self.grave else 0.0) + _WEIGHTS.get(self.check, 1.0) * min(max(far, 1 / max(far, 1e-9)), 4.0)

    def as_json(self) -> dict[str, Any]:
        """Plain values, numbers to six digits."""
        numbers = {
            name: None if value is None else float(f"{value:.6g}")
            for name, value in (("value", self.value), ("limit", self.limit))
        }
        return {"check": self.check, "episode": self.episode, "column": self.column, **numbers, "words": self.words}


def gather(findings: Sequence[Finding], episodes: int) -> tuple[Finding, ...]:
    """Findings in the order of CHECKS, of the data set before those of episodes, the weightiest first.

    What one check says of one column in many episodes becomes one finding of the data set, with the weightiest as its
    example; grave findings stay as they are, because each names an episode to leave out.
    """
    groups: dict[tuple[str, str | None], list[Finding]] = defaultdict(list)
    kept = []
    for finding in findings:
        alone = finding.episode is None or finding.grave
        (kept if alone else groups[finding.check, finding.column]).append(finding)
    for group in groups.values():
        concerned = {finding.episode for finding in group}
        if len(concerned) <= max(4, MANY * episodes):
            kept += group
            continue
        worst = max(group, key=lambda finding: finding.weight)
        words = f"In {len(concerned)} of {episodes} episodes; the clearest is episode {worst.episode}: {worst.words}"
        kept.append(Finding(worst.check, None, worst.column, worst.value, worst.limit, words))
    order = list(CHECKS)
    return tuple(sorted(kept, key=lambda f: (order.index(f.check), f.episode is not None, -f.weight)))

"""What several detectors need of a data set, worked out once, and the arithmetic of steps and runs within episodes.

Everything is done a column at a time, in float32: next to a million frames of many columns it takes little memory.
What does not belong here: judging.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pipeline.lerobot_format.kinds import state_column, wrap
from pipeline.lerobot_format.parts import blocks
from pipeline.lerobot_format.quality import dead_columns
from pipeline.types import ACTION, STATE, Demonstrations, Semantics

_GRIPPER = ("gripper", "grip", "claw", "finger", "jaw", "hand_open", "vacuum", "suction")


@dataclass(frozen=True)
class Column:
    """One column of `action` or `observation.state`: its values [N] float32 and its span.

    span     from the 0.5th to the 99.5th percentile of all frames (the whole range where that is nothing)
    partner  the position of the state column that an action column commands
    """

    feature: str
    position: int
    name: str
    unit: str | None
    kind: str | None
    partner: int | None
    circular: bool
    values: np.ndarray
    span: float

    @property
    def key(self) -> str:
        return f"{self.feature}/{self.name}"

    @property
    def is_rate(self) -> bool:
        """Whether it says how fast to go, so that its value is no place."""
        return self.kind in ("velocity", "delta")

    @property
    def is_gripper(self) -> bool:
        return any(word in self.name.lower() for word in _GRIPPER)

    def amount(self, value: float) -> str:
        """A difference in words: `12.5 px`."""
        return f"{value:.3g} {self.unit}" if self.unit else f"{value:.3g}"


@dataclass(frozen=True)
class Survey:
    """Demonstrations, what their columns mean, and what follows from both."""

    demos: Demonstrations
    semantics: Semantics

    @property
    def starts(self) -> np.ndarray:
        return self.demos.episode_starts

    @property
    def tick(self) -> float:
        """Seconds between frames by fps."""
        return 1.0 / self.demos.fps

    def seconds(self, frames: float) -> float:
        return frames / self.demos.fps

    def frames(self, seconds: float, least: int = 1) -> int:
        """So many seconds, in frames."""
        return max(least, round(seconds * self.demos.fps))

    def id(self, episode: int) -> int:
        """The recorded `episode_index` of the episode at a position."""
        return int(self.demos.episode_ids[episode])

    @cached_property
    def dead(self) -> dict[str, np.ndarray]:
        """feature → [D] bool, for actions and observations."""
        keys = [key for key in self.demos.columns if key == ACTION or key.startswith("observation.")]
        return {key: dead_columns(self.demos, key) for key in keys}

    @cached_property
    def spans(self) -> dict[str, np.ndarray]:
        """feature → [D] span of each column of actions and state."""
        return {
            key: np.array([_span(self.demos.columns[key][:, i]) for i in range(self.demos.columns[key].shape[1])])
            for key in (ACTION, STATE)
        }

    @cached_property
    def partners(self) -> tuple[int | None, ...]:
        """[A] the state column that each action column commands; of steps, which `Semantics` leaves out, by name or place."""
        return tuple(
            state_column(self.demos, position) if kind == "delta" and known is None else known
            for position, (kind, known) in enumerate(
                zip(self.semantics.kinds, self.semantics.state_column, strict=True)
            )
        )

    def column(self, feature: str, position: int) -> Column:
        demos, of_action = self.demos, feature == ACTION
        return Column(
            feature, position, demos.features[feature].names[position], demos.features[feature].units[position],
            self.semantics.kinds[position] if of_action else None,
            self.partners[position] if of_action else None,
            self.semantics.circular[feature][position],
            np.ascontiguousarray(demos.columns[feature][:, position], np.float32), float(self.spans[feature][position]),
        )  # fmt: skip

    def living(self, *features: str) -> Iterator[Column]:
        """The columns that move, of these features, one after another."""
        for feature in features:
            for position in np.flatnonzero(~self.dead[feature]):
                yield self.column(feature, int(position))

    def steps(self, column: Column) -> np.ndarray:
        """[N] change from each frame to the next; 0 at the last frame of an episode."""
        change = np.empty_like(column.values)
        np.subtract(column.values[1:], column.values[:-1], out=change[:-1])
        change[self.starts[1:] - 1] = 0
        return wrap(change) if column.circular else change

    @cached_property
    def moved(self) -> tuple[np.ndarray, np.ndarray]:
        """[E] frames before anything has left its first value by MOVED of its span, and frames after everything has
        come within MOVED of its last: the idle start and end. An episode in which nothing moves is idle throughout.
        """
        left, arrived = np.zeros(self.demos.frames, bool), np.zeros(self.demos.frames, bool)
        for column in self.living(STATE, ACTION):
            if column.is_rate or column.span <= 0:
                continue
            for mark, border in ((left, self.starts[:-1]), (arrived, self.starts[1:] - 1)):
                for episodes, frames in blocks(self.starts):
                    rest = np.repeat(column.values[border[episodes]], self.demos.lengths[episodes])
                    away = column.values[frames] - rest
                    mark[frames] |= np.abs(wrap(away) if column.circular else away) > MOVED * column.span
        return _first_true(left, self.starts), _first_true(arrived[::-1], self.demos.frames - self.starts[::-1])[::-1]


MOVED = 0.02
"""Share of its span by which a column must leave its first value to have moved: above the noise of sensors at rest
(below 0.5 % on the arms looked at), below any motion that means something."""


def _span(values: np.ndarray) -> float:
    low, high = np.quantile(values, [0.005, 0.995])
    return float(high - low) or float(np.ptp(values))


def _first_true(mask: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """[E] frames before the first True of each episode; its length where there is none."""
    found = []
    for episodes, frames in blocks(starts):
        places, begins = np.append(np.flatnonzero(mask[frames]), len(mask)), starts[:-1][episodes] - frames.start
        found.append(places[np.searchsorted(places, begins)] - begins)
    return np.minimum(np.concatenate(found), np.diff(starts))


def runs(mask: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First frames and (exclusive) last frames of unbroken stretches of True, cut at episode borders."""
    before = np.concatenate([[False], mask[:-1]])
    before[starts[:-1]] = False
    after = np.concatenate([mask[1:], [False]])
    after[starts[1:] - 1] = False
    return np.flatnonzero(mask & ~before), np.flatnonzero(mask & ~after) + 1


def per_episode(values: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """[E] sums over the frames of each episode."""
    return np.concatenate(
        [
            np.add.reduceat(values[frames], starts[:-1][episodes] - frames.start, dtype=np.float64)
            for episodes, frames in blocks(starts)
        ]
    )


def robust(values: np.ndarray) -> tuple[float, float]:
    """The median, and 1.4826 × the median distance from it: the deviation, were the values Gaussian."""
    centre = float(np.median(values))
    return centre, 1.4826 * float(np.median(np.abs(values - centre)))

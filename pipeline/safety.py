"""The safety layer between a policy and a robot: whatever is asked for, what is passed on keeps the limits.

What belongs here: limits, clamping, counting, stopping. What does not: where limits come from (a simulator's own, the
configuration), or what a stopped robot does next.

In this order: an action that is not finite stops the robot; a column is held within its own limits and within what it may change
in a frame; an action that would take the effector out of the workspace is shortened until it does not. A robot that was stopped
is told where it already is, for good.

Every limit is kept to the last bit, and not every bit is worth a word: an intervention is what changes a column by more than
TOLERANCE of its range.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.config import SafetyConfig
from pipeline.errors import ConfigError
from pipeline.types import Feature

RUNS, NOT_FINITE, REPEATED = range(3)
"""Why a robot was stopped: not at all, an action was not finite, too many interventions in a row."""
TOLERANCE = 0.01
"""Of a column's range. A follower is on average further than that from where its leader tells it to be (1.1 to 4.3 % by column
in `so101_sim`, 3.3 % in `pusht_sim`): a robot does not carry a smaller change out. A gripper that is told to close a hair
further than it can is no intervention."""
RANGE_FRAMES = 10
"""What a column may change in so many frames is its range where that is less than from `low` to `high`."""
HALVINGS = 12
"""An action that leaves the workspace is shortened to within 1/4096 of the last place that is still inside."""


@dataclass(frozen=True)
class Workspace:
    """A box that the effector stays in: low and high [D] in m; `place` is forward kinematics, actions [n, A] → places [n, D]."""

    low: np.ndarray
    high: np.ndarray
    place: Callable[[np.ndarray], np.ndarray]

    def holds(self, actions: np.ndarray) -> np.ndarray:
        """[n] bool: which actions [n, A] put the effector inside."""
        at = self.place(np.asarray(actions, np.float64))
        return ((at >= self.low) & (at <= self.high)).all(axis=1)


@dataclass(frozen=True)
class Limits:
    """What a robot may be told, in the units of the action columns.

    names       [A]
    low, high   [A] of each column
    per_frame   [A] the most that it may change from one frame to the next, inf for any
    workspace   where the effector may be, or None for anywhere
    stop_after  interventions in so many frames in a row stop the robot; None: never
    """

    names: tuple[str, ...]
    low: np.ndarray
    high: np.ndarray
    per_frame: np.ndarray
    workspace: Workspace | None = None
    stop_after: int | None = None

    def __post_init__(self):
        columns = zip(self.names, self.low, self.high, self.per_frame, *self.box, strict=True)
        for name, low, high, change, least, largest in columns:
            if not least <= largest:
                raise ConfigError(
                    f"The limits of '{name}' contradict each other: nothing is both {low:g} or more and {high:g} or "
                    "less."
                )
            if not change > 0:
                raise ConfigError(
                    f"'{name}' may change by {change:g} a frame: it could never move. Expected more than 0."
                )
        box = self.workspace
        if box is not None and not (np.asarray(box.low) < np.asarray(box.high)).all():
            raise ConfigError(
                f"The limits of the workspace contradict each other: low {box.low} is not below high {box.high}."
            )

    @property
    def ranges(self) -> np.ndarray:
        """[A] what interventions are measured by, in the columns' units: from low to high, or RANGE_FRAMES frames at the fastest
        where that is less; 1 for a column that neither says anything of."""
        found = np.minimum(np.subtract(self.high, self.low), RANGE_FRAMES * np.asarray(self.per_frame, np.float64))
        return np.where(np.isfinite(found) & (found > 0), found, 1.0)

    @property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """[A] the least and the largest float32 within the limits."""
        return _up(np.asarray(self.low, np.float64)), _down(np.asarray(self.high, np.float64))


def tighter(limits: Limits, safety: SafetyConfig, feature: Feature) -> Limits:
    """The limits and those of the configuration beside them: both hold. `feature` has the names and units of the actions.

    Raises:
        ConfigError: nothing is left between them, or something is said of a column that there is not.
    """
    names, units = feature.names, feature.units
    return replace(
        limits,
        names=names,
        low=np.maximum(limits.low, by_column(safety.low, names, units, -np.inf)),
        high=np.minimum(limits.high, by_column(safety.high, names, units, np.inf)),
        per_frame=np.minimum(limits.per_frame, by_column(safety.per_frame, names, units, np.inf)),
        workspace=_smaller(limits.workspace, safety),
        stop_after=safety.stop_after or limits.stop_after,
    )


def _smaller(workspace: Workspace | None, safety: SafetyConfig) -> Workspace | None:
    if safety.workspace is None:
        return workspace
    if workspace is None:
        raise ConfigError(
            "safety: a workspace needs forward kinematics, and there are none here. Limit the action columns instead (low, high)."
        )
    low, high = np.maximum(workspace.low, safety.workspace.low), np.minimum(workspace.high, safety.workspace.high)
    return replace(workspace, low=low, high=high)


class Guard:
    """The limits at work on R robots.

    interventions [R] frames in which what was asked for was not finite, or a column was changed by more than TOLERANCE of its range
    corrections   [R] the sum, over those that were finite, of how far the column was changed that was changed most, in ranges
    stopped       [R] RUNS, NOT_FINITE or REPEATED
    """

    def __init__(self, limits: Limits, standing: np.ndarray):
        """`standing` [R, A] are the actions that leave every robot where it is; the first change is measured from there, or
        from the nearest action within the limits.

        Raises:
            ConfigError: a robot begins outside the workspace, or nowhere.
        """
        self.limits, self._box, self._ranges = limits, limits.box, limits.ranges
        if not np.isfinite(standing).all():
            raise ConfigError("A robot does not say where it is: a number of its first state is not finite.")
        self.previous = np.clip(np.asarray(standing, np.float64), *self._box).astype(np.float32)
        self.interventions, self.corrections = np.zeros(len(standing), np.int64), np.zeros(len(standing))
        self.stopped = np.full(len(standing), RUNS, np.int64)
        self._in_a_row = np.zeros(len(standing), np.int64)
        if limits.workspace is not None and not limits.workspace.holds(self.previous).all():
            at = limits.workspace.place(self.previous[~limits.workspace.holds(self.previous)][:1].astype(np.float64))[0]
            raise ConfigError(
                f"A robot begins at {np.round(at, 4).tolist()} m, outside its workspace {list(limits.workspace.low)} … "
                f"{list(limits.workspace.high)}: no action could keep that limit. Widen the workspace."
            )

    def __call__(self, actions: np.ndarray, running: np.ndarray) -> np.ndarray:
        """What may be passed on, [R, A] float32, for the actions asked for [R, A]; only those of `running` [R] count."""
        running = running & (self.stopped == RUNS)
        with np.errstate(over="ignore", invalid="ignore"):
            asked = np.asarray(actions).astype(np.float32)
        finite = np.isfinite(asked).all(axis=1)
        wanted = np.where(finite[:, None], asked, self.previous)
        passed = np.where(finite[:, None], self._within(wanted), self.previous)
        changed = (np.abs(passed.astype(np.float64) - wanted) / self._ranges).max(axis=1)
        stepped_in = running & (~finite | (changed > TOLERANCE))
        self.interventions += stepped_in
        self.corrections += np.where(stepped_in, changed, 0.0)
        self._in_a_row = np.where(stepped_in, self._in_a_row + 1, 0)
        self.stopped[running & ~finite] = NOT_FINITE
        if self.limits.stop_after is not None:
            self.stopped[running & finite & (self._in_a_row >= self.limits.stop_after)] = REPEATED
        moves = running & (self.stopped == RUNS)
        self.previous = np.where(moves[:, None], passed, self.previous)
        return self.previous.copy()

    def _within(self, asked: np.ndarray) -> np.ndarray:
        """[R, A] the nearest finite actions that keep every limit."""
        low, high = self._box
        # Towards the action before, float32 rounds into the limits.
        slowest, fastest = self.previous - self.limits.per_frame, self.previous + self.limits.per_frame
        held = np.clip(asked, np.maximum(low, _up(slowest)), np.minimum(high, _down(fastest)))
        return held if self.limits.workspace is None else self._shortened(held)

    def _shortened(self, held: np.ndarray) -> np.ndarray:
        """The same, on the way from the action before to each only as far as the workspace goes."""
        workspace = self.limits.workspace
        outside = np.flatnonzero(~workspace.holds(held))
        if not len(outside):
            return held
        before, wanted = self.previous[outside], held[outside]
        inside, share = before.copy(), np.zeros((len(outside), 1))
        for halving in range(1, HALVINGS + 1):
            further = share + 0.5**halving
            tried = (before + further * (wanted.astype(np.float64) - before)).astype(np.float32)
            tried = np.clip(tried, np.minimum(before, wanted), np.maximum(before, wanted))
            good = workspace.holds(tried)[:, None]
            inside, share = np.where(good, tried, inside), np.where(good, further, share)
        found = held.copy()
        found[outside] = inside
        return found


def _up(limits: np.ndarray) -> np.ndarray:
    """float64 → the least float32 that is not below."""
    rounded = limits.astype(np.float32)
    return np.where(rounded < limits, np.nextafter(rounded, np.float32(np.inf)), rounded)


def _down(limits: np.ndarray) -> np.ndarray:
    """float64 → the largest float32 that is not above."""
    rounded = limits.astype(np.float32)
    return np.where(rounded > limits, np.nextafter(rounded, np.float32(-np.inf)), rounded)


def by_column(
    said: Mapping[str, float], names: Sequence[str], units: Sequence[str | None], otherwise: float
) -> np.ndarray:
    """[A] a number for every column, from what is said of columns or, where nothing is, of units.

    Raises:
        ConfigError: something is said of neither.
    """
    for word in said:
        if word not in (*names, *units):
            known = ", ".join(dict.fromkeys([*names, *(unit for unit in units if unit)]))
            raise ConfigError(
                f"A limit is given for '{word}', which is neither an action column nor a unit here. Known: {known}."
            )
    pairs = zip(names, units, strict=True)
    return np.array([said.get(name, said.get(unit, otherwise)) for name, unit in pairs], np.float64)

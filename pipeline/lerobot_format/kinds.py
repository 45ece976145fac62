"""Is an action column a position, a velocity, a step, or something else? Guessed from values first, then from its name.

The values decide by how much of the action's variance three predictions explain: the next state (position), the state's
change per second (velocity), the state's change per frame (delta). Nothing is fitted, so units must agree, as they do
when the action really is what it seems. What does not belong here: what the user has set (quality.py).
"""

import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from pipeline.lerobot_format.parts import parts
from pipeline.types import ACTION, STATE, ActionKind, Demonstrations

CLEAR, MARGIN, CERTAIN = 0.5, 0.2, 0.9
"""Share of variance that settles a kind, its lead over the next kind, and the share that overrules a name."""

_WORDS: dict[str, ActionKind] = {
    "vel": "velocity", "velocity": "velocity", "speed": "velocity", "qvel": "velocity", "dq": "velocity",
    "delta": "delta", "rel": "delta", "relative": "delta", "increment": "delta",
    "pos": "position", "position": "position", "qpos": "position",
}  # fmt: skip
_BESIDE_THE_POINT = {
    *_WORDS,
    "px",
    "rad",
    "deg",
    "mm",
    "s",
    "cmd",
    "command",
    "target",
    "goal",
    "action",
    "state",
    "obs",
    "observation",
}


@dataclass(frozen=True)
class Guess:
    """A kind, the state column it was compared with, and, where it is unsure, why."""

    kind: ActionKind
    state_column: int | None
    doubt: str | None = None


@dataclass(frozen=True)
class Steps:
    """Pairs of consecutive frames [M] of one episode: the first one's position, and the seconds between them."""

    first: np.ndarray
    seconds: np.ndarray


def steps_of(demonstrations: Demonstrations) -> Iterator[Steps]:
    """All pairs of consecutive frames within episodes, a part at a time; where the clock stands still, 1 / fps stands for
    the time.
    """
    last, stamps = demonstrations.episode_starts[1:] - 1, demonstrations.timestamps
    for part in parts(demonstrations.frames):
        inside = np.ones(part.stop - part.start, bool)
        inside[last[np.searchsorted(last, part.start) : np.searchsorted(last, part.stop)] - part.start] = False
        first = part.start + np.flatnonzero(inside)
        seconds = stamps[first + 1] - stamps[first]
        yield Steps(first, np.where(seconds > 0, seconds, 1 / demonstrations.fps))


def wrap(angle: np.ndarray) -> np.ndarray:
    """Radians in (−π, π]."""
    return -((math.pi - angle) % (2 * math.pi) - math.pi)


def guess_kinds(
    demonstrations: Demonstrations, circular: Mapping[str, tuple[bool, ...]], still: np.ndarray
) -> list[Guess]:
    """One guess for each action column. `still` [A] marks columns that hardly move: they follow their name, else the
    kind that most other columns have.
    """
    feature = demonstrations.features[ACTION]
    states = [state_column(demonstrations, column) for column in range(len(feature.names))]
    guesses: list[Guess | None] = []
    for column, (name, unit, state) in enumerate(zip(feature.names, feature.units, states, strict=True)):
        scores = None if still[column] else _scores(demonstrations, column, state, circular)
        guesses.append(_judge(name, unit, state, scores))
    agreed = Counter(guess.kind for guess in guesses if guess and guess.kind != "other" and not guess.doubt)
    usual = agreed.most_common(1)[0][0] if agreed else None
    return [guess or _by_the_others(usual, state) for guess, state in zip(guesses, states, strict=True)]


def _by_the_others(usual: ActionKind | None, state: int | None) -> Guess:
    if usual and state is not None:
        return Guess(usual, state)
    return Guess("other", None, "it does not move, and neither its name nor the other columns tell")


def state_column(demonstrations: Demonstrations, column: int) -> int | None:
    """The column of `observation.state` that an action column speaks of: by name, by place, or by values.

    By place only where no names agree and there are as many of both. By values means that the next state explains nine
    tenths of the action's variance.
    """
    names, states = demonstrations.features[ACTION].names, demonstrations.features[STATE].names
    stem = _stem(names[column])
    same = [j for j, state in enumerate(states) if _stem(state) == stem]
    if len(same) > 1:
        same = [j for j in same if _hint(states[j], None) in (None, "position")] or same
    if same:
        return same[0]
    named = {_stem(state) for state in states} & {_stem(name) for name in names}
    if len(names) == len(states) and not named:
        return column
    taken = {_stem(name) for name in names}
    free = [j for j, state in enumerate(states) if _stem(state) not in taken]

    def differences(steps: Steps, action: np.ndarray) -> list[np.ndarray]:
        following = demonstrations.columns[STATE][steps.first + 1]
        return [action - following[:, j] for j in free]

    shares = _explained(demonstrations, column, differences) if free else None
    best = int(np.argmax(shares)) if shares else 0
    return free[best] if shares and shares[best] >= CERTAIN else None


def _stem(name: str) -> tuple[str, ...]:
    """What a name speaks of, without what it says about it: `joint_0_vel` and `joint_0` → (joint, 0)."""
    words = [word for word in re.split(r"[^a-z0-9]+", name.lower()) if word]
    return tuple(word for word in words if word not in _BESIDE_THE_POINT) or tuple(words)


def _hint(name: str, unit: str | None) -> ActionKind | None:
    """The kind that a name or unit says outright."""
    if unit and unit.endswith("/s"):
        return "velocity"
    for word in re.split(r"[^a-z0-9]+", name.lower()):
        if word in _WORDS:
            return _WORDS[word]
    return None


def _scores(
    demonstrations: Demonstrations, column: int, state: int | None, circular: Mapping[str, tuple[bool, ...]]
) -> dict[ActionKind, float] | None:
    """Share of the action's variance that each kind explains; empty where no state column goes with it, None where the
    action is constant.
    """
    turns = state is not None and circular[STATE][state]

    def differences(steps: Steps, action: np.ndarray) -> list[np.ndarray]:
        if state is None:
            return []
        values = demonstrations.columns[STATE][:, state]
        now, following = values[steps.first].astype(np.float64), values[steps.first + 1].astype(np.float64)
        change = wrap(following - now) if turns else following - now
        away = wrap(action - following) if turns else action - following
        return [away, action - change / steps.seconds, action - change]

    shares = _explained(demonstrations, column, differences)
    return None if shares is None else dict(zip(("position", "velocity", "delta"), shares, strict=False))


def _explained(
    demonstrations: Demonstrations, column: int, differences: Callable[[Steps, np.ndarray], list[np.ndarray]]
) -> list[float] | None:
    """1 − mean squared difference / variance of the action, for each prediction; 1 is perfect, 0 is what the mean alone
    does, below 0 is worse. None where the action is constant.
    """
    values = demonstrations.columns[ACTION][:, column]
    taken = [values[steps.first] for steps in steps_of(demonstrations)]
    count = sum(map(len, taken))
    if not count or min(part.min() for part in taken if len(part)) == max(part.max() for part in taken if len(part)):
        return None
    mean = sum(float(part.sum(dtype=np.float64)) for part in taken) / count
    spread, errors = 0.0, np.zeros(0)
    for steps, part in zip(steps_of(demonstrations), taken, strict=True):
        action = part.astype(np.float64)
        spread += float(((action - mean) ** 2).sum())
        squares = np.array([float((one**2).sum()) for one in differences(steps, action)])
        errors = squares if not len(errors) else errors + squares
    return (1 - errors / spread).tolist()


def _judge(name: str, unit: str | None, state: int | None, scores: dict[ActionKind, float] | None) -> Guess | None:
    """None where the column tells nothing and its name says nothing."""
    said = _hint(name, unit)
    if scores is None:
        return Guess(said, state) if said and (said != "position" or state is not None) else None
    if not scores:
        return Guess(said, None) if said in ("velocity", "delta") else Guess("other", None)
    (best, share), (_, second) = sorted(scores.items(), key=lambda item: -item[1])[:2]
    clear = share >= CLEAR and share - second >= MARGIN
    if clear and said in (None, best):
        return Guess(best, state)
    if clear and share >= CERTAIN:
        return Guess(best, state, f"its name says {said}, but its values are {_PLAINLY[best]}")
    if said:
        return Guess(said, state, f"only its name says so: its values are not clearly {_PLAINLY[said]}")
    return Guess("other", None, "its values follow neither the next state nor the state's change")


_PLAINLY: dict[ActionKind, str] = {
    "position": "the next state", "velocity": "the state's change per second", "delta": "the state's change per frame",
    "other": "anything else",
}  # fmt: skip

"""Is an action column a position, a velocity, a step, or something else? Guessed from values first, then from its name.

The values decide by how much of the action's variance three predictions explain: the next state (position), the state's
change per second (velocity), the state's change per frame (delta). Nothing is fitted, so units must agree, as they do
when the action really is what it seems. What does not belong here: what the user has set (quality.py).
"""

import math
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

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


def steps_of(demonstrations: Demonstrations) -> Steps:
    """All pairs of consecutive frames within episodes; where the clock stands still, 1 / fps stands for the time."""
    inside = np.ones(demonstrations.frames, bool)
    inside[demonstrations.episode_starts[1:] - 1] = False
    first = np.flatnonzero(inside)
    seconds = demonstrations.timestamps[first + 1] - demonstrations.timestamps[first]
    return Steps(first, np.where(seconds > 0, seconds, 1 / demonstrations.fps))


def wrap(angle: np.ndarray) -> np.ndarray:
    """Radians in (−π, π]."""
    return -((math.pi - angle) % (2 * math.pi) - math.pi)


def guess_kinds(
    demonstrations: Demonstrations, circular: Mapping[str, tuple[bool, ...]], still: np.ndarray
) -> list[Guess]:
    """One guess for each action column. `still` [A] marks columns that hardly move: they follow their name, else the
    kind that most other columns have.
    """
    feature, steps = demonstrations.features[ACTION], steps_of(demonstrations)
    states = [state_column(demonstrations, column, steps) for column in range(len(feature.names))]
    guesses: list[Guess | None] = []
    for column, (name, unit, state) in enumerate(zip(feature.names, feature.units, states, strict=True)):
        scores = None if still[column] else _scores(demonstrations, column, state, steps, circular)
        guesses.append(_judge(name, unit, state, scores))
    agreed = Counter(guess.kind for guess in guesses if guess and guess.kind != "other" and not guess.doubt)
    usual = agreed.most_common(1)[0][0] if agreed else None
    return [guess or _by_the_others(usual, state) for guess, state in zip(guesses, states, strict=True)]


def _by_the_others(usual: ActionKind | None, state: int | None) -> Guess:
    if usual and state is not None:
        return Guess(usual, state)
    return Guess("other", None, "it does not move, and neither its name nor the other columns tell")


def state_column(demonstrations: Demonstrations, column: int, steps: Steps) -> int | None:
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
    action = demonstrations.columns[ACTION][steps.first, column].astype(np.float64)
    following = demonstrations.columns[STATE][steps.first + 1].astype(np.float64)
    taken = {_stem(name) for name in names}
    shares = [
        _explained(action, following[:, j]) if _stem(states[j]) not in taken else -1.0 for j in range(len(states))
    ]
    best = int(np.argmax(shares)) if shares else 0
    return best if shares and shares[best] >= CERTAIN else None


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
    demonstrations: Demonstrations,
    column: int,
    state: int | None,
    steps: Steps,
    circular: Mapping[str, tuple[bool, ...]],
) -> dict[ActionKind, float] | None:
    """Share of the action's variance that each kind explains; empty where no state column goes with it, None where the
    action is constant.
    """
    action = demonstrations.columns[ACTION][steps.first, column].astype(np.float64)
    if not len(action) or action.std() == 0:
        return None
    if state is None:
        return {}
    now = demonstrations.columns[STATE][steps.first, state].astype(np.float64)
    following = demonstrations.columns[STATE][steps.first + 1, state].astype(np.float64)
    turns = circular[STATE][state]
    change = wrap(following - now) if turns else following - now
    return {
        "position": _explained(action, following, turns),
        "velocity": _explained(action, change / steps.seconds),
        "delta": _explained(action, change),
    }


def _explained(action: np.ndarray, prediction: np.ndarray, turns: bool = False) -> float:
    """1 − mean squared error / variance; 1 is perfect, 0 is what the mean alone does, below 0 is worse."""
    variance = action.var()
    if not len(action) or variance == 0:
        return -math.inf
    error = wrap(action - prediction) if turns else action - prediction
    return float(1 - np.mean(error**2) / variance)


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

"""What columns mean, and what about a data set deserves a warning.

What belongs here: kinds as set or guessed, circular columns, dead columns, tracking lag, the clock, and the summary
that `demobench inspect` shows. What does not: reading (read.py), how a kind is guessed (kinds.py).
"""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.errors import ConfigError, did_you_mean
from pipeline.lerobot_format.kinds import Guess, guess_kinds, state_column, steps_of, wrap
from pipeline.lerobot_format.parts import parts
from pipeline.lerobot_format.units import usual_range
from pipeline.types import ACTION, STATE, ActionKind, Demonstrations, Semantics

__all__ = ["dead_columns", "inspect_dataset", "resolve_semantics", "usual_range"]

DEAD = 1e-3
"""Deviation over the unit's usual range below which a column counts as dead."""

_ANGLES = {"angle", "yaw", "pitch", "roll", "theta", "heading", "orientation"}


def resolve_semantics(
    demonstrations: Demonstrations,
    *,
    kind: str | Mapping[str, ActionKind] = "auto",
    circular: Sequence[str] | None = None,
) -> Semantics:
    """What the columns mean: as set where it is set, else guessed, with a warning where the guess is unsure.

    `kind` is "auto", one kind for all action columns, or kinds by column name (the rest guessed). `circular` lists
    angles in radians that wrap, as column names or `feature/column`; None finds them, an empty list says that there are
    none.

    Raises:
        ConfigError: a column name that does not exist, or a kind that the data cannot have.
    """
    turns = _find_circular(demonstrations) if circular is None else _set_circular(demonstrations, circular)
    guesses = guess_kinds(demonstrations, turns, dead_columns(demonstrations, ACTION))
    guesses = _with_settings(demonstrations, guesses, kind)
    turns = _shared_by_command_and_state(turns, guesses)
    names = demonstrations.features[ACTION].names
    doubts = [
        f"Action '{name}': kind '{guess.kind}' is an unsure guess: {guess.doubt}. Set `kind` for this data set."
        for name, guess in zip(names, guesses, strict=True)
        if guess.doubt
    ]
    return Semantics(
        kinds=tuple(guess.kind for guess in guesses),
        state_column=tuple(guess.state_column if guess.kind in ("position", "velocity") else None for guess in guesses),
        circular=turns,
        tracking_lag=_tracking_lag(demonstrations, guesses, turns),
        warnings=(
            *doubts,
            *_circular_warnings(demonstrations, turns, found=circular is None),
            *dead_warnings(demonstrations),
            *clock_warnings(demonstrations),
        ),
    )


def _with_settings(
    demonstrations: Demonstrations, guesses: list[Guess], kind: str | Mapping[str, ActionKind]
) -> list[Guess]:
    """The guesses, replaced by what the user has set."""
    names = demonstrations.features[ACTION].names
    if kind == "auto":
        return guesses
    wanted = dict.fromkeys(names, kind) if isinstance(kind, str) else dict(kind)
    for name in wanted:
        if name not in names:
            raise ConfigError(
                f"kind names the action column '{name}', which does not exist. {did_you_mean(name, names)}"
            )
    settled = list(guesses)
    for column, name in enumerate(names):
        if name not in wanted:
            continue
        state = state_column(demonstrations, column)
        if wanted[name] == "position" and state is None:
            raise ConfigError(
                f"kind says that the action '{name}' is a position, but no column of {STATE} matches it "
                f"({', '.join(demonstrations.features[STATE].names)}). "
                f'Say kind = {{{_toml_key(name)} = "other"}} for it.'
            )
        settled[column] = Guess(wanted[name], state)
    return settled


def _toml_key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else f'"{name}"'


def _find_circular(demonstrations: Demonstrations) -> dict[str, tuple[bool, ...]]:
    """Columns that a name or unit says are angles in radians, and that wrap."""
    return {
        key: tuple(
            _is_angle(name, unit) and _wraps(demonstrations, values[:, column])
            for column, (name, unit) in enumerate(zip(feature.names, feature.units, strict=True))
        )
        for key, feature in demonstrations.features.items()
        for values in (demonstrations.columns[key],)
    }


def _is_angle(name: str, unit: str | None) -> bool:
    words = set(re.split(r"[^a-z0-9]+", name.lower()))
    return unit == "rad" or (unit is None and bool(words & _ANGLES))


def _wraps(demonstrations: Demonstrations, values: np.ndarray) -> bool:
    """All values lie within one turn, and between two frames the value jumps by more than half of it."""
    if not float(np.ptp(values)) <= 2 * math.pi + 0.02:
        return False
    pairs = (steps.first for steps in steps_of(demonstrations))
    return any(bool((np.abs(values[first + 1] - values[first]) > math.pi).any()) for first in pairs)


def _set_circular(demonstrations: Demonstrations, wanted: Sequence[str]) -> dict[str, tuple[bool, ...]]:
    """The columns that the user lists, as `column` (in every feature that has it) or `feature/column`."""
    turns = {key: [False] * len(feature.names) for key, feature in demonstrations.features.items()}
    known = {
        name
        for key, feature in demonstrations.features.items()
        for one in feature.names
        for name in (one, f"{key}/{one}")
    }
    for name in wanted:
        if name not in known:
            raise ConfigError(f"circular names the column '{name}', which does not exist. {did_you_mean(name, known)}")
        for key, feature in demonstrations.features.items():
            for column, (one, unit) in enumerate(zip(feature.names, feature.units, strict=True)):
                if name not in (one, f"{key}/{one}"):
                    continue
                if unit not in (None, "rad"):
                    raise ConfigError(
                        f"circular names '{name}', which is in {unit}. Only angles in radians can be circular."
                    )
                turns[key][column] = True
    return {key: tuple(flags) for key, flags in turns.items()}


def _shared_by_command_and_state(
    turns: Mapping[str, tuple[bool, ...]], guesses: list[Guess]
) -> dict[str, tuple[bool, ...]]:
    """A position command is circular where the state it commands is, and the other way round."""
    action, state = list(turns[ACTION]), list(turns[STATE])
    for column, guess in enumerate(guesses):
        if guess.kind == "position" and guess.state_column is not None:
            action[column] = state[guess.state_column] = action[column] or state[guess.state_column]
    return {**turns, ACTION: tuple(action), STATE: tuple(state)}


def _tracking_lag(
    demonstrations: Demonstrations, guesses: list[Guess], turns: Mapping[str, tuple[bool, ...]]
) -> tuple[float | None, ...]:
    """Mean |a_t − s_t| over all frames for position columns."""
    lags: list[float | None] = []
    for column, guess in enumerate(guesses):
        if guess.kind != "position" or guess.state_column is None:
            lags.append(None)
            continue
        action, state = demonstrations.columns[ACTION][:, column], demonstrations.columns[STATE][:, guess.state_column]
        total = 0.0
        for part in parts(demonstrations.frames):
            behind = action[part].astype(np.float64) - state[part]
            total += float(np.abs(wrap(behind) if turns[ACTION][column] else behind).sum())
        lags.append(total / demonstrations.frames)
    return tuple(lags)


def _deviation(values: np.ndarray) -> float:
    """The standard deviation of one column, in double precision, without a copy of it."""
    if values.min() == values.max():
        return 0.0
    each = parts(len(values))
    mean = sum(float(values[part].sum(dtype=np.float64)) for part in each) / len(values)
    squares = sum(float(((values[part].astype(np.float64) - mean) ** 2).sum()) for part in each)
    return math.sqrt(squares / len(values))


def dead_columns(demonstrations: Demonstrations, feature: str, frames: np.ndarray | slice | None = None) -> np.ndarray:
    """[D] bool: columns whose deviation is below 10⁻³ of their unit's usual range, or zero, over `frames` (or all).

    Where the unit is not known, 1 stands for its usual range, or the widest range of the feature's columns if that is
    less (small steps in metres must not count as dead).
    """
    values = demonstrations.columns[feature][slice(None) if frames is None else frames]
    return _dead_with(values, demonstrations.features[feature].units)


def _dead_with(values: np.ndarray, units: Sequence[str | None]) -> np.ndarray:
    """[D] bool, whether columns are dead in these units."""
    if not len(values):
        return np.ones(values.shape[1], bool)
    widest = float((values.max(axis=0).astype(np.float64) - values.min(axis=0)).max())
    usual = np.array([usual_range(unit) or min(1.0, widest) for unit in units])
    deviation = np.array([_deviation(column) for column in values.T])
    return (deviation == 0) | (deviation < DEAD * usual)


def dead_by_unit(demonstrations: Demonstrations, feature: str) -> np.ndarray:
    """[D] bool: dead columns that move, only by next to nothing for their unit. The unit may be the wrong one."""
    values, units = demonstrations.columns[feature], demonstrations.features[feature].units
    return _dead_with(values, units) & ~_dead_with(values, [None] * len(units))


ASK_UNIT = "Is that the unit? Say the right one with `units` under the data set in demobench.toml"


def dead_warnings(demonstrations: Demonstrations) -> list[str]:
    """Columns of actions and states that hardly move."""
    warnings = []
    for key in (ACTION, STATE):
        names, units = demonstrations.features[key].names, demonstrations.features[key].units
        by_unit = dead_by_unit(demonstrations, key)
        dead = [names[column] for column in np.flatnonzero(dead_columns(demonstrations, key) & ~by_unit)]
        left_out = "; left out of errors divided by the deviation" if key == ACTION else ""
        if dead:
            warnings.append(f"{key}: {', '.join(dead)} hardly move{'s' if len(dead) == 1 else ''} (dead){left_out}.")
        warnings += [
            f"{key}: {names[column]} hardly moves for {units[column]} (dead){left_out}. {ASK_UNIT}."
            for column in np.flatnonzero(by_unit)
        ]
    return warnings


def _circular_warnings(
    demonstrations: Demonstrations, turns: Mapping[str, tuple[bool, ...]], *, found: bool
) -> list[str]:
    """What was found circular, and columns of no known unit that jump by a whole turn."""
    if not found:
        return []
    warnings = []
    for key, feature in demonstrations.features.items():
        for column, name in enumerate(feature.names):
            values = demonstrations.columns[key][:, column]
            if turns[key][column]:
                warnings.append(f"{key}: '{name}' is an angle that wraps; it is treated as circular.")
            elif feature.units[column] is None and float(np.ptp(values)) > 5.5 and _wraps(demonstrations, values):
                warnings.append(
                    f"{key}: '{name}' jumps by a whole turn; if it is an angle in radians, list it in `circular`."
                )
    return warnings


def clock_warnings(demonstrations: Demonstrations) -> list[str]:
    """Where the recorded clock is not what fps says: horizons in seconds are then nominal."""
    stamps, step = demonstrations.timestamps, 1 / demonstrations.fps
    seconds = np.concatenate([stamps[steps.first + 1] - stamps[steps.first] for steps in steps_of(demonstrations)])
    if not len(seconds):
        return []
    off = sum(int((np.abs(seconds[part] - step) > 0.2 * step).sum()) for part in parts(len(seconds)))
    uneven = off / len(seconds)
    typical = float(np.median(seconds, overwrite_input=True))
    warnings = []
    if abs(typical - step) > 0.05 * step:
        warnings.append(
            f"The recorded clock ticks every {typical:.3f} s, but fps = {demonstrations.fps:g} says {step:.3f} s."
        )
    if uneven > 0.01:
        warnings.append(
            f"Uneven clock: a step lasts {seconds.min():.3f} to {seconds.max():.3f} s, {step:.3f} s by fps "
            f"({uneven:.1%} of the steps are off by more than a fifth). Horizons in seconds are nominal."
        )
    return warnings


def inspect_dataset(demonstrations: Demonstrations, semantics: Semantics) -> dict[str, Any]:
    """The summary that `demobench inspect --json` writes; plain lists, numbers and strings."""
    action, lengths = demonstrations.features[ACTION], demonstrations.lengths
    return {
        "name": demonstrations.name,
        "source": demonstrations.source,
        "revision": demonstrations.revision,
        "content_hash": demonstrations.content_hash,
        "robot_type": demonstrations.robot_type,
        "episodes": demonstrations.episodes,
        "frames": demonstrations.frames,
        "fps": demonstrations.fps,
        "episode_length": {"min": int(lengths.min()), "median": float(np.median(lengths)), "max": int(lengths.max())},
        "action_names": list(action.names),
        "action_units": list(action.units),
        "action_kinds": list(semantics.kinds),
        "tracking_lag": list(semantics.tracking_lag),
        "features": [_feature_summary(demonstrations, semantics, key) for key in demonstrations.features],
        "cameras": [vars(camera) for camera in demonstrations.cameras],
        "tasks": dict(Counter(demonstrations.tasks).most_common()),
        "episode_tasks": list(demonstrations.tasks),
        "excluded": list(demonstrations.excluded),
        "warnings": [*demonstrations.warnings, *semantics.warnings],
    }


def _feature_summary(demonstrations: Demonstrations, semantics: Semantics, key: str) -> dict[str, Any]:
    feature, values = demonstrations.features[key], demonstrations.columns[key]
    deviations = np.array([_deviation(column) for column in values.T])
    means = values.mean(0, dtype=np.float64)
    numbers = {"min": values.min(0), "max": values.max(0), "mean": means, "std": deviations}
    return {
        "key": key,
        "names": list(feature.names),
        "units": list(feature.units),
        "circular": list(semantics.circular[key]),
        "dead": dead_columns(demonstrations, key).tolist(),
        **{name: [float(one) if math.isfinite(one) else None for one in array] for name, array in numbers.items()},
    }

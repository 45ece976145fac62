"""Which features are the action and the state, as set or as plainly meant, and their names and units.

What belongs here: the choice, and making `action` and `observation.state` of it. What does not: reading the numbers
(frames.py, joined.py), what a column means (quality.py).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.errors import ConfigError, DatasetError, did_you_mean
from pipeline.lerobot_format.units import canonical_unit
from pipeline.types import ACTION, STATE, ColumnChoice, Feature

__all__ = ["ColumnChoice", "Roles", "arrange", "choose_roles", "set_units"]

ACTIONS = ("actions", "action.action", "actions.action", "joint_action", "joint_actions")
STATES = (
    "state", "states", "observation.states", "observation.qpos", "qpos", "observation.joint_state",
    "observation.joint_states", "observation.joint_position", "observation.joint_positions", "observation.robot_state",
    "robot_state", "observation.proprio", "observation.proprioception", "proprio",
)  # fmt: skip
"""Names under which public data sets keep what LeRobot's convention calls `action` and `observation.state`."""
SPLIT_STATES = (f"{STATE}.", "observation.states.", "state.", "states.")
"""Beginnings of the names of a state that is kept in parts."""


@dataclass(frozen=True)
class Roles:
    """The features that are the state, side by side, and the one that is the action; `notes` on what was guessed."""

    state: tuple[str, ...]
    action: str
    notes: tuple[str, ...]

    @property
    def needed(self) -> tuple[str, ...]:
        return (self.action, *self.state)


def choose_roles(known: Sequence[str], choice: ColumnChoice, where: str) -> Roles:
    """The state and the action among the features of numbers `known`, in the order of info.json.

    Raises:
        ConfigError: the choice names a feature that does not exist, or one twice, or the action as state.
        DatasetError: nothing is set, and there is nothing or more than one thing that could be meant.
    """
    notes = []
    if choice.action is not None:
        action = _existing(choice.action, "action", known, where)
    elif ACTION in known:
        action = ACTION
    else:
        action = _the_only(_action_candidates(known), known, ACTION, f'action = "{(known or ["…"])[0]}"', where)[0]
        notes.append(f"There is no feature '{ACTION}'; '{action}' was taken. Set `action` to be sure.")
    if choice.state is not None:
        state = tuple(_existing(name, "state", known, where) for name in choice.state)
        _check_state(state, action)
    elif STATE in known:
        state = (STATE,)
    else:
        others = [name for name in known if name != action]
        state = _the_only(_state_candidates(others), known, STATE, f'state = ["{(others or ["…"])[0]}"]', where)
        listed = ", ".join(state)
        notes.append(f"There is no feature '{STATE}'; it was made of: {listed}. Set `state` to be sure.")
    return Roles(state, action, tuple(notes))


def _existing(name: str, key: str, known: Sequence[str], where: str) -> str:
    if name not in known:
        raise ConfigError(
            f"{key} names the feature '{name}', which {where} does not have as numbers. {did_you_mean(name, known)}"
        )
    return name


def _check_state(state: tuple[str, ...], action: str) -> None:
    if action in state:
        raise ConfigError(f"state names '{action}', which is the action: a policy would see what it is to predict.")
    if len(set(state)) < len(state):
        raise ConfigError(f"state names a feature twice: {', '.join(state)}. Name each once.")


def _the_only(
    candidates: list[tuple[str, ...]], known: Sequence[str], key: str, example: str, where: str
) -> tuple[str, ...]:
    """The one candidate there is."""
    if len(candidates) == 1:
        return candidates[0]
    some = " or ".join(" + ".join(group) for group in candidates)
    which = f"; it could be {some}" if candidates else ""
    raise DatasetError(
        f"{where} has no feature '{key}', which every policy here needs{which}. "
        f"It has: {', '.join(known) or 'none'}. Say which it is in demobench.toml: [datasets.‹name›] {example}."
    )


def _action_candidates(known: Sequence[str]) -> list[tuple[str, ...]]:
    parts = [name for name in known if name.startswith(("action.", "actions.")) and name not in ACTIONS]
    return [(name,) for name in known if name in ACTIONS or parts == [name]]


def _state_candidates(known: Sequence[str]) -> list[tuple[str, ...]]:
    split = [tuple(name for name in known if name.startswith(start)) for start in SPLIT_STATES]
    return [group for group in split if group] + [(name,) for name in known if name in STATES]


def arrange(
    columns: dict[str, np.ndarray], features: Mapping[str, Feature], roles: Roles
) -> tuple[dict[str, np.ndarray], dict[str, Feature]]:
    """`columns` and `features` with `action` and `observation.state` in them.

    One feature in a role takes its name. Of several that are the state, side by side, each also stays what it was, so
    that an observation set may name it. What had the name before and plays no part is left out.
    """
    columns, features = dict(columns), dict(features)
    parts = [(features[key], columns[key]) for key in roles.state]
    action, values = features[roles.action], columns[roles.action]
    for key in {ACTION, STATE, roles.action, *(roles.state if len(parts) == 1 else ())}:
        columns.pop(key, None)
        features.pop(key, None)
    names = _side_by_side([feature for feature, _ in parts])
    units = tuple(unit for feature, _ in parts for unit in feature.units)
    stacked = parts[0][1] if len(parts) == 1 else np.concatenate([part for _, part in parts], axis=1)
    first = {ACTION: values, STATE: stacked}
    return first | columns, {ACTION: replace(action, key=ACTION), STATE: Feature(STATE, names, units)} | features


def _side_by_side(parts: Sequence[Feature]) -> tuple[str, ...]:
    """Column names of features side by side, with the feature's in front of those that clash."""
    names = [name for part in parts for name in part.names]
    twice = {name for name in names if names.count(name) > 1}
    for shorten in (True, False):
        said = [
            f"{part.key.rsplit('.', 1)[-1] if shorten else part.key}.{name}" if name in twice else name
            for part in parts
            for name in part.names
        ]
        if len(set(said)) == len(said):
            return tuple(said)
    return tuple(f"{position}.{name}" for position, name in enumerate(names))


def set_units(features: Mapping[str, Feature], units: str | Mapping[str, str] | None) -> dict[str, Feature]:
    """The features, with the units that the user gave for columns of action and state.

    Raises:
        ConfigError: no such column ("did you mean"), or a unit that is no word.
    """
    if units is None:
        return dict(features)
    names = {name for key in (ACTION, STATE) for name in features[key].names}
    wanted = dict.fromkeys(names, units) if isinstance(units, str) else dict(units)
    for name, unit in wanted.items():
        if name not in names:
            raise ConfigError(
                f"units names the column '{name}', which neither {ACTION} nor {STATE} has. {did_you_mean(name, names)}"
            )
        if not unit.strip() or len(unit) > 24 or not unit.isprintable():
            raise ConfigError(f"units gives '{name}' the unit {unit[:40]!r}; expected a short word such as \"deg\".")
    changed = dict(features)
    for key in (ACTION, STATE):
        pairs = zip(features[key].names, features[key].units, strict=True)
        said = tuple(canonical_unit(wanted[name]) if name in wanted else unit for name, unit in pairs)
        changed[key] = replace(features[key], units=said)
    return changed

"""Which features are the action and the state, as set or as plainly meant, and their names and units.

What belongs here: the choice, and making `action` and `observation.state` of it. What does not: reading the numbers
(frames.py, joined.py), what a column means (quality.py).
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.errors import ConfigError, DatasetError, did_you_mean
from pipeline.lerobot_format.units import canonical_unit
from pipeline.types import ACTION, STATE, ColumnChoice, Feature, ObservationSet

__all__ = ["ColumnChoice", "Roles", "arrange", "choose_roles", "set_units"]

ACTIONS = ("actions", "action.action", "actions.action", "joint_action", "joint_actions")
STATES = (
    "state", "states", "observation.states", "observation.qpos", "qpos", "observation.joint_state",
    "observation.joint_states", "observation.joint_position", "observation.joint_positions", "observation.robot_state",
    "robot_state", "observation.proprio", "observation.proprioception", "proprio",
)  # fmt: skip
"""Names under which public data sets keep what LeRobot's convention calls `action` and `observation.state`."""
SPLIT_STATES = (f"{STATE}.", "observation.states.", "state.", "states.")
SPLIT_ACTIONS = ("action.", "actions.")
"""Beginnings of the names of a state, and of an action, that is kept in parts."""


@dataclass(frozen=True)
class Roles:
    """The features that, side by side, are the state and the action; `notes` on what was guessed."""

    state: tuple[str, ...]
    action: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def needed(self) -> tuple[str, ...]:
        return (*self.action, *self.state)


def choose_roles(known: Sequence[str], choice: ColumnChoice, where: str) -> Roles:
    """The state and the action among the features of numbers `known`, in the order of info.json.

    Raises:
        ConfigError: the choice names a feature that does not exist, or one twice, or the action as state.
        DatasetError: nothing is set, and there is nothing or more than one thing that could be meant.
    """
    notes = []
    if choice.action is not None:
        action = _set("action", choice.action, known, where)
    elif ACTION in known:
        action = (ACTION,)
    else:
        action = _guessed("action", ACTION, _candidates(known, ACTIONS, SPLIT_ACTIONS), known, where, notes)
    if choice.state is not None:
        state = _set("state", choice.state, known, where)
    elif STATE in known:
        state = (STATE,)
    else:
        others = [name for name in known if name not in action]
        state = _guessed("state", STATE, _candidates(others, STATES, SPLIT_STATES), others, where, notes)
    for name in state:
        if name in action:
            raise ConfigError(f"state names '{name}', which is the action: a policy would see what it is to predict.")
    return Roles(state, action, tuple(notes))


def _set(key: str, names: tuple[str, ...], known: Sequence[str], where: str) -> tuple[str, ...]:
    """The features that the user named."""
    if len(set(names)) < len(names):
        raise ConfigError(f"{key} names a feature twice: {', '.join(names)}. Name each once.")
    return tuple(_existing(name, key, known, where) for name in names)


def _guessed(
    key: str, usual: str, candidates: list[tuple[str, ...]], known: Sequence[str], where: str, notes: list[str]
) -> tuple[str, ...]:
    """What is plainly meant, with a note that says so."""
    found = _the_only(candidates, known, usual, f'{key} = ["{(known or ["…"])[0]}"]', where)
    notes.append(f"There is no feature '{usual}'; it was made of: {', '.join(found)}. Set `{key}` to be sure.")
    return found


def _existing(name: str, key: str, known: Sequence[str], where: str) -> str:
    if name not in known:
        raise ConfigError(
            f"{key} names the feature '{name}', which {where} does not have as numbers. {did_you_mean(name, known)}"
        )
    return name


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


def _candidates(known: Sequence[str], names: Sequence[str], beginnings: Sequence[str]) -> list[tuple[str, ...]]:
    """Features kept in parts, and single ones, under the names of public data sets."""
    parts = [tuple(n for n in known if n.startswith(start) and n not in names) for start in beginnings]
    return [group for group in parts if group] + [(name,) for name in known if name in names]


def arrange(
    columns: dict[str, np.ndarray], features: Mapping[str, Feature], roles: Roles
) -> tuple[dict[str, np.ndarray], dict[str, Feature]]:
    """`columns` and `features` with `action` and `observation.state` in them.

    One feature in a role takes its name. Of several that are the state, side by side, each also stays what it was, so
    that an observation set may name it; those of the action do not: a policy would see what it is to predict. What had
    the name before and plays no part is left out.
    """
    kept = names_after(columns, roles)[2:]
    left, described = {key: columns[key] for key in kept}, {key: features[key] for key in kept}
    first, about = {}, {}
    for key, parts in ((ACTION, roles.action), (STATE, roles.state)):
        values = [columns[part] for part in parts]
        first[key] = values[0] if len(parts) == 1 else np.concatenate(values, axis=1)
        units = tuple(unit for part in parts for unit in features[part].units)
        about[key] = Feature(key, _side_by_side([features[part] for part in parts]), units)
    return first | left, about | described


def names_after(known: Iterable[str], roles: Roles) -> list[str]:
    """The features there are once `arrange` has made action and state of those with a role."""
    gone = {ACTION, STATE, *roles.action, *(roles.state if len(roles.state) == 1 else ())}
    return [ACTION, STATE, *(name for name in known if name not in gone)]


def check_observation_set(observation_set: ObservationSet, known: Collection[str], name: str) -> None:
    """Every feature that an observation set names must be among the features of numbers of the data set `name`.

    Raises:
        ConfigError: it is not ("did you mean"), or it is the action.
    """
    for key in observation_set.features:
        if key == ACTION:
            raise ConfigError(
                f"The observation set '{observation_set.name}' names '{ACTION}': a policy would see what it is to predict. "
                "Leave it out."
            )
        if key not in known:
            raise ConfigError(
                f"The observation set '{observation_set.name}' asks for '{key}', which the data set '{name}' "
                f"does not have as numbers. {did_you_mean(key, [one for one in known if one != ACTION])}"
            )


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

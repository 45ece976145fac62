"""A policy's own view of its windows: what enters a method, and what its answers mean.

What belongs here: scaling, relative actions, derived features with their inverses. What does not: which windows there are
(`windows`), how they are varied in training (`augmentation`), learning (`networks`).

    inputs   [B, F]  the set's columns, scaled, frame after frame, then derived features, scaled
    targets  [B, K, A']  absolute columns as the normaliser encodes them, after them those relative to the state at the anchor

A *relative* column is (action − state at the anchor), the short way round for angles, over the root mean square of that at each
step of the chunk. Only columns of the kind `position` have a state to be relative to; others stay as they are.
"""

import importlib.util
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np

from pipeline.errors import PolicyError
from pipeline.lerobot_format.kinds import wrap
from pipeline.lerobot_format.quality import dead_columns
from pipeline.methods import DERIVED
from pipeline.normalize import Normalizer, Scaler, check_columns, circular_columns, fit_scaler, frames_of
from pipeline.types import ACTION, STATE
from pipeline.windows import Windows

BLOCK = 4096
"""Windows gathered at a time where statistics go over all of them."""


class Seen(dict):
    """What a window shows, feature key → [B, T, D] raw; asking for a feature that is not seen is one clear message."""

    def __init__(self, parts: Mapping[str, np.ndarray], asked_by: str):
        super().__init__(parts)
        self.asked_by = asked_by

    def __missing__(self, key: str) -> np.ndarray:
        raise PolicyError(
            f"{self.asked_by} need '{key}', which the observation set does not hold. It holds {', '.join(self)}; name another "
            "set under [policies.<name>] observations."
        )


@dataclass(frozen=True)
class Transform:
    """Fitted on training episodes, saved with the weights.

    widths    feature key → its columns, in the order of the observation set's columns
    history   T frames
    observations  how the set's columns are scaled
    derived   None, or the name of the function whose features are added, and how they are scaled
    absolute  how action columns that are not relative are scaled
    relative  [A] bool      state_column [A] the column of the state, where relative      circular [A] bool
    rms       [K, R] what relative columns are divided by at each step
    centre    [A] the middle of the branch that angles are answered in
    """

    widths: Mapping[str, int]
    history: int
    observations: Scaler
    derived: tuple[str, Scaler] | None
    absolute: Scaler
    relative: np.ndarray
    state_column: np.ndarray
    circular: np.ndarray
    rms: np.ndarray
    centre: np.ndarray

    @property
    def chunk(self) -> int:
        return len(self.rms)

    @property
    def width(self) -> int:
        """A', the encoded columns of one action."""
        return self.absolute.width + int(self.relative.sum())

    # What is seen --------------------------------------------------------------------------------------------------------

    def encode(self, values: np.ndarray) -> np.ndarray:
        """[B, T, O] raw → [B, F] float32.

        Raises:
            PolicyError: another history than the policy was trained with.
        """
        if values.shape[1] != self.history:
            raise PolicyError(f"The policy sees {self.history} frames at a time and was given {values.shape[1]}.")
        check_columns(values, len(self.observations.circular))
        columns = self.observations.encode(values).reshape(len(values), -1)
        if self.derived is None:
            return columns
        name, scaler = self.derived
        return np.concatenate([columns, scaler.encode(derive(name, self.widths, values))], axis=1)

    # What is answered ------------------------------------------------------------------------------------------------------

    def now(self, values: np.ndarray) -> np.ndarray:
        """[B, R] the state that relative columns are relative to."""
        if not self.relative.any():
            return np.empty((len(values), 0))
        state = split_columns(self.widths, values)[STATE]
        return state[:, -1, self.state_column[self.relative]].astype(np.float64)

    def encode_actions(self, actions: np.ndarray, now: np.ndarray) -> np.ndarray:
        """[B, K, A] raw, [B, R] → [B, K, A'] float32."""
        absolute = self.absolute.encode(actions[..., ~self.relative])
        moved = _moved(actions, now, self.relative, self.circular) / self.rms
        return np.concatenate([absolute, moved.astype(np.float32)], axis=-1)

    def decode_actions(self, encoded: np.ndarray, now: np.ndarray) -> np.ndarray:
        """[..., B, K, A'] → [..., B, K, A] raw float32: the inverse of `encode_actions`."""
        split = self.absolute.width
        actions = np.empty((*encoded.shape[:-1], len(self.relative)), np.float32)
        actions[..., ~self.relative] = self.absolute.decode(encoded[..., :split])
        moved = now[:, None, :] + encoded[..., split:].astype(np.float64) * self.rms
        angles, centre = self.circular[self.relative], self.centre[self.relative]
        moved[..., angles] = centre[angles] + wrap(moved[..., angles] - centre[angles])
        actions[..., self.relative] = moved
        return actions

    # Files ----------------------------------------------------------------------------------------------------------------

    def arrays(self) -> dict[str, np.ndarray]:
        parts = self.observations.arrays("observations") | self.absolute.arrays("actions")
        if self.derived is not None:
            parts |= self.derived[1].arrays("derived")
        own = {"relative": self.relative.astype(np.uint8), "circular": self.circular.astype(np.uint8)}
        own |= {"state_column": self.state_column, "rms": self.rms, "centre": self.centre}
        return parts | {f"transform.{name}": array for name, array in own.items()}

    def settings(self) -> dict[str, Any]:
        derived = None if self.derived is None else self.derived[0]
        return {"widths": [list(pair) for pair in self.widths.items()], "history": self.history, "derived": derived}

    @classmethod
    def restore(cls, arrays: Mapping[str, np.ndarray], settings: Mapping[str, Any]) -> "Transform":
        """The inverse of `arrays` and `settings`."""
        own = {n: arrays[f"transform.{n}"] for n in ("relative", "circular", "state_column", "rms", "centre")}
        own |= {"relative": own["relative"].astype(bool), "circular": own["circular"].astype(bool)}
        name = settings["derived"]
        return cls(
            widths=dict(settings["widths"]),
            history=settings["history"],
            observations=Scaler.from_arrays(arrays, "observations"),
            derived=None if name is None else (name, Scaler.from_arrays(arrays, "derived")),
            absolute=Scaler.from_arrays(arrays, "actions"),
            **own,
        )


# Fitting ----------------------------------------------------------------------------------------------------------------


def fit_transform(windows: Windows, *, actions: str = "absolute", features: str | None = None) -> Transform:
    """What of `config.PolicyConfig.view` concerns what is seen and answered, fitted on the windows' episodes.

    Raises
    ------
    PolicyError : no action column can be relative, the set lacks the state or what the features need, or they are unusable.
    """
    normalizer: Normalizer = windows.normalizer
    widths = {key: windows.demos.columns[key].shape[1] for key in windows.observation_set.features}
    relative = _relative_columns(windows) if actions == "relative" else np.zeros(len(windows.semantics.kinds), bool)
    state_column = np.array([-1 if c is None else c for c in windows.semantics.state_column], np.int64)
    circular = circular_columns(windows.demos, windows.semantics, [ACTION]) & (windows.protocol == "strict")
    derived = None
    if features is not None:
        values = np.concatenate([derive(features, widths, seen) for seen, *_ in _all(windows)])
        plain = np.zeros(values.shape[1], bool)
        derived = (features, fit_scaler(values, plain, np.zeros(len(plain), bool)))
    return Transform(
        widths=widths,
        history=windows.history,
        observations=normalizer.observations,
        derived=derived,
        absolute=_absolute_scaler(windows, relative) if relative.any() else normalizer.actions,
        relative=relative,
        state_column=state_column,
        circular=circular,
        rms=_rms(windows, widths, relative, state_column, circular),
        centre=normalizer.actions.centre,
    )


def _relative_columns(windows: Windows) -> np.ndarray:
    semantics, names = windows.semantics, windows.demos.features[ACTION].names
    pairs = zip(semantics.kinds, semantics.state_column, strict=True)
    relative = np.array([kind == "position" and column is not None for kind, column in pairs])
    if not relative.any():
        kinds = ", ".join(f"{name} {kind}" for name, kind in zip(names, semantics.kinds, strict=True))
        raise PolicyError(
            f"actions = \"relative\", and no action column of '{windows.demos.name}' is a position that the state has ({kinds}). "
            'Use actions = "absolute", or say what the columns are with [datasets.<name>] kind.'
        )
    if STATE not in windows.observation_set.features:
        raise PolicyError(
            f"actions = \"relative\" are relative to {STATE}, which the observation set '{windows.observation_set.name}' does not "
            'hold: the answers would give away what the policy does not see. Add it to the set, or use "absolute".'
        )
    return relative


def _absolute_scaler(windows: Windows, relative: np.ndarray) -> Scaler:
    frames = frames_of(windows.demos, windows.statistics_episodes)
    values = windows.demos.columns[ACTION][frames][:, ~relative]
    circular = circular_columns(windows.demos, windows.semantics, [ACTION]) & (windows.protocol == "strict")
    if not values.shape[1]:
        return Scaler(np.zeros(0, bool), np.zeros(0), np.zeros(0), np.ones(0))
    return fit_scaler(values, circular[~relative], dead_columns(windows.demos, ACTION, frames)[~relative])


def _rms(
    windows: Windows, widths: Mapping[str, int], relative: np.ndarray, state_column: np.ndarray, circular: np.ndarray
) -> np.ndarray:
    """[K, R] over the windows whose action lies inside the episode; 1 where nothing ever moves."""
    squares, counts = np.zeros((windows.chunk, int(relative.sum()))), np.zeros((windows.chunk, 1))
    if relative.any():
        for values, actions, mask in _all(windows):
            now = split_columns(widths, values)[STATE][:, -1, state_column[relative]].astype(np.float64)
            moved = _moved(actions, now, relative, circular)
            squares += (moved**2 * mask[..., None]).sum(axis=0)
            counts[:, 0] += mask.sum(axis=0)
    rms = np.sqrt(squares / np.maximum(counts, 1))
    return np.where(rms > 0, rms, 1.0)


def _moved(actions: np.ndarray, now: np.ndarray, relative: np.ndarray, circular: np.ndarray) -> np.ndarray:
    """[B, K, R] how far relative columns are from where they are."""
    moved = actions[..., relative].astype(np.float64) - now[:, None, :]
    angles = circular[relative]
    moved[..., angles] = wrap(moved[..., angles])
    return moved


def _all(windows: Windows):
    """Every window's (values, actions, mask), block by block."""
    for start in range(0, len(windows), BLOCK):
        block = slice(start, start + BLOCK)
        yield windows.observations(block).values, *windows.targets(block)


def split_columns(widths: Mapping[str, int], values: np.ndarray) -> dict[str, np.ndarray]:
    """[..., O] → feature key → [..., D]."""
    parts = np.split(values, np.cumsum(list(widths.values()))[:-1], axis=-1)
    return dict(zip(widths, parts, strict=True))


# Derived features -------------------------------------------------------------------------------------------------------


def derive(name: str, widths: Mapping[str, int], values: np.ndarray) -> np.ndarray:
    """[B, T, O] → [B, F] float64: what the function of that name makes of the frames seen.

    Raises:
        PolicyError: it needs what is not seen, fails, or answers with something else than B rows of finite numbers.
    """
    function = find_function(name)
    shown = Seen(split_columns(widths, values), f"The derived features '{name}'")
    try:
        found = np.asarray(function(shown), np.float64)
    except PolicyError:
        raise
    except Exception as error:
        raise PolicyError(f"The derived features '{name}' raised {type(error).__name__}: {error}") from error
    if found.ndim != 2 or len(found) != len(values) or not found.shape[1]:
        raise PolicyError(
            f"The derived features '{name}' have the shape {found.shape}; expected [{len(values)}, F]: a row a window."
        )
    if not np.isfinite(found).all():
        raise PolicyError(f"The derived features '{name}' are not finite everywhere.")
    return found


def find_function(name: str) -> Callable[[Mapping[str, np.ndarray]], np.ndarray]:
    """One of this project's by name, or `path/to/file.py:function`, or `package.module:function`.

    Raises:
        PolicyError: there is none.
    """
    if name in DERIVED:
        module, function = DERIVED[name]
        return getattr(import_module(module), function)
    from pipeline.policies.own import source_hash

    return _import_function(name, source_hash(name, "features"))


@cache
def _import_function(address: str, content: str) -> Callable[[Mapping[str, np.ndarray]], np.ndarray]:
    where, _, name = address.rpartition(":")
    try:
        if where.endswith(".py"):
            spec = importlib.util.spec_from_file_location(f"demobench_derived_{content[:16]}", where)
            module = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(module)
        else:
            module = import_module(where)
    except Exception as error:
        raise PolicyError(f'features = "{address}": importing it raised {type(error).__name__}: {error}') from error
    function = getattr(module, name, None)
    if not callable(function):
        raise PolicyError(f"features = \"{address}\": {where} has no function '{name}'.")
    return function

"""From raw units to what networks and distances see, and back.

What belongs here: centring, scaling, angles as sine and cosine, and what counts as a column that does not move. What does not:
choosing episodes (`split`) or frames (`windows`).

A block of D columns is encoded as D + C columns, C of them circular: first the D columns in order, an angle replaced by its
sine, then the cosines of the angles.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.errors import NotApplicableError
from pipeline.lerobot_format.units import usual_range
from pipeline.types import ACTION, STATE, Demonstrations, Protocol, Semantics

DEAD_SHARE = 1e-3
"""A column whose deviation is below this share of its unit's usual range does not move."""

ROUNDING = 1e-6
"""Where no usual range is known: a deviation below this share of the largest value is float32 rounding."""

NOTEBOOK_SMALLEST = 1e-6


@dataclass(frozen=True)
class Scaler:
    """Affine scaling of one block of columns, with its exact inverse beside it.

    circular [D] bool    centre [D] the middle of the branch that angles are decoded into
    mean [D + C]         scale [D + C], 1 for columns that do not move
    """

    circular: np.ndarray
    centre: np.ndarray
    mean: np.ndarray
    scale: np.ndarray

    @property
    def width(self) -> int:
        """D + C, the encoded columns."""
        return len(self.mean)

    def encode(self, values: np.ndarray) -> np.ndarray:
        """[..., D] raw → [..., D + C] float32, about zero mean and unit deviation."""
        return ((unroll(values, self.circular) - self.mean) / self.scale).astype(np.float32)

    def decode(self, encoded: np.ndarray) -> np.ndarray:
        """[..., D + C] → [..., D] raw float32; angles within π of `centre`."""
        plain = encoded * self.scale + self.mean
        columns = len(self.circular)
        values = plain[..., :columns]
        if self.circular.any():
            angle = np.arctan2(values[..., self.circular], plain[..., columns:])
            centre = self.centre[self.circular]
            values[..., self.circular] = centre + wrap(angle - centre)
        return values.astype(np.float32)

    def arrays(self, prefix: str) -> dict[str, np.ndarray]:
        """The four arrays under names that start with `prefix`, for a safetensors file."""
        return {
            f"{prefix}.circular": self.circular.astype(np.uint8),
            f"{prefix}.centre": self.centre,
            f"{prefix}.mean": self.mean,
            f"{prefix}.scale": self.scale,
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray], prefix: str) -> "Scaler":
        """The inverse of `arrays`."""
        circular, centre, mean, scale = (arrays[f"{prefix}.{part}"] for part in ("circular", "centre", "mean", "scale"))
        return cls(circular.astype(bool), centre, mean, scale)


@dataclass(frozen=True)
class Normalizer:
    """How observations (one frame of an observation set) and actions are scaled."""

    observations: Scaler
    actions: Scaler

    def hash(self) -> str:
        """sha256 over every number in it."""
        digest = hashlib.sha256()
        for name, array in sorted(self.arrays().items()):
            digest.update(name.encode())
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def arrays(self) -> dict[str, np.ndarray]:
        return self.observations.arrays("observations") | self.actions.arrays("actions")

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> "Normalizer":
        return cls(Scaler.from_arrays(arrays, "observations"), Scaler.from_arrays(arrays, "actions"))


def wrap(angle: np.ndarray) -> np.ndarray:
    """Angles to [−π, π), radians."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def unroll(values: np.ndarray, circular: np.ndarray) -> np.ndarray:
    """[..., D] → [..., D + C] float64: angles as sine in their place and cosine at the end."""
    values = np.asarray(values, np.float64)
    if not circular.any():
        return values
    angles = values[..., circular]
    out = np.concatenate([values, np.cos(angles)], axis=-1)
    out[..., np.flatnonzero(circular)] = np.sin(angles)
    return out


def dead_columns(values: np.ndarray, units: Sequence[str | None]) -> np.ndarray:
    """[D] bool: the columns of `values` [n, D] that do not move, judged by the usual range of their unit."""
    deviation = values.std(axis=0, dtype=np.float64)
    largest = np.abs(values).max(axis=0, initial=0.0)
    usual = np.array([usual_range(unit) or np.nan for unit in units], np.float64)
    threshold = np.where(np.isnan(usual), ROUNDING * largest, DEAD_SHARE * usual)
    return deviation <= threshold


def fit_scaler(values: np.ndarray, circular: np.ndarray, units: Sequence[str | None], protocol: Protocol) -> Scaler:
    """Means and deviations of `values` [n, D].

    The sine and cosine of an angle share one scale, so that distances on the circle stay distances. `notebook` knows no
    circles and no dead columns: it divides by the deviation, at least 1e-6.
    """
    if protocol == "notebook":
        mean, deviation = values.mean(axis=0, dtype=np.float64), values.std(axis=0, dtype=np.float64)
        nothing = np.zeros(values.shape[1], bool)
        return Scaler(nothing, np.zeros(values.shape[1]), mean, np.maximum(deviation, NOTEBOOK_SMALLEST))
    columns = unroll(values, circular)
    mean, scale = columns.mean(axis=0), columns.std(axis=0)
    dead = dead_columns(values, units)
    of_circle, cosines = np.flatnonzero(circular), np.arange(values.shape[1], columns.shape[1])
    scale[of_circle] = scale[cosines] = np.sqrt((scale[of_circle] ** 2 + scale[cosines] ** 2) / 2)
    dead = np.concatenate([dead, dead[of_circle]])
    centre = np.where(circular, (values.min(axis=0) + values.max(axis=0)) / 2.0, 0.0)
    return Scaler(circular, centre, mean, np.where(dead, 1.0, scale))


def fit_normalizer(
    demos: Demonstrations,
    semantics: Semantics,
    features: Sequence[str],
    episodes: Sequence[int],
    *,
    protocol: Protocol,
    state_for_actions: bool = False,
) -> Normalizer:
    """Statistics of an observation set's columns and of the actions over all frames of the given episodes.

    Parameters
    ----------
    state_for_actions : scale each action column like the state column it commands (the notebook's arm recipe).

    Raises
    ------
    NotApplicableError : `state_for_actions`, and an action column commands no state column.
    """
    frames = np.concatenate([np.arange(demos.frames)[demos.episode(e)] for e in episodes])
    values = np.concatenate([demos.columns[key][frames] for key in features], axis=1)
    circular = np.concatenate([np.asarray(semantics.circular.get(key, (False,) * demos.columns[key].shape[1]), bool) for key in features])
    units = [unit for key in features for unit in demos.features[key].units]
    observations = fit_scaler(values, circular, units, protocol)
    key, actions = ACTION, demos.columns[ACTION]
    if state_for_actions:
        key, actions = STATE, demos.columns[STATE][:, commanded_columns(demos, semantics)]
    action_circular = np.asarray(semantics.circular.get(ACTION, (False,) * actions.shape[1]), bool)
    return Normalizer(observations, fit_scaler(actions[frames], action_circular, demos.features[ACTION].units, protocol))


def commanded_columns(demos: Demonstrations, semantics: Semantics) -> list[int]:
    """[A] the state column that every action column commands.

    Raises:
        NotApplicableError: some action column commands none.
    """
    missing = [n for n, c in zip(demos.features[ACTION].names, semantics.state_column, strict=True) if c is None]
    if missing:
        states = demos.columns[STATE].shape[1] if STATE in demos.columns else 0
        raise NotApplicableError(
            f"The notebook protocol scales every action by the state column it commands, and in '{demos.name}' "
            f"({states} state → {len(semantics.state_column)} action columns) {', '.join(missing)} commands none. "
            "Use the protocol 'strict', which scales actions by their own statistics."
        )
    return [column for column in semantics.state_column if column is not None]

"""From raw units to what networks and distances see, and back.

What belongs here: centring, scaling, angles as sine and cosine. What does not: choosing episodes (`split`) or frames
(`windows`), and which columns are angles or do not move (`lerobot_format.quality`).

A block of D columns is encoded as D + C columns, C of them circular: first the D columns in order, an angle replaced by
its sine, then the cosines of the angles.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.errors import NotApplicableError, PolicyError
from pipeline.lerobot_format.kinds import wrap
from pipeline.lerobot_format.quality import dead_columns
from pipeline.types import ACTION, STATE, Demonstrations, Protocol, Semantics

NOTEBOOK_SMALLEST = 1e-6
"""The notebook divides by the deviation, or by this where a column does not move."""


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


def check_columns(values: np.ndarray, expected: int) -> None:
    """Observations [..., O] must be those that something was fitted on.

    Raises:
        PolicyError: another number of columns.
    """
    if values.shape[-1] != expected:
        raise PolicyError(
            f"The policy sees {expected} columns and was given {values.shape[-1]}: it was trained on another data set or "
            "observation set."
        )


def unroll(values: np.ndarray, circular: np.ndarray) -> np.ndarray:
    """[..., D] → [..., D + C] float64: angles as sine in their place and cosine at the end."""
    values = np.asarray(values, np.float64)
    if not circular.any():
        return values
    angles = values[..., circular]
    out = np.concatenate([values, np.cos(angles)], axis=-1)
    out[..., np.flatnonzero(circular)] = np.sin(angles)
    return out


def fit_scaler(values: np.ndarray, circular: np.ndarray, dead: np.ndarray) -> Scaler:
    """Means and deviations of `values` [n, D]; columns that are `dead` [D] keep the scale 1.

    The sine and cosine of an angle share one scale, so that distances on the circle stay distances.
    """
    columns = unroll(values, circular)
    mean, scale = columns.mean(axis=0), columns.std(axis=0)
    sines, cosines = np.flatnonzero(circular), np.arange(values.shape[1], columns.shape[1])
    scale[sines] = scale[cosines] = np.sqrt((scale[sines] ** 2 + scale[cosines] ** 2) / 2)
    still = np.concatenate([dead, dead[sines]]) | (scale == 0)
    centre = np.where(circular, (values.min(axis=0) + values.max(axis=0)) / 2.0, 0.0)
    return Scaler(circular, centre, mean, np.where(still, 1.0, scale))


def fit_notebook_scaler(values: np.ndarray) -> Scaler:
    """As the notebook scales `values` [n, D]: it knows neither circles nor columns that do not move."""
    mean, deviation = values.mean(axis=0, dtype=np.float64), values.std(axis=0, dtype=np.float64)
    nothing = np.zeros(values.shape[1])
    return Scaler(nothing.astype(bool), nothing, mean, np.maximum(deviation, NOTEBOOK_SMALLEST))


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
    frames = frames_of(demos, episodes)
    seen = np.concatenate([demos.columns[key][frames] for key in features], axis=1)
    actions = demos.columns[ACTION][frames]
    if protocol == "notebook":
        if state_for_actions:
            actions = demos.columns[STATE][frames][:, commanded_columns(demos, semantics)]
        return Normalizer(fit_notebook_scaler(seen), fit_notebook_scaler(actions))
    dead = np.concatenate([dead_columns(demos, key, frames) for key in features])
    return Normalizer(
        fit_scaler(seen, circular_columns(demos, semantics, features), dead),
        fit_scaler(actions, circular_columns(demos, semantics, [ACTION]), dead_columns(demos, ACTION, frames)),
    )


def frames_of(demos: Demonstrations, episodes: Sequence[int]) -> np.ndarray:
    """The global frames of some episodes, one episode after another."""
    return np.concatenate([np.arange(demos.frames)[demos.episode(episode)] for episode in episodes])


def circular_columns(demos: Demonstrations, semantics: Semantics, features: Sequence[str]) -> np.ndarray:
    """[D] bool: which columns of these features, side by side, are angles that wrap."""
    nowhere = {key: (False,) * demos.columns[key].shape[1] for key in features}
    return np.concatenate([np.array(semantics.circular.get(key, nowhere[key]), bool) for key in features])


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

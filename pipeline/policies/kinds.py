"""What standing still means for every action column, by its kind: shared by the policies that move nothing or drift on.

What belongs here: the current value of each column. What does not: predicting any later one.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pipeline.lerobot_format.kinds import wrap
from pipeline.normalize import circular_columns, frames_of
from pipeline.types import ACTION, STATE, Observations
from pipeline.windows import Windows


@dataclass(frozen=True)
class Columns:
    """The kind of every action column, as masks, and a value for columns that nothing else is known of.

    state_column [A] int, −1 where none      still [A] bool: zero is standing still (velocities, differences)
    circular [A] bool                        mean [A] the mean training action, in place of an absent previous action
    """

    state_column: np.ndarray
    still: np.ndarray
    circular: np.ndarray
    mean: np.ndarray

    @property
    def follows(self) -> np.ndarray:
        """[A] bool: columns that command a position of the state."""
        return self.state_column >= 0

    def now(self, observations: Observations) -> np.ndarray:
        """[B, A] the action that changes nothing: the state, zero, or once more the action before."""
        action = np.where(self.still, 0.0, self.previous(observations))
        action[:, self.follows] = observations.state[:, -1, self.state_column[self.follows]]
        return action

    def previous(self, observations: Observations) -> np.ndarray:
        """[B, A] the action one frame before; at an episode's first frame zero or the mean training action."""
        unknown = np.where(self.still, 0.0, self.mean)
        before = observations.previous_action
        return np.where(np.isnan(before), unknown, before).astype(np.float64)

    def step(self, observations: Observations) -> np.ndarray:
        """[B, A] how far followed columns moved in the last frame, the short way round for angles; 0 elsewhere."""
        moved = np.zeros_like(observations.previous_action, dtype=np.float64)
        if observations.state.shape[1] > 1:
            columns = self.state_column[self.follows]
            moved[:, self.follows] = observations.state[:, -1, columns] - observations.state[:, -2, columns]
        moved[:, self.circular] = wrap(moved[:, self.circular])
        return moved

    def arrays(self) -> dict[str, np.ndarray]:
        return {
            "state_column": self.state_column,
            "still": self.still.astype(np.uint8),
            "circular": self.circular.astype(np.uint8),
            "mean": self.mean,
        }

    @classmethod
    def restore(cls, arrays: Mapping[str, np.ndarray]) -> "Columns":
        return cls(
            arrays["state_column"], arrays["still"].astype(bool), arrays["circular"].astype(bool), arrays["mean"]
        )


def columns_of(windows: Windows) -> Columns:
    """The columns of a data set; the mean action is that of the windows' own episodes."""
    kinds = np.array(windows.semantics.kinds)
    has_state = STATE in windows.demos.columns
    state_column = [
        column if kind == "position" and column is not None and has_state else -1
        for kind, column in zip(windows.semantics.kinds, windows.semantics.state_column, strict=True)
    ]
    circular = circular_columns(windows.demos, windows.semantics, [ACTION]) & (windows.protocol == "strict")
    return Columns(
        state_column=np.array(state_column, np.int64),
        still=np.isin(kinds, ("velocity", "delta")),
        circular=circular,
        mean=mean_action(windows, circular),
    )


def mean_action(windows: Windows, circular: np.ndarray) -> np.ndarray:
    """[A] the mean action over all frames of the windows' episodes; for angles the mean direction."""
    actions = windows.demos.columns[ACTION][frames_of(windows.demos, windows.episodes)]
    mean = actions.mean(axis=0, dtype=np.float64)
    angles = actions[:, circular].astype(np.float64)
    mean[circular] = np.arctan2(np.sin(angles).mean(axis=0), np.cos(angles).mean(axis=0))
    return mean

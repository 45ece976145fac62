"""The nearest frame in each of the nearest other episodes, for many states at once.

What belongs here: one exact search for all horizons. What does not: what is done with neighbours (`floors`).

Frames of one episode are copies in time, so a state's neighbours are one frame an episode. Trees cannot ask for that; every
distance is worked out instead, a block of states at a time, as one matrix product.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

BLOCK_MB = 64
FAR = np.float32(1e30)


@dataclass(frozen=True)
class Neighbours:
    """For one horizon: states that have an action there, and their neighbours that have one, nearest first.

    scored [M] global frames      frames [M, K] one global frame of each of the K nearest other episodes
    squared_distance [M, K]
    """

    scored: np.ndarray
    frames: np.ndarray
    squared_distance: np.ndarray


def find_neighbours(
    inputs: np.ndarray,
    episode_starts: np.ndarray,
    scored: np.ndarray,
    first: int,
    horizons: Sequence[int],
    *,
    keep: int,
) -> dict[int, Neighbours]:
    """Search once, answer for every horizon.

    Parameters
    ----------
    inputs : [N, D] float32.
    scored : [M] global frames whose neighbours are asked for.
    first : the first frame of an episode that can be a neighbour.
    horizons : a frame counts at horizon h when the frame h steps later is still in its episode.
    keep : K; fewer where there are fewer other episodes.

    Returns
    -------
    dict of horizon → Neighbours; states whose own episode ends before the horizon are left out there.
    """
    table = _Padded(inputs, episode_starts, first)
    keep = min(keep, len(episode_starts) - 2)
    episode = np.searchsorted(episode_starts, scored, side="right") - 1
    parts: dict[int, list[Neighbours]] = {h: [] for h in sorted(horizons)}
    size = max(1, int(BLOCK_MB * 2**20 / (4 * max(1, table.right.shape[1]))))
    for start in range(0, len(scored) if parts else 0, size):
        block = slice(start, start + size)
        asked = scored[block]
        distances = table.distances(inputs[asked], episode[block])
        for horizon in parts:
            distances[:, *table.tail(horizon)] = FAR
            inside = asked + horizon < episode_starts[episode[block] + 1]
            parts[horizon].append(_nearest(inputs, asked[inside], distances[inside], table, keep))
    return {horizon: _join(found) for horizon, found in parts.items()}


class _Padded:
    """Every episode's frames side by side, padded to the longest, ready for one matrix product."""

    def __init__(self, inputs: np.ndarray, starts: np.ndarray, first: int):
        self.lengths = np.maximum(np.diff(starts) - first, 0)
        self.first_frame = starts[:-1] + first
        self.episodes, self.longest = len(self.lengths), int(self.lengths.max())
        columns = inputs.shape[1]
        points = np.zeros((self.episodes, self.longest, columns), np.float32)
        norms = np.full((self.episodes, self.longest), FAR)
        for e, (frame, length) in enumerate(zip(self.first_frame, self.lengths, strict=True)):
            points[e, :length] = inputs[frame : frame + length]
            norms[e, :length] = (points[e, :length] ** 2).sum(axis=1)
        # |q − p|² = |q|² + |p|² − 2 q·p; |q|² is the same for all candidates of a state, so it is left out.
        self.right = np.concatenate([-2 * points.reshape(-1, columns), norms.reshape(-1, 1)], axis=1).T.copy()

    def distances(self, states: np.ndarray, own: np.ndarray) -> np.ndarray:
        """[B, E, L] squared distances less the state's own norm; far for padding and for the state's own episode."""
        left = np.concatenate([states, np.ones((len(states), 1), np.float32)], axis=1)
        found = (left @ self.right).reshape(len(states), self.episodes, self.longest)
        found[np.arange(len(states)), own] = FAR
        return found

    def tail(self, horizon: int) -> tuple[np.ndarray, np.ndarray]:
        """Episode and position of the last `horizon` frames of every episode."""
        ago = np.arange(1, horizon + 1)
        episode, back = np.repeat(np.arange(self.episodes), horizon), np.tile(ago, self.episodes)
        position = self.lengths[episode] - back
        there = position >= 0
        return episode[there], position[there]


def _nearest(inputs: np.ndarray, asked: np.ndarray, distances: np.ndarray, table: _Padded, keep: int) -> Neighbours:
    at = distances.argmin(axis=2)
    smallest = np.take_along_axis(distances, at[:, :, None], axis=2)[:, :, 0]
    nearest = np.argpartition(smallest, keep - 1, axis=1)[:, :keep] if keep < smallest.shape[1] else None
    nearest = np.tile(np.arange(smallest.shape[1]), (len(asked), 1)) if nearest is None else nearest
    frames = table.first_frame[nearest] + np.take_along_axis(at, nearest, axis=1)
    # The product above loses digits where states nearly coincide; those that count are measured again.
    exact = ((inputs[asked][:, None].astype(np.float64) - inputs[frames]) ** 2).sum(axis=2)
    exact[np.take_along_axis(smallest, nearest, axis=1) >= FAR / 2] = np.inf
    order = np.argsort(exact, axis=1, kind="stable")
    return Neighbours(asked, np.take_along_axis(frames, order, axis=1), np.take_along_axis(exact, order, axis=1))


def _join(parts: Sequence[Neighbours]) -> Neighbours:
    return Neighbours(
        np.concatenate([p.scored for p in parts]),
        np.concatenate([p.frames for p in parts]),
        np.concatenate([p.squared_distance for p in parts]),
    )

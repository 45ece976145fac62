"""Copy what was done at the most similar training window (1-NN on the normalised history).

What belongs here: remembering and searching. What does not: how columns are scaled (`normalize`).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from pipeline.normalize import Normalizer, frames_of
from pipeline.policies import Plan
from pipeline.types import ACTION, Observations
from pipeline.windows import Windows

QUERIES, CANDIDATES = 512, 4096
"""Distances are worked out in blocks of at most this many queries by this many candidates (16 MB of float64)."""


@dataclass(frozen=True)
class NearestNeighbour:
    """The encoded frames of the training episodes, and the windows among them.

    frames [N', O'] float32 encoded      actions [N', A] raw      history T
    anchors, first [M] rows of `frames`: where a window is, and where its episode begins
    remaining [M] the largest horizon at which a window still has its own action
    """

    normalizer: Normalizer
    frames: np.ndarray
    actions: np.ndarray
    anchors: np.ndarray
    first: np.ndarray
    remaining: np.ndarray
    history: int

    seeds: ClassVar[tuple[int, ...]] = (0,)
    chunk: ClassVar[None] = None
    parameters: ClassVar[int] = 0

    @classmethod
    def fit(cls, windows: Windows, plan: Plan) -> tuple[Self, None]:
        """Remember the windows' episodes. `plan` is not used."""
        demos = windows.demos
        kept = frames_of(demos, windows.episodes)
        row = np.full(demos.frames, -1, np.int64)
        row[kept] = np.arange(len(kept))
        policy = cls(
            normalizer=windows.normalizer,
            frames=windows.normalizer.observations.encode(windows.values[kept]),
            actions=np.asarray(demos.columns[ACTION][kept]),
            anchors=row[windows.anchors],
            first=row[windows.first_frame],
            remaining=windows.end_frame - 1 - windows.anchors,
            history=windows.history,
        )
        return policy, None

    def predict(self, observations: Observations, horizons: int = 1) -> np.ndarray:
        """[1, B, K, A] float32, raw units. At horizon h only windows with an action of their own at h are candidates.

        Beyond the longest training episode there are none: the last answer is repeated.
        """
        reached = min(horizons, int(self.remaining.max()) + 1)
        chosen = self.search(observations, reached)
        actions = self.actions[self.anchors[chosen] + np.arange(reached)]
        return np.pad(actions, ((0, 0), (0, horizons - reached), (0, 0)), mode="edge")[None]

    def search(self, observations: Observations, horizons: int) -> np.ndarray:
        """[B, K] which window is nearest at each horizon.

        Candidates are taken in order of how far they reach, so that the candidates of horizon h are all those seen by
        the time h is answered, and one pass over the distances answers every horizon. Of equally near windows the one
        that reaches farthest is taken (counting no farther than the last horizon), then the earliest.
        """
        encoded = self.normalizer.observations.encode(observations.values)
        queries = encoded.reshape(len(encoded), -1).astype(np.float64)
        chosen = np.empty((len(queries), horizons), np.int64)
        for start in range(0, len(queries), QUERIES):
            block = slice(start, start + QUERIES)
            chosen[block] = self._search_block(queries[block], horizons)
        return chosen

    def _search_block(self, queries: np.ndarray, horizons: int) -> np.ndarray:
        reach = np.minimum(self.remaining, horizons - 1)
        order = np.argsort(-reach, kind="stable")
        ends = np.searchsorted(-reach[order], -np.arange(horizons), side="right")
        best = np.full(len(queries), np.inf)
        nearest = np.full(len(queries), order[0])
        chosen = np.empty((len(queries), horizons), np.int64)
        seen = 0
        for horizon in reversed(range(horizons)):
            for start in range(seen, ends[horizon], CANDIDATES):
                candidates = order[start : min(start + CANDIDATES, ends[horizon])]
                distance = self._distances(queries, candidates)
                position = distance.argmin(axis=1)
                smallest = distance[np.arange(len(queries)), position]
                closer = smallest < best
                best[closer] = smallest[closer]
                nearest[closer] = candidates[position[closer]]
            seen = ends[horizon]
            chosen[:, horizon] = nearest
        return chosen

    def _distances(self, queries: np.ndarray, candidates: np.ndarray) -> np.ndarray:
        """[B, C] squared distances less the part that is the same for all candidates of a query."""
        rows = np.maximum(self.anchors[candidates, None] + np.arange(1 - self.history, 1), self.first[candidates, None])
        windows = self.frames[rows].reshape(len(candidates), -1).astype(np.float64)
        return np.einsum("cd,cd->c", windows, windows) - 2 * queries @ windows.T

    def arrays(self) -> dict[str, np.ndarray]:
        remembered = ("frames", "actions", "anchors", "first", "remaining")
        return self.normalizer.arrays() | {name: getattr(self, name) for name in remembered}

    def settings(self) -> dict[str, Any]:
        return {"history": self.history}

    @classmethod
    def restore(cls, arrays: Mapping[str, np.ndarray], settings: Mapping[str, Any]) -> Self:
        remembered = ("frames", "actions", "anchors", "first", "remaining")
        return cls(Normalizer.from_arrays(arrays), **{n: arrays[n] for n in remembered}, history=settings["history"])

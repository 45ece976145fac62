"""Windows as indices: which frames are anchors, which frames each sees, and which actions follow.

What belongs here: the rules that say where a window may lie, and gathering one batch of windows. What does not:
learning anything. Frames are never copied for a whole data set: memory is O(frames), whatever history and chunk are.
"""

import hashlib
import json
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from pipeline.errors import ConfigError, DatasetError
from pipeline.lerobot_format.columns import check_observation_set
from pipeline.lerobot_format.pictures import pictures_of
from pipeline.normalize import Normalizer, commanded_columns, fit_normalizer
from pipeline.types import ACTION, STATE, Demonstrations, Observations, ObservationSet, Protocol, Semantics

Recipe = Literal["arm", "every_frame"]


@dataclass(frozen=True)
class Windows:
    """The windows of some episodes: anchors, and how to gather what lies around them.

    anchors              [M] int64 global frames, ascending
    episodes             the episodes they lie in (positions)
    statistics_episodes  the episodes that normalisation statistics come from: those that train (`notebook`: all)
    history, chunk       T frames seen, oldest first; K actions that follow, the first at the anchor's own frame
    recipe               `every_frame`: a policy without history; under `notebook` every frame is an anchor
    """

    demos: Demonstrations
    semantics: Semantics
    observation_set: ObservationSet
    episodes: tuple[int, ...]
    statistics_episodes: tuple[int, ...]
    protocol: Protocol
    recipe: Recipe
    history: int
    chunk: int
    anchors: np.ndarray

    def __len__(self) -> int:
        return len(self.anchors)

    @cached_property
    def values(self) -> np.ndarray:
        """[N, O] the observation set's columns side by side, raw units."""
        parts = [self.demos.columns[key] for key in self.observation_set.features]
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)

    @cached_property
    def normalizer(self) -> Normalizer:
        """How this observation set and the actions are scaled, from `statistics_episodes` alone."""
        return fit_normalizer(
            self.demos,
            self.semantics,
            self.observation_set.features,
            self.statistics_episodes,
            protocol=self.protocol,
            state_for_actions=self.protocol == "notebook" and self.recipe == "arm",
        )

    @cached_property
    def first_frame(self) -> np.ndarray:
        """[M] the first frame of each anchor's episode."""
        return self.demos.episode_starts[self._episode]

    @cached_property
    def end_frame(self) -> np.ndarray:
        """[M] one past the last frame of each anchor's episode."""
        return self.demos.episode_starts[self._episode + 1]

    @cached_property
    def _episode(self) -> np.ndarray:
        return np.searchsorted(self.demos.episode_starts, self.anchors, side="right") - 1

    def history_frames(self, index: np.ndarray | slice | None = None) -> np.ndarray:
        """[B, T] the frames that each window sees; an episode's first frame is repeated where the history is longer."""
        index = slice(None) if index is None else index
        frames = self.anchors[index, None] + np.arange(1 - self.history, 1)
        return np.maximum(frames, self.first_frame[index, None])

    def target_frames(self, index: np.ndarray | slice | None = None) -> tuple[np.ndarray, np.ndarray]:
        """[B, K] the frames of each window's actions, kept inside the episode, and a mask of those that really are."""
        index = slice(None) if index is None else index
        frames = self.anchors[index, None] + np.arange(self.chunk)
        last = self.end_frame[index, None] - 1
        return np.minimum(frames, last), frames <= last

    def observations(self, index: np.ndarray | slice | None = None) -> Observations:
        """What a policy is asked with at these windows, raw units."""
        index = slice(None) if index is None else index
        frames, anchors = self.history_frames(index), self.anchors[index]
        actions = self.demos.columns[ACTION]
        previous = np.array(actions[np.maximum(anchors - 1, 0)])
        previous[anchors == self.first_frame[index]] = np.nan
        states = self.demos.columns.get(STATE)
        state = np.empty((*frames.shape, 0), np.float32) if states is None else rows(states, frames)
        return Observations(rows(self.values, frames), state, previous, anchors, self.look(frames))

    def look(self, frames: np.ndarray) -> Callable[[str | None, int], np.ndarray]:
        """How the pictures of frames [B, T] are come by: nothing is opened before it is called."""
        return lambda camera, pixels: pictures_of(self.demos, camera, pixels)(frames)

    def targets(self, index: np.ndarray | slice | None = None) -> tuple[np.ndarray, np.ndarray]:
        """The recorded actions [B, K, A], and a mask [B, K]: False past the end, where an action means nothing."""
        frames, mask = self.target_frames(index)
        return rows(self.demos.columns[ACTION], frames), mask

    def hash(self) -> str:
        """sha256 over all that learning from these windows can see, and nothing else."""
        digest = hashlib.sha256(json.dumps(self._described(), sort_keys=True).encode())
        digest.update(self.anchors.tobytes())
        digest.update(self.normalizer.hash().encode())
        for episode in self.episodes:
            frames = self.demos.episode(episode)
            for array in (self.values, self.demos.columns[ACTION]):
                digest.update(np.ascontiguousarray(array[frames]).tobytes())
        return digest.hexdigest()

    def _described(self) -> dict:
        return {
            "features": self.observation_set.features,
            "episodes": self.episodes,
            "protocol": self.protocol,
            "recipe": self.recipe,
            "history": self.history,
            "chunk": self.chunk,
            "kinds": self.semantics.kinds,
            "state_column": self.semantics.state_column,
            "fps": self.demos.fps,
        }


def rows(values: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """`values[frames]`, [N, D] at [B, …] → [B, …, D]; `take` is an order of magnitude faster than the brackets."""
    return np.take(np.asarray(values), frames, axis=0)


def make_windows(
    demos: Demonstrations,
    semantics: Semantics,
    observation_set: ObservationSet,
    episodes: Collection[int],
    *,
    statistics_episodes: Collection[int],
    protocol: Protocol,
    history: int,
    chunk: int,
    recipe: Recipe = "arm",
    own_history: int | None = None,
) -> Windows:
    """Lay windows over episodes.

    Parameters
    ----------
    episodes : positions; those that train, or those held out.
    statistics_episodes : the episodes that train. Under `notebook` statistics come from all, whatever is given.
    history : the benchmark's history. Anchors depend on it alone (`strict`), so that all policies share them.
    own_history : the frames that this policy sees, where they differ; `every_frame` sees one.

    Raises
    ------
    ConfigError : the observation set names a feature that the data set lacks, or the chunk exceeds every episode.
    DatasetError : an episode is shorter than the history, or no window fits.
    NotApplicableError : `notebook`, and an action column commands no state column.
    """
    check_observation_set(observation_set, demos.columns, demos.name)
    _check_lengths(demos, history, chunk)
    if protocol == "notebook" and recipe == "arm":
        commanded_columns(demos, semantics)
    everywhere = protocol == "notebook" and recipe == "every_frame"
    first = 0 if everywhere else history - 1
    cut = chunk if protocol == "notebook" and not everywhere else 0
    anchors = _anchors(demos, sorted(episodes), first, cut)
    if not len(anchors):
        raise DatasetError(
            f"No window of {history} frames and {chunk} actions fits into the {len(episodes)} episodes asked for of "
            f"'{demos.name}'. Ask for a smaller chunk or a shorter history."
        )
    own = 1 if recipe == "every_frame" else own_history or history
    statistics = range(demos.episodes) if protocol == "notebook" else sorted(statistics_episodes)
    parts = (tuple(sorted(episodes)), tuple(statistics))
    return Windows(demos, semantics, observation_set, *parts, protocol, recipe, own, chunk, anchors)


def _anchors(demos: Demonstrations, episodes: Sequence[int], first: int, cut: int) -> np.ndarray:
    """[M] the frames of episodes less the `first` ones and the last `cut` of each."""
    spans = [demos.episode(episode) for episode in episodes]
    anchors = [np.arange(span.start + first, span.stop - cut, dtype=np.int64) for span in spans]
    return np.concatenate([np.empty(0, np.int64), *anchors])


def _check_lengths(demos: Demonstrations, history: int, chunk: int) -> None:
    lengths = demos.lengths
    shortest = int(lengths.argmin())
    if lengths[shortest] < history:
        raise DatasetError(
            f"Episode {demos.episode_ids[shortest]} of '{demos.name}' has {lengths[shortest]} frames, and the "
            f"history is {history}. Set [benchmark] history to at most {lengths[shortest]}, or remove the episode."
        )
    largest = int(lengths.max()) - history + 1
    if chunk > largest:
        raise ConfigError(
            f"A chunk of {chunk} actions is longer than every episode of '{demos.name}': after {history} frames of "
            f"history the longest ({lengths.max()} frames) leaves {largest}. Ask for chunks of at most {largest}."
        )

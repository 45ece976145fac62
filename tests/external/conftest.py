"""Small demonstrations, and files of predictions to score and to break."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from pipeline.external.anchors import anchors_of, fold_of_episodes
from pipeline.split import make_split
from pipeline.types import ACTION, Demonstrations, Semantics, Split
from tests.hand_made import random_walks, semantics

HISTORY = 3


@dataclass(frozen=True)
class Rows:
    """Predictions by row, before they are a file."""

    columns: dict[str, Any]

    def write(self, path: Path) -> Path:
        pq.write_table(pa.table(self.columns), path)
        return path

    def but(self, **columns: Any) -> "Rows":
        """The same with other columns; None takes one away."""
        changed = self.columns | columns
        return Rows({name: values for name, values in changed.items() if values is not None})

    def at(self, rows: Sequence[int] | np.ndarray) -> "Rows":
        """Some of the rows, in that order."""
        return Rows({name: [values[row] for row in rows] for name, values in self.columns.items()})


@dataclass(frozen=True)
class Place:
    """Demonstrations of six episodes, numbered from 10, and five folds."""

    demos: Demonstrations
    semantics: Semantics
    split: Split

    def rows(self, steps: int = 2, seeds: int = 1, off: float = 0.5, episodes: Sequence[int] | None = None) -> Rows:
        """What was recorded, off by a seed's own noise."""
        anchors = anchors_of(self.demos, HISTORY, episodes)
        last = self.demos.episode_starts[1:][self.demos.episode_of_frame[anchors]] - 1
        target = self.demos.columns[ACTION][np.minimum(anchors[:, None] + np.arange(steps), last[:, None])]
        noise = np.random.default_rng(1).normal(size=(seeds, *target.shape))
        of_anchor = self.demos.episode_of_frame[anchors]
        return Rows(
            {
                "episode_index": np.tile(self.demos.episode_ids[of_anchor], seeds).tolist(),
                "frame_index": np.tile(self.demos.frame_in_episode[anchors], seeds).tolist(),
                "action": (target + off * noise).reshape(-1, *target.shape[1:]).tolist(),
                "seed": np.repeat(np.arange(seeds), len(anchors)).tolist(),
                "fold": np.tile(fold_of_episodes(self.split, self.demos.episodes)[of_anchor], seeds).tolist(),
            }
        )


@pytest.fixture(scope="session")
def place() -> Place:
    demos = random_walks((40, 35, 45, 38, 42, 40), columns=3)
    split = make_split(demos, protocol="strict", folds=5, test_share=0.2, seed=0, has_simulator=False)
    return Place(demos, semantics(demos), split)


@pytest.fixture
def refusal(tmp_path) -> Callable[..., str]:
    """What reading predictions says."""
    from pipeline.errors import DatasetError
    from pipeline.external.reading import read_answers

    def read(rows: Rows | Path, demos: Demonstrations) -> str:
        path = rows if isinstance(rows, Path) else rows.write(tmp_path / "bad.parquet")
        with pytest.raises(DatasetError) as caught:
            read_answers(path, demos, HISTORY)
        text = str(caught.value)
        assert "\n" not in text
        assert str(path) in text
        return text

    return read

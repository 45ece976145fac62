"""The rows to fill in: every frame at which a policy is asked.

What belongs here: which frames those are, and the parquet file of them. What does not: reading what comes back.
"""

import json
import os
from collections.abc import Collection
from pathlib import Path

import numpy as np

from pipeline.errors import NotApplicableError, StoreError
from pipeline.store import drafted
from pipeline.types import ACTION, Demonstrations, Protocol, Split

NO_FOLD = -1
"""The fold of an episode that no fold holds out."""
METADATA = b"demobench"


def require_strict(protocol: Protocol) -> None:
    """Predictions from elsewhere are scored under `strict` alone.

    Raises:
        NotApplicableError: the protocol is another one.
    """
    if protocol != "strict":
        raise NotApplicableError(
            f"Under protocol '{protocol}' every chunk size is scored on windows of its own, so predictions from elsewhere have no "
            "common anchors with the rest. Score them under protocol strict."
        )


def anchors_of(demos: Demonstrations, history: int, episodes: Collection[int] | None = None) -> np.ndarray:
    """[M] global frames, ascending: all frames of some episodes (positions; None: all) from number history − 1 on."""
    frames = np.flatnonzero(demos.frame_in_episode >= history - 1)
    return frames if episodes is None else frames[np.isin(demos.episode_of_frame[frames], list(episodes))]


def fold_of_episodes(split: Split, episodes: int) -> np.ndarray:
    """[E] the fold that holds each episode out, −1 where none does."""
    fold = np.full(episodes, NO_FOLD, np.int64)
    for number, one in enumerate(split.folds):
        fold[list(one.test)] = number
    return fold


def write_anchors(
    path: Path, demos: Demonstrations, split: Split, history: int, episodes: Collection[int] | None = None
) -> int:
    """Write the rows to fill in as parquet, whole or not at all; returns how many there are.

    Columns `episode_index` (as recorded), `frame_index` (in the episode) and `fold` (the fold that holds the episode out, −1 where
    none does). The file's metadata, key `demobench`, is JSON: dataset, content_hash, fps, history, action_names, split_hash.

    Raises:
        StoreError: the file cannot be written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    anchors = anchors_of(demos, history, episodes)
    of_anchor = demos.episode_of_frame[anchors]
    described = {
        "dataset": demos.name, "content_hash": demos.content_hash, "fps": demos.fps, "history": history,
        "action_names": list(demos.features[ACTION].names), "split_hash": split.hash,
    }  # fmt: skip
    columns = {
        "episode_index": demos.episode_ids[of_anchor].astype(np.int64),
        "frame_index": demos.frame_in_episode[anchors].astype(np.int64),
        "fold": fold_of_episodes(split, demos.episodes)[of_anchor],
    }
    rows = pa.table(columns).replace_schema_metadata({METADATA: json.dumps(described).encode()})
    try:
        with drafted(path) as draft:
            pq.write_table(rows, draft)
    except OSError as error:
        why = os.strerror(error.errno) if error.errno else str(error)  # arrow's own words name the draft
        raise StoreError(
            f"The anchors cannot be written to {path}: {why}. Name a file in a folder that is there."
        ) from None
    return len(anchors)

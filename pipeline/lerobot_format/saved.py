"""Demonstrations on disk, and the hash of what is in them.

One .npy a column, so that it can be mapped into memory in no time, and meta.json for the rest. Nothing here reads
LeRobot's own layout.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import StoreError
from pipeline.types import Camera, Demonstrations, Feature

_META = "meta.json"
ROWS_AT_A_TIME = 2**16
"""Rows that are hashed at once: no column is copied whole."""


def hash_demonstrations(
    columns: Mapping[str, np.ndarray],
    features: Mapping[str, Feature],
    *,
    episode_starts: np.ndarray,
    episode_ids: np.ndarray,
    timestamps: np.ndarray,
    tasks: tuple[str, ...],
    fps: float,
) -> str:
    """sha256 over the canonical arrays: equal for equal demonstrations whatever files they came in.

    Columns go in by key: name, column names, shape, float32 little-endian bytes (−0 counts as 0).
    """
    digest = hashlib.sha256()

    def add(label: Any, array: np.ndarray, kind: str) -> None:
        header = json.dumps([label, list(array.shape), kind], ensure_ascii=False, separators=(",", ":"))
        digest.update(len(header.encode()).to_bytes(8, "little") + header.encode())
        for start in range(0, len(array), ROWS_AT_A_TIME):
            part = array[start : start + ROWS_AT_A_TIME]
            digest.update(np.ascontiguousarray(part + np.float32(0) if kind == "<f4" else part, dtype=kind).data)

    for key in sorted(columns):
        add([key, *features[key].names], columns[key], "<f4")
    add("episode_starts", episode_starts, "<i8")
    add("episode_ids", episode_ids, "<i8")
    add("timestamps", timestamps, "<f8")
    add(["tasks", *tasks], np.array([fps]), "<f8")
    return digest.hexdigest()


def save_demonstrations(demonstrations: Demonstrations, folder: Path) -> None:
    """Write into `folder`, which exists or is made; whoever calls makes it atomic (the store renames whole folders)."""
    folder.mkdir(parents=True, exist_ok=True)
    keys = sorted(demonstrations.columns)
    for position, key in enumerate(keys):
        np.save(folder / f"column-{position:03d}.npy", demonstrations.columns[key], allow_pickle=False)
    for name in ("episode_starts", "episode_ids", "timestamps"):
        np.save(folder / f"{name}.npy", getattr(demonstrations, name), allow_pickle=False)
    meta = {
        "name": demonstrations.name,
        "source": demonstrations.source,
        "revision": demonstrations.revision,
        "fps": demonstrations.fps,
        "robot_type": demonstrations.robot_type,
        "features": [
            {"key": key, "names": demonstrations.features[key].names, "units": demonstrations.features[key].units}
            for key in keys
        ],
        "tasks": demonstrations.tasks,
        "cameras": [vars(camera) for camera in demonstrations.cameras],
        "warnings": demonstrations.warnings,
        "content_hash": demonstrations.content_hash,
        "excluded": demonstrations.excluded,
    }
    (folder / _META).write_text(json.dumps(meta, indent=1, ensure_ascii=False), encoding="utf-8")


def load_demonstrations(folder: Path) -> Demonstrations:
    """Open what `save_demonstrations` wrote; the columns are mapped, read-only, not read.

    Raises:
        StoreError: something is missing or is not what was written.
    """
    try:
        meta = json.loads((folder / _META).read_text(encoding="utf-8"))
        features = {
            block["key"]: Feature(block["key"], tuple(block["names"]), tuple(block["units"]))
            for block in meta["features"]
        }
        columns = {
            key: np.load(folder / f"column-{position:03d}.npy", mmap_mode="r", allow_pickle=False)
            for position, key in enumerate(features)
        }
        arrays = {
            name: np.load(folder / f"{name}.npy", allow_pickle=False)
            for name in ("episode_starts", "episode_ids", "timestamps")
        }
        return Demonstrations(
            **{key: meta[key] for key in ("name", "source", "revision", "fps", "robot_type", "content_hash")},
            columns=columns,
            features=features,
            tasks=tuple(meta["tasks"]),
            cameras=tuple(Camera(**camera) for camera in meta["cameras"]),
            warnings=tuple(meta["warnings"]),
            excluded=tuple(meta.get("excluded", ())),
            **arrays,
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StoreError(
            f"The demonstrations kept in {folder} cannot be read ({type(error).__name__}: {error}). "
            "Remove the folder and run again."
        ) from None

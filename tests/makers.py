"""Small recordings with known answers, and the data sets that tests write from them.

A `Recording` is plain arrays; it becomes `Demonstrations` in memory, or a LeRobot folder of any version that is read.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.lerobot_format.saved import hash_demonstrations
from pipeline.lerobot_format.units import unit_of
from pipeline.lerobot_format.write import write_dataset
from pipeline.types import ACTION, STATE, Demonstrations, Feature

Column = tuple[tuple[str, ...] | None, np.ndarray, str]
"""Names of the D columns, values [N, D], dtype as info.json says it."""


@dataclass(frozen=True)
class Recording:
    """Episodes one after another: features by key, frames of each episode, the task of each."""

    fps: float
    features: dict[str, Column]
    lengths: tuple[int, ...]
    tasks: tuple[str, ...]

    def slices(self) -> list[slice]:
        stops = np.cumsum(self.lengths)
        return [slice(int(stop - length), int(stop)) for stop, length in zip(stops, self.lengths, strict=True)]


def tiny_recording(
    episodes: int = 6,
    frames: int | Sequence[int] = 40,
    *,
    kind: str = "position",
    joints: int = 2,
    fps: float = 10.0,
    seed: int = 0,
    names: Sequence[str] | None = None,
) -> Recording:
    """Smooth random motion of a few joints, commanded by `kind`: "position" (the joint goes half of the way to its
    command in every frame), "velocity" (state per second) or "delta" (state per frame).
    """
    random = np.random.default_rng(seed)
    lengths = (frames,) * episodes if isinstance(frames, int) else tuple(frames)
    states, actions = zip(*(_episode(random, length, joints, kind, fps) for length in lengths), strict=True)
    done = np.concatenate([np.arange(length) == length - 1 for length in lengths])
    names = tuple(names or (f"joint_{j}" for j in range(joints)))
    return Recording(
        fps=fps,
        features={
            ACTION: (names, np.concatenate(actions).astype(np.float32), "float32"),
            STATE: (names, np.concatenate(states).astype(np.float32), "float32"),
            "next.done": (None, done[:, None], "bool"),
        },
        lengths=lengths,
        tasks=tuple(("push", "pull")[e % 2] for e in range(len(lengths))),
    )


def _episode(
    random: np.random.Generator, length: int, joints: int, kind: str, fps: float
) -> tuple[np.ndarray, np.ndarray]:
    """States and actions [length, joints] of one episode."""
    time = np.arange(length)[:, None] / 10.0
    speed, phase = random.uniform(0.5, 2.0, joints), random.uniform(0, 2 * np.pi, joints)
    command = np.sin(speed * time + phase)
    state = np.empty((length, joints))
    state[0] = random.uniform(-0.5, 0.5, joints)
    for t in range(1, length):
        step = {
            "position": 0.5 * (command[t - 1] - state[t - 1]),
            "velocity": command[t - 1] / fps,
            "delta": command[t - 1],
        }
        state[t] = state[t - 1] + step[kind]
    return state, command


def demonstrations_of(recording: Recording, name: str = "tiny", **changes: Any) -> Demonstrations:
    """The recording as it would be read, without files. `changes` replace fields of the record."""
    columns = {key: np.ascontiguousarray(values, np.float32) for key, (_, values, _) in recording.features.items()}
    features = {
        key: Feature(
            key,
            _names(key, names, columns[key].shape[1]),
            tuple(map(unit_of, _names(key, names, columns[key].shape[1]))),
        )
        for key, (names, _, _) in recording.features.items()
    }
    arrays = {
        "episode_starts": np.concatenate([[0], np.cumsum(recording.lengths)]).astype(np.int64),
        "episode_ids": np.arange(len(recording.lengths)),
        "timestamps": np.concatenate([np.arange(length) / recording.fps for length in recording.lengths]),
        "tasks": recording.tasks,
    }
    fields = {
        "name": name, "source": f"made:{name}", "revision": None, "fps": recording.fps, "robot_type": "made",
        "columns": columns, "features": features, "cameras": (), "warnings": (), **arrays,
        "content_hash": hash_demonstrations(columns, features, fps=recording.fps, **arrays),
    }  # fmt: skip
    return Demonstrations(**fields | changes)


def _names(key: str, names: tuple[str, ...] | None, width: int) -> tuple[str, ...]:
    if names is not None:
        return names
    return (key.rsplit(".", 1)[-1],) if width == 1 else tuple(map(str, range(width)))


def tiny_demonstrations(episodes: int = 6, frames: int | Sequence[int] = 40, **options: Any) -> Demonstrations:
    """`tiny_recording`, as `Demonstrations` in memory."""
    return demonstrations_of(tiny_recording(episodes, frames, **options))


def write_v3(folder: Path, recording: Recording, **options: Any) -> Path:
    """The recording as a v3.0 folder, by the project's own writer."""
    write_dataset(
        folder,
        fps=recording.fps,
        features=recording.features,
        episode_lengths=recording.lengths,
        tasks=recording.tasks,
        robot_type="made",
        **options,
    )
    return folder


def write_v2(folder: Path, recording: Recording, *, version: str = "v2.1", chunks_size: int = 1000) -> Path:
    """The recording as a v2.0 or v2.1 folder: one file an episode, JSON lines, statistics as each version has them."""
    words = list(dict.fromkeys(recording.tasks))
    for episode, frames in enumerate(recording.slices()):
        columns = {key: _arrow(values[frames]) for key, (_, values, _) in recording.features.items()}
        columns |= _index_columns(recording, episode, frames, words.index(recording.tasks[episode]))
        path = folder / f"data/chunk-{episode // chunks_size:03d}/episode_{episode:06d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table(columns), path)
    meta = folder / "meta"
    meta.mkdir()
    (meta / "info.json").write_text(json.dumps(_info_v2(recording, version, chunks_size), indent=4))
    _write_lines(meta / "tasks.jsonl", [{"task_index": i, "task": word} for i, word in enumerate(words)])
    episodes = zip(recording.lengths, recording.tasks, strict=True)
    rows = [{"episode_index": e, "tasks": [task], "length": length} for e, (length, task) in enumerate(episodes)]
    _write_lines(meta / "episodes.jsonl", rows)
    if version == "v2.0":
        (meta / "stats.json").write_text(
            json.dumps({key: _stats(values) for key, (_, values, _) in recording.features.items()})
        )
    else:
        stats = [
            {
                "episode_index": e,
                "stats": {key: _stats(values[frames]) for key, (_, values, _) in recording.features.items()},
            }
            for e, frames in enumerate(recording.slices())
        ]
        _write_lines(meta / "episodes_stats.jsonl", stats)
    return folder


def _arrow(values: np.ndarray) -> pa.Array:
    flat = pa.array(np.ascontiguousarray(values).ravel())
    return flat if values.shape[1] == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def _index_columns(recording: Recording, episode: int, frames: slice, task: int) -> dict[str, np.ndarray]:
    number = np.arange(frames.stop - frames.start)
    return {
        "timestamp": (number / recording.fps).astype(np.float32),
        "frame_index": number,
        "episode_index": np.full(len(number), episode),
        "index": number + frames.start,
        "task_index": np.full(len(number), task),
    }


def _info_v2(recording: Recording, version: str, chunks_size: int) -> dict[str, Any]:
    declared = {
        key: {"dtype": dtype, "shape": [values.shape[1]], "names": list(names) if names else None}
        for key, (names, values, dtype) in recording.features.items()
    }
    index = ("frame_index", "episode_index", "index", "task_index")
    declared["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    declared |= {key: {"dtype": "int64", "shape": [1], "names": None} for key in index}
    episodes = len(recording.lengths)
    return {
        "codebase_version": version, "robot_type": "made", "fps": recording.fps, "features": declared,
        "total_episodes": episodes, "total_frames": sum(recording.lengths), "total_tasks": len(set(recording.tasks)),
        "total_videos": 0, "total_chunks": -(-episodes // chunks_size), "chunks_size": chunks_size,
        "splits": {"train": f"0:{episodes}"}, "video_path": None,
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
    }  # fmt: skip


def _stats(values: np.ndarray) -> dict[str, list[float]]:
    exact = values.astype(float)
    return {
        "min": [*exact.min(0)],
        "max": [*exact.max(0)],
        "mean": [*exact.mean(0)],
        "std": [*exact.std(0)],
        "count": [len(exact)],
    }


def _write_lines(path: Path, rows: list[dict[str, Any]]) -> None:
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))


def edit_info(folder: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Rewrite meta/info.json after `change` has altered the dictionary."""
    path = folder / "meta/info.json"
    info = json.loads(path.read_text())
    change(info)
    path.write_text(json.dumps(info))


def edit_table(path: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    """Rewrite a parquet file."""
    pq.write_table(change(pq.read_table(path, use_threads=False)), path)

"""Inspecting: fifty episodes against reading them alone, and a million frames of (6 + 6) columns, with their memory.

The long recording is the embedded data set over and over, each time elsewhere and with noise of its own, six joints of
its two: real motion, nothing twice. It is made in memory: reading is measured on what lies on disk.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.inspection.look import inspect
from pipeline.lerobot_format.quality import resolve_semantics
from pipeline.lerobot_format.read import load_source
from pipeline.types import ACTION, STATE, Demonstrations, Feature
from speed.timing import peak_mb, seconds

EPISODES, FRAMES, JOINTS = 50, 1_000_000, 6


def some(demos: Demonstrations, episodes: int) -> Demonstrations:
    """The first episodes."""
    stop = int(demos.episode_starts[episodes])
    return replace(
        demos, columns={key: values[:stop] for key, values in demos.columns.items()},
        episode_starts=demos.episode_starts[: episodes + 1], episode_ids=demos.episode_ids[:episodes],
        timestamps=demos.timestamps[:stop], tasks=demos.tasks[:episodes],
    )  # fmt: skip


def long_recording(demos: Demonstrations, frames: int) -> Demonstrations:
    """At least so many frames; state and action only, JOINTS columns of each."""
    random = np.random.default_rng(0)
    times = -(-frames // demos.frames)
    names = tuple(f"joint_{joint}.pos" for joint in range(JOINTS))
    columns = {key: np.empty((times * demos.frames, JOINTS), np.float32) for key in (STATE, ACTION)}
    for place in range(times):
        rows = slice(place * demos.frames, (place + 1) * demos.frames)
        for joint in range(JOINTS):
            stretch = random.uniform(0.8, 1.2, demos.episodes)[demos.episode_of_frame]
            for key, values in columns.items():
                noise = random.normal(0, 0.5, demos.frames)
                values[rows, joint] = stretch * demos.columns[key][:, joint % 2] + noise
    lengths = np.tile(demos.lengths, times)
    return replace(
        demos, columns=columns, features={key: Feature(key, names, (None,) * JOINTS) for key in columns},
        episode_starts=np.concatenate([[0], np.cumsum(lengths)]), episode_ids=np.arange(len(lengths)),
        timestamps=np.tile(demos.timestamps, times), tasks=demos.tasks * times,
    )  # fmt: skip


def measure(demos: Demonstrations) -> list[str]:
    semantics = resolve_semantics(demos)
    fifty = some(demos, EPISODES)
    read = seconds(lambda: load_source(demos.source, name=demos.name, config_dir=Path.cwd()))
    short = seconds(lambda: inspect(fifty, semantics))
    long = long_recording(demos, FRAMES)
    meaning = resolve_semantics(long)
    whole = seconds(lambda: inspect(long, meaning))
    memory = peak_mb(lambda: inspect(long, meaning))
    size = sum(values.nbytes for values in long.columns.values()) / 1e6
    return [
        f"inspecting {EPISODES} episodes ({fifty.frames:,} frames): {short:.2f} s; reading all {demos.episodes}: {read:.2f} s",
        f"inspecting {long.frames:,} frames of {JOINTS} + {JOINTS} columns in {long.episodes:,} episodes: {whole:.1f} s; peak "
        f"memory {memory:.0f} MB beside the columns' {size:.0f} MB, {memory / size:.2f} times",
    ]

"""`demobench inspect`: 50 episodes, and a million frames; seconds, and memory against the columns that are read."""

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from pipeline.inspection.look import inspect
from pipeline.lerobot_format.quality import inspect_dataset, resolve_semantics
from pipeline.lerobot_format.write import write_dataset
from pipeline.types import ACTION, STATE, Demonstrations
from speed.planted import made_arm
from speed.timing import peak_mb, seconds

MILLION = 1_000_000

_COMMAND = """
import json, sys, time
from pathlib import Path
sys.argv = ["demobench", "inspect", {folder!r}, "--json", {out!r}]
from demobench.cli import main
began = time.perf_counter()
try:
    main()
except SystemExit as end:
    assert not end.code, end.code
took = time.perf_counter() - began
# Not ru_maxrss, which is inherited from the process that forked.
peak = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
print(json.dumps([took, int(peak.split()[1]) * 1024 / 1e6]))
"""


def many(demos: Demonstrations, copies: int) -> Demonstrations:
    """The same demonstrations so many times over, every copy scaled and moved a little: none is another's duplicate."""
    random = np.random.default_rng(0)
    columns = {}
    for key, values in demos.columns.items():
        factors = 1 + 0.05 * random.normal(size=(copies, 1, 1))
        moved = 0.05 * np.ptp(values, axis=0) * random.normal(size=(copies, 1, values.shape[1]))
        columns[key] = (values[None] * factors + moved).reshape(-1, values.shape[1]).astype(np.float32)
    lengths = np.tile(demos.lengths, copies)
    return replace(
        demos, columns=columns, episode_starts=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        episode_ids=np.arange(len(lengths)), timestamps=np.tile(demos.timestamps, copies), tasks=demos.tasks * copies,
    )  # fmt: skip


def looked_at(demos: Demonstrations) -> Callable[[], object]:
    def work() -> object:
        semantics = resolve_semantics(demos)
        return inspect(demos, semantics), inspect_dataset(demos, semantics)

    return work


def of_command(demos: Demonstrations) -> tuple[float, float]:
    """Seconds and peak resident MB (a million bytes) of the command on a folder, imports left out of the seconds."""
    with TemporaryDirectory() as place:
        folder, out = Path(place) / "set", Path(place) / "out.json"
        features = {key: (demos.features[key].names, demos.columns[key], "float32") for key in (ACTION, STATE)}
        write_dataset(
            folder, fps=demos.fps, features=features, episode_lengths=demos.lengths.tolist(), tasks=demos.tasks,
            robot_type=None,
        )  # fmt: skip
        code = _COMMAND.format(folder=str(folder), out=str(out))
        run = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
        return tuple(json.loads(run.stdout.strip().splitlines()[-1]))


def measure() -> list[str]:
    small = made_arm(50, 0)
    large = many(small, -(-MILLION // small.frames))
    columns_mb = sum(values.nbytes for values in large.columns.values()) / 1e6
    index_mb = 8 * 4 * large.frames / 1e6  # seconds, and the numbers of episode, frame and task, in the files
    small_s, small_mb = of_command(small)
    large_s, large_mb = of_command(large)
    more_mb = large_mb - small_mb
    alone_s, beside_mb = seconds(looked_at(large)), peak_mb(looked_at(large))
    return [
        f"inspect, {small.episodes} episodes ({small.frames:,} frames, 12 columns): {small_s:.1f} s with reading, kinds and "
        f"detectors alone {min(seconds(looked_at(small)) for _ in range(3)):.2f} s",
        f"inspect, {large.episodes:,} episodes ({large.frames:,} frames): {large_s:.1f} s with reading, kinds and detectors alone "
        f"{alone_s:.1f} s; the whole process peaks at {large_mb:.0f} MB, {more_mb:.0f} MB more than for {small.episodes} episodes: "
        f"{more_mb / columns_mb:.2f} times the {columns_mb:.0f} MB of actions and states, {more_mb / (columns_mb + index_mb):.2f} "
        f"times all columns that are read, which have {index_mb:.0f} MB of times and numbers besides; kinds and detectors take "
        f"{beside_mb:.0f} MB of it",
    ]


if __name__ == "__main__":
    print("\n".join(measure()))

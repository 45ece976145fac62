"""All studies of a run as shards: computed in processes, one small file each, kept; what is there is not done again.

What belongs here: which studies a quick and a full run hold, and running them. What does not: what a study does
(`studies`), or whether its result is good enough (`goals`).
"""

import ast
import hashlib
import json
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pipeline.statistics.known_truth.generators import GENERATORS
from pipeline.statistics.known_truth.studies import SHAPES, STUDIES
from pipeline.store import write_json

Size = Literal["quick", "full"]
MODES = (
    ("coin", "state"), ("strategies", "state"), ("two_ways_round", "state"), ("skewed", "state"), ("heavy_tails", "state"),
    ("uneven", "state"), ("gripper", "state"), ("drifting", "state"), ("object", "state"),
)  # fmt: skip
"""Where modes are looked for: networks are trained, so not everywhere."""

ESTIMATORS = (
    "brackets", "comparisons", "curve", "curve_errors", "floors", "intervals", "metrics", "modes", "neighbours", "pilot",
    "radius", "success",
)  # fmt: skip
"""Modules of `pipeline.statistics` that records depend on."""

Columns = dict[str, np.ndarray]


@dataclass(frozen=True)
class Shard:
    """A block of repeats of one study: `first` … `first + count − 1`; settings are keyword arguments of the study."""

    study: str
    settings: tuple[tuple[str, Any], ...]
    first: int
    count: int

    @property
    def file_name(self) -> str:
        words = [self.study, *(f"{key}={value}" for key, value in self.settings), f"{self.first:05d}+{self.count}"]
        return "-".join(words) + f"-{code_hash()[:12]}.json"

    def run(self) -> dict[str, Any]:
        """The study's record, and the seconds it took."""
        start = time.perf_counter()
        record = STUDIES[self.study](repeats=range(self.first, self.first + self.count), **dict(self.settings))
        return record | {"seconds": time.perf_counter() - start}


@dataclass(frozen=True)
class Cell:
    """All repeats of one study at one setting: columns of [R] numbers, NaN where there was none."""

    study: str
    settings: dict[str, Any]
    truth: dict[str, float]
    columns: Columns


@cache
def code_hash() -> str:
    """sha256 of everything that a record depends on: a change of an estimator makes its shards again, words do not."""
    statistics = Path(__file__).parents[1]
    files = [statistics / f"{name}.py" for name in ESTIMATORS]
    files += [Path(__file__).parent / f"{name}.py" for name in ("generators", "studies")]
    files += [statistics.parent / f"{name}.py" for name in ("normalize", "split")]
    digest = hashlib.sha256(np.__version__.encode())
    for file in sorted(files):
        digest.update(file.name.encode() + b"\0" + without_words(file.read_text(encoding="utf-8")).encode())
    return digest.hexdigest()


def without_words(source: str) -> str:
    """Code without its comments, docstrings and layout."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [s for s in body if not (isinstance(s, ast.Expr) and isinstance(s.value, ast.Constant))]
    return ast.dump(tree)


def plan(size: Size) -> list[Shard]:
    """The shards of a run, the longest first, so that processes end together."""
    full = size == "full"
    shards: list[Shard] = []

    def add(study: str, repeats: int, block: int, **settings: Any) -> None:
        for first in range(0, repeats, block):
            shards.append(Shard(study, tuple(settings.items()), first, min(block, repeats - first)))

    for resampled in (True, False) if full else (True,):
        for seeds in (5, 1) if full else (5,):
            add("null", 400 if full else 60, 20, generator="arm", episodes=50, seeds=seeds, resampled=resampled)
    floors = {300: 40, 200: 40, 100: 200, 50: 200, 20: 10} if full else {100: 20, 50: 30, 20: 2}
    for episodes, repeats in floors.items():
        for generator in GENERATORS:
            add("floors", repeats, 20 if episodes > 150 else 50, generator=generator, episodes=episodes)
    for generator, observations in MODES:
        several = observations in GENERATORS[generator].modes
        repeats = (10 if several else 20) if full else 3
        if full or generator in ("coin", "skewed"):
            what = {"generator": generator, "observations": observations, "episodes": 50}
            add("modes", repeats, 5, **what)
    for rate in (0.0, 0.1, 0.5, 1.0):
        add("curve", 1000 if full else 60, 100, rate=rate)
    for shape in SHAPES:
        for episodes in (5, 8, 10, 20, 50) if full else (8, 20, 50):
            for seeds, folds in ((1, 1), (5, 1), (5, 5)):
                if folds * 2 <= episodes:
                    what = {"shape": shape, "episodes": episodes, "seeds": seeds, "folds": folds}
                    add("differences", 4000 if full else 600, 2000, **what)
                    add("means", 4000 if full else 600, 2000, **what)
        add("means", 4000 if full else 600, 2000, shape=shape, episodes=20, seeds=1, folds=1, weighted=True)
        add("family", 1000 if full else 150, 250, shape=shape, episodes=20, seeds=5)
    for trials in (10, 20, 50, 200) if full else (10, 50):
        add("success", 1, 1, trials=trials)
    return shards


def run_shards(
    shards: Sequence[Shard], folder: Path, *, workers: int = 2, on_done: Callable[[int, int], None] = lambda *_: None
) -> float:
    """Compute what is not in `folder` yet; returns the seconds of all shards together, those found included.

    Each process has one BLAS thread. Ctrl-C waits for the shards at work, some seconds, and leaves whole files only.

    Parameters
    ----------
    on_done : called with (shards done, shards in all), also once before the first.
    """
    folder.mkdir(parents=True, exist_ok=True)
    missing = [shard for shard in shards if not (folder / shard.file_name).exists()]
    on_done(len(shards) - len(missing), len(shards))
    if missing:
        with (
            _one_thread_each(),
            ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), initializer=_ignore_interrupts) as pool,
        ):
            jobs = [pool.submit(_run_and_write, shard, folder / shard.file_name) for shard in missing]
            try:
                for done, job in enumerate(as_completed(jobs), start=len(shards) - len(missing) + 1):
                    job.result()
                    on_done(done, len(shards))
            except BaseException:
                pool.shutdown(wait=True, cancel_futures=True)
                raise
    return sum(_read(folder / shard.file_name)["seconds"] for shard in shards)


def collect(shards: Sequence[Shard], folder: Path) -> list[Cell]:
    """The records of all shards, joined over blocks of repeats."""
    joined: dict[tuple[str, tuple], list[dict[str, Any]]] = {}
    for shard in shards:
        joined.setdefault((shard.study, shard.settings), []).append(_read(folder / shard.file_name))
    return [as_cell(study, dict(settings), records) for (study, settings), records in joined.items()]


def as_cell(study: str, settings: dict[str, Any], records: Sequence[dict[str, Any]]) -> Cell:
    """The records of one study's blocks as one cell."""
    columns = {
        name: np.array([value for record in records for value in record["columns"][name]], np.float64)
        for name in records[0]["columns"]
    }
    return Cell(study, settings, records[0]["truth"], columns)


def _run_and_write(shard: Shard, path: Path) -> None:
    write_json(path, shard.run())


def _read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8"))


def _ignore_interrupts() -> None:
    """Ctrl-C reaches all processes of a terminal; the one that started them decides."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Processes started inside have one BLAS thread, or two of them would share the cores with many."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value

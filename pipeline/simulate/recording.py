"""Recording a scripted demonstrator as a LeRobot data set: the same for every simulator.

What belongs here: making attempts until enough succeeded, and writing them down with a record of how they came about. What
does not: demonstrating, and the words of a card (`pusht_demonstrator`, `so101_demonstrator`, `…_card`).

Same seed, same demonstrations, whatever the number of processes: an attempt depends on its number only.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import asdict, dataclass
from itertools import count
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from pipeline.errors import StoreError
from pipeline.lerobot_format.write import FeatureArrays, write_dataset
from pipeline.store import drafted_folder


class Recorded(Protocol):
    """One successful episode: which of two strategies (0 or 1) it followed, and its actions [n, A]."""

    strategy: int
    action: np.ndarray


@dataclass(frozen=True)
class Recording:
    """How a data set came about. `frames_median` and the range are frames an episode; `interval` is Clopper–Pearson,
    95 %."""

    seed: int
    episodes: int
    frames: int
    frames_shortest: int
    frames_median: float
    frames_longest: int
    attempts: int
    failures: int
    interval: tuple[float, float]
    episodes_by_strategy: tuple[int, int]
    versions: Mapping[str, str]

    @classmethod
    def of(cls, kept: Sequence[Recorded], *, seed: int, attempts: int, versions: Mapping[str, str]) -> "Recording":
        from scipy.stats import binomtest

        interval = binomtest(len(kept), attempts).proportion_ci(0.95, method="exact")
        lengths = [len(demonstration.action) for demonstration in kept]
        second = sum(demonstration.strategy for demonstration in kept)
        return cls(
            seed=seed,
            episodes=len(kept),
            frames=sum(lengths),
            frames_shortest=min(lengths),
            frames_median=float(np.median(lengths)),
            frames_longest=max(lengths),
            attempts=attempts,
            failures=attempts - len(kept),
            interval=(round(float(interval.low), 4), round(float(interval.high), 4)),
            episodes_by_strategy=(len(kept) - second, second),
            versions=dict(versions),
        )

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)

    def words(self) -> dict[str, str]:
        """What every card says in the same words: `made_with`, `starts` (numbers of start states) and `success`."""
        rate = f"{self.episodes} of {self.attempts} = {self.episodes / self.attempts:.3f}"
        interval = f"95 % interval {self.interval[0]:.3f} … {self.interval[1]:.3f} (Clopper–Pearson)"
        left_out = f"{self.failures} failed attempt{'s were' if self.failures != 1 else ' was'} left out"
        first = start_number(self.seed, 0)
        return {
            "made_with": ", ".join(f"{name} {version}" for name, version in self.versions.items()),
            "starts": f"n = {first:,} … {first + self.attempts - 1:,}",
            "success": f"{rate}, {interval}; {left_out}",
        }


@dataclass(frozen=True)
class Demonstrator:
    """A scripted demonstrator, and what is written of it.

    demonstrate  attempts the start state of that number; None where it fails. A function of a module, for other processes
    features     feature key → names, values, dtype of the episodes that were kept, as the writer takes them
    card         README.md for the data set's folder
    versions     the packages that the physics depends on; raises NotApplicableError where one is missing
    """

    demonstrate: Callable[[int], Recorded | None]
    features: Callable[[list], Mapping[str, FeatureArrays]]
    card: Callable[[Recording], str]
    versions: Callable[[], Mapping[str, str]]
    fps: int
    task: str
    robot_type: str


def start_number(seed: int, attempt: int) -> int:
    """The start state of an attempt: 2³² and above, where no roll-out begins."""
    return ((1 + seed) << 32) + attempt


def record(
    demonstrator: Demonstrator,
    out: Path,
    *,
    episodes: int,
    seed: int,
    workers: int,
    on_episode: Callable[[int, int], None] | None,
) -> None:
    """Record demonstrations into a new folder `out`, with a card that says how they were made.

    Attempts are made in order until `episodes` of them have succeeded; the others are left out and counted.

    Args:
        workers: processes; the demonstrations do not depend on it.
        on_episode: called with (recorded, wanted) after every demonstration.

    Raises:
        NotApplicableError: the simulator is not installed.
        StoreError: `out` exists, or cannot be written.
    """
    made_with = demonstrator.versions()
    out = out.absolute()
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise StoreError(f"{out} exists already and is not empty. Give another folder, or remove it first.")
    kept: list[Recorded] = []
    attempts = _attempts(demonstrator.demonstrate, seed, workers)
    tried = 0
    while len(kept) < episodes:
        demonstration = next(attempts)
        tried += 1
        if demonstration is not None:
            kept.append(demonstration)
            if on_episode:
                on_episode(len(kept), episodes)
    attempts.close()
    _write(demonstrator, out, kept, Recording.of(kept, seed=seed, attempts=tried, versions=made_with))


def _attempts(demonstrate: Callable[[int], Recorded | None], seed: int, workers: int) -> Iterator[Recorded | None]:
    """Attempts 0, 1, 2 … in order, a few ahead of what is asked for when there are several processes."""
    numbers = (start_number(seed, attempt) for attempt in count())
    if workers == 1:
        yield from map(demonstrate, numbers)
    # A forked process would inherit threads of whoever calls (torch, Dagster) in the middle of what they were doing.
    executor = ProcessPoolExecutor(workers, mp_context=get_context("spawn"))
    try:
        ahead: list[Future] = [executor.submit(demonstrate, next(numbers)) for _ in range(2 * workers)]
        while True:
            yield ahead.pop(0).result()
            ahead.append(executor.submit(demonstrate, next(numbers)))
    finally:
        executor.shutdown(cancel_futures=True)


def _write(demonstrator: Demonstrator, out: Path, kept: list[Recorded], recording: Recording) -> None:
    """Data, card and `meta/recording.json` under a temporary name beside `out`, then renamed."""
    try:
        with drafted_folder(out) as draft:
            write_dataset(
                draft,
                fps=demonstrator.fps,
                features=demonstrator.features(kept),
                episode_lengths=[len(demonstration.action) for demonstration in kept],
                tasks=[demonstrator.task] * len(kept),
                robot_type=demonstrator.robot_type,
            )
            (draft / "README.md").write_text(demonstrator.card(recording), encoding="utf-8")
            (draft / "meta" / "recording.json").write_text(json.dumps(recording.as_dict(), indent=2) + "\n")
    except OSError as error:
        raise StoreError(f"{out} cannot be written: {error.strerror or error}. Choose another folder.") from None


def last_of(lengths: Sequence[int]) -> np.ndarray:
    """[N, 1] bool, true at the last frame of each episode."""
    return np.concatenate([np.arange(n) == n - 1 for n in lengths])[:, None]

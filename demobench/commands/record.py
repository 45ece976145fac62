"""`demobench record`: demonstrations from a simulator's scripted demonstrator."""

from collections.abc import Callable
from pathlib import Path

from rich.console import Console


def record_pusht(out: Path, episodes: int, seed: int, workers: int) -> None:
    from pipeline.simulate import pusht_demonstrator

    _record(pusht_demonstrator.record_pusht, out, episodes, seed, workers)


def record_so101(out: Path, episodes: int, seed: int, workers: int) -> None:
    from pipeline.simulate import so101_demonstrator

    _record(so101_demonstrator.record_so101, out, episodes, seed, workers)


def _record(record: Callable[..., None], out: Path, episodes: int, seed: int, workers: int) -> None:
    from demobench.progress import counting_bar

    console = Console(highlight=False)
    with counting_bar(console, "demonstrations", episodes) as count:
        record(out, episodes=episodes, seed=seed, workers=workers, on_episode=count)
    console.print(f"Written to {out}. Benchmark it with: demobench run {out}", soft_wrap=True)

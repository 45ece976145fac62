"""`demobench record`: demonstrations from a simulator's scripted demonstrator."""

from pathlib import Path

from rich.console import Console


def record_pusht(out: Path, episodes: int, seed: int, workers: int) -> None:
    from demobench.progress import counting_bar
    from pipeline.simulate import pusht_demonstrator

    console = Console(highlight=False)
    with counting_bar(console, "demonstrations", episodes) as count:
        pusht_demonstrator.record_pusht(out, episodes=episodes, seed=seed, workers=workers, on_episode=count)
    console.print(f"Written to {out}. Benchmark it with: demobench run {out}", soft_wrap=True)

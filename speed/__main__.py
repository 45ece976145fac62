"""`python -m speed`: every measurement, one line each."""

from pathlib import Path

from pipeline.lerobot_format.quality import resolve_semantics
from pipeline.lerobot_format.read import load_source
from pipeline.types import ObservationSet
from pipeline.windows import make_windows
from speed import inspect, loading, recordings, rollouts, statistics, training, windows


def main() -> None:
    demos = load_source("embedded:pusht_sim", name="pusht_sim", config_dir=Path.cwd())
    semantics = resolve_semantics(demos)
    pose = ObservationSet("pose", ("observation.state", "observation.environment_state"))
    everything = tuple(range(demos.episodes))
    print(f"pusht_sim, content hash {demos.content_hash[:12]}: {demos.episodes} episodes, {demos.frames:,} frames")
    for chunk in (1, 16):
        cut = make_windows(
            demos,
            semantics,
            pose,
            everything,
            statistics_episodes=everything,
            protocol="strict",
            history=3,
            chunk=chunk,
        )
        for line in [*windows.measure(cut), *training.measure(cut)]:
            print(line, flush=True)
    for line in rollouts.measure(cut, pose):
        print(line, flush=True)
    for line in recordings.measure(demos, semantics):
        print(line, flush=True)
    for line in [*statistics.measure(demos, semantics, pose), *inspect.measure(), *loading.measure()]:
        print(line)


if __name__ == "__main__":
    main()

"""Floors and intervals: against the obvious ways, and how floors grow with the data."""

import time
from dataclasses import replace

import numpy as np

from pipeline.statistics.comparisons import table_comparisons
from pipeline.statistics.floors import MORE, measure_floors, scored_frames, seen_inputs
from pipeline.statistics.intervals import RESAMPLES, estimate_mean
from pipeline.statistics.metrics import summarise
from pipeline.statistics.neighbours import find_neighbours
from pipeline.types import Demonstrations, EpisodeErrors, Fold, ObservationSet, Semantics, Split
from speed.timing import compare

HORIZONS = (0, 7, 15)
ASKED = 500
"""States whose neighbours are looked for in the plain way, which takes minutes for all of them."""

POLICIES, EPISODES, SEEDS, ACTIONS = 10, 50, 5, 6


def plain_search(inputs: np.ndarray, starts: np.ndarray, scored: np.ndarray, keep: int) -> np.ndarray:
    """The obvious way: for every state the distances to all frames, then the nearest of each other episode."""
    episode = np.searchsorted(starts, scored, side="right") - 1
    found = []
    for frame, own in zip(scored, episode, strict=True):
        distances = ((inputs - inputs[frame]) ** 2).sum(axis=1)
        nearest = np.minimum.reduceat(distances, starts[:-1])
        nearest[own] = np.inf
        found.append(np.sort(nearest)[:keep])
    return np.stack(found)


def tenfold(demos: Demonstrations) -> Demonstrations:
    """The same demonstrations ten times over, each copy moved a little."""
    generator = np.random.default_rng(0)
    columns = {
        key: np.concatenate([v + 1e-3 * v.std(axis=0) * generator.normal(size=v.shape) for _ in range(10)]).astype(
            np.float32
        )
        for key, v in demos.columns.items()
    }
    starts = np.concatenate([[0], np.cumsum(np.tile(demos.lengths, 10))])
    episodes = 10 * demos.episodes
    return replace(
        demos, columns=columns, episode_starts=starts, episode_ids=np.arange(episodes), tasks=demos.tasks * 10,
        timestamps=np.tile(demos.timestamps, 10),
    )  # fmt: skip


def floors_s(demos: Demonstrations, semantics: Semantics, observation_set: ObservationSet) -> float:
    """Seconds for all floors of one observation set with every episode held out: the most states that are ever scored."""
    everything = tuple(range(demos.episodes))
    split = Split((Fold(everything, everything),), 0, "")
    started = time.perf_counter()
    measure_floors(demos, semantics, observation_set, split, history=3, horizons=HORIZONS)
    return time.perf_counter() - started


def random_errors(generator: np.random.Generator, horizons: int) -> EpisodeErrors:
    """Errors as a benchmark of 50 episodes and 5 seeds has them."""
    anchors = np.full((EPISODES, horizons), 300)
    absolute = 300 * generator.gamma(4.0, 0.25, size=(SEEDS, EPISODES, horizons, ACTIONS))
    fold = np.arange(EPISODES) % 5
    scale = np.ones((EPISODES, ACTIONS))
    return EpisodeErrors(np.arange(EPISODES), fold, anchors, absolute, absolute**2, absolute.sum(axis=3), scale)


def table_intervals(errors: list[EpisodeErrors]) -> None:
    """All metrics, intervals and verdicts of a table."""
    for each in errors:
        summarise(each, protocol="strict", fps=30.0, chunk=32)
    rows = [(name, "state", each) for name, each in zip(["hold_still", *"abcdefghi"], errors, strict=True)]
    table_comparisons(rows, "a", 30.0, "strict")


def plain_bootstrap(values: np.ndarray) -> tuple[float, float]:
    """Bootstrap-t, one resample at a time."""
    of_episode = values.mean(axis=0)
    centre, generator = of_episode.mean(), np.random.default_rng(0)
    ts = []
    for _ in range(RESAMPLES):
        drawn = generator.choice(of_episode, len(of_episode))
        ts.append((drawn.mean() - centre) / (drawn.std(ddof=1) / np.sqrt(len(drawn))))
    low, high = np.quantile(ts, [0.025, 0.975])
    se = of_episode.std(ddof=1) / np.sqrt(len(of_episode))
    return centre - high * se, centre - low * se


def measure(demos: Demonstrations, semantics: Semantics, observation_set: ObservationSet) -> list[str]:
    everything = np.arange(demos.episodes)
    inputs = seen_inputs(demos, semantics, observation_set.features, 3)
    scored = scored_frames(demos, everything, 2)[:: max(1, demos.frames // ASKED)]
    starts = demos.episode_starts
    search = compare(
        lambda: find_neighbours(inputs, starts, scored, 0, [0], keep=MORE),
        lambda: plain_search(inputs, starts, scored, MORE),
    )
    once = min(floors_s(demos, semantics, observation_set) for _ in range(3))
    ten = floors_s(tenfold(demos), semantics, observation_set)
    generator = np.random.default_rng(0)
    errors = [random_errors(generator, 32) for _ in range(POLICIES)]
    started = time.perf_counter()
    table_intervals(errors)
    table_s = time.perf_counter() - started
    values = errors[0].absolute[:, :, 0].mean(axis=2)
    interval = compare(lambda: estimate_mean(values), lambda: plain_bootstrap(values))
    return [
        f"neighbours: {search.median:.1f} times as fast as one state at a time ({search.low:.1f} to {search.high:.1f})",
        f"floors of one observation set, {len(HORIZONS)} horizons, {inputs.shape[1]} columns, {demos.frames:,} frames, all held "
        f"out: {once:.1f} s; ten times the frames: {ten / once:.1f} times as long",
        f"all metrics, intervals and verdicts of {POLICIES} policies ({EPISODES} episodes, {SEEDS} seeds): {table_s:.2f} s; "
        f"an interval is {interval.median:.0f} times as fast as resampling in a loop ({interval.low:.0f} to {interval.high:.0f})",
    ]

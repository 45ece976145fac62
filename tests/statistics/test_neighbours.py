"""The search for neighbours: against a slow one, with hypothesis."""

from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.statistics import neighbours
from pipeline.statistics.neighbours import find_neighbours


def slow(inputs, starts, scored, first, horizon, keep):
    """One state, one other episode, one frame at a time."""
    found = []
    for frame in scored:
        own = np.searchsorted(starts, frame, side="right") - 1
        if frame + horizon >= starts[own + 1]:
            continue
        best = []
        for episode in range(len(starts) - 1):
            frames = range(starts[episode] + first, starts[episode + 1] - horizon)
            if episode == own or not len(frames):
                continue
            distances = [float(((inputs[frame].astype(float) - inputs[f]) ** 2).sum()) for f in frames]
            best.append((min(distances), frames[int(np.argmin(distances))]))
        found.append((frame, sorted(best)[:keep]))
    return found


@given(
    lengths=st.lists(st.integers(2, 9), min_size=3, max_size=7),
    columns=st.integers(1, 4),
    first=st.integers(0, 1),
    horizon=st.integers(0, 3),
    keep=st.integers(1, 8),
    seed=st.integers(0, 10**6),
)
@settings(max_examples=60, deadline=None)
def test_it_finds_what_the_slow_search_finds(lengths, columns, first, horizon, keep, seed):
    starts = np.concatenate([[0], np.cumsum(lengths)])
    inputs = np.random.default_rng(seed).normal(size=(starts[-1], columns)).astype(np.float32)
    scored = np.concatenate([np.arange(a + first, b) for a, b in pairwise(starts)])
    found = find_neighbours(inputs, starts, scored, first, [0, horizon], keep=keep)[horizon]
    expected = slow(inputs, starts, scored, first, horizon, keep)
    assert found.scored.tolist() == [frame for frame, _ in expected]
    for frames, distances, (_, best) in zip(found.frames, found.squared_distance, expected, strict=True):
        there = np.isfinite(distances)
        assert there.sum() == min(len(best), found.frames.shape[1])
        assert frames[there].tolist() == [frame for _, frame in best[: there.sum()]]
        np.testing.assert_allclose(distances[there], [d for d, _ in best[: there.sum()]], rtol=1e-5, atol=1e-9)


def test_blocks_do_not_show(monkeypatch):
    starts = np.arange(0, 101, 10)
    inputs = np.random.default_rng(0).normal(size=(100, 3)).astype(np.float32)
    whole = find_neighbours(inputs, starts, np.arange(100), 0, [0, 2], keep=4)
    monkeypatch.setattr(neighbours, "BLOCK_MB", 0.001)
    parts = find_neighbours(inputs, starts, np.arange(100), 0, [0, 2], keep=4)
    for horizon in (0, 2):
        np.testing.assert_array_equal(whole[horizon].frames, parts[horizon].frames)


def test_states_that_nearly_coincide_keep_their_digits():
    # Far from the origin a product of float32 numbers has no digits left for a distance of a thousandth.
    inputs = np.full((6, 2), 1000.0, np.float32)
    inputs[2:4] += np.float32(0.5)
    inputs[4:] += np.float32(0.001)
    found = find_neighbours(inputs, np.array([0, 2, 4, 6]), np.array([0]), 0, [0], keep=2)[0]
    assert found.frames[0, 0] in (4, 5)
    np.testing.assert_allclose(found.squared_distance[0], [2 * 0.001**2, 0.5], rtol=0.1)

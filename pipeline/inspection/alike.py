"""The same recording twice: whole, shifted by some frames, or a part of another.

A few frames of each episode, where it moves most, are looked up among all frames: [action, state], divided by their
spans, through four fixed random projections, which keep equal frames equal and near ones near, so that a tree over them
is small and quick. Two episodes that meet there at one and the same shift are then compared frame by frame.
"""

from collections import Counter
from collections.abc import Iterator, Mapping

import numpy as np

from pipeline.inspection.finding import Finding
from pipeline.inspection.survey import Survey
from pipeline.lerobot_format.parts import blocks
from pipeline.types import ACTION, STATE

PROJECTIONS, ASKED, MOST = 4, 8, 64
"""Numbers a frame is looked up by, frames asked of each episode, and neighbours looked at in one tree."""

NEAR, NEAR_A_MILLION = 6e-3, 2e-3
"""How near counts, in spans: the more frames, the nearer, so that about as many lie within it (and take as long)."""

IN_A_TREE = 2**17
"""Frames of one tree: it takes 50 bytes a frame, so larger data sets are looked through a part at a time."""

BATCH = 1024
"""Frames that are looked up at once; what is found for them takes a kilobyte a frame."""

SAME, OVERLAP = 0.005, 0.6
"""Two stretches are the same recording when their columns differ by 0.5 % of their span on average (people who repeat a
task are never that exact), over at least 60 % of the shorter episode."""


def check_duplicates(survey: Survey) -> Iterator[Finding]:
    scales = {feature: _scales(survey, feature) for feature in (ACTION, STATE)}
    candidates = _candidates(survey, scales)
    told: set[int] = set()
    for (one, other, shift), _ in candidates.most_common():
        if one in told or other in told:
            continue
        frames, difference = _compare(survey, scales, one, other, shift)
        shorter = min(survey.demos.lengths[one], survey.demos.lengths[other])
        if frames < OVERLAP * shorter or difference > SAME:
            continue
        lesser, kept = (one, other) if survey.demos.lengths[one] < survey.demos.lengths[other] else (other, one)
        told.add(lesser)
        by = f", shifted by {abs(shift)} frames" if shift else ""
        exactly = "exactly" if difference == 0 else f"to {difference:.2%} of their range"
        yield Finding(
            "duplicate", survey.id(lesser), None, frames / shorter, OVERLAP,
            f"It is the same recording as episode {survey.id(kept)}{by}: {frames} of its {survey.demos.lengths[lesser]} frames "
            f"agree {exactly}.", grave=True,
        )  # fmt: skip


def _candidates(survey: Survey, scales: Mapping[str, np.ndarray]) -> Counter:
    """(episode, other episode, shift) → how many of the frames asked met there; at least a quarter of them."""
    from scipy.spatial import cKDTree

    if survey.demos.episodes < 2 or not any(scale.any() for scale in scales.values()):
        return Counter()
    asked, where = _asked(survey, scales)
    reach, met = _reach(survey.demos.frames), Counter()
    for _, frames in blocks(survey.starts, IN_A_TREE):
        points = _points(survey, scales, frames)
        tree = cKDTree(points, balanced_tree=False)
        for first in range(0, len(asked), BATCH):
            some = slice(first, first + BATCH)
            distances, found = tree.query(where[some], k=min(MOST, len(points)), distance_upper_bound=reach)
            hits = np.isfinite(distances)
            for row in np.flatnonzero(hits.any(axis=1)):
                met.update(_meetings(survey.starts, int(asked[some][row]), frames.start + found[row][hits[row]]))
    return Counter({pair: count for pair, count in met.items() if count >= ASKED // 4})


def _reach(frames: int) -> float:
    """How near counts among so many frames."""
    return min(NEAR, NEAR_A_MILLION * (1e6 / frames) ** (1 / PROJECTIONS))


def _meetings(starts: np.ndarray, frame: int, near: np.ndarray) -> set[tuple[int, int, int]]:
    """The frame's episode, every other one that has a frame near it, and by how much that is shifted."""
    mine = int(np.searchsorted(starts, frame, side="right")) - 1
    theirs = np.searchsorted(starts, near, side="right") - 1
    shifts = (near - starts[theirs]) - (frame - starts[mine])
    return {_pair(mine, other, shift) for other, shift in zip(theirs, shifts, strict=True) if other != mine}


def _pair(one: int, other: int, shift: int) -> tuple[int, int, int]:
    """The same pair from either side; frame t of the first is frame t + shift of the second."""
    return (int(one), int(other), int(shift)) if one < other else (int(other), int(one), -int(shift))


def _points(survey: Survey, scales: Mapping[str, np.ndarray], frames: slice) -> np.ndarray:
    """[frames, PROJECTIONS]; float64, because a tree copies anything else."""
    living = [(f, int(i)) for f in (ACTION, STATE) for i in np.flatnonzero(scales[f])]
    weights = np.random.default_rng(0).normal(size=(len(living), PROJECTIONS)) / np.sqrt(len(living))
    points = np.zeros((frames.stop - frames.start, PROJECTIONS))
    for (feature, i), weight in zip(living, weights, strict=True):
        scaled = survey.demos.columns[feature][frames, i] / np.float32(scales[feature][i])
        for number in range(PROJECTIONS):
            points[:, number] += np.float32(weight[number]) * scaled
    return points


def _scales(survey: Survey, feature: str) -> np.ndarray:
    """[D] the span of each column, or a quarter of its whole range if that is more; 0 for dead columns."""
    values = survey.demos.columns[feature]
    whole = values.max(axis=0) - values.min(axis=0)
    return np.where(survey.dead[feature], 0.0, np.maximum(survey.spans[feature], whole / 4))


def _asked(survey: Survey, scales: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Global frames to look up, and their points: in each of ASKED parts of an episode the one where it moves most; none
    where it rests.
    """
    asked, where = [], []
    for episodes, block in blocks(survey.starts):
        points = _points(survey, scales, block)
        for episode in range(episodes.start, episodes.stop):
            first = int(survey.starts[episode]) - block.start
            mine = points[first : first + int(survey.demos.lengths[episode])]
            speed = np.abs(np.diff(mine, axis=0)).max(axis=1) if len(mine) > 1 else np.zeros(0)
            for part in np.array_split(np.arange(len(speed)), ASKED):
                if len(part) and speed[part].max() > NEAR_A_MILLION:
                    fastest = first + int(part[np.argmax(speed[part])])
                    asked.append(block.start + fastest)
                    where.append(points[fastest].copy())  # a view would keep all of them
    return np.array(asked, np.int64), np.array(where).reshape(-1, PROJECTIONS)


def _compare(survey: Survey, scales: Mapping[str, np.ndarray], one: int, other: int, shift: int) -> tuple[int, float]:
    """How many frames overlap, and their mean difference in spans."""
    starts, lengths = survey.starts, survey.demos.lengths
    low, high = max(0, -shift), min(int(lengths[one]), int(lengths[other]) - shift)
    if high <= low:
        return 0, np.inf
    total, columns = 0.0, 0
    for feature in (ACTION, STATE):
        keep = scales[feature] > 0
        values = survey.demos.columns[feature]
        a = values[starts[one] + low : starts[one] + high][:, keep]
        b = values[starts[other] + low + shift : starts[other] + high + shift][:, keep]
        total += float((np.abs(a - b) / scales[feature][keep]).mean(axis=0).sum())
        columns += int(keep.sum())
    return high - low, total / max(1, columns)

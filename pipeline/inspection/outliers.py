"""Episodes unlike the others: no demonstration at all, far longer or shorter, begun elsewhere, gone elsewhere.

Start poses and paths are judged by the distance to their nearest other episodes, not to a mean: a task with two starting
places, or two ways round an obstacle, has no outliers.
"""

from collections.abc import Iterator

import numpy as np

from pipeline.inspection.finding import Finding
from pipeline.inspection.survey import Survey, robust
from pipeline.types import STATE

SHORT_S, SHORT_FRAMES = 1.0, 10
"""An episode of less than a second, or of less than ten frames, demonstrates nothing."""

FEWEST = 5
"""Episodes below which nothing is called unlike the others."""

LENGTH, DEVIATIONS = 3.0, 4.0
"""How many times longer or shorter than the median, and how many deviations of the logarithm, an odd length is."""

POINTS = 16
"""Points of a path that are compared, evenly spaced in time between the idle start and the idle end."""

START, PATH = 0.2, 0.25
"""Least distance of an odd start from the next, and of an odd path, in spans of the columns (root mean square)."""

ODD_START, ODD_PATH = 5.0, 2.5
"""How many times the distance of the others (their 80th percentile) an odd start or path is away from its nearest
episodes. On clean data of 12 and 50 episodes it was at most 4.6 times for starts, and 1.9 times for paths."""


REACH = 0.3
"""Share of its span by which a column leaves, in one episode, the range it has in all others together: its span, or a
quarter of what is usual among the state's columns of its unit, for a joint that hardly ever moves."""


def check_short(survey: Survey) -> Iterator[Finding]:
    lengths, starts_idle = survey.demos.lengths, survey.moved[0]
    least = max(SHORT_FRAMES, survey.frames(SHORT_S))
    for episode in np.flatnonzero((lengths < least) & (lengths < 0.5 * np.median(lengths))):
        yield Finding(
            "short", survey.id(episode), None, int(lengths[episode]), least,
            f"It has {lengths[episode]} frames, {survey.seconds(lengths[episode]):.1f} s; the median has {np.median(lengths):g}.",
            grave=True,
        )  # fmt: skip
    for episode in np.flatnonzero((starts_idle >= lengths) & (lengths >= least)):
        yield Finding(
            "short", survey.id(episode), None, 0.0, None,
            f"Nothing moves in all of its {lengths[episode]} frames ({survey.seconds(lengths[episode]):.1f} s).", grave=True,
        )  # fmt: skip


def check_outliers(survey: Survey) -> Iterator[Finding]:
    if survey.demos.episodes < FEWEST:
        return
    yield from _odd_lengths(survey)
    columns = np.flatnonzero(~survey.dead[STATE] & (survey.spans[STATE] > 0))
    if not len(columns):
        return
    paths = _paths(survey, columns)
    yield from _odd_starts(survey, columns, paths[:, 0])
    yield from _odd_paths(survey, columns, paths)
    yield from _odd_reaches(survey)


def _odd_lengths(survey: Survey) -> Iterator[Finding]:
    lengths = survey.demos.lengths
    centre, deviation = robust(np.log(lengths))
    limit = max(np.log(LENGTH), DEVIATIONS * deviation)
    least = max(SHORT_FRAMES, survey.frames(SHORT_S))
    for episode in np.flatnonzero((np.abs(np.log(lengths) - centre) > limit) & (lengths >= least)):
        ratio = lengths[episode] / np.exp(centre)
        words = f"{ratio:.1f} times" if ratio > 1 else f"{ratio:.0%} of"
        yield Finding(
            "outlier", survey.id(episode), None, int(lengths[episode]), float(np.exp(centre + np.sign(ratio - 1) * limit)),
            f"It has {lengths[episode]} frames ({survey.seconds(lengths[episode]):.1f} s), {words} the median of "
            f"{np.exp(centre):.0f}.",
        )  # fmt: skip


def _paths(survey: Survey, columns: np.ndarray) -> np.ndarray:
    """[E, POINTS, C (cosine and sine apart for angles)] in spans, from the last idle frame at the start to the first at
    the end.
    """
    begin, end = survey.moved
    first = survey.starts[:-1] + np.where(begin < survey.demos.lengths, begin, 0)
    last = np.maximum(survey.starts[1:] - 1 - np.where(end < survey.demos.lengths, end, 0), first)
    where = np.rint(first[:, None] + np.linspace(0, 1, POINTS) * (last - first)[:, None]).astype(np.int64)
    parts = []
    for column in columns:
        values = survey.demos.columns[STATE][:, column][where].astype(np.float64)
        if survey.semantics.circular[STATE][column]:
            parts += [np.cos(values) / 2, np.sin(values) / 2]
        else:
            parts.append(values / survey.spans[STATE][column])
    return np.stack(parts, axis=-1)


def _nearest(vectors: np.ndarray) -> np.ndarray:
    """[E] root mean square distance to the nearest others: to the third (to a tenth of the episodes where they are few)."""
    from scipy.spatial import cKDTree

    neighbours = int(np.clip(len(vectors) // 10, 1, 3))
    flat = vectors.reshape(len(vectors), -1)
    distances, _ = cKDTree(flat).query(flat, k=neighbours + 1)
    return distances[:, -1] / np.sqrt(flat.shape[1])


def _odd(distance: np.ndarray, least: float, times: float) -> tuple[np.ndarray, float]:
    """Which distances stand out, and from what on."""
    limit = max(least, times * float(np.quantile(distance, 0.8)))
    return np.flatnonzero(distance > limit), limit


def _odd_starts(survey: Survey, columns: np.ndarray, starts: np.ndarray) -> Iterator[Finding]:
    distance = _nearest(starts)
    odd, limit = _odd(distance, START, ODD_START)
    usual = [float(np.median(survey.demos.columns[STATE][survey.starts[:-1], c])) for c in columns]
    for episode in odd:
        own = survey.demos.columns[STATE][survey.starts[episode], columns]
        far = np.abs(own - usual) / survey.spans[STATE][columns]
        column = survey.column(STATE, int(columns[np.argmax(far)]))
        yield Finding(
            "outlier", survey.id(episode), column.key, float(distance[episode]), limit,
            f"It starts where no other does: {column.key} is {own[np.argmax(far)]:.4g}, usually {usual[int(np.argmax(far))]:.4g}.",
        )  # fmt: skip


def _odd_paths(survey: Survey, columns: np.ndarray, paths: np.ndarray) -> Iterator[Finding]:
    distance = _nearest(paths)
    odd, limit = _odd(distance, PATH, ODD_PATH)
    for episode in odd:
        yield Finding(
            "outlier", survey.id(episode), None, float(distance[episode]), limit,
            f"Its path is unlike the others': {distance[episode]:.0%} of the joints' ranges from the nearest, where the median "
            f"episode is {np.median(distance):.0%} away.",
        )  # fmt: skip


def _odd_reaches(survey: Survey) -> Iterator[Finding]:
    """Columns that one episode takes further than any other."""
    units, living = survey.demos.features[STATE].units, np.flatnonzero(~survey.dead[STATE])
    for column in survey.living(STATE):
        if column.circular:
            continue
        like = [survey.spans[STATE][i] for i in living if units[i] == column.unit]
        scale = max(column.span, 0.25 * float(np.percentile(like, 50, method="lower")))
        highs = np.maximum.reduceat(column.values, survey.starts[:-1])
        lows = np.minimum.reduceat(column.values, survey.starts[:-1])
        for ends, words, sign in ((highs, "above", 1), (lows, "below", -1)):
            order = np.argsort(-sign * ends, kind="stable")
            first, second = float(ends[order[0]]), float(ends[order[1]])
            if abs(first - second) > REACH * scale:
                yield Finding(
                    "outlier", survey.id(order[0]), column.key, first, second + sign * REACH * scale,
                    f"{column.key} reaches {first:.4g}; in no other episode is it {words} {second:.4g}.",
                )  # fmt: skip

"""Are predictions aligned with what was recorded? What is wrong gets a name, instead of a bad score.

What belongs here: faults that turn a good policy's predictions into nonsense: columns permuted, another unit, normalised numbers,
a constant offset, shifted in time, episodes mixed up. What does not: judging a policy.

A poor policy must never be refused. So a refusal needs a *much better fit of something else*: the same numbers read in another
order, unit, frame or episode explain what was recorded, and as they stand they do not. The mean action, standing still and noise
explain nothing in any reading. What an honest policy can do as well (lag behind, be off by a constant) is only warned of.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.lerobot_format.quality import dead_columns
from pipeline.normalize import circular_columns
from pipeline.types import ACTION, Demonstrations, Semantics

FITS, MUCH_BETTER = 0.75, 4.0
"""A reading fits where it explains three quarters of the variance, and fits much better where it leaves a quarter of the error."""
CORRELATED, LESS_CORRELATED = 0.8, 0.3
"""Columns are permuted where each correlates so much with another one, and by so much less with its own."""
UNITS = {
    np.pi / 180: "radians are to degrees",
    180 / np.pi: "degrees are to radians",
    1e-3: "metres are to millimetres",
    1e3: "millimetres are to metres",
    1e-2: "metres are to centimetres, or shares to percent",
    1e2: "centimetres are to metres, or percent to shares",
}
"""Factors between units, and what they are like; which unit the data has is for the data to say."""
MOST_SHIFT = 10
FRAMES_OF_EPISODE = 64
"""Frames compared of each pair of episodes."""
FEWEST_EPISODES = 3


@dataclass(frozen=True)
class Faults:
    """What was found: `refuse` keeps the predictions from being scored, `warn` is shown beside the score."""

    refuse: tuple[str, ...]
    warn: tuple[str, ...]


@dataclass(frozen=True)
class _Pair:
    """First actions predicted and recorded, [M, C] float64 over the columns that move and are no angles that wrap.

    deviation  [C] of the recorded column      names, units [C]
    """

    predicted: np.ndarray
    recorded: np.ndarray
    deviation: np.ndarray
    names: tuple[str, ...]
    units: tuple[str | None, ...]

    def error(self, predicted: np.ndarray, recorded: np.ndarray) -> np.ndarray:
        """[C] mean squared difference in variances of the column: 1 for its mean, 0 for itself."""
        return (((predicted - recorded) / self.deviation) ** 2).mean(axis=0)


def check_alignment(anchors: np.ndarray, actions: np.ndarray, demos: Demonstrations, semantics: Semantics) -> Faults:
    """Look for what makes predictions nonsense.

    Parameters
    ----------
    anchors : [M] global frames, ascending, whole episodes.
    actions : [M, K, A] one prediction an anchor (the mean over seeds and samples).
    """
    recorded = demos.columns[ACTION][anchors].astype(np.float64)
    first = actions[:, 0].astype(np.float64)
    use = ~(dead_columns(demos, ACTION, anchors) | circular_columns(demos, semantics, [ACTION]))
    use &= recorded.std(axis=0) > 0
    if not use.any() or len(anchors) < 10:
        return Faults((), ())
    names, units = (
        tuple(one for one, used in zip(said, use, strict=True) if used)
        for said in (demos.features[ACTION].names, demos.features[ACTION].units)
    )
    pair = _Pair(first[:, use], recorded[:, use], recorded[:, use].std(axis=0), names, units)
    refuse = _permuted(pair) or _normalised(pair, demos, use) or _scaled(pair)
    refuse = refuse or _early(pair, anchors, demos, use) or _mixed_up(pair, anchors, demos, use)
    if refuse:
        return Faults(tuple(refuse), ())
    warn = [*_exact(pair), *_offset(pair), *_looks_normalised(pair), *_looks_permuted(pair)]
    return Faults((), (*warn, *_late(pair, anchors, demos, use)))


def _correlations(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[C, C] correlation of each column of a with each of b; 0 for a column that does not move."""
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    a_size, b_size = np.sqrt((a**2).sum(axis=0)), np.sqrt((b**2).sum(axis=0))
    still = a_size <= 1e-9 * np.sqrt((b_size**2).mean())
    found = (a.T @ b) / np.where(still, np.inf, a_size)[:, None] / b_size
    return np.nan_to_num(found)


def _permuted(pair: _Pair) -> list[str]:
    """Columns in another order: in their new places they fit, in their own they do not."""
    place, moved = _places(pair)
    undone = pair.predicted.copy()
    undone[:, place[moved]] = pair.predicted[:, moved]
    new, own = (pair.error(predicted, pair.recorded)[moved] for predicted in (undone, pair.predicted))
    if not moved.any() or (new > 1 - FITS).any() or (own < MUCH_BETTER * new).any():
        return []
    return [f"action columns are permuted: {_places_words(pair)}. Expected the order {', '.join(pair.names)}"]


def _looks_permuted(pair: _Pair) -> list[str]:
    """Columns that go with others more than with their own, and fit neither: a policy that learnt little does that as well."""
    _, moved = _places(pair)
    return [f"are action columns permuted? {_places_words(pair)}; but they fit no place"] if moved.any() else []


def _places(pair: _Pair) -> tuple[np.ndarray, np.ndarray]:
    """[C] the column that each correlates with in the best assignment, and [C] bool, those that moved for certain. Every one
    must correlate with its new place: one that merely resembles a neighbour is not enough.
    """
    from scipy.optimize import linear_sum_assignment

    correlation = _correlations(pair.predicted, pair.recorded)
    _, place = linear_sum_assignment(-correlation)
    columns = np.arange(len(place))
    moved = (
        (place != columns)
        & (correlation[columns, place] >= CORRELATED)
        & (correlation[columns, place] - correlation.diagonal() >= LESS_CORRELATED)
    )
    return place, moved & np.isin(place, columns[moved])  # whole cycles only


def _places_words(pair: _Pair) -> str:
    place, moved = _places(pair)
    correlation = _correlations(pair.predicted, pair.recorded)
    return ", ".join(
        f"{pair.names[i]} holds {pair.names[place[i]]} (correlation {correlation[i, place[i]]:.2f}, with its own "
        f"{correlation[i, i]:.2f})"
        for i in np.flatnonzero(moved)
    )


def _normalised(pair: _Pair, demos: Demonstrations, use: np.ndarray) -> list[str]:
    """Normalised numbers: undoing what trainers do, with the data's own statistics, explains them."""
    actions = demos.columns[ACTION][:, use].astype(np.float64)
    low, high = actions.min(axis=0), actions.max(axis=0)
    readings = {
        "mean 0 and deviation 1": pair.predicted * actions.std(axis=0) + actions.mean(axis=0),
        "−1 … 1 between minimum and maximum": (pair.predicted + 1) / 2 * (high - low) + low,
        "0 … 1 between minimum and maximum": pair.predicted * (high - low) + low,
    }
    as_is = np.median(pair.error(pair.predicted, pair.recorded))
    undone = {words: np.median(pair.error(reading, pair.recorded)) for words, reading in readings.items()}
    words = min(undone, key=undone.get)
    if undone[words] > 1 - FITS or as_is < MUCH_BETTER * undone[words] or as_is <= 0.5:
        return []
    return [
        f"the predictions are normalised ({words}): undone, they leave {_share(undone[words], 1)} of the variance unexplained. "
        "Apply the policy's own un-normalising (LeRobot: its postprocessor) before writing them"
    ]


def _scaled(pair: _Pair) -> list[str]:
    """Another unit: divided by the factor between two units, the predictions explain what was recorded.

    Zero moves with the unit, so a policy that hardly dares to leave the mean does not look like one in radians; where the mean
    is zero (velocities) two columns at once must.
    """
    as_is = pair.error(pair.predicted, pair.recorded)
    undone = {factor: pair.error(pair.predicted / factor, pair.recorded) for factor in UNITS}
    so = {factor: (error <= 1 - FITS) & (as_is >= MUCH_BETTER * error) for factor, error in undone.items()}
    factor = max(UNITS, key=lambda f: (so[f].sum(), -np.median(undone[f])))
    found = so[factor]
    if not found.any() or (factor < 1 and found.sum() < min(2, len(found))):
        return []
    columns = ", ".join(name for name, there in zip(pair.names, found, strict=True) if there)
    return [
        f"the predictions of {columns} are in another unit than the data set ({_units_words(pair, found)}): divided by "
        f"{factor:.4g}, as {UNITS[factor]}, they leave {_share(np.median(undone[factor][found]), 1)} of the variance unexplained. "
        "Convert them to the data set's unit"
    ]


def _units_words(pair: _Pair, found: np.ndarray) -> str:
    """What the data set says of the unit of some columns."""
    units = dict.fromkeys(unit for unit, there in zip(pair.units, found, strict=True) if there)
    if not any(units):
        return "which does not state its own"
    return f"which has {' and '.join(unit or 'one that it does not state' for unit in units)}"


def _shift_errors(pair: _Pair, anchors: np.ndarray, demos: Demonstrations, use: np.ndarray) -> dict[int, float]:
    """Mean error (in variances) against the action recorded n frames later, all n on the same anchors."""
    starts, of_anchor = demos.episode_starts, demos.episode_of_frame[anchors]
    inside = (anchors - MOST_SHIFT >= starts[of_anchor]) & (anchors + MOST_SHIFT < starts[of_anchor + 1])
    if inside.sum() < 10:
        return {}
    actions = demos.columns[ACTION]
    shifts = range(-MOST_SHIFT, MOST_SHIFT + 1)
    later = {n: actions[anchors[inside] + n][:, use].astype(np.float64) for n in shifts}
    return {n: float(pair.error(pair.predicted[inside], later[n]).mean()) for n in shifts}


def _early(pair: _Pair, anchors: np.ndarray, demos: Demonstrations, use: np.ndarray) -> list[str]:
    """Predictions that fit the future much better than the present: no policy knows it better, so rows are shifted."""
    errors = _shift_errors(pair, anchors, demos, use)
    best = min(errors, key=errors.get, default=0)
    if best <= 0 or errors[best] > 1 - FITS or errors[0] < MUCH_BETTER * errors[best]:
        return []
    share = _share(errors[best], errors[0])
    return [
        f"the predictions are shifted in time: they fit the actions recorded {_frames(best)} later, with {share} of the error. "
        f"The first action of a row is that of its own frame; add {best} to frame_index, or start the chunk there"
    ]


def _late(pair: _Pair, anchors: np.ndarray, demos: Demonstrations, use: np.ndarray) -> list[str]:
    """The same into the past is only worth a word: holding still, and repeating the last action, lag behind honestly."""
    errors = _shift_errors(pair, anchors, demos, use)
    best = min(errors, key=errors.get, default=0)
    if best >= 0 or errors[best] > 1 - FITS or errors[0] < MUCH_BETTER * errors[best]:
        return []
    share = _share(errors[best], errors[0])
    return [
        f"the predictions fit the actions recorded {_frames(-best)} earlier, with {share} of the error: either "
        "frame_index is off, or the policy repeats what it saw, as holding still does"
    ]


def _frames(count: int) -> str:
    return f"{count} frame{'s' * (count != 1)}"


def _share(part: float, whole: float) -> str:
    share = 100 * part / whole
    return f"{share:.0f} %" if share >= 1 else "less than 1 %"


def _mixed_up(pair: _Pair, anchors: np.ndarray, demos: Demonstrations, use: np.ndarray) -> list[str]:
    """Episodes under the wrong number: each fits another one much better, no two the same, and its own no better than any.

    Replaying one recording everywhere, or copying the nearest one, is honest: the first points at one episode for all, the
    second is near its own episode as well.
    """
    episodes = np.unique(demos.episode_of_frame[anchors])
    if len(episodes) < FEWEST_EPISODES:
        return []
    errors = _episode_errors(pair, anchors, episodes, demos, use)
    own, best = errors[np.arange(len(episodes)), episodes], errors.argmin(axis=1)
    least = errors.min(axis=1)
    wrong = (best != episodes) & (least <= 1 - FITS) & (own >= MUCH_BETTER * least)
    wrong &= own >= 0.5 * np.median(errors, axis=1)
    several = wrong.sum() >= FEWEST_EPISODES and wrong.sum() > len(episodes) / 2
    if not several or len(np.unique(best[wrong])) < 0.9 * wrong.sum():
        return []
    ids = demos.episode_ids
    some = ", ".join(f"{ids[e]} fits {ids[b]}" for e, b in list(zip(episodes[wrong], best[wrong], strict=True))[:3])
    return [
        f"episodes are mixed up: {wrong.sum()} of {len(episodes)} fit another episode much better than their own ({some}). "
        "episode_index must be the recorded number, not the position in a list"
    ]


def _episode_errors(
    pair: _Pair, anchors: np.ndarray, episodes: np.ndarray, demos: Demonstrations, use: np.ndarray
) -> np.ndarray:
    """[covered, E] error of the predictions of one episode against the actions of another at the same frame numbers."""
    actions = demos.columns[ACTION][:, use] / pair.deviation
    found = np.full((len(episodes), demos.episodes), np.inf)
    of_anchor, in_episode = demos.episode_of_frame[anchors], demos.frame_in_episode[anchors]
    for row, episode in enumerate(episodes):
        here = np.flatnonzero(of_anchor == episode)
        here = here[np.linspace(0, len(here) - 1, min(FRAMES_OF_EPISODE, len(here))).astype(int)]
        frames = demos.episode_starts[:-1, None] + in_episode[here]
        there = in_episode[here] < demos.lengths[:, None]
        target = actions[np.minimum(frames, demos.frames - 1)]
        error = ((pair.predicted[here] / pair.deviation - target) ** 2).mean(axis=2)
        enough = there.sum(axis=1) >= len(here) / 2
        found[row, enough] = ((error * there).sum(axis=1)[enough]) / there.sum(axis=1)[enough]
    return found


def _exact(pair: _Pair) -> list[str]:
    if (np.abs(pair.predicted - pair.recorded) <= 1e-6 * pair.deviation).all():
        return [
            "every first action is exactly the one recorded: does the file hold the recording instead of predictions?"
        ]
    return []


def _offset(pair: _Pair) -> list[str]:
    """A constant makes nine tenths of a column's error and is more than the column's own deviation."""
    off = (pair.predicted - pair.recorded).mean(axis=0)
    spread = (pair.predicted - pair.recorded).std(axis=0)
    so = (np.abs(off) > pair.deviation) & (np.abs(off) > 3 * spread)
    words = [f"{name} by {value:+.4g}" for name, value, found in zip(pair.names, off, so, strict=True) if found]
    return [f"off by a constant: {', '.join(words)}. Is zero elsewhere, or the unit another?"] if words else []


def _looks_normalised(pair: _Pair) -> list[str]:
    """Mean 0 and deviation 1 in every column, where the data is far from that; they fit nothing, so it may be noise."""
    mean, deviation = pair.predicted.mean(axis=0), pair.predicted.std(axis=0)
    like = (np.abs(mean) < 0.5) & (deviation > 0.3) & (deviation < 2)
    far = (np.abs(pair.recorded.mean(axis=0)) > 3) | (pair.deviation > 5) | (pair.deviation < 0.1)
    if len(like) > 1 and like.all() and far.all():
        return [
            "every predicted column has about mean 0 and deviation 1, the data has not: are the predictions normalised?"
        ]
    return []


def mean_of(actions: np.ndarray, circular: np.ndarray, axes: Sequence[int]) -> np.ndarray:
    """The mean over some axes of actions […, A]; of angles the direction of the mean of their unit vectors."""
    values = actions.astype(np.float64)
    mean = values.mean(axis=tuple(axes))
    angles = values[..., circular]
    mean[..., circular] = np.arctan2(np.sin(angles).mean(axis=tuple(axes)), np.cos(angles).mean(axis=tuple(axes)))
    return mean.astype(np.float32)

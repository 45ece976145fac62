"""The multimodality floor: how small can the error of any deterministic policy of an observation set get?

People do different things in the same place, so a policy that gives one answer there is wrong about some of them. Recorded
actions are compared with those of the nearest frames in *other* episodes, and what is left when the distance between the
frames is extrapolated to nothing is the floor. What belongs here: the estimators, how sure they are, and when they refuse.
What does not: policies' errors (`brackets`), the notebook's estimator (`radius`).

`gamma`, for the squared error: least squares of γ_k, half the mean squared difference of the actions, on δ_k, the mean squared
distance of the states, over the k-th nearest of the other episodes; Γ is the intercept (Stefánsson, Končar & Jones 1997;
Evans & Jones 2002). `pair_distance`, for L1 and L2 errors: with D₀ the mean distance of two actions at one and the same
observation, D₀/2 ≤ floor ≤ D₀ whatever their distribution: any point's mean distance to the actions is at least half of
theirs to each other (triangle inequality), and a randomly chosen action is one such point.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np

from pipeline.lerobot_format.kinds import wrap
from pipeline.lerobot_format.quality import dead_columns
from pipeline.normalize import circular_columns, fit_scaler
from pipeline.statistics.intervals import FEWEST, t_quantile
from pipeline.statistics.neighbours import Neighbours, find_neighbours
from pipeline.types import ACTION, Demonstrations, FloorEstimate, ObservationSet, Semantics, Split

NEAREST = 10
"""The neighbours of a state that count: one frame of each of so many other episodes."""

FEWER, MORE = 5, 20
"""Other fits: over fewer, to see how straight the line is; over more, to see whether it is one."""

FEWEST_EPISODES = 30
MOST_SCORED = 20_000
MOST_ELSEWHERE = 8_000
"""States at which the law of the extrapolation is looked at where only some episodes are held out."""

MOST_REMOVED = 0.5
"""The share of the nearest neighbours' value that extrapolation may take away."""

CURVED = 0.12
"""The share of an estimate that a jump in the mean action may account for, before the estimate is refused."""

TOLD_APART, TOLD_APART_TOGETHER = 1.35, 1.5
"""How many times worse the law of a jump must fit, in mean squared residuals, to be ruled out: one column, all together."""

SHARE_IN_DOUBT = 0.1
"""Of what extrapolation takes away, so much joins the interval."""

TOO_FAR = (
    "the nearest states differ too much: extrapolation to distance zero would take away {:.0f} % of what they show"
)
A_JUMP = (
    "the mean action may jump from state to state (a gripper that closes): a jump could make up {} of the estimate, and the "
    "data cannot tell"
)
NOTHING: dict[str, None] = {"value": None, "upper": None, "interval": None}

Loss = Literal["rmse", "mae", "l2"]


@dataclass(frozen=True)
class States:
    """What every horizon and loss of one observation set is measured on.

    inputs   [N, D] what a policy of the set sees at each frame, every column of unit deviation
    scored   [M] global frames where policies are scored
    first    the first frame of an episode that can be an anchor
    """

    demos: Demonstrations
    circular: np.ndarray
    observation_set: ObservationSet
    history: int
    first: int
    inputs: np.ndarray
    scored: np.ndarray

    @cached_property
    def episode(self) -> np.ndarray:
        """[N] the episode of each frame."""
        return self.demos.episode_of_frame

    @cached_property
    def actions(self) -> np.ndarray:
        return self.demos.columns[ACTION].astype(np.float64)


def measure_floors(
    demos: Demonstrations,
    semantics: Semantics,
    observation_set: ObservationSet,
    split: Split,
    *,
    history: int,
    horizons: Sequence[int],
) -> list[FloorEstimate]:
    """The floors of one observation set on the states where policies are scored.

    Parameters
    ----------
    split : its held-out episodes are scored (at most 20,000 states, the same share of each episode); neighbours come from
        all other episodes. A floor is no policy: nothing leaks.
    history : the benchmark's, which decides where anchors are; the frames seen are the observation set's own.
    horizons : how many steps after the state the action is taken; both members of a pair need it inside their episode.

    Returns
    -------
    list of FloorEstimate : for every horizon gamma (rmse) and pair distance (mae, l2), each with a value or a refusal.
    """
    states = prepare_states(demos, semantics, observation_set, split, history=history)
    reason = _nothing_to_measure(states)
    horizons = sorted(set(horizons))
    possible = [h for h in horizons if _reaches(states, h)] if reason is None else []
    found = _search(states, states.scored, possible)
    laws = found
    if len(np.unique(states.episode[states.scored])) < demos.episodes:
        # Whether a mean jumps is a property of the data, not of the share of them that is scored: all of them can tell.
        everywhere = scored_frames(demos, np.arange(demos.episodes), states.first, MOST_ELSEWHERE)
        laws = _search(states, everywhere, possible)
    estimates = []
    for horizon in horizons:
        if horizon in found:
            estimates += _estimate(states, found[horizon], laws[horizon], horizon)
        else:
            why = reason or f"no two episodes have an action {horizon} steps after a state that is scored"
            estimates += [_refusal(states, horizon, loss, why) for loss in ("rmse", "mae", "l2")]
    return estimates


def _search(states: States, scored: np.ndarray, horizons: Sequence[int]) -> dict[int, Neighbours]:
    return find_neighbours(states.inputs, states.demos.episode_starts, scored, states.first, horizons, keep=MORE)


def prepare_states(
    demos: Demonstrations, semantics: Semantics, observation_set: ObservationSet, split: Split, *, history: int
) -> States:
    """Scale the observation set and choose the scored states."""
    own = observation_set.history or history
    held_out = np.unique([e for fold in split.folds for e in fold.test])
    return States(
        demos,
        circular_columns(demos, semantics, [ACTION]),
        observation_set,
        own,
        history - 1,
        seen_inputs(demos, semantics, observation_set.features, own),
        scored_frames(demos, held_out, history - 1),
    )


def seen_inputs(demos: Demonstrations, semantics: Semantics, features: Sequence[str], frames: int) -> np.ndarray:
    """[N, D] float32: an observation set's columns at each frame, then their change from frame to frame.

    The changes hold the same information as the earlier frames, and to a floor only information matters. But neighbours are
    found by distance: among copies of the position a velocity would hardly count. Every column has unit deviation.
    """
    values = np.concatenate([demos.columns[key] for key in features], axis=1)
    circular = circular_columns(demos, semantics, features)
    dead = np.concatenate([dead_columns(demos, key) for key in features])
    now = fit_scaler(values, circular, dead).encode(values)
    blocks = [now]
    first = np.repeat(demos.episode_starts[:-1], demos.lengths)
    for back in range(1, frames):
        later, earlier = (np.maximum(np.arange(demos.frames) - ago, first) for ago in (back - 1, back))
        change = now[later] - now[earlier]
        blocks.append(change / np.where(change.std(axis=0) > 1e-9, change.std(axis=0), 1.0))
    return np.concatenate(blocks, axis=1).astype(np.float32)


def scored_frames(demos: Demonstrations, episodes: np.ndarray, first: int, most: int = MOST_SCORED) -> np.ndarray:
    """[M] global frames, at most `most`: the same share of each episode's anchors, evenly spaced."""
    anchors = [np.arange(demos.episode_starts[e] + first, demos.episode_starts[e + 1]) for e in episodes]
    share = min(1.0, most / max(1, sum(len(a) for a in anchors)))
    counts = [max(1, int(share * len(a))) if len(a) else 0 for a in anchors]
    spaced = [a[np.linspace(0, len(a) - 1, n).round().astype(np.int64)] for a, n in zip(anchors, counts, strict=True)]
    return np.concatenate([np.empty(0, np.int64), *spaced])


def _nothing_to_measure(states: States) -> str | None:
    demos, held_out = states.demos, len(np.unique(states.episode[states.scored]))
    if demos.episodes < FEWEST_EPISODES:
        return f"{demos.episodes} episodes are too few to find neighbours in; a floor needs {FEWEST_EPISODES}"
    if held_out < FEWEST:
        return f"{held_out} held-out episodes are too few to tell how sure a floor is; it needs {FEWEST}"
    if not demos.columns[ACTION].std(axis=0).any():
        return "the recorded actions never change, so there is nothing to disagree about"
    return None


def _reaches(states: States, horizon: int) -> bool:
    lengths = states.demos.lengths
    scored = np.unique(states.episode[states.scored])
    return (lengths - states.first > horizon).sum() > NEAREST and bool((lengths[scored] - states.first > horizon).any())


# From neighbours to estimates -----------------------------------------------------------------------------------------


def _estimate(states: States, found: Neighbours, laws: Neighbours, horizon: int) -> list[FloorEstimate]:
    pairs, difference = _pairs(states, found), _differences(states, found, horizon)
    squared = difference**2
    everywhere, apart_everywhere = pairs, squared
    if laws is not found:
        everywhere, apart_everywhere = _pairs(states, laws), _differences(states, laws, horizon) ** 2
    columns = 0.5 * np.tensordot(everywhere.weights, apart_everywhere, axes=1) / squared.shape[2]
    jump = _jump(everywhere.curve, columns)
    estimates = [_judge(states, pairs, horizon, "rmse", 0.5 * squared.mean(axis=2), jump)]
    for loss, apart in (("mae", np.abs(difference).mean(axis=2)), ("l2", np.sqrt(squared.sum(axis=2)))):
        mean = pairs.weights @ apart
        # The square of a mean, pair by pair: its average is mean², and it moves with a pair as the square of the mean does.
        estimates.append(_judge(states, pairs, horizon, loss, mean**2 + 2 * mean * (apart - mean)))
    return estimates


def _differences(states: States, found: Neighbours, horizon: int) -> np.ndarray:
    """[M, K, A] the action of a scored state less that of its neighbour, `horizon` steps later; angles wrapped."""
    difference = states.actions[found.scored + horizon][:, None] - states.actions[found.frames + horizon]
    difference[..., states.circular] = wrap(difference[..., states.circular])
    return difference


@dataclass(frozen=True)
class Pairs:
    """Scored states with their neighbours, nearest first.

    weights [M] sum to one, every episode counts once     distance [M, K] squared
    scored [M, K], other [M, K] the episodes of a pair    episodes E
    """

    weights: np.ndarray
    distance: np.ndarray
    scored: np.ndarray
    other: np.ndarray
    episodes: int

    @property
    def df(self) -> int:
        """Degrees of freedom: episodes that are scored, less one."""
        return len(np.unique(self.scored)) - 1

    @cached_property
    def curve(self) -> np.ndarray:
        """[K] δ_k, the mean squared distance of the k-th nearest."""
        return self.weights @ self.distance

    def variance(self, moved: np.ndarray) -> tuple[np.ndarray, float]:
        """How much each episode [E] and each pair of episodes moved an estimate, from what each pair of states [M, K] did.

        Noise of a pair of episodes is in the influence of both, so the sum of squared influences (the infinitesimal
        jackknife) counts it twice; the second number is what to take off again (Aronow, Samii & Assenova 2015).
        """
        cell = (self.scored * self.episodes + self.other)[:, : moved.shape[1]]
        cells = np.bincount(cell.ravel(), moved.ravel(), self.episodes**2).reshape(self.episodes, self.episodes)
        both = cells + cells.T
        return both.sum(axis=0), float((np.triu(both, 1) ** 2).sum())


def _pairs(states: States, found: Neighbours) -> Pairs:
    own = states.episode[found.scored]
    weights = 1.0 / np.bincount(own)[own]
    return Pairs(
        weights / weights.sum(),
        found.squared_distance,
        np.broadcast_to(own[:, None], found.frames.shape),
        states.episode[found.frames],
        states.demos.episodes,
    )


def standard_error(influence: np.ndarray, counted_twice: float = 0.0) -> float:
    """From the influence of each episode [E]; never less than if all of it were counted twice."""
    jackknife = float((influence**2).sum())
    episodes = len(influence)
    return float(np.sqrt(max(jackknife - counted_twice, jackknife / 2) * episodes / (episodes - 1)))


def _line(distance: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Least squares of value [K] on distance [K]: the weights [K] whose product with value is the intercept, the slope, and
    the mean squared residual."""
    centred = distance - distance.mean()
    square = float((centred**2).sum()) or 1.0
    slope = float(centred @ value) / square
    weights = 1 / len(value) - distance.mean() * centred / square
    residual = value - value.mean() - slope * centred
    return weights, slope, float((residual**2).mean())


def _judge(
    states: States, pairs: Pairs, horizon: int, loss: Loss, apart: np.ndarray, jump: float = 0.0
) -> FloorEstimate:
    """One estimate on the squared scale (Γ or D₀²) from the pairs' values [M, K], or the reason why there is none.

    `jump` is how much of it a jump in the mean action may account for.
    """
    delta, value = pairs.curve, pairs.weights @ apart
    weights, slope, _ = _line(delta[:NEAREST], value[:NEAREST])
    estimate = float(weights @ value[:NEAREST])
    residual = apart[:, :NEAREST] - slope * pairs.distance[:, :NEAREST] - estimate
    influence, twice = pairs.variance(pairs.weights[:, None] * weights * residual)
    half = t_quantile(0.975, pairs.df) * standard_error(influence, twice)
    described = _described(states, horizon, loss) | {
        "influence": influence, "counted_twice": twice, "nearest": float(np.sqrt(delta[0] / states.inputs.shape[1]))
    }  # fmt: skip
    doubt = _doubt(delta, value, estimate, jump)
    if doubt.refused:
        first = pairs.variance(pairs.weights[:, None] * (apart[:, :1] - value[0]))
        below = _root(value[0] + t_quantile(0.95, pairs.df) * standard_error(*first))
        return FloorEstimate(**described, **NOTHING, below=below, refused=doubt.refused)
    share = 1.0 if loss == "rmse" else 0.5
    half += doubt.wrong
    low, high = _root(estimate - half), _root(estimate + half)
    return FloorEstimate(
        **described, value=share * _root(estimate), upper=None if loss == "rmse" else _root(estimate),
        interval=(share * low, high), below=None, refused=None,
    )  # fmt: skip


@dataclass(frozen=True)
class Doubt:
    """What extrapolating may be wrong by, on the squared scale, and why to refuse."""

    wrong: float
    refused: str | None


def _doubt(delta: np.ndarray, value: np.ndarray, estimate: float, jump: float) -> Doubt:
    """How far extrapolation is to be believed: how much it takes away, how straight the line is, whether the mean may jump."""
    removed = 1.0 - estimate / value[0] if value[0] > 0 else 1.0
    if removed > MOST_REMOVED:
        return Doubt(0.0, TOO_FAR.format(100 * min(1.0, removed)))
    if jump > CURVED * estimate:
        return Doubt(0.0, A_JUMP.format(f"{100 * jump / estimate:.0f} %" if jump < estimate else "all"))
    bent = abs(float(_line(delta[:FEWER], value[:FEWER])[0] @ value[:FEWER]) - estimate)
    return Doubt(max(bent, SHARE_IN_DOUBT * abs(value[0] - estimate)), None)


def _jump(delta: np.ndarray, columns: np.ndarray) -> float:
    """How much of an estimate may be a jump in the mean of one action column rather than disagreement.

    Where a mean is smooth, values grow with the squared distance. Where it jumps (a gripper that closes), they grow with the
    distance itself, and a straight line in its square ends too high. Both laws are fitted, to all columns together and to each
    alone: where neither can be told from the other, the difference of their intercepts in that column is in doubt.
    """
    together, _ = _two_laws(delta, columns.sum(axis=1))
    if together > TOLD_APART_TOGETHER:
        return 0.0
    each = [_two_laws(delta, value) for value in columns.T]
    return max([0.0, *(between for misfits, between in each if misfits < TOLD_APART)])


def _two_laws(delta: np.ndarray, value: np.ndarray) -> tuple[float, float]:
    """How many times worse a line in the distance fits than one in its square, and how far their intercepts lie apart."""
    smooth, _, misfit = _line(delta, value)
    rooted, _, misfit_rooted = _line(np.sqrt(delta), value)
    return misfit_rooted / max(misfit, 1e-30), float((smooth - rooted) @ value)


def _root(squared: float) -> float:
    return float(np.sqrt(max(0.0, squared)))


def _described(states: States, horizon: int, loss: Loss) -> dict:
    return {
        "observations": states.observation_set.name, "history": states.history, "horizon": int(horizon), "loss": loss,
        "estimator": "gamma" if loss == "rmse" else "pair_distance",
    }  # fmt: skip


def _refusal(states: States, horizon: int, loss: Loss, why: str) -> FloorEstimate:
    """There is nothing to estimate from."""
    nowhere = {"influence": np.zeros(states.demos.episodes), "counted_twice": 0.0, "nearest": float("nan")}
    return FloorEstimate(**_described(states, horizon, loss), **NOTHING, **nowhere, below=None, refused=why)


def save_estimates(estimates: Sequence[FloorEstimate], path: Path) -> None:
    """Write estimates as JSON."""
    path.write_text(json.dumps([asdict(e) for e in estimates], default=np.ndarray.tolist))


def load_estimates(path: Path) -> list[FloorEstimate]:
    """The inverse of `save_estimates`."""
    found = []
    for stored in json.loads(path.read_text()):
        stored["interval"] = None if stored["interval"] is None else tuple(stored["interval"])
        found.append(FloorEstimate(**{**stored, "influence": np.array(stored["influence"], float)}))
    return found

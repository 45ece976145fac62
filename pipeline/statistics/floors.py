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
from pipeline.statistics.pilot import Pilot, fit_pilot
from pipeline.statistics.refusals import A_JUMP, CONTRADICTED, NOT_EXPLAINED, TOO_FAR, TOO_SMALL
from pipeline.types import ACTION, Demonstrations, FloorEstimate, ObservationSet, Semantics, Split

NEAREST = 10
"""The neighbours of a state that count: one frame of each of so many other episodes."""

FEWER, MORE = 5, 20
"""Other fits: over fewer, to see how straight the line is; over more, to see whether values still grow."""

FEWEST_EPISODES = 30
MOST_SCORED = 20_000
MOST_ELSEWHERE = 8_000
"""States at which a jump is looked for where only some episodes are held out."""

MOST_FITTED = 20_000
"""States that the pilot regression learns from, the same share of each episode."""

MOST_REMOVED = 0.5
"""The share of the nearest neighbours' value that extrapolation may take away."""

JUMPY = 0.07
"""The share of an estimate that a jump in the mean action may account for, before the estimate is refused."""

SURE_OF_JUMP = 5.0
"""How many standard errors a jump needs, to be taken off the estimate."""

MOST_EXPLAINED = 0.5
"""The share of the pilot's own error on held-out episodes that the floor may leave to be explained."""

MOST_KEPT = 0.75
"""The least that extrapolation gives without the pilot, as a share of what it gives with it; clearly less, and it is refused."""

SMALLEST = 0.01
"""In deviations of the actions: below it, what the pilot misses and what people disagree about look alike."""

SHARE_IN_DOUBT = 0.5
"""Of what the fit takes away from the nearest neighbours, or from the pilot's error, so much joins the interval."""

NOTHING = {"value": None, "upper": None, "interval": None, "wrong": 0.0}

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
    everywhere = found
    if len(np.unique(states.episode[states.scored])) < demos.episodes:
        # Whether a mean jumps is a property of the data, not of the share of them that is scored: all of them can tell.
        frames = scored_frames(demos, np.arange(demos.episodes), states.first, MOST_ELSEWHERE)
        everywhere = _search(states, frames, possible)
    estimates = []
    for horizon in horizons:
        if horizon in found:
            estimates += _estimate(states, found[horizon], everywhere[horizon], horizon)
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


def _estimate(states: States, found: Neighbours, everywhere: Neighbours, horizon: int) -> list[FloorEstimate]:
    pilot = _pilot(states, horizon)
    pairs, difference = _pairs(states, found), _differences(states, pilot, found, horizon)
    squared = difference**2
    recorded = 0.5 * (_recorded(states, found, horizon) ** 2).mean(axis=2)
    at_all = (pairs, difference)
    if everywhere is not found:
        at_all = _pairs(states, everywhere), _differences(states, pilot, everywhere, horizon)
    jump = _jump(*at_all)
    doubt = _doubt(states, pilot, pairs, 0.5 * squared.mean(axis=2), recorded, jump)
    estimates = [_judge(states, pairs, horizon, "rmse", 0.5 * squared.mean(axis=2), doubt)]
    doubt = doubt if doubt.by_pilot else Doubt()  # a bracket of a factor of two has room for a jump
    for loss, apart in (("mae", np.abs(difference).mean(axis=2)), ("l2", np.sqrt(squared.sum(axis=2)))):
        mean = pairs.weights @ apart
        # The square of a mean, pair by pair: its average is mean², and it moves with a pair as the square of the mean does.
        estimates.append(_judge(states, pairs, horizon, loss, mean**2 + 2 * mean * (apart - mean), doubt))
    return estimates


def _pilot(states: States, horizon: int) -> Pilot:
    """What a regression expects `horizon` steps later. Angles are left to the neighbours: their mean is no number."""
    demos = states.demos
    frames = scored_frames(demos, np.arange(demos.episodes), states.first, MOST_FITTED)
    frames = frames[frames + horizon < demos.episode_starts[states.episode[frames] + 1]]
    actions = np.where(states.circular, 0.0, states.actions[frames + horizon])
    return fit_pilot(states.inputs[frames], actions, states.episode[frames], demos.episodes)


def _recorded(states: States, found: Neighbours, horizon: int) -> np.ndarray:
    """[M, K, A] the action of a scored state less that of its neighbour, `horizon` steps later; angles wrapped."""
    difference = states.actions[found.scored + horizon][:, None] - states.actions[found.frames + horizon]
    difference[..., states.circular] = wrap(difference[..., states.circular])
    return difference


def _differences(states: States, pilot: Pilot, found: Neighbours, horizon: int) -> np.ndarray:
    """[M, K, A] the same, less what the pilot expects them to differ by."""
    expected = pilot.differences(states.inputs, states.episode, found.scored, found.frames)
    return _recorded(states, found, horizon) - expected


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


def _line(distance: np.ndarray, length: int | None = None) -> np.ndarray:
    """[K] what to weigh values at `distance` [K] with, so that the sum is the intercept of their least-squares line;
    followed by zeros up to `length`."""
    centred = distance - distance.mean()
    weights = 1 / len(distance) - distance.mean() * centred / (float((centred**2).sum()) or 1.0)
    return np.pad(weights, (0, (length or len(weights)) - len(weights)))


@dataclass(frozen=True)
class Sum:
    """A weighted sum over neighbours of their mean values, and how sure it is: `moved` as `Pairs.variance` has it."""

    value: float
    moved: tuple[np.ndarray, float]

    @property
    def error(self) -> float:
        return standard_error(*self.moved)


def _contrast(pairs: Pairs, apart: np.ndarray, weights: np.ndarray) -> Sum:
    """The values [M, K] of pairs, weighted by rank [K]; each pair moves it by what it differs from its rank's mean."""
    value = pairs.weights @ apart
    return Sum(float(weights @ value), pairs.variance(pairs.weights[:, None] * weights * (apart - value)))


def _intercept(pairs: Pairs, apart: np.ndarray) -> Sum:
    """The values [M, K] of pairs, extrapolated to distance zero by the NEAREST; what distance explains moves nothing."""
    delta, near = pairs.curve[:NEAREST], apart[:, :NEAREST]
    weights, value = _line(delta), pairs.weights @ near
    intercept = float(weights @ value)
    slope = (float(value.mean()) - intercept) / (float(delta.mean()) or 1.0)
    residual = near - slope * pairs.distance[:, :NEAREST] - intercept
    return Sum(intercept, pairs.variance(pairs.weights[:, None] * weights * residual))


def _judge(states: States, pairs: Pairs, horizon: int, loss: Loss, apart: np.ndarray, doubt: "Doubt") -> FloorEstimate:
    """One estimate on the squared scale (Γ or D₀²) from the pairs' values [M, K], or the reason why there is none."""
    found, nearest = _intercept(pairs, apart), float(pairs.weights @ apart[:, 0])
    removed = 1.0 - found.value / nearest if nearest > 0 else 1.0
    refused = TOO_FAR.format(100 * min(1.0, removed)) if removed > MOST_REMOVED else doubt.refused
    influence, twice = found.moved
    described = _described(states, horizon, loss) | {
        "influence": influence, "counted_twice": twice,
        "nearest": float(np.sqrt(pairs.curve[0] / states.inputs.shape[1])),
    }  # fmt: skip
    if refused:
        first = _contrast(pairs, apart[:, :1], np.ones(1))
        below = _root(first.value + t_quantile(0.95, pairs.df) * first.error)
        return FloorEstimate(**described, **NOTHING, below=below, refused=refused)
    taken = max(nearest, doubt.explained) - found.value
    wrong = max(_bent(pairs, apart), SHARE_IN_DOUBT * taken, doubt.jump)
    estimate, half = found.value - doubt.shift, t_quantile(0.975, pairs.df) * found.error + wrong
    share = 1.0 if loss == "rmse" else 0.5
    low, high = _root(estimate - half), _root(estimate + half)
    return FloorEstimate(
        **described, value=share * _root(estimate), upper=None if loss == "rmse" else _root(estimate),
        interval=(share * low, high), below=None, refused=None, wrong=wrong,
    )  # fmt: skip


def _bent(pairs: Pairs, apart: np.ndarray) -> float:
    """What a line through the FEWER nearest says differently, beyond chance."""
    ranks = apart.shape[1]
    found = _contrast(pairs, apart, _line(pairs.curve[:FEWER], ranks) - _line(pairs.curve[:NEAREST], ranks))
    return max(0.0, abs(found.value) - t_quantile(0.975, pairs.df) * found.error)


@dataclass(frozen=True)
class Doubt:
    """Why extrapolating the squared error may be wrong, on the squared scale.

    explained  the pilot's error on held-out episodes, which holds the floor and what the pilot misses
    jump       how much of the floor's square may be a jump in the mean
    shift      the part of it that stands out of chance, to be taken off
    refused    why there can be no number     by_pilot: for any loss
    """

    explained: float = 0.0
    jump: float = 0.0
    shift: float = 0.0
    refused: str | None = None
    by_pilot: bool = False


def _doubt(states: States, pilot: Pilot, pairs: Pairs, apart: np.ndarray, recorded: np.ndarray, jump: Sum) -> Doubt:
    """Whether what the pilot leaves is disagreement: how good it is, how small the rest, whether the mean may jump.

    `apart` and `recorded` [M, K] are half the mean squared differences with and without the pilot.
    """
    estimate = _intercept(pairs, apart).value
    deviation = float(np.sqrt(states.actions.var(axis=0).mean()))
    if estimate < (SMALLEST * deviation) ** 2:
        return Doubt(refused=TOO_SMALL.format(100 * SMALLEST), by_pilot=True)
    explained = float(pilot.error[~states.circular].sum() / states.actions.shape[1])
    if (1 - MOST_EXPLAINED) * explained > estimate:
        return Doubt(refused=NOT_EXPLAINED.format(explained / estimate), by_pilot=True)
    plain = _intercept(pairs, recorded)
    if MOST_KEPT * estimate > plain.value + t_quantile(0.975, pairs.df) * plain.error:
        return Doubt(refused=CONTRADICTED, by_pilot=True)
    if jump.value > JUMPY * estimate:
        return Doubt(refused=A_JUMP.format(min(100.0, 100 * jump.value / estimate)))
    if jump.value > SURE_OF_JUMP * jump.error:
        return Doubt(jump=jump.value, shift=jump.value)  # what the pilot misses is put down to the jump
    return Doubt(explained, max(0.0, jump.value))


def _jump(pairs: Pairs, difference: np.ndarray) -> Sum:
    """How much of the floor's square may be a jump in the mean of one action column rather than disagreement.

    Where a mean is smooth, values grow with the squared distance. Where it jumps (a gripper that closes), they grow with the
    distance itself, and a straight line in its square ends too high, by once or twice what the two laws' intercepts lie
    apart. The pilot takes smooth growth away, so what grows still is suspect.
    """
    there = pairs.curve[np.isfinite(pairs.curve)]  # far ahead, fewer episodes than that have an action
    weights = np.pad(_line(there) - _line(np.sqrt(there)), (0, len(pairs.curve) - len(there)))
    columns = [
        _contrast(pairs, 0.5 * apart**2 / difference.shape[2], weights) for apart in np.moveaxis(difference, 2, 0)
    ]
    return max(columns, key=lambda column: column.value)


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

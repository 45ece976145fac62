"""Demonstrations whose multimodality floors are known exactly.

What belongs here: how states move, how a demonstrator acts in them, and the floors that follow. What does not: any
estimator.

Every generator is states that move like a robot's, and `action = mean(state) + noise`. Paths follow one task: a smooth
curve that all episodes share, from a start to a goal that differ from episode to episode (a few directions, whatever
the number of joints), at an uneven speed. Frames next to each other are copies of one another; what other episodes did
in the same place is not. The states do not depend on the noise, so the floor at a state is that of the noise there:

    mse   the variance, averaged over action columns
    mae   the mean absolute distance to the median, averaged over action columns
    l2    the mean Euclidean distance to the point that makes it smallest

and beside them, for the estimator of pair distances, pair_mae and pair_l2: the mean L1 and L2 distance of two actions at
one and the same state.

Where noise is the same everywhere, mse is a formula, and mae and l2 are had from 3 × 10⁵ draws of it (to 0.2 %).
Where it depends on the state, the floor at a state is a formula, averaged over 8,000 episodes of states (to 0.3 %),
episodes weighted equally. Noise tied in time, or drawn once an episode, leaves the floor of a frame as it is: it is
what episodes differ by.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from pipeline.lerobot_format.saved import hash_demonstrations
from pipeline.types import ACTION, STATE, Demonstrations, Feature, ObservationSet, Semantics

OBJECT = "observation.environment_state"
LOSSES = ("mse", "mae", "l2", "pair_mae", "pair_l2")
FPS = 20.0
SHORTEST, LONGEST = 40, 80
POPULATION = 8_000
DRAWS = 300_000

Losses = dict[str, Any]
"""What LOSSES names: one number each, or [N] at N states."""


@dataclass(frozen=True)
class Truth:
    """Demonstrations and their floors.

    history  of the benchmark: anchors lie at t ≥ history − 1
    floors   (observation set's name, horizon, one of LOSSES) → the floor, or mean pair distance
    """

    demos: Demonstrations
    semantics: Semantics
    sets: tuple[ObservationSet, ...]
    history: int
    floors: Mapping[tuple[str, int, str], float]


@dataclass(frozen=True)
class States:
    """[N, D] where episodes were, one after another, how long each is [E], and a hidden number of each episode [E]."""

    values: np.ndarray
    lengths: np.ndarray
    hidden: np.ndarray

    @property
    def episode(self) -> np.ndarray:
        """[N] the episode of each frame."""
        return np.repeat(np.arange(len(self.lengths)), self.lengths)

    @property
    def first(self) -> np.ndarray:
        """[E] the first frame of each episode."""
        return np.cumsum(self.lengths) - self.lengths


@dataclass(frozen=True)
class Noise:
    """What a demonstrator adds to the mean action.

    draw    (random, states) → [N, A]
    floors  states → LOSSES for each observation set's name
    """

    draw: Callable[[np.random.Generator, States], np.ndarray]
    floors: Callable[[States], dict[str, Losses]]


@dataclass(frozen=True)
class Generator:
    """One kind of demonstrations.

    smooth          the mean action is a smooth function of the state
    positive_floor  it is not zero
    dimensions      input columns of each observation set, over its frames
    modes           the observation sets, by name, that leave several clearly different actions
    """

    name: str
    words: str
    states: Callable[[np.random.Generator, int], States]
    mean: Callable[[States], np.ndarray]
    noise: Noise
    dimensions: Mapping[str, int]
    smooth: bool = True
    positive_floor: bool = True
    sets: tuple[ObservationSet, ...] = (ObservationSet("state", (STATE,), history=1),)
    circular: tuple[int, ...] = ()
    history: int = 1
    modes: tuple[str, ...] = ()

    def build(self, episodes: int, seed: int) -> Truth:
        """Record `episodes` demonstrations."""
        random = np.random.default_rng([seed, episodes])
        states = self.states(random, episodes)
        actions = self.mean(states) + self.noise.draw(random, states)
        columns = {STATE: states.values, ACTION: actions}
        if any(OBJECT in each.features for each in self.sets):
            columns[OBJECT] = np.repeat(states.hidden, states.lengths)[:, None]
        demos = _demonstrations(self.name, columns, states.lengths)
        return Truth(demos, _semantics(demos, self.circular), self.sets, self.history, _population_floors(self.name))


def _demonstrations(name: str, columns: Mapping[str, np.ndarray], lengths: np.ndarray) -> Demonstrations:
    """Columns of numbers as a data set; columns are named 0, 1, …, without units."""
    arrays = {key: np.ascontiguousarray(values, np.float32) for key, values in columns.items()}
    features = {
        key: Feature(key, tuple(map(str, range(v.shape[1]))), (None,) * v.shape[1]) for key, v in arrays.items()
    }
    timing = {
        "episode_starts": np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        "episode_ids": np.arange(len(lengths)),
        "timestamps": np.concatenate([np.arange(length) / FPS for length in lengths]),
        "tasks": ("",) * len(lengths),
        "fps": FPS,
    }
    return Demonstrations(
        name=name, source=f"known_truth:{name}", revision=None, robot_type=None, columns=arrays, features=features,
        cameras=(), warnings=(), content_hash=hash_demonstrations(arrays, features, **timing), **timing,
    )  # fmt: skip


def _semantics(demos: Demonstrations, circular: tuple[int, ...]) -> Semantics:
    actions = demos.columns[ACTION].shape[1]
    turns = {key: tuple(key == STATE and i in circular for i in range(v.shape[1])) for key, v in demos.columns.items()}
    return Semantics(("other",) * actions, (None,) * actions, turns, (None,) * actions, ())


@cache
def _population_floors(name: str) -> dict[tuple[str, int, str], float]:
    """The floors over all states that a generator's episodes visit, an episode counting once."""
    generator = GENERATORS[name]
    states = generator.states(np.random.default_rng(20_240), POPULATION)
    weights = 1.0 / (np.repeat(states.lengths, states.lengths) * len(states.lengths))
    floors = {}
    for observations, losses in generator.noise.floors(states).items():
        for loss in LOSSES:
            floors[observations, 0, loss] = float((np.broadcast_to(losses[loss], len(weights)) * weights).sum())
    return floors


# Where episodes go ----------------------------------------------------------------------------------------------------


def _task(dimensions: int, *, latent: int | None = None, spread: float = 0.5, wiggle: float = 0.06):
    """Paths of one task in `dimensions`; starts and goals differ in `latent` directions (default: in all)."""
    fixed = np.random.default_rng(dimensions)
    phase = fixed.uniform(0, 2 * np.pi, (2, dimensions))
    latent = latent or dimensions
    mix = np.eye(dimensions) if latent == dimensions else fixed.normal(size=(latent, dimensions)) / np.sqrt(latent)

    def draw(random: np.random.Generator, episodes: int) -> States:
        lengths, tau = _clock(random, episodes)
        e = np.repeat(np.arange(episodes), lengths)
        tau = tau[:, None]
        shared = np.cos(1.5 * np.pi * tau + phase[0]) + 0.5 * np.cos(3 * np.pi * tau + phase[1])
        start, goal = spread * random.normal(size=(2, episodes, latent)) @ mix
        waves = wiggle * random.normal(size=(2, episodes, dimensions))
        own = (1 - tau) * start[e] + 0.6 * tau * goal[e]
        own += waves[0, e] * np.sin(2 * np.pi * tau) + waves[1, e] * np.sin(3 * np.pi * tau)
        return States(shared + own, lengths, random.uniform(-1, 1, episodes))

    return draw


def _clock(random: np.random.Generator, episodes: int) -> tuple[np.ndarray, np.ndarray]:
    """[E] frames of each episode, and [N] how far along 0 … 1 each frame is: some hurry first, some last."""
    lengths = random.integers(SHORTEST, LONGEST + 1, episodes)
    first = np.cumsum(lengths) - lengths
    number = np.arange(lengths.sum()) - np.repeat(first, lengths)
    hurry = np.repeat(random.uniform(0.8, 1.25, episodes), lengths)
    return lengths, (number / np.repeat(lengths - 1, lengths)) ** hurry


def _turning(random: np.random.Generator, episodes: int) -> States:
    """A position in the plane, and an angle in 0 … 2π that starts anywhere and turns by up to a third."""
    states = _task(2)(random, episodes)
    tau = np.concatenate([np.linspace(0, 1, length) for length in states.lengths])
    start, turn = random.uniform(0, 2 * np.pi, episodes), random.uniform(-2, 2, episodes)
    angle = (start[states.episode] + turn[states.episode] * tau) % (2 * np.pi)
    return States(np.column_stack([states.values, angle]), states.lengths, states.hidden)


def _rounds(random: np.random.Generator, episodes: int) -> States:
    """Round and round an ellipse, 0.25 rad a frame; half of the episodes go the other way (`hidden` = ±1)."""
    lengths = random.integers(SHORTEST, LONGEST + 1, episodes)
    first = np.cumsum(lengths) - lengths
    number = np.arange(lengths.sum()) - np.repeat(first, lengths)
    way = random.choice([-1.0, 1.0], episodes)
    start, radius = random.uniform(0, 2 * np.pi, episodes), random.uniform(0.8, 1.2, episodes)
    angle = np.repeat(start, lengths) + 0.25 * np.repeat(way, lengths) * number
    wide = np.repeat(radius, lengths)
    return States(np.column_stack([wide * np.cos(angle), 0.8 * wide * np.sin(angle)]), lengths, way)


# What is done there ---------------------------------------------------------------------------------------------------


def _smooth(dimensions: int, actions: int, turn: float = 1.0) -> Callable[[States], np.ndarray]:
    """A bent plane: linear, and a sine of one more direction an action column."""
    fixed = np.random.default_rng([dimensions, actions])
    slope, direction = fixed.normal(size=(2, dimensions, actions)) / np.sqrt(dimensions)

    def mean(states: States) -> np.ndarray:
        return states.values @ slope + 0.5 * np.sin(turn * states.values @ direction)

    return mean


def _turned(states: States) -> np.ndarray:
    """Smooth on the circle, so that a jump of the angle from 2π to 0 is none."""
    x, y, angle = states.values.T
    return np.column_stack([np.sin(angle) + 0.5 * x, np.cos(angle) * (1 + 0.3 * y), 0.5 * np.sin(2 * angle) + 0.3 * y])


def _gripping(opening: float) -> Callable[[States], np.ndarray]:
    """Two smooth columns, and a gripper that closes by `opening` where the first coordinate is positive."""

    def mean(states: States) -> np.ndarray:
        return np.column_stack([_smooth(3, 2)(states), np.where(states.values[:, 0] > 0, opening / 2, -opening / 2)])

    return mean


# How it varies --------------------------------------------------------------------------------------------------------


def _everywhere(
    draw: Callable[[np.random.Generator, States], np.ndarray],
    sample: Callable[[np.random.Generator, int], np.ndarray],
    variance: float,
    name: str = "state",
) -> Noise:
    """Noise that is the same in every state.

    Parameters
    ----------
    draw : how it comes along episodes.
    sample : (random, n) → [n, A], how it is distributed at one frame, over episodes.
    variance : its mean over action columns.
    """

    @cache
    def losses() -> Losses:
        drawn = sample(np.random.default_rng(7), 2 * DRAWS)
        return {"mse": variance} | numeric_losses(drawn[:DRAWS]) | _pairs(drawn[:DRAWS] - drawn[DRAWS:])

    return Noise(draw, lambda states: {name: losses()})


def numeric_losses(sample: np.ndarray) -> Losses:
    """mae and l2 of a sample [n, A] about its medians and its geometric median (Weiszfeld's iteration)."""
    centre = np.median(sample, axis=0)
    mae = float(np.abs(sample - centre).mean())
    for _ in range(20):
        weight = 1.0 / np.maximum(_norm(sample - centre), 1e-9)
        centre = weight @ sample / weight.sum()
    return {"mae": mae, "l2": float(_norm(sample - centre).mean())}


def _pairs(differences: np.ndarray) -> Losses:
    return {"pair_mae": float(np.abs(differences).mean()), "pair_l2": float(_norm(differences).mean())}


def _norm(values: np.ndarray) -> np.ndarray:
    return np.sqrt(np.einsum("ij,ij->i", values, values))


def _independent(sample: Callable[[np.random.Generator, int], np.ndarray], variance: float) -> Noise:
    """Drawn anew at every frame."""
    return _everywhere(lambda random, states: sample(random, len(states.values)), sample, variance)


def _gaussian(deviations: np.ndarray) -> Callable[[np.random.Generator, int], np.ndarray]:
    return lambda random, n: deviations * random.normal(size=(n, len(deviations)))


def _coin(random: np.random.Generator, n: int) -> np.ndarray:
    """This way in 7 of 10 frames, that way in 3."""
    way = np.where(random.random((n, 1)) < 0.7, 0.6, -1.4)
    return way * np.array([0.5, -0.3]) + 0.15 * random.normal(size=(n, 2))


def _skew(random: np.random.Generator, n: int) -> np.ndarray:
    return 0.3 * (random.exponential(size=(n, 3)) - 1.0)


def _tailed(random: np.random.Generator, n: int) -> np.ndarray:
    """Student's t with five degrees of freedom."""
    return 0.25 * random.standard_t(5, size=(n, 2))


def _drifting(weight: np.ndarray, deviation: float) -> Noise:
    """A uniform number of each episode times `weight` [A], alike in episodes recorded after each other; Gaussian noise."""

    def draw(random: np.random.Generator, states: States) -> np.ndarray:
        mine = np.sort(random.uniform(-1, 1, len(states.lengths)))[states.episode]
        return mine[:, None] * weight + deviation * random.normal(size=(len(mine), len(weight)))

    def sample(random: np.random.Generator, n: int) -> np.ndarray:
        return random.uniform(-1, 1, (n, 1)) * weight + deviation * random.normal(size=(n, len(weight)))

    return _everywhere(draw, sample, float((weight**2).mean() / 3 + deviation**2))


def _told(weight: np.ndarray, deviation: float, square: float, blind: str, seeing: str) -> Noise:
    """The episode's hidden number times `weight`, which the set `seeing` is told, and Gaussian noise."""
    uniform = square < 1

    def draw(random: np.random.Generator, states: States) -> np.ndarray:
        mine = states.hidden[states.episode][:, None]
        return mine * weight + deviation * random.normal(size=(len(mine), len(weight)))

    def sample(random: np.random.Generator, n: int) -> np.ndarray:
        mine = random.uniform(-1, 1, (n, 1)) if uniform else random.choice([-1.0, 1.0], (n, 1))
        return mine * weight + deviation * random.normal(size=(n, len(weight)))

    variance = float(square * (weight**2).mean() + deviation**2)
    told = _gaussian(np.full(len(weight), deviation))
    hidden = _everywhere(draw, sample, variance, blind)
    seen = _everywhere(draw, told, deviation**2, seeing)
    return Noise(draw, lambda states: hidden.floors(states) | seen.floors(states))


def _reacting(columns: int, deviation: float, memory: float) -> Noise:
    """Noise tied in time, as a slow hand's: an AR(1) process at its stationary deviation."""

    def draw(random: np.random.Generator, states: States) -> np.ndarray:
        from scipy.signal import lfilter

        noise = random.normal(size=(len(states.values), columns))
        for start, length in zip(states.first, states.lengths, strict=True):
            part = noise[start : start + length]
            part[1:] *= np.sqrt(1 - memory**2)  # the first frame is drawn from where the process has settled
            part[:] = lfilter([1.0], [1.0, -memory], part, axis=0)
        return deviation * noise

    return _everywhere(draw, _gaussian(np.full(columns, deviation)), deviation**2)


def _two_ways(columns: int, deviation: float) -> Noise:
    """Half of the episodes pass an obstacle on one side, half on the other: far apart beside it, alike elsewhere."""
    weight = np.resize([1.0, -0.6, 0.3], columns)

    def apart(states: States) -> np.ndarray:
        return 0.8 * np.exp(-0.5 * (states.values[:, 0] ** 2))

    def draw(random: np.random.Generator, states: States) -> np.ndarray:
        side = random.choice([-1.0, 1.0], len(states.lengths))[states.episode]
        return (side * apart(states))[:, None] * weight + deviation * random.normal(size=(len(side), columns))

    def floors(states: States) -> dict[str, Losses]:
        gap = apart(states)

        def mae(distance: np.ndarray, noise: float) -> np.ndarray:
            return np.mean([_mean_norm(distance * abs(w), noise, 1) for w in weight], axis=0)

        def l2(distance: np.ndarray, noise: float) -> np.ndarray:
            return _mean_norm(distance * np.linalg.norm(weight), noise, columns)

        twice = np.sqrt(2) * deviation  # of a difference; half of all pairs are on one side
        losses = {"mse": (gap**2) * (weight**2).mean() + deviation**2}
        for name, loss in (("mae", mae), ("l2", l2)):
            losses[name] = loss(gap, deviation)
            losses[f"pair_{name}"] = 0.5 * loss(0 * gap, twice) + 0.5 * loss(2 * gap, twice)
        return {"state": losses}

    return Noise(draw, floors)


def _mean_norm(distance: np.ndarray, deviation: float, columns: int) -> np.ndarray:
    """The mean norm of Gaussian noise about a point at `distance`: the mean of a noncentral chi distribution."""
    from scipy.special import gammaln, hyp1f1

    central = np.sqrt(2) * deviation * np.exp(gammaln((columns + 1) / 2) - gammaln(columns / 2))
    return central * hyp1f1(-0.5, columns / 2, -0.5 * (distance / deviation) ** 2)


def _uneven(columns: int) -> Noise:
    """Gaussian noise, up to three times as wide in one part of the states as in another."""

    def width(states: States) -> np.ndarray:
        return 0.15 + 0.3 / (1 + np.exp(-2 * states.values[:, 0]))

    def draw(random: np.random.Generator, states: States) -> np.ndarray:
        return width(states)[:, None] * random.normal(size=(len(states.values), columns))

    def floors(states: States) -> dict[str, Losses]:
        wide, zero = width(states), np.zeros(1)
        losses = {"mae": wide * _mean_norm(zero, 1.0, 1), "l2": wide * _mean_norm(zero, 1.0, columns)}
        pairs = {f"pair_{name}": np.sqrt(2) * value for name, value in losses.items()}
        return {"state": {"mse": wide**2} | losses | pairs}

    return Noise(draw, floors)


STEP, JITTER, PHASES = 0.25, 0.2, 400
"""Actions that a device rounds to whole steps, how far the hand was off before, and places between two steps."""


def _rounded(mean: Callable[[States], np.ndarray]) -> Noise:
    """Gaussian noise, and the sum rounded to whole steps; one action column."""

    def draw(random: np.random.Generator, states: States) -> np.ndarray:
        wanted = mean(states)
        return np.round((wanted + JITTER * random.normal(size=wanted.shape)) / STEP) * STEP - wanted

    def floors(states: States) -> dict[str, Losses]:
        # What is done depends on the mean only through where it lies between two steps.
        phase = (mean(states)[:, 0] / STEP) % 1.0
        table = [_rounded_losses((cell + 0.5) / PHASES) for cell in range(PHASES)]
        cell = np.minimum((phase * PHASES).astype(int), PHASES - 1)
        return {"state": {name: np.array([losses[name] for losses in table])[cell] for name in LOSSES}}

    return Noise(draw, floors)


def _rounded_losses(phase: float) -> Losses:
    """The floors where the mean lies at `phase` of a step; with one column mae and l2 are the same."""
    from scipy.special import ndtr

    steps = np.arange(-12, 14)
    edges = (np.arange(-12, 15) - 0.5 - phase) * STEP / JITTER
    chance = np.diff(ndtr(edges))
    values = steps * STEP
    centre = chance @ values
    median = values[np.searchsorted(np.cumsum(chance), 0.5)]
    mae, pair = chance @ np.abs(values - median), chance @ np.abs(values[:, None] - values) @ chance
    return {"mse": chance @ (values - centre) ** 2, "mae": mae, "l2": mae, "pair_mae": pair, "pair_l2": pair}


_NONE = Noise(
    lambda random, states: np.zeros((len(states.values), 2)),
    lambda states: {"state": dict.fromkeys(LOSSES, 0.0)},
)


# The list -------------------------------------------------------------------------------------------------------------

_WITH_OBJECT = (
    ObservationSet("state", (STATE,), history=1),
    ObservationSet("object", (STATE, OBJECT), history=1),
)
_WITH_MOTION = (
    ObservationSet("state", (STATE,), history=1),
    ObservationSet("motion", (STATE,), history=2),
)
_ARM = np.array([0.4, 0.35, 0.3, 0.3, 0.25, 0.2])


def _make() -> dict[str, Generator]:
    def even(n: int, deviation: float) -> Noise:
        return _independent(_gaussian(np.full(n, deviation)), deviation**2)

    made = [
        Generator("plane", "Gaussian noise in the plane", _task(2), _smooth(2, 2), even(2, 0.3), {"state": 2}),
        Generator("arm", "six joints, each with its own Gaussian noise", _task(6, latent=3), _smooth(6, 6),
                  _independent(_gaussian(_ARM), float((_ARM**2).mean())), {"state": 6}),
        Generator("fine_hand", "six joints and little noise: most of what neighbours differ by is where they are",
                  _task(6, latent=3), _smooth(6, 6), even(6, 0.12), {"state": 6}),
        Generator("steady_hand", "six joints and hardly any noise", _task(6, latent=3), _smooth(6, 6), even(6, 0.03),
                  {"state": 6}),
        Generator("two_arms", "eighteen joints", _task(18, latent=3), _smooth(18, 14), even(14, 0.3), {"state": 18}),
        Generator("coin", "at every frame one of two ways, 7 to 3", _task(3), _smooth(3, 2),
                  _independent(_coin, 0.17 * 0.84 + 0.15**2), {"state": 3}, modes=("state",)),
        Generator("strategies", "each episode passes an obstacle on its side", _task(4, latent=3), _smooth(4, 3),
                  _two_ways(3, 0.2), {"state": 4}, modes=("state",)),
        Generator("skewed", "exponential noise", _task(3), _smooth(3, 3), _independent(_skew, 0.09), {"state": 3}),
        Generator("heavy_tails", "noise after Student's t, five degrees of freedom", _task(2), _smooth(2, 2),
                  _independent(_tailed, 0.0625 * 5 / 3), {"state": 2}),
        Generator("drifting", "the demonstrator changes from session to session", _task(3), _smooth(3, 2),
                  _drifting(np.array([0.5, 0.3]), 0.2), {"state": 3}),
        Generator("slow_hand", "noise tied in time over ten frames", _task(6, latent=3), _smooth(6, 6),
                  _reacting(6, 0.3, 0.9), {"state": 6}),
        Generator("uneven", "noise up to three times as wide in some places", _task(2), _smooth(2, 2), _uneven(2),
                  {"state": 2}),
        Generator("gripper", "a gripper that opens and closes at once", _task(3), _gripping(2.0), even(3, 0.2),
                  {"state": 3}, smooth=False),
        Generator("soft_gripper", "a gripper that opens and closes half as far", _task(3), _gripping(1.0), even(3, 0.2),
                  {"state": 3}, smooth=False),
        Generator("turning", "an angle that wraps", _turning, _turned, even(3, 0.3), {"state": 4}, circular=(2,)),
        Generator("rounded", "actions in whole steps", _task(4, latent=3), _smooth(4, 1), _rounded(_smooth(4, 1)),
                  {"state": 4}),
        Generator("object", "the place of an object that only one set sees", _task(2), _smooth(2, 2),
                  _told(np.array([0.6, -0.4]), 0.2, 1 / 3, "state", "object"), {"state": 2, "object": 3},
                  sets=_WITH_OBJECT),
        Generator("two_ways_round", "the way of going, which two frames tell and one does not", _rounds, _smooth(2, 2),
                  _told(np.array([0.5, 0.5]), 0.2, 1.0, "state", "motion"), {"state": 2, "motion": 4},
                  sets=_WITH_MOTION, history=2, modes=("state",)),
        Generator("winding", "what is done changes quickly from place to place", _task(3), _smooth(3, 2, turn=4.0),
                  even(2, 0.2), {"state": 3}),
        Generator("exact", "no noise at all", _task(3), _smooth(3, 2), _NONE, {"state": 3}, positive_floor=False),
        Generator("exact_winding", "no noise, and what is done changes quickly", _task(3), _smooth(3, 2, turn=4.0), _NONE,
                  {"state": 3}, positive_floor=False),
    ]  # fmt: skip
    return {generator.name: generator for generator in made}


GENERATORS: dict[str, Generator] = _make()

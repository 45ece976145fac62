"""What the estimators and intervals say where the truth is known: one function a study, one small record a block of repeats.

What belongs here: drawing data whose truth is known, asking an estimator, and writing down both. What does not: whether
that is good enough (`goals`). Estimators are parameters: a test hands in a broken one and sees the goals fail.

A record is {"truth": …, "columns": {name: [one value a repeat]}}, JSON-able; NaN is None. Repeat r uses seed r.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.split import make_split
from pipeline.statistics.brackets import Scored, Sight, gap_to_floor, value_of_sensors
from pipeline.statistics.comparisons import compare_paired, judge
from pipeline.statistics.floors import measure_floors
from pipeline.statistics.intervals import estimate_mean
from pipeline.statistics.known_truth.generators import GENERATORS, Generator, States, Truth
from pipeline.statistics.radius import radius_floor
from pipeline.types import ACTION, STATE, Demonstrations, EpisodeErrors, FloorEstimate, Split

Record = dict[str, Any]
Columns = dict[str, list[float | None]]
SCALES = {"rmse": "mse", "mae": "mae", "l2": "l2"}
"""The loss of an estimate → the floor it is held against; rmse is the root of it."""


# Floors ---------------------------------------------------------------------------------------------------------------


OFF = {"best": 0.0, "off": 0.5}
"""Two policies of known error: the mean of the demonstrator, and so many deviations of its noise beside it."""


def study_floors(
    *,
    repeats: Sequence[int],
    generator: str,
    episodes: int,
    measure: Callable[..., Sequence[FloorEstimate]] = measure_floors,
    radius: Callable[..., Any] | None = radius_floor,
    gap: Callable[..., Any] = gap_to_floor,
    worth: Callable[..., Sequence[Mapping[str, Any]]] = value_of_sensors,
) -> Record:
    """Floors of every observation set of a generator, what lies between them and two policies, what seeing more is worth.

    `radius` None: without the notebook's.
    """
    made = GENERATORS[generator]
    columns: Columns = {}
    for repeat in repeats:
        truth = made.build(episodes, repeat)
        split = split_of(truth, repeat)
        floors: list[FloorEstimate] = []
        for observations in truth.sets:
            found = measure(truth.demos, truth.semantics, observations, split, history=truth.history, horizons=[0])
            floors += found
            for estimate in found:
                where = f"{observations.name}/{estimate.loss}"
                _write(columns, where, value=estimate.value, upper=estimate.upper, below=estimate.below)
                _write(columns, where, **_ends(estimate.interval))
            if radius is not None and observations.history == 1:
                _write(
                    columns,
                    f"{observations.name}/radius",
                    value=radius(truth.demos, truth.semantics, observations, probes=200).mean,
                )
        _write_gaps(columns, made, truth, floors[0], gap)
        if len(truth.sets) > 1:
            sights = {each.name: Sight(frozenset(each.features), each.history) for each in truth.sets}
            (found,) = worth(floors, sights, ())
            _write(columns, "worth", value=found["value"], **_ends(found["interval"]))
    known = {f"{name}/{loss}": value for (name, _, loss), value in truth.floors.items()}
    return {"truth": known, "columns": columns}


def _write_gaps(columns: Columns, made: Generator, truth: Truth, floor: FloorEstimate, gap: Callable[..., Any]) -> None:
    """The distance of each policy of OFF from the squared floor of the smallest set, whose mean the generator knows."""
    demos = truth.demos
    states = States(demos.columns[STATE].astype(np.float64), demos.lengths, np.zeros(demos.episodes))
    best, deviation = made.mean(states), np.sqrt(truth.floors[floor.observations, 0, "mse"])
    for name, off in OFF.items():
        found = gap(_scored(truth, best + off * deviation, floor.observations), floor)
        _write(columns, f"{floor.observations}/gap_{name}", value=found.gap, **_ends(found.interval))


def _scored(truth: Truth, predicted: np.ndarray, observations: str) -> Scored:
    """A policy's errors at the first action of every anchor, by episode."""
    demos = truth.demos
    error = np.where((demos.frame_in_episode >= truth.history - 1)[:, None], predicted - demos.columns[ACTION], 0.0)

    def by_episode(values: np.ndarray) -> np.ndarray:
        return np.add.reduceat(values, demos.episode_starts[:-1])[None, :, None]

    errors = EpisodeErrors(
        episodes=np.arange(demos.episodes), fold=np.zeros(demos.episodes, int),
        anchors=(demos.lengths - truth.history + 1)[:, None], absolute=by_episode(np.abs(error)),
        squared=by_episode(error**2), l2=by_episode(np.linalg.norm(error, axis=1)),
        scale=np.ones((demos.episodes, error.shape[1])),
    )  # fmt: skip
    return Scored("policy", observations, Sight(frozenset([STATE]), 1), errors)


def split_of(truth: Truth, seed: int) -> Split:
    """As a benchmark splits by default."""
    return make_split(truth.demos, protocol="strict", folds="auto", test_share=0.2, seed=seed, has_simulator=False)


# Means and differences of drawn errors --------------------------------------------------------------------------------

SEED, BOTH = 0.3, 0.4
"""Deviations of what a seed adds everywhere, and of what it adds to one episode; that of an episode is 1."""

SHAPES: Mapping[str, Callable[[np.random.Generator, Any], np.ndarray]] = {
    "gaussian": lambda random, size: random.normal(size=size),
    "exponential": lambda random, size: random.exponential(size=size) - 1.0,
    "heavy": lambda random, size: random.standard_t(3, size=size) / np.sqrt(3),
}
"""How episodes differ: mean 0, deviation 1."""


def study_means(
    *,
    repeats: Sequence[int],
    shape: str,
    episodes: int,
    seeds: int = 1,
    folds: int = 1,
    weighted: bool = False,
    estimate: Callable[..., Any] = estimate_mean,
) -> Record:
    """The interval of a mean error, where the mean is 0. `weighted`: over frames, episodes are unevenly long."""
    columns: Columns = {}
    fold = np.arange(episodes) % folds
    for repeat in repeats:
        random = np.random.default_rng([repeat, episodes, seeds, folds])
        errors = SHAPES[shape](random, episodes) + _of_seeds(random, seeds, fold)
        counts = random.integers(20, 101, episodes) if weighted else None
        found = estimate(errors, counts, fold if folds > 1 else None)
        _write(columns, value=found.value, **_ends(found.interval))
    return {"truth": {"mean": 0.0}, "columns": columns}


def study_differences(
    *,
    repeats: Sequence[int],
    shape: str,
    episodes: int,
    seeds: int = 1,
    folds: int = 1,
    compare: Callable[..., Any] = compare_paired,
) -> Record:
    """The interval and the p-value of a difference that is 0 on average; both policies find the same episodes hard."""
    columns: Columns = {}
    fold = np.arange(episodes) % folds
    for repeat in repeats:
        random = np.random.default_rng([repeat, episodes, seeds, folds, 1])
        hard = 3 * random.exponential(size=episodes)
        own = SHAPES[shape](random, episodes)  # what one of them finds harder than the other
        a = hard + own + _of_seeds(random, seeds, fold)
        b = hard + _of_seeds(random, seeds, fold)
        found = compare(a, b, fold=fold if folds > 1 else None)
        _write(columns, value=found.difference, p=found.p, **_ends(found.interval))
    return {"truth": {"difference": 0.0}, "columns": columns}


RIVALS = 10


def study_family(
    *,
    repeats: Sequence[int],
    shape: str,
    episodes: int,
    seeds: int,
    compare: Callable[..., Any] = compare_paired,
    verdicts: Callable[..., Any] = judge,
) -> Record:
    """Whether any of RIVALS policies, equal on average to the champion, is called better or worse than it."""
    columns: Columns = {}
    for repeat in repeats:
        random = np.random.default_rng([repeat, episodes, seeds, 2])
        hard, fold = 3 * random.exponential(size=episodes), np.zeros(episodes, int)
        errors = [hard + SHAPES[shape](random, episodes) + _of_seeds(random, seeds, fold) for _ in range(1 + RIVALS)]
        pairs = [(str(i), "champion", "mae", compare(rival, errors[0])) for i, rival in enumerate(errors[1:])]
        _write(columns, any=any(found.word in ("better", "worse") for found in verdicts(pairs)))
    return {"truth": {}, "columns": columns}


def _of_seeds(random: np.random.Generator, seeds: int, fold: np.ndarray) -> np.ndarray:
    """[S, E] what seeds add, nested in folds; nothing with one seed, whose interval is for that network alone."""
    if seeds == 1:
        return np.zeros((1, len(fold)))
    everywhere = SEED * random.normal(size=(seeds, fold.max() + 1))
    return everywhere[:, fold] + BOTH * random.normal(size=(seeds, len(fold)))


# The null that moves --------------------------------------------------------------------------------------------------

RISE = 1.2
FAMILY = 4
FEATURES = 40


def study_null(
    *,
    repeats: Sequence[int],
    generator: str,
    episodes: int,
    seeds: int,
    resampled: bool,
    compare: Callable[..., Any] = compare_paired,
    verdicts: Callable[..., Any] = judge,
) -> Record:
    """Results of one method against each other: every verdict is false. And one whose error has risen by a fifth.

    Each repeat records new demonstrations. A stored result and FAMILY new ones come from the same method, trained with
    fresh seeds and, with `resampled`, on training episodes drawn anew with replacement. Columns, 1 where so:

    alarm    the first new result is called worse than the stored one: the regression gate
    verdict  it is called worse or better
    family   any of the new results is, after Holm over them
    power    the first new result with its errors raised by a fifth is called worse
    """
    columns: Columns = {}
    for repeat in repeats:
        truth = GENERATORS[generator].build(episodes, repeat)
        random = np.random.default_rng([repeat, seeds, resampled])
        split = split_of(truth, repeat)
        stored, *new = (train_and_score(truth.demos, split, random, seeds, resampled) for _ in range(1 + FAMILY))
        fold = fold_of_episodes(split)

        def words(
            against: Sequence[np.ndarray], stored: np.ndarray = stored, fold: np.ndarray | None = fold
        ) -> list[str]:
            pairs = [(str(i), "stored", "mae", compare(a, stored, fold=fold)) for i, a in enumerate(against)]
            return [comparison.word for comparison in verdicts(pairs)]

        one, family, risen = words(new[:1]), words(new), words([RISE * new[0]])
        _write(
            columns,
            alarm=one[0] == "worse",
            verdict=one[0] in ("worse", "better"),
            family=any(word in ("worse", "better") for word in family),
            power=risen[0] == "worse",
        )
    return {"truth": {}, "columns": columns}


def fold_of_episodes(split: Split) -> np.ndarray | None:
    """[E] the fold of each held-out episode in order; None with one fold."""
    if len(split.folds) == 1:
        return None
    pairs = sorted((e, f) for f, fold in enumerate(split.folds) for e in fold.test)
    return np.array([f for _, f in pairs])


def train_and_score(
    demos: Demonstrations, split: Split, random: np.random.Generator, seeds: int, resampled: bool
) -> np.ndarray:
    """[S, E] mean absolute errors on held-out episodes of a cheap policy, ridge regression on random features."""
    inputs, actions = (demos.columns[key].astype(np.float64) for key in (STATE, ACTION))
    frames = [np.arange(*demos.episode_starts[e : e + 2]) for e in range(demos.episodes)]
    errors = np.full((seeds, demos.episodes), np.nan)
    for fold in split.folds:
        train = random.choice(fold.train, len(fold.train)) if resampled else fold.train
        rows = np.concatenate([frames[e] for e in train])
        scaled = (inputs - inputs[rows].mean(axis=0)) / inputs[rows].std(axis=0)
        for seed in range(seeds):
            seen = _features(scaled, random)
            predicted = seen @ _ridge(seen[rows], actions[rows])
            for e in fold.test:
                errors[seed, e] = np.abs(predicted[frames[e]] - actions[frames[e]]).mean()
    return errors[:, sorted(e for fold in split.folds for e in fold.test)]


def _features(scaled: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """[N, 1 + FEATURES] cosines of random directions, and one (Rahimi & Recht 2007)."""
    directions = random.normal(size=(scaled.shape[1], FEATURES)) / np.sqrt(scaled.shape[1])
    waves = np.cos(scaled @ directions + random.uniform(0, 2 * np.pi, FEATURES))
    return np.column_stack([waves, np.ones(len(scaled))])


def _ridge(seen: np.ndarray, actions: np.ndarray) -> np.ndarray:
    return np.linalg.solve(seen.T @ seen + 1e-3 * len(seen) * np.eye(seen.shape[1]), seen.T @ actions)


# Modes, and the learning curve -----------------------------------------------------------------------------------------


def study_modes(
    *,
    repeats: Sequence[int],
    generator: str,
    observations: str,
    episodes: int,
    evidence: Callable[..., Any] | None = None,
) -> Record:
    """Whether several modes are said to be there; `truth` is whether they are."""
    if evidence is None:
        from pipeline.statistics.modes import evidence_of_modes as evidence
    made = GENERATORS[generator]
    seen = next(each for each in made.sets if each.name == observations)
    columns: Columns = {}
    for repeat in repeats:
        truth = made.build(episodes, repeat)
        (found,) = evidence(truth.demos, truth.semantics, seen, history=truth.history, horizons=[0], seed=repeat)
        _write(columns, found=found.found, gain=found.gain)
    return {"truth": {"modes": float(observations in made.modes)}, "columns": columns}


SIZES, HELD_OUT, ORDERS, TRAINING_SEEDS = (10, 20, 40, 80), 20, 3, 5


def study_curve(*, repeats: Sequence[int], rate: float, answer: Callable[..., Any] | None = None) -> Record:
    """Whether 50 more demonstrations would help, where the error is ½ + ½ (n / 80)^−rate, in units of the present one.

    What is worth it is five hundredths. Episodes differ in how hard they are, orders of the training episodes in their
    luck, the more so the fewer they are, and seeds as well.
    """
    from pipeline.statistics.curve import CurveErrors
    from pipeline.statistics.curve import answer as of_project

    error = 0.5 + 0.5 * (np.array([*SIZES, SIZES[-1] + 50]) / SIZES[-1]) ** -rate
    columns: Columns = {}
    for repeat in repeats:
        random = np.random.default_rng([repeat, round(100 * rate)])
        hard = random.gamma(4, 1 / 4, HELD_OUT)
        values = []
        for n, mean in zip(SIZES, error, strict=False):
            orders = 1 if n == SIZES[-1] else ORDERS
            luck = 0.03 * np.sqrt(SIZES[-1] / n) * random.normal(size=(orders, 1, 1)) * (n < SIZES[-1])
            of_seeds = 0.03 * random.normal(size=(orders, TRAINING_SEEDS, 1))
            own = 0.05 * random.normal(size=(orders, TRAINING_SEEDS, HELD_OUT))
            values.append(hard * (mean + luck + of_seeds) + own)
        found = (answer or of_project)(CurveErrors(SIZES, tuple(values), np.zeros(HELD_OUT, int)), "first_step_mae")
        _write(columns, yes=found.word == "yes", no=found.word == "no", **_ends(found.interval))
    return {"truth": {"gain": float(error[-2] - error[-1])}, "columns": columns}


# Success rates, exactly -----------------------------------------------------------------------------------------------


def study_success(
    *, repeats: Sequence[int], trials: int, rates: int = 199, intervals: Mapping[str, Any] | None = None
) -> Record:
    """How often an interval of a success rate holds the rate, summed over all counts; no simulation.

    `columns`: for each interval's name the coverage at each of `rates` rates between 0 and 1.
    """
    from scipy.special import bdtr

    from pipeline.statistics.success import clopper_pearson, wilson

    successes = np.arange(trials + 1)
    grid = (np.arange(rates) + 1) / (rates + 1)
    below = np.concatenate([np.zeros((1, rates)), bdtr(successes[:, None], trials, grid)])
    chance = np.diff(below, axis=0)
    columns = {"rate": [float(rate) for rate in grid]}
    for name, interval in (intervals or {"clopper_pearson": clopper_pearson, "wilson": wilson}).items():
        ends = np.array([interval(int(count), trials) for count in successes])
        inside = (ends[:, :1] <= grid) & (grid <= ends[:, 1:])
        columns[name] = [_number(value) for value in (chance * inside).sum(axis=0)]
    return {"truth": {}, "columns": columns}


STUDIES: Mapping[str, Callable[..., Record]] = {
    "floors": study_floors,
    "means": study_means,
    "differences": study_differences,
    "family": study_family,
    "null": study_null,
    "success": study_success,
    "modes": study_modes,
    "curve": study_curve,
}


def _write(columns: Columns, where: str = "", **values: Any) -> None:
    for name, value in values.items():
        columns.setdefault(f"{where}/{name}" if where else name, []).append(_number(value))


def _ends(interval: tuple[float, float] | None) -> dict[str, float | None]:
    low, high = interval or (None, None)
    return {"low": low, "high": high}


def _number(value: Any) -> float | None:
    """Six digits are more than any goal asks for, and JSON has no NaN."""
    return None if value is None or not np.isfinite(value) else float(f"{float(value):.6g}")

"""What the estimators and intervals say where the truth is known: one function a study, one small record a block of repeats.

What belongs here: drawing data whose truth is known, asking an estimator, and writing down both. What does not: whether
that is good enough (`goals`). Estimators are parameters: a test hands in a broken one and sees the goals fail.

A record is {"truth": …, "columns": {name: [one value a repeat]}}, JSON-able; NaN is None. Repeat r uses seed r.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.split import make_split
from pipeline.statistics.comparisons import compare_paired, judge
from pipeline.statistics.floors import measure_floors
from pipeline.statistics.intervals import estimate_mean
from pipeline.statistics.known_truth.generators import GENERATORS, Truth
from pipeline.statistics.radius import radius_floor
from pipeline.types import ACTION, STATE, Demonstrations, Split

Record = dict[str, Any]
SCALES = {"rmse": "mse", "mae": "mae", "l2": "l2"}
"""The loss of an estimate → the floor it is held against; rmse is the root of it."""


# Floors ---------------------------------------------------------------------------------------------------------------


def study_floors(
    *,
    repeats: Sequence[int],
    generator: str,
    episodes: int,
    measure: Callable[..., Sequence[Any]] = measure_floors,
    radius: Callable[..., Any] | None = radius_floor,
) -> Record:
    """Every floor of every observation set of a generator, beside its truth; `radius` None: without the notebook's."""
    made = GENERATORS[generator]
    names = ("value", "upper", "low", "high", "below")
    columns: dict[str, list[float | None]] = {}
    for repeat in repeats:
        truth = made.build(episodes, repeat)
        split = split_of(truth, repeat)
        for observations in truth.sets:
            found = measure(truth.demos, truth.semantics, observations, split, history=truth.history, horizons=[0])
            for estimate in found:
                low, high = estimate.interval or (None, None)
                values = (estimate.value, estimate.upper, low, high, estimate.below)
                for name, value in zip(names, values, strict=True):
                    columns.setdefault(f"{observations.name}/{estimate.loss}/{name}", []).append(_number(value))
            if radius is not None and observations.history == 1:
                found = radius(truth.demos, truth.semantics, observations, probes=200)
                columns.setdefault(f"{observations.name}/radius/value", []).append(_number(found.mean))
    floors = {f"{name}/{loss}": value for (name, _, loss), value in truth.floors.items()}
    return {"truth": floors, "columns": columns}


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
    columns: dict[str, list[float | None]] = {"value": [], "low": [], "high": []}
    fold = np.arange(episodes) % folds
    for repeat in repeats:
        random = np.random.default_rng([repeat, episodes, seeds, folds])
        errors = SHAPES[shape](random, episodes) + _of_seeds(random, seeds, fold)
        counts = random.integers(20, 101, episodes) if weighted else None
        found = estimate(errors, counts, fold if folds > 1 else None)
        _write(columns, value=found.value, low=_end(found.interval, 0), high=_end(found.interval, 1))
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
    columns: dict[str, list[float | None]] = {"value": [], "low": [], "high": [], "p": []}
    fold = np.arange(episodes) % folds
    for repeat in repeats:
        random = np.random.default_rng([repeat, episodes, seeds, folds, 1])
        hard = 3 * random.exponential(size=episodes)
        own = SHAPES[shape](random, episodes)  # what one of them finds harder than the other
        a = hard + own + _of_seeds(random, seeds, fold)
        b = hard + _of_seeds(random, seeds, fold)
        found = compare(a, b, fold=fold if folds > 1 else None)
        ends = {"low": _end(found.interval, 0), "high": _end(found.interval, 1)}
        _write(columns, value=found.difference, p=found.p, **ends)
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
    columns: dict[str, list[float | None]] = {"any": []}
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
    columns: dict[str, list[float | None]] = {"alarm": [], "verdict": [], "family": [], "power": []}
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
    columns: dict[str, list[float | None]] = {"found": [], "gain": []}
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
    columns: dict[str, list[float | None]] = {name: [] for name in ("low", "high", "yes", "no")}
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
        ends = {"low": _end(found.interval, 0), "high": _end(found.interval, 1)}
        _write(columns, yes=found.word == "yes", no=found.word == "no", **ends)
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


def _write(columns: dict[str, list[float | None]], **values: Any) -> None:
    for name, value in values.items():
        columns[name].append(_number(value))


def _end(interval: tuple[float, float] | None, end: int) -> float | None:
    return None if interval is None else interval[end]


def _number(value: Any) -> float | None:
    """Six digits are more than any goal asks for, and JSON has no NaN."""
    return None if value is None or not np.isfinite(value) else float(f"{float(value):.6g}")

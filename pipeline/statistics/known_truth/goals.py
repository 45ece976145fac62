"""What must hold where the truth is known, as one list, and whether it does.

What belongs here: the goals of this project's statistics and how each is read off the cells of a run. What does not:
running anything, printing.

Every measured number has its own uncertainty. A goal is *missed* where a number lies beyond its limit by more than
SURE standard errors (the limits of a Wilson interval for shares): among a few hundred numbers, one beyond two is bound to
turn up. Beyond the limit by less is *unsure*.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from pipeline.statistics.known_truth.generators import GENERATORS
from pipeline.statistics.known_truth.shards import Cell
from pipeline.statistics.known_truth.studies import OFF

SURE = 2.5
FEWEST_ANSWERS = 15
"""Fewer answers than this say nothing about their bias or coverage."""
ANSWERS = 0.8
"""A generator is answered where so many of its data sets get a number."""
PAIRS = 400
"""The upper limit of false alarms is read off so many pairs or more."""

Outcome = Literal["met", "unsure", "missed"]


@dataclass(frozen=True)
class Place:
    """A number measured somewhere. `low` and `high`: 95 % for showing; `surely`: the wider limits that judge it."""

    where: str
    value: float
    low: float
    high: float
    surely: tuple[float, float]
    repeats: int
    study: dict = field(default_factory=dict)


@dataclass(frozen=True)
class Goal:
    """Limits of a number, in percent where `unit` says so, wherever `measure` finds it."""

    name: str
    words: str
    least: float
    most: float
    unit: str
    measure: Callable[[Sequence[Cell]], Iterator[Place]]

    def outcome(self, place: Place) -> Outcome:
        """Whether the number lies inside the limits, or how sure it is that it does not."""
        if self.least <= place.value <= self.most:
            return "met"
        low, high = place.surely
        return "missed" if high < self.least or low > self.most else "unsure"


@dataclass(frozen=True)
class Result:
    """A goal and every place where it was measured."""

    goal: Goal
    places: tuple[Place, ...]

    @property
    def outcome(self) -> Outcome | None:
        """The worst outcome of all places; None where nothing was measured."""
        found = {self.goal.outcome(place) for place in self.places}
        return next((word for word in ("missed", "unsure", "met") if word in found), None)

    @property
    def worst(self) -> Place | None:
        """The place furthest beyond a limit, or nearest to one."""
        goal = self.goal
        return max(self.places, key=lambda p: max(goal.least - p.value, p.value - goal.most), default=None)


def limits_in_words(goal: Goal) -> str:
    """`92 … 97 %`, `≤ 5 %`, `≥ 80 %`, `≤ 2 times`."""
    unit = f" {goal.unit}" if goal.unit else ""
    if goal.unit == "%" and goal.most == 100:
        return f"≥ {goal.least:.3g}{unit}"
    if goal.least == 0:
        return f"≤ {goal.most:.3g}{unit}"
    return f"{goal.least:.3g} … {goal.most:.3g}{unit}"


def judge_goals(cells: Sequence[Cell]) -> list[Result]:
    """Every goal against the cells of a run."""
    return [Result(goal, tuple(goal.measure(cells))) for goal in GOALS]


# Numbers with their uncertainty ---------------------------------------------------------------------------------------


def share(where: str, true: np.ndarray, cell: Cell) -> Place:
    """The share of repeats [R] in which something was so, in percent, with Wilson's interval."""
    n, p = len(true), float(np.mean(true))

    def wilson(z: float) -> tuple[float, float]:
        centre, half = p + z * z / (2 * n), z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
        return max(0.0, 100 * (centre - half) / (1 + z * z / n)), min(100.0, 100 * (centre + half) / (1 + z * z / n))

    return Place(where, 100 * p, *wilson(1.96), wilson(SURE), n, cell.settings)


def mean(where: str, values: np.ndarray, cell: Cell) -> Place:
    """The mean of [R] numbers."""
    centre, error = float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))
    return about(where, centre, error, len(values), cell)


def about(where: str, value: float, error: float, repeats: int, cell: Cell) -> Place:
    """A number with a standard error."""
    wide = SURE * error
    return Place(
        where, value, value - 1.96 * error, value + 1.96 * error, (value - wide, value + wide), repeats, cell.settings
    )


# Floors ---------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Floors:
    """One observation set of a cell of the study of floors."""

    cell: Cell
    observations: str

    @property
    def where(self) -> str:
        generator = GENERATORS[self.cell.settings["generator"]]
        name = generator.name if len(generator.sets) == 1 else f"{generator.name}/{self.observations}"
        return f"{name}, {self.episodes} episodes"

    @property
    def episodes(self) -> int:
        return self.cell.settings["episodes"]

    @property
    def generator(self) -> str:
        return self.cell.settings["generator"]

    def column(self, loss: str, name: str) -> np.ndarray:
        return self.cell.columns[f"{self.observations}/{loss}/{name}"]

    def truth(self, loss: str) -> float:
        """The floor; of `rmse` the root of the squared one."""
        return (
            self.cell.truth[f"{self.observations}/mse"] ** 0.5
            if loss == "rmse"
            else self.cell.truth[f"{self.observations}/{loss}"]
        )

    def answered(self, loss: str) -> np.ndarray:
        return np.isfinite(self.column(loss, "value"))

    def enough(self, loss: str) -> bool:
        return int(self.answered(loss).sum()) >= min(FEWEST_ANSWERS, len(self.answered(loss)))


def floors_of(cells: Sequence[Cell]) -> Iterator[Floors]:
    """Every observation set of every generator and number of episodes."""
    for cell in cells:
        if cell.study == "floors":
            for observations in GENERATORS[cell.settings["generator"]].sets:
                yield Floors(cell, observations.name)


def gamma_bias(floors: Floors) -> Place:
    """The mean of the squared floor where it is given, in percent above the truth."""
    found = floors.column("rmse", "value")[floors.answered("rmse")] ** 2
    return mean(floors.where, 100 * (found / floors.truth("rmse") ** 2 - 1), floors.cell)


def _gamma_bias(least: int, most: int) -> Callable[[Sequence[Cell]], Iterator[Place]]:
    def measure(cells: Sequence[Cell]) -> Iterator[Place]:
        for floors in floors_of(cells):
            if least <= floors.episodes <= most and floors.truth("rmse") > 0 and floors.enough("rmse"):
                yield gamma_bias(floors)

    return measure


def holds(floors: Floors, loss: str) -> Place:
    """How often the interval of a floor, or of the span of a pair distance, holds the truth."""
    inside = (floors.column(loss, "low") <= floors.truth(loss)) & (floors.truth(loss) <= floors.column(loss, "high"))
    return share(f"{loss}, {floors.where}", inside[floors.answered(loss)], floors.cell)


def _intervals(*losses: str) -> Callable[[Sequence[Cell]], Iterator[Place]]:
    def measure(cells: Sequence[Cell]) -> Iterator[Place]:
        for floors in floors_of(cells):
            for loss in losses:
                if floors.truth(loss) > 0 and floors.enough(loss):
                    yield holds(floors, loss)

    return measure


def width(where: str, cell: Cell, columns: str) -> Place:
    """The intervals' mean width over that of 95 % of the estimates; the error is that of their spread."""
    values, low, high = (cell.columns[f"{columns}/{name}"] for name in ("value", "low", "high"))
    use = np.isfinite(low)
    ratio = float((high - low)[use].mean() / (2 * 1.96 * values[use].std(ddof=1)))
    return about(where, ratio, ratio / np.sqrt(2 * (use.sum() - 1)), int(use.sum()), cell)


def floor_width(floors: Floors) -> Place:
    """That of the squared error's floor."""
    return width(floors.where, floors.cell, f"{floors.observations}/rmse")


def _widths(cells: Sequence[Cell]) -> Iterator[Place]:
    for floors in floors_of(cells):
        if floors.truth("rmse") > 0 and floors.enough("rmse"):
            yield floor_width(floors)


def gap_holds(floors: Floors, policy: str) -> Place:
    """How often the interval of a policy's distance from the floor holds it."""
    true = floors.truth("rmse") * (np.hypot(1.0, OFF[policy]) - 1.0)
    low, high = (floors.column(f"gap_{policy}", name) for name in ("low", "high"))
    given = np.isfinite(low)
    return share(f"{policy}, {floors.where}", ((low <= true + 1e-9) & (true - 1e-9 <= high))[given], floors.cell)


def _gaps(measure: Callable[[Floors, str], Place]) -> Callable[[Sequence[Cell]], Iterator[Place]]:
    def of_all(cells: Sequence[Cell]) -> Iterator[Place]:
        for floors in floors_of(cells):
            first = GENERATORS[floors.generator].sets[0].name == floors.observations
            # Rounding moves the mean of what is done away from the mean that was wanted.
            if first and floors.truth("rmse") > 0 and floors.enough("rmse") and floors.generator != "rounded":
                yield from (measure(floors, policy) for policy in OFF)

    return of_all


def _gap_width(floors: Floors, policy: str) -> Place:
    return width(f"{policy}, {floors.where}", floors.cell, f"{floors.observations}/gap_{policy}")


def _sensors(measure: Callable[[str, Cell], Place]) -> Callable[[Sequence[Cell]], Iterator[Place]]:
    def of_all(cells: Sequence[Cell]) -> Iterator[Place]:
        for cell in cells:
            given = np.isfinite(cell.columns.get("worth/low", np.empty(0)))
            if given.sum() >= FEWEST_ANSWERS:
                yield measure(f"{cell.settings['generator']}, {cell.settings['episodes']} episodes", cell)

    return of_all


def _worth_holds(where: str, cell: Cell) -> Place:
    smaller, larger = (cell.truth[f"{each.name}/mse"] ** 0.5 for each in GENERATORS[cell.settings["generator"]].sets)
    low, high = cell.columns["worth/low"], cell.columns["worth/high"]
    return share(where, ((low <= smaller - larger) & (smaller - larger <= high))[np.isfinite(low)], cell)


def _worth_width(where: str, cell: Cell) -> Place:
    return width(where, cell, "worth")


def answers(floors: Floors) -> Place:
    """How often there is an answer: a number, or "below x" where the floor is zero."""
    positive = GENERATORS[floors.generator].positive_floor
    given = floors.answered("rmse") if positive else np.isfinite(floors.column("rmse", "below"))
    return share(floors.where, given, floors.cell)


def _must_answer(cells: Sequence[Cell]) -> Iterator[Place]:
    for floors in floors_of(cells):
        generator = GENERATORS[floors.generator]
        easy = generator.smooth and generator.dimensions[floors.observations] <= 6
        if floors.episodes >= 100 and easy:
            yield answers(floors)


def _answered_generators(cells: Sequence[Cell]) -> Iterator[Place]:
    for episodes in sorted({floors.episodes for floors in floors_of(cells) if floors.episodes >= 100}):
        mine = [floors for floors in floors_of(cells) if floors.episodes == episodes]
        by_name: dict[str, bool] = {}
        for floors in mine:
            by_name[floors.generator] = by_name.get(floors.generator, True) and answers(floors).value >= 100 * ANSWERS
        value = 100 * sum(by_name.values()) / len(by_name)
        yield about(
            f"{sum(by_name.values())} of {len(by_name)}, {episodes} episodes", value, 0.0, len(by_name), mine[0].cell
        )


def _few_episodes(cells: Sequence[Cell]) -> Iterator[Place]:
    for floors in floors_of(cells):
        if floors.episodes < 30:
            yield share(floors.where, floors.answered("rmse"), floors.cell)


def _below(cells: Sequence[Cell]) -> Iterator[Place]:
    for floors in floors_of(cells):
        given = np.isfinite(floors.column("rmse", "below"))
        if given.sum() >= FEWEST_ANSWERS:
            held = floors.column("rmse", "below")[given] >= floors.truth("rmse")
            yield share(floors.where, held, floors.cell)


# Errors and comparisons -----------------------------------------------------------------------------------------------


def drawn_where(cell: Cell) -> str:
    """In words where drawn errors come from."""
    s = cell.settings
    words = [s["shape"], f"{s['episodes']} episodes", f"{s['seeds']} seed{'s' * (s['seeds'] > 1)}"]
    words += [f"{s['folds']} folds"] if s["folds"] > 1 else []
    return ", ".join([*words, "over frames"] if s.get("weighted") else words)


def coverage(cell: Cell) -> Place:
    """How often an interval holds the true mean, which is 0."""
    return share(f"{cell.study}: {drawn_where(cell)}", (cell.columns["low"] <= 0) & (cell.columns["high"] >= 0), cell)


def _coverages(cells: Sequence[Cell]) -> Iterator[Place]:
    for cell in cells:
        if cell.study in ("means", "differences"):
            yield coverage(cell)


def _false_verdicts(cells: Sequence[Cell]) -> Iterator[Place]:
    for cell in cells:
        if cell.study == "differences":
            yield share(f"drawn errors: {drawn_where(cell)}", cell.columns["p"] <= 0.05, cell)
        if cell.study == "family":
            s = cell.settings
            where = f"drawn errors, ten at once: {s['shape']}, {s['episodes']} episodes, {s['seeds']} seeds"
            yield share(where, cell.columns["any"], cell)
        if cell.study == "null" and cell.settings["seeds"] > 1:
            yield share(f"policies: {null_where(cell)}", cell.columns["verdict"], cell)
            yield share(f"policies, four at once: {null_where(cell)}", cell.columns["family"], cell)


def null_where(cell: Cell) -> str:
    """In words what changes between two results of one method."""
    s = cell.settings
    resampled = "fresh seeds and resampled episodes" if s["resampled"] else "fresh seeds"
    return f"{resampled}, {s['episodes']} episodes, {s['seeds']} seed{'s' * (s['seeds'] > 1)}"


def _of_null(column: str) -> Callable[[Sequence[Cell]], Iterator[Place]]:
    def measure(cells: Sequence[Cell]) -> Iterator[Place]:
        for cell in cells:
            if cell.study == "null" and cell.settings["seeds"] > 1:
                yield share(null_where(cell), cell.columns[column], cell)

    return measure


def _alarms_at_most(cells: Sequence[Cell]) -> Iterator[Place]:
    for place in _of_null("alarm")(cells):
        if place.repeats >= PAIRS:
            yield Place(
                place.where, place.high, place.high, place.high, (place.high, place.high), place.repeats, place.study
            )


def _success(cells: Sequence[Cell]) -> Iterator[Place]:
    for cell in cells:
        if cell.study == "success":
            value = 100 * float(cell.columns["clopper_pearson"].min())
            yield about(f"{cell.settings['trials']} trials, the worst rate", value, 0.0, 1, cell)


# Modes and the learning curve -----------------------------------------------------------------------------------------


def _modes(several: bool) -> Callable[[Sequence[Cell]], Iterator[Place]]:
    def measure(cells: Sequence[Cell]) -> Iterator[Place]:
        for cell in cells:
            if cell.study == "modes" and bool(cell.truth["modes"]) == several:
                s = cell.settings
                yield share(
                    f"{s['generator']}/{s['observations']}, {s['episodes']} episodes", cell.columns["found"] == 1, cell
                )

    return measure


WORTHWHILE = 0.05


def _false_answers(cells: Sequence[Cell]) -> Iterator[Place]:
    for cell in cells:
        if cell.study == "curve":
            wrong = "no" if cell.truth["gain"] > WORTHWHILE else "yes"
            yield share(
                f"'{wrong}' where 50 more gain {100 * cell.truth['gain']:.1f} %", cell.columns[wrong] == 1, cell
            )


def _gains(cells: Sequence[Cell]) -> Iterator[Place]:
    for cell in cells:
        if cell.study == "curve":
            gain, given = cell.truth["gain"], np.isfinite(cell.columns["low"])
            inside = (cell.columns["low"] <= gain + 1e-9) & (gain - 1e-9 <= cell.columns["high"])
            yield share(f"where 50 more gain {100 * gain:.1f} %", inside[given], cell)


GOALS: tuple[Goal, ...] = (
    Goal("gamma, 100 episodes", "mean of the squared floor against the truth, from 100 episodes on", -5, 5, "%",
         _gamma_bias(100, 10_000)),
    Goal("gamma, 50 episodes", "the same at 50 episodes", -10, 10, "%", _gamma_bias(50, 99)),
    Goal("floor intervals", "intervals of the squared error's floor that hold it", 92, 100, "%", _intervals("rmse")),
    Goal("floor widths", "their width over that of 95 % of the estimates", 0, 2, "times", _widths),
    Goal("gaps", "intervals of a policy's distance from the floor that hold it", 92, 100, "%", _gaps(gap_holds)),
    Goal("gap widths", "their width over that of 95 % of the estimates", 0, 2, "times", _gaps(_gap_width)),
    Goal("sensors", "intervals of what seeing more is worth that hold it", 92, 100, "%", _sensors(_worth_holds)),
    Goal("sensor widths", "their width over that of 95 % of the estimates", 0, 2, "times", _sensors(_worth_width)),
    Goal("brackets", "L1 and L2 brackets that hold the floor", 95, 100, "%", _intervals("mae", "l2")),
    Goal("generators answered", "generators with an answer in four data sets of five", 100 * 8 / 12, 100, "%",
         _answered_generators),
    Goal("must answer", "data sets with an answer: smooth, up to six columns, from 100 episodes on", 100 * ANSWERS, 100,
         "%", _must_answer),
    Goal("too few episodes", "data sets below 30 episodes with a number all the same", 0, 0, "%", _few_episodes),
    Goal("below x", "upper limits, where there is no number, that hold", 95, 100, "%", _below),
    Goal("intervals", "intervals of errors and differences that hold them", 92, 97, "%", _coverages),
    Goal("false verdicts", "verdicts between equal policies", 0, 5, "%", _false_verdicts),
    Goal("false alarms", "unchanged methods that the regression gate stops", 0, 5, "%", _of_null("alarm")),
    Goal("false alarms at most", "the upper limit of that over 400 pairs", 0, 8, "%", _alarms_at_most),
    Goal("power", "errors risen by a fifth that the gate stops", 80, 100, "%", _of_null("power")),
    Goal("false modes", "data with one mode where several are found", 0, 5, "%", _modes(False)),
    Goal("modes found", "data with several modes where they are found", 80, 100, "%", _modes(True)),
    Goal("false answers", "wrong answers to whether more demonstrations would help", 0, 5, "%", _false_answers),
    Goal("gains", "intervals of what more demonstrations gain that hold it", 92, 100, "%", _gains),
    Goal("success rates", "exact intervals of a success rate that hold it, at the worst rate", 95, 100, "%", _success),
)  # fmt: skip

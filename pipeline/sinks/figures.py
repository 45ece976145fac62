"""Which pictures a benchmark's page shows, from its table and predictions: one figure a question, with panels.

What belongs here: choosing episodes, policies and columns to draw, and saying what was chosen. What does not: drawing
(`charts`, `planes`), the page (`report`). Importing this module imports Altair.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import altair as alt
import numpy as np

from pipeline.methods import METHODS
from pipeline.sinks import bracket_chart, charts, curve_chart, held_out_chart, planes
from pipeline.sinks.findings import (
    LOSSES,
    MORE,
    ahead,
    bracket_of,
    capital,
    floors_of,
    name_in,
    not_above,
    ranks,
    why_not,
)
from pipeline.sinks.held_out import held_out_lines
from pipeline.sinks.words import common_unit, show
from pipeline.statistics.curve import METRIC_WORDS
from pipeline.statistics.curve_reading import Reading
from pipeline.types import ACTION, STATE, Demonstrations, Predictions, RadiusFloor, Rollouts, Semantics

POINTS = 400
"""Points in a scatter, at most; evenly spaced among all."""
DRIVES = 60
"""Roll-outs in one picture, at most; evenly spaced among all."""
COLUMNS = 6
EPISODES = 3
Row = Mapping[str, Any]


@dataclass(frozen=True)
class Panel:
    """One chart of a figure, and what it is of."""

    caption: str
    chart: alt.TopLevelMixin


@dataclass(frozen=True)
class Figure:
    """Pictures that answer one question, and how to read them; those about floors stand beside the floors' table.

    answer   what the pictures say, where it belongs to the first screen too
    """

    question: str
    reading: str
    panels: tuple[Panel, ...]
    about: Literal["policies", "floors"] = "policies"
    answer: str = ""


def benchmark_figures(
    table: Mapping[str, Any],
    demos: Demonstrations,
    semantics: Semantics,
    predictions: Sequence[Predictions],
    floors: Sequence[RadiusFloor] = (),
    rollouts: Sequence[Rollouts] = (),
    curves: Mapping[str, Reading] | None = None,
) -> list[Figure]:
    """Every figure that this benchmark has data for, in the order in which a reader asks.

    Parameters:
        table: one object of `run --json`.
        predictions: at held-out anchors; figures of single predictions are left out where there are none.
        curves: learning curves, by `policy/observations`.
    """
    everyone = _everyone(table)
    figures = [bracket_figure(table)]
    figures += [curve_figure(table, name, reading) for name, reading in (curves or {}).items()]
    figures += [horizon_figure(table), chunk_figure(table)]
    best = best_predictions(table, predictions)
    if best is not None:
        figures.append(held_out_figure(table, demos, semantics, predictions))
        if _in_a_plane(semantics, demos):
            figures.append(paths_figure(demos, _longest(predictions, best), everyone))
        figures.append(scatter_figure(demos, semantics, best, everyone))
    figures += [rollout_figure(rollouts, demos), floor_figure(demos, semantics, floors), lag_figure(table)]
    return [figure for figure in figures if figure is not None]


def curve_figure(table: Mapping[str, Any], address: str, reading: Reading) -> Figure:
    """Error against training episodes, the first action and one second ahead, with the answer in words."""
    policy, _, observations = address.partition("/")
    unit = common_unit(table["dataset"]["action_units"])
    panels = []
    for metric, points in reading.points.items():
        what = METRIC_WORDS[metric].removeprefix("the ")
        chart = curve_chart.learning_curve(
            points, what=what, unit=unit, policy=policy, everyone=_everyone(table), floor=reading.floors.get(metric)
        )
        panels.append(Panel(capital(what), chart))
    said = " ".join(answer.words for answer in reading.answers)
    how = (
        f"{said} {policy} ({observations}) was trained on nested parts of the training episodes and scored on the same held-out "
        "episodes. Thin lines are single orders of the episodes, bars 95 % intervals; dashed, where it is known, the floor."
    )
    return Figure(MORE, how, tuple(panels), answer=said)


def by_observation_set(table: Mapping[str, Any]) -> dict[str, list[Row]]:
    """The table's rows for each observation set; rows that no set changes (`hold_still`) come with every set."""
    rows = table["policies"]
    shared = [row for row in rows if not _asks_observations(row)]
    names = dict.fromkeys(row["observations"] for row in rows if _asks_observations(row))
    names = names or dict.fromkeys(row["observations"] for row in rows)
    return {name: [row for row in rows if row in shared or row["observations"] == name] for name in names}


def _asks_observations(row: Row) -> bool:
    return row["method"] not in METHODS or METHODS[row["method"]].uses_observations


def best_predictions(table: Mapping[str, Any], predictions: Sequence[Predictions]) -> Predictions | None:
    """Those of the trained policy with the lowest first-step error; of any policy where none was trained."""
    known = {(one.policy, one.observations): one for one in predictions if len(one.anchors)}
    rows = [row for row in table["policies"] if (row["policy"], row["observations"]) in known and ranks(row)]
    trained = [row for row in rows if row["method"] not in METHODS or METHODS[row["method"]].trained]
    ranked = sorted(trained or rows, key=lambda row: np.nan_to_num(row["first_step_mae"] or np.inf, nan=np.inf))
    return known[ranked[0]["policy"], ranked[0]["observations"]] if ranked else None


def _longest(predictions: Sequence[Predictions], best: Predictions) -> Predictions:
    """The trained policy with the longest chunk up to 16 on the best one's observation set, to draw chunks of."""
    same = [
        p for p in predictions if p.observations == best.observations and p.policy not in METHODS and len(p.anchors)
    ]
    return max([p for p in same if p.actions.shape[2] <= 16] or [best], key=lambda p: p.actions.shape[2])


def bracket_figure(table: Mapping[str, Any]) -> Figure | None:
    """Floors and the best policy under each, a panel a horizon; None where nothing was held against a floor."""
    panels = []
    for horizon in dict.fromkeys(bracket["horizon"] for bracket in table["brackets"]):
        floors = [f for f in floors_of(table) if f["horizon"] == horizon and f["loss"] != "l2"]
        lines = [_line(table, floor) for loss in LOSSES for floor in floors if floor["loss"] == loss]
        lines = [line for line in lines if line["error"] is not None]
        if lines:
            look = {"unit": common_unit(table["dataset"]["action_units"]), "everyone": _everyone(table)}
            caption = capital(ahead(horizon, table["dataset"]["fps"]))
            panels.append(Panel(caption, bracket_chart.brackets(lines, **look)))
    if not panels:
        return None
    reading = (
        "The dot is the best policy that sees no more than the line's observation set; the floor cannot be above it. A dark "
        "tick is the floor, the line through it its 95 % interval. In absolute error (MAE) the floor is only known to lie "
        "within the grey bar; the line is the bar's 95 % interval. A dotted line with an arrow: no floor could be given; it "
        "may lie anywhere along the line."
    )
    return Figure("Between the floor and the best policy", reading, tuple(panels), "floors")


def _everyone(table: Mapping[str, Any]) -> list[str]:
    return [row["policy"] for row in table["policies"]]


def _line(table: Mapping[str, Any], floor: Mapping[str, Any]) -> dict[str, Any]:
    """What is drawn of one floor and its bracket."""
    bracket = bracket_of(table, floor) or {"upper": None, "upper_policy": "", "lower": None}
    refused = why_not(floor, bracket if bracket["upper_policy"] else None) is not None
    limit = not_above(floor, bracket) if refused else None
    low, high = (None, None) if refused else (floor["interval"] or (None, None))
    return {
        "label": f"{floor['observations']} · {LOSSES[floor['loss']]}",
        "floor": None if refused else floor["value"], "upper": None if refused else floor["upper"], "low": low,
        "high": high, "limit": limit and limit[0], "error": bracket["upper"],
        "policy": bracket["upper_policy"].split("/")[0], "name": _short_name(table, bracket["upper_policy"], floor["observations"]),
    }  # fmt: skip


def _short_name(table: Mapping[str, Any], where: str, observations: str) -> str:
    """A policy's name; its observation set beside it only where that is another than the line's."""
    policy, _, own = where.partition("/")
    return policy if own == observations else name_in(table, where)


def horizon_figure(table: Mapping[str, Any]) -> Figure:
    data, unit = table["dataset"], common_unit(table["dataset"]["action_units"])
    everyone = _everyone(table)
    curves = {}
    for name, rows in by_observation_set(table).items():
        curves[name] = {row["policy"]: row["error_by_horizon"] for row in rows}
        if "hold_still" not in curves[name] and rows:
            curves[name]["hold_still"] = max((row["hold_still_by_horizon"] for row in rows), key=len)
    top = max(map(charts.axis_top, curves.values()), default=1.0)
    look = {"fps": data["fps"], "unit": unit, "everyone": everyone, "top": top}
    panels = [Panel(f"Observation set {name}", charts.error_over_horizon(c, **look)) for name, c in curves.items()]
    outside = {p: e[0] for c in curves.values() for p, e in c.items() if len(e) and e[0] is not None and e[0] > top}
    reading = (
        "Each line ends where the policy's chunk ends. Below the dashed grey line a policy knows more than “stay "
        "where you are”. Click a name to single it out."
    )
    if outside:
        names = ", ".join(f"{policy} ({show(error)} at the first step)" for policy, error in outside.items())
        reading += f" Above the frame, so not to be seen: {names}."
    return Figure("How fast does the error grow, the further ahead a policy predicts?", reading, tuple(panels))


def chunk_figure(table: Mapping[str, Any]) -> Figure:
    unit = common_unit(table["dataset"]["action_units"])
    everyone = _everyone(table)
    still = next((row["first_step_mae"] for row in table["policies"] if row["method"] == "hold_still"), None)
    bars = {}
    for name, rows in by_observation_set(table).items():
        chunked = [row for row in rows if row["chunk"] is not None] or rows
        bars[name] = sorted(chunked, key=lambda row: (row["method"], row["chunk"] or 0))
    top = max((charts.bars_top(rows, still) for rows in bars.values()), default=1.0)
    look = {"unit": unit, "hold_still": still, "everyone": everyone, "top": top}
    panels = [Panel(f"Observation set {name}", charts.chunk_bars(rows, **look)) for name, rows in bars.items()]
    reading = (
        "The error of the very next action, for each chunk size, with 95 % intervals over held-out episodes. Where "
        "intervals overlap widely, the order may be chance."
    )
    return Figure("What does a longer chunk cost on the very next action?", reading, tuple(panels))


def _in_a_plane(semantics: Semantics, demos: Demonstrations) -> bool:
    return semantics.kinds == ("position", "position") and len(set(demos.features[ACTION].units)) == 1


def _counts_down(unit: str | None) -> bool:
    """Pixels are counted from the top of a screen."""
    return unit == "px"


def _shown_episodes(demos: Demonstrations, one: Predictions) -> list[int]:
    """A few episodes with predictions, evenly spaced among them."""
    episodes = np.unique(demos.episode_of_frame[one.anchors])
    return [
        int(e) for e in episodes[np.linspace(0, len(episodes) - 1, min(EPISODES, len(episodes))).round().astype(int)]
    ]


def paths_figure(demos: Demonstrations, one: Predictions, everyone: Sequence[str]) -> Figure:
    """Actions that are positions in a plane: the recorded path, and chunks predicted along it."""
    feature, chunk = demos.features[ACTION], one.actions.shape[2]
    panels = []
    for episode in _shown_episodes(demos, one):
        frames = demos.episode(episode)
        inside = one.in_frames(frames)[:: max(chunk // 2, 4)]
        panels.append(
            Panel(
                f"Episode {demos.episode_ids[episode]}",
                planes.path_with_chunks(
                    demos.columns[ACTION][frames],
                    [one.actions[0, place] for place in inside],
                    names=feature.names,
                    unit=feature.units[0],
                    policy=one.policy,
                    everyone=everyone,
                    down=_counts_down(feature.units[0]),
                ),
            )
        )
    reading = (
        "The broad grey line is what the demonstrator commanded in held-out episodes; each thin line is a chunk of "
        f"{chunk} actions that {one.policy} ({one.observations}) predicted on the way, a dot where it begins. Seed "
        f"{one.seeds[0]}."
    )
    return Figure("What would the policy have done in demonstrations that it never saw?", reading, tuple(panels))


def held_out_figure(
    table: Mapping[str, Any], demos: Demonstrations, semantics: Semantics, predictions: Sequence[Predictions]
) -> Figure | None:
    """Any held-out episode, action column and horizon, as the reader chooses."""
    lines = held_out_lines(table, demos, semantics, predictions)
    if lines is None:
        return None
    chart = held_out_chart.held_out_chart(lines, everyone=_everyone(table))
    reading = (
        "Choose an episode that these policies were not trained on, an action, and how far ahead. The broad line is the action "
        "that was recorded; another line is what a policy, asked that much earlier, said it would be, with its first training "
        f"seed. A policy that does not look so far ahead has none. Click a name to single it out. {lines.left_out}"
    )
    return Figure("Look for yourself: what would each policy have done?", reading.strip(), (Panel("", chart),))


def scatter_figure(demos: Demonstrations, semantics: Semantics, one: Predictions, everyone: Sequence[str]) -> Figure:
    """Predicted against recorded first actions; positions less the state, beside which moves would be small."""
    feature = demos.features[ACTION]
    some = np.linspace(0, len(one.anchors) - 1, min(POINTS, len(one.anchors))).round().astype(int)
    frames, panels, moves = one.anchors[some], [], 0
    for column in range(min(len(feature.names), COLUMNS)):
        where, origin = semantics.state_column[column], 0.0
        if semantics.kinds[column] == "position" and where is not None and not any(semantics.circular.get(ACTION, ())):
            origin, moves = demos.columns[STATE][frames, where], moves + 1
        chart = planes.predicted_against_recorded(
            demos.columns[ACTION][frames, column] - origin,
            one.actions[0, some, 0, column] - origin,
            what="action" if np.isscalar(origin) else "move",
            unit=feature.units[column],
            policy=one.policy,
            everyone=everyone,
        )
        panels.append(Panel(feature.names[column], chart))
    reading = (
        f"Each dot is one held-out frame ({len(some):,} of {len(one.anchors):,}): {one.policy} ({one.observations}), "
        f"first action, seed {one.seeds[0]}. On the dashed diagonal the prediction is right. "
    )
    reading += (
        "A move is the action less the state: holding still lies on the horizontal through zero. " if moves else ""
    )
    return Figure("Does it predict the right move?", (reading + _left_out(feature.names)).strip(), tuple(panels))


def _left_out(names: Sequence[str]) -> str:
    return f"Not shown: {', '.join(names[COLUMNS:])}." if len(names) > COLUMNS else ""


def rollout_figure(rollouts: Sequence[Rollouts], demos: Demonstrations) -> Figure | None:
    """The best network's drives, where its end effector moves in a plane."""
    drawn = [one for one in rollouts if one.paths is not None and len(one.success)]
    if not drawn:
        return None
    best = max(drawn, key=lambda one: (one.success.mean(), one.best_reward.mean()))
    feature = demos.features[ACTION]
    unit = feature.units[0]
    some = np.linspace(0, len(best.success) - 1, min(DRIVES, len(best.success))).round().astype(int)
    chart = planes.rollout_paths(
        best.paths[some], best.success[some], names=feature.names[:2], unit=unit, down=_counts_down(unit)
    )
    reading = (
        f"{best.policy} ({best.observations}, seed {best.seed}) drives by itself in the simulator {best.simulator} "
        f"{best.simulator_version} from {len(best.success)} numbered start states; a dot where each drive begins. "
        f"Task done in {int(best.success.sum())}."
    )
    reading += f" {len(some)} of the drives are drawn." if len(some) < len(best.success) else ""
    caption = f"{best.policy}, observation set {best.observations}"
    return Figure("Where does the best policy go when it drives by itself?", reading, (Panel(caption, chart),))


def floor_figure(demos: Demonstrations, semantics: Semantics, floors: Sequence[RadiusFloor]) -> Figure | None:
    """The most crowded neighbourhood of each observation set."""
    feature, panels = demos.features[ACTION], []
    for floor in floors:
        if floor.crowded is None or len(feature.names) < 2:
            continue
        spread = np.nanstd(floor.crowded.actions, axis=0)
        pair = sorted(np.argsort(-spread, kind="stable")[:2])
        names, unit = [feature.names[c] for c in pair], common_unit([feature.units[c] for c in pair])
        commanded = [semantics.state_column[c] if semantics.kinds[c] == "position" else None for c in pair]
        state = demos.columns[STATE][floor.crowded.probe, commanded] if None not in commanded else None
        chart = planes.floor_scatter(
            floor.crowded.actions[:, pair], state, names=names, unit=unit, down=_counts_down(unit)
        )
        within = f"{floor.radius:.3g} {'training deviations' if floor.scaled else unit or ''}".strip()
        panels.append(Panel(f"{floor.observations}: {len(floor.crowded.frames)} frames within {within}", chart))
    if not panels:
        return None
    reading = (
        "The spot that demonstrations visit most: every dot is what a demonstrator did there. A policy that answers "
        "with one action cannot do better than a point amid them; if they fall into groups, the mean may be what "
        "nobody did."
    )
    if len(feature.names) > 2:
        reading += " The two action columns that vary most there are drawn."
    return Figure("How much do demonstrators disagree in one and the same spot?", reading, tuple(panels))


def lag_figure(table: Mapping[str, Any]) -> Figure | None:
    """Tracking lag, a panel for each unit."""
    data = table["dataset"]
    columns = [
        c
        for c in zip(data["action_names"], data["tracking_lag"], data["action_units"], strict=True)
        if c[1] is not None
    ]
    if not columns:
        return None
    panels = []
    for unit in dict.fromkeys(c[2] for c in columns):
        names, lags, _ = zip(*[c for c in columns if c[2] == unit], strict=True)
        panels.append(Panel("", charts.tracking_lag_bars(names, lags, unit=unit)))
    reading = (
        "Mean distance between the commanded position and where the joint was at that moment, over all frames. A "
        "policy that repeats the state makes this error at the first step, so errors are to be read against it."
    )
    return Figure("How far does the robot lag behind its commands?", reading, tuple(panels))

"""The report of the known-truth suite: a Markdown page, and its plots beside it.

What belongs here: tables and plots of goals and cells. What does not: measuring or judging
(`pipeline.statistics.known_truth`). Importing this module imports Altair.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import altair as alt
import numpy as np

from pipeline.sinks.drawing import WIDTH, Rows, chart_png, inline, number
from pipeline.sinks.palette import FAILURE, INK, MUTED, TRAINED
from pipeline.sinks.words import DASH
from pipeline.statistics.known_truth import goals
from pipeline.statistics.known_truth.generators import GENERATORS
from pipeline.statistics.known_truth.goals import Floors, Place, Result, floors_of, limits_in_words
from pipeline.statistics.known_truth.shards import Cell, code_hash

HEAD = """# Are the statistics right? The known-truth suite

Made by `demobench selftest{full} --page docs/known_truth.md`, never by hand: {minutes} minutes of one core, code {code}.

Demonstrations are drawn whose floors are known exactly, errors whose means are known, and pairs of results that differ by
nothing but chance. Every estimator, interval and verdict of this project is held against them. A number here comes with its
own uncertainty in brackets (95 %). A goal is *missed* where a number lies beyond the limit by more than {sure} standard errors,
*unsure* where it lies beyond by less.

"""


def write_page(page: Path, results: Sequence[Result], cells: Sequence[Cell], *, size: str, core_minutes: float) -> None:
    """Write the page and, in `images` beside it, a plot for each section that has something to show."""
    images = page.parent / "images"
    images.mkdir(parents=True, exist_ok=True)
    text = HEAD.format(
        full=" --full" if size == "full" else "", minutes=f"{core_minutes:.0f}", code=code_hash()[:12], sure=goals.SURE
    )
    text += _goal_table(results) + _beyond(results)
    for title, name, words, chart in _plots(results, cells):
        if chart is not None:
            (images / f"known_truth_{name}.png").write_bytes(chart_png(chart))
            text += f"## {title}\n\n{words}\n\n![{title}](images/known_truth_{name}.png)\n\n"
    text += _generator_table(cells) + _policy_table(cells)
    page.write_text(text, encoding="utf-8")


# Tables ---------------------------------------------------------------------------------------------------------------


def _goal_table(results: Sequence[Result]) -> str:
    rows = []
    for result in results:
        met = sum(result.goal.outcome(place) == "met" for place in result.places)
        worst = f"{spread(result.worst)} {result.worst.where}" if result.worst else "not measured in this run"
        outcome = f"**{result.outcome}**" if result.outcome == "missed" else result.outcome or DASH
        counted = f"{met}/{len(result.places)}" if result.places else DASH
        rows.append([result.goal.name, result.goal.words, limits_in_words(result.goal), worst, counted, outcome])
    return "## Goals\n\n" + table(["goal", "what", "limits", "the worst number", "met", ""], rows)


def _beyond(results: Sequence[Result]) -> str:
    """Every number beyond a limit, missed or unsure."""
    rows = [
        [result.goal.name, place.where, spread(place), str(place.repeats), result.goal.outcome(place)]
        for result in results
        for place in result.places
        if result.goal.outcome(place) != "met"
    ]
    return (
        "## Every number beyond its limits\n\n" + table(["goal", "where", "number", "repeats", ""], rows)
        if rows
        else ""
    )


def _generator_table(cells: Sequence[Cell]) -> str:
    """A row for each observation set of each generator and number of episodes."""
    rows = []
    for floors in sorted(floors_of(cells), key=lambda f: f.episodes):
        if floors.episodes < 30:
            continue
        positive, enough = floors.truth("rmse") > 0, floors.enough("rmse")
        judged = positive and enough
        rows.append([
            floors.where, f"{floors.truth('rmse'):.3f}", f"{goals.answers(floors).value:.0f} %",
            spread(goals.gamma_bias(floors)) if judged else DASH,
            spread(goals.holds(floors, "rmse")) if judged else DASH,
            f"{goals.floor_width(floors).value:.2f}" if judged else DASH,
            *(spread(pair_bias(floors, loss)) if positive and floors.enough(loss) else DASH for loss in ("mae", "l2")),
            _radius(floors),
        ])  # fmt: skip
    head = ["generator", "√Γ", "answered", "Γ too high by, %", "interval holds it, %", "width / spread",
            "D₀ (mae) too high by, %", "D₀ (l2) too high by, %", "radius / l2 floor"]  # fmt: skip
    words = "\n".join(f"- `{g.name}`: {g.words}, {_columns(g.dimensions)}" for g in GENERATORS.values())
    about = (
        f"{words}\n\n`answered` counts numbers, and upper limits where the floor is zero. `radius` is the estimator of the "
        "notebook that this project grew from ([protocols](protocols.md)): the mean distance of actions to their group's own "
        "mean, over the floor of the L2 error.\n\n"
    )
    return "## Floors, generator by generator\n\n" + about + table(head, rows)


def _columns(dimensions: Mapping[str, int]) -> str:
    if len(dimensions) == 1:
        return f"{next(iter(dimensions.values()))} input columns"
    return ", ".join(f"{count} input columns as '{name}'" for name, count in dimensions.items())


def pair_bias(floors: Floors, loss: str) -> Place:
    """How far the mean pair distance at one observation is too high, in percent."""
    found = floors.column(loss, "upper")[floors.answered(loss)]
    truth = floors.cell.truth[f"{floors.observations}/pair_{loss}"]
    return goals.mean(floors.where, 100 * (found / truth - 1), floors.cell)


def _radius(floors: Floors) -> str:
    values = floors.cell.columns.get(f"{floors.observations}/radius/value", np.empty(0))
    values = values[np.isfinite(values)]
    if not len(values) or floors.truth("l2") == 0:
        return DASH
    return f"{values.mean() / floors.truth('l2'):.2f}"


def _policy_table(cells: Sequence[Cell]) -> str:
    """Rates on the null that moves, one seed included, and what a weekly schedule would alarm a year."""
    rows = []
    for cell in cells:
        if cell.study == "null":
            shares = {name: goals.share("", values, cell) for name, values in cell.columns.items()}
            rows.append([
                goals.null_where(cell), *(spread(shares[name]) for name in ("alarm", "verdict", "family", "power")),
                f"{52 * shares['alarm'].value / 100:.1f} ({52 * shares['alarm'].low / 100:.1f} … "
                f"{52 * shares['alarm'].high / 100:.1f})", str(len(cell.columns["alarm"])),
            ])  # fmt: skip
    if not rows:
        return ""
    head = ["two results of one method", "gate stops it, %", "any verdict, %", "any verdict of four, %",
            "a fifth worse: gate stops it, %", "false alarms a year, weekly", "pairs"]  # fmt: skip
    about = (
        "A stored result and a new one of the same cheap policies (ridge regression on random features), five folds. With one "
        "seed a verdict is about the two networks, which do differ: that row is no goal, and the table says so beside each such "
        "verdict.\n\n"
    )
    return "## The null that moves\n\n" + about + table(head, rows)


def spread(place: Place) -> str:
    """A number with its uncertainty: `95.2 (92.6 … 96.9)`."""
    return f"{place.value:.3g} ({place.low:.3g} … {place.high:.3g})"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table and an empty line."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in lines) + "\n"


# Plots ----------------------------------------------------------------------------------------------------------------

Plot = tuple[str, str, str, alt.TopLevelMixin | None]


def _plots(results: Sequence[Result], cells: Sequence[Cell]) -> list[Plot]:
    """Title, file name, words and chart of each plot; a chart is None where a run has nothing for it."""
    floors = [f for f in floors_of(cells) if f.episodes >= 30 and f.truth("rmse") > 0 and f.enough("rmse")]
    return [
        ("How far the floor is off", "gamma",
         "Mean of Γ, the squared floor, against the truth. Dashed: the goal from 100 episodes on.",
         dots(_rows(floors, goals.gamma_bias), "Γ above the truth (%)", limits=(-5, 5))),
        ("How often a floor's interval holds it", "floor_intervals", "Dashed: the goal.",
         dots(_rows(floors, lambda f: goals.holds(f, "rmse")), "intervals that hold the floor (%)", limits=(92,))),
        ("How often there is an answer", "answers",
         "The share of data sets with a number; for the demonstrator without noise with an upper limit. Dashed: the goal for "
         "smooth generators of up to six columns.",
         dots(_rows([f for f in floors_of(cells) if f.episodes >= 30], goals.answers), "data sets with an answer (%)",
              limits=(100 * goals.ANSWERS,))),
        ("How often an interval of errors holds the mean", "intervals",
         "Errors drawn with known mean: episodes differ as a Gaussian, an exponential or a heavy-tailed (t, three degrees of "
         "freedom) number. Dashed: the goal.", coverage_lines(cells)),
        ("How often an interval of a success rate holds it", "success",
         "Exactly, for every rate. Clopper–Pearson never falls below 95 %; Wilson's does, near both ends.",
         success_lines(cells)),
    ]  # fmt: skip


def _rows(floors: Sequence[Floors], measure: Callable[[Floors], Place]) -> Rows:
    rows = []
    for each in floors:
        place = measure(each)
        rows.append({
            "label": place.where.rsplit(",", 1)[0], "episodes": str(each.episodes), "value": number(place.value),
            "low": number(place.low), "high": number(place.high),
        })  # fmt: skip
    return rows


def dots(rows: Rows, title: str, *, limits: Sequence[float]) -> alt.LayerChart | None:
    """A dot with its uncertainty for every generator and number of episodes; dashed lines at the limits."""
    if not rows:
        return None
    sizes = sorted({row["episodes"] for row in rows}, key=int)
    colour = alt.Color(
        "episodes:N", scale=alt.Scale(domain=sizes, range=[each.light for each in TRAINED[: len(sizes)]]),
        legend=alt.Legend(title="episodes"),
    )  # fmt: skip
    labels = list(dict.fromkeys(row["label"] for row in rows))
    axis = alt.Axis(labelColor=INK.light, labelFontSize=12, labelLimit=220, grid=True)
    base = alt.Chart(inline(rows)).encode(
        y=alt.Y("label:N", sort=labels, title=None, axis=axis),
        yOffset=alt.YOffset("episodes:N", sort=sizes),
        color=colour,
    )
    across = alt.X("value:Q", title=title, scale=alt.Scale(zero=False), axis=alt.Axis(tickCount=7))
    points = base.mark_point(filled=True, size=34).encode(x=across)
    whiskers = base.mark_rule(strokeWidth=1.5).encode(x="low:Q", x2="high:Q")
    return alt.layer(_limit_rules(limits, "x"), whiskers, points).properties(
        width=WIDTH, height=alt.Step(8 + 3 * len(sizes))
    )


def coverage_lines(cells: Sequence[Cell]) -> alt.LayerChart | None:
    """Coverage over the number of episodes, a line a shape; a column of plots for means and differences and seeds."""
    rows: Rows = []
    for cell in cells:
        if cell.study in ("means", "differences") and not cell.settings.get("weighted"):
            place, s = goals.coverage(cell), cell.settings
            kind = f"{cell.study}, {s['seeds']} seed{'s' * (s['seeds'] > 1)}" + (", 5 folds" if s["folds"] > 1 else "")
            rows.append({
                "shape": s["shape"], "kind": kind, "episodes": s["episodes"], "value": number(place.value),
                "low": number(place.low), "high": number(place.high),
            })  # fmt: skip
    if not rows:
        return None
    shapes = list(dict.fromkeys(row["shape"] for row in rows))
    colour = alt.Color("shape:N", scale=alt.Scale(domain=shapes, range=[c.light for c in TRAINED[: len(shapes)]]))
    sizes = alt.Axis(values=[5, 8, 10, 20, 50], grid=False)
    across = alt.X("episodes:Q", title="held-out episodes", scale=alt.Scale(type="log", nice=False), axis=sizes)
    scale = alt.Scale(domain=[86, 100], nice=False, clamp=True)
    base = alt.Chart().encode(x=across, color=colour)
    line = base.mark_line(strokeWidth=2, point=True).encode(y=alt.Y("value:Q", title="holds the mean (%)", scale=scale))
    whiskers = base.mark_rule(strokeWidth=1.5).encode(y=alt.Y("low:Q", scale=scale), y2="high:Q")
    rules = [
        alt.Chart().mark_rule(strokeDash=[6, 4], color=MUTED.light).encode(y=alt.Y(datum=limit, scale=scale))
        for limit in (92, 97)
    ]
    layers = alt.layer(*rules, whiskers, line, data=inline(rows)).properties(width=200, height=150)
    return layers.facet(facet=alt.Facet("kind:N", title=None), columns=3)


def success_lines(cells: Sequence[Cell]) -> alt.LayerChart | None:
    """Coverage of both intervals over the rate, for the fewest and the most trials."""
    mine = sorted((cell for cell in cells if cell.study == "success"), key=lambda cell: cell.settings["trials"])
    if not mine:
        return None
    rows: Rows = [
        {"what": f"{words}, {cell.settings['trials']} trials", "rate": number(100 * rate), "value": number(100 * value)}
        for cell in (mine[0], mine[-1])
        for name, words in (("clopper_pearson", "Clopper–Pearson"), ("wilson", "Wilson"))
        for rate, value in zip(cell.columns["rate"], cell.columns[name], strict=True)
    ]
    names = list(dict.fromkeys(row["what"] for row in rows))
    colours = [TRAINED[0].light, FAILURE.light, TRAINED[5].light, TRAINED[4].light][: len(names)]
    lines = (
        alt.Chart(inline(rows))
        .mark_line(strokeWidth=1.5)
        .encode(
            x=alt.X("rate:Q", title="success rate (%)", axis=alt.Axis(grid=False)),
            y=alt.Y("value:Q", title="holds the rate (%)", scale=alt.Scale(domain=[80, 100], nice=False, clamp=True)),
            color=alt.Color("what:N", scale=alt.Scale(domain=names, range=colours)),
        )
    )
    return alt.layer(lines, _limit_rules((95,), "y", alt.Scale(domain=[80, 100], nice=False))).properties(
        width=WIDTH, height=220
    )


def _limit_rules(limits: Sequence[float], channel: str, scale: alt.Scale | None = None) -> alt.Chart:
    """Dashed lines across the other axis."""
    rows: list[dict[str, Any]] = [{"limit": number(limit)} for limit in limits]
    scale = scale or alt.Scale(zero=False)
    place = alt.X("limit:Q", scale=scale) if channel == "x" else alt.Y("limit:Q", scale=scale)
    return (
        alt.Chart(inline(rows))
        .mark_rule(strokeDash=[6, 4], strokeWidth=1.5, color=MUTED.light)
        .encode(**{channel: place})
    )

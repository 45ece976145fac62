"""Charts: each a function from numbers to an Altair chart that answers one question. Nothing is computed here.

What belongs here: marks, axes and looks, one chart a function. What does not: which charts a page shows (`figures`), files.

Charts are drawn in the colours for light ground; the page swaps each for a CSS variable, so that one drawing serves light,
dark and paper. Rows are plain dictionaries with fixed field names: what a data set calls its columns is only ever a value,
never a field name or an expression. Numbers that are not finite become null. Importing this module imports Altair.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import altair as alt
import numpy as np

from pipeline.sinks.palette import FAILURE, GRID, INK, MUTED, SUCCESS, dash_of, policy_colours

WIDTH, HEIGHT = 460, 280
SQUARE = 300
Rows = list[dict[str, Any]]

CONFIG: dict[str, Any] = {
    "font": "system-ui, -apple-system, 'Segoe UI', Roboto, 'DejaVu Sans', sans-serif",
    "background": "#ffffff",
    "view": {"stroke": None},
    "axis": {
        "labelColor": MUTED.light, "titleColor": MUTED.light, "domainColor": GRID.light, "gridColor": GRID.light,
        "ticks": False, "labelPadding": 6, "labelFontSize": 11, "titleFontSize": 12, "titleFontWeight": "normal",
        "titlePadding": 8, "domain": False,
    },
    "legend": {
        "labelColor": INK.light, "orient": "bottom", "title": None, "labelFontSize": 12, "symbolStrokeWidth": 2.5,
        "symbolSize": 160, "columnPadding": 14, "labelLimit": 200,
    },
    "text": {"color": INK.light, "fontSize": 12},
}  # fmt: skip
"""How every chart looks; given to Vega-Lite beside the chart, on the page and for pictures alike."""


def chart_png(chart: alt.TopLevelMixin, *, scale: float = 2.0) -> bytes:
    """The chart as a picture on white ground, drawn without a browser or network."""
    import vl_convert

    return vl_convert.vegalite_to_png(chart.to_dict(), scale=scale, config=CONFIG, allowed_base_urls=[])


def number(value: Any) -> float | None:
    """A float with five significant digits, or None where it is missing or not finite."""
    if value is None or not math.isfinite(value):
        return None
    return float(f"{float(value):.5g}")


def with_unit(what: str, unit: str | None) -> str:
    """An axis title with its unit, as it is printed everywhere: `error (px)`."""
    return f"{what} ({unit or 'unit unknown'})"


def _data(rows: Rows) -> alt.InlineData:
    return alt.InlineData(values=rows)


def _policy_colour(policies: Iterable[str], everyone: Iterable[str], **more: Any) -> alt.Color:
    """Colour by policy. `everyone` are all policies of the benchmark: they decide which colour each one has."""
    colours, names = policy_colours(everyone), list(policies)
    scale = alt.Scale(domain=names, range=[colours[name].light for name in names])
    return alt.Color("policy:N", scale=scale, **more)


def error_over_horizon(
    curves: Mapping[str, Sequence[float]], *, fps: float, unit: str | None, everyone: Iterable[str] = ()
) -> alt.Chart:
    """Mean error at each horizon, one line a policy; hold-still is one of them.

    The vertical axis ends a little above hold-still and what was trained: a constant such as the mean action may lie
    outside, and is then cut off rather than flattening the others.

    Parameters:
        curves: policy → [H] mean absolute error at h = 0, 1, …; NaN or None where it has none.
        everyone: the names of all policies of the benchmark, for colours; default: those in `curves`.
    """
    rows = [
        {"policy": policy, "seconds": number(h / fps), "step": h, "error": number(error)}
        for policy, errors in curves.items()
        for h, error in enumerate(errors)
        if number(error) is not None
    ]
    names = list(curves)
    dashes = alt.Scale(domain=names, range=[list(dash_of(name)) for name in names])
    top = axis_top(curves)
    picked = alt.selection_point(fields=["policy"], bind="legend")
    base = alt.Chart(_data(rows)).encode(
        x=alt.X("seconds:Q", title="how far ahead (s)", axis=alt.Axis(grid=False, tickCount=6)),
        y=alt.Y("error:Q", title=with_unit("mean error", unit), scale=alt.Scale(domain=[0, top], nice=False)),
        color=_policy_colour(names, everyone or names, legend=alt.Legend(columns=3)),
        opacity=alt.condition(picked, alt.value(1.0), alt.value(0.12)),
        tooltip=[
            alt.Tooltip("policy:N"),
            alt.Tooltip("step:Q", title="steps ahead"),
            alt.Tooltip("error:Q", format=".3~g"),
        ],
    )
    lines = base.mark_line(strokeWidth=2.5, clip=True).encode(strokeDash=alt.StrokeDash("policy:N", scale=dashes, legend=None))
    first = base.mark_point(filled=True, size=45, clip=True).transform_filter("datum.step === 0")
    every = base.mark_point(filled=True, size=120, clip=True).encode(opacity=alt.value(0))
    return alt.layer(lines, first, every).add_params(picked).properties(width=WIDTH, height=HEIGHT)


def axis_top(curves: Mapping[str, Sequence[float]]) -> float:
    """Where the error axis of `error_over_horizon` ends."""
    leading = [errors for policy, errors in curves.items() if policy not in ("mean_action", "constant_velocity")]
    values = [e for errors in (leading or curves.values()) for e in errors if number(e) is not None]
    return 1.08 * max(values, default=1.0) or 1.0


def chunk_bars(rows: Sequence[Mapping[str, Any]], *, unit: str | None, hold_still: float | None, everyone=()) -> alt.Chart:
    """First-step error with its interval, a bar a policy in the order given; hold-still as a dashed line.

    Parameters:
        rows: `policy`, `error`, and `low`, `high` (None where there is no interval).
    """
    names = [row["policy"] for row in rows]
    values = [
        {"policy": row["policy"], "error": number(row["error"]), "low": number(row["low"]), "high": number(row["high"])}
        for row in rows
    ]
    shown = [v for row in values for v in (row["error"], row["high"]) if v is not None]
    highest = max([*shown, hold_still or 0.0], default=1.0)
    x = alt.X("error:Q", title=with_unit("first-step error", unit), scale=alt.Scale(domain=[0, 1.08 * highest or 1.0], nice=False))
    base = alt.Chart(_data(values)).encode(
        y=alt.Y("policy:N", sort=names, title=None, axis=alt.Axis(grid=False, labelColor=INK.light, labelFontSize=12)),
        tooltip=[alt.Tooltip(f"{field}:{kind}") for field, kind in (("policy", "N"), ("error", "Q"), ("low", "Q"), ("high", "Q"))],
    )
    bars = base.mark_bar(height={"band": 0.62}, cornerRadiusEnd=2).encode(
        x=x, color=_policy_colour(names, everyone or names, legend=None)
    )
    whiskers = base.mark_rule(strokeWidth=2, color=INK.light).encode(x=alt.X("low:Q"), x2="high:Q")
    ends = [base.mark_tick(thickness=2, size=9, color=INK.light).encode(x=alt.X(f"{end}:Q")) for end in ("low", "high")]
    layers = [bars, whiskers, *ends]
    if number(hold_still) is not None:
        still = alt.Chart(_data([{"error": number(hold_still), "label": "hold still"}])).encode(x="error:Q")
        layers += [
            still.mark_rule(strokeDash=[7, 4], strokeWidth=2, color=MUTED.light),
            still.mark_text(align="right", dx=-6, baseline="bottom", dy=-4, color=MUTED.light).encode(text="label:N", y=alt.value(0)),
        ]
    return alt.layer(*layers).properties(width=WIDTH, height=max(34 * len(names), 60))


def floor_scatter(
    actions: np.ndarray, state: np.ndarray | None, *, names: Sequence[str], unit: str | None
) -> alt.Chart:
    """What demonstrators did in one crowded spot: their actions [n, 2], the mean of them, and the state [2] itself.

    Parameters:
        state: None where actions and states are not the same quantity.
    """
    points = [{"x": number(x), "y": number(y), "what": "an action of a neighbour"} for x, y in actions]
    marks = [("mean of these actions", actions.mean(axis=0))]
    if state is not None:
        marks.append(("the state", state))
    special = [{"x": number(x), "y": number(y), "what": what} for what, (x, y) in marks]
    shapes = {"an action of a neighbour": "circle", "mean of these actions": "cross", "the state": "diamond"}
    domain = list(shapes)[: 1 + len(marks)]
    colours = dict(zip(shapes, (policy_colours(["any"])["any"].light, FAILURE.light, INK.light), strict=True))
    domains = _equal_domains(np.concatenate([actions, np.stack([at for _, at in marks])]))
    base = alt.Chart(_data([*points, *special])).encode(
        **_plane(names, unit, domains),
        shape=alt.Shape("what:N", scale=alt.Scale(domain=domain, range=[shapes[d] for d in domain])),
        color=alt.Color("what:N", scale=alt.Scale(domain=domain, range=[colours[d] for d in domain])),
        tooltip=[alt.Tooltip("what:N", title="this is"), alt.Tooltip("x:Q"), alt.Tooltip("y:Q")],
    )
    crowd = base.mark_point(filled=True, size=70, opacity=0.65).transform_filter("datum.what === 'an action of a neighbour'")
    named = base.mark_point(filled=True, size=190, opacity=1).transform_filter("datum.what !== 'an action of a neighbour'")
    return _square(alt.layer(crowd, named))


def predicted_against_recorded(
    recorded: np.ndarray, predicted: np.ndarray, *, unit: str | None, policy: str, everyone: Iterable[str] = ()
) -> alt.Chart:
    """One action column at held-out frames: predicted [n] over recorded [n]. On the diagonal the prediction is right."""
    colour = policy_colours(everyone or [policy])[policy].light
    rows = [{"x": number(x), "y": number(y)} for x, y in zip(recorded, predicted, strict=True)]
    both = np.concatenate([recorded, predicted])
    low, high = _padded(both[np.isfinite(both)])
    ends = alt.Chart(_data([{"x": low, "y": low}, {"x": high, "y": high}]))
    diagonal = ends.mark_line(color=MUTED.light, strokeDash=[4, 3], strokeWidth=1.5).encode(x="x:Q", y="y:Q")
    names = ("recorded", "predicted")
    points = (
        alt.Chart(_data(rows))
        .mark_point(filled=True, size=22, opacity=0.4, color=colour)
        .encode(**_plane(names, unit, [(low, high)] * 2), tooltip=[alt.Tooltip("x:Q", title="recorded"), alt.Tooltip("y:Q", title="predicted")])
    )
    return _square(alt.layer(diagonal, points), side=240)


def path_in_the_plane(
    recorded: np.ndarray, chunks: Sequence[np.ndarray], *, names: Sequence[str], unit: str | None, policy: str,
    everyone: Iterable[str] = (),
) -> alt.Chart:  # fmt: skip
    """One episode in the plane: the recorded actions [n, 2], and chunks [K, 2] that a policy predicted along the way."""
    colour = policy_colours(everyone or [policy])[policy].light
    lines = [{"what": "recorded", "line": -1, "step": i, "x": number(x), "y": number(y)} for i, (x, y) in enumerate(recorded)]
    for line, chunk in enumerate(chunks):
        lines += [{"what": policy, "line": line, "step": i, "x": number(x), "y": number(y)} for i, (x, y) in enumerate(chunk)]
    points = np.concatenate([recorded, *chunks])
    domains = _equal_domains(points[np.isfinite(points).all(axis=1)])
    what = alt.Color("what:N", scale=alt.Scale(domain=["recorded", policy], range=[MUTED.light, colour]))
    base = alt.Chart(_data(lines)).encode(**_plane(names, unit, domains), color=what)
    order = {"order": "step:Q", "detail": "line:N"}
    strokes = alt.StrokeWidth("what:N", scale=alt.Scale(domain=["recorded", policy], range=[4, 1.75]), legend=None)
    paths = base.mark_line(strokeCap="round", strokeJoin="round").encode(strokeWidth=strokes, **order)
    starts = base.mark_point(filled=True, size=40, opacity=1).transform_filter("datum.step === 0")
    return _square(alt.layer(paths, starts))


def columns_over_time(
    seconds: np.ndarray, series: Mapping[str, np.ndarray], *, unit: str | None, what: str, everyone: Iterable[str] = ()
) -> alt.Chart:
    """One action column of one episode over time: `recorded`, perhaps `state`, and policies' first actions, each [n]."""
    rows = [
        {"what": name, "seconds": number(t), "value": number(v)}
        for name, values in series.items()
        for t, v in zip(seconds, values, strict=True)
    ]
    names = list(series)
    colours = {"recorded": INK.light, "state": MUTED.light}
    colours |= {name: colour.light for name, colour in policy_colours(everyone or set(names) - set(colours)).items()}
    color = alt.Color("what:N", scale=alt.Scale(domain=names, range=[colours[name] for name in names]))
    widths = alt.Scale(domain=names, range=[3.5 if name == "recorded" else 1.75 for name in names])
    return (
        alt.Chart(_data(rows))
        .mark_line()
        .encode(
            x=alt.X("seconds:Q", title="time in the episode (s)", axis=alt.Axis(grid=False)),
            y=alt.Y("value:Q", title=with_unit(what, unit), scale=alt.Scale(zero=False)),
            color=color,
            strokeWidth=alt.StrokeWidth("what:N", scale=widths, legend=None),
            tooltip=[alt.Tooltip("what:N"), alt.Tooltip("seconds:Q"), alt.Tooltip("value:Q", format=".4~g")],
        )
        .properties(width=WIDTH, height=180)
    )


def tracking_lag_bars(names: Sequence[str], lag: Sequence[float | None], *, unit: str | None) -> alt.Chart:
    """How far each joint is from where it is commanded to be: mean |action − state| of position columns."""
    rows = [{"column": name, "lag": number(value)} for name, value in zip(names, lag, strict=True) if number(value) is not None]
    base = alt.Chart(_data(rows)).encode(
        y=alt.Y("column:N", sort=[row["column"] for row in rows], title=None, axis=alt.Axis(grid=False, labelColor=INK.light, labelLimit=140)),
        x=alt.X("lag:Q", title=with_unit("mean |action − state|", unit), scale=alt.Scale(domainMin=0)),
        tooltip=[alt.Tooltip("column:N"), alt.Tooltip("lag:Q")],
    )
    bars = base.mark_bar(height={"band": 0.6}, cornerRadiusEnd=2, color=MUTED.light)
    labels = base.mark_text(align="left", dx=5).encode(text=alt.Text("lag:Q", format=".3~g"))
    return alt.layer(bars, labels).properties(width=WIDTH, height=max(28 * len(rows), 50))


def rollout_paths(paths: np.ndarray, success: np.ndarray, *, names: Sequence[str], unit: str | None) -> alt.Chart:
    """Where the policy went when it drove: paths [R, L, 2], NaN after the end, by whether the task was done."""
    words = {True: "task done", False: "not done"}
    rows = [
        {"what": words[bool(done)], "line": line, "step": step, "x": number(x), "y": number(y)}
        for line, (path, done) in enumerate(zip(paths, success, strict=True))
        for step, (x, y) in enumerate(path)
        if math.isfinite(x) and step % 2 == 0
    ]
    points = paths.reshape(-1, 2)
    domains = _equal_domains(points[np.isfinite(points).all(axis=1)])
    scale = alt.Scale(domain=list(words.values()), range=[SUCCESS.light, FAILURE.light])
    dashes = alt.Scale(domain=list(words.values()), range=[[1, 0], [5, 3]])
    base = alt.Chart(_data(rows)).encode(**_plane(names, unit, domains), color=alt.Color("what:N", scale=scale))
    lines = base.mark_line(strokeWidth=1.25, opacity=0.7).encode(
        strokeDash=alt.StrokeDash("what:N", scale=dashes, legend=None), order="step:Q", detail="line:N"
    )
    starts = base.mark_point(filled=True, size=26, opacity=0.9).transform_filter("datum.step === 0")
    return _square(alt.layer(lines, starts))


def loss_curves(steps: np.ndarray, losses: np.ndarray, *, policy: str, everyone: Iterable[str] = ()) -> alt.Chart:
    """Training loss over steps, a line a seed: steps [L], losses [S, L]."""
    colour = policy_colours(everyone or [policy])[policy].light
    rows = [
        {"step": int(step), "loss": number(loss), "seed": seed}
        for seed, curve in enumerate(losses)
        for step, loss in zip(steps, curve, strict=True)
        if number(loss) is not None and loss > 0
    ]
    return (
        alt.Chart(_data(rows))
        .mark_line(strokeWidth=1.5, opacity=0.75, color=colour)
        .encode(
            x=alt.X("step:Q", title="training step", axis=alt.Axis(grid=False)),
            y=alt.Y("loss:Q", title="training loss (normalised actions)", scale=alt.Scale(type="log")),
            detail="seed:N",
            tooltip=[alt.Tooltip("seed:N"), alt.Tooltip("step:Q"), alt.Tooltip("loss:Q", format=".3~g")],
        )
        .properties(width=WIDTH, height=HEIGHT)
    )


def _plane(names: Sequence[str], unit: str | None, domains: Sequence[tuple[float, float]]) -> dict[str, Any]:
    """Both axes of a plane. Pixels count downwards, as they do on a screen."""
    axes = {}
    for channel, kind, name, domain in zip("xy", (alt.X, alt.Y), names, domains, strict=True):
        scale = alt.Scale(domain=list(domain), nice=False, reverse=channel == "y" and unit == "px" and "predicted" not in names)
        axes[channel] = kind(f"{channel}:Q", title=with_unit(name, unit), scale=scale, axis=alt.Axis(tickCount=5))
    return axes


def _square(chart: alt.LayerChart, side: int = SQUARE) -> alt.LayerChart:
    """The page keeps the plot's shape where it makes it smaller."""
    return chart.properties(width=side, height=side, usermeta={"square": True})


def _padded(values: np.ndarray) -> tuple[float, float]:
    if len(values) == 0:
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    room = 0.05 * (high - low) or 1.0
    return number(low - room), number(high + room)


def _equal_domains(points: np.ndarray) -> list[tuple[float, float]]:
    """Domains of both axes with the same span, so that distances look the same in both directions."""
    bounds = [_padded(points[:, axis]) for axis in (0, 1)]
    half = max(high - low for low, high in bounds) / 2
    return [(number((low + high) / 2 - half), number((low + high) / 2 + half)) for low, high in bounds]

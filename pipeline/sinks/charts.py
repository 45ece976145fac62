"""Charts of errors, joints and losses: each a function from numbers to one Altair chart. Nothing is computed here.

What belongs here: marks and axes, one chart a function. What does not: charts in a plane (`planes`), looks (`drawing`),
which charts a page shows (`figures`). Importing this module imports Altair.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import altair as alt
import numpy as np

from pipeline.sinks.drawing import (
    HEIGHT,
    WIDTH,
    chart_png,
    colour_by_policy,
    colour_of,
    inline,
    number,
    with_unit,
)
from pipeline.sinks.palette import INK, MUTED, policy_colours, policy_dashes

__all__ = [
    "axis_top",
    "bars_top",
    "chart_png",
    "chunk_bars",
    "columns_over_time",
    "error_over_horizon",
    "loss_curves",
    "tracking_lag_bars",
]


def error_over_horizon(
    curves: Mapping[str, Sequence[float | None]], *, fps: float, unit: str | None, everyone: Iterable[str] = (),
    top: float | None = None,
) -> alt.LayerChart:  # fmt: skip
    """Mean error at each horizon, one line a policy; hold-still is one of them.

    The vertical axis ends a little above hold-still and what was trained: a constant such as the mean action may lie
    outside, and is then cut off rather than flattening the others (`axis_top`).

    Parameters:
        curves: policy → [H] mean absolute error at h = 0, 1, …; NaN or None where it has none.
        everyone: the names of all policies of the benchmark, for colours; default: those in `curves`.
        top: where the axis ends instead, so that several charts can be compared.
    """
    rows = [
        {"policy": policy, "seconds": number(h / fps), "step": h, "error": number(error)}
        for policy, errors in curves.items()
        for h, error in enumerate(errors)
        if number(error) is not None
    ]
    names = list(curves)
    dash = policy_dashes([*everyone, *names])
    dashes = alt.Scale(domain=names, range=[list(dash[name]) for name in names])
    picked = alt.selection_point(fields=["policy"], bind="legend")
    legend = alt.Legend(symbolType="stroke", symbolSize=500)
    end = max((row["seconds"] for row in rows), default=1.0) or 1.0
    across = alt.Scale(domain=[-0.015 * end, end], nice=False)  # room for the first points, which lie at zero
    scale = alt.Scale(domain=[0, top or axis_top(curves)], nice=False)
    base = alt.Chart(inline(rows)).encode(
        x=alt.X("seconds:Q", title="how far ahead (s)", scale=across, axis=alt.Axis(grid=False, tickCount=6)),
        y=alt.Y("error:Q", title=with_unit("mean error", unit), scale=scale),
        color=colour_by_policy(names, everyone, legend=legend),
        opacity=alt.condition(picked, alt.value(1.0), alt.value(0.12)),
        tooltip=[
            alt.Tooltip("policy:N"),
            alt.Tooltip("step:Q", title="steps ahead"),
            alt.Tooltip("error:Q", format=".3~g"),
        ],
    )
    lines = base.mark_line(strokeWidth=2.5, clip=True)
    lines = lines.encode(strokeDash=alt.StrokeDash("policy:N", scale=dashes, legend=legend))
    first = base.mark_point(filled=True, size=45, clip=True).transform_filter("datum.step === 0")
    touch = base.mark_point(filled=True, size=120, clip=True).encode(opacity=alt.value(0))
    return alt.layer(lines, first, touch).add_params(picked).properties(width=WIDTH, height=HEIGHT)


def axis_top(curves: Mapping[str, Sequence[float | None]]) -> float:
    """Where the error axis of `error_over_horizon` ends."""
    leading = [errors for policy, errors in curves.items() if policy not in ("mean_action", "constant_velocity")]
    values = [number(error) for errors in (leading or curves.values()) for error in errors]
    return number(1.08 * max((v for v in values if v is not None), default=1.0)) or 1.0


def chunk_bars(
    rows: Sequence[Mapping[str, Any]], *, unit: str | None, hold_still: float | None, everyone: Iterable[str] = (),
    top: float | None = None,
) -> alt.LayerChart:  # fmt: skip
    """First-step error with its interval, a bar a row in the order given; hold-still as a dashed line.

    Parameters:
        rows: of the benchmark's table; where a policy comes with several observation sets, the bars name them.
        top: where the axis ends instead, so that several charts can be compared.
    """
    values = [_bar(row, [other["policy"] for other in rows]) for row in rows]
    scale = alt.Scale(domain=[0, top or bars_top(rows, hold_still)], nice=False)
    axis = alt.Axis(grid=False, labelColor=INK.light, labelFontSize=12, labelLimit=220)
    fields = ("error", "low", "high")
    base = alt.Chart(inline(values)).encode(
        y=alt.Y("label:N", sort=[row["label"] for row in values], title=None, axis=axis),
        tooltip=[alt.Tooltip("label:N", title="policy"), *(alt.Tooltip(f"{key}:Q", format=".3~g") for key in fields)],
    )
    bars = base.mark_bar(height={"band": 0.62}, cornerRadiusEnd=2).encode(
        x=alt.X("error:Q", title=with_unit("first-step error", unit), scale=scale, axis=alt.Axis(tickCount=6)),
        color=colour_by_policy(dict.fromkeys(row["policy"] for row in rows), everyone, legend=None),
    )
    whiskers = base.mark_rule(strokeWidth=2, color=INK.light).encode(x="low:Q", x2="high:Q")
    ends = [base.mark_tick(thickness=2, size=9, color=INK.light).encode(x=f"{end}:Q") for end in ("low", "high")]
    layers = [bars, whiskers, *ends]
    if number(hold_still) is not None:
        still = alt.Chart(inline([{"error": number(hold_still), "label": "hold still"}])).encode(x="error:Q")
        layers.append(still.mark_rule(strokeDash=[7, 4], strokeWidth=2, color=MUTED.light))
        label = still.mark_text(align="right", dx=-6, baseline="bottom", dy=-4, color=MUTED.light)
        layers.append(label.encode(text="label:N", y=alt.value(0)))
    return alt.layer(*layers).properties(width=WIDTH, height=max(34 * len(values), 60))


def bars_top(rows: Sequence[Mapping[str, Any]], hold_still: float | None) -> float:
    """Where the error axis of `chunk_bars` ends."""
    bars = [_bar(row, []) for row in rows]
    values = [bar[key] for bar in bars for key in ("error", "high")] + [number(hold_still)]
    return number(1.08 * max((v for v in values if v is not None), default=1.0)) or 1.0


def _bar(row: Mapping[str, Any], policies: Sequence[str]) -> dict[str, Any]:
    """What is drawn of a row of the table."""
    low, high = (row.get("interval") or {}).get("first_step_mae") or (None, None)
    once = policies.count(row["policy"]) < 2
    return {
        "policy": row["policy"],
        "label": row["policy"] if once else f"{row['policy']} ({row['observations']})",
        "error": number(row["first_step_mae"]),
        "low": number(low),
        "high": number(high),
    }


def columns_over_time(
    seconds: np.ndarray, series: Mapping[str, np.ndarray], *, unit: str | None, name: str, everyone: Iterable[str] = ()
) -> alt.Chart:
    """One action column of one episode over seconds: `recorded`, perhaps `state`, and first actions, each [n]."""
    rows = [
        {"what": what, "seconds": number(t), "value": number(v), "width": 3.5 if what == "recorded" else 1.75}
        for what, values in series.items()
        for t, v in zip(seconds, values, strict=True)
    ]
    names = list(series)
    colours = {"recorded": INK.light, "state": MUTED.light}
    policies = [what for what in names if what not in colours]
    colours |= {what: colour.light for what, colour in policy_colours([*everyone, *policies]).items()}
    legend = alt.Legend(symbolType="stroke", symbolSize=500)
    color = alt.Color("what:N", scale=alt.Scale(domain=names, range=[colours[what] for what in names]), legend=legend)
    return (
        alt.Chart(inline(rows))
        .mark_line()
        .encode(
            x=alt.X("seconds:Q", title="time in the episode (s)", axis=alt.Axis(grid=False)),
            y=alt.Y("value:Q", title=with_unit(name, unit), scale=alt.Scale(zero=False)),
            color=color,
            strokeWidth=alt.StrokeWidth("width:Q", scale=None),
            tooltip=[alt.Tooltip("what:N"), alt.Tooltip("seconds:Q"), alt.Tooltip("value:Q", format=".4~g")],
        )
        .properties(width=WIDTH, height=180)
    )


def tracking_lag_bars(names: Sequence[str], lag: Sequence[float | None], *, unit: str | None) -> alt.LayerChart:
    """How far each joint is from where it is commanded to be: mean |action − state| of position columns."""
    rows = [{"column": name, "lag": number(value)} for name, value in zip(names, lag, strict=True)]
    rows = [row for row in rows if row["lag"] is not None]
    axis = alt.Axis(grid=False, labelColor=INK.light, labelFontSize=12, labelLimit=150)
    highest = number(1.15 * max((row["lag"] for row in rows), default=0.0)) or 1.0
    base = alt.Chart(inline(rows)).encode(
        y=alt.Y("column:N", sort=[row["column"] for row in rows], title=None, axis=axis),
        x=alt.X(
            "lag:Q", title=with_unit("mean |action − state|", unit), scale=alt.Scale(domain=[0, highest], nice=False)
        ),
        tooltip=[alt.Tooltip("column:N"), alt.Tooltip("lag:Q", format=".4~g")],
    )
    bars = base.mark_bar(height={"band": 0.6}, cornerRadiusEnd=2, color=MUTED.light)
    labels = base.mark_text(align="left", dx=5).encode(text=alt.Text("lag:Q", format=".3~g"))
    return alt.layer(bars, labels).properties(width=WIDTH, height=max(28 * len(rows), 50))


def loss_curves(steps: np.ndarray, losses: np.ndarray, *, policy: str, everyone: Iterable[str] = ()) -> alt.Chart:
    """Training loss over steps, a line a seed: steps [L], losses [S, L]; losses that are not positive are left out."""
    rows = [
        {"step": int(step), "loss": number(loss), "seed": seed}
        for seed, curve in enumerate(losses)
        for step, loss in zip(steps, curve, strict=True)
        if number(loss) is not None and loss > 0
    ]
    return (
        alt.Chart(inline(rows))
        .mark_line(strokeWidth=1.5, opacity=0.75, color=colour_of(policy, everyone))
        .encode(
            x=alt.X("step:Q", title="training step", axis=alt.Axis(grid=False)),
            y=alt.Y("loss:Q", title="training loss (scaled actions)", scale=alt.Scale(type="log", nice=False)),
            detail="seed:N",
            tooltip=[alt.Tooltip("seed:N"), alt.Tooltip("step:Q"), alt.Tooltip("loss:Q", format=".3~g")],
        )
        .properties(width=WIDTH, height=HEIGHT)
    )

"""The chart that a reader steers: one held-out episode, one action column and one horizon at a time.

What belongs here: its marks, its choices (Vega-Lite parameters bound to menus) and the transforms that pick a line. What does
not: which lines there are (`held_out`). Importing this module imports Altair.

Names that a data set chooses are values of parameters and of rows, never part of an expression.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import altair as alt

from pipeline.sinks.drawing import WIDTH, inline
from pipeline.sinks.held_out import RECORDED, STATE_LINE, HeldOut
from pipeline.sinks.palette import INK, MUTED, policy_colours, policy_dashes

LEFT = 44
"""Room for the numbers of every vertical axis, so that the parts stand in line."""
CHOSEN = "datum.episode === episode && datum.column === column"
ASKED = "(!isValid(datum.ahead) || datum.ahead === ahead) && (!isValid(datum.sees) || datum.sees === sees)"
PREDICTED = f"datum.what !== '{RECORDED}' && datum.what !== '{STATE_LINE}'"
ERROR = "abs(datum.turn ? atan2(sin(datum.apart), cos(datum.apart)) : datum.apart)"


def held_out_chart(lines: HeldOut, *, everyone: Iterable[str] = ()) -> alt.VConcatChart:
    """Recorded and predicted actions over time, the error below, and its mean for each policy.

    Parameters:
        everyone: all policies of the benchmark: they decide on colours and dashes.
    """
    picked = alt.selection_point(name="picked", fields=["what"], bind="legend")
    base, looks = _base(lines), _looks(lines, everyone)
    parts = (_actions(base, looks, picked), _errors(base, looks), _means(lines, base, looks["color"]))
    chart = alt.vconcat(*parts, data=inline(lines.rows), spacing=26)
    return chart.add_params(*_choices(lines)).properties(usermeta={"stacked": True})


def _choices(lines: HeldOut) -> list[alt.Parameter]:
    """A menu for each thing to choose; the set only where there are several."""
    menus = [
        ("episode", "Episode", lines.episodes, lines.episodes[0]),
        ("column", "Action", lines.columns, lines.columns[0]),
    ]
    menus.append(("ahead", "How far ahead", lines.horizons, lines.begin))
    if lines.sets:
        menus.append(("sees", "Seeing", lines.sets, lines.sets[0]))
    found = [
        alt.param(name=name, value=first, bind=alt.binding_select(options=list(options), name=label))
        for name, label, options, first in menus
    ]
    return found if lines.sets else [*found, alt.param(name="sees", value=None)]


def _base(lines: HeldOut) -> alt.Chart:
    """The chosen lines, a row a point: its second, its value and how far it is from what was recorded."""
    chart = alt.Chart().transform_filter(CHOSEN)
    chart = chart.transform_filter(ASKED if lines.sets else ASKED.replace("datum.sees === sees", "true"))
    chart = chart.transform_flatten(["y"], ["value"]).transform_window(place="row_number()", groupby=["what"])
    chart = chart.transform_calculate(
        seconds="datum.first + (datum.place - 1) * datum.every",
        known=f"datum.what === '{RECORDED}' ? datum.value : null",
    )
    chart = chart.transform_joinaggregate(truth="max(known)", groupby=["place"])
    apart = "isValid(datum.value) && isValid(datum.truth) ? datum.value - datum.truth : null"
    return chart.transform_calculate(apart=apart).transform_calculate(error=f"isValid(datum.apart) ? {ERROR} : null")


def _looks(lines: HeldOut, everyone: Iterable[str]) -> dict[str, Any]:
    """Colour and dash of every line, the same in each part: two that could be confused by colour differ in dash."""
    everyone = [*everyone, *lines.policies]
    colours = {name: colour.light for name, colour in policy_colours(everyone).items()}
    colours |= {RECORDED: INK.light, STATE_LINE: MUTED.light}
    dashes = policy_dashes(everyone) | {RECORDED: (1, 0), STATE_LINE: (1, 3)}
    there = {row["what"] for row in lines.rows}
    names = [*(name for name in (RECORDED, STATE_LINE) if name in there), *lines.policies]
    legend = alt.Legend(symbolType="stroke", symbolSize=500)
    scales = (
        alt.Scale(domain=names, range=[look(name) for name in names])
        for look in (colours.get, lambda name: list(dashes[name]))
    )
    color, dash = (
        channel("what:N", scale=scale, legend=legend)
        for channel, scale in zip((alt.Color, alt.StrokeDash), scales, strict=True)
    )
    return {"color": color, "strokeDash": dash}


def _x(*, titled: bool) -> alt.X:
    title = "time in the episode (s)" if titled else None
    return alt.X("seconds:Q", title=title, scale=alt.Scale(nice=False), axis=alt.Axis(grid=False, tickCount=8))


def _title(text: str) -> alt.TitleParams:
    return alt.TitleParams(text=alt.expr(text), anchor="start", color=INK.light, fontSize=13, offset=8)


def _tips() -> list[alt.Tooltip]:
    return [alt.Tooltip("what:N"), *(alt.Tooltip(f"{key}:Q", format=".4~g") for key in ("seconds", "value", "error"))]


def _y(field: str, ticks: int, *, zero: bool) -> alt.Y:
    axis = alt.Axis(tickCount=ticks, minExtent=LEFT, maxExtent=LEFT)
    return alt.Y(field, title=None, scale=alt.Scale(zero=zero), axis=axis)


def _actions(base: alt.Chart, looks: Mapping[str, Any], picked: alt.Parameter) -> alt.LayerChart:
    y = _y("value:Q", 5, zero=False)
    shared = base.encode(
        x=_x(titled=False), y=y, opacity=alt.condition(picked, alt.value(1.0), alt.value(0.12)), **looks
    )
    broad = shared.transform_filter(f"datum.what === '{RECORDED}'").mark_line(strokeWidth=4, strokeCap="round")
    fine = shared.transform_filter(f"datum.what !== '{RECORDED}'").mark_line(strokeWidth=1.75)
    touch = base.mark_point(filled=True, size=90, opacity=0).encode(x=_x(titled=False), y=y, tooltip=_tips())
    title = _title("[column, 'episode ' + episode + ', ' + ahead]")
    return alt.layer(broad, fine, touch).add_params(picked).properties(width=WIDTH, height=230, title=title)


def _errors(base: alt.Chart, looks: Mapping[str, Any]) -> alt.LayerChart:
    y = _y("error:Q", 3, zero=True)
    lines = base.transform_filter(PREDICTED).mark_line(strokeWidth=1.5).encode(x=_x(titled=True), y=y, **looks)
    # Every row, what was recorded too: so the axis is as long as the one above.
    touch = base.mark_point(filled=True, size=90, opacity=0).encode(x=_x(titled=True), y=y, tooltip=_tips())
    return alt.layer(lines, touch).properties(
        width=WIDTH, height=90, title=_title("'How far off: |predicted − recorded|'")
    )


def _means(lines: HeldOut, base: alt.Chart, color: alt.Color) -> alt.LayerChart:
    mean = (
        base.transform_filter(f"{PREDICTED} && isValid(datum.error)")
        .transform_aggregate(error="mean(error)", groupby=["what"])
        .transform_calculate(label="datum.what + ': ' + format(datum.error, '.3~g')")
    )
    mean = mean.encode(
        y=alt.Y(
            "what:N", sort=list(lines.policies), title=None, axis=alt.Axis(labels=False, grid=False, minExtent=LEFT)
        )
    )
    bars = mean.mark_bar(height=7, yOffset=8, cornerRadiusEnd=2).encode(
        x=alt.X("error:Q", title=None, axis=alt.Axis(tickCount=5)),
        color=color,
    )
    labels = mean.mark_text(align="left", dy=-4, fontSize=12).encode(x=alt.value(1), text="label:N")
    title = _title("'How far off on average over these points'")
    return alt.layer(bars, labels).properties(width=WIDTH, height=alt.Step(30), title=title)

"""The picture of brackets: where the floor lies, and what the best policy reaches, one line an observation set and loss.

What belongs here: its marks. What does not: the numbers (`statistics.brackets`), choosing them (`figures`). Importing this
module imports Altair.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import altair as alt

from pipeline.sinks.drawing import WIDTH, colour_by_policy, inline, number, with_unit
from pipeline.sinks.palette import INK, MUTED

ROW_HEIGHT = 46


def brackets(lines: Sequence[Mapping[str, Any]], *, unit: str | None, everyone: Iterable[str] = ()) -> alt.LayerChart:
    """Brackets of one horizon, on an axis from zero.

    Parameters:
        lines: from top to bottom; `label`, `floor` (or None), `upper` (of a span, or None), `low` and `high` (95 %, or
            None), `limit` (what a refused floor does not exceed, or None), `error`, `policy` and `name` of the best.
        everyone: all policies of the benchmark: they decide on colours.
    """
    rows = [{**line, "start": 0.0, **{key: number(line[key]) for key in NUMBERS}} for line in lines]
    highest = max((row[key] for row in rows for key in NUMBERS if row[key] is not None), default=1.0)
    scale = alt.Scale(domain=[0, number(1.06 * highest) or 1.0], nice=False)
    x = alt.X("floor:Q", title=with_unit("error", unit), scale=scale, axis=alt.Axis(tickCount=6))
    axis = alt.Axis(grid=False, labelColor=INK.light, labelFontSize=12, labelLimit=150)
    y = alt.Y("label:N", sort=[row["label"] for row in rows], title=None, axis=axis)
    layers = [*_known(rows, x, y), *_refused(rows, x, y), *_best(rows, x, y, everyone)]
    return alt.layer(*layers).properties(width=WIDTH, height=ROW_HEIGHT * len(rows))


NUMBERS = ("floor", "upper", "low", "high", "limit", "error")


def _known(rows: Sequence[Mapping[str, Any]], x: alt.X, y: alt.Y) -> list[alt.Chart]:
    """A tick where the floor is one number, a light bar where it is a span; the line through either is the interval."""
    base = alt.Chart(inline([row for row in rows if row["floor"] is not None])).encode(y=y, tooltip=_tooltip())
    span = base.transform_filter("datum.upper !== null").mark_bar(height=15, color=MUTED.light, opacity=0.28)
    tick = base.transform_filter("datum.upper === null").mark_tick(thickness=4, height=19, color=INK.light)
    return [
        span.encode(x=x, x2="upper:Q"),
        base.mark_rule(strokeWidth=2, color=INK.light).encode(x=alt.X("low:Q"), x2="high:Q"),
        tick.encode(x=x),
    ]


def _refused(rows: Sequence[Mapping[str, Any]], x: alt.X, y: alt.Y) -> list[alt.Chart]:
    """A broken line from zero to what the floor does not exceed: it may lie anywhere along it."""
    base = alt.Chart(inline([row for row in rows if row["floor"] is None and row["limit"] is not None]))
    base = base.encode(y=y, tooltip=_tooltip())
    line = base.mark_rule(strokeWidth=2, strokeDash=[2, 5], color=MUTED.light).encode(x=alt.X("start:Q"), x2="limit:Q")
    arrow = base.mark_point(shape="triangle-left", filled=True, size=80, opacity=1, color=MUTED.light, xOffset=6)
    return [line, arrow.encode(x=alt.X("start:Q"))]


def _best(rows: Sequence[Mapping[str, Any]], x: alt.X, y: alt.Y, everyone: Iterable[str]) -> list[alt.Chart]:
    policies = dict.fromkeys(row["policy"] for row in rows if row["error"] is not None)
    base = alt.Chart(inline([row for row in rows if row["error"] is not None])).encode(y=y, x=alt.X("error:Q"))
    points = base.mark_point(filled=True, size=110, opacity=1)
    return [
        points.encode(color=colour_by_policy(policies, everyone, legend=None), tooltip=_tooltip()),
        base.mark_text(dy=-14, fontSize=11, color=MUTED.light).encode(text="name:N"),
    ]


def _tooltip() -> list[alt.Tooltip]:
    titles = {"floor": "floor, or its lower end", "upper": "its upper end", "limit": "not above", "error": "its error"}
    numbers = [alt.Tooltip(f"{key}:Q", title=title, format=".3~g") for key, title in titles.items()]
    return [alt.Tooltip("label:N", title="sees"), alt.Tooltip("name:N", title="best policy"), *numbers]

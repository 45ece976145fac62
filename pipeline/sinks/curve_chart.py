"""The chart of a learning curve: error against training episodes, the size doubling along the axis.

What belongs here: its marks and its picture. What does not: the numbers (`statistics.curve`). Importing this module imports
Altair.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path

import altair as alt

from pipeline.sinks.drawing import HEIGHT, WIDTH, chart_png, colour_of, inline, number, with_unit
from pipeline.sinks.palette import INK, MUTED
from pipeline.statistics.curve import Floor
from pipeline.statistics.curve_errors import Point


def learning_curve(
    points: Sequence[Point], *, what: str, unit: str | None, policy: str, everyone: Iterable[str] = (),
    floor: Floor | None = None,
) -> alt.LayerChart:  # fmt: skip
    """Means with their 95 % intervals, thin lines for single orders (or folds), and the floor as a dashed line.

    Parameters:
        points: sizes ascending; the last is the benchmark's own number.
        what: what the error is of, for the vertical axis.
        everyone: all policies of the benchmark: they decide on the colour of this one.
    """
    sizes = [point.episodes for point in points]
    means = [_row(point) for point in points]
    most = max(len(point.orders) for point in points)
    lines = [
        {"episodes": point.episodes, "error": number(error), "order": order}
        for point in points
        # The full size has one order, in which all lines end.
        for order, error in enumerate(point.orders if len(point.orders) > 1 else point.orders * most)
    ]
    room = (sizes[-1] / sizes[0]) ** 0.05
    across = alt.Scale(type="log", base=2, domain=[number(sizes[0] / room), number(sizes[-1] * room)], nice=False)
    top = max(row[key] for row in [*means, *lines] for key in ("error", "high") if row.get(key) is not None)
    x = alt.X("episodes:Q", title="training episodes", scale=across,
              axis=alt.Axis(values=sizes, grid=False, format="d", labelOverlap=False))  # fmt: skip
    y = alt.Y(
        "error:Q", title=with_unit(what, unit), scale=alt.Scale(domain=[0, number(1.08 * top) or 1.0], nice=False)
    )
    colour = colour_of(policy, everyone)
    thin = alt.Chart(inline(lines)).mark_line(strokeWidth=1, opacity=0.35, color=colour, clip=True)
    base = alt.Chart(inline(means)).encode(
        x=x,
        tooltip=[alt.Tooltip("episodes:Q"), *(alt.Tooltip(f"{k}:Q", format=".3~g") for k in ("error", "low", "high"))],
    )
    layers = [
        thin.encode(x=x, y=y, detail="order:N"),
        base.mark_rule(strokeWidth=2, color=INK.light, clip=True).encode(y=alt.Y("low:Q"), y2="high:Q"),
        base.mark_line(strokeWidth=2.5, color=colour).encode(y=y),
        base.mark_point(filled=True, size=70, color=colour, opacity=1).encode(y=y),
    ]
    if floor is not None:
        layers += _floor_line(floor)
    return alt.layer(*layers).properties(width=WIDTH, height=HEIGHT)


def _row(point: Point) -> dict[str, float | int | None]:
    low, high = point.interval or (None, None)
    return {"episodes": point.episodes, "error": number(point.error), "low": number(low), "high": number(high)}


def _floor_line(floor: Floor) -> list[alt.Chart]:
    base = alt.Chart(inline([{"error": number(floor.value), "label": floor.words}])).encode(y="error:Q")
    label = base.mark_text(align="left", baseline="bottom", dx=4, dy=-4, color=MUTED.light)
    return [
        base.mark_rule(strokeDash=[7, 4], strokeWidth=2, color=MUTED.light),
        label.encode(x=alt.value(0), text="label:N"),
    ]


def picture_curve(
    points: Sequence[Point], path: Path, *, what: str, unit: str | None, policy: str, everyone: Iterable[str] = (),
    floor: Floor | None = None,
) -> None:  # fmt: skip
    """The chart as a PNG file."""
    chart = learning_curve(points, what=what, unit=unit, policy=policy, everyone=everyone, floor=floor)
    path.write_bytes(chart_png(chart))

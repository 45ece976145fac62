"""What all charts share: looks, number and unit printing, planes with equal axes, pictures of charts.

What belongs here: helpers of `charts` and `planes`. What does not: a chart. Importing this module imports Altair.

Charts are drawn in the colours for light ground; the page swaps each for a CSS variable, so that one drawing serves
light, dark and paper. Rows are plain dictionaries with fixed field names: what a data set calls its columns is only
ever a value, never a field name or an expression. Numbers that are not finite become null.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Any

import altair as alt
import numpy as np
from altair.utils.schemapi import debug_mode

from pipeline.sinks.palette import CONFIG, policy_colours

WIDTH, HEIGHT, SQUARE = 460, 280, 300
Rows = list[dict[str, Any]]


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
    """A quantity with its unit, as it is printed everywhere: `error (px)`."""
    return f"{what} ({unit or 'unit unknown'})"


def inline(rows: Rows) -> alt.InlineData:
    """Rows as the data of a chart, inside its definition; Altair would take seconds to find that rows may be anything."""
    with debug_mode(False):
        return alt.InlineData(values=rows)


def colour_by_policy(policies: Iterable[str], everyone: Iterable[str], **more: Any) -> alt.Color:
    """Colour by the field `policy`. `everyone` are all policies of the benchmark: they decide which colour each has."""
    names = list(policies)
    colours = policy_colours([*everyone, *names])
    scale = alt.Scale(domain=names, range=[colours[name].light for name in names])
    return alt.Color("policy:N", scale=scale, **more)


def colour_of(policy: str, everyone: Iterable[str]) -> str:
    """The one colour of a policy, on light ground."""
    return policy_colours([*everyone, policy])[policy].light


def plane(
    names: Sequence[str], unit: str | None, domains: Sequence[tuple[float, float]], *, down: bool
) -> dict[str, Any]:
    """Both axes of a plane over the fields `x` and `y`; `down` for a vertical axis that counts downwards."""
    x, y = (alt.Scale(domain=list(domain), nice=False) for domain in domains)
    if down:
        y.reverse = True
    return {
        "x": alt.X("x:Q", title=with_unit(names[0], unit), scale=x, axis=alt.Axis(tickCount=5)),
        "y": alt.Y("y:Q", title=with_unit(names[1], unit), scale=y, axis=alt.Axis(tickCount=5)),
    }


def square(chart: alt.LayerChart, side: int = SQUARE) -> alt.LayerChart:
    """A plot as high as it is wide; the page keeps it so where it makes it smaller."""
    return chart.properties(width=side, height=side, usermeta={"square": True})


def padded(values: np.ndarray) -> tuple[float, float]:
    """A domain with a little room around the finite values."""
    finite = values[np.isfinite(values)]
    if len(finite) == 0:
        return 0.0, 1.0
    low, high = float(finite.min()), float(finite.max())
    room = 0.05 * (high - low) or 1.0
    return float(f"{low - room:.5g}"), float(f"{high + room:.5g}")


def equal_domains(points: np.ndarray) -> list[tuple[float, float]]:
    """Domains of both axes of points [n, 2] with the same span: distances look the same in both directions."""
    bounds = [padded(points[:, axis]) for axis in (0, 1)]
    half = max(high - low for low, high in bounds) / 2
    return [(float(f"{(low + high) / 2 - half:.6g}"), float(f"{(low + high) / 2 + half:.6g}")) for low, high in bounds]

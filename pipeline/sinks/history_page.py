"""The history of a benchmark as a chart and as a page of its own: one file, no network, nothing that runs.

What belongs here: how entries are drawn and told. What does not: the entries (`pipeline.history`). Importing this module
imports Altair.
"""

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import altair as alt

from pipeline.history import Line, in_words
from pipeline.sinks.drawing import HEIGHT, WIDTH, chart_png, colour_by_policy, inline, number, with_unit
from pipeline.sinks.markup import Html, element, join
from pipeline.sinks.page_style import style_sheet
from pipeline.sinks.palette import INK, policy_colours
from pipeline.sinks.words import DASH, plural, show, show_interval

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'"
LATEST = 30
"""So many tables are in the chart; all are on the page."""
LARGEST_TIMES = 4.0
"""Rows whose error never is within so many times the smallest are left out of the chart: they would flatten the rest."""


def history_chart(lines: Sequence[Line], *, unit: str | None) -> alt.LayerChart:
    """First-step errors with their intervals, a point a table, in the order in which the latest tables were made.

    A ring marks the champion. Tooltips name the data and the code.
    """
    points = _points(lines)
    policies = sorted({point["policy"] for point in points})
    order = [_label(place, line) for place, line in _latest(lines)]
    x = alt.X(
        "run:O", sort=order, title="table, with the commit of the code", axis=alt.Axis(grid=False, labelAngle=-40)
    )
    top = max((p["high"] or p["error"] for p in points), default=1.0)
    y = alt.Y(
        "error:Q",
        title=with_unit("first-step MAE", unit),
        scale=alt.Scale(domain=[0, number(1.08 * top) or 1.0], nice=False),
    )
    shown = {"address": "policy", "run": "table", "data": "data", "code": "code"}
    told = [alt.Tooltip(f"{key}:N", title=title) for key, title in shown.items()]
    told += [alt.Tooltip(f"{key}:Q", format=".3~g") for key in ("error", "low", "high")]
    aside = alt.XOffset("address:N", sort=sorted({point["address"] for point in points}))
    base = alt.Chart(inline(points)).encode(x=x, xOffset=aside, detail="address:N", tooltip=told)
    colour = colour_by_policy(policies, policies)
    champion = base.transform_filter("datum.champion").mark_point(size=190, strokeWidth=2, color=INK.light, opacity=1)
    layers = [
        base.mark_rule(strokeWidth=2).encode(y=alt.Y("low:Q"), y2="high:Q", color=colour),
        base.mark_point(filled=True, size=70, opacity=1).encode(y=y, color=colour),
        champion.encode(y=y),
    ]
    return alt.layer(*layers).properties(width=max(WIDTH, 90 * len(order)), height=HEIGHT)


def _points(lines: Sequence[Line]) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    for place, line in _latest(lines):
        for row in line.rows:
            if row["first_step_mae"] is None:
                continue
            low, high = row["interval"] or (None, None)
            address = f"{row['policy']}/{row['observations']}"
            found.append(
                {
                    "run": _label(place, line), "policy": row["policy"], "address": address, "champion": address == line.champion,
                    "error": number(row["first_step_mae"]), "low": number(low), "high": number(high),
                    "data": _data(line), "code": line.code,
                }
            )  # fmt: skip
    least = min((point["error"] for point in found), default=0.0)
    near = {point["address"] for point in found if point["error"] <= LARGEST_TIMES * least or point["champion"]}
    return [point for point in found if point["address"] in near]


def _latest(lines: Sequence[Line]) -> list[tuple[int, Line]]:
    return list(enumerate(lines))[-LATEST:]


def _label(place: int, line: Line) -> str:
    return f"{place + 1}: {line.when[:10]} {_commit(line)}"


def _commit(line: Line) -> str:
    """The commit of `0.1.0 (1a2b3c4)`, or the version."""
    return line.code.partition("(")[2].rstrip(")") or line.code


def _data(line: Line) -> str:
    return (
        f"{line.revision[:12]} (content {line.content_hash[:12]})"
        if line.revision
        else f"content {line.content_hash[:12]}"
    )


def picture_history(lines: Sequence[Line], *, unit: str | None) -> bytes | None:
    """The chart as a PNG; None where there is no number to draw."""
    return chart_png(history_chart(lines, unit=unit)) if _points(lines) else None


def write_history_page(
    lines: Sequence[Line], picture: bytes | None, path: Path, *, name: str, unit: str | None
) -> None:
    """The page: who the champion is, the chart, and a row for each table, the latest first."""
    last = lines[-1]
    policies = policy_colours({row["policy"] for line in lines for row in line.rows})
    head = [
        element("meta", charset="utf-8"),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", http_equiv="Content-Security-Policy", content=POLICY),
        element("title", f"{name}: history"),
        element("style", style_sheet(policies)),
    ]
    main = element(
        "main",
        element("header", element("p", "demobench", class_="brand"), element("h1", f"{name}: history")),
        element("div", element("p", in_words(last)), class_="short"),
        _chart(picture, len(lines)) if picture else None,
        element("section", element("h2", "Every table"), _rows(lines, unit)),
    )
    body = element("html", element("head", head), element("body", main), lang="en")
    path.write_text(f"<!doctype html>\n{body}\n", encoding="utf-8")


def _chart(picture: bytes, tables: int) -> Html:
    source = f"data:image/png;base64,{base64.b64encode(picture).decode()}"
    about = f"First-step errors of {plural(min(tables, LATEST), 'table')}; the numbers are in the table below"
    words = "Bars are 95 % intervals over held-out episodes and training seeds; a ring marks the champion."
    image = element("img", src=source, alt=about, style="max-width:100%;height:auto;background:#fff")
    return element("section", image, element("p", words))


def _rows(lines: Sequence[Line], unit: str | None) -> Html:
    head = ["", "made", "data", "code", "champion", f"its first-step MAE ({unit or 'unit unknown'})", "success", "said"]
    rows = [element("tr", [element("th", words, scope="col") for words in head])]
    for place, line in reversed(list(enumerate(lines))):
        row = _champions_row(line)
        cells = [
            str(place + 1), f"{line.when[:10]} {line.when[11:16]} UTC", _data(line), line.code, line.champion or DASH,
            f"{show(row['first_step_mae'])} {show_interval(row['interval'])}" if row else DASH, _success(row), in_words(line),
        ]  # fmt: skip
        rows.append(element("tr", [element("td", words) for words in cells]))
    return element(
        "div", element("table", join(rows)), class_="scroll", tabindex="0", role="region", aria_label="Every table"
    )


def _champions_row(line: Line) -> Mapping[str, Any] | None:
    return next((row for row in line.rows if f"{row['policy']}/{row['observations']}" == line.champion), None)


def _success(row: Mapping[str, Any] | None) -> str:
    rolled = row and row["rollouts"]
    if not rolled or rolled["success"] is None:
        return DASH
    low, high = rolled["success_interval"] or (None, None)
    return f"{show(rolled['success'], 2)} {show_interval((low, high), 2)} of {rolled['n']}"

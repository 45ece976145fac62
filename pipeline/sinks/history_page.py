"""The history of a benchmark as a chart and as a page of its own: one file, no network, nothing that runs.

What belongs here: how entries are drawn and told. What does not: the entries (`pipeline.history`). Importing this module
imports Altair.
"""

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import altair as alt

from pipeline.history import Line, in_words, news_words
from pipeline.sinks.drawing import HEIGHT, WIDTH, chart_png, colour_by_policy, inline, number, with_unit
from pipeline.sinks.markup import Html, element
from pipeline.sinks.page_style import drawn, style_sheet, themed
from pipeline.sinks.palette import INK, policy_colours
from pipeline.sinks.report_sections import verdict
from pipeline.sinks.words import DASH, plural, show, show_interval

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'"
REPORT = "../benchmark_report/report.html"
"""Where the report lies, seen from the page: on the disk and over http alike."""
SHAPES = {"circle": "●", "square": "■", "diamond": "◆", "triangle-up": "▲", "cross": "✚"}
"""Of points, by observation set, and how they are written."""
LATEST = 30
"""So many tables are in the page's chart; all are in its table."""
IN_PICTURE = 10
"""So many are in the picture, which nobody can scroll."""
LARGEST_TIMES = 4.0
"""Rows whose error never is within so many times the smallest are left out of the chart: they would flatten the rest."""


def history_chart(
    lines: Sequence[Line], *, unit: str | None, latest: int = LATEST, legend: bool = True
) -> alt.LayerChart:
    """First-step errors with their intervals, a point a table, in the order in which the latest tables were made.

    A ring marks the champion. Tooltips name the data and the code. The scale is beside the latest table.
    """
    points = _points(lines, latest)
    policies = sorted({point["policy"] for point in points})
    addresses, sets = (sorted({point[of] for point in points}) for of in ("address", "observations"))
    order = [_label(place, line) for place, line in _latest(lines, latest)]
    by_words = alt.Axis(
        grid=False, titleAnchor="end", labelAngle=0, labelExpr="split(datum.label, ' ')", labelLineHeight=14
    )
    x = alt.X("run:O", sort=order, title="table, when it was made, commit of the code", axis=by_words)
    top = max((p["high"] or p["error"] for p in points), default=1.0)
    y = alt.Y(
        "error:Q",
        title=with_unit("first-step MAE", unit),
        scale=alt.Scale(domain=[0, number(1.08 * top) or 1.0], nice=False),
        axis=alt.Axis(orient="right"),
    )
    shown = {"address": "policy", "run": "table", "data": "data", "code": "code"}
    told = [alt.Tooltip(f"{key}:N", title=title) for key, title in shown.items()]
    told += [alt.Tooltip(f"{key}:Q", format=".3~g") for key in ("error", "low", "high")]
    aside = alt.XOffset("address:N", sort=addresses)
    base = alt.Chart(inline(points)).encode(x=x, xOffset=aside, detail="address:N", tooltip=told)
    named = alt.Legend(symbolOpacity=1) if legend else None
    colour = colour_by_policy(policies, policies, legend=named)
    # Of a policy with two observation sets both have its colour.
    by_set = alt.Legend(symbolFillColor=INK.light, symbolStrokeColor=INK.light) if legend and len(sets) > 1 else None
    shape = alt.Shape("observations:N", scale=alt.Scale(domain=sets, range=list(SHAPES)), legend=by_set)
    champion = base.transform_filter("datum.champion").mark_point(size=210, strokeWidth=2, color=INK.light, opacity=1)
    layers = [
        base.mark_line(strokeWidth=1.5, opacity=0.45).encode(y=y, color=colour),
        base.mark_rule(strokeWidth=2).encode(y=alt.Y("low:Q"), y2="high:Q", color=colour),
        base.mark_point(filled=True, size=70, opacity=1).encode(y=y, color=colour, shape=shape),
        champion.encode(y=y),
    ]
    return alt.layer(*layers).properties(width=max(WIDTH, (40 + 5 * len(addresses)) * len(order)), height=HEIGHT)


def _points(lines: Sequence[Line], latest: int = LATEST) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    for place, line in _latest(lines, latest):
        for row in line.rows:
            if row["first_step_mae"] is None:
                continue
            low, high = row["interval"] or (None, None)
            address = f"{row['policy']}/{row['observations']}"
            found.append(
                {
                    "run": _label(place, line), "policy": row["policy"], "observations": row["observations"], "address": address,
                    "champion": address == line.champion,
                    "error": number(row["first_step_mae"]), "low": number(low), "high": number(high),
                    "data": _data(line), "code": line.code,
                }
            )  # fmt: skip
    least = min((point["error"] for point in found), default=0.0)
    near = {point["address"] for point in found if point["error"] <= LARGEST_TIMES * least or point["champion"]}
    return [point for point in found if point["address"] in near]


def _latest(lines: Sequence[Line], latest: int) -> list[tuple[int, Line]]:
    return list(enumerate(lines))[-latest:]


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
    return chart_png(history_chart(lines, unit=unit, latest=IN_PICTURE)) if _points(lines, IN_PICTURE) else None


def write_history_page(lines: Sequence[Line], path: Path, *, name: str, unit: str | None) -> None:
    """The page: who the champion is, the chart, and a row for each table, the latest first."""
    policies = policy_colours({row["policy"] for line in lines for row in line.rows})
    head = [
        element("meta", charset="utf-8"),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"),
        element("meta", http_equiv="Content-Security-Policy", content=POLICY),
        element("link", rel="icon", href="data:,"),
        element("title", f"{name}: history"),
        element("style", style_sheet(policies)),
    ]
    report = element("a", "the report of the latest table", href=REPORT)
    main = element(
        "main",
        element(
            "header",
            element("p", "demobench", class_="brand"),
            element("h1", f"{name}: history"),
            element("p", f"{plural(len(lines), 'table')} · ", report, class_="facts"),
        ),
        element("div", element("p", in_words(lines[-1])), class_="short"),
        _chart(lines, unit) if _points(lines) else None,
        element("section", element("h2", "Every table"), _rows(lines, unit)),
    )
    body = element("html", element("head", head), element("body", main), lang="en")
    path.write_text(f"<!doctype html>\n{body}\n", encoding="utf-8")


def _chart(lines: Sequence[Line], unit: str | None) -> Html:
    """The chart in the reader's colours, as wide as it is: a narrow screen shows the latest tables and scrolls to the others."""
    chart = history_chart(lines, unit=unit, legend=False)
    about = f"First-step errors of {plural(min(len(lines), LATEST), 'table')}; the numbers are in the table below"
    words = "Bars are 95 % intervals over held-out episodes and training seeds; a ring marks the champion."
    at_the_left = "direction:ltr;width:max-content;margin:0 auto 0 0"
    picture = element("div", drawn(themed(chart.to_dict())), role="img", aria_label=about, style=at_the_left)
    # A box that is read from the right is scrolled to its right end.
    box = {
        "class_": "scroll",
        "tabindex": "0",
        "role": "region",
        "aria_label": "Chart",
        "style": "direction:rtl;border:0",
    }
    return element("section", element("div", picture, **box), _legend(_points(lines)), element("p", words))


def _legend(points: Sequence[Mapping[str, Any]]) -> Html:
    """Colours, and shapes where there are several observation sets; beside the chart, so that it stays where the chart scrolls."""
    policies, sets = (sorted({point[of] for point in points}) for of in ("policy", "observations"))
    named = [
        element("span", element("span", class_="swatch", data_policy=policy), policy, style="margin-right:1.2em")
        for policy in policies
    ]
    if len(sets) > 1:
        named += [f"{mark} {name}  " for mark, name in zip(cycle(SHAPES.values()), sets, strict=False)]
    return element("p", named, class_="facts")


def _rows(lines: Sequence[Line], unit: str | None) -> Html:
    """On narrow screens a list of cells that say their heading, as the tables of the report are."""
    heads = [
        "table",
        "champion",
        f"first-step MAE ({unit or 'unit unknown'})",
        "trained anew",
        "success",
        "data and code",
    ]
    rows = []
    for place, line in reversed(list(enumerate(lines))):
        row = _champions_row(line)
        error = (show(row["first_step_mae"]), show_interval(row["interval"])) if row else (DASH, None)
        cells = [
            (f"{place + 1}: {line.when[:10]}", f"{line.when[11:16]} UTC"), (line.champion or DASH, None), error,
            (verdict(line.regression and line.regression["word"]), None), _success(row), (_data(line), line.code),
        ]  # fmt: skip
        told = [
            element("td", content, element("small", below) if below else None, data_head=head)
            for head, (content, below) in zip(heads, cells, strict=True)
        ]
        rows.append(element("tr", told, element("td", news_words(line), class_="wraps", data_head="what was said")))
    names = [element("th", head, class_="left", scope="col") for head in (*heads, "what was said")]
    inner = element("table", element("thead", element("tr", names)), element("tbody", rows))
    return element("div", inner, class_="scroll words", tabindex="0", role="region", aria_label="Every table")


def _champions_row(line: Line) -> Mapping[str, Any] | None:
    return next((row for row in line.rows if f"{row['policy']}/{row['observations']}" == line.champion), None)


def _success(row: Mapping[str, Any] | None) -> tuple[str, str | None]:
    """The champion's success, and its interval with the number of roll-outs."""
    rolled = row and row["rollouts"]
    if not rolled or rolled["success"] is None:
        return DASH, None
    low, high = rolled["success_interval"] or (None, None)
    return show(rolled["success"], 2), f"{show_interval((low, high), 2)} of {rolled['n']}"

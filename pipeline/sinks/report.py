"""The page of a benchmark: one HTML file that opens anywhere, without a network.

What belongs here: the page's order, wording and safety. What does not: choosing pictures (`figures`), drawing them,
numbers.

The page holds its own copy of the Vega libraries. Its content security policy allows only the scripts whose hashes it
names and no request to anywhere, so even a name that slipped through the escaping could not run.
"""

import base64
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.methods import METHODS
from pipeline.sinks import explanations, replacing
from pipeline.sinks.markup import Html, element, join, json_for_script, script_text
from pipeline.sinks.page_style import draw_script, style_sheet, themed
from pipeline.sinks.report_table import benchmark_table, column_table
from pipeline.sinks.words import common_unit, plural, show, show_interval

if TYPE_CHECKING:
    from pipeline.sinks.figures import Figure

Table = Mapping[str, Any]


@dataclass(frozen=True)
class Provenance:
    """What a reader needs to make the page again.

    command   the command line that gives these numbers
    history   frames of history that every policy may see
    version   of this project, with a commit where there is one
    made_at   when, in words; empty leaves it out
    warnings  what differed from expectation in the data set
    """

    command: str
    history: int
    version: str
    made_at: str = ""
    warnings: tuple[str, ...] = ()


def write_report(path: Path, table: Table, figures: Sequence["Figure"], provenance: Provenance) -> None:
    """Write the page of one data set.

    Parameters:
        table: one object of `run --json`.
        figures: from `figures.benchmark_figures`, in order.

    Raises:
        StoreError: the file cannot be written.
    """
    page = render_report(table, figures, provenance)
    with replacing(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def render_report(table: Table, figures: Sequence["Figure"], provenance: Provenance) -> str:
    """The whole page as text."""
    specs = [themed(panel.chart.to_dict()) for figure in figures for panel in figure.panels]
    bundle, draw = _vega_bundle(), draw_script()
    policies = [row["policy"] for row in table["policies"]]
    head = [
        element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content=_policy(bundle, draw)),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"),
        element("link", rel="icon", href="data:,"),
        element("title", f"{table['dataset']['name']} · demobench"),
        element("style", style_sheet(policies)),
    ]
    scripts = [
        element("script", json_for_script(specs), type="application/json", id="charts"),
        element("script", bundle),
        element("script", draw),
    ]
    body = element("body", element("main", _body(table, _figures(figures, specs), provenance)), scripts)
    return f"<!doctype html>\n{element('html', element('head', head), body, lang='en')}\n"


@cache
def _vega_bundle() -> Html:
    """Vega, Vega-Lite and Vega-Embed with all that they need, as one script."""
    import vl_convert

    return script_text(vl_convert.javascript_bundle())


def _policy(*scripts: str) -> str:
    hashes = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
    allowed = " ".join(f"'sha256-{digest}'" for digest in hashes)
    return (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )


def _body(table: Table, figures: Html, provenance: Provenance) -> list[Html | None]:
    return [
        element(
            "header", element("p", "demobench", class_="brand"), element("h1", table["dataset"]["name"]), _facts(table)
        ),
        _in_short(table),
        element("section", benchmark_table(table), _notes(table), column_table(table)),
        _warnings(provenance.warnings),
        element("noscript", element("p", "The pictures below need JavaScript; nothing is loaded from anywhere.")),
        figures,
        element(
            "section",
            element("h2", "How each number was made"),
            _definitions(explanations.numbers(table, provenance.history)),
        ),
        element("section", element("h2", "Make it again"), _again(table, provenance)),
    ]


def _facts(table: Table) -> Html:
    """The lines under the title: the data, and the settings that the numbers depend on."""
    return join([element("p", join(*_dotted(line)), class_="facts") for line in explanations.facts(table)])


def _dotted(parts: Sequence[str]) -> list[Html]:
    spans = [element("span", part) for part in parts]
    return [piece for span in spans for piece in (Html(" · "), span)][1:]


def _in_short(table: Table) -> Html | None:
    """The answer in a sentence or two, before the table."""
    rows = [row for row in table["policies"] if row["first_step_mae"] is not None]
    driven = [row for row in table["policies"] if row["rollouts"]]
    if not rows:
        return None
    unit = common_unit(table["dataset"]["action_units"]) or ""
    return element("p", _best_offline(rows, unit), _best_driven(driven) if driven else None, class_="short")


def _best_offline(rows: Sequence[Mapping[str, Any]], unit: str) -> Html:
    best = min(rows, key=lambda row: row["first_step_mae"])
    interval = show_interval((best.get("interval") or {}).get("first_step_mae"))
    ratio = best["vs_hold_still"]
    value = element("b", f"{show(best['first_step_mae'])} {unit}".strip())
    than_still = f", {show(ratio)} × smaller than holding still" if ratio is not None and ratio > 1 else ""
    return join(
        "The lowest first-step error is that of ", _who(best), ": ", value, f" {interval}".rstrip(), than_still, ". "
    )


def _best_driven(rows: Sequence[Mapping[str, Any]]) -> Html:
    most = max(rows, key=lambda row: (row["rollouts"]["success"], row["rollouts"]["score"]))
    n, rate, interval = most["rollouts"]["n"], most["rollouts"]["success"], most["rollouts"].get("success_interval")
    if rate == 0:
        score = element("b", show(most["rollouts"]["score"]))
        none = f"In closed loop no policy succeeds from any of {n} start states; the highest score is that of "
        return join(none, _who(most), ": ", score, ".")
    count = element("b", f"{round(rate * n)} of {n}")
    percent = f" ({100 * interval[0]:.0f}–{100 * interval[1]:.0f} %)" if show_interval(interval) else ""
    return join("In closed loop ", _who(most), " succeeds most often: ", count, percent, ".")


def _who(row: Mapping[str, Any]) -> Html:
    """A policy, and what it sees if its answer depends on that."""
    sees = row["method"] not in METHODS or METHODS[row["method"]].uses_observations
    return join(element("b", row["policy"]), f" seeing {row['observations']}" if sees else None)


def _notes(table: Table) -> Html:
    return element("ul", [element("li", note) for note in explanations.notes(table)], class_="notes")


def _warnings(warnings: Sequence[str]) -> Html | None:
    if not warnings:
        return None
    items = [element("li", warning) for warning in warnings]
    return element("aside", element("h2", f"About the data: {plural(len(warnings), 'warning')}"), element("ul", items))


def _figures(figures: Sequence["Figure"], specs: Sequence[Mapping[str, Any]]) -> Html:
    """Figures with places for their charts, numbered through the page as the script finds them; small ones in pairs."""
    sections, place = [], 0
    for figure in figures:
        panels = []
        for panel in figure.panels:
            is_square = bool(specs[place].get("usermeta", {}).get("square"))
            label = f"{figure.question} {panel.caption}".strip()
            slot = element("div", class_="chart", data_chart=place, role="img", aria_label=label)
            caption = element("figcaption", panel.caption) if panel.caption else None
            panels.append(element("figure", caption, slot, class_="square" if is_square else None))
            place += 1
        is_wide = len(panels) > (2 if is_square else 1)
        head = [element("h2", figure.question), element("p", figure.reading)]
        body = element("div", panels, class_="panels")
        sections.append(element("section", head, body, class_="card wide" if is_wide else "card"))
    return element("div", sections, class_="figures")


def _definitions(entries: Mapping[str, str]) -> Html:
    return element("dl", [element("div", element("dt", term), element("dd", text)) for term, text in entries.items()])


def _again(table: Table, provenance: Provenance) -> list[Html]:
    opened = explanations.files(table)
    parts = [
        element("pre", element("code", provenance.command)),
        _definitions(explanations.identity(table, provenance.version, provenance.made_at)),
    ]
    if opened:
        parts += [element("h3", "The files beside this page"), _definitions(opened)]
    return parts

"""The page of a benchmark: one HTML file that opens anywhere, without a network.

What belongs here: the page's order, wording and safety. What does not: choosing pictures (`figures`), drawing them,
numbers.

The page holds its own copy of the Vega libraries. Its content security policy allows only the scripts whose hashes it
names and no request to anywhere, so even a name that slipped through the escaping could not run.
"""

import base64
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.sinks import explanations, replacing
from pipeline.sinks.findings import BEST, FLOOR, MORE, Command, Sentence, Strong, answers, key_of
from pipeline.sinks.markup import Html, element, join, json_for_script, script_text
from pipeline.sinks.page_style import draw_script, drawn, style_sheet, themed
from pipeline.sinks.report_sections import (
    closed_loop_section,
    comparison_section,
    floor_section,
    modes_section,
    sensor_section,
)
from pipeline.sinks.report_table import benchmark_table, column_table
from pipeline.sinks.report_video import Clip, video_section
from pipeline.sinks.words import plural

if TYPE_CHECKING:
    from pipeline.sinks.figures import Figure

Table = Mapping[str, Any]
NO_SCRIPT = (
    "Without JavaScript the pictures below stand still: nothing can be chosen in them, or read off by pointing at it. The script "
    "is in this file; nothing is loaded from anywhere."
)
MOST_STILL = 250_000
"""Characters of a picture for readers without JavaScript; a larger one is left out, and its place says so."""


@dataclass(frozen=True)
class Provenance:
    """What a reader needs to make the page again.

    command   the command line that gives these numbers
    history   frames of history that every policy may see
    version   of this project, with a commit where there is one
    made_at   when, in words; empty leaves it out
    warnings  what differed from expectation in the data set
    settings  all of them, as the text of a `demobench.toml`; empty leaves them out
    needs     whether the command needs them in a file
    """

    command: str
    history: int
    version: str
    made_at: str = ""
    warnings: tuple[str, ...] = ()
    settings: str = ""
    needs: bool = False


def write_report(
    path: Path,
    table: Table,
    figures: Sequence["Figure"],
    provenance: Provenance,
    clips: Sequence[Clip] = (),
    no_clips: Mapping[str, str] | None = None,
) -> None:
    """Write the page of one data set.

    Parameters:
        table: one object of `run --json`.
        figures: from `figures.benchmark_figures`, in order.
        clips: videos of roll-outs.
        no_clips: observation set → why there is none of it, where there should be one.

    Raises:
        StoreError: the file cannot be written.
    """
    page = render_report(table, figures, provenance, video_section(clips, no_clips or {}))
    with replacing(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def render_report(table: Table, figures: Sequence["Figure"], provenance: Provenance, videos: Html | None = None) -> str:
    """The whole page as text."""
    specs = [themed(panel.chart.to_dict()) for figure in figures for panel in figure.panels]
    bundle, draw = _vega_bundle(), draw_script()
    policies = [row["policy"] for row in table["policies"]]
    head = [
        element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content=_policy(bundle, draw, videos=videos is not None)),
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
    body = element(
        "body", element("main", _body(table, figures, _sections(figures, specs), provenance, videos)), scripts
    )
    return f"<!doctype html>\n{element('html', element('head', head), body, lang='en')}\n"


@cache
def _vega_bundle() -> Html:
    """Vega, Vega-Lite and Vega-Embed with all that they need, as one script."""
    import vl_convert

    return script_text(vl_convert.javascript_bundle())


def _policy(*scripts: str, videos: bool) -> str:
    """What the page may load: the scripts it holds, pictures that it holds and, where it has any, videos that it holds."""
    hashes = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
    allowed = " ".join(f"'sha256-{digest}'" for digest in hashes)
    return (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; img-src data:; "
        f"{'media-src data:; ' if videos else ''}"
        "base-uri 'none'; form-action 'none'"
    )


def _body(
    table: Table,
    figures: Sequence["Figure"],
    sections: Mapping[str, list[Html]],
    provenance: Provenance,
    videos: Html | None,
) -> list[Html | None]:
    return [
        element(
            "header", element("p", "demobench", class_="brand"), element("h1", table["dataset"]["name"]), _facts(table)
        ),
        _in_short(table, figures),
        element("section", benchmark_table(table), _notes(table), column_table(table)),
        _warnings(provenance.warnings),
        element("noscript", element("p", NO_SCRIPT)),
        floor_section(table, sections["floors"]),
        sensor_section(table),
        modes_section(table),
        comparison_section(table),
        closed_loop_section(table),
        videos,
        element("div", sections["policies"], class_="figures"),
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


HINTS = {
    FLOOR: "The floor: the least error of any policy that gives one answer to what it sees.",
    BEST: "Hold-still stays where it is: what a policy must beat.",
}
"""What a question's words mean, for those who read them for the first time."""


def _in_short(table: Table, figures: Sequence["Figure"]) -> Html | None:
    """The answer before the table: one sentence large, what else is known by the question that it answers."""
    found = answers(table)
    if not found:
        return None
    found |= {MORE: [[figure.answer] for figure in figures if figure.answer] or _not_asked(table)}
    question = next(iter(found))
    first, *found[question] = found[question]
    rows = [_question(question, sentences) for question, sentences in found.items() if sentences]
    return element("div", element("p", [_part(part) for part in first]), element("dl", rows), class_="short")


def _question(question: str, sentences: Sequence[Sentence]) -> Html:
    hint = element("small", HINTS[question]) if question in HINTS else None
    said = element("dd", [element("p", [_part(part) for part in sentence]) for sentence in sentences])
    return element("div", element("dt", question, hint), said)


def _not_asked(table: Table) -> list[Sentence]:
    return [
        ["Not asked yet: ", Command(f"demobench curve {key_of(table)}"), " trains on ever fewer of them, and tells."]
    ]


def _part(part: str) -> Html | str:
    if isinstance(part, Command):
        return element("code", part)
    return element("b", part) if isinstance(part, Strong) else part


def _notes(table: Table) -> Html:
    return element("ul", [element("li", note) for note in explanations.notes(table)], class_="notes")


def _warnings(warnings: Sequence[str]) -> Html | None:
    if not warnings:
        return None
    items = [element("li", warning) for warning in warnings]
    return element("aside", element("h2", f"About the data: {plural(len(warnings), 'warning')}"), element("ul", items))


def _sections(figures: Sequence["Figure"], specs: Sequence[Mapping[str, Any]]) -> dict[str, list[Html]]:
    """Figures with places for their charts, numbered through the page, by what they are about."""
    sections: dict[str, list[Html]] = {"floors": [], "policies": []}
    place = 0
    for figure in figures:
        sections[figure.about].append(_figure(figure, place, specs))
        place += len(figure.panels)
    return sections


def _figure(figure: "Figure", place: int, specs: Sequence[Mapping[str, Any]]) -> Html:
    """One question with its charts, the first at `place` among all; small ones in pairs."""
    panels = []
    for number, panel in enumerate(figure.panels, place):
        is_square = bool(specs[number].get("usermeta", {}).get("square"))
        label = f"{figure.question} {panel.caption}".strip()
        still = element("noscript", _still(json.dumps(specs[number])))
        slot = element("div", still, class_="chart", data_chart=number, role="img", aria_label=label)
        caption = element("figcaption", panel.caption) if panel.caption else None
        menus = element("div", class_="menus", data_menus=number) if _has_menus(specs[number]) else None
        panels.append(element("figure", caption, menus, slot, class_="square" if is_square else None))
    is_wide = len(panels) > (2 if is_square else 1) or menus is not None
    head = [element("h2" if figure.about == "policies" else "h3", figure.question), element("p", figure.reading)]
    body = element("div", panels, class_="panels")
    return element("section", head, body, class_="card wide" if is_wide else "card")


@lru_cache(maxsize=64)
def _still(spec: str) -> Html:
    """A chart as it looks before anything is chosen, in the page's colours; the script draws it again where there is one."""
    picture = drawn(json.loads(spec), aria=False)
    if len(picture) <= MOST_STILL:
        return picture
    return element("p", "This picture has too many points to stand here without JavaScript.")


def _has_menus(spec: Mapping[str, Any]) -> bool:
    """Whether a reader chooses what a chart shows: the menus stand above it, outside of what is one picture."""
    return any(isinstance(param.get("bind"), dict) for param in spec.get("params", ()))


def _definitions(entries: Mapping[str, str]) -> Html:
    return element("dl", [element("div", element("dt", term), element("dd", text)) for term, text in entries.items()])


def _again(table: Table, provenance: Provenance) -> list[Html | None]:
    opened = explanations.files(table)
    where = f"In a folder {'that holds the settings below as' if provenance.needs else 'without a'} demobench.toml:"
    listed = element("pre", element("code", provenance.settings), tabindex="0")
    folded = element("details", element("summary", "All settings, as a demobench.toml"), listed)
    parts = [
        element("p", where),
        element("pre", element("code", provenance.command)),
        folded if provenance.settings else None,
        _definitions(explanations.identity(table, provenance.version, provenance.made_at)),
    ]
    if opened:
        beside = "The files beside this page; commands are for the folder that it lies in"
        parts += [element("h3", beside), _definitions(opened)]
    return parts

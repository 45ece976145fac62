"""The page's looks: style sheet, colours as CSS variables, and the script that draws the charts.

What belongs here: CSS and JavaScript. What does not: content. Colours are variables of which the reader's setting
(light or dark) or paper picks one value; charts are SVG that refers to them, so nothing is drawn again when it changes.
"""

from collections.abc import Iterable
from typing import Any

from pipeline.sinks.markup import Html, json_for_script, script_text
from pipeline.sinks.palette import CONFIG, FAILURE, GRID, INK, MUTED, SUCCESS, Colour, all_colours, policy_colours

PAGE = Colour("#ffffff", "#14171b")


def variable(colour: Colour) -> str:
    """The CSS variable of a colour, named after its value on light ground."""
    return f"--c{colour.light[1:]}"


def themed(spec: Any) -> Any:
    """A chart's definition with every colour replaced by its CSS variable. Data is left alone."""
    swaps = {colour.light: f"var({variable(colour)})" for colour in all_colours()}
    return _swap(spec, swaps)


def drawn(spec: Any, **looks: Any) -> Html:
    """A chart as a picture inside the page, in the page's colours; nothing is loaded for it. `looks` are more of Vega's config."""
    import vl_convert

    config = themed(CONFIG) | {"background": "transparent"} | looks
    return Html(vl_convert.vegalite_to_svg(spec, config=config, allowed_base_urls=[]))


def _swap(value: Any, swaps: dict[str, str]) -> Any:
    if isinstance(value, dict):
        kept = ("datasets", "data", "$schema")
        return {key: item if key in kept else _swap(item, swaps) for key, item in value.items() if key != "$schema"}
    if isinstance(value, list):
        return [_swap(item, swaps) for item in value]
    return swaps.get(value, value) if isinstance(value, str) else value


def _colour_rules(policies: Iterable[str]) -> list[str]:
    def block(theme: str) -> str:
        return "".join(f"{variable(colour)}:{getattr(colour, theme)};" for colour in (*all_colours(), PAGE))

    rules = [
        f":root{{{block('light')}}}",
        f"@media screen and (prefers-color-scheme:dark){{:root{{{block('dark')}}}}}",
    ]
    for policy, colour in policy_colours(policies).items():
        rules.append(f'[data-policy="{_css_string(policy)}"]{{--policy:var({variable(colour)})}}')
    return rules


def _css_string(text: str) -> str:
    """Text inside a quoted CSS string: all but ASCII letters, digits, `_` and `-` are written as their numbers."""
    return "".join(c if c.isascii() and (c.isalnum() or c in "_-") else f"\\{ord(c):x} " for c in text)


STYLE = """
:root {
  color-scheme: light dark;
  --ink: var(INK); --muted: var(MUTED); --line: var(GRID); --page: var(PAGE);
  --soft: color-mix(in srgb, var(INK) 4%, var(PAGE)); --edge: color-mix(in srgb, var(INK) 28%, transparent);
}
* { box-sizing: border-box; }
body {
  margin: 0; background: var(--page); color: var(--ink); -webkit-text-size-adjust: 100%;
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif;
}
main { max-width: 1340px; margin: 0 auto; padding: 40px 24px 72px; }
h1 { margin: 2px 0 10px; font-size: 34px; line-height: 1.15; letter-spacing: -.015em; overflow-wrap: anywhere; }
h2 { margin: 0 0 6px; font-size: 20px; line-height: 1.3; letter-spacing: -.005em; }
h3 { margin: 24px 0 4px; font-size: 16px; }
section { margin-top: 44px; }
.brand { margin: 0; color: var(--muted); font-size: 13px; letter-spacing: .08em; text-transform: uppercase; }
.facts { margin: 2px 0; color: var(--muted); font-size: 14px; }
.facts span { display: inline-block; }
section > p { max-width: 78ch; }
.short { margin: 26px 0 -14px; }
.short > p { max-width: 72ch; margin: 0; font-size: 20px; line-height: 1.45; }
.short dl { display: block; margin: 14px 0 0; font-size: 15.5px; }
.short dl > div {
  display: grid; gap: 2px 28px; grid-template-columns: 15.5em minmax(0, 78ch); padding: 9px 0;
  border-top: 1px solid var(--line);
}
.short dt small { display: block; color: var(--muted); font-size: 13px; font-weight: 400; line-height: 1.35; }
.short dd { color: inherit; }
.short dd p { margin: 0 0 3px; }
.short code { font-size: .88em; overflow-wrap: anywhere; }
.verdict { white-space: nowrap; }
.verdict.better { color: var(SUCCESS); }
.verdict.worse { color: var(FAILURE); }
.words th, .words td { text-align: left; }
.words .wraps { min-width: 30ch; max-width: 62ch; white-space: normal; }

/* Where a table goes on beyond an edge, a shadow lies on that edge: the first two grounds move along and cover it. */
.scroll {
  overflow-x: auto; border-block: 1px solid var(--line);
  background:
    linear-gradient(90deg, var(--page) 30%, transparent) 0 0 / 48px 100% no-repeat local,
    linear-gradient(270deg, var(--page) 30%, transparent) 100% 0 / 48px 100% no-repeat local,
    linear-gradient(90deg, var(--edge), transparent) 0 0 / 16px 100% no-repeat scroll,
    linear-gradient(270deg, var(--edge), transparent) 100% 0 / 16px 100% no-repeat scroll;
}
.sideways { display: none; }
.scroll:focus-visible, summary:focus-visible { outline: 2px solid var(--ink); outline-offset: 2px; }
table {
  width: 100%; border-collapse: separate; border-spacing: 0; font-size: 13.5px; font-variant-numeric: tabular-nums;
}
caption {
  position: sticky; left: 0; width: max-content; max-width: calc(100vw - 32px); padding: 8px 7px;
  color: var(--muted); font-size: 13px; text-align: left;
}
th, td {
  padding: 6px 7px; border-top: 1px solid var(--line);
  font-weight: 400; text-align: right; vertical-align: top; white-space: nowrap;
}
thead th { font-weight: 600; vertical-align: bottom; font-size: 13px; line-height: 1.3; white-space: normal; }
td small, th small { display: block; color: var(--muted); font-size: 12px; font-weight: 400; line-height: 1.35; }
td small.beside { display: inline; }
td small.late { white-space: normal; }
td b { font-weight: inherit; }
td.best, td.best b { font-weight: 700; }
td.none { color: var(--muted); }
.left, .name { text-align: left; }
.name { position: sticky; left: 0; z-index: 1; background: var(--page); }
tbody th.name small { padding-left: 19px; }
tbody tr:hover > * { background: var(--soft); }
tr.baseline .name, tr.baseline td { color: var(--muted); }
.swatch {
  display: inline-block; width: 11px; height: 11px; margin-right: 8px; border-radius: 3px; background: var(--policy);
}
tr.baseline .swatch { border-radius: 50%; }
.range {
  display: block; position: relative; width: 118px; height: 9px; margin: 3px 0 1px auto;
  border-left: 1px solid var(--line);
  background: linear-gradient(var(--line), var(--line)) 0 4px / 100% 1px no-repeat;
}
.range i { position: absolute; }
.whisker { top: 3px; height: 3px; min-width: 1px; border-radius: 2px; background: var(--policy); }
.dot { top: 0; width: 9px; height: 9px; margin-left: -4.5px; border-radius: 50%; background: var(--policy); }
.beyond { top: 0; margin-left: -4px; border: 4.5px solid transparent; border-left: 7px solid var(--policy); }
.notes { max-width: 96ch; margin: 12px 0 18px; padding-left: 20px; color: var(--muted); font-size: 14px; }
details { margin-top: 14px; }
details .scroll { margin-top: 8px; }
summary {
  width: fit-content; padding: 6px 14px; border: 1px solid var(--line); border-radius: 6px; background: var(--soft);
  font-size: 15px; cursor: pointer;
}
aside { margin-top: 36px; padding: 14px 20px; border-left: 3px solid var(FAILURE); background: var(--soft); }
aside h2 { font-size: 16px; }
aside ul { margin: 6px 0; padding-left: 20px; font-size: 15px; overflow-wrap: anywhere; }

.figures { display: grid; gap: 48px 44px; grid-template-columns: repeat(2, minmax(0, 1fr)); margin-top: 48px; }
.figures section { margin: 0; }
.figures.brackets { margin: 22px 0 26px; }
.figures.brackets h3 { margin: 0 0 4px; }
.figures .wide { grid-column: 1 / -1; }
.card > p { margin: 0 0 14px; color: var(--muted); font-size: 15px; }
.panels { display: grid; gap: 22px 34px; grid-template-columns: repeat(auto-fit, minmax(min(100%, 420px), 1fr)); }
.panels:has(.square) { grid-template-columns: repeat(auto-fill, minmax(min(100%, 250px), 1fr)); }
.wide .panels:has(.square) { grid-template-columns: repeat(auto-fill, minmax(min(100%, 330px), 1fr)); }
figure { min-width: 0; margin: 0; break-inside: avoid; }
figure:only-child { max-width: 720px; }
figure:only-child:has(.menus) { max-width: 1040px; }
.clips { display: grid; gap: 24px; max-width: 1024px; margin-top: 14px; }
.clips figure:only-child { max-width: none; }
.clips video { display: block; width: 100%; height: auto; border-radius: 8px; }
.clips p { max-width: 100ch; margin: 6px 0 0; color: var(--muted); font-size: 14px; }
.menus { display: flex; flex-wrap: wrap; gap: 8px 22px; margin-bottom: 10px; }
.menus label { display: flex; gap: 8px; align-items: baseline; font-size: 14px; }
.menus .vega-bind-name { color: var(--muted); }
.menus select {
  max-width: 60vw; padding: 5px 8px; border: 1px solid var(--muted); border-radius: 6px; background: var(--page);
  color: var(--ink); font: inherit;
}
figcaption { margin-bottom: 4px; font-size: 14px; font-weight: 600; overflow-wrap: anywhere; }
.chart { width: 100%; min-height: 60px; }
.chart svg { max-width: 100%; height: auto; overflow: visible; }
.chart.failed { color: var(--muted); font-size: 14px; }
#vg-tooltip-element {
  position: fixed; z-index: 9; visibility: hidden; padding: 7px 10px; border: 1px solid var(--line);
  border-radius: 6px; background: var(--page); box-shadow: 0 2px 10px rgb(0 0 0 / .18); font-size: 13px;
}
#vg-tooltip-element.visible { visibility: visible; }
#vg-tooltip-element td { padding: 1px 4px; border: 0; text-align: left; }
#vg-tooltip-element .key { color: var(--muted); }

dl {
  display: grid; gap: 10px 40px; grid-template-columns: repeat(auto-fit, minmax(min(100%, 440px), 1fr));
  margin: 10px 0 0; font-size: 15px;
}
dt { font-weight: 600; }
dd { margin: 0; color: var(--muted); overflow-wrap: anywhere; }
pre {
  padding: 12px 16px; border: 1px solid var(--line); border-radius: 6px; background: var(--soft);
  white-space: pre-wrap; overflow-wrap: anywhere;
}
code { font: 14px/1.5 ui-monospace, SFMono-Regular, Menlo, Consolas, "DejaVu Sans Mono", monospace; }

@media screen and (max-width: 1180px) {
  .sideways { display: inline; }
}
@media screen and (max-width: 900px) {
  .figures { display: block; }
  .figures section { margin-top: 40px; }
}
@media screen and (max-width: 600px) {
  main { padding: 22px 16px 48px; }
  h1 { font-size: 27px; }
  h2 { font-size: 18px; }
  .scroll { margin-inline: -16px; }
  th, td { padding: 7px 8px; }
  .name { padding-left: 16px; box-shadow: 1px 0 0 var(--line); }
  .short > p { font-size: 18px; }
  .short dl > div { grid-template-columns: minmax(0, 1fr); }
  .range { width: 104px; }
  .words { margin-inline: 0; }
  .words thead { display: none; }
  .words table, .words caption, .words tbody { display: block; }
  .words tr {
    display: grid; gap: 6px 12px; grid-template-columns: minmax(0, 1.4fr) repeat(2, minmax(0, 1fr)); padding: 10px 0;
    border-top: 1px solid var(--line);
  }
  .words td { padding: 0; border: 0; white-space: normal; overflow-wrap: anywhere; }
  .words td::before { content: attr(data-head); display: block; color: var(--muted); font-size: 12px; }
  .words .wraps { grid-column: 1 / -1; min-width: 0; }
}
@media print {
  @page { size: A4 landscape; margin: 12mm; }
  :root { color-scheme: light; }
  * { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
  body { font-size: 10.5pt; }
  main { max-width: none; padding: 0; }
  section { margin-top: 24px; }
  h1, h2, h3, figcaption, summary, section > p { break-after: avoid; }
  tr, figure, dl > div, .card > p { break-inside: avoid; }
  caption, thead { break-after: avoid; }
  tbody tr:first-child { break-before: avoid; }
  .short + section { break-before: page; }
  .short { margin: 16px 0 0; }
  .short > p { font-size: 14pt; }
  .short dl { font-size: 10.5pt; }
  .short dl > div { padding: 5px 0; }
  .scroll { overflow: visible; background: none; }
  .name, caption { position: static; }
  caption { max-width: none; }
  table { font-size: 8pt; }
  thead th, td small, th small { font-size: 7pt; }
  th, td { padding: 3px 5px; }
  .range { width: 96px; }
  .words .wraps { min-width: 0; }
  summary { padding: 0; border: 0; background: none; list-style: none; }
  details::details-content { display: block; content-visibility: visible; }
  .menus { display: none; }
  .figures { display: block; }
  .figures section { margin-top: 24px; }
  .card { break-inside: avoid; }
  .figures > .card:not(.wide) { display: inline-block; width: 47%; margin-right: 2%; vertical-align: top; }
  .chart svg { max-height: 150mm; }
  figure:has(.menus) svg { width: auto; max-height: 125mm; }
  .panels:has(.square) { grid-template-columns: repeat(auto-fill, minmax(min(100%, 190px), 1fr)); }
  .wide .panels:has(.square) { grid-template-columns: repeat(auto-fill, minmax(min(100%, 280px), 1fr)); }
  .notes, caption, .card > p, .clips p, dl { font-size: 9.5pt; }
  p, li, dd { orphans: 3; widows: 3; }
  .clips { display: block; }
  .clips figure { margin-bottom: 20px; }
  .wide .square svg { width: auto; max-height: 66mm; }
  .clips video { width: auto; max-width: 100%; max-height: 135mm; }
  video::-webkit-media-controls { display: none; }
}
@media print and (max-width: 820px) {
  .short dl > div { grid-template-columns: 11em minmax(0, 1fr); }
  .scroll:not(.words) table { font-size: 5.6pt; }
  .scroll:not(.words) :is(thead th, td small, th small) { font-size: 5pt; }
  .scroll:not(.words) :is(th, td) { padding: 2px; }
  .scroll:not(.words) .swatch { width: 6px; height: 6px; margin-right: 3px; border-radius: 2px; }
  .scroll:not(.words) tbody th.name small { padding-left: 9px; }
  .range { display: none; }
  .figures > .card:not(.wide) { display: block; width: auto; margin-right: 0; }
}
"""

DRAW = """
"use strict";
const charts = JSON.parse(document.getElementById("charts").textContent);
const options = {
  mode: "vega-lite", renderer: "svg", actions: false, defaultStyle: false, ast: true, config: CONFIG,
  tooltip: {disableDefaultStyle: true},
};
if (document.body.clientWidth < 520) options.config.legend.columns = 2;
function fitted(spec, width) {
  if (spec.usermeta && spec.usermeta.square) {
    const side = Math.max(160, Math.min(spec.width, width - 76));
    return {...spec, width: side, height: side};
  }
  if (spec.usermeta && spec.usermeta.stacked) return widened(spec, Math.max(220, width - 56));
  return {...spec, width: "container", autosize: {type: "fit-x", contains: "padding"}};
}
function widened(view, width) {
  return view.vconcat ? {...view, vconcat: view.vconcat.map((part) => widened(part, width))} : {...view, width};
}
for (const place of document.querySelectorAll("[data-chart]")) {
  const spec = charts[Number(place.dataset.chart)];
  const menus = document.querySelector(`[data-menus="${place.dataset.chart}"]`);
  vegaEmbed(place, fitted(spec, place.clientWidth), menus ? {...options, bind: menus} : options).then(() => {
    // The place is one picture with one description; marks inside that call themselves pictures would need theirs.
    place.querySelector("svg").setAttribute("aria-hidden", "true");
  }).catch((error) => {
    place.classList.add("failed");
    place.textContent = "This picture could not be drawn: " + error.message;
  });
}
"""
"""Draws every chart into its place. Expressions run in Vega's interpreter (`ast`), since the page allows no `eval`."""


def style_sheet(policies: Iterable[str]) -> Html:
    """The page's whole style: looks, the variables for light, dark and paper, and a rule for each policy's colour."""
    rules = STYLE
    named = {"INK": INK, "MUTED": MUTED, "GRID": GRID, "PAGE": PAGE, "SUCCESS": SUCCESS, "FAILURE": FAILURE}
    for name, colour in named.items():
        rules = rules.replace(f"var({name})", f"var({variable(colour)})")
    return Html("\n".join([rules, *_colour_rules(policies)]))


def draw_script() -> Html:
    """The script that draws the charts in the page's colours."""
    config = themed(CONFIG) | {"background": "transparent"}
    return script_text(DRAW.replace("CONFIG", json_for_script(config)))

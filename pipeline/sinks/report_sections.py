"""The page's sections on floors, sensors and comparisons: what was concluded, and every number behind it.

What belongs here: these three sections. What does not: sentences that the terminal says too (`findings`), charts
(`bracket_chart`), how the numbers are made (`explanations`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.sinks import findings
from pipeline.sinks.findings import LOSSES, MARKS, ahead, capital
from pipeline.sinks.markup import Html, element, join
from pipeline.sinks.words import DASH, is_number, show, show_interval

Table = Mapping[str, Any]

MOST_LINES = 12
"""A longer table is folded away under a line that says what it holds."""
METRICS = {
    "first_step_mae": "first action", "at_one_second_mae": "one second ahead", "success": "success", "score": "score",
}  # fmt: skip


def verdict(word: str | None) -> Html | str:
    """A verdict as a mark and a word: colour alone would not tell everybody."""
    if word is None:
        return DASH
    return element("span", f"{MARKS[word]} {word}", class_=f"verdict {word.replace(' ', '-')}")


@dataclass(frozen=True)
class Cell:
    """What stands in a cell, in small letters below it, and whether it is a sentence."""

    content: Any
    below: Any = None
    wraps: bool = False


def _table(caption: str, heads: Sequence[str], rows: Sequence[Sequence[Cell]], summary: str) -> Html:
    """A table of words, on narrow screens a list of cells that say their heading; a long one is folded under `summary`."""
    names = [element("th", head, class_="left", scope="col") for head in heads]
    body = [element("tr", [_td(head, cell) for head, cell in zip(heads, row, strict=True)]) for row in rows]
    inner = element(
        "table", element("caption", caption), element("thead", element("tr", names)), element("tbody", body)
    )
    scroll = element("div", inner, class_="scroll words", tabindex="0", role="region", aria_label=summary)
    return element("details", element("summary", summary), scroll) if len(rows) > MOST_LINES else scroll


def _td(head: str, cell: Cell) -> Html:
    small = element("small", cell.below) if cell.below else None
    return element("td", cell.content, small, class_="wraps" if cell.wraps else None, data_head=head)


# Floors ---------------------------------------------------------------------------------------------------------------


def floor_section(table: Table, figures: Sequence[Html]) -> Html | None:
    """How small the error of a deterministic policy can get; None where nothing was held against a floor."""
    floors = findings.floors_of(table)
    if not floors or not table["brackets"]:
        return None
    floors = sorted(floors, key=lambda floor: (floor["horizon"], list(LOSSES).index(floor["loss"])))
    rows = [_floor_row(table, floor) for floor in floors]
    unit = findings.dataset_unit(table).strip()
    heads = ["When", "Sees", "Error", f"Floor{f', {unit}' if unit else ''}", "Best policy", "What lies between"]
    said = (
        "People do different things in the same place. A policy that gives one answer there is wrong about some of them, "
        "however well it is trained: the least error that it can have is the floor. A policy at its floor gains nothing from "
        "more training, more data or a larger network; only from seeing more, or from being allowed several answers. So a "
        "floor belongs to what a policy sees."
    )
    caption = "Floors, and the best policy that sees no more. Numbers in brackets are 95 % intervals."
    return element(
        "section",
        element("h2", "How good can it get?"),
        element("p", said),
        element("div", figures, class_="figures brackets"),
        _table(caption, heads, rows, f"All {len(rows)} floors as numbers, and why some are missing"),
    )


def modes_section(table: Table) -> Html | None:
    """Whether people do several things at the same observation; None where nothing was looked for."""
    if not table.get("modes"):
        return None
    said = (
        "A floor says how much actions scatter, not how. Here a network that may give several answers was held against the "
        "same network with one, on episodes that neither saw. Several peaks with few sensors can be missing information: "
        "look at what sees more."
    )
    heads = ["When", "Sees", "Answer"]
    fps = table["dataset"]["fps"]
    rows = [
        [
            Cell(capital(ahead(one["horizon"], fps))),
            Cell(one["observations"]),
            Cell(_modes_words(one), wraps=True),
        ]
        for one in table["modes"]
    ]
    caption = "Evidence of modes. Numbers in brackets are 95 % intervals."
    return element(
        "section",
        element("h2", "Do people do several things in the same place?"),
        element("p", said),
        _table(caption, heads, rows, f"All {len(rows)} answers"),
    )


def _modes_words(one: Mapping[str, Any]) -> str:
    """The answer without where and when, which stand in cells of their own."""
    at = f"With '{one['observations']}' at horizon {one['horizon']} "
    return capital(one["words"].removeprefix(at)) if one["words"] else f"Not looked for: {one['refused']}"


def _floor_row(table: Table, floor: Mapping[str, Any]) -> list[Cell]:
    bracket = findings.bracket_of(table, floor)
    frames = f"{floor['history']} frame{'s' * (floor['history'] != 1)}"
    best = DASH if bracket is None else show(bracket["upper"])
    name = findings.name_in(table, bracket["upper_policy"]) if bracket else "no policy looks so far"
    why = findings.why_not(floor, bracket)
    if why is not None:
        limit = findings.limit_words(table, floor, bracket)
        value, beside, between = "none", None, f"No floor: {why}.{f' It is {limit}.' if limit else ''}"
    else:
        value, beside = _floor_value(floor)
        between = findings.gap_words(bracket, findings.dataset_unit(table)) if bracket else ""
    return [
        Cell(capital(ahead(floor["horizon"], table["dataset"]["fps"]))), Cell(floor["observations"], frames),
        Cell(LOSSES[floor["loss"]]), Cell(value, beside), Cell(best, name), Cell(capital(between), wraps=True),
    ]  # fmt: skip


def _floor_value(floor: Mapping[str, Any]) -> tuple[str, str]:
    """One number with its interval, or the span in which it lies with the interval of the span."""
    interval = show_interval(floor["interval"])
    if not is_number(floor["upper"]):
        return show(floor["value"]), interval
    return f"{show(floor['value'])} to {show(floor['upper'])}", interval


# Sensors --------------------------------------------------------------------------------------------------------------


def sensor_section(table: Table) -> Html | None:
    """By how much the floor falls when more is seen; None where no observation set holds another."""
    sensors = table["sensors"]
    if not sensors:
        return None
    title = element("h2", "What is each sensor worth?")
    if not any(is_number(sensor["value"]) or is_number(sensor["at_least"]) for sensor in sensors):
        pairs = ", ".join(dict.fromkeys(f"{s['smaller']} to {s['larger']}" for s in sensors))
        why = "no floor could be given that would show how far it falls; the reasons are in the table above."
        return element("section", title, element("p", f"Not known for {pairs}: {why}"))
    horizons = sorted({sensor["horizon"] for sensor in sensors})
    found = {(s["smaller"], s["larger"], s["horizon"]): s for s in sensors}
    pairs = list(dict.fromkeys((s["smaller"], s["larger"]) for s in sensors))
    frames = {floor["observations"]: floor["history"] for floor in findings.floors_of(table)}
    rows = [
        [
            Cell(join(_sees(a, frames), " → ", _sees(b, frames))),
            *(_sensor_cell(found.get((a, b, h))) for h in horizons),
        ]
        for a, b in pairs
    ]
    unit = findings.dataset_unit(table)
    heads = ["From what is seen, to more", *(capital(ahead(h, table["dataset"]["fps"])) for h in horizons)]
    said = (
        f"By how much the floor (RMSE{f',{unit}' if unit else ''}) falls when a policy sees more: what a sensor, or more "
        "frames, could gain at best. Where the floor falls a lot, what looked like people disagreeing was missing "
        "information. “At least”: no floor could be given for the larger set, but what it does not exceed is so much below "
        "the interval of the smaller set's floor. “Not known”: too little is known of the smaller set's floor, or of both."
    )
    return element(
        "section",
        title,
        element("p", said),
        _table("Fall of the floor, with 95 % intervals.", heads, rows, "What each sensor is worth"),
    )


def _sees(name: str, frames: Mapping[str, int]) -> Html:
    count = frames.get(name)
    beside = element("small", f" {count} frame{'s' * (count != 1)}", class_="beside") if count else None
    return join(name, beside)


def _sensor_cell(sensor: Mapping[str, Any] | None) -> Cell:
    if sensor is None:
        return Cell(DASH)
    if is_number(sensor["at_least"]):
        return Cell(f"at least {show(sensor['at_least'])}")
    if not is_number(sensor["value"]):
        return Cell("not known")
    low, high = sensor["interval"]
    interval = show_interval((low, high))
    if low <= 0:
        return Cell("no fall seen", f"{show(sensor['value'])} {interval}")
    return Cell(element("b", show(sensor["value"])), f"{interval}, {sensor['words'].rpartition(', ')[2]}")


# Comparisons ----------------------------------------------------------------------------------------------------------


def comparison_section(table: Table) -> Html | None:
    """Every comparison of the table, and how many share the correction."""
    comparisons = table["comparisons"]
    if not comparisons:
        return None
    unit = findings.dataset_unit(table)
    in_unit = f",{unit}" if unit else ""
    heads = [
        "Policy",
        "Against",
        "Verdict",
        f"Difference{in_unit}",
        "p, Holm",
        f"Seen from{in_unit}",
        "In words",
    ]
    said = (
        f"{findings.families_words(table)} Each pair is compared on the same held-out episodes, over which the "
        "difference must stand out, and over training seeds too where there are several. “Seen from” is the smallest "
        "difference that such a test of one pair would notice four times out of five. “Cannot tell” does not mean equal."
    )
    rows = [_comparison_row(table, comparison) for comparison in comparisons]
    summary = f"All {len(rows)} comparisons: {_tally(comparisons)}"
    caption = "Difference of mean absolute errors, below zero where the policy is better; 95 % intervals."
    return element(
        "section",
        element("h2", "Which differences are real?"),
        element("p", said),
        _table(caption, heads, rows, summary),
    )


def closed_loop_section(table: Table) -> Html | None:
    """Every comparison in closed loop; None where fewer than two policies were rolled out."""
    comparisons = (table.get("closed_loop") or {}).get("comparisons")
    if not comparisons:
        return None
    heads = ["Policy", "Against", "Verdict", "Difference", "p, Holm", "Seen from", "In words"]
    several = any((row["rollouts"] or {}).get("seeds", 1) > 1 for row in table["policies"])
    how = (
        "Of each start state the mean over training seeds is compared: the difference must stand out over start states, and over "
        "seeds too. "
        if several
        else "One network of each is compared, its success by McNemar's exact test; nothing is said of other training seeds. "
    )
    said = (
        f"{findings.driven_family_words(table)} Every policy acts from the same start states, which stand here for episodes. "
        f"{how}“Cannot tell” does not mean equal."
    )
    rows = [_comparison_row(table, comparison) for comparison in comparisons]
    caption = "Difference of success rates (1 is 100 points) or scores, above zero where the policy is better; 95 % intervals."
    return element(
        "section",
        element("h2", "Which policies do better in closed loop?"),
        element("p", said),
        _table(caption, heads, rows, f"All {len(rows)} comparisons in closed loop: {_tally(comparisons)}"),
    )


def _tally(comparisons: Sequence[Mapping[str, Any]]) -> str:
    counts = {word: sum(comparison["word"] == word for comparison in comparisons) for word in MARKS}
    return ", ".join(f"{count} {word}" for word, count in counts.items() if count)


def _comparison_row(table: Table, comparison: Mapping[str, Any]) -> list[Cell]:
    difference = comparison["difference"]
    signed = DASH if difference is None else f"{'−' if difference < 0 else '+'}{show(abs(difference))}"
    interval = show_interval(comparison["interval"]).replace("-", "−")
    return [
        Cell(findings.name_in(table, comparison["a"]), METRICS.get(comparison["metric"], comparison["metric"])),
        Cell(findings.name_in(table, comparison["b"])),
        Cell(verdict(comparison["word"])),
        Cell(signed, interval),
        Cell(_p(comparison["p_holm"])),
        Cell(show(comparison["smallest_seen"])),
        Cell(capital(comparison["words"]), wraps=True),
    ]


def _p(p: float | None) -> str:
    return DASH if p is None else "< 0.001" if p < 0.001 else f"{p:.3f}"

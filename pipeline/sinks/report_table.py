"""The page's table: one row a policy × observation set, and the first-step error by action column below it.

What belongs here: columns, cells and their wording. What does not: the rest of the page (`report`), any arithmetic
beyond finding a column's best value.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from pipeline.sinks.findings import MARKS, address, champion, driven_word, first_step_gap, gap_parts, is_seen, ranks
from pipeline.sinks.markup import Html, element, join
from pipeline.sinks.palette import is_baseline
from pipeline.sinks.report_sections import verdict
from pipeline.sinks.words import DASH, common_unit, decimals_for, is_number, percent, show, show_interval

Row = Mapping[str, Any]
SIDEWAYS = element("span", "This table scrolls sideways.", class_="sideways")
"""Shown where a screen is too narrow for the table."""


@dataclass(frozen=True)
class Column:
    """A column: its heading, what stands below it, a row's value (a number, or a word), and which end is better, if either."""

    title: str
    below: str
    value: Callable[[Row], Any]
    better: Literal["low", "high"] | None = None
    cell: Callable[[Row, str], Html | str] | None = None
    decimals: int | None = None


def benchmark_table(table: Mapping[str, Any]) -> Html:
    """The table of one object of `run --json`; closed-loop columns only where something was rolled out."""
    rows = table["policies"]
    columns = _columns(table)
    heads = [_head("Policy", "and what it sees", class_="name")]
    heads += [_head(column.title, column.below) for column in columns]
    decimals = [
        decimals_for([column.value(row) for row in rows]) if column.decimals is None else column.decimals
        for column in columns
    ]
    bests = [_best(column, rows) for column in columns]
    body = []
    for row in rows:
        cells = [_name_cell(row)]
        for column, places, best in zip(columns, decimals, bests, strict=True):
            cells.append(_cell(column, row, places, best))
        body.append(element("tr", cells, class_="baseline" if is_baseline(row["policy"]) else None))
    caption = ["Policies, lowest first-step error on top. Bold: the best value of its column. ", SIDEWAYS]
    inner = element(
        "table", element("caption", caption), element("thead", element("tr", heads)), element("tbody", body)
    )
    return element("div", inner, class_="scroll", tabindex="0", role="region", aria_label="Benchmark table")


def _name_cell(row: Row) -> Html:
    """A policy with its colour, and below it the observation set that it sees."""
    swatch = element("span", class_="swatch", data_policy=row["policy"], aria_hidden="true")
    name = f"{row['policy']} (seen in training)" if is_seen(row) else row["policy"]
    return element("th", swatch, name, element("small", row["observations"]), class_="name", scope="row")


def _columns(table: Mapping[str, Any]) -> list[Column]:
    unit = common_unit(table["dataset"]["action_units"]) or ""
    scale = _scale(table["policies"])
    columns = [
        Column(
            "First-step MAE", _and(unit, "95 % interval"), lambda row: row["first_step_mae"], "low",
            lambda row, shown: _with_interval(row, shown, scale),
        ),
        Column(
            "× hold-still", "ratio, tested", lambda row: row["vs_hold_still"], "high",
            lambda row, shown: _with_verdict(shown, row["verdict"]["vs_hold_still"]), 2,
        ),
        *_champion(table),
        Column("RMSE", unit, lambda row: row["first_step_rmse"], "low"),
        *_floor(table, unit),
        Column(
            "At 1 s", _and("MAE", unit), lambda row: row["at_one_second_mae"], "low",
            lambda row, shown: _with_verdict(shown, row["verdict"]["vs_hold_still_at_one_second"]),
        ),
        Column("Whole chunk", _and("MAE", unit), lambda row: row["whole_chunk_mae"]),
        Column("Scaled", "deviations", lambda row: row["scaled"], "low"),
    ]  # fmt: skip
    if any(row["rollouts"] for row in table["policies"]):
        columns += [
            Column(
                "Success",
                "95 % interval, tested",
                lambda row: _of(row, "success"),
                "high",
                lambda row, _: _with_verdict(_success(row), driven_word(table, address(row))),
            ),
            Column("Score", "best reward", lambda row: _of(row, "score"), "high", _score, 3),
            *_stepped_in(table),
        ]
    return [
        *columns,
        Column("Params", "of one net; training of all", lambda row: row["params"], None, _network),
        Column("Latency", "ms a call", lambda row: row["latency_ms"], None, _late, 3),
    ]


def _champion(table: Mapping[str, Any]) -> list[Column]:
    """Verdicts against the champion, where one was named."""
    named = champion(table)
    if named is None:
        return []

    def word(row: Row) -> str | None:
        return "champion" if address(row) == named else row["verdict"]["vs_champion"]

    return [Column("Against", "the champion", word, None, lambda _, said: verdict(said) if said in MARKS else said, 0)]


def _floor(table: Mapping[str, Any], unit: str) -> list[Column]:
    """How far each row is above the floor of what it sees, where any is."""
    if not any(first_step_gap(row) for row in table["policies"]):
        return []

    def gap(row: Row) -> float | None:
        return (first_step_gap(row) or {}).get("gap")

    return [Column("Above floor", _and("RMSE", unit), gap, None, _above_floor)]


def _with_verdict(shown: str, word: str | None) -> Html | str:
    return shown if word is None else join(shown, element("small", verdict(word)))


def _above_floor(row: Row, _: str) -> Html:
    short, beside = gap_parts(first_step_gap(row))
    return join(short, element("small", beside) if beside else None)


def _and(*words: str) -> str:
    return ", ".join(word for word in words if word)


def _head(title: str, below: str, class_: str | None = None) -> Html:
    return element("th", title, element("small", below) if below else None, class_=class_, scope="col")


def _best(column: Column, rows: Sequence[Row]) -> Any:
    if column.better is None:
        return None
    values = [value for row in rows if ranks(row) and is_number(value := column.value(row))]
    if len(set(values)) < 2:
        return None
    return min(values) if column.better == "low" else max(values)


def _cell(column: Column, row: Row, decimals: int, best: Any) -> Html:
    value = column.value(row)
    applies = isinstance(value, str) or is_number(value)
    shown = value if isinstance(value, str) else show(value, decimals)
    content = column.cell(row, shown) if column.cell and applies else shown
    if best is not None and value == best:
        return element("td", content, class_="best")
    return element("td", content, class_=None if applies else "none")


def _of(row: Row, key: str) -> float | None:
    return row["rollouts"].get(key) if row["rollouts"] else None


def _scale(rows: Sequence[Row]) -> float:
    """The right end of the small interval pictures. Constants such as the mean action may lie beyond it."""
    leading = [row for row in rows if row["policy"] not in ("mean_action", "constant_velocity")] or rows
    highs = [
        max(row["first_step_mae"], *(_interval(row) or (0.0,))) for row in leading if is_number(row["first_step_mae"])
    ]
    return 1.08 * max(highs, default=0.0) or 1.0


def _interval(row: Row) -> Sequence[float] | None:
    interval = (row.get("interval") or {}).get("first_step_mae")
    return interval if show_interval(interval) else None


def _with_interval(row: Row, shown: str, scale: float) -> Html:
    """The error, its interval, and both as a small picture on an axis from zero that all rows share."""
    interval = _interval(row)
    decimals = len(shown.partition(".")[2])
    text = show_interval(interval, decimals)
    low, high = interval if text else (row["first_step_mae"],) * 2
    left, right, at = (100 * min(max(v / scale, 0.0), 1.0) for v in (low, high, row["first_step_mae"]))
    marks = [
        element("i", class_="whisker", style=f"left:{left:.1f}%;width:{right - left:.1f}%"),
        element("i", class_="dot" if row["first_step_mae"] <= scale else "beyond", style=f"left:{at:.1f}%"),
    ]
    picture = element("span", marks, class_="range", data_policy=row["policy"], aria_hidden="true")
    return join(element("b", shown), " ", element("small", text, class_="beside") if text else None, picture)


def _score(row: Row, shown: str) -> Html:
    text = show_interval(row["rollouts"].get("score_interval"), 3)
    return join(element("b", shown), element("small", text) if text else None)


def _success(row: Row) -> Html:
    rollouts = row["rollouts"]
    done = round(rollouts["success"] * rollouts["episodes"])
    interval = rollouts.get("success_interval")
    text = f"{100 * interval[0]:.0f}–{100 * interval[1]:.0f} %" if show_interval(interval) else ""
    return join(element("b", f"{done}/{rollouts['episodes']}"), element("small", text))


def _stepped_in(table: Mapping[str, Any]) -> list[Column]:
    """What the safety layer did, where it had anything to do."""
    if not any(_of(row, "interventions") for row in table["policies"]):
        return []

    def share(row: Row) -> float | None:
        found = _of(row, "intervened")
        return None if found is None else 100 * found

    def by_how_much(row: Row, shown: str) -> Html | str:
        size = _of(row, "mean_intervention")
        return join(shown, element("small", f"by {percent(size)}")) if is_number(size) else shown

    return [Column("Safety", "stepped in, % of frames", share, None, by_how_much, 2)]


def _late(row: Row, shown: str) -> Html | str:
    """The median, with the 99th percentile and what it misses below."""
    late = row.get("latency_p99_ms")
    if not is_number(late):
        return shown
    missed = element("small", "misses its deadline", class_="late") if row["misses_deadline"] else None
    return join(shown, element("small", f"99 %: {show(late)}"), missed)


def _network(row: Row, _: str) -> Html:
    """Parameters of one network, and below them the seconds that training took."""
    seconds = row["train_s"]
    took = f"{seconds:,.0f} s" if seconds and seconds >= 10 else f"{seconds:.1f} s" if seconds else ""
    return join(f"{row['params']:,}" if row["params"] else DASH, element("small", took) if took else None)


def column_table(table: Mapping[str, Any]) -> Html | None:
    """First-step error of every action column, in its own unit; None where there is only one column."""
    data, rows = table["dataset"], table["policies"]
    names, units = data["action_names"], data["action_units"]
    if len(names) < 2:
        return None
    heads = [_head("Policy", "and what it sees", class_="name")]
    heads += [_head(name, unit or "") for name, unit in zip(names, units, strict=True)]
    decimals = [decimals_for([row["error_by_joint"].get(name) for row in rows]) for name in names]
    body = []
    for row in rows:
        errors = [show(row["error_by_joint"].get(name), places) for name, places in zip(names, decimals, strict=True)]
        body.append(element("tr", _name_cell(row), [element("td", error) for error in errors]))
    caption = element("caption", "In each column's own unit. ", SIDEWAYS)
    inner = element("table", caption, element("thead", element("tr", heads)), element("tbody", body))
    scroll = element("div", inner, class_="scroll", tabindex="0", role="region", aria_label="Error by action column")
    return element("details", element("summary", "First-step MAE of each action column"), scroll)

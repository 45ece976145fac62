"""The head-to-head table in a terminal.

What belongs here: columns, footnotes, what gives way where it is narrow. What does not: any number (`pipeline.table`).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pipeline.sinks.findings import (
    MARKS,
    NOT_HELD,
    Strong,
    address,
    answer,
    champion,
    deadline_words,
    driven_family_words,
    driven_word,
    driven_words,
    elsewhere_words,
    excluded_words,
    families_words,
    first_step_gap,
    gap_parts,
    interval_words,
    is_elsewhere,
    is_seen,
    not_held,
    safety_words,
    success_words,
    without_floor,
)

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text


def render_table(table: Mapping[str, Any], console: "Console", marked: str | None = None) -> None:
    """Draw the table, best first step on top; below it the answer in words, and what its numbers rest on.

    `marked` is the address of the row that somebody asked about.
    """
    from rich.markup import escape

    dataset = table["dataset"]
    unit = _common_unit(dataset["action_units"])
    console.print()
    console.print(
        f"[bold]{escape(dataset['name'])}[/]  {dataset['episodes']:,} episodes · {dataset['frames']:,} frames · "
        f"{dataset['fps']:g} fps · {len(dataset['action_names'])} action columns ({_units_words(dataset)})"
    )
    grid, left_out = _grid(table, unit, console, marked)
    console.print(grid)
    if any(row["by_task"] for row in table["policies"]):
        console.print(_by_task(table))
    for sentence in answer(table):
        console.print(_styled(sentence))
    console.print()
    narrow = [f"left out for want of width: {', '.join(left_out)} (all in --json)"] if left_out else []
    for line in (*_footnotes(table), *narrow):
        console.print(escape(line), style="dim")
    for warning in dataset["warnings"]:
        console.print(f"[yellow]warning:[/] {escape(warning)}")
    console.print()


def _by_task(table: Mapping[str, Any]):
    """The error of the first action, a column a task."""
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    rows = [row for row in table["policies"] if row["by_task"]]
    tasks = list(rows[0]["by_task"])
    grid = Table(
        box=box.SIMPLE_HEAD, header_style="bold", pad_edge=False, title="first step MAE by task", title_justify="left"
    )
    grid.add_column("policy")
    for task in tasks:
        held_out = rows[0]["by_task"][task]["episodes"]
        grid.add_column(f"{escape(task) or 'no task'}\n({held_out} held out)", justify="right", max_width=28)
    for row in rows:
        cells = [row["by_task"].get(task) for task in tasks]
        words = ["—" if cell is None else _with_interval(cell["first_step_mae"], cell["interval"]) for cell in cells]
        grid.add_row(escape(row["policy"]), *words, style=None if row["params"] else "dim")
    return grid


def _styled(sentence: Sequence[str]) -> "Text":
    """A sentence with what stands out in bold; names of a data set are text, never markup."""
    from rich.text import Text

    return Text.assemble(*((part, "bold" if isinstance(part, Strong) else "") for part in sentence))


@dataclass(frozen=True)
class _Column:
    """A column of the text table: its head, a cell of a row, and the order in which it gives way (0: never). What answers
    a question (the verdicts, the error one second ahead, the floor) gives way last.
    """

    head: str
    cell: Callable[[Mapping[str, Any]], str]
    gives_way: int = 0


def _grid(
    table: Mapping[str, Any], unit: str | None, console: "Console", marked: str | None = None
) -> tuple[Any, list[str]]:
    """The table as wide as the console allows, and the heads of the columns that had to be left out."""
    columns, left_out = _columns(table, unit), []
    while True:
        grid = _draw(table["policies"], columns, marked)
        expendable = [column for column in columns if column.gives_way]
        if console.measure(grid, options=console.options.update(width=1000)).maximum <= console.width or not expendable:
            return grid, left_out
        least = min(expendable, key=lambda column: column.gives_way)
        columns.remove(least)
        left_out.append(" ".join(least.head.split()) + (f" ({_the_set(table)})" if least.head == "sees" else ""))


def _the_set(table: Mapping[str, Any]) -> str | None:
    """The observation set, where all rows see the same one."""
    sets = {row["observations"] for row in table["policies"]}
    return sets.pop() if len(sets) == 1 else None


def _draw(rows: Sequence[Mapping[str, Any]], columns: Sequence[_Column], marked: str | None = None):
    from rich import box
    from rich.table import Table

    grid = Table(box=box.SIMPLE_HEAD, header_style="bold", pad_edge=False)
    for column in columns:
        grid.add_column(column.head, justify="left" if column.head in ("policy", "sees") else "right", no_wrap=True)
    for row in rows:
        here = address(row) == marked
        learns = row["params"] or is_elsewhere(row)
        cells = [column.cell(row) for column in columns]
        grid.add_row(
            f"→ {cells[0]}" if here else cells[0], *cells[1:], style="bold" if here else "" if learns else "dim"
        )
    return grid


def _columns(table: Mapping[str, Any], unit: str | None) -> list[_Column]:
    """From left to right, those that have something to show."""
    from rich.markup import escape

    rows = table["policies"]
    in_unit = f"\n{unit}" if unit else ""

    def number(key: str, digits: int = 4) -> Callable[[Mapping[str, Any]], str]:
        return lambda row: _number(row[key], digits)

    def score(row: Mapping[str, Any]) -> str:
        return _number(row["rollouts"] and row["rollouts"].get("score"), 3)

    columns = [
        _Column("policy", lambda row: escape(row["policy"]) + (" (seen in training)" if is_seen(row) else "")),
        _Column("sees", lambda row: escape(row["observations"]), 4 if _the_set(table) else 0),
        _Column(f"first step\nMAE{in_unit}", _first_step),
        _Column("\n× hold-still", number("vs_hold_still", 3), 10),
        *_verdicts(table),
        _Column(f"\nRMSE{in_unit}", number("first_step_rmse"), 5),
    ]
    if any(first_step_gap(row) for row in rows):
        columns.append(_Column("above floor\nRMSE", _above_floor, 11))
    if any(len(row["error_by_joint"]) == 2 for row in rows):
        columns.append(_Column(f"\nL2{in_unit}", number("first_step_l2"), 9))
    if unit is None:
        columns.append(_Column("\nscaled", number("scaled", 3), 6))
    if any(row["at_one_second_mae"] is not None for row in rows):
        columns.append(_Column(f"at 1 s\nMAE{in_unit}", _at_one_second, 13))
    optional = [
        ("whole_chunk_mae", f"whole chunk\nMAE{in_unit}", 8),
        ("ensembled_first_step_mae", f"ensembled\nMAE{in_unit}", 7),
    ]
    columns += [
        _Column(head, number(key), way) for key, head, way in optional if any(row[key] is not None for row in rows)
    ]
    if any(row["rollouts"] for row in rows):
        columns += [
            _Column("success", lambda row: _success(row, driven_word(table, address(row)))),
            _Column("score", score, 12),
        ]
    return [
        *columns,
        _Column("params", lambda row: f"{row['params']:,}" if row["params"] else "—", 3),
        _Column("trained\ns", lambda row: f"{row['train_s']:,.0f}" if row["params"] else "—", 1),
        _Column("call\nms", _call, 2),
    ]


def _verdicts(table: Mapping[str, Any]) -> list[_Column]:
    """What the tests say of the first step; a column without a word is left out."""
    rows, named = table["policies"], champion(table)
    heads = {"vs_hold_still": ("against\nhold-still", 15), "vs_champion": ("against\nchampion", 14)}

    def word(row: Mapping[str, Any], rival: str) -> str:
        if rival == "vs_champion" and address(row) == named:
            return "champion"
        return _verdict(row["verdict"][rival])

    return [
        _Column(head, lambda row, rival=rival: word(row, rival), way)
        for rival, (head, way) in heads.items()
        if any(row["verdict"][rival] for row in rows)
    ]


COLOURS = {"better": "green", "worse": "red", "cannot tell": "yellow", "not comparable": "dim"}


def _verdict(word: str | None, *, mark_only: bool = False) -> str:
    if word is None:
        return "—"
    return f"[{COLOURS[word]}]{MARKS[word]}{'' if mark_only else f' {word}'}[/]"


def _above_floor(row: Mapping[str, Any]) -> str:
    gap = first_step_gap(row)
    if gap is None:
        return "—"
    short, beside = gap_parts(gap)
    beside = beside.strip("[]").replace(", ", "–")
    return f"{short} [dim]{beside}[/]" if beside else short


def _at_one_second(row: Mapping[str, Any]) -> str:
    """The error, with the mark of its verdict against hold-still at the same horizon."""
    value, word = _number(row["at_one_second_mae"]), row["verdict"]["vs_hold_still_at_one_second"]
    return f"{value} {_verdict(word, mark_only=True)}" if word else value


def _call(row: Mapping[str, Any]) -> str:
    """The median, and the 99th percentile beside it."""
    late, value = row.get("latency_p99_ms"), _number(row["latency_ms"], 2)
    return value if late is None else f"{value} [dim]{_number(late, 2)}[/]{' ✗' if row['misses_deadline'] else ''}"


def _number(value: float | None, digits: int = 4) -> str:
    return "—" if value is None else f"{value:#.{digits}g}".rstrip(".")


def _first_step(row: Mapping[str, Any]) -> str:
    """The error and its interval."""
    return _with_interval(row["first_step_mae"], row["interval"].get("first_step_mae"))


def _with_interval(value: float | None, interval: Sequence[float] | None) -> str:
    shown = f"[bold]{_number(value)}[/]"
    return f"{shown} [dim]{_number(interval[0], 3)}–{_number(interval[1], 3)}[/]" if interval else shown


def _success(row: Mapping[str, Any], word: str | None) -> str:
    """The rate, its interval, and the mark of its verdict in closed loop."""
    rollouts = row["rollouts"]
    if not rollouts:
        return "—"
    interval = rollouts.get("success_interval")
    value = f"{100 * rollouts['success']:.0f} %"
    value += f" [dim]{100 * interval[0]:.0f}–{100 * interval[1]:.0f}[/]" if interval else ""
    return f"{value} {_verdict(word, mark_only=True)}" if word else value


def _common_unit(units: Sequence[str | None]) -> str | None:
    return units[0] if units and len(set(units)) == 1 else None


def _units_words(dataset: Mapping[str, Any]) -> str:
    from rich.markup import escape

    units = list(dict.fromkeys(unit or "unit not stated" for unit in dataset["action_units"]))
    words = " and ".join(units)
    return escape(words + (", MAE mixes them: see scaled" if len(units) > 1 else ""))


def _footnotes(table: Mapping[str, Any]) -> list[str]:
    lines = [*filter(None, [excluded_words(table)]), _setting(table), _means(table)]
    if any(row["verdict"]["vs_hold_still"] for row in table["policies"]):
        lines.append(
            f"against: paired tests over episodes and seeds, {families_words(table)} ✓ better, ✗ worse, ? cannot tell; "
            "at 1 s: against hold-still"
        )
    if words := success_words(table):
        lines.append(f"success: {words} · score: mean best reward")
    if words := driven_family_words(table):
        lines.append(f"closed loop: {words}")
    lines += [*safety_words(table), *driven_words(table), *deadline_words(table)]
    if any(first_step_gap(row) for row in table["policies"]):
        lines.append(
            "above floor: the first action's RMSE less the least that a policy of what it sees can have (gamma); "
            "none where a baseline sees more than the set it stands with"
        )
    lines += elsewhere_words(table)
    lines += [
        f"no floor of the RMSE of policies seeing '{name}' at the first action: {why}"
        for name, why in without_floor(table).items()
    ]
    if not_held(table):
        lines.append(NOT_HELD)
    radius = table["floor"]["radius"]
    if radius and radius["mean"] is not None:
        unit = f" {radius['unit']}" if radius["unit"] else ""
        lines.append(
            f"floor by radius (the estimator of the notebook that this project grew from; biased), L2, '{radius['observations']}': "
            f"mean {radius['mean']:.2f}{unit}, 90th percentile {radius['p90']:.2f}{unit}, {radius['probes']} probes; "
            "it bounds no MAE"
        )
    if table["dataset"].get("revision"):
        lines.append(f"revision {table['dataset']['revision'][:12]} · split {table['split']['hash'][:12]}")
    return lines


def _setting(table: Mapping[str, Any]) -> str:
    budget, folds = table["budget"], table["split"]["folds"]
    name = f"{budget['name']}, " if budget["name"] else ""
    own = "".join(f", {policy} {words}" for policy, words in budget.get("own", {}).items())
    held_out = sum(len(fold["test"]) for fold in folds)
    split = f"{len(folds)} folds" if len(folds) > 1 else f"1 fold, {len(folds[0]['train'])} episodes train"
    return (
        f"protocol {table['protocol']} · budget {name}{budget['seeds']} seed{'s' * (budget['seeds'] != 1)} × "
        f"{budget['steps']:,} steps{own} · {split}, {held_out} held out"
    )


def _means(table: Mapping[str, Any]) -> str:
    over = "episodes, each counts once" if table["protocol"] == "strict" else "frames"
    return (
        f"mean over {over}, averaged over seeds · {interval_words(table)} · × hold-still above 1: a smaller error than "
        "standing still"
    )

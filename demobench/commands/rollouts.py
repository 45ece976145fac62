"""`demobench rollouts`: trained policies in closed loop, chunk × executed actions × delay. What does not belong here: the loop."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from demobench.commands.session import open_session, write_json_to
from demobench.commands.trained import Found, find_trained
from pipeline.errors import ConfigError
from pipeline.execution import settled
from pipeline.experiment import parse_numbers
from pipeline.safety import TOLERANCE
from pipeline.sinks.words import percent
from pipeline.types import Execution


def run_rollouts(
    address: str,
    *,
    execute: str | None,
    delay: str | None,
    ensemble: bool,
    carry_on: bool,
    seeds: int | None,
    starts: int,
    first: int | None,
    config_path: Path | None,
    store_path: str | None,
    json_to: str | None,
) -> None:
    """Roll trained policies out in every way asked for; nothing of it is kept in the store.

    Raises
    ------
    ConfigError : nothing of what was asked for can be carried out, or more seeds are asked for than were trained.
    NotApplicableError : the data set has no simulator that is installed and fits.
    """
    from pipeline.simulate.trial import roll_out
    from pipeline.statistics.closed_loop import summarise_rollouts

    session = open_session(config_path, store_path, json_to)
    asked = _asked(parse_numbers("--execute", execute, 1), parse_numbers("--delay", delay, 0), ensemble, carry_on)
    found = find_trained(address, session)
    first = found[0].task.experiment.start_states.stop if first is None else first
    trained = found[0].task.experiment.seeds
    if seeds is not None and seeds > trained:
        raise ConfigError(
            f"--seeds is {seeds}, and {found[0].variant.name} was trained with {trained}: ask for at most so many."
        )
    pairs, left_out = _that_can_be(found, asked)
    rows = []
    for one, execution in pairs:
        with _bar(session.console, f"{one.variant.name}, {_how(execution)}") as on_frame:
            numbers = range(first, first + starts)
            rolled = roll_out(one.task, one.folder, on_frame, seeds=seeds, start_states=numbers, execution=execution)
        named = {"policy": one.variant.name, "observations": rolled[0].observations, "chunk": one.variant.chunk}
        rows.append(named | summarise_rollouts(rolled))
    if json_to != "-":
        _show(found[0].plan.key, rows, left_out, (first, starts), session.console)
    start_states = {"first": first, "n": starts}
    said = {"dataset": found[0].plan.key, "start_states": start_states, "rows": rows, "left_out": left_out}
    write_json_to(json_to, said)


def _asked(executes: Sequence[int], delays: Sequence[int], ensemble: bool, carry_on: bool) -> list[Execution | None]:
    """Every way that is asked for; None alone: as the configuration says."""
    if not (executes or delays or ensemble or carry_on):
        return [None]
    late = delays or (0,)
    plain = [
        Execution(e, False, d, on) for e, d in product(executes or (None,), late) for on in sorted({False, carry_on})
    ]
    return (plain if executes or carry_on or not ensemble else []) + [
        Execution(None, True, d) for d in late if ensemble
    ]


def _that_can_be(
    found: Sequence[Found], asked: Sequence[Execution | None]
) -> tuple[list[tuple[Found, Execution]], list[dict[str, Any]]]:
    """Every policy in every way that its chunk allows, and what is left out and why."""
    pairs, left_out = [], []
    for one, execution in product(found, asked):
        wanted = execution or one.task.policy.execution
        try:
            pairs.append((one, settled(wanted, one.variant.chunk or 1)))
        except ConfigError as why:
            left_out.append({"policy": one.variant.name, "execution": asdict(wanted), "why": str(why)})
    if not pairs:
        raise ConfigError(f"{left_out[0]['policy']}: {left_out[0]['why']}")
    return list({(one.variant.name, execution): (one, execution) for one, execution in pairs}.values()), left_out


@contextmanager
def _bar(console: Console, what: str) -> Iterator[Callable[[int, int], None]]:
    """A bar while it works, on a terminal."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(bar_width=24), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bars:
        task = bars.add_task(escape(what), total=None)
        yield lambda done, total: bars.update(task, completed=done, total=total)


def _executed(how: Mapping[str, Any]) -> str:
    return "ensemble" if how["ensemble"] else f"{how['execute']}{', on' if how['carry_on'] else ''}"


def _how(execution: Execution) -> str:
    how = "ensemble" if execution.ensemble else f"{execution.execute} executed"
    return f"{how}, delay {execution.delay}{', carried on' if execution.carry_on else ''}"


def _show(
    key: str,
    rows: Sequence[Mapping[str, Any]],
    left_out: Sequence[Mapping[str, Any]],
    at: tuple[int, int],
    console: Console,
) -> None:
    first, starts = at
    console.print(
        f"[bold]{escape(key)}[/]: {escape(rows[0]['observations'])}, start states {first} to {first + starts - 1} of "
        f"{rows[0]['simulator']}, {_networks(rows[0])}",
        soft_wrap=True,
    )
    table = Table(box=SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    for head in ("policy", "chunk", "executed", "delay", "success", "95 %", "score", "stepped\nin", "by", "stopped"):
        table.add_column(head, no_wrap=True, justify="left" if head == "policy" else "right")
    for row in rows:
        interval = row["success_interval"]
        how, size = row["execution"], row["mean_intervention"]
        table.add_row(
            escape(row["policy"]), str(row["chunk"]), _executed(how),
            str(how["delay"]), f"[bold]{row['successes']}/{row['episodes']}[/]",
            f"{100 * interval[0]:.0f}–{100 * interval[1]:.0f} %" if interval else "—",
            f"{row['score']:.3f}", percent(row["intervened"]), "—" if size is None else percent(size), str(row["stopped"]),
        )  # fmt: skip
    console.print(table)
    for policy in dict.fromkeys(one["policy"] for one in left_out):
        ways = [_how(Execution(**one["execution"])) for one in left_out if one["policy"] == policy]
        console.print(
            f"[yellow]left out of {escape(policy)}:[/] {'; '.join(ways)} (more than the chunk has, or a delay longer than what is "
            "executed)",
        )
    console.print(
        f"Stepped in: the share of frames in which the safety layer changed an action by more than {percent(TOLERANCE)} of a "
        "column's range; by: how far on average, in ranges; stopped: episodes that it ended.\n"
        f"{'“on”: an answer goes on where the robot has not moved. ' if any(row['execution']['carry_on'] for row in rows) else ''}"
        f"Intervals ({_intervals(rows[0])}) are of each row alone: the best of many is partly luck. Roll it out again from "
        "start states that chose nothing (--from).",
        style="dim",
    )


def _networks(row: Mapping[str, Any]) -> str:
    return "seed 0 of fold 0" if row["seeds"] == 1 else f"seeds 0 to {row['seeds'] - 1} of fold 0"


def _intervals(row: Mapping[str, Any]) -> str:
    return "Clopper–Pearson" if row["seeds"] == 1 else f"over start states and {row['seeds']} seeds"

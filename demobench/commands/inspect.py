"""`demobench inspect`: facts, columns, what looks wrong, the episodes to look at, and those to leave out.

What does not belong here: finding anything (pipeline/inspection).
"""

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from demobench.commands.session import open_dataset, open_session, write_json_to
from pipeline.errors import printable
from pipeline.inspection.finding import CHECKS

WIDE = 24
"""Columns of a feature that are listed one by one; more are one row."""

SHOWN = 5
"""Findings of one check that are printed; --json has all."""


def inspect_dataset(argument: str, config_path: Path | None, json_to: str | None) -> None:
    """The facts of a data set, and what looks wrong with it."""
    from demobench.progress import status_line
    from pipeline.inspection.look import inspect
    from pipeline.inspection.videos import local_folder
    from pipeline.lerobot_format import quality

    session = open_session(config_path, None, json_to)
    target, demos, semantics = open_dataset(argument, session)
    folder = local_folder(target.experiment.dataset.source, session.config_dir)
    with status_line(long=demos.frames > 200_000) as say:
        found = inspect(demos, semantics, folder, say)
    facts = quality.inspect_dataset(demos, semantics) | found.as_json(argument)
    if json_to != "-":
        repeated = [*quality.dead_warnings(demos), *quality.clock_warnings(demos)]
        show_inspection(facts, session.console, repeated)
    write_json_to(json_to, facts)


def show_inspection(facts: Mapping[str, Any], console: Console, said_by_checks: Sequence[str] = ()) -> None:
    """`facts` are those of `quality.inspect_dataset` and `Inspection.as_json`; `said_by_checks` are warnings among them
    that findings repeat.
    """
    _show_facts(facts, console)
    grid, left_out = _columns(facts, console)
    console.print(grid)
    if left_out:
        console.print(f"left out for want of width: {', '.join(left_out)} (all in --json)", style="dim")
    for camera in facts["cameras"]:
        there = "there" if camera["present"] else "declared, but its files are absent"
        console.print(f"camera {plain(camera['key'])} {camera['width']}×{camera['height']}: {there}", soft_wrap=True)
    for warning in facts["warnings"]:
        if warning not in said_by_checks:
            console.print(f"[yellow]note:[/] {plain(warning)}")
    console.print()
    _show_findings(facts["findings"], facts["skipped"], console)
    _show_episodes(facts, console)


def plain(words: str) -> str:
    """What others wrote, to be printed as it is: no markup, and no characters that a terminal obeys."""
    return escape(printable(words))


def _show_facts(facts: Mapping[str, Any], console: Console) -> None:
    lengths, fps = facts["episode_length"], facts["fps"]
    console.print(f"[bold]{plain(facts['name'])}[/]  {plain(facts['source'])}", soft_wrap=True)
    revision = f" · revision {facts['revision'][:12]}" if facts["revision"] else ""
    robot = f" · {plain(facts['robot_type'])}" if facts["robot_type"] else ""
    console.print(
        f"{facts['episodes']:,} episodes · {facts['frames']:,} frames · {fps:g} fps · {facts['frames'] / fps / 60:.1f} minutes · "
        f"{lengths['min']} to {lengths['max']} frames an episode (median {lengths['median']:g}){robot}{revision}",
        soft_wrap=True,
    )
    if facts.get("excluded"):
        console.print(
            f"left out by the configuration: episodes {', '.join(map(str, facts['excluded']))}", soft_wrap=True
        )
    tasks = [(words, count) for words, count in facts["tasks"].items() if words]
    for words, count in tasks[:SHOWN]:
        console.print(f"task “{plain(words)}”: {count} episode{'s' * (count != 1)}", soft_wrap=True)
    if len(tasks) > SHOWN:
        console.print(f"… and {len(tasks) - SHOWN} more tasks", soft_wrap=True)
    console.print(f"[dim]content hash {facts['content_hash']}[/]\n", soft_wrap=True)


def _columns(facts: Mapping[str, Any], console: Console) -> tuple[Table, list[str]]:
    """A row a column; what only action columns have is empty for the others. Where the console is too narrow, numbers
    give way, names never: the heads of those that did.
    """
    heads, left_out = list(HEADS), []
    while True:
        grid = _grid(facts, heads)
        gives_way = next((head for head in GIVE_WAY if head in heads), None)
        fits = console.measure(grid, options=console.options.update(width=1000)).maximum <= console.width
        if fits or gives_way is None:
            return grid, left_out
        heads.remove(gives_way)
        left_out.append(gives_way)


def _grid(facts: Mapping[str, Any], heads: Sequence[str]) -> Table:
    grid = Table(box=box.SIMPLE_HEAD, header_style="bold", pad_edge=False)
    for head in heads:
        grid.add_column(head, overflow="fold", no_wrap=head != "column")
    for feature in sorted(facts["features"], key=lambda feature: feature["key"] != "action"):
        grid.add_row(f"[bold]{plain(feature['key'])}[/]")
        if len(feature["names"]) > WIDE:
            cells = {"column": f"  {len(feature['names'])} columns", "range": _wide_range(feature)}
            grid.add_row(*(cells.get(head, "") for head in heads))
            continue
        for position in range(len(feature["names"])):
            cells = _cells(facts, feature, position)
            grid.add_row(*(cells[head] for head in heads))
    return grid


HEADS = ("column", "unit", "kind", "tracking lag", "mean |a − s|", "range")
GIVE_WAY = ("mean |a − s|", "tracking lag", "range")


def _cells(facts: Mapping[str, Any], feature: Mapping[str, Any], position: int) -> dict[str, str]:
    kind, lag, gap = "", "", ""
    if feature["key"] == "action":
        kind = facts["action_kinds"][position]
        frames = facts["lag_frames"][position]
        lag = "—" if frames is None else f"{frames:.1f} frames ({1e3 * frames / facts['fps']:.0f} ms)"
        gap = "—" if facts["tracking_lag"][position] is None else f"{facts['tracking_lag'][position]:.4g}"
    if feature["dead"][position]:
        kind += " [yellow]dead[/]"
    if feature["circular"][position]:
        kind += " angle"
    unit = feature["units"][position] or "?"
    values = f"{_number(feature['min'][position])} … {_number(feature['max'][position])}"
    return dict(
        zip(HEADS, (f"  {plain(feature['names'][position])}", plain(unit), kind.strip(), lag, gap, values), strict=True)
    )


def _number(value: float | None) -> str:
    return "—" if value is None else f"{value:.4g}"


def _wide_range(feature: Mapping[str, Any]) -> str:
    known = [value for value in (*feature["min"], *feature["max"]) if value is not None]
    return f"{_number(min(known, default=None))} … {_number(max(known, default=None))}"


def _show_findings(findings: Sequence[Mapping[str, Any]], skipped: Mapping[str, str], console: Console) -> None:
    found = {finding["check"] for finding in findings}
    quiet = ", ".join(check for check in CHECKS if check not in found and check not in skipped)
    left = "".join(f" Not looked at: {check} ({plain(why)})." for check, why in skipped.items())
    if not findings:
        console.print(f"[green]Nothing looks wrong.[/] Looked at: {quiet}.{left}", soft_wrap=True)
        return
    console.print(f"[bold]What looks wrong[/]  Found nothing: {quiet or '—'}.{left}", soft_wrap=True)
    for check, group in groupby(findings, key=lambda finding: finding["check"]):
        mine = list(group)
        console.print(f"[yellow]{check}[/]")
        for finding in mine[:SHOWN]:
            where = "" if finding["episode"] is None else f"episode {finding['episode']}: "
            console.print(f"  {where}{plain(finding['words'])}", soft_wrap=True)
        if len(mine) > SHOWN:
            console.print(f"  … and {len(mine) - SHOWN} more; --json lists them all", soft_wrap=True)
    console.print()


def _show_episodes(facts: Mapping[str, Any], console: Console) -> None:
    if facts["look_at"]:
        console.print("[bold]Look at these episodes first[/]")
        for place, one in enumerate(facts["look_at"], 1):
            console.print(f"  {place}. {plain(one['command'])}", soft_wrap=True)
            for reason in one["reasons"]:
                console.print(f"     {plain(reason)}", soft_wrap=True)
    elif facts["findings"]:
        console.print("No single episode stands out.")
    if facts["exclude_line"]:
        console.print(
            "\n[bold]Worth leaving out[/], once you have looked: put this under the data set in demobench.toml",
            soft_wrap=True,
        )
        console.print(f"  {plain(facts['exclude_line'])}", soft_wrap=True)

"""`demobench selftest`: the known-truth suite, its table in the terminal, and its page.

What belongs here: arguments → shards → goals → what is printed. What does not: studies and goals
(`pipeline.statistics.known_truth`), the page (`pipeline.sinks.selftest_page`).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from demobench.commands.session import open_session, write_json_to
from demobench.progress import counting_bar

if TYPE_CHECKING:
    from pipeline.statistics.known_truth.goals import Result
    from pipeline.statistics.known_truth.shards import Shard

COLOURS = {"met": "green", "unsure": "yellow", "missed": "bold red", None: "dim"}


def run_selftest(
    *,
    full: bool,
    workers: int,
    page: Path | None,
    config_path: Path | None,
    store_path: str | None,
    json_to: str | None,
    shards: Sequence["Shard"] | None = None,
) -> bool:
    """Run what is missing, judge the goals, write what was asked for. Returns whether no goal was missed.

    `shards`: these instead of those of a quick or a full run.
    """
    from pipeline.statistics.known_truth.goals import judge_goals
    from pipeline.statistics.known_truth.shards import collect, plan, run_shards

    session = open_session(config_path, store_path, json_to)
    session.store.ensure()
    folder, size = session.store.root / "selftest", "full" if full else "quick"
    shards = plan(size) if shards is None else shards
    with counting_bar(session.console, f"{size} self-test", len(shards)) as update:
        seconds = run_shards(shards, folder, workers=workers, on_done=update)
    cells = collect(shards, folder)
    results = judge_goals(cells)
    session.console.print(_table(results))
    _print_misses(session.console, results)
    session.console.print(f"{len(shards)} shards, {seconds / 60:.1f} minutes of one core, kept in {folder}")
    if page is not None:
        from pipeline.sinks.selftest_page import write_page

        write_page(page, results, cells, size=size, core_minutes=seconds / 60)
        session.console.print(f"Page: {page}")
    write_json_to(json_to, [as_json(result) for result in results])
    return all(result.outcome != "missed" for result in results)


def _table(results: Sequence["Result"]) -> Table:
    """Each goal, the worst number measured for it, and how many numbers meet it."""
    from pipeline.statistics.known_truth.goals import limits_in_words

    table = Table(box=None, header_style="bold", pad_edge=False)
    for name, justify in (
        ("goal", "left"),
        ("limits", "right"),
        ("worst", "right"),
        ("where", "left"),
        ("met", "right"),
        ("", "left"),
    ):
        table.add_column(name, justify=justify, overflow="fold")
    for result in results:
        worst, outcome = result.worst, result.outcome
        if worst is None:
            table.add_row(result.goal.name, limits_in_words(result.goal), "", "not measured in this run", "", "")
            continue
        met = sum(result.goal.outcome(place) == "met" for place in result.places)
        colour = COLOURS[outcome]
        table.add_row(
            result.goal.name, limits_in_words(result.goal), f"{worst.value:.3g} ({worst.low:.3g} … {worst.high:.3g})", worst.where,
            f"{met}/{len(result.places)}", f"[{colour}]{outcome}[/]",
        )  # fmt: skip
    return table


def _print_misses(console: Console, results: Sequence["Result"]) -> None:
    """Every place beyond a limit, by goal: the numbers that somebody has to do something about."""
    from pipeline.statistics.known_truth.goals import limits_in_words

    for result in results:
        beyond = [place for place in result.places if result.goal.outcome(place) == "missed"]
        if beyond:
            console.print(
                f"[bold red]missed[/] {result.goal.name}: {result.goal.words}, {limits_in_words(result.goal)}"
            )
            for place in beyond:
                console.print(f"  {place.value:.3g} ({place.low:.3g} … {place.high:.3g}) {place.where}", soft_wrap=True)


def as_json(result: "Result") -> dict[str, Any]:
    """A goal and all its places as plain values."""
    goal = result.goal
    return {
        "goal": goal.name,
        "words": goal.words,
        "least": goal.least,
        "most": goal.most,
        "unit": goal.unit,
        "outcome": result.outcome,
        "places": [
            {
                "where": place.where, "value": place.value, "interval": [place.low, place.high],
                "repeats": place.repeats, "outcome": goal.outcome(place), "settings": place.study,
            }
            for place in result.places
        ],
    }  # fmt: skip

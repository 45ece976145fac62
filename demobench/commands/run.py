"""`demobench run`: settings → plan → Dagster run → table."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.markup import escape

from demobench.commands.session import Session, open_session, program, short, tell_mlflow, write_json_to
from pipeline.errors import ConfigError, StoreError
from pipeline.experiment import Choices, Target, parse_chunks, parse_list, resolve_target, select_rows
from pipeline.methods import METHODS, is_own
from pipeline.store import Store

if TYPE_CHECKING:
    from dagster import DagsterInstance, Definitions

    from assets_defs.plan import Plan, Unit
    from demobench.progress import PoliciesFailed, RunProgress


def run_benchmarks(
    datasets: Sequence[str],
    *,
    choices: Mapping[str, Any],
    config_path: Path | None,
    store_path: str | None,
    json_to: str | None,
) -> None:
    """Benchmark every data set asked for; what is up to date is kept."""
    session = open_session(config_path, store_path, json_to)
    chosen = Choices(
        **{
            **choices,
            "policies": parse_list(choices["policies"]),
            "chunks": parse_chunks(choices["chunks"]),
            "observations": parse_list(choices["observations"]),
        }
    )
    names = list(dict.fromkeys(datasets)) or list(session.config.datasets)
    if not names:
        raise ConfigError("The configuration has no data sets. Name one: demobench run some/lerobot/folder")
    registered = session.store.experiments()
    targets = [resolve_target(n, session.config, session.config_dir, chosen, registered) for n in names]
    check_source(targets, session)
    session.store.ensure()
    tell_mlflow(session, first=True)
    results, failures = zip(*(_run_one(target, session) for target in targets), strict=True)
    tell_mlflow(session)
    write_json_to(json_to, list(results))
    for failure in filter(None, failures):
        raise failure


def check_source(targets: Sequence[Target], session: Session) -> None:
    """Fail before any work when a folder is not there, or is no data set, or a policy's class cannot be had."""
    from pipeline.lerobot_format.read import check_experiment

    for target in targets:
        check_experiment(target.experiment, session.config_dir)
        for method in {v.method for v in target.selected if is_own(v.method)}:
            METHODS[method].load_class().check()


def _run_one(target: Target, session: Session) -> tuple[dict[str, Any], "PoliciesFailed | None"]:
    """The table, and what kept policies from it."""
    console, store = session.console, session.store
    with store.lock(target.key):
        store.register(target.key, target.experiment.model_dump(mode="json"))
        failure = _make(target, session)
    plan = _plan(target, session)
    report = collect(target, plan, session)
    show(report, target, session)
    if news := champion_news(store, target.key):
        console.print(f"  [yellow]{escape(news)}[/]", soft_wrap=True)
    for unit in plan.scored_units():
        if not plan.is_fresh(unit):
            console.print(
                f"  [yellow]'{unit.entry}', predicted elsewhere, is not in the table: its data, settings or code changed. Score it "
                "again with: demobench score[/]",
                soft_wrap=True,
            )
    return report, failure


def champion_news(store: Store, key: str) -> str | None:
    """What the latest table says of the champion, where it got worse or another policy takes its place."""
    from pipeline.history import in_words, read_history

    lines = read_history(store, key)
    return in_words(lines[-1]) if lines and (lines[-1].got_worse or lines[-1].promotion) else None


def _plan(target: Target, session: Session) -> "Plan":
    from assets_defs.plan import Plan

    variants, selected = tuple(target.experiment.variants), tuple(v.name for v in target.selected)
    return Plan(session.store, target.key, target.experiment, variants, selected, target.observations)


def _make(target: Target, session: Session) -> "PoliciesFailed | None":
    """Make what is stale. A policy that cannot be trained or asked must not keep the others from the table."""
    from demobench.progress import PoliciesFailed

    try:
        _make_stale(target, session)
    except PoliciesFailed as failure:
        others = tuple(v for v in target.selected if v.name not in failure.why)
        if not others:
            raise
        _make_stale(replace(target, selected=others), session)
        return failure
    return None


def _make_stale(target: Target, session: Session) -> None:
    plan = _plan(target, session)
    materialise(target, session, plan.units(), list(plan.stale()))


def materialise(
    target: Target,
    session: Session,
    units: Sequence["Unit"],
    stale: Sequence["Unit"],
    *,
    job: str | None = None,
    ops: Mapping[str, Any] | None = None,
) -> None:
    """Make those of `units` that are stale as a Dagster run of a job (the benchmark by default), and show it; say so where none
    are.

    `ops` are settings of single assets.

    Raises:
        StoreError: the run's log cannot be written.
        DemobenchError: what the run failed for.
        typer.Exit: Ctrl-C.
    """
    if not stale:
        session.console.print(f"[bold]{target.key}[/] is up to date: nothing to compute.")
        return
    from sqlalchemy.exc import SQLAlchemyError

    from demobench.progress import RunProgress

    assets, making = [u.asset for u in units], [u.asset for u in stale]
    with (
        RunProgress(session.console, target, assets, making) as progress,
        _dagster(target, session, progress) as dagster,
    ):
        from assets_defs.automation import BENCHMARK
        from assets_defs.launch import run_benchmark
        from assets_defs.resources import asset_keys

        try:
            run = run_benchmark(
                *dagster,
                target.key,
                asset_keys(stale),
                target.observations,
                [v.name for v in target.selected],
                progress.on_event,
                job_name=job or BENCHMARK,
                ops=ops,
            )
        except KeyboardInterrupt:
            progress.stop()
            session.console.print("Stopped. What was finished is kept; the same command goes on from there.")
            raise typer.Exit(130) from None
        except (OSError, SQLAlchemyError) as error:
            raise StoreError(
                f"The run stopped because its log could not be written: {str(error).splitlines()[0]}. Results that were "
                f"finished are intact in {session.store.root}. Free some space there and run the same command again."
            ) from error
    if not run.is_success:
        progress.raise_failure(run.run_id)


@contextmanager
def _dagster(
    target: Target, session: Session, progress: "RunProgress"
) -> "Iterator[tuple[DagsterInstance, Definitions]]":
    """The store's Dagster instance, its dead runs closed, and the definitions, which Ctrl-C stops between two pieces of work."""
    from assets_defs.definitions import build_defs
    from assets_defs.launch import Interrupts, close_dead_runs, open_instance

    with Interrupts() as interrupts, open_instance(session.store.root) as instance:

        def report(*what: Any) -> None:
            interrupts.check()
            progress.report(*what)

        defs = build_defs(
            session.config,
            config_dir=session.config_dir,
            store=session.store,
            progress=report,
            experiments={target.key: target.experiment},
        )
        for words in close_dead_runs(instance):
            progress.say(words)
        yield instance, defs


def collect(target: Target, plan: Any, session: Session) -> dict[str, Any]:
    """The table's JSON, less what was not asked for, with the paths of what was made."""
    from assets_defs.plan import Unit

    built = json.loads((plan.folder(Unit("benchmark_table")) / "table.json").read_text(encoding="utf-8"))
    built["policies"] = select_rows(built["policies"], target)
    mlflow = session.config.tracking.mlflow
    built["artifacts"] = {
        "report": str(plan.folder(Unit("benchmark_report")) / "report.html"),
        "mcap": str(plan.folder(Unit("mcap_log")) / "held_out.mcap"),
        "rerun": str(plan.folder(Unit("rerun_recording")) / "held_out.rrd"),
        "mlflow": f"sqlite:///{session.store.root / 'mlflow.db'}" if mlflow == "sqlite" else mlflow,
    }
    return built


def show(report: Mapping[str, Any], target: Target, session: Session, marked: str | None = None) -> None:
    """The table and where its files are; `marked` is the address of the row that this is about."""
    from pipeline.sinks.text_table import render_table

    console = session.console
    render_table(report, console, marked)
    paths = report["artifacts"]
    opens = {
        "report": f"xdg-open {short(paths['report'])}",
        "mcap": f"{program('rerun')} --bind 127.0.0.1 {short(paths['mcap'])}",
        "rerun": f"{program('rerun')} --bind 127.0.0.1 {short(paths['rerun'])}",
        "mlflow": f"{program('demobench')} ui",
    }
    names = {"report": "Report", "mcap": "MCAP", "rerun": "Rerun", "mlflow": "MLflow"}
    for kind, name in names.items():
        console.print(f"  {name:<7}{short(paths[kind])}", soft_wrap=True)
        console.print(f"         [dim]open with:[/] {opens[kind]}", soft_wrap=True)
    if not target.file_has_it:
        console.print(
            "  [yellow]This run has policies or chunk sizes that the configuration does not define: the Dagster UI shows it "
            "but cannot run it again.[/]"
        )

"""What the commands do: settings → plan → Dagster run → table. `cli.py` holds their arguments, `progress.py` the bars."""

import json
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer
from rich.console import Console

from pipeline.config import Config, find_config, load_config
from pipeline.errors import ConfigError, StoreError, did_you_mean
from pipeline.experiment import (
    Choices,
    Target,
    parse_chunks,
    parse_horizons,
    parse_list,
    resolve_target,
    select_rows,
)
from pipeline.methods import METHODS, is_own
from pipeline.store import Store, write_json


@dataclass(frozen=True)
class Session:
    """A configuration, where it lies, its store, and where to print."""

    config: Config
    config_dir: Path
    store: Store
    console: Console


def open_session(config_path: Path | None, store_path: str | None, json_to: str | None = None) -> Session:
    """Read the configuration; with `--json -` everything that is not JSON goes to standard error."""
    path = find_config(config_path)
    config = load_config(path)
    config_dir = path.parent if path else Path.cwd()
    if store_path is not None:
        config = config.model_copy(update={"store": type(config.store)(path=store_path)})
        store = Store(Path.cwd() / Path(store_path).expanduser())
    else:
        store = Store(config_dir / Path(config.store.path).expanduser())
    return Session(config, config_dir, store, Console(stderr=json_to == "-", highlight=False, soft_wrap=False))


def write_json_to(target: str | None, value: Any) -> None:
    """`-` is standard output; anything else a file, written whole or not at all."""
    if target == "-":
        sys.stdout.write(json.dumps(value, indent=1, allow_nan=False) + "\n")
    elif target:
        try:
            write_json(Path(target), value)
        except OSError as error:
            raise StoreError(f"The JSON cannot be written to {target}: {error.strerror}.") from None


# run ------------------------------------------------------------------------------------------------------------------


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
    results = [_run_one(target, session) for target in targets]
    write_json_to(json_to, results)


def check_source(targets: Sequence[Target], session: Session) -> None:
    """Fail before any work when a folder is not there, or is no data set, or a policy's class cannot be had."""
    from pipeline.lerobot_format.read import check_experiment

    for target in targets:
        check_experiment(target.experiment, session.config_dir)
        for method in {v.method for v in target.selected if is_own(v.method)}:
            METHODS[method].load_class().check()


def _run_one(target: Target, session: Session) -> dict[str, Any]:
    from assets_defs.plan import Plan

    console, store = session.console, session.store
    plan = Plan(
        store,
        target.key,
        target.experiment,
        tuple(target.experiment.variants),
        tuple(v.name for v in target.selected),
        target.observations,
    )
    with store.lock(target.key):
        store.register(target.key, target.experiment.model_dump(mode="json"))
        stale = plan.stale()
        if stale:
            materialise(target, session, list(stale))
        else:
            console.print(f"[bold]{target.key}[/] is up to date: nothing to compute.")
    plan.forget()
    report = collect(target, plan, session)
    show(report, target, session)
    for unit in plan.scored_units():
        if not plan.is_fresh(unit):
            console.print(
                f"  [yellow]'{unit.entry}', predicted elsewhere, is not in the table: its data, settings or code changed. Score it "
                "again with: demobench score[/]",
                soft_wrap=True,
            )
    return report


def materialise(
    target: Target,
    session: Session,
    stale: Sequence[Any],
    *,
    job: str | None = None,
    ops: Mapping[str, Any] | None = None,
) -> None:
    """Make stale results as a Dagster run of a job (the benchmark by default) with bars; `ops` are settings of single assets.

    Raises:
        StoreError: the run's log cannot be written.
        DemobenchError: what the run failed for.
        typer.Exit: Ctrl-C.
    """
    from sqlalchemy.exc import SQLAlchemyError

    from demobench.progress import RunProgress

    with RunProgress(session.console, target, stale) as progress:
        from assets_defs.automation import BENCHMARK
        from assets_defs.definitions import build_defs
        from assets_defs.launch import Interrupts, close_dead_runs, open_instance, run_benchmark
        from assets_defs.resources import asset_keys

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
            for run_id in close_dead_runs(instance):
                progress.say(f"closed run {run_id[:8]}, whose process was gone")
            try:
                run = run_benchmark(
                    instance,
                    defs,
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
    from pipeline.table import render_table

    console = session.console
    render_table(report, console, marked)
    paths = report["artifacts"]
    opens = {
        "report": f"xdg-open {short(paths['report'])}",
        "mcap": f"{_program('rerun')} --bind 127.0.0.1 {short(paths['mcap'])}",
        "rerun": f"{_program('rerun')} --bind 127.0.0.1 {short(paths['rerun'])}",
        "mlflow": f"{_program('demobench')} ui",
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


def _program(name: str) -> str:
    """How to call a program that was installed beside this one: by name where that finds it, else by its path."""
    here = Path(sys.executable).parent / name
    found = shutil.which(name)
    return name if found and Path(found).resolve() == here.resolve() else short(str(here))


def short(path: str) -> str:
    """Relative to the working directory where that is shorter."""
    prefix, plain = ("sqlite:///", path.removeprefix("sqlite:///")) if path.startswith("sqlite:///") else ("", path)
    try:
        return prefix + str(Path(plain).relative_to(Path.cwd()))
    except ValueError:
        return path


# inspect, floor -------------------------------------------------------------------------------------------------------


def open_dataset(argument: str, session: Session, choices: Choices | None = None) -> tuple[Target, Any, Any]:
    """The data set of a name, folder or Hub address, and what its columns mean."""
    from pipeline.lerobot_format.read import load_experiment

    registered = session.store.experiments()
    target = resolve_target(argument, session.config, session.config_dir, choices or Choices(), registered)
    return target, *load_experiment(target.experiment, session.config_dir)


def inspect_dataset(argument: str, config_path: Path | None, json_to: str | None) -> None:
    """The facts of a data set, and what looks wrong with it."""
    from demobench.inspection import show_inspection
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


def measure_floor(
    argument: str,
    *,
    radius: float | None,
    probes: int,
    min_neighbours: int,
    observations: str | None,
    horizons: str | None,
    config_path: Path | None,
    json_to: str | None,
) -> None:
    """The floors of the states that a benchmark would score, and the notebook's."""
    from demobench.show import show_estimates, show_radius
    from pipeline.folds import split_of
    from pipeline.lerobot_format import quality
    from pipeline.statistics.floors import measure_floors
    from pipeline.statistics.radius import radius_floor
    from pipeline.table import dataset_json, floor_json

    session = open_session(config_path, None, json_to)
    asked = parse_horizons(horizons)
    target, demos, semantics = open_dataset(argument, session)
    experiment = target.experiment
    sets = {s.name: s for s in experiment.observation_sets}
    wanted = parse_list(observations) or tuple(sets)
    experiment.require_sets(wanted)
    floors = [
        radius_floor(demos, semantics, sets[name], radius=radius, probes=probes, min_neighbours=min_neighbours)
        for name in wanted
    ]
    split = split_of(experiment, demos)
    settings = {"history": experiment.history, "horizons": asked or experiment.floor_horizons(demos.fps)}
    estimates = [e for name in wanted for e in measure_floors(demos, semantics, sets[name], split, **settings)]
    facts = quality.inspect_dataset(demos, semantics)
    if json_to != "-":
        show_estimates(estimates, facts, session.console)
        show_radius(floors, session.console)
    write_json_to(json_to, {"dataset": dataset_json(facts), "floor": floor_json(floors, estimates)})


# view, record ---------------------------------------------------------------------------------------------------------


def view_episode(
    argument: str,
    episode: int,
    policy: str | None,
    save: Path | None,
    config_path: Path | None,
    store_path: str | None,
) -> None:
    """One episode with what every up-to-date policy predicted in it (held-out episodes have predictions)."""
    import numpy as np

    from assets_defs.plan import Plan, Unit
    from pipeline.predict import load_predictions
    from pipeline.sinks import to_rerun

    session = open_session(config_path, store_path)
    target, demos, semantics = open_dataset(argument, session)
    position = np.flatnonzero(demos.episode_ids == episode)
    if not len(position):
        raise ConfigError(
            f"'{target.key}' has no episode {episode}. Its episodes are {demos.episode_ids.min()} to {demos.episode_ids.max()}."
        )
    plan = Plan(session.store, target.key, target.experiment, tuple(target.experiment.variants))
    units = plan.fresh_predictions() if plan.is_fresh(Unit("demonstrations")) else []
    wanted = parse_list(policy)
    names = {u.policy for u in units}
    for name in wanted:
        if name not in names:
            raise ConfigError(
                f"No up-to-date predictions of a policy '{name}' for '{target.key}'. {did_you_mean(name, names)}"
            )
    predictions = [load_predictions(plan.folder(u)) for u in units if not wanted or u.policy in wanted]
    frames = demos.episode(int(position[0]))
    if not any(len(p.in_frames(frames)) for p in predictions):
        session.console.print(_why_no_predictions(episode, predictions, demos, target, session), soft_wrap=True)
    path = save or session.store.dataset(target.key) / "view.rrd"
    path.parent.mkdir(parents=True, exist_ok=True)
    to_rerun.write_rerun(path, demos, semantics, predictions, [int(position[0])], name=f"{target.key} {episode}")
    if save:
        session.console.print(f"Written to {save}. Open it with: rerun --bind 127.0.0.1 {save}", soft_wrap=True)
    else:
        to_rerun.view(path)


def _why_no_predictions(episode: int, predictions: Sequence[Any], demos: Any, target: Target, session: Session) -> str:
    """Why an episode is shown as it was recorded, and nothing more."""
    import numpy as np

    if not predictions:
        base = target.key.split("+")[0]
        finished = [
            key for key in session.store.experiments() if (session.store.folder(key, "benchmark_table")).exists()
        ]
        others = [key for key in finished if key.split("+")[0] == base and key != target.key]
        known = f" There are results of {', '.join(others)}." if others else ""
        return (
            f"'{target.key}' has no up-to-date predictions in {session.store.root}; showing the recording alone.{known}"
        )
    anchors = np.concatenate([p.anchors for p in predictions])
    held_out = demos.episode_ids[np.unique(np.searchsorted(demos.episode_starts, anchors, side="right") - 1)]
    some = ", ".join(map(str, held_out[:10]))
    return f"Episode {episode} was trained on, so no policy was asked about it; held out are {some}{' …' * (len(held_out) > 10)}"


def record_pusht(out: Path, episodes: int, seed: int, workers: int) -> None:
    from demobench.progress import counting_bar
    from pipeline.simulate import pusht_demonstrator

    console = Console(highlight=False)
    with counting_bar(console, "demonstrations", episodes) as count:
        pusht_demonstrator.record_pusht(out, episodes=episodes, seed=seed, workers=workers, on_episode=count)
    console.print(f"Written to {out}. Benchmark it with: demobench run {out}", soft_wrap=True)

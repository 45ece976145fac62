"""The command line. Thin: every command reads its arguments, calls the pipeline or Dagster, and prints.

Heavy modules (dagster, torch, mlflow, rerun) are imported by the commands that need them, so that `--help` is quick.
"""

import sys
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console

from pipeline.config import BudgetName
from pipeline.errors import DemobenchError
from pipeline.types import Protocol

app = typer.Typer(
    name="demobench",
    help="How good can a policy trained on these demonstrations get, is yours there yet, and would more demonstrations help?",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    add_completion=False,
)
record_app = typer.Typer(help="Record demonstrations in simulation, by scripted demonstrators.", no_args_is_help=True)
app.add_typer(record_app, name="record")

DatasetArgument = Annotated[str, typer.Argument(help="A name from the file, a folder, or hub:owner/name.")]
ConfigOption = Annotated[
    Path | None,
    typer.Option("--config", help="Configuration; else DEMOBENCH_CONFIG, else ./demobench.toml, else built-in."),
]
StoreOption = Annotated[str | None, typer.Option("--store", help="The folder for results; else the configuration's.")]
JsonOption = Annotated[
    str | None,
    typer.Option("--json", metavar="FILE|-", help="Write the numbers as JSON to a file, or to standard output."),
]
OutArgument = Annotated[Path, typer.Argument(help="The folder to write; it must not exist.")]
EpisodesOption = Annotated[int, typer.Option(min=1, help="Demonstrations to record.")]
SeedOption = Annotated[int, typer.Option(min=0, help="Same seed, same content.")]
WorkersOption = Annotated[int, typer.Option(min=1, help="Processes.")]


@app.callback()
def _global(
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
) -> None:
    """See `main` for what --debug does."""


@app.command(
    epilog="""Examples:\n
    demobench run                                   every data set of demobench.toml\n
    demobench run my/lerobot/folder                 any LeRobot data set\n
    demobench run hub:lerobot/pusht --seeds 3       from the Hub, three seeds\n
    demobench run tape --policies mlp --chunks 1,16 --json results.json"""
)
def run(
    datasets: Annotated[
        list[str] | None, typer.Argument(metavar="[DATASET …]", help="Names from the file, folders, or hub:owner/name.")
    ] = None,
    policies: Annotated[
        str | None, typer.Option(help="Only these (baselines are always there): mlp,hold_still")
    ] = None,
    chunks: Annotated[str | None, typer.Option(help="Only these chunk sizes: 1,16")] = None,
    observations: Annotated[str | None, typer.Option(help="Only these observation sets: position,pose")] = None,
    seeds: Annotated[int | None, typer.Option(min=1, help="Training seeds.")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Training steps.")] = None,
    budget: Annotated[
        BudgetName | None, typer.Option(help="quick (600 steps), standard (3,000) or thorough (20,000).")
    ] = None,
    folds: Annotated[int | None, typer.Option(min=1, help="Folds of the split by episode.")] = None,
    protocol: Annotated[
        Protocol | None, typer.Option(help="strict, or notebook: as in the notebook that this project grew from.")
    ] = None,
    rollouts: Annotated[int | None, typer.Option(min=1, help="Start states in closed loop.")] = None,
    rollout_seeds: Annotated[int | None, typer.Option(min=1, help="Training seeds in closed loop.")] = None,
    device: Annotated[Literal["auto", "cpu", "cuda"] | None, typer.Option(help="auto, cpu or cuda.")] = None,
    config: ConfigOption = None,
    store: StoreOption = None,
    json_to: JsonOption = None,
) -> None:
    """Run the whole benchmark: from demonstrations to a table, a page, recordings and tracked metrics."""
    from demobench.commands.run import run_benchmarks

    run_benchmarks(
        datasets or [],
        choices={
            "policies": policies, "chunks": chunks, "observations": observations, "seeds": seeds, "steps": steps,
            "budget": budget, "folds": folds, "protocol": protocol, "rollouts": rollouts, "rollout_seeds": rollout_seeds,
            "device": device,
        },
        config_path=config,
        store_path=store,
        json_to=json_to,
    )  # fmt: skip


@app.command(epilog="Examples:\n\n    demobench inspect my/lerobot/folder\n\n    demobench inspect pusht_sim --json -")
def inspect(
    dataset: DatasetArgument,
    config: ConfigOption = None,
    json_to: JsonOption = None,
) -> None:
    """What is in a data set: counts, features, kinds of action, units, tracking lag, and what looks wrong. No training."""
    from demobench.commands.inspect import inspect_dataset

    inspect_dataset(dataset, config, json_to)


@app.command(
    epilog="Examples:\n\n    demobench floor my/lerobot/folder\n\n    demobench floor tape --horizons 0,15,30 --json -\n\n"
    "    demobench floor pusht --radius 2 --probes 2000 --min-neighbours 5      the notebook's settings"
)
def floor(
    dataset: DatasetArgument,
    radius: Annotated[
        float | None,
        typer.Option(min=1e-12, help="The notebook's: frames within this distance are neighbours; else a close one."),
    ] = None,
    probes: Annotated[
        int, typer.Option(min=1, help="The notebook's: frames, evenly spaced, whose neighbours are looked for.")
    ] = 2000,
    min_neighbours: Annotated[
        int, typer.Option(min=2, help="The notebook's: probes with fewer frames around them do not count.")
    ] = 5,
    observations: Annotated[str | None, typer.Option(help="Only these observation sets.")] = None,
    horizons: Annotated[
        str | None, typer.Option(help="Steps ahead: 0,15,30; else the first action and one second ahead.")
    ] = None,
    config: ConfigOption = None,
    json_to: JsonOption = None,
) -> None:
    """How small can the error of a deterministic policy get here? People do different things in the same place.

    --radius, --probes and --min-neighbours are of the notebook's estimator: that of the study that this project grew from.
    """
    from demobench.commands.floor import measure_floor

    measure_floor(
        dataset,
        radius=radius,
        probes=probes,
        min_neighbours=min_neighbours,
        observations=observations,
        horizons=horizons,
        config_path=config,
        json_to=json_to,
    )


@app.command(
    context_settings={"ignore_unknown_options": True},  # so that "-3/20" is answered in our own words
    epilog="Examples:\n\n    demobench success 18/20 16/20\n\n    demobench success trials.csv --json -",
)
def success(
    counts: Annotated[
        list[str],
        typer.Argument(
            metavar="COUNT … | TRIALS.csv", help="Successes of trials (18/20), or a CSV: policy, start state, success."
        ),
    ],
    json_to: JsonOption = None,
) -> None:
    """Success rates of real-robot trials: how sure each is, which policy is better, and how many trials would tell."""
    from demobench.commands.success import judge_success

    judge_success(counts, json_to)


@app.command(
    epilog="Examples:\n\n    demobench compare tape/mlp_k01 tape/mlp_k16\n\n"
    "    demobench compare tape                            all pairs of its table\n\n"
    "    demobench compare pusht_sim/mlp_k01/pose@1f3a pusht_sim/mlp_k01/position --json -"
)
def compare(
    addresses: Annotated[
        list[str],
        typer.Argument(metavar="A [B …]", help="Results: dataset/policy[/observations][@run], or a data set for all."),
    ],
    config: ConfigOption = None,
    store: StoreOption = None,
    json_to: JsonOption = None,
) -> None:
    """Which policy is better? Paired over held-out episodes: better, worse, cannot tell, or not comparable, and why."""
    from demobench.commands.compare import compare_policies

    compare_policies(addresses, config, store, json_to)


@app.command(
    epilog="""Examples:\n
    demobench curve pusht_sim                                    would 50 more demonstrations help?\n
    demobench curve my/lerobot/folder --policy mlp_k16 --more 100\n
    demobench curve pusht_sim --policy mlp_k01 --observations pose --sizes 20,40,80 --json -"""
)
def curve(
    dataset: DatasetArgument,
    policy: Annotated[
        str | None, typer.Option(help="The policy; else the data set's champion, else the first that is trained.")
    ] = None,
    observations: Annotated[str | None, typer.Option(help="Only these observation sets: position,pose")] = None,
    sizes: Annotated[
        str | None, typer.Option(help="Training episodes: 10,20,40; else about an eighth, a quarter and a half of all.")
    ] = None,
    more: Annotated[int, typer.Option(min=1, help="How many more demonstrations are in question.")] = 50,
    worthwhile: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="The share of the present error that is worth recording for.")
    ] = 0.05,
    seeds: Annotated[int | None, typer.Option(min=1, help="Training seeds.")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Training steps, the same at every size.")] = None,
    budget: Annotated[
        BudgetName | None, typer.Option(help="quick (600 steps), standard (3,000) or thorough (20,000).")
    ] = None,
    folds: Annotated[int | None, typer.Option(min=1, help="Folds of the split by episode.")] = None,
    protocol: Annotated[Protocol | None, typer.Option(help="strict, or notebook (see run --help).")] = None,
    device: Annotated[Literal["auto", "cpu", "cuda"] | None, typer.Option(help="auto, cpu or cuda.")] = None,
    config: ConfigOption = None,
    store: StoreOption = None,
    json_to: JsonOption = None,
) -> None:
    """Would more demonstrations help? Yes, no, or cannot tell: error against the number of training episodes."""
    from demobench.commands.curve import run_curve

    run_curve(
        dataset,
        policy=policy,
        sizes=sizes,
        more=more,
        worthwhile=worthwhile,
        choices={
            "observations": observations, "seeds": seeds, "steps": steps, "budget": budget, "folds": folds,
            "protocol": protocol, "device": device,
        },
        config_path=config,
        store_path=store,
        json_to=json_to,
    )  # fmt: skip


@app.command(
    epilog="""Examples:\n
    demobench rollouts pusht_sim/mlp_k16/pose                               once more, from other start states\n
    demobench rollouts pusht_sim/mlp/pose --execute 1,4,8 --delay 0,2       every chunk, executed actions and delay\n
    demobench rollouts pusht_sim/mlp_k16/pose --seeds 3 --starts 500        three training seeds\n
    demobench rollouts so101_sim/mlp_k16/pose --execute 8 --ensemble --starts 200 --from 1000 --json -"""
)
def rollouts(
    address: Annotated[
        str, typer.Argument(metavar="POLICY", help="dataset/policy[/observations]; mlp stands for all of its chunks.")
    ],
    execute: Annotated[
        str | None, typer.Option(help="Actions carried out of each chunk: 1,4,8; else as the configuration says.")
    ] = None,
    delay: Annotated[str | None, typer.Option(help="Frames from a question to its answer: 0,2")] = None,
    ensemble: Annotated[bool, typer.Option("--ensemble", help="Also (or only) as a temporal ensemble.")] = False,
    carry_on: Annotated[
        bool, typer.Option("--carry-on", help="Also so that an answer goes on where the robot has not moved.")
    ] = False,
    seeds: Annotated[
        int | None, typer.Option(min=1, help="Training seeds, at most those trained; else as the configuration says.")
    ] = None,
    starts: Annotated[int, typer.Option(min=1, help="Start states.")] = 100,
    first: Annotated[
        int | None,
        typer.Option("--from", min=0, help="The first start state's number; else those that follow the benchmark's."),
    ] = None,
    config: ConfigOption = None,
    store: StoreOption = None,
    json_to: JsonOption = None,
) -> None:
    """Trained policies in the simulator: success for each chunk, number of executed actions, and delay. Nothing is trained."""
    from demobench.commands.rollouts import run_rollouts

    run_rollouts(
        address, execute=execute, delay=delay, ensemble=ensemble, carry_on=carry_on, seeds=seeds, starts=starts, first=first,
        config_path=config, store_path=store, json_to=json_to,
    )  # fmt: skip


@app.command(
    epilog="""Examples:\n
    demobench proxy pusht_sim                                every offline score against success\n
    demobench proxy pusht_sim so101_sim                      named on the first, tested on the second\n
    demobench proxy pusht_sim so101_sim --observations pose --chunks 16 --json -"""
)
def proxy(
    datasets: Annotated[
        list[str],
        typer.Argument(metavar="DATASET [DATASET2]", help="Data sets with a simulator that were benchmarked."),
    ],
    observations: Annotated[str | None, typer.Option(help="Only these observation sets: position,pose")] = None,
    chunks: Annotated[str | None, typer.Option(help="Only these chunk sizes: 1,16")] = None,
    config: ConfigOption = None,
    store: StoreOption = None,
    json_to: JsonOption = None,
) -> None:
    """Does a smaller offline error mean more success? Over the trained networks in the store; with two data sets, tested."""
    from demobench.commands.proxy import run_proxy

    run_proxy(datasets, observations=observations, chunks=chunks, config_path=config, store_path=store, json_to=json_to)


@app.command(
    epilog="""Examples:\n
    demobench export tape/mlp_k16 mlp_k16.onnx\n
    demobench export pusht_sim/act_k16/pose act.onnx --seed 2 --json -"""
)
def export(
    address: Annotated[str, typer.Argument(metavar="POLICY", help="dataset/policy[/observations].")],
    out: Annotated[Path, typer.Argument(metavar="OUT.onnx", help="The file to write.")],
    seed: Annotated[int, typer.Option(min=0, help="Which of its training seeds.")] = 0,
    config: ConfigOption = None,
    store: StoreOption = None,
    json_to: JsonOption = None,
) -> None:
    """A trained network as an ONNX file for a robot: raw observations in, raw actions out, checked against PyTorch."""
    from demobench.commands.export import run_export

    run_export(address, out, seed=seed, config_path=config, store_path=store, json_to=json_to)


@app.command(
    epilog="""Examples:\n
    demobench split tape                                         which episodes every fold holds out\n
    demobench split tape --format lerobot --fold 0               what LeRobot's trainer takes\n
    demobench split tape --format json --fold 0 --out fold0.json for score --trained-on"""
)
def split(
    dataset: DatasetArgument,
    form: Annotated[
        Literal["text", "json", "lerobot"],
        typer.Option(
            "--format", help="text; json, which score --trained-on reads; or lerobot, an option of its trainer."
        ),
    ] = "text",
    out: Annotated[Path | None, typer.Option(help="Write it to a file.")] = None,
    folds: Annotated[int | None, typer.Option(min=1, help="Another number of folds than the benchmark's.")] = None,
    fold: Annotated[
        int | None, typer.Option(min=0, help="Only this fold, counted from 0: the one you train on.")
    ] = None,
    config: ConfigOption = None,
    store: StoreOption = None,
    json_to: JsonOption = None,
) -> None:
    """Which episodes train and which are held out, so that you can train elsewhere without the held-out ones."""
    from demobench.commands.split import run_split

    run_split(
        dataset, form=form, out=out, folds=folds, fold=fold, config_path=config, store_path=store, json_to=json_to
    )


@app.command(
    epilog="""Examples:\n
    demobench score tape --write-anchors anchors.parquet         the rows to fill in\n
    demobench score tape my_act.parquet --trained-on fold0.json  score them\n
    demobench score tape --lerobot outputs/train/act --lerobot-python lerobot-env/bin/python\n
    demobench score tape --lerobot hub:me/act_tape@main --lerobot-python lerobot-env/bin/python\n
    demobench score tape --remove my_act"""
)
def score(
    dataset: DatasetArgument,
    predictions: Annotated[
        Path | None,
        typer.Argument(metavar="PREDICTIONS.parquet", help="Predictions made anywhere (docs/scoring.md)."),
    ] = None,
    write_anchors: Annotated[
        Path | None, typer.Option(metavar="OUT.parquet", help="Write the rows to fill in, and stop.")
    ] = None,
    fold: Annotated[
        int | None, typer.Option(min=0, help="With --write-anchors: only the episodes that this fold holds out.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="The row's name; else the file's, or the checkpoint's.")] = None,
    observations: Annotated[
        str | None,
        typer.Option(metavar="SET", help="It sees no more than this observation set: hold it against the set's floor."),
    ] = None,
    trained_on: Annotated[
        Path | None,
        typer.Option(help="What it was trained on: a split, a JSON list of episodes, or LeRobot's train_config.json."),
    ] = None,
    lerobot: Annotated[
        str | None,
        typer.Option(
            metavar="CHECKPOINT",
            help="Ask a LeRobot checkpoint instead of reading a file: a folder, or hub:owner/name[@revision].",
        ),
    ] = None,
    lerobot_python: Annotated[
        Path | None, typer.Option(metavar="PATH", help="The Python of the environment that has LeRobot.")
    ] = None,
    device: Annotated[Literal["cpu", "cuda"], typer.Option(help="Where the LeRobot checkpoint is asked.")] = "cpu",
    lerobot_feature: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=COLUMN",
            help="A feature of the checkpoint and the data set's that it is shown. May be repeated.",
        ),
    ] = None,
    remove: Annotated[str | None, typer.Option(metavar="NAME", help="Take a row that was scored out again.")] = None,
    config: ConfigOption = None,
    store: StoreOption = None,
    json_to: JsonOption = None,
) -> None:
    """Predictions made anywhere become a row of the same table: same anchors, same intervals, same verdicts."""
    from demobench.commands.score import run_score

    run_score(
        dataset,
        predictions,
        write_anchors=write_anchors,
        fold=fold,
        name=name,
        observations=observations,
        trained_on=trained_on,
        lerobot=lerobot,
        lerobot_python=lerobot_python,
        device=device,
        features=lerobot_feature or (),
        remove=remove,
        config_path=config,
        store_path=store,
        json_to=json_to,
    )


@app.command(
    epilog="Examples:\n\n    demobench view pusht_sim 0\n\n    demobench view so101_sim 36 --policy mlp_k16\n\n"
    "    demobench view pusht_sim 0 --save episode.rrd\n\n    demobench view held_out.mcap"
)
def view(
    dataset: Annotated[
        str, typer.Argument(help="A data set that was benchmarked; or a recording, FILE.mcap or FILE.rrd.")
    ],
    episode: Annotated[int | None, typer.Argument(help="The episode's recorded number.")] = None,
    policy: Annotated[str | None, typer.Option(help="Only these policies.")] = None,
    save: Annotated[
        Path | None,
        typer.Option(
            help="Write a Rerun recording (or what is recovered of an MCAP file) instead of opening the viewer."
        ),
    ] = None,
    config: ConfigOption = None,
    store: StoreOption = None,
) -> None:
    """Look at one episode in Rerun: what was recorded, and what every policy would have done.

    An MCAP file that was cut off is recovered as far as it goes.
    """
    from demobench.commands.view import is_recording, view_episode, view_file

    if is_recording(dataset) and episode is None:
        view_file(Path(dataset), save)
    else:
        view_episode(dataset, episode, policy, save, config, store)


@app.command(epilog="Examples:\n\n    demobench selftest\n\n    demobench selftest --full --page docs/known_truth.md")
def selftest(
    full: Annotated[
        bool, typer.Option("--full/--quick", help="All of it, half an hour; or what shows a broken estimator.")
    ] = False,
    page: Annotated[
        Path | None, typer.Option(help="Write the report, a Markdown page with its plots beside it.")
    ] = None,
    workers: WorkersOption = 2,
    config: ConfigOption = None,
    store: StoreOption = None,
    json_to: JsonOption = None,
) -> None:
    """Are the statistics right? Every estimator and interval against data whose truth is known. Resumable.

    The exit status is 1 where a goal is missed.
    """
    from demobench.commands.selftest import run_selftest

    passed = run_selftest(full=full, workers=workers, page=page, config_path=config, store_path=store, json_to=json_to)
    if not passed:
        raise typer.Exit(1)


@app.command(
    epilog="Examples:\n\n    demobench ui\n\n    demobench ui --port 3100 --files-port 3101 --mlflow-port 5100"
)
def ui(
    port: Annotated[int, typer.Option(min=1, max=65535, help="Dagster's port.")] = 3000,
    mlflow_port: Annotated[int, typer.Option(min=1, max=65535, help="MLflow's port.")] = 5000,
    files_port: Annotated[int, typer.Option(min=1, max=65535, help="The port of reports and recordings.")] = 3001,
    config: ConfigOption = None,
    store: StoreOption = None,
) -> None:
    """Dagster, MLflow and the reports in the browser, on 127.0.0.1. Ctrl-C stops all."""
    from demobench.commands.ui import serve

    serve(port, mlflow_port, files_port, config, store)


@record_app.command("pusht", epilog="Example:\n\n    demobench record pusht my_pusht --episodes 20 --seed 1")
def record_pusht(
    out: OutArgument,
    episodes: EpisodesOption = 200,
    seed: SeedOption = 0,
    workers: WorkersOption = 2,
) -> None:
    """Record PushT demonstrations in simulation, by a planner with two strategies, as a LeRobot data set."""
    from demobench.commands.record import record_pusht

    record_pusht(out, episodes, seed, workers)


@record_app.command("so101", epilog="Example:\n\n    demobench record so101 my_so101 --episodes 200 --seed 1")
def record_so101(
    out: OutArgument,
    episodes: EpisodesOption = 50,
    seed: SeedOption = 0,
    workers: WorkersOption = 2,
) -> None:
    """Record SO-101 pick-and-place demonstrations in simulation, by a scripted leader, as a LeRobot data set."""
    from demobench.commands.record import record_so101

    record_so101(out, episodes, seed, workers)


def main() -> None:
    """Entry point: a user's mistake is one message and exit status 2; Ctrl-C is 130."""
    # People add --debug at the end of the line that failed, wherever the option belongs.
    debug = "--debug" in sys.argv
    sys.argv[1:] = [word for word in sys.argv[1:] if word != "--debug"]
    try:
        app()
    except DemobenchError as error:
        if debug:
            sys.stderr.write(getattr(error, "traceback", ""))
            raise
        Console(stderr=True, highlight=False, soft_wrap=True).print(f"[bold red]error:[/] {_escape(str(error))}")
        sys.exit(2)
    except KeyboardInterrupt:
        Console(stderr=True).print("stopped")
        sys.exit(130)
    except BrokenPipeError:
        sys.exit(0)


def _escape(text: str) -> str:
    """A message as it is, whatever the files that it quotes may hold: no markup, nothing that a terminal obeys."""
    from rich.markup import escape

    from pipeline.errors import printable

    return escape("\n".join(map(printable, text.split("\n"))))


if __name__ == "__main__":
    main()

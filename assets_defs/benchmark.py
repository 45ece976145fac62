"""The benchmark: one table of policies, baselines and floors, and one page that shows it."""

import json
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import dagster as dg

from assets_defs import up_to_date
from assets_defs.curve import KEY as CURVE
from assets_defs.curve import read_kept
from assets_defs.data import PARTITIONS, demonstrations, episode_split
from assets_defs.floor import ESTIMATES
from assets_defs.history import history_folder, record, with_champion
from assets_defs.links import experiment_link, file_link, history_link
from assets_defs.looking import VIDEO, driven_videos
from assets_defs.plan import Unit
from assets_defs.resources import Bench, Budget, Outcome, Workbench, check_spec, code_version, result, warning_spec
from assets_defs.show import interval_words, picture, present, table
from pipeline.experiment import Variant
from pipeline.methods import EXTERNAL

if TYPE_CHECKING:
    from pipeline.history import Line
    from pipeline.sinks.to_mlflow import Message

TABLE = dg.AssetKey(["benchmark_table"])
REPORT = dg.AssetKey(["benchmark_report"])
REGRESSION = "champion_not_worse"
ROWS = "policies.csv"
"""The table's rows for spreadsheets, and for MLflow, which shows such files as tables."""


def benchmark_assets(
    deps: Sequence[dg.AssetKey], floors: Sequence[dg.AssetsDefinition], cron: str
) -> list[dg.AssetsDefinition]:
    """The table and the page; `deps` are the predictions and roll-outs of every policy, `cron` when they are made by themselves."""
    benchmark_table = _benchmark_table(deps, floors, cron)
    return [benchmark_table, _benchmark_report(benchmark_table)]


def gate_words(cron: str) -> str:
    """What the regression gate asks, how often it is wrong, and what that means at a schedule."""
    from pipeline.statistics.regression import FALSE_ALARMS_AT_MOST, FEWEST_SEEDS, MARGIN, POWER

    runs = runs_a_year(cron)
    often = "less than once" if runs < 1 else "once" if runs == 1 else f"{runs:,.0f} times"
    return (
        f"The champion, trained anew, is not worse than it was: paired by held-out episode, more than {100 * MARGIN:.0f} % beyond "
        f"chance, on the same data with the same settings; needs {FEWEST_SEEDS} seeds. Where nothing changed it alarms in "
        f"{100 * FALSE_ALARMS_AT_MOST:.1f} % of trainings or less (an upper limit over 400 pairs with fresh seeds and resampled "
        f"episodes), and it sees an error that rose by a fifth in {100 * POWER:.0f} % or more (50 episodes). At the schedule "
        f"'{cron}', {often} a year, that is at most {FALSE_ALARMS_AT_MOST * runs:.1f} false alarms a year and data set, and "
        "fewer where most weeks change nothing. It stops nothing."
    )


def runs_a_year(cron: str) -> float:
    """How often a schedule ticks in a year, on average over four that are over: those to come have no partitions yet."""
    span = {"start": "2020-01-01 00:00", "end": "2023-12-31 23:59", "fmt": "%Y-%m-%d %H:%M"}
    between_ticks = dg.TimeWindowPartitionsDefinition(cron_schedule=cron, **span).get_num_partitions()
    return (between_ticks + 1) / 4


def _benchmark_table(
    deps: Sequence[dg.AssetKey], floors: Sequence[dg.AssetsDefinition], cron: str
) -> dg.AssetsDefinition:
    @dg.asset(
        key=TABLE,
        partitions_def=PARTITIONS,
        group_name="benchmark",
        kinds={"json"},
        deps=[demonstrations, episode_split, *floors, *deps],
        code_version=code_version("benchmark_table"),
        check_specs=[
            check_spec(TABLE, "baselines_present", "Hold-still is in the table: every error is read against it."),
            check_spec(TABLE, "same_data", "Every row was computed from the same demonstrations and split."),
            warning_spec(TABLE, REGRESSION, gate_words(cron)),
            warning_spec(TABLE, up_to_date.CHECK, up_to_date.WORDS),
        ],
    )
    def benchmark_table(
        context: dg.AssetExecutionContext, workbench: dg.ResourceParam[Workbench], budget: Budget
    ) -> dg.MaterializeResult:
        """Policies and baselines side by side, on the same held-out episodes, with intervals over episodes.

        It holds every result that is up to date, whichever run made it. Each table is an entry of the history, from which
        follows who the champion is, and whether it got worse (docs/automation.md).
        """
        from pipeline.history import regression_words

        bench = workbench.open(context, budget)
        made = bench.make(Unit("benchmark_table"), lambda draft: _write_table(bench, draft))
        line = record(bench, made, project_version(), context.run.run_id)
        verdict = (not line.got_worse, regression_words(line))
        checks = {**made.summary["checks"], REGRESSION: verdict, up_to_date.CHECK: (True, up_to_date.JUST_MADE)}
        made = replace(made, summary={**made.summary, "checks": checks})
        header = ["policy", "sees", "first-step MAE", "95 %", "× still", "success"]
        metadata = {
            "table": table(header, made.summary["rows"]),
            **_links(context, bench),
            "protocol": bench.experiment.protocol,
            "budget": bench.experiment.budget_words,
            **_history_metadata(bench, line),
            # The UI plots numbers over time, and prints a longer name over the column beside it.
            **{f"mae_{row[0]}_{row[1]}": float(row[2]) for row in made.summary["rows"] if row[2] is not None},
        }
        return result(
            bench,
            TABLE,
            {"": made},
            present(metadata),
            ["baselines_present", "same_data"],
            warnings=[REGRESSION, up_to_date.CHECK],
        )

    return benchmark_table


def _links(context: dg.AssetExecutionContext, bench: Bench) -> dict[str, dg.UrlMetadataValue]:
    """Where the pages and MLflow's comparison are, for whoever looks at the asset or (as tags) at the run."""
    links = {
        "report": file_link(bench, Unit("benchmark_report"), "report.html"),
        "history": history_link(bench),
        "mlflow": experiment_link(bench, bench.outbox.experiment_id(bench.plan.key)),
    }
    context.instance.add_run_tags(context.run.run_id, {f"demobench/{name}": link for name, link in links.items()})
    return {name: dg.MetadataValue.url(link) for name, link in links.items()}


def _history_metadata(bench: Bench, line: "Line") -> dict[str, Any]:
    from pipeline.history import PICTURE, in_words

    return {
        "champion": line.champion,
        "champion_from_now_on": line.next_champion if line.promotion else None,
        "regression": (line.regression or {}).get("word"),
        "champion_in_words": in_words(line),
        "history_chart": picture(history_folder(bench) / PICTURE),
    }


def _write_table(bench: Bench, draft) -> Outcome:
    from pipeline.sinks.rows_csv import write_rows
    from pipeline.statistics.floors import load_estimates
    from pipeline.statistics.metrics import load_errors
    from pipeline.statistics.radius import load_floors
    from pipeline.store import write_json
    from pipeline.table import build_table

    plan = bench.plan
    entries = []
    for unit in plan.fresh_policy_units("predictions"):
        name = unit.asset.split("/")[0]
        trained = bench.summary(Unit(f"{name}/trained_policy", unit.entry))
        rolled = Unit(f"{name}/rollouts", unit.entry)
        entries.append(
            {
                "variant": next(v for v in plan.variants if v.name == name),
                "observations": unit.entry,
                "errors": load_errors(plan.folder(unit) / "errors.safetensors"),
                **bench.summary(unit),
                "parameters": trained["parameters"],
                **{name: trained.get(name) for name in ("train_s", "steps", "cpu_s", "vram_mb")},
                **_rolled_out(bench, rolled),
            }
        )
    entries += [_entry_from_elsewhere(bench, unit) for unit in plan.scored_units() if plan.is_fresh(unit)]
    floor = plan.folder(Unit("multimodality_floor"))
    floors, estimates = load_floors(floor / "radius.json"), load_estimates(floor / ESTIMATES)
    facts = bench.summary(Unit("demonstrations"))["inspect"]
    modes = json.loads((plan.folder(Unit("action_modes")) / "modes.json").read_text(encoding="utf-8"))
    experiment = with_champion(bench.store, plan.key, bench.experiment)
    built = build_table(facts, experiment, bench.split, floors, estimates, entries, modes)
    built["key"] = plan.key
    write_json(draft / "table.json", built)
    write_rows(built["policies"], draft / ROWS)
    rows = [
        (
            row["policy"],
            row["observations"],
            row["first_step_mae"],
            interval_words(row["interval"].get("first_step_mae")),
            row["vs_hold_still"],
            row["rollouts"]["success"] if row["rollouts"] else None,
        )
        for row in built["policies"]
    ]
    still = any(row["policy"] == "hold_still" for row in built["policies"])
    hashes = {entry["split_hash"] for entry in entries}
    return Outcome(
        {"rows": rows},
        {
            "baselines_present": (
                still,
                f"{len(rows)} rows"
                if still
                else "hold_still/predictions is missing or out of date: materialise it first",
            ),
            "same_data": (hashes == {bench.split.hash}, f"split {bench.split.hash[:16]}"),
        },
        [about_benchmark(bench, [ROWS, "table.json"])],
    )


def about_benchmark(bench: Bench, files: Sequence[str]) -> "Message":
    """Files of the table or of its report for the MLflow run of the table that is there now."""
    from pipeline.sinks.to_mlflow import Message, benchmark_card

    made_from = bench.plan.fingerprint(Unit("benchmark_table"))
    card = benchmark_card(bench.experiment, bench.demonstrations, bench.split, bench.plan.key, made_from)
    return Message(card, files=list(files))


def _rolled_out(bench: Bench, unit: Unit) -> dict:
    """What came of a policy's roll-outs, and why there are none where there could be."""
    from pipeline.simulate.trial import load_rollouts

    said = bench.summary(unit) if bench.plan.is_fresh(unit) else {}
    variant = next(v for v in bench.plan.variants if v.name == unit.policy)
    could = bench.experiment.dataset.simulator is not None and variant.is_rolled_out
    return {
        "rollouts": said.get("rollouts"),
        "rolled_out": load_rollouts(bench.plan.folder(unit)) if said.get("rollouts") else [],
        "no_rollouts": said.get("why_not") if could else None,
    }


def _entry_from_elsewhere(bench: Bench, unit: Unit) -> dict:
    """A row that was predicted elsewhere: nothing is known of its size, its training or its speed."""
    from pipeline.statistics.metrics import load_errors

    said = bench.summary(unit)
    return {
        **said,
        "variant": Variant(unit.entry, unit.entry, EXTERNAL, said["chunk"]),
        "errors": load_errors(bench.plan.folder(unit) / "errors.safetensors"),
        "parameters": None,
        "train_s": 0.0,
        "rollouts": None,
        "elsewhere": {name: said[name] for name in ("seen_in_training", "training", "episodes", "samples", "warnings")}
        | {"sight_stated": said["asked"]["observations"] is not None},
    }


def _choice_of_policies(bench: Bench, table) -> str:
    """What the command line must name where the table holds other policies than a run without choices makes."""
    shown = {row["policy"] for row in table["policies"] if row["params"] and row["method"] != EXTERNAL}
    usual = {v.name for v in bench.plan.variants if v.is_trained and not v.only_when_named}
    return "" if shown == usual or not shown else f" --policies {','.join(sorted(shown))}"


def project_version() -> str:
    """This project's version, with the commit where it runs from a checkout."""
    import subprocess
    from importlib.metadata import version

    here = Path(__file__).resolve().parents[1]
    if not (here / ".git").exists():
        return version("demobench")
    asked = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=here, capture_output=True, text=True, check=False
    )
    return f"{version('demobench')} ({asked.stdout.strip()})" if asked.returncode == 0 else version("demobench")


def _benchmark_report(benchmark_table: dg.AssetsDefinition) -> dg.AssetsDefinition:
    @dg.asset(
        key=REPORT,
        partitions_def=PARTITIONS,
        group_name="looking",
        kinds={"html", "altair"},
        deps=[benchmark_table, VIDEO, CURVE],
        code_version=code_version("benchmark_report"),
        check_specs=[check_spec(REPORT, "self_contained", "The page asks for nothing from the network.")],
    )
    def benchmark_report(
        context: dg.AssetExecutionContext, workbench: dg.ResourceParam[Workbench], budget: Budget
    ) -> dg.MaterializeResult:
        """One page, one file, no network: the table, the pictures that explain it, and how to make it again."""
        bench = workbench.open(context, budget)
        unit = Unit("benchmark_report")
        made = bench.make(unit, lambda draft: _write_report(bench, draft))
        metadata = {
            "page": dg.MetadataValue.path(str(bench.plan.folder(unit) / "report.html")),
            **_links(context, bench),
            "size_mb": made.summary["size_mb"],
            "errors": picture(bench.plan.folder(unit) / "errors.png"),
        }
        return result(bench, REPORT, {"": made}, present(metadata), ["self_contained"])

    return benchmark_report


def _curves(bench: Bench) -> dict:
    """The learning curves that are up to date, by `policy/observations`; of several for one the last by its sizes."""
    plan, variants = bench.plan, {v.name: v for v in bench.plan.variants}
    found = {}
    for unit in filter(plan.is_fresh, plan.curves()):
        policy, observations, _ = unit.entry.split("/")
        found[f"{policy}/{observations}"] = read_kept(bench, plan.folder(unit), variants[policy], observations)
    return found


def _write_report(bench: Bench, draft) -> Outcome:
    from pipeline.history import FOLDER, PAGE
    from pipeline.predict import load_predictions
    from pipeline.simulate.trial import load_rollouts
    from pipeline.sinks.figures import benchmark_figures
    from pipeline.sinks.markup import outside_references
    from pipeline.sinks.pictures import picture_table
    from pipeline.sinks.report import Provenance, write_report
    from pipeline.sinks.report_video import Clip
    from pipeline.sinks.settings_file import command_is_enough, settings_file
    from pipeline.statistics.radius import load_floors

    plan = bench.plan
    built = json.loads((plan.folder(Unit("benchmark_table")) / "table.json").read_text())
    built["artifacts"] |= {"mcap": "../mcap_log/held_out.mcap", "rerun": "../rerun_recording/held_out.rrd"}
    built["artifacts"]["history"] = f"../{FOLDER}/{PAGE}"
    predictions = [load_predictions(plan.folder(u)) for u in plan.fresh_predictions()]
    floors = load_floors(plan.folder(Unit("multimodality_floor")) / "radius.json")
    rolled = [u for u in plan.fresh_policy_units("rollouts") if bench.summary(u)["rollouts"]]
    figures = benchmark_figures(
        built,
        bench.demonstrations,
        bench.semantics,
        predictions,
        floors,
        [one for u in rolled for one in load_rollouts(plan.folder(u))],
        _curves(bench),
    )
    enough = command_is_enough(bench.experiment)
    command = bench.experiment.command if enough else f"demobench run {bench.experiment.name}"
    provenance = Provenance(
        command=command + _choice_of_policies(bench, built),
        history=bench.experiment.history,
        version=project_version(),
        made_at=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        warnings=tuple(bench.summary(Unit("demonstrations"))["inspect"]["warnings"]),
        settings=settings_file(bench.experiment),
        needs=not enough,
    )
    page = draft / "report.html"
    clips = [Clip(video, path, path.with_suffix(".png")) for video, path in driven_videos(bench)]
    write_report(page, built, figures, provenance, clips, bench.summary(Unit("rollout_video"))["left_out"])
    picture_table(built, draft / "errors.png")
    outside = outside_references(page)
    return Outcome(
        {"size_mb": round(page.stat().st_size / 1e6, 2)},
        {"self_contained": (not outside, "; ".join(outside) or "no outside reference")},
        [about_benchmark(bench, ["report.html", "errors.png"])],
    )

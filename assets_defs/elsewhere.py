"""Predictions that were made elsewhere, scored like those of any policy here."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import dagster as dg
from pydantic import Field

from assets_defs.data import PARTITIONS, demonstrations, episode_split
from assets_defs.links import mlflow_links
from assets_defs.plan import SCORED, Plan, Unit
from assets_defs.resources import Bench, Budget, Outcome, Workbench, check_spec, code_version, result
from assets_defs.show import picture, present, table
from pipeline.config import check_slug
from pipeline.errors import ConfigError, did_you_mean
from pipeline.experiment import Experiment

KEY = dg.AssetKey([SCORED])


class ScoreConfig(dg.Config):
    """Left empty: what was scored before is shown again."""

    name: str = Field(default="", description="The row's name, for example my_act.")
    predictions: str = Field(default="", description="The parquet file of predictions (docs/scoring.md).")
    trained_on: str = Field(
        default="",
        description="What it was trained on: a split, a JSON list of episodes, or LeRobot's train_config.json.",
    )
    observations: str = Field(default="", description="The observation set that it sees no more than, if it is one.")


@dataclass(frozen=True)
class Request:
    """What is to be scored, under which name."""

    name: str
    predictions: Path
    trained_on: Path | None
    observations: str | None

    def config(self) -> dict[str, Any]:
        """As the asset's settings."""
        return {
            "name": self.name,
            "predictions": str(self.predictions),
            "trained_on": str(self.trained_on or ""),
            "observations": self.observations or "",
        }

    def identity(self, demos: Any) -> dict[str, Any]:
        """What the score depends on: the bytes of the file, the training episodes, what the policy sees.

        Raises:
            ConfigError: the file of training episodes cannot be read.
            DatasetError: the predictions cannot be read.
        """
        from pipeline.external.reading import hash_file
        from pipeline.external.training import read_training

        training = read_training(self.trained_on, demos)
        return {
            "sha256": hash_file(self.predictions),
            "trained_on": training and training.identity(),
            "observations": self.observations,
        }


def check_name(name: str, experiment: Experiment) -> None:
    """A name that can be a row beside the experiment's policies.

    Raises:
        ConfigError: it is no name, or that of a policy of ours.
    """
    check_slug(name, "name of a row")
    taken = {v.name for v in experiment.variants} | {v.family for v in experiment.variants}
    if name in taken:
        raise ConfigError(
            f"'{name}' is a policy of '{experiment.name}'. Give the predictions another name with --name."
        )


def elsewhere_assets() -> list[dg.AssetsDefinition]:
    """The asset, in a group of its own."""

    @dg.asset(
        key=KEY,
        partitions_def=PARTITIONS,
        group_name="elsewhere",
        kinds={"numpy", "parquet", "mlflow"},
        deps=[demonstrations, episode_split],
        code_version=code_version(SCORED),
        check_specs=[
            check_spec(KEY, "aligned", "The predictions fit no other order, unit, frame or episode much better."),
            check_spec(KEY, "whole_episodes", "Every anchor of every episode that is scored was predicted."),
        ],
    )
    def scored_predictions(
        context: dg.AssetExecutionContext, workbench: dg.ResourceParam[Workbench], budget: Budget, config: ScoreConfig
    ) -> dg.MaterializeResult:
        """Predictions made anywhere, as rows of the same table: same anchors, same errors, same intervals.

        The launch names a file; docs/scoring.md describes it. Rows that were scored before stay until
        `demobench score DATASET --remove NAME`.
        """
        bench = workbench.open(context, budget)
        made = {
            u.entry: bench.store.made(bench.plan.folder(u)) for u in bench.plan.scored_units() if bench.plan.is_fresh(u)
        }
        if config.name:
            made[config.name] = _make(bench, config)
        # "Materialize all" comes by here too: with nothing to score it must not stop the table that follows.
        nothing = None if made else "Nothing was scored yet: name a file of predictions in the launchpad."
        rows = [
            (
                name,
                m.summary["observations"],
                m.summary["metrics"]["first_step_mae"],
                len(m.summary["episodes"]),
                m.summary["training"],
            )
            for name, m in made.items()
        ]
        pictures = {
            f"error_by_horizon_{name}": picture(bench.plan.folder(Unit(SCORED, name)) / "error_by_horizon.png")
            for name in made
        }
        header = ["name", "observations", "first-step MAE", "episodes", "training"]
        return result(
            bench,
            KEY,
            made,
            present({"scores": table(header, rows), "nothing": nothing, **pictures, **mlflow_links(bench, made)}),
            ["aligned", "whole_episodes"],
        )

    return [scored_predictions]


def _make(bench: Bench, config: ScoreConfig):
    check_name(config.name, bench.experiment)
    bench.experiment.require_sets([config.observations] if config.observations else [])
    trained_on = Path(config.trained_on) if config.trained_on else None
    request = Request(config.name, Path(config.predictions), trained_on, config.observations or None)
    plan = replace(bench.plan, asked={config.name: request.identity(bench.demonstrations)}, _memo={})
    asked = replace(bench, plan=plan)
    return asked.make(Unit(SCORED, config.name), lambda draft: _score(asked, request, draft))


def _score(bench: Bench, request: Request, draft: Path) -> Outcome:
    from pipeline.external.scoring import ELSEWHERE, score_file
    from pipeline.external.training import read_training
    from pipeline.predict import save_predictions
    from pipeline.sinks.pictures import picture_horizons
    from pipeline.sinks.to_mlflow import about_scores, run_card
    from pipeline.statistics.metrics import save_errors

    demos = bench.demonstrations
    scored = score_file(
        request.predictions,
        name=request.name,
        observations=request.observations,
        training=read_training(request.trained_on, demos),
        demos=demos,
        semantics=bench.semantics,
        split=bench.split,
        experiment=bench.experiment,
    )
    save_predictions(scored.predictions, draft)
    save_errors(scored.score.errors, draft / "errors.safetensors")
    everyone = bench.everyone(request.name)
    picture_horizons(scored.score.metrics, request.name, everyone, demos, draft / "error_by_horizon.png")
    summary = scored.summary(demos)
    asked = bench.plan.asked[request.name]
    changes = {"seeds": len(scored.predictions.seeds), "steps": "unknown"}
    if scored.task.observation_set not in bench.experiment.observation_sets:
        changes["features"] = "unknown"
    run = run_card(
        scored.task,
        bench.plan.key,
        bench.plan.fingerprint(Unit(SCORED, request.name)),
        tags={
            "external": "true",
            "predictions_sha256": asked["sha256"],
            "training": scored.held_out.words,
            "seen_in_training": {True: "true", False: "false", None: "unknown"}[scored.held_out.seen],
        },
        changes=changes,
    )
    samples = {f"samples_{name}": values for name, values in (scored.samples or {}).get("by_horizon", {}).items()}
    return Outcome(
        {
            **summary,
            "asked": asked,
            "observations": request.observations or ELSEWHERE,
            "split_hash": bench.split.hash,
            "file": str(request.predictions),
        },
        {
            "aligned": (True, "; ".join(scored.warnings) or "nothing fits better"),
            "whole_episodes": (True, f"{summary['windows_test']:,} anchors of {len(summary['episodes'])} episodes"),
        },
        [
            about_scores(
                run,
                scored.predictions.seeds,
                scored.score.metrics | samples,
                scored.score.seed_metrics,
                ["error_by_horizon.png"],
            )
        ],
    )


def names_scored(plan: Plan) -> list[str]:
    """The names of all predictions made elsewhere that the store holds."""
    return [unit.entry for unit in plan.scored_units()]


def require_scored(name: str, plan: Plan) -> Unit:
    """The result of that name.

    Raises:
        ConfigError: there is none ("did you mean").
    """
    names = names_scored(plan)
    if name not in names:
        raise ConfigError(f"Nothing was scored under the name '{name}' for '{plan.key}'. {did_you_mean(name, names)}")
    return Unit(SCORED, name)

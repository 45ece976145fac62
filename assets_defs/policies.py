"""Three assets for every policy, made by a factory: its weights, its predictions on held-out episodes, its roll-outs.

Baselines go the same way as trained policies. An asset of a policy holds one entry for each observation set.
"""

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import dagster as dg

from assets_defs.data import PARTITIONS, demonstrations, episode_split, windows
from assets_defs.links import mlflow_links
from assets_defs.plan import Unit
from assets_defs.resources import Bench, Budget, Outcome, Workbench, check_spec, code_version, result
from assets_defs.show import picture, present, table
from pipeline.experiment import Variant
from pipeline.store import Made

TRAINED = """Weights of `{name}`: {what}

One entry an observation set; all seeds of all folds, as safetensors. A killed run goes on from its last checkpoint."""
PREDICTIONS = """What `{name}` predicts at every held-out anchor, and how far that is from what was recorded.

Errors are kept per episode, horizon and joint, so that every metric and interval can be made from them."""
ROLLOUTS = """`{name}` acting in the simulator from numbered start states, the same for every policy.

Where the data set has no simulator the record says so. The first `rollout_seeds` training seeds of fold 0 are rolled out."""


def policy_assets(variant: Variant) -> list[dg.AssetsDefinition]:
    """The branch of one policy, in a group named after it."""
    trained = _trained_policy(variant)
    return [trained, _predictions(variant, trained), _rollouts(variant, trained)]


def _make_entries(
    bench: Bench, variant: Variant, kind: str, work: Callable[[Bench, Variant, Unit, Path], Outcome]
) -> dict[str, Made]:
    """Every entry of one asset of a policy that is asked for: observation set → what made it."""
    units = _units(bench, variant, kind)
    return {unit.entry: bench.make(unit, partial(work, bench, _its(bench, variant), unit)) for unit in units}


def _units(bench: Bench, variant: Variant, kind: str) -> list[Unit]:
    """The entries that are asked for; none where the data set does not have the policy."""
    its = _its(bench, variant)
    return bench.plan.selected_units(its, kind) if its else []


def _its(bench: Bench, variant: Variant) -> Variant | None:
    """The policy as the data set has it; None where it does not."""
    return next((v for v in bench.plan.variants if v.name == variant.name), None)


def _not_part(bench: Bench, variant: Variant) -> str | None:
    """Why there are no entries, where the data set does not have the policy: a run of everything must not stop at that."""
    if _its(bench, variant) is not None:
        return None
    of_file = bench.workbench.config.policies.get(variant.family)
    if of_file is not None and not of_file.is_for(bench.experiment.name):
        return f"{variant.name} is for other data sets only: {', '.join(of_file.datasets)}."
    return (
        f"'{bench.plan.key}' was benchmarked from the command line with the policies of that time, and {variant.name} is none of "
        f"them. demobench run {bench.experiment.dataset.source} takes those of the file as it is now."
    )


def _trained_policy(variant: Variant) -> dg.AssetsDefinition:
    asset_key = dg.AssetKey([variant.name, "trained_policy"])
    method = "a baseline: nothing is trained" if not variant.is_trained else f"method `{variant.method}`"
    what = f"{method}, chunk {variant.chunk}." if variant.chunk else f"{method}."

    @dg.asset(
        key=asset_key,
        partitions_def=PARTITIONS,
        group_name=variant.name,
        kinds={"pytorch", "mlflow"} if variant.is_trained else {"numpy", "mlflow"},
        deps=[demonstrations, episode_split, windows],
        code_version=code_version("trained_policy"),
        description=TRAINED.format(name=variant.name, what=what),
        check_specs=[check_spec(asset_key, "finite_losses", "Training ended with finite losses in every seed.")],
    )
    def trained_policy(
        context: dg.AssetExecutionContext, workbench: dg.ResourceParam[Workbench], budget: Budget
    ) -> dg.MaterializeResult:
        bench = workbench.open(context, budget)
        made = _make_entries(bench, variant, "trained_policy", _train)
        rows = [
            (
                entry,
                *(m.summary.get(name) for name in ("parameters", "steps", "train_s", "cpu_s", "vram_mb", "last_loss")),
            )
            for entry, m in made.items()
        ]
        plots = {
            f"losses_{unit.entry}": picture(bench.plan.folder(unit) / "losses.png")
            for unit in _units(bench, variant, "trained_policy")
        }
        header = ["observations", "parameters", "steps", "training s", "CPU s", "GPU memory, MB", "last loss"]
        why_none = {"why_none": _not_part(bench, variant)}
        metadata = {"training": table(header, rows), **plots, **mlflow_links(bench, made), **why_none}
        return result(bench, asset_key, made, present(metadata), ["finite_losses"])

    return trained_policy


def _train(bench: Bench, variant: Variant, unit: Unit, draft: Path) -> Outcome:
    import numpy as np

    from pipeline.folds import train_folds
    from pipeline.sinks.pictures import picture_losses
    from pipeline.sinks.to_mlflow import about_training

    task = bench.task(variant, unit.entry)
    unfinished = bench.store.dataset(bench.plan.key) / ".unfinished" / bench.plan.fingerprint(unit)
    name = f"{variant.name} {unit.entry}"
    folds = train_folds(
        task,
        draft,
        unfinished,
        lambda done, total, loss: bench.progress(name, done, total, "" if np.isnan(loss) else f"loss {loss:.4g}"),
        recorded=bench.store.dataset(bench.plan.key) / ".steps" / f"{bench.plan.fingerprint(unit)}.json",
    )
    known = all(t.losses.size for t in folds)
    last = float(np.mean([t.losses[:, -1].mean() for t in folds])) if known else None
    if known:
        picture_losses(folds[0], variant.name, bench.everyone(variant.name), draft / "losses.png")
    shutil.rmtree(unfinished, ignore_errors=True)
    return Outcome(
        {
            "parameters": folds[0].parameters,
            "train_s": sum(t.train_s for t in folds),
            "steps": max(t.steps for t in folds),
            "cpu_s": sum(t.cpu_s for t in folds),
            "vram_mb": max(t.vram_mb for t in folds),
            "last_loss": last,
        },
        {
            "finite_losses": (
                last is None or bool(np.isfinite(last)),
                "no losses are known" if last is None else f"{last:.4g}",
            )
        },
        [
            about_training(
                bench.run_card(variant, unit.entry),
                folds,
                task.seeds if variant.is_trained else (),
                "fold_0" if variant.is_trained else None,
            )
        ],
    )


def _predictions(variant: Variant, trained: dg.AssetsDefinition) -> dg.AssetsDefinition:
    asset_key = dg.AssetKey([variant.name, "predictions"])

    @dg.asset(
        key=asset_key,
        partitions_def=PARTITIONS,
        group_name=variant.name,
        kinds={"numpy"},
        deps=[trained],
        code_version=code_version("predictions"),
        description=PREDICTIONS.format(name=variant.name),
        check_specs=[
            check_spec(asset_key, "finite", "Every prediction is a finite number."),
            check_spec(asset_key, "every_held_out_episode", "Every held-out episode is scored."),
        ],
    )
    def predictions(
        context: dg.AssetExecutionContext, workbench: dg.ResourceParam[Workbench], budget: Budget
    ) -> dg.MaterializeResult:
        bench = workbench.open(context, budget)
        made = _make_entries(bench, variant, "predictions", _predict)
        rows = [
            (
                entry,
                m.summary["metrics"]["first_step_mae"],
                m.summary["metrics"]["vs_hold_still"],
                m.summary["latency_ms"],
                m.summary["latency_p99_ms"],
            )
            for entry, m in made.items()
        ]
        plots = {
            f"error_by_horizon_{unit.entry}": picture(bench.plan.folder(unit) / "error_by_horizon.png")
            for unit in _units(bench, variant, "predictions")
        }
        numbers = {f"first_step_mae_{row[0]}": dg.MetadataValue.float(row[1]) for row in rows if row[1] is not None}
        header = ["observations", "first-step MAE", "× hold-still", "latency, ms", "99th percentile, ms"]
        metadata = {"scores": table(header, rows), **numbers, **plots, "why_none": _not_part(bench, variant)}
        return result(bench, asset_key, made, present(metadata), ["finite", "every_held_out_episode"])

    return predictions


def _predict(bench: Bench, variant: Variant, unit: Unit, draft: Path) -> Outcome:
    import numpy as np

    from pipeline.folds import predict_folds
    from pipeline.predict import save_predictions
    from pipeline.sampling import sampled_scores
    from pipeline.sinks.pictures import picture_horizons
    from pipeline.sinks.to_mlflow import about_scores
    from pipeline.statistics.metrics import save_errors, score_task

    task = bench.task(variant, unit.entry)
    trained_unit = Unit(f"{variant.name}/trained_policy", unit.entry)
    bench.progress(f"{variant.name} {unit.entry} predictions", 0, 1, "")
    predicted, facts = predict_folds(task, bench.plan.folder(trained_unit))
    broken = int((~np.isfinite(predicted.actions)).sum())
    score = score_task(task, predicted)
    samples = sampled_scores(task, bench.plan.folder(trained_unit))
    save_predictions(predicted, draft)
    save_errors(score.errors, draft / "errors.safetensors")
    picture_horizons(
        score.metrics, variant.name, bench.everyone(variant.name), task.demos, draft / "error_by_horizon.png"
    )
    held_out = set(task.split.held_out)
    scored = set(score.errors.episodes.tolist())
    return Outcome(
        {"metrics": score.metrics, "samples": samples, "split_hash": task.split.hash, **facts},
        {
            "finite": (not broken, f"{broken:,} of {predicted.actions.size:,} numbers are not finite"),
            "every_held_out_episode": (scored == held_out, f"{len(scored)} of {len(held_out)} episodes"),
        },
        [
            about_scores(
                bench.run_card(variant, unit.entry),
                task.seeds,
                score.metrics | _series_of(samples),
                score.seed_metrics,
                ["error_by_horizon.png"],
            )
        ],
    )


def _series_of(samples: dict | None) -> dict[str, list[float]]:
    """The scores of samples as metrics whose step is the horizon: `samples_energy`, `samples_of_mean`, `samples_of_one`."""
    return {f"samples_{name}": values for name, values in samples["by_horizon"].items()} if samples else {}


def _rollouts(variant: Variant, trained: dg.AssetsDefinition) -> dg.AssetsDefinition:
    asset_key = dg.AssetKey([variant.name, "rollouts"])

    @dg.asset(
        key=asset_key,
        partitions_def=PARTITIONS,
        group_name=variant.name,
        kinds={"gymnasium"},
        deps=[trained],
        code_version=code_version("rollouts"),
        description=ROLLOUTS.format(name=variant.name),
        check_specs=[check_spec(asset_key, "sane", "Rewards lie in 0 … 1, and a success has the reward of one.")],
    )
    def rollouts(
        context: dg.AssetExecutionContext, workbench: dg.ResourceParam[Workbench], budget: Budget
    ) -> dg.MaterializeResult:
        bench = workbench.open(context, budget)
        made = _make_entries(bench, variant, "rollouts", _roll_out)
        rows = []
        for entry, m in made.items():
            r = m.summary["rollouts"]
            rows.append((entry, m.summary["why_not"], r and r["n"], r and r["success"], r and r["score"]))
        header = ["observations", "not applicable", "start states", "success rate", "score (mean best reward)"]
        metadata = {"rollouts": table(header, rows), "why_none": _not_part(bench, variant)}
        return result(bench, asset_key, made, present(metadata), ["sane"])

    return rollouts


def _roll_out(bench: Bench, variant: Variant, unit: Unit, draft: Path) -> Outcome:
    from pipeline.errors import ConfigError, NotApplicableError, PolicyError
    from pipeline.simulate.trial import roll_out, save_rollouts
    from pipeline.sinks.to_mlflow import about_rollouts
    from pipeline.statistics.closed_loop import summarise_rollouts

    task, trained_unit = bench.task(variant, unit.entry), Unit(f"{variant.name}/trained_policy", unit.entry)
    name = f"{variant.name} {unit.entry} roll-outs"
    try:
        results = roll_out(
            task,
            bench.plan.folder(trained_unit),
            lambda done, total: bench.progress(name, done, total, "frames"),
        )
    except (NotApplicableError, PolicyError, ConfigError) as why:
        # One policy that cannot be rolled out must not keep the others from the table, which says why this one was not.
        return Outcome({"rollouts": None, "why_not": str(why)}, {"sane": (True, str(why))})
    save_rollouts(results, draft)
    summary = summarise_rollouts(results)
    in_range = all(((one.best_reward >= 0) & (one.best_reward <= 1)).all() for one in results)
    agree = all((one.best_reward[one.success] >= 1).all() for one in results)
    words = [f"{summary['successes']} of {summary['episodes']} succeeded, score {summary['score']:.3f}"]
    words += [
        f"{s} {count}" for s, count in zip(summary.get("stages", ()), summary.get("stage_counts", ()), strict=True)
    ]
    return Outcome(
        {"rollouts": summary, "why_not": None},
        {"sane": (bool(in_range and agree), ", ".join(words))},
        [about_rollouts(bench.run_card(variant, unit.entry), summary)],
    )

"""The learning curve: would more demonstrations help?"""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import dagster as dg
from pydantic import Field

from assets_defs.data import PARTITIONS, episode_split
from assets_defs.floor import ESTIMATES, multimodality_floor
from assets_defs.history import with_champion
from assets_defs.plan import CODE_VERSIONS, Plan, Unit, curve_unit, sizes_of
from assets_defs.resources import Bench, Budget, Outcome, Workbench, check_spec, code_version, result
from assets_defs.show import picture, present, table
from pipeline.config import hash_of
from pipeline.errors import ConfigError, did_you_mean
from pipeline.experiment import Experiment, Variant

if TYPE_CHECKING:
    from pipeline.statistics.curve_reading import Reading

KEY = dg.AssetKey(["learning_curve"])


class CurveConfig(dg.Config):
    """Left empty: about an eighth, a quarter and a half of the training episodes. All of them are always there."""

    sizes: list[int] = Field(
        default_factory=list, description="Numbers of training episodes, for example [10, 20, 40]."
    )


def curve_assets(predictions: Sequence[dg.AssetKey]) -> list[dg.AssetsDefinition]:
    """The asset; `predictions` are those of every policy, of which the launch names one."""

    @dg.asset(
        key=KEY,
        partitions_def=PARTITIONS,
        group_name="benchmark",
        kinds={"pytorch", "numpy", "altair"},
        deps=[episode_split, multimodality_floor, *predictions],
        code_version=code_version("learning_curve"),
        check_specs=[
            check_spec(KEY, "ends_in_the_table", "The error at full size is that of the policy's predictions."),
            check_spec(KEY, "same_episodes", "Every size is scored on the same held-out episodes."),
        ],
    )
    def learning_curve(
        context: dg.AssetExecutionContext, workbench: dg.ResourceParam[Workbench], budget: Budget, config: CurveConfig
    ) -> dg.MaterializeResult:
        """Error against the number of training episodes, and whether 50 more demonstrations would help.

        One policy is trained on nested parts of each fold's training episodes and scored on the same held-out episodes. The
        policy is the data set's champion, else the first that is trained; the launch's budget can name others. Not part of a
        benchmark: it trains for longer than one.
        """
        bench = workbench.open(context, budget)
        experiment = with_champion(bench.store, bench.plan.key, bench.experiment)
        units = curves_asked(experiment, bench.plan.variants, budget.policies, budget.observations, config.sizes)
        made = {
            unit.entry: bench.make(unit, lambda draft, unit=unit: _draw_curve(bench, unit, draft)) for unit in units
        }
        rows = [
            (*unit.entry.split("/")[:2], a["metric"], a["word"], a["words"])
            for unit in units
            for a in made[unit.entry].summary["answers"]
        ]
        points = [
            (*unit.entry.split("/")[:2], p["episodes"], p["error"], *(p["interval"] or (None, None)))
            for unit in units
            for p in made[unit.entry].summary["sizes"]
        ]
        pictures = {
            f"{path.stem}_{unit.entry.replace('/', '_')}": picture(path)
            for unit in units
            for path in sorted(bench.plan.folder(unit).glob("*.png"))
        }
        metadata = {
            "would_more_help": table(["policy", "observations", "error", "answer", "in words"], rows),
            "curve": table(["policy", "observations", "training episodes", "first-step MAE", "low", "high"], points),
            "budget": bench.experiment.budget_words,
            **pictures,
        }
        return result(bench, KEY, made, present(metadata), ["ends_in_the_table", "same_episodes"])

    return [learning_curve]


def curves_asked(
    experiment: Experiment,
    variants: Sequence[Variant],
    policies: Sequence[str] = (),
    observations: Sequence[str] = (),
    sizes: Sequence[int] = (),
) -> list[Unit]:
    """The curves that a launch asks for: of the policies it names, with the observation sets it names.

    Without names: the champion of `experiment` (with the set that it names), else the first policy that is trained by itself. The
    champion is that of the history (`history.with_champion`), which may be gone since.

    Raises
    ------
    ConfigError : no such policy, or a policy that is not asked with such a set.
    NotApplicableError : the policy does not learn.
    """
    from pipeline.curve import require_learning

    known = {v.name: v for v in variants}
    champion, _, champions_set = (experiment.dataset.champion or "").partition("/")
    by_itself = [v.name for v in variants if v.is_trained and not v.only_when_named]
    names = list(policies) or [champion if champion in known else (by_itself or ["nearest_neighbour"])[0]]
    units = []
    for name in names:
        if name not in known:
            raise ConfigError(f"No policy '{name}'. {did_you_mean(name, known)}")
        require_learning(known[name])
        wanted = list(observations) or ([champions_set] if name == champion and champions_set else [])
        experiment.require_sets(wanted)
        has = [s.name for s in experiment.sets_of(known[name])]
        for missing in (s for s in wanted if s not in has):
            raise ConfigError(
                f"'{name}' is not asked with the observation set '{missing}', only with {', '.join(has)}."
            )
        units += [curve_unit(name, s, sizes) for s in (wanted or has)]
    return units


def _draw_curve(bench: Bench, unit: Unit, draft: Path) -> Outcome:
    """Train on every subset, keep the errors by size, and say what they mean."""
    from pipeline.curve import curve_sizes, full_size, train_subsets
    from pipeline.sinks.to_mlflow import about_curve
    from pipeline.statistics.curve_reading import errors_file, keep_errors
    from pipeline.statistics.metrics import load_errors, save_errors

    policy, observations, _ = unit.entry.split("/")
    task = bench.task(next(v for v in bench.plan.variants if v.name == policy), observations)
    if task.steps is None:
        # CPU-seconds: every size gets as many steps as the full number of episodes got.
        task = task.with_steps(bench.summary(Unit(f"{policy}/trained_policy", observations))["steps"])
    sizes = curve_sizes(task.split, sizes_of(unit))
    kept = _kept_subsets(bench, policy, observations)
    train_subsets(
        task, sizes, kept, keep_errors, lambda done, total, words: bench.progress(unit.entry, done, total, words)
    )
    predictions = Unit(f"{policy}/predictions", observations)
    full = load_errors(bench.plan.folder(predictions) / "errors.safetensors")
    by_size = {size: _joined(task, kept, size) for size in sizes}
    for size, orders in by_size.items():
        for order, errors in enumerate(orders):
            save_errors(errors, draft / errors_file(size, order))
    save_errors(full, draft / errors_file(full_size(task.split), 0))
    said = _describe(bench, task, draft)
    table_value = bench.summary(predictions)["metrics"]["first_step_mae"]
    same = all(
        (e.episodes == full.episodes).all() and (e.anchors == full.anchors).all() for o in by_size.values() for e in o
    )
    last = said["sizes"][-1]["error"]
    return Outcome(
        {**said, "steps": task.steps, "seeds": list(task.seeds)},
        {
            "ends_in_the_table": (abs(last - table_value) <= 1e-9 * abs(table_value), f"{last:.6g}"),
            "same_episodes": (bool(same), f"{len(full.episodes)} held-out episodes"),
        },
        [
            about_curve(
                bench.run_card(task.variant, observations), said["sizes"], sorted(p.name for p in draft.glob("*.png"))
            )
        ],
    )


def _kept_subsets(bench: Bench, policy: str, observations: str) -> Path:
    """Where the errors of single subsets are kept: a run that was stopped, and one with other sizes, go on from them.

    They belong to one fingerprint of the policy's training; those of an earlier one are removed.
    """
    trained = bench.plan.fingerprint(Unit(f"{policy}/trained_policy", observations))
    folder = bench.store.dataset(bench.plan.key) / ".subsets" / policy / observations
    current = folder / hash_of([trained, CODE_VERSIONS["learning_curve"]])[:32]
    for other in folder.glob("*"):
        if other != current:
            shutil.rmtree(other, ignore_errors=True)
    return current


def _joined(task, kept: Path, size: int) -> list:
    """The errors of one size, an entry an order, each with the episodes of all folds."""
    from pipeline.curve import nested_subsets, orders_of
    from pipeline.statistics.curve_reading import join_errors
    from pipeline.statistics.metrics import load_errors

    subsets = nested_subsets(task.split, [size])
    return [
        join_errors([load_errors(kept / f"{s.name}.safetensors") for s in subsets if s.order == order])
        for order in range(orders_of(task.split))
    ]


def _describe(bench: Bench, task, draft: Path) -> dict[str, Any]:
    """What the errors in the draft say (JSON-able), and their pictures."""
    from pipeline.sinks.curve_chart import picture_curve
    from pipeline.sinks.words import common_unit
    from pipeline.statistics.curve import METRIC_WORDS
    from pipeline.types import ACTION

    unit = common_unit(task.demos.features[ACTION].units)
    read = read_kept(bench, draft, task.variant, task.observation_set.name)
    for metric, points in read.points.items():
        picture_curve(
            points, draft / f"{metric}.png", what=METRIC_WORDS[metric].removeprefix("the "), unit=unit,
            policy=task.variant.name, everyone=bench.everyone(task.variant.name), floor=read.floors.get(metric),
        )  # fmt: skip
    return read.as_json()


def read_kept(bench: Bench, folder: Path, variant: Variant, observations: str) -> "Reading":
    """What the errors in a curve's folder say, with the floors of its observation set."""
    from pipeline.sinks.words import common_unit
    from pipeline.statistics.curve_reading import read_curve
    from pipeline.types import ACTION

    demos = bench.demonstrations
    return read_curve(
        folder, fps=demos.fps, protocol=bench.experiment.protocol, trained=variant.is_trained,
        unit=common_unit(demos.features[ACTION].units), floors=floors_of(bench.plan, observations),
    )  # fmt: skip


def floors_of(plan: Plan, observations: str) -> list:
    """The floors that were measured for an observation set; none where they have not been."""
    from pipeline.statistics.floors import load_estimates

    path = plan.folder(Unit("multimodality_floor")) / ESTIMATES
    return [f for f in load_estimates(path) if f.observations == observations] if path.exists() else []

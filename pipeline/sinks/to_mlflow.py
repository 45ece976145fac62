"""What MLflow is to hear: one experiment a data set, one run a policy × observation set, seeds as nested runs.

What belongs here: names of parameters, metrics and tags, and messages that hold them as plain numbers and words. What does
not: computing any of them, and sending them (`mlflow_outbox`), which may have to wait until MLflow can be reached.
"""

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pipeline.experiment import Experiment
from pipeline.folds import PolicyTask
from pipeline.types import Demonstrations, Split

Series = Mapping[str, Sequence[tuple[int, float]]]
"""Metric → (step, value) pairs."""

CHAMPION = "champion"
"""The alias in the model registry."""
VIEW = "demobench"
"""The name of the view of an experiment that links lead to: MLflow keeps such views as tags of the experiment."""
NOTE = """One run a policy × observation set, its training seeds as nested runs; one run `benchmark` a table, with the report.

`first_step_mae` is the error of the first action on held-out episodes; of `error_by_horizon` the step is how many actions ahead;
`rollout_…` is closed loop. Intervals, and what is better than chance, are in the report."""
COMPARED = (
    "first_step_mae",
    "error_by_horizon",
    "vs_hold_still",
    "at_one_second_mae",
    "rollout_success",
    "rollout_score",
)
"""The charts of the view, in order; MLflow's own are all metrics by the alphabet. Errors of whole chunks cannot be compared."""


def tracking_uri(setting: str, store_root: Path) -> str:
    """`"sqlite"` is a file in the store; anything else is a server's address."""
    return f"sqlite:///{store_root / 'mlflow.db'}" if setting == "sqlite" else setting


def without_secret(uri: str) -> str:
    """The address without a user and password that somebody may have put into it."""
    scheme, _, rest = uri.partition("://")
    return f"{scheme}://{rest.rpartition('@')[2]}"


def experiment_tags() -> dict[str, str]:
    """What a data set's experiment says about itself, and how its policies are compared: the best first, without seeds."""
    charts = [
        {
            "uuid": f"{VIEW}-{metric}",
            "type": "LINE" if metric.endswith("by_horizon") else "BAR",
            "metricKey": metric,
            "selectedMetricKeys": [metric],
            "displayName": metric,
            "metricSectionId": VIEW,
            "runsCountToCompare": 50,
            "xAxisKey": "step",
            "useGlobalXaxisKey": True,
            "lineSmoothness": 0,
            "scaleType": "linear",
            "deleted": False,
            "isGenerated": False,
        }
        for metric in COMPARED
    ]
    section = {"uuid": VIEW, "name": "Policies", "display": True, "isReordered": False, "deleted": False}
    view = {
        "compareRunCharts": charts,
        "compareRunSections": [section | {"isGenerated": False}],
        "isAccordionReordered": False,
        "runsHiddenMode": "SHOW_ALL",
        "searchFilter": "params.`policy` != ''",  # seeds have no parameters
        "orderByKey": "metrics.`first_step_mae`",
        "orderByAsc": True,
        "selectedColumns": [
            "params.`chunk`",
            "params.`seeds`",
            "params.`steps`",
            *(f"metrics.`{m}`" for m in COMPARED),
        ],
    }
    return {"mlflow.note.content": NOTE, f"mlflow.sharedViewState.{VIEW}": json.dumps(view)}


@dataclass(frozen=True)
class RunCard:
    """Everything needed to find an MLflow run, or to open it where there is none (a new server, a store that was deleted).

    fingerprint  of what the run is about; the run of an experiment that is tagged with it is the one
    params       what people compare by
    tags         what people search by, without the prefix `demobench.`
    dataset      name, digest (of the content), source, revision, and a few facts
    """

    experiment: str
    name: str
    fingerprint: str
    params: Mapping[str, str]
    tags: Mapping[str, str]
    dataset: Mapping[str, Any]


@dataclass(frozen=True)
class Message:
    """One result for MLflow. Files and folders are named within the result's own folder.

    series   metrics of the run
    seeds    training seed → metrics of its nested run
    files    artefacts
    model    the folder of weights to be logged as the run's model
    alias    the model registry's name for the run's model, which moves here
    time_ms  when it was made, since 1970: sent twice, a metric is still there once
    """

    run: RunCard
    series: Series = field(default_factory=dict)
    seeds: Mapping[str, Series] = field(default_factory=dict)
    files: Sequence[str] = ()
    model: str | None = None
    alias: str | None = None
    time_ms: int = field(default_factory=lambda: int(time.time() * 1000))

    def as_json(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def of(cls, said: Mapping[str, Any]) -> "Message":
        """The inverse of `as_json`."""
        return cls(**{**said, "run": RunCard(**said["run"])})


def run_card(
    task: PolicyTask,
    experiment: str,
    fingerprint: str,
    *,
    tags: Mapping[str, str] | None = None,
    changes: Mapping[str, Any] | None = None,
) -> RunCard:
    """The run of one policy with one observation set; `changes` to the parameters of the task, None to leave one out."""
    variant, demos = task.variant, task.demos
    params = {
        "policy": variant.name,
        "method": variant.method,
        "chunk": variant.chunk,
        "observations": task.observation_set.name,
        "features": ", ".join(task.observation_set.features),
        "protocol": task.experiment.protocol,
        "seeds": len(task.seeds),
        "steps": task.steps,
        "folds": len(task.split.folds),
        "history": task.policy.history or task.experiment.history,
        **{key: value for key, value in task.policy.given.items() if key not in ("steps", "history")},
        **{f"settings.{key}": value for key, value in task.policy.settings.items()},
        **(changes or {}),
    }
    return RunCard(
        experiment=experiment,
        name=f"{variant.name}/{task.observation_set.name}",
        fingerprint=fingerprint,
        params={key: str(value) for key, value in params.items()},
        tags=_tags_of(demos, task.split.hash) | {key: str(value) for key, value in (tags or {}).items()},
        dataset=_dataset_of(demos),
    )


def benchmark_card(experiment: Experiment, demos: Demonstrations, split: Split, key: str, fingerprint: str) -> RunCard:
    """The run of one table. It has no policy, so that comparisons of policies leave it out."""
    params = {name: getattr(experiment, name) for name in ("protocol", "seeds", "steps", "history")}
    return RunCard(
        experiment=key,
        name="benchmark",
        fingerprint=fingerprint,
        params={name: str(value) for name, value in (params | {"folds": len(split.folds)}).items()},
        tags=_tags_of(demos, split.hash),
        dataset=_dataset_of(demos),
    )


def _tags_of(demos: Demonstrations, split_hash: str) -> dict[str, str]:
    return {
        "content_hash": demos.content_hash,
        "split_hash": split_hash,
        "revision": demos.revision or "",
        "data_set": demos.name,
        "excluded": ", ".join(map(str, demos.excluded))[:5000],
    }


def _dataset_of(demos: Demonstrations) -> dict[str, Any]:
    facts = {"episodes": demos.episodes, "frames": demos.frames, "fps": demos.fps, "content_hash": demos.content_hash}
    return {"name": demos.name, "source": demos.source, "revision": demos.revision, "facts": facts}


def about_training(run: RunCard, trained: Sequence, seeds: Sequence[int], model: str | None) -> Message:
    """What training cost, the losses of every seed and fold, and the weights in the folder `model`; no seeds of a baseline."""
    costs = {
        "train_s": sum(t.train_s for t in trained),
        "parameters": trained[0].parameters,
        "steps": trained[0].steps,
    }
    losses = {
        str(seed): {
            f"loss_fold_{fold}": [
                (int(step), float(loss)) for step, loss in zip(t.steps_logged, t.losses[number], strict=True)
            ]
            for fold, t in enumerate(trained)
        }
        for number, seed in enumerate(seeds)
    }
    return Message(run, series_of(costs), losses, model=model, files=["losses.png"])


def about_scores(
    run: RunCard,
    seeds: Sequence[int],
    metrics: Mapping[str, Any],
    seed_metrics: Sequence[Mapping[str, Any]],
    files: Sequence[str] = (),
) -> Message:
    """What was scored: single numbers as metrics, per-horizon errors with the horizon as step, pictures as artefacts."""
    own = zip(seeds, seed_metrics, strict=True) if len(seed_metrics) > 1 else ()
    return Message(run, series_of(metrics), {str(seed): series_of(values) for seed, values in own}, list(files))


def about_rollouts(run: RunCard, summary: Mapping[str, Any]) -> Message:
    """Closed-loop results: `rollout_success`, `rollout_score` and their limits; each seed's own to its nested run."""
    own = {
        str(one["seed"]): {"rollout_success": one["successes"] / summary["n"], "rollout_score": one["score"]}
        for one in (summary["per_seed"] if summary["seeds"] > 1 else ())
    }
    values = series_of({f"rollout_{name}": value for name, value in summary.items()})
    return Message(run, values, {seed: series_of(said) for seed, said in own.items()})


def about_curve(run: RunCard, sizes: Sequence[Mapping[str, Any]], files: Sequence[str] = ()) -> Message:
    """A learning curve: `curve_first_step_mae` and `curve_at_one_second_mae`, the step is the number of training episodes."""
    later = [size["at_one_second"] for size in sizes if size["at_one_second"]]
    series = {
        "curve_first_step_mae": [(size["episodes"], size["error"]) for size in sizes],
        "curve_at_one_second_mae": [(size["episodes"], size["error"]) for size in later],
    }
    return Message(run, series, files=list(files))


def about_champion(run: RunCard) -> Message:
    """The run's model is the one to beat: the alias in the registry moves to it."""
    return Message(run, alias=CHAMPION)


def series_of(metrics: Mapping[str, Any]) -> dict[str, list[tuple[int, float]]]:
    """Numbers and lists of numbers as (step, value) pairs; what is missing is left out. A list's step is its horizon."""
    found = {}
    for name, value in metrics.items():
        values = value if isinstance(value, list) else [value]
        pairs = [(i, float(v)) for i, v in enumerate(values) if isinstance(v, (int, float)) and not isinstance(v, bool)]
        if pairs:
            found[name] = pairs
        if isinstance(value, Mapping):
            for part, number in value.items():
                if isinstance(number, (int, float)):
                    found[f"{name}.{_metric_name(str(part))}"] = [(0, float(number))]
    return found


def _metric_name(text: str) -> str:
    """MLflow allows letters, digits, `_ - . space : /`."""
    return "".join(c if c.isalnum() or c in "_-. :/" else "_" for c in text)

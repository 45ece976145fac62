"""demobench from Python: the same names as on the command line, arrays instead of files.

    data = demobench.read("path/to/my_dataset")
    folds = demobench.split(data)
    mlp = demobench.predict(data, "mlp", chunk=16)
    demobench.score(data, mlp).metrics["first_step_mae"]

What belongs here: short ways to what the pipeline offers, nothing kept on disk. What does not: any number's making.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.config import BUDGETS, DatasetConfig, find_config, load_config, parse_config
from pipeline.errors import ConfigError, did_you_mean
from pipeline.experiment import Choices, Experiment, Variant, resolve_target, variants
from pipeline.methods import EXTERNAL, METHODS
from pipeline.types import (
    Demonstrations,
    EpisodeErrors,
    FloorEstimate,
    ObservationSet,
    Predictions,
    Semantics,
    Split,
)  # fmt: skip

if TYPE_CHECKING:
    from pipeline.folds import PolicyTask
    from pipeline.statistics.comparisons import Comparison
    from pipeline.windows import Windows


@dataclass(frozen=True)
class Dataset:
    """Demonstrations, what their columns mean, and the settings of their benchmark."""

    demos: Demonstrations
    semantics: Semantics
    experiment: Experiment


def read(source: str | Path, *, config: Path | None = None, **settings: Any) -> Dataset:
    """Read a data set: a name from `demobench.toml`, a folder, or `hub:owner/name@revision`.

    Parameters
    ----------
    config : the configuration; else DEMOBENCH_CONFIG, else `demobench.toml` in the current folder, else the defaults.
    settings : what the configuration may say of a data set or a benchmark, by the same names: `kind`, `circular`,
        `observations`, `seeds`, `steps`, `budget`, `folds`, `protocol`, `history`, …

    Raises
    ------
    DatasetError, HubError : it cannot be read.
    ConfigError : a setting is unknown or out of range.
    """
    from pipeline.lerobot_format.read import load_experiment

    path = find_config(config)
    config_dir = path.parent if path else Path.cwd()
    target = resolve_target(str(source), load_config(path), config_dir, Choices(), {})
    experiment = _changed(target.experiment, settings)
    return Dataset(*load_experiment(experiment, config_dir), experiment)


def _changed(experiment: Experiment, settings: Mapping[str, Any]) -> Experiment:
    """The experiment with settings of its data set or its benchmark replaced, and checked."""
    from pydantic import ValidationError

    values = experiment.model_dump()
    own = set(Experiment.model_fields) - {"name", "dataset", "policies"}
    for name, value in settings.items():
        if name in own:
            values[name] = value
        elif name in DatasetConfig.model_fields and name != "source":
            values["dataset"][name] = value
        else:
            known = own | set(DatasetConfig.model_fields) - {"source"}
            raise ConfigError(f"read() knows no setting '{name}'. {did_you_mean(name, known)}")
    if "budget" in settings and "steps" not in settings:
        values["steps"] = BUDGETS.get(settings["budget"], values["steps"])
    elif "steps" in settings:
        values["budget"] = None
    try:
        return Experiment.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        raise ConfigError(f"{'.'.join(map(str, first['loc']))}: {first['msg']} (got {first['input']!r}).") from None


def split(data: Dataset) -> Split:
    """The folds that a benchmark uses: which episodes (positions) train, which are held out."""
    from pipeline.folds import split_of

    return split_of(data.experiment, data.demos)


def windows(
    data: Dataset,
    episodes: Collection[int],
    *,
    observations: str | None = None,
    chunk: int = 1,
    train: Collection[int] | None = None,
) -> "Windows":
    """The windows of some episodes: `.observations().values` [M, T, O], `.targets()` → actions [M, K, A] and mask [M, K].

    Parameters
    ----------
    episodes : positions, as in a fold of `split`.
    observations : an observation set of the data set; its first one if left out.
    train : the episodes that statistics for scaling come from; `episodes` themselves if left out.
    """
    from pipeline.windows import make_windows

    seen = _observation_set(data, observations)
    return make_windows(
        data.demos, data.semantics, seen, episodes, statistics_episodes=episodes if train is None else train,
        protocol=data.experiment.protocol, history=data.experiment.history, chunk=chunk, own_history=seen.history,
    )  # fmt: skip


def floor(
    data: Dataset, *, observations: str | None = None, horizons: Sequence[int] | None = None
) -> list[FloorEstimate]:
    """How small the error of a deterministic policy can get, for what it sees: values with intervals, or refusals.

    `horizons` are steps ahead; the first action and one second ahead if left out.
    """
    from pipeline.statistics.floors import measure_floors

    asked = data.experiment.floor_horizons(data.demos.fps) if horizons is None else horizons
    return measure_floors(
        data.demos, data.semantics, _observation_set(data, observations), split(data),
        history=data.experiment.history, horizons=asked,
    )  # fmt: skip


def predict(
    data: Dataset,
    method: str,
    *,
    chunk: int | None = None,
    observations: str | None = None,
    name: str | None = None,
    settings: Mapping[str, Any] | None = None,
    on_step: Callable[[int, int, float], None] | None = None,
    **given: Any,
) -> Predictions:
    """Train a method on every fold, and predict what each fold held out.

    Parameters
    ----------
    method : as in the configuration: `mlp`, `hold_still`, …, or a class of your own, `my_policy.py:MyPolicy`.
    chunk : K, for methods that take one.
    name : what the policy is called; its method's name if left out. A chunk size is added to it: `mlp_k16`.
    settings : what the method is made with, as under `[policies.<name>]`.
    on_step : called with (step, steps, loss) now and then, for each fold anew.
    given : further keys of `[policies.<name>]`: history, actions, features, augment, steps, cpu_seconds.
    """
    from pipeline.folds import predict_fold, train_fold
    from pipeline.predict import join_folds

    task = _task(data, method, chunk, observations, name, {"settings": dict(settings or {}), **given})
    parts = []
    for number, fold in enumerate(task.split.folds):
        trained = train_fold(task, fold, on_step=on_step)
        if task.steps is None:
            task = task.with_steps(trained.steps)  # CPU-seconds: what they came to holds for every fold
        parts.append(predict_fold(task, trained.policy, number, task.windows(fold.test, fold)))
    return join_folds(parts)


@dataclass(frozen=True)
class Scored:
    """Predictions with their errors on held-out episodes.

    address   policy/observations        metrics  as in a row of the table
    errors    by episode                 trained  whether the policy has seeds
    seen      whether it was trained on the episodes it is scored on; None: nothing is known
    warnings  what looks wrong with predictions made elsewhere
    """

    address: str
    metrics: dict[str, Any]
    errors: EpisodeErrors
    trained: bool
    seen: bool | None = False
    warnings: tuple[str, ...] = ()


def score(
    data: Dataset, predictions: Predictions | str | Path, *, name: str | None = None, trained_on: Path | None = None
) -> Scored:
    """Score predictions: those of `predict`, or a parquet file that was made anywhere (docs/scoring.md).

    `name` and `trained_on` (a split, a list of episodes, LeRobot's train_config.json) belong to a file.

    Raises
    ------
    DatasetError : the file cannot be read, or is not aligned with what was recorded.
    """
    from pipeline.statistics.metrics import score_task

    if isinstance(predictions, Predictions):
        task = _task_of(data, predictions)
        found = score_task(task, predictions)
        address = f"{predictions.policy}/{predictions.observations}"
        return Scored(address, found.metrics, found.errors, task.variant.is_trained)
    return _score_file(data, Path(predictions), name, trained_on)


def _score_file(data: Dataset, path: Path, name: str | None, trained_on: Path | None) -> Scored:
    from pipeline.external.scoring import score_file
    from pipeline.external.training import read_training

    found = score_file(
        path, name=name or path.stem, observations=None,
        training=read_training(Path(trained_on) if trained_on else None, data.demos), demos=data.demos,
        semantics=data.semantics, split=split(data), experiment=data.experiment,
    )  # fmt: skip
    address = f"{found.predictions.policy}/{found.predictions.observations}"
    return Scored(address, found.score.metrics, found.score.errors, True, found.held_out.seen, found.warnings)


def compare(data: Dataset, *rows: Scored | Predictions, horizon: int = 0) -> "list[Comparison]":
    """All pairs of some rows, paired by the episodes that both hold out: better, worse, cannot tell, not comparable.

    p is corrected (Holm 1979) for all pairs of this call. `horizon` counts steps ahead: 0 is the first action.
    """
    from pipeline.external.pairing import Rival, compare_common
    from pipeline.statistics.comparisons import judge

    scored = [row if isinstance(row, Scored) else score(data, row) for row in rows]
    rivals = [Rival(one.address, one.errors, one.trained, one.seen) for one in scored]
    metric = "first_step_mae" if horizon == 0 else f"mae_at_step_{horizon}"
    pairs = combinations(rivals, 2)
    return judge(
        [(a.address, b.address, metric, compare_common(a, b, horizon, data.experiment.protocol)) for a, b in pairs]
    )


def _observation_set(data: Dataset, name: str | None) -> ObservationSet:
    sets = data.experiment.observation_sets
    if name is not None:
        data.experiment.require_sets([name])
    return next(s for s in sets if name in (None, s.name))


def _task(
    data: Dataset,
    method: str,
    chunk: int | None,
    observations: str | None,
    name: str | None = None,
    given: Mapping[str, Any] | None = None,
) -> "PolicyTask":
    """A policy of the configuration's methods, whether or not the file has it."""
    from pipeline.folds import PolicyTask

    if method not in METHODS:
        raise ConfigError(f"No method '{method}'. {did_you_mean(method, METHODS)}")
    family = name or method.rpartition(":")[2]
    chunks = (chunk or 1,) if METHODS[method].chunk == "set" else ()
    said = {"method": method, "chunks": chunks, **(given or {})}
    policy = parse_config({"policies": {family: said}}, "predict()").policies[family]
    (variant,) = variants({family: policy})
    experiment = data.experiment.model_copy(update={"policies": {**data.experiment.policies, family: policy}})
    return PolicyTask(
        data.demos, data.semantics, split(data), _observation_set(data, observations), variant, experiment
    )  # fmt: skip


def _task_of(data: Dataset, predictions: Predictions) -> "PolicyTask":
    """The task that predictions answer, by the policy's name."""
    known: dict[str, Variant] = {v.name: v for v in data.experiment.variants}
    name, chunk = predictions.policy, predictions.actions.shape[2]
    variant = known.get(name) or Variant(name, name, EXTERNAL, chunk)
    task = _task(data, "hold_still", None, predictions.observations)
    return replace(task, variant=variant)

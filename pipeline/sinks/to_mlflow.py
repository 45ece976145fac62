"""Metrics and models to MLflow: one experiment a data set, one run a policy × observation set, seeds as nested runs.

What belongs here: names of parameters, metrics and tags, and sending them in batches (one call a metric is forty times
slower). What does not: computing any of them. A model is a safetensors file behind a pyfunc; nothing is pickled.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pipeline.errors import StoreError
from pipeline.folds import PolicyTask

BATCH = 1000
"""Metrics in one request; MLflow's own limit."""


def tracking_uri(setting: str, store_root: Path) -> str:
    """`"sqlite"` is a file in the store; anything else is a server's address."""
    return f"sqlite:///{store_root / 'mlflow.db'}" if setting == "sqlite" else setting


@contextmanager
def _client(uri: str) -> Iterator[Any]:
    """An MLflow client; what goes wrong becomes one message."""
    # Telemetry and its own progress prints have no place in somebody else's terminal.
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "2")
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "15")
    import logging

    # MLflow reports about itself on the terminal; what matters here comes as an exception.
    for noisy in ("alembic", "mlflow.store.db.utils", "mlflow.tracking.fluent"):
        logging.getLogger(noisy).setLevel(logging.ERROR)
    import mlflow
    from mlflow.exceptions import MlflowException

    mlflow.set_tracking_uri(uri)
    try:
        yield mlflow.MlflowClient(uri)
    except MlflowException as error:
        raise StoreError(
            f"MLflow at {_without_secret(uri)} said: {str(error).splitlines()[0]} Results so far are kept. Check "
            '[tracking] mlflow in demobench.toml; "sqlite" needs no server.'
        ) from error


def _without_secret(uri: str) -> str:
    """The address without a user and password that somebody may have put into it."""
    scheme, _, rest = uri.partition("://")
    return f"{scheme}://{rest.rpartition('@')[2]}"


def _experiment_id(client: Any, uri: str, name: str) -> str:
    found = client.get_experiment_by_name(name)
    if found is not None:
        return found.experiment_id
    if not uri.startswith("sqlite:///"):
        return client.create_experiment(name)
    artifacts = Path(uri.removeprefix("sqlite:///")).parent / "mlartifacts"
    return client.create_experiment(name, artifact_location=artifacts.as_uri())


def log_training(
    uri: str, *, experiment: str, task: PolicyTask, trained: Sequence, weights: Path, tags: Mapping[str, str]
) -> str:
    """Open the run of one policy: parameters, losses of every seed and fold, and the model of the first fold.

    Returns the run's id, under which scores and roll-outs are added later.
    """
    with _client(uri) as client:
        run_id = _open_run(client, uri, experiment, task, tags)
        experiment_id = client.get_run(run_id).info.experiment_id
        name = f"{task.variant.name}/{task.observation_set.name}"
        costs = {
            "train_s": sum(t.train_s for t in trained),
            "parameters": trained[0].parameters,
            "steps": trained[0].steps,
        }
        _send(client, run_id, _series(costs))
        if task.variant.is_trained:
            for seed_number, seed in enumerate(task.seeds):
                losses = {
                    f"loss_fold_{fold}": list(zip(t.steps_logged, t.losses[seed_number], strict=True))
                    for fold, t in enumerate(trained)
                }
                child = _child(client, experiment_id, run_id, f"{name}/seed_{seed}", seed)
                _send(client, child, losses)
                client.set_terminated(child)
            _log_model(client, run_id, weights, task)
        client.set_terminated(run_id)
    return run_id


def log_elsewhere(
    uri: str,
    *,
    experiment: str,
    task: PolicyTask,
    seeds: Sequence[int],
    metrics: Mapping[str, Any],
    seed_metrics: Sequence[Mapping[str, Any]],
    samples: Mapping[str, Sequence[float]] | None,
    tags: Mapping[str, str],
    artifacts: Sequence[Path] = (),
) -> str:
    """A run of its own for predictions that were made elsewhere, tagged `demobench.external`: the metrics of every other run
    under the same names, seeds as nested runs; scores of samples, where there are some, as `samples_energy`, … by horizon.

    Returns the run's id.
    """
    with _client(uri) as client:
        changes = {"seeds": len(seeds), "steps": "unknown"}
        if task.observation_set not in task.experiment.observation_sets:
            changes["features"] = "unknown"
        run_id = _open_run(client, uri, experiment, task, {"external": "true", **tags}, changes)
        experiment_id = client.get_run(run_id).info.experiment_id
        name = f"{task.variant.name}/{task.observation_set.name}"
        for seed, values in zip(seeds, seed_metrics, strict=True) if len(seeds) > 1 else ():
            child = _child(client, experiment_id, run_id, f"{name}/seed_{seed}", seed)
            _send(client, child, _series(values))
            client.set_terminated(child)
        _send(client, run_id, _series(metrics))
        if samples:
            _send(client, run_id, _series({f"samples_{name}": values for name, values in samples.items()}))
        for path in artifacts:
            client.log_artifact(run_id, str(path))
        client.set_terminated(run_id)
    return run_id


def _open_run(
    client: Any,
    uri: str,
    experiment: str,
    task: PolicyTask,
    tags: Mapping[str, str],
    changes: Mapping[str, Any] | None = None,
) -> str:
    """A new run with the parameters and tags that people compare and search by; `changes` to the parameters of the task."""
    from mlflow.entities import Param, RunTag

    variant = task.variant
    name = f"{variant.name}/{task.observation_set.name}"
    run_id = client.create_run(_experiment_id(client, uri, experiment), run_name=name).info.run_id
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
    about = {
        "content_hash": task.demos.content_hash,
        "split_hash": task.split.hash,
        "revision": task.demos.revision or "",
        "data_set": task.demos.name,
        "excluded": ", ".join(map(str, task.demos.excluded))[:5000],
        **tags,
    }
    client.log_batch(
        run_id,
        params=[Param(k, str(v)) for k, v in params.items()],
        tags=[RunTag(f"demobench.{k}", v) for k, v in about.items()],
    )
    return run_id


def find_run(uri: str, run_id: str, *, experiment: str, task: PolicyTask, tags: Mapping[str, str]) -> str:
    """The run that `log_training` opened; another one where it is gone (a store that was deleted, another server)."""
    from mlflow.exceptions import MlflowException

    with _client(uri) as client:
        try:
            return client.get_run(run_id).info.run_id
        except MlflowException as error:
            if error.error_code != "RESOURCE_DOES_NOT_EXIST":
                raise
        experiment_id = _experiment_id(client, uri, experiment)
        same = " and ".join(f"tags.`demobench.{name}` = '{value}'" for name, value in tags.items())
        found = client.search_runs([experiment_id], same, max_results=1)
        return found[0].info.run_id if found else _open_run(client, uri, experiment, task, tags)


def _child(client: Any, experiment_id: str, parent: str, name: str, seed: int) -> str:
    tags = {"mlflow.parentRunId": parent, "demobench.seed": str(seed)}
    return client.create_run(experiment_id, run_name=name, tags=tags).info.run_id


def log_scores(
    uri: str,
    run_id: str,
    metrics: Mapping[str, Any],
    seed_metrics: Sequence[Mapping[str, Any]],
    artifacts: Sequence[Path] = (),
) -> None:
    """Add what was scored: single numbers as metrics, per-horizon errors with the horizon as step, pictures as artefacts."""
    with _client(uri) as client:
        _send(client, run_id, _series(metrics))
        if len(seed_metrics) > 1:
            children = _children(client, run_id)
            for seed, values in enumerate(seed_metrics):
                if str(seed) in children:
                    _send(client, children[str(seed)], _series(values))
        for path in artifacts:
            client.log_artifact(run_id, str(path))


def log_rollouts(uri: str, run_id: str, summary: Mapping[str, Any]) -> None:
    """Add closed-loop results: `rollout_success`, `rollout_score` and their limits; each seed's own to its nested run."""
    with _client(uri) as client:
        _send(client, run_id, _series({f"rollout_{name}": value for name, value in summary.items()}))
        if summary["seeds"] > 1:
            children = _children(client, run_id)
            for one in summary["per_seed"]:
                own = {"rollout_success": one["successes"] / summary["n"], "rollout_score": one["score"]}
                if str(one["seed"]) in children:
                    _send(client, children[str(one["seed"])], _series(own))


def log_file(uri: str, run_id: str, path: Path) -> None:
    """Add a file to a run."""
    with _client(uri) as client:
        client.log_artifact(run_id, str(path))


def log_curve(uri: str, run_id: str, sizes: Sequence[Mapping[str, Any]]) -> None:
    """Add a learning curve: `curve_first_step_mae` and `curve_at_one_second_mae`, the step is the number of training episodes."""
    later = [size["at_one_second"] for size in sizes if size["at_one_second"]]
    series = {
        "curve_first_step_mae": [(size["episodes"], size["error"]) for size in sizes],
        "curve_at_one_second_mae": [(size["episodes"], size["error"]) for size in later],
    }
    with _client(uri) as client:
        _send(client, run_id, series)


def _children(client: Any, run_id: str) -> dict[str, str]:
    """Seed → id of the nested run."""
    experiment_id = client.get_run(run_id).info.experiment_id
    runs = client.search_runs([experiment_id], f"tags.`mlflow.parentRunId` = '{run_id}'")
    return {run.data.tags["demobench.seed"]: run.info.run_id for run in runs}


def _series(metrics: Mapping[str, Any]) -> dict[str, list[tuple[int, float]]]:
    """Numbers and lists of numbers as (step, value) pairs; what is missing is left out. A list's step is its horizon."""
    found = {}
    for name, value in metrics.items():
        values = value if isinstance(value, list) else [value]
        pairs = [(i, v) for i, v in enumerate(values) if isinstance(v, (int, float)) and not isinstance(v, bool)]
        if pairs:
            found[name] = pairs
        if isinstance(value, Mapping):
            for part, number in value.items():
                if isinstance(number, (int, float)):
                    found[f"{name}.{_metric_name(str(part))}"] = [(0, number)]
    return found


def _metric_name(text: str) -> str:
    """MLflow allows letters, digits, `_ - . space : /`."""
    return "".join(c if c.isalnum() or c in "_-. :/" else "_" for c in text)


def _send(client: Any, run_id: str, series: Mapping[str, Sequence[tuple[int, float]]]) -> None:
    import time

    from mlflow.entities import Metric

    now = int(time.time() * 1000)
    metrics = [Metric(name, float(v), now, int(step)) for name, pairs in series.items() for step, v in pairs]
    for start in range(0, len(metrics), BATCH):
        client.log_batch(run_id, metrics=metrics[start : start + BATCH])


def _log_model(client: Any, run_id: str, weights: Path, task: PolicyTask) -> None:
    """The policy as an MLflow pyfunc: code from this package, weights as a safetensors artefact."""
    import mlflow

    from pipeline.sinks import mlflow_model

    with mlflow.start_run(run_id=run_id, log_system_metrics=False):
        mlflow.pyfunc.log_model(
            name="model",
            python_model=mlflow_model.__file__,
            artifacts={"policy": str(weights)},
            pip_requirements=["demobench"],
            metadata={"policy": task.variant.name, "observations": task.observation_set.name},
        )

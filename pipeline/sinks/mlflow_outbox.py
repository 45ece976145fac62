"""Messages on their way to MLflow: kept until they are there, one JSON file each, sent in order and exactly once.

A message is written before it is sent, so that a server that is down, hangs, or goes away in the middle loses nothing and
stops no run. What has arrived is tagged on its run: sent again, it is known.
What belongs here: keeping, sending in batches (one call a metric is forty times slower), waiting. What does not: what is in a
message (`to_mlflow`). A model is a safetensors file behind a pyfunc; nothing is pickled.
"""

import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.errors import StoreError, printable
from pipeline.sinks.to_mlflow import VIEW, Message, RunCard, Series, experiment_tags, tracking_uri, without_secret
from pipeline.store import Store, drafted

BATCH = 1000
"""Metrics in one request; MLflow's own limit."""
PROBE_S, REQUEST_S, PAUSE_S = 5, 10, 60
"""How long MLflow may take to answer at all, to answer a request, and how long a run leaves it alone when it did not."""
UNSENT = "mlflow_unsent"
DIGEST = 36
"""The longest digest of a data set that MLflow keeps."""


@dataclass(frozen=True)
class Delivery:
    """What came of sending: messages sent, messages still kept, and why."""

    sent: int
    kept: int
    why: str = ""


class Outbox:
    """The messages of one store for the MLflow that `[tracking] mlflow` names."""

    def __init__(self, store: Store, setting: str):
        self._store = store
        self._uri = tracking_uri(setting, store.root)
        self.folder = store.root / UNSENT
        self._silent = self.folder / "unreachable"

    @property
    def address(self) -> str:
        """Where MLflow is, without a user and password that somebody may have put into it."""
        return without_secret(self._uri)

    def experiment_id(self, name: str) -> str | None:
        """The id of MLflow's experiment of that name; None where it has none, or does not answer."""
        if self._is_silent():
            return None
        with suppress(*_mlflow_errors()), _client(self._uri) as client:
            found = client.get_experiment_by_name(name)
            return found and found.experiment_id
        return None

    def waiting(self) -> list[Path]:
        """The messages that were not sent, in the order in which they were made."""
        return sorted(self.folder.glob("[0-9]*.json"))

    def post(self, message: Message, folder: Path, about: str, made: str) -> None:
        """Keep a message about the result in `folder`: `about` is its name, `made` its fingerprint."""
        self.folder.mkdir(parents=True, exist_ok=True)
        kept = {"about": about, "made": made, "folder": str(folder.relative_to(self._store.root)), **message.as_json()}
        with drafted(self.folder / f"{time.time_ns():020d}-{os.getpid()}.json") as draft:
            # Losses may be infinite, which JSON has no word for; Python reads back what it writes.
            draft.write_text(json.dumps(kept), encoding="utf-8")

    def deliver(self, *, patient: bool = True) -> Delivery:
        """Send what is kept. Where MLflow did not answer a moment ago it is asked again only by who is `patient`.

        Whatever MLflow says, nothing is raised: results do not depend on it.
        """
        if not self.waiting() or (not patient and self._is_silent()):
            return Delivery(0, len(self.waiting()), self._why())
        from filelock import FileLock, Timeout

        try:
            with FileLock(self.folder / ".lock", timeout=REQUEST_S):
                return self._deliver()
        except Timeout:
            return Delivery(0, len(self.waiting()), "another process is sending them")

    def _is_silent(self) -> bool:
        with suppress(OSError):
            return time.time() - self._silent.stat().st_mtime < PAUSE_S
        return False

    def _why(self) -> str:
        with suppress(OSError):
            return self._silent.read_text(encoding="utf-8")
        return ""

    def _deliver(self) -> Delivery:
        sent, troubles, refused = 0, [], set()
        try:
            with _client(self._uri) as client:
                for path in self.waiting():
                    kept = json.loads(path.read_text(encoding="utf-8"))
                    run = kept["run"]["fingerprint"]
                    if run in refused:
                        continue
                    try:
                        self._send(client, kept)
                    except _mlflow_errors() as error:
                        # What one run is refused must not hold back the others; a server that refuses two is ill.
                        refused.add(run)
                        troubles.append(_words(error).replace(self._uri, self.address))
                        if len(troubles) > 1 or not _answers(client):
                            break
                    else:
                        path.unlink()
                        sent += 1
        except _mlflow_errors() as error:
            troubles.append(_words(error).replace(self._uri, self.address))
        with suppress(OSError):
            if troubles:
                self._silent.write_text(troubles[0], encoding="utf-8")
            else:
                self._silent.unlink(missing_ok=True)
        return Delivery(sent, len(self.waiting()), troubles[0] if troubles else "")

    def _send(self, client: Any, kept: Mapping[str, Any]) -> None:
        """One message: to its run, which is opened where there is none."""
        about, made = kept["about"], kept["made"]
        folder = self._store.root / kept["folder"]
        message = Message.of({k: v for k, v in kept.items() if k not in ("about", "made", "folder")})
        run = _find_run(client, self._uri, message.run) or _open_run(client, self._uri, message)
        run_id, tag = run.info.run_id, f"demobench.sent.{about}"
        if not run.data.params:
            _describe_run(client, run_id, message.run)
        if message.alias:
            _promote(client, run_id, message.run.experiment, message.alias)
        elif run.data.tags.get(tag) != made:
            _log_series(client, run_id, message.series, message.time_ms)
            _log_seeds(client, run, message)
            # A result that has been replaced since has other pictures and weights than these numbers.
            if self._store.is_fresh(folder, made):
                for file in (folder / name for name in message.files):
                    if file.exists():
                        client.log_artifact(run_id, str(file))
                if message.model:
                    _log_model(client, run_id, folder / message.model, message.run)
                client.set_tag(run_id, tag, made)
            if run.info.status != "FINISHED":
                client.set_terminated(run_id, end_time=message.time_ms)
        if not message.alias:
            self._store.amend(folder, made, mlflow_run_id=run_id)


def _mlflow_errors() -> tuple[type[Exception], ...]:
    from mlflow.exceptions import MlflowException
    from requests import RequestException
    from sqlalchemy.exc import SQLAlchemyError

    return (MlflowException, RequestException, SQLAlchemyError, OSError, StoreError)


def _words(error: Exception) -> str:
    """What MLflow said, on one line; of a connection that failed only the first cause."""
    from requests import RequestException

    root: BaseException | None = error
    while root is not None and (not isinstance(root, OSError) or isinstance(root, RequestException)):
        # A connection's own error may be no cause but one of what was raised about it.
        inside = (about for about in root.args if isinstance(about, BaseException))
        root = root.__cause__ or root.__context__ or next(inside, None)
    words = str(error) if root is None else root.strerror or str(root)
    return printable(words.splitlines()[0] if words else type(error).__name__)[:300].rstrip(". ")


@contextmanager
def _client(uri: str) -> Iterator[Any]:
    """An MLflow client that answers.

    Raises:
        one of `_mlflow_errors`: it does not answer, or not soon enough.
    """
    # Telemetry and its own progress prints have no place in somebody else's terminal.
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")
    os.environ.setdefault("MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT", "true")
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", str(REQUEST_S))
    import logging

    # MLflow reports about itself on the terminal; what matters here comes as an exception.
    for noisy in ("alembic", "mlflow.store.db.utils", "mlflow.tracking.fluent", "urllib3.connectionpool"):
        logging.getLogger(noisy).setLevel(logging.ERROR)
    import mlflow

    before = mlflow.get_tracking_uri()
    mlflow.set_tracking_uri(uri)
    try:
        client = mlflow.MlflowClient(uri)
        _ask(client)
        yield client
    finally:
        mlflow.set_tracking_uri(before)


def _ask(client: Any) -> None:
    """A question that needs an answer from the database behind the server, too, without any patience."""
    short = {"MLFLOW_HTTP_REQUEST_MAX_RETRIES": "0", "MLFLOW_HTTP_REQUEST_TIMEOUT": str(PROBE_S)}
    before = {name: os.environ.get(name) for name in short}
    os.environ.update(short)
    try:
        client.search_experiments(max_results=1)
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _answers(client: Any) -> bool:
    try:
        _ask(client)
    except _mlflow_errors():
        return False
    return True


def _experiment_id(client: Any, uri: str, name: str) -> str:
    """The experiment of that name, opened where there is none, with the view that links lead to."""
    wanted = experiment_tags()
    found = client.get_experiment_by_name(name)
    if found is not None:
        # A note may be the user's by now; the view is ours.
        for key, value in wanted.items():
            if key not in found.tags or (key.endswith(VIEW) and found.tags[key] != value):
                client.set_experiment_tag(found.experiment_id, key, value)
        return found.experiment_id
    if not uri.startswith("sqlite:///"):
        return client.create_experiment(name, tags=wanted)
    artifacts = Path(uri.removeprefix("sqlite:///")).parent / "mlartifacts"
    return client.create_experiment(name, artifact_location=artifacts.as_uri(), tags=wanted)


def _find_run(client: Any, uri: str, card: RunCard) -> Any:
    """The run of that fingerprint, or None."""
    same = f"tags.`demobench.fingerprint` = '{card.fingerprint}'"
    found = client.search_runs([_experiment_id(client, uri, card.experiment)], same, max_results=1)
    return found[0] if found else None


def _open_run(client: Any, uri: str, message: Message) -> Any:
    """A new run with the tags that people search by."""
    card = message.run
    tags = {"fingerprint": card.fingerprint, **card.tags}
    return client.create_run(
        _experiment_id(client, uri, card.experiment),
        start_time=message.time_ms,
        run_name=card.name,
        # With the run itself: a run without its fingerprint would never be found again.
        tags={f"demobench.{name}": value for name, value in tags.items()},
    )


def _describe_run(client: Any, run_id: str, card: RunCard) -> None:
    """The data set and the parameters that people compare by; the parameters last, as they say that a run is described."""
    from mlflow.entities import Param

    client.log_inputs(run_id, [_dataset_input(card.dataset)])
    client.log_batch(run_id, params=[Param(name, value) for name, value in card.params.items()])


def _dataset_input(said: Mapping[str, Any]) -> Any:
    """The demonstrations as MLflow's lineage shows them: name, digest, where they are from."""
    from mlflow.entities import Dataset, DatasetInput, InputTag

    kind, source = _source(said["source"], said["revision"])
    digest = said["facts"]["content_hash"][:DIGEST]
    about = Dataset(said["name"], digest, kind, json.dumps(source), profile=json.dumps(said["facts"]))
    return DatasetInput(about, [InputTag("mlflow.data.context", "training")])


def _source(source: str, revision: str | None) -> tuple[str, dict[str, Any]]:
    """Where demonstrations are from, as `mlflow.data` names it: the Hub, or files."""
    from pipeline.embedded import embedded_folder
    from pipeline.lerobot_format.read import EMBEDDED, HUB

    if source.startswith(HUB):
        return "hugging_face", {"path": source.removeprefix(HUB).partition("@")[0], "revision": revision}
    here = embedded_folder(source.removeprefix(EMBEDDED)) if source.startswith(EMBEDDED) else Path(source)
    return "local", {"uri": str(here.absolute())}


def _log_series(client: Any, run_id: str, series: Series, time_ms: int) -> None:
    from mlflow.entities import Metric

    metrics = [Metric(name, float(v), time_ms, int(step)) for name, pairs in series.items() for step, v in pairs]
    for start in range(0, len(metrics), BATCH):
        client.log_batch(run_id, metrics=metrics[start : start + BATCH])


def _log_seeds(client: Any, run: Any, message: Message) -> None:
    """The metrics of single seeds, each to its nested run."""
    if not message.seeds:
        return
    experiment_id, parent = run.info.experiment_id, run.info.run_id
    nested = client.search_runs([experiment_id], f"tags.`mlflow.parentRunId` = '{parent}'")
    children = {one.data.tags["demobench.seed"]: one for one in nested}
    for seed, series in message.seeds.items():
        tags = {"mlflow.parentRunId": parent, "demobench.seed": seed}
        name = f"{message.run.name}/seed_{seed}"
        child = children.get(seed) or client.create_run(experiment_id, message.time_ms, run_name=name, tags=tags)
        _log_series(client, child.info.run_id, series, message.time_ms)
        if child.info.status != "FINISHED":
            client.set_terminated(child.info.run_id, end_time=message.time_ms)


def _models(client: Any, run_id: str) -> Sequence[Any]:
    """The models of a run that are whole."""
    outputs = client.get_run(run_id).outputs
    logged = [client.get_logged_model(one.model_id) for one in outputs.model_outputs] if outputs else []
    return [model for model in logged if model.status == "READY"]


def _log_model(client: Any, run_id: str, weights: Path, card: RunCard) -> None:
    """The policy as an MLflow pyfunc: code from this package, weights as a safetensors artefact."""
    import mlflow

    from pipeline.sinks import mlflow_model

    if _models(client, run_id):
        return
    with mlflow.start_run(run_id=run_id, log_system_metrics=False):
        mlflow.pyfunc.log_model(
            name="model",
            python_model=mlflow_model.__file__,
            artifacts={"policy": str(weights)},
            pip_requirements=["demobench"],
            metadata={"policy": card.params["policy"], "observations": card.params["observations"]},
        )


def _promote(client: Any, run_id: str, name: str, alias: str) -> None:
    """Move an alias of the model registry to a run's model; a baseline has none, and leaves the alias where it is."""
    models = _models(client, run_id)
    if not models:
        return
    if not client.search_registered_models(f"name = '{name}'"):
        client.create_registered_model(name)
    versions = client.search_model_versions(f"name = '{name}'")
    same = next((one for one in versions if one.run_id == run_id), None)
    if same is None:
        model_id = models[0].model_id
        same = client.create_model_version(name, f"models:/{model_id}", run_id, model_id=model_id)
    client.set_registered_model_alias(name, alias, same.version)

"""Messages for MLflow: kept while it cannot be told, sent in order and once; against real MLflow, on a file and on servers."""

import json
import os
import shutil
import socket
import subprocess
import tempfile
import time
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import mlflow
import pytest

from pipeline.sinks.mlflow_outbox import PROBE_S, Outbox
from pipeline.sinks.to_mlflow import Message, RunCard, about_scores, series_of
from pipeline.store import Made, Store
from tests.mlflow_server import MlflowServer, free_port

CARD = RunCard(
    experiment="tape",
    name="mlp_k04/state",
    fingerprint="f" * 64,
    params={"policy": "mlp_k04", "chunk": "4"},
    tags={"content_hash": "c" * 64},
    dataset={"name": "tape", "source": "hub:me/tape@v1", "revision": "0123", "facts": {"content_hash": "c" * 64}},
)
SCORES = about_scores(
    CARD, (0, 1), {"first_step_mae": 2.0, "error_by_horizon": [2.0, 3.0]}, [{"first_step_mae": 1.0}] * 2, ["errors.png"]
)


@pytest.fixture
def store(tmp_path) -> Store:
    return Store(tmp_path / "results").ensure()


def put(store: Store, outbox: Outbox, message: Message, name: str = "predictions", made: str = "1") -> Path:
    """A result in the store, and what MLflow is to hear of it."""
    folder = store.folder("tape", f"mlp_k04/{name}", "state")
    folder.mkdir(parents=True, exist_ok=True)
    for file in message.files:
        (folder / file).write_bytes(b"a picture")
    store.write_made(folder, Made(made))
    outbox.post(message, folder, f"mlp_k04/{name}/state", made)
    return folder


def histories(uri: str) -> dict[str, list[tuple[int, float]]]:
    """Every point of every metric of the one run."""
    client = mlflow.MlflowClient(uri)
    (run,) = runs(uri)
    return {
        name: sorted((m.step, m.value) for m in client.get_metric_history(run.info.run_id, name))
        for name in run.data.metrics
    }


def runs(uri: str) -> list:
    client = mlflow.MlflowClient(uri)
    found = client.search_runs([client.get_experiment_by_name("tape").experiment_id])
    return [run for run in found if "mlflow.parentRunId" not in run.data.tags]


def test_a_message_survives_its_file():
    message = replace(SCORES, model="fold_0", alias="champion")
    assert Message.of(json.loads(json.dumps(message.as_json()))).as_json() == json.loads(json.dumps(message.as_json()))


def test_series_have_the_horizon_as_step_and_leave_out_what_is_missing():
    found = series_of({"mae": 1, "by_horizon": [3.0, None, 4.0], "none": None, "sure": True, "joints": {"a\nb": 2.0}})
    assert found == {"mae": [(0, 1.0)], "by_horizon": [(0, 3.0), (2, 4.0)], "joints.a_b": [(0, 2.0)]}


def test_what_is_sent_twice_is_there_once(store):
    outbox = Outbox(store, "sqlite")
    uri = f"sqlite:///{store.root / 'mlflow.db'}"
    folder = put(store, outbox, SCORES)
    (kept,) = outbox.waiting()
    shutil.copy(kept, store.root / "copy.json")
    assert (outbox.deliver().sent, outbox.deliver().sent) == (1, 0)
    once = histories(uri)
    assert once["error_by_horizon"] == [(0, 2.0), (1, 3.0)]
    (run,) = runs(uri)
    assert (run.data.params["chunk"], run.info.status) == ("4", "FINISHED")
    assert run.inputs.dataset_inputs[0].dataset.digest == "c" * 36
    assert mlflow.data.get_source(run.inputs.dataset_inputs[0].dataset).path == "me/tape"
    assert store.made(folder).summary["mlflow_run_id"] == run.info.run_id
    # A process that was killed after the server answered, and before it could remove the message.
    shutil.copy(store.root / "copy.json", kept)
    assert outbox.deliver().sent == 1
    # One that was killed in the middle: the run is there with its metrics, and does not say that they are.
    client = mlflow.MlflowClient(uri)
    client.delete_tag(run.info.run_id, "demobench.sent.mlp_k04/predictions/state")
    shutil.copy(store.root / "copy.json", kept)
    assert outbox.deliver().sent == 1
    assert histories(uri) == once
    nested = client.search_runs([run.info.experiment_id], f"tags.`mlflow.parentRunId` = '{run.info.run_id}'")
    assert sorted(one.data.tags["demobench.seed"] for one in nested) == ["0", "1"]
    assert [len(client.get_metric_history(one.info.run_id, "first_step_mae")) for one in nested] == [1, 1]
    # Of a result that was replaced before it could be sent there are numbers, and not the other result's pictures.
    later = replace(CARD, fingerprint="e" * 64)
    put(store, outbox, replace(SCORES, run=later), made="2")
    store.write_made(folder, Made("3"))
    assert outbox.deliver().kept == 0
    other = next(run for run in runs(uri) if run.data.tags["demobench.fingerprint"] == later.fingerprint)
    assert other.data.metrics["first_step_mae"] == 2.0
    assert client.list_artifacts(other.info.run_id) == []
    assert [a.path for a in client.list_artifacts(run.info.run_id)] == ["errors.png"]


def test_a_message_that_is_refused_holds_nobody_else_back(store):
    outbox = Outbox(store, "sqlite")
    bad = replace(CARD, fingerprint="b" * 64, params={"what?!": "no such name is allowed"})
    put(store, outbox, Message(bad, series_of({"mae": 1.0})), "rollouts")
    put(store, outbox, SCORES)
    delivery = outbox.deliver()
    assert (delivery.sent, delivery.kept) == (1, 1)
    assert "what?!" in delivery.why
    assert outbox.deliver().kept == 1


@pytest.mark.parametrize("kind", ["nobody", "hangs"])
def test_a_server_that_does_not_answer_costs_seconds_and_loses_nothing(store, kind):
    import mlflow.store.tracking.rest_store  # noqa: F401  (not what is timed)

    with socket.socket() as deaf:
        deaf.bind(("127.0.0.1", 0))
        if kind == "hangs":
            deaf.listen()
        outbox = Outbox(store, f"http://me:secret@127.0.0.1:{deaf.getsockname()[1]}")
        put(store, outbox, SCORES)
        start = time.monotonic()
        delivery = outbox.deliver()
        # The time limit is the probe's own; the rest is room for a busy machine.
        assert time.monotonic() - start < PROBE_S + 10
        assert (delivery.sent, delivery.kept) == (0, 1)
        assert delivery.why
        assert "secret" not in outbox.address + delivery.why
        start = time.monotonic()
        put(store, outbox, SCORES, "rollouts")
        assert outbox.deliver(patient=False).kept == 2
        assert time.monotonic() - start < 1, "a run asks once a minute, not with every result"


@pytest.mark.slow
def test_a_server_that_is_stopped_and_started_again_hears_everything_once_in_order(store, tmp_path, capfd):
    server = MlflowServer(tmp_path)
    outbox = Outbox(store, server.address)
    try:
        server.start()
        put(store, outbox, Message(CARD, series_of({"a": 1.0})), "trained_policy")
        deliver_all(outbox)
        server.stop()
        put(store, outbox, SCORES)
        put(store, outbox, Message(CARD, series_of({"b": 1.0})), "rollouts")
        put(store, outbox, replace(SCORES, run=replace(CARD, fingerprint="d" * 64)), "learning_curve")
        away = outbox.deliver()
        assert (away.sent, away.kept) == (0, 3)
        assert away.why in ("Connection refused", "Connection reset by peer")
        server.start()
        deliver_all(outbox)
        found = {run.data.tags["demobench.fingerprint"]: run for run in runs(server.address)}
        assert set(found) == {CARD.fingerprint, "d" * 64}
        assert set(found[CARD.fingerprint].data.metrics) == {"a", "b", "first_step_mae", "error_by_horizon"}
        client = mlflow.MlflowClient(server.address)
        assert len(client.get_metric_history(found[CARD.fingerprint].info.run_id, "error_by_horizon")) == 2
        assert [a.path for a in client.list_artifacts(found["d" * 64].info.run_id)] == ["errors.png"]
        assert capfd.readouterr().out == "", "standard output is not MLflow's"
    finally:
        server.stop()


def deliver_all(outbox: Outbox) -> None:
    """On a machine that is busy a server may need longer than the product waits for it."""
    for _ in range(10):
        if not outbox.deliver().kept:
            return
    raise AssertionError(outbox.deliver().why)


@pytest.fixture
def postgresql():
    """A PostgreSQL of its own, where Debian's package is installed and Python can talk to it."""
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin"))
    driver = next((name for name in ("psycopg2", "psycopg") if find_spec(name)), None)
    if not found or driver is None:
        pytest.skip("no PostgreSQL here: apt-get install postgresql" if not found else "pip install psycopg2-binary")
    with tempfile.TemporaryDirectory(prefix="demobench-postgresql-") as place:
        run = {"check": True, "stdout": subprocess.DEVNULL, "cwd": place, "timeout": 300}
        if os.getuid() == 0:
            # PostgreSQL refuses to run as root.
            shutil.chown(place, "postgres", "postgres")
            run |= {"user": "postgres", "group": "postgres", "extra_groups": []}
        data, port = Path(place) / "data", free_port()
        subprocess.run([found[-1] / "initdb", "-D", data, "-A", "trust", "-U", "mlflow", "--no-sync"], **run)
        pg_ctl = [found[-1] / "pg_ctl", "-D", data]
        options = f"-h 127.0.0.1 -p {port} -k {place} -F"
        subprocess.run([*pg_ctl, "-w", "-l", Path(place) / "log", "-o", options, "start"], **run)
        try:
            yield f"postgresql+{driver}://mlflow@127.0.0.1:{port}/postgres"
        finally:
            subprocess.run([*pg_ctl, "-m", "immediate", "stop"], **run)


@pytest.mark.slow
def test_a_server_on_postgresql_by_one_setting(postgresql, store, tmp_path):
    server = MlflowServer(tmp_path, postgresql)
    try:
        server.start()
        outbox = Outbox(store, server.address)
        put(store, outbox, SCORES)
        put(store, outbox, SCORES)
        deliver_all(outbox)
        assert histories(server.address)["error_by_horizon"] == [(0, 2.0), (1, 3.0)]
    finally:
        server.stop()

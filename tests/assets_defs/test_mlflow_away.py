"""A run whose MLflow server goes away in the middle: a real server, stopped by its process and started again."""

import io

import mlflow
import pytest
from rich.console import Console

from assets_defs.plan import Unit
from demobench.commands.session import Session, tell_mlflow
from pipeline.store import Store
from tests.assets_defs.conftest import TINY, TinyBenchmark
from tests.mlflow_server import MlflowServer

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]


def say_what_is_told(bench: TinyBenchmark) -> str:
    console = Console(file=io.StringIO(), width=300)
    tell_mlflow(Session(bench.config, bench.folder, bench.store, console))
    return console.file.getvalue()


def test_the_run_finishes_and_mlflow_hears_everything_once_when_it_is_back(tiny_folder, tmp_path):
    server = MlflowServer(tmp_path)
    bench = TinyBenchmark(
        tiny_folder, Store(tmp_path / "results").ensure(), TINY | {"tracking": {"mlflow": server.address}}
    )

    def pull_the_plug(event) -> None:
        if event.event_type_value == "STEP_SUCCESS" and event.step_key == "mlp_k01__trained_policy":
            server.stop()

    try:
        server.start()
        bench.run(pull_the_plug)
        plan = bench.plan()
        assert not plan.stale(), "the run made everything"
        kept = list((bench.store.root / "mlflow_unsent").glob("*.json"))
        assert len(kept) >= 6, "of six policies at least the predictions"
        assert "run_id" not in str(bench.store.made(plan.folder(Unit("mlp_k04/predictions", "state"))).summary)
        words = say_what_is_told(bench)
        assert f"MLflow at {server.address} cannot be told now" in words
        assert f"{len(kept)} results are kept in" in words
        assert words.count("\n") == 1

        server.start()
        for _ in range(5):  # a busy machine's server may need longer than the product waits
            words = say_what_is_told(bench)
            if "are kept" not in words:
                break
        assert "was told what was kept for it" in words
        assert not list((bench.store.root / "mlflow_unsent").glob("*.json"))
        assert say_what_is_told(bench) == ""

        client = mlflow.MlflowClient(server.address)
        experiment = client.get_experiment_by_name("tiny").experiment_id
        top = client.search_runs([experiment], "params.policy != ''")
        assert len(top) == len({r.data.tags["demobench.fingerprint"] for r in top}) == 6
        assert all(r.data.metrics["first_step_mae"] > 0 and r.info.status == "FINISHED" for r in top)
        for policy in ("mlp_k01", "mlp_k04"):
            (run,) = (r for r in top if r.data.params["policy"] == policy)
            assert len(client.get_metric_history(run.info.run_id, "error_by_horizon")) == int(run.data.params["chunk"])
            assert "error_by_horizon.png" in {a.path for a in client.list_artifacts(run.info.run_id)}
            made = bench.store.made(plan.folder(Unit(f"{policy}/trained_policy", "state")))
            assert made.summary["mlflow_run_id"] == run.info.run_id
            (model,) = run.outputs.model_outputs
            assert client.get_logged_model(model.model_id).status == "READY"
    finally:
        server.stop()

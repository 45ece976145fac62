"""What a benchmark leaves in MLflow, read back through MLflow itself."""

import csv
import json
import subprocess
import sys
from pathlib import Path

import mlflow
import numpy as np
import pytest

from assets_defs.history import crown
from assets_defs.plan import Unit
from assets_defs.resources import Bench, Workbench
from pipeline.lerobot_format.saved import load_demonstrations
from pipeline.predict import load_predictions
from pipeline.sinks.to_mlflow import tracking_uri

FRESH = """
import json, sys
import mlflow
mlflow.set_tracking_uri(sys.argv[1])
model = mlflow.pyfunc.load_model(sys.argv[2])
print(json.dumps(model.predict(json.loads(sys.argv[3]))))
"""


@pytest.fixture(scope="module")
def client(finished):
    return mlflow.MlflowClient(tracking_uri("sqlite", finished.store.root))


@pytest.fixture(scope="module")
def run_of(finished, client):
    """The MLflow run of a policy, as the store remembers it."""

    def find(policy: str):
        made = finished.store.made(finished.plan().folder(Unit(f"{policy}/trained_policy", "state")))
        return client.get_run(made.summary["mlflow_run_id"])

    return find


def test_one_experiment_one_run_a_policy_seeds_nested(client, run_of):
    experiment = client.get_experiment_by_name("tiny")
    runs = client.search_runs([experiment.experiment_id], max_results=1000)
    top = {r.info.run_name for r in runs if "mlflow.parentRunId" not in r.data.tags}
    assert top == {
        "hold_still/state", "mean_action/state", "constant_velocity/state", "nearest_neighbour/state", "mlp_k01/state",
        "mlp_k04/state", "benchmark",
    }  # fmt: skip
    parent = run_of("mlp_k04")
    children = [r for r in runs if r.data.tags.get("mlflow.parentRunId") == parent.info.run_id]
    assert {r.data.tags["demobench.seed"] for r in children} == {"0", "1"}
    assert all(r.data.metrics["first_step_mae"] > 0 for r in children)
    assert parent.data.params["chunk"] == "4"
    assert parent.info.status == "FINISHED"


def test_a_table_is_a_run_with_its_rows_and_its_report(finished, client):
    experiment = client.get_experiment_by_name("tiny")
    (run,) = client.search_runs([experiment.experiment_id], "attributes.run_name = 'benchmark'")
    kept = Path(client.download_artifacts(run.info.run_id, ""))
    assert {path.name for path in kept.iterdir()} == {"policies.csv", "table.json", "report.html", "errors.png"}
    for name, asset in (("policies.csv", "benchmark_table"), ("report.html", "benchmark_report")):
        assert (kept / name).read_bytes() == (finished.plan().folder(Unit(asset)) / name).read_bytes()
    with (kept / "policies.csv").open(newline="") as file:
        rows = {row["policy"]: row for row in csv.DictReader(file)}
    assert float(rows["hold_still"]["vs_hold_still"]) == pytest.approx(1)
    assert len(rows) == 6


def test_policies_are_compared_without_tables_and_seeds_the_best_first(client):
    experiment = client.get_experiment_by_name("tiny")
    view = json.loads(experiment.tags["mlflow.sharedViewState.demobench"])
    order = [f"{view['orderByKey']} {'ASC' if view['orderByAsc'] else 'DESC'}"]
    compared = client.search_runs([experiment.experiment_id], view["searchFilter"], order_by=order)
    errors = [run.data.metrics["first_step_mae"] for run in compared]
    assert len(errors) == 6
    assert errors == sorted(errors)
    drawn = {chart["metricKey"] for chart in view["compareRunCharts"]}
    here = {name for run in compared for name in run.data.metrics}
    assert drawn - here == {"rollout_success", "rollout_score"}, "what is drawn is measured, where there is a simulator"
    assert "One run a policy" in experiment.tags["mlflow.note.content"]


def test_losses_and_errors_have_steps(finished, client, run_of):
    parent = run_of("mlp_k04")
    by_horizon = client.get_metric_history(parent.info.run_id, "error_by_horizon")
    assert [m.step for m in sorted(by_horizon, key=lambda m: m.step)] == [0, 1, 2, 3]
    table = json.loads((finished.plan().folder(Unit("benchmark_table")) / "table.json").read_text())
    row = next(r for r in table["policies"] if r["policy"] == "mlp_k04")
    assert [m.value for m in sorted(by_horizon, key=lambda m: m.step)] == pytest.approx(row["error_by_horizon"])
    child = client.search_runs([parent.info.experiment_id], f"tags.`mlflow.parentRunId` = '{parent.info.run_id}'")[0]
    assert len(client.get_metric_history(child.info.run_id, "loss_fold_0")) > 1
    assert "error_by_horizon.png" in {a.path for a in client.list_artifacts(parent.info.run_id)}


def test_the_model_predicts_in_a_fresh_process_what_was_scored(finished, run_of):
    demos = load_demonstrations(finished.plan().folder(Unit("demonstrations")) / "frames")
    predicted = load_predictions(finished.plan().folder(Unit("mlp_k04/predictions", "state")))
    anchor = int(predicted.anchors[predicted.fold == 0][0])
    seen = demos.columns["observation.state"][anchor - 2 : anchor + 1]
    asked = json.dumps([{"values": seen.tolist()}])
    uri, model = tracking_uri("sqlite", finished.store.root), f"runs:/{run_of('mlp_k04').info.run_id}/model"
    out = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", FRESH, uri, model, asked], capture_output=True, text=True, check=False
    )
    assert out.returncode == 0, out.stderr[-2000:]
    answer = np.array(json.loads(out.stdout.splitlines()[-1]))
    assert answer.shape == (1, 4, 2)
    scored = predicted.actions[0, np.flatnonzero(predicted.anchors == anchor)[0]]
    np.testing.assert_allclose(answer[0], scored, rtol=1e-4, atol=1e-5)


def test_a_model_holds_no_pickle(finished):
    files = [p for p in (finished.store.root / "mlartifacts").rglob("*") if p.is_file()]
    assert any(p.suffix == ".safetensors" for p in files)
    assert not [p for p in files if p.suffix in (".pkl", ".pickle", ".pt", ".pth")]


def test_a_run_says_which_demonstrations_it_is_of(finished, run_of):
    demos = load_demonstrations(finished.plan().folder(Unit("demonstrations")) / "frames")
    (used,) = run_of("mlp_k04").inputs.dataset_inputs
    assert (used.dataset.name, used.dataset.digest) == (demos.name, demos.content_hash[:36])
    assert mlflow.data.get_source(used.dataset).uri == str(finished.folder)
    assert json.loads(used.dataset.profile)["episodes"] == demos.episodes


def test_the_champions_model_has_the_alias(finished, client, run_of):
    bench = Bench(Workbench(finished.config, finished.folder, finished.store, ()), finished.plan(), None, None)

    def holder(champion: str) -> str:
        for message in crown(bench, champion):
            bench.outbox.post(message, bench.plan.folder(Unit("benchmark_table")), "benchmark_table", "")
        assert bench.outbox.deliver().kept == 0
        return client.get_model_version_by_alias("tiny", "champion").run_id

    first = holder("mlp_k04/state")
    assert first == run_of("mlp_k04").info.run_id
    assert holder("mlp_k01") == run_of("mlp_k01").info.run_id
    assert holder("mlp_k04") == first
    assert holder("hold_still") == first, "a baseline has no model"
    assert holder("nobody") == first
    assert len(client.search_model_versions("name = 'tiny'")) == 2


def test_nothing_is_kept_where_mlflow_answers(finished):
    assert not list((finished.store.root / "mlflow_unsent").glob("*.json"))

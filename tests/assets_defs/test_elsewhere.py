"""The asset `scored_predictions`: what it is made from, when it is fresh, and that the table holds it."""

import json
import shutil
from dataclasses import replace

import dagster as dg
import mlflow
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from assets_defs.elsewhere import Request, check_name
from assets_defs.launch import open_instance, run_benchmark
from assets_defs.plan import SCORED, Plan, Unit
from assets_defs.resources import asset_keys
from demobench.commands.split import split_json
from pipeline.config import BASELINES
from pipeline.errors import ConfigError
from pipeline.lerobot_format.saved import load_demonstrations
from pipeline.predict import load_predictions
from pipeline.sinks.to_mlflow import tracking_uri
from pipeline.split import load_split
from pipeline.statistics.metrics import load_errors
from pipeline.store import Store
from tests.assets_defs.conftest import TinyBenchmark, why_failed


@pytest.fixture(scope="module")
def copied(finished, tmp_path_factory) -> TinyBenchmark:
    """A finished benchmark that these tests may add to."""
    root = tmp_path_factory.mktemp("scored") / "results"
    shutil.copytree(finished.store.root, root)
    return TinyBenchmark(finished.folder, Store(root), finished.raw)


@pytest.fixture(scope="module")
def request_of_ours(copied) -> tuple[Request, dict]:
    """The trained policy's own predictions as a file, and what its score depends on."""
    plan, place = copied.plan(), copied.store.root.parent
    demos = load_demonstrations(plan.folder(Unit("demonstrations")) / "frames")
    split = load_split(plan.folder(Unit("episode_split")) / "split.json")
    (place / "split.json").write_text(json.dumps(split_json(split, demos, None)))
    p = load_predictions(plan.folder(Unit("mlp_k04/predictions", "state")))
    episode = demos.episode_of_frame[p.anchors]
    rows = {
        "episode_index": np.tile(demos.episode_ids[episode], 2),
        "frame_index": np.tile(demos.frame_in_episode[p.anchors], 2),
        "seed": np.repeat(p.seeds, len(episode)),
        "action": np.asarray(p.actions).reshape(-1, *p.actions.shape[2:]).tolist(),
    }
    pq.write_table(pa.table(rows), place / "ours.parquet")
    request = Request("sent", place / "ours.parquet", place / "split.json", "state")
    return request, request.identity(demos)


def plan_of(benchmark: TinyBenchmark, asked=None) -> Plan:
    return replace(benchmark.plan(), selected=tuple(BASELINES), asked=asked or {}, _memo={})


def run_score(benchmark: TinyBenchmark, assets, config) -> tuple[dg.DagsterRun, list[str]]:
    target = benchmark.target()
    with open_instance(benchmark.store.root) as instance:
        ops = {SCORED: config} if config else None
        run = run_benchmark(
            instance, benchmark.defs(), target.key, assets, (), list(BASELINES), job_name="score", ops=ops
        )
        return run, why_failed(instance, run)


@pytest.fixture(scope="module")
def scored(copied, request_of_ours) -> list[Unit]:
    """What was stale before the predictions were scored."""
    request, identity = request_of_ours
    stale = plan_of(copied, {request.name: identity}).stale()
    run, why = run_score(copied, asset_keys(stale), request.config())
    assert run.is_success, why
    return list(stale)


def test_only_the_score_and_the_summaries_are_made(copied, request_of_ours, scored):
    request, identity = request_of_ours
    assert [unit.asset for unit in scored] == [
        SCORED, "benchmark_table", "benchmark_report", "mcap_log", "rerun_recording",
    ]  # fmt: skip
    assert plan_of(copied, {request.name: identity}).stale() == {}
    assert plan_of(copied).stale() == {}, "a run without the request keeps the row"
    assert [u.policy for u in plan_of(copied).fresh_predictions()][-1] == "sent"


def test_other_bytes_training_or_sight_make_it_stale(copied, request_of_ours, scored):
    request, identity = request_of_ours
    for change in ({"sha256": "0" * 64}, {"trained_on": None}, {"observations": None}):
        stale = plan_of(copied, {request.name: identity | change}).stale()
        assert stale[Unit(SCORED, "sent")] == "its data, settings or code changed"


def test_the_row_is_that_of_the_policy(copied, scored):
    plan = plan_of(copied)
    table = json.loads((plan.folder(Unit("benchmark_table")) / "table.json").read_text())
    rows = {row["policy"]: row for row in table["policies"]}
    ours, sent = rows["mlp_k04"], rows["sent"]
    same = (
        "first_step_mae", "first_step_rmse", "at_one_second_mae", "whole_chunk_mae", "error_by_horizon",
        "hold_still_by_horizon", "error_by_joint", "vs_hold_still", "scaled", "interval", "ensembled_first_step_mae",
        "windows_test", "seeds", "chunk", "observations", "above_floor", "verdict",
    )  # fmt: skip
    assert {key: sent[key] for key in same} == {key: ours[key] for key in same}
    assert (sent["method"], sent["params"], sent["latency_ms"], sent["train_s"]) == ("external", None, None, 0)
    assert sent["seen_in_training"] is False
    assert sent["episodes"] == list(range(6))
    folders = (Unit("mlp_k04/predictions", "state"), Unit(SCORED, "sent"))
    of_ours, of_sent = (load_errors(plan.folder(unit) / "errors.safetensors") for unit in folders)
    for name, values in vars(of_ours).items():
        np.testing.assert_allclose(getattr(of_sent, name), values, rtol=1e-6, err_msg=name)


def test_the_ui_shows_it_and_it_is_no_part_of_a_benchmark(copied, scored):
    defs = copied.defs()
    of_benchmark = {k.to_user_string() for k in defs.resolve_job_def("benchmark").asset_layer.executable_asset_keys}
    assert SCORED not in of_benchmark
    assert SCORED not in {u.asset for u in copied.plan().units()}
    node = defs.resolve_asset_graph().get(dg.AssetKey([SCORED]))
    assert node.group_name == "elsewhere"
    assert dg.AssetKey(["benchmark_table"]) in node.child_keys
    with open_instance(copied.store.root) as instance:
        event = instance.get_latest_materialization_event(dg.AssetKey([SCORED]))
    metadata = event.asset_materialization.metadata
    assert "6 episodes that it was not trained on (split.json, a split of 2 folds)" in metadata["scores"].value
    assert "data:image/png" in metadata["error_by_horizon_sent"].value


def test_mlflow_has_a_run_of_it_with_the_metrics_of_every_other_run(copied, scored):
    """Equal predictions: the metrics that scoring gives the policy's own run are those of the row from elsewhere."""
    client = mlflow.MlflowClient(tracking_uri("sqlite", copied.store.root))
    experiment = client.get_experiment_by_name("tiny").experiment_id
    runs = client.search_runs([experiment], "tags.`demobench.external` = 'true'", max_results=10)
    (run,) = runs
    said = copied.store.made(copied.plan().folder(Unit(SCORED, "sent"))).summary
    assert run.info.run_id == said["mlflow_run_id"]
    assert (run.info.run_name, run.info.status) == ("sent/state", "FINISHED")
    assert run.data.params | {"method": "external", "seeds": "2", "steps": "unknown"} == run.data.params
    tags = {
        name: run.data.tags[f"demobench.{name}"] for name in ("seen_in_training", "predictions_sha256", "split_hash")
    }
    assert tags == {
        "seen_in_training": "false",
        "predictions_sha256": said["asked"]["sha256"],
        "split_hash": said["split_hash"],
    }
    ours = copied.store.made(copied.plan().folder(Unit("mlp_k04/trained_policy", "state"))).summary["mlflow_run_id"]
    of_ours = client.get_run(ours).data.metrics
    costs = {"train_s", "parameters", "steps"}
    assert set(run.data.metrics) == set(of_ours) - costs
    assert {name: run.data.metrics[name] for name in run.data.metrics} == pytest.approx(
        {name: of_ours[name] for name in run.data.metrics}
    )
    nested = client.search_runs([experiment], f"tags.`mlflow.parentRunId` = '{run.info.run_id}'")
    assert sorted(child.info.run_name for child in nested) == ["sent/state/seed_0", "sent/state/seed_1"]
    assert all(child.data.metrics["first_step_mae"] > 0 for child in nested)
    assert [one.path for one in client.list_artifacts(run.info.run_id)] == ["error_by_horizon.png"]


def test_without_a_name_it_shows_what_is_there(copied, scored):
    run, why = run_score(copied, [dg.AssetKey([SCORED])], None)
    assert run.is_success, why


def test_a_name_must_be_free_and_a_name(copied):
    experiment = copied.target().experiment
    check_name("my_act", experiment)
    for name in ("hold_still", "mlp_k04", "mlp"):
        with pytest.raises(ConfigError, match=f"'{name}' is a policy of 'tiny'"):
            check_name(name, experiment)
    with pytest.raises(ConfigError):
        check_name("../outside", experiment)


def test_with_nothing_to_score_it_stops_nothing(copied):
    # The last test of this file: it takes away what was scored.
    for folder in copied.plan().folder(Unit(SCORED)).glob("*"):
        shutil.rmtree(folder)
    run, why = run_score(copied, [dg.AssetKey([SCORED])], None)
    assert run.is_success, why
    with open_instance(copied.store.root) as instance:
        event = instance.get_latest_materialization_event(dg.AssetKey([SCORED]))
    assert "Nothing was scored yet" in event.asset_materialization.metadata["nothing"].value

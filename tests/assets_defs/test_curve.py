"""The asset `learning_curve`: what it is made from, what it keeps, and what it says."""

import json

import dagster as dg
import numpy as np
import pytest

from assets_defs.curve import curves_asked
from assets_defs.launch import open_instance, run_benchmark
from assets_defs.plan import Unit, curve_unit, sizes_of
from assets_defs.resources import asset_keys
from pipeline.errors import ConfigError, NotApplicableError
from pipeline.statistics.curve_reading import load_by_size
from pipeline.statistics.metrics import load_errors
from pipeline.store import Store
from tests.assets_defs.conftest import TinyBenchmark, why_failed
from tests.makers import tiny_recording, write_v3

RAW = {
    "benchmark": {"seeds": 2, "folds": 1, "test_share": 0.4, "steps": 6, "threads": 1},
    "policies": {"mlp": {"method": "mlp", "chunks": [1]}},
}
UNIT = curve_unit("mlp_k01", "state")


def run_curve(benchmark: TinyBenchmark, *sizes: int) -> tuple[dict[Unit, str], dg.DagsterRun, list[str]]:
    """Make the curve and what it needs, as the command line does; returns what was stale, the run, and why it failed."""
    target, plan = benchmark.target(), benchmark.plan()
    stale = plan.stale(plan.curve_units([curve_unit("mlp_k01", "state", sizes)]))
    benchmark.store.register(target.key, target.experiment.model_dump(mode="json"))
    with open_instance(benchmark.store.root) as instance:
        ops = {"learning_curve": {"sizes": list(sizes)}}
        run = run_benchmark(
            instance, benchmark.defs(), target.key, asset_keys(stale), (), ["mlp_k01"], job_name="curve", ops=ops
        )
        return stale, run, why_failed(instance, run)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory) -> tuple[TinyBenchmark, dict[Unit, str], dg.DagsterRun]:
    """A curve over 4 and 8 of 8 training episodes, six held out."""
    folder = write_v3(tmp_path_factory.mktemp("data") / "tiny", tiny_recording(episodes=14, frames=25))
    benchmark = TinyBenchmark(folder, Store(tmp_path_factory.mktemp("results")).ensure(), RAW)
    stale, run, why = run_curve(benchmark)
    assert run.is_success, why
    return benchmark, stale, run


def test_it_makes_what_it_needs_and_nothing_more(drawn):
    benchmark, stale, _ = drawn
    assert {u.asset for u in stale} == {
        "demonstrations", "episode_split", "windows", "multimodality_floor", "mlp_k01/trained_policy",
        "mlp_k01/predictions", "learning_curve",
    }  # fmt: skip
    assert not (benchmark.store.dataset("tiny") / "benchmark_table").exists()
    assert not (benchmark.store.dataset("tiny") / "hold_still").exists()
    plan = benchmark.plan()
    assert plan.stale(plan.curve_units([UNIT])) == {}


def test_the_curve_ends_in_the_tables_number(drawn):
    benchmark, _, _ = drawn
    plan = benchmark.plan()
    summary = benchmark.store.made(plan.folder(UNIT)).summary
    metrics = benchmark.store.made(plan.folder(Unit("mlp_k01/predictions", "state"))).summary["metrics"]
    assert [p["episodes"] for p in summary["sizes"]] == [4, 8]
    assert summary["sizes"][-1]["error"] == pytest.approx(metrics["first_step_mae"], rel=1e-12)
    assert summary["sizes"][-1]["interval"] == pytest.approx(metrics["interval"]["first_step_mae"])
    assert (summary["steps"], summary["seeds"]) == (6, [0, 1])
    assert all(passed for passed, _ in summary["checks"].values())


def test_errors_are_kept_by_size_on_the_same_episodes(drawn):
    benchmark, _, _ = drawn
    by_size = load_by_size(benchmark.plan().folder(UNIT))
    assert {size: len(orders) for size, orders in by_size.items()} == {4: 3, 8: 1}
    full = load_errors(benchmark.plan().folder(Unit("mlp_k01/predictions", "state")) / "errors.safetensors")
    for errors in [e for orders in by_size.values() for e in orders]:
        np.testing.assert_array_equal(errors.episodes, full.episodes)
        np.testing.assert_array_equal(errors.anchors, full.anchors)
    assert len({e.absolute.sum() for e in by_size[4]}) == 3, "orders differ"


def test_the_curve_is_in_mlflow_with_the_episodes_as_steps(drawn):
    from mlflow import MlflowClient

    benchmark, _, _ = drawn
    plan = benchmark.plan()
    run_id = benchmark.store.made(plan.folder(Unit("mlp_k01/trained_policy", "state"))).summary["mlflow_run_id"]
    client = MlflowClient(f"sqlite:///{benchmark.store.root / 'mlflow.db'}")
    logged = client.get_metric_history(run_id, "curve_first_step_mae")
    sizes = benchmark.store.made(plan.folder(UNIT)).summary["sizes"]
    assert [(m.step, m.value) for m in logged] == [(size["episodes"], pytest.approx(size["error"])) for size in sizes]


def test_it_shows_the_answer_and_the_picture_in_the_ui(drawn):
    benchmark, _, _ = drawn
    with open_instance(benchmark.store.root) as instance:
        event = instance.get_latest_materialization_event(dg.AssetKey(["learning_curve"]))
    metadata = event.asset_materialization.metadata
    words = [a["words"] for a in benchmark.store.made(benchmark.plan().folder(UNIT)).summary["answers"]]
    assert words
    assert all(said in metadata["would_more_help"].value for said in words)
    assert "data:image/png" in metadata["first_step_mae_mlp_k01_state_default"].value
    assert {"seconds", "peak_memory_mb", "curve", "budget"} <= set(metadata)
    json.dumps(benchmark.store.made(benchmark.plan().folder(UNIT)).summary, allow_nan=False)


def test_other_sizes_overwrite_nothing_and_train_only_what_is_new(drawn):
    benchmark, _, _ = drawn
    (kept,) = (benchmark.store.dataset("tiny") / ".subsets" / "mlp_k01" / "state").iterdir()
    before = {p.name: p.stat().st_mtime_ns for p in kept.iterdir()}
    made = benchmark.store.made(benchmark.plan().folder(UNIT))
    stale, run, why = run_curve(benchmark, 4, 5)
    assert run.is_success, why
    assert [u.asset for u in stale] == ["learning_curve"]
    after = {p.name: p.stat().st_mtime_ns for p in kept.iterdir()}
    assert before.items() <= after.items()
    assert len(after) == len(before) + 3
    assert benchmark.store.made(benchmark.plan().folder(UNIT)) == made


def test_it_is_no_part_of_a_benchmark_and_has_a_job_of_its_own(drawn):
    benchmark, _, run = drawn
    assert run.job_name == "curve"
    defs = benchmark.defs()
    of_benchmark = {k.to_user_string() for k in defs.resolve_job_def("benchmark").asset_layer.executable_asset_keys}
    assert "learning_curve" not in of_benchmark
    assert "learning_curve" not in {unit.asset for unit in benchmark.plan().units()}
    node = defs.resolve_asset_graph().get(dg.AssetKey(["learning_curve"]))
    assert node.group_name == "benchmark"
    assert dg.AssetKey(["mlp_k01", "predictions"]) in node.parent_keys


def test_without_predictions_it_says_what_to_materialise(drawn, tmp_path):
    benchmark, _, _ = drawn
    empty = TinyBenchmark(benchmark.folder, Store(tmp_path / "results").ensure(), RAW)
    target = empty.target()
    with open_instance(empty.store.root) as instance:
        keys = [dg.AssetKey(["learning_curve"])]
        run = run_benchmark(instance, empty.defs(), target.key, keys, job_name="curve")
        (why, *_) = why_failed(instance, run)
    assert "learning_curve of 'tiny' needs" in why
    assert "mlp_k01/predictions state" in why


def test_which_curves_are_asked_for(drawn):
    benchmark, _, _ = drawn
    e = benchmark.target().experiment
    assert curves_asked(e, e.variants) == [UNIT], "the first policy that is trained"
    champion = e.model_copy(update={"dataset": e.dataset.model_copy(update={"champion": "nearest_neighbour/state"})})
    assert curves_asked(champion, e.variants) == [curve_unit("nearest_neighbour", "state")]
    gone = e.model_copy(update={"dataset": e.dataset.model_copy(update={"champion": "mlp_k64/state"})})
    assert curves_asked(gone, e.variants) == [UNIT], "who was promoted may not be in the file any more"
    assert curves_asked(champion, e.variants, ["mlp_k01"], ["state"], [8, 4]) == [
        curve_unit("mlp_k01", "state", [4, 8])
    ]
    with pytest.raises(ConfigError, match="No policy 'mlp_k1'. Did you mean 'mlp_k01'"):
        curves_asked(e, e.variants, ["mlp_k1"])
    with pytest.raises(ConfigError, match="has no observation set 'stat'. Did you mean 'state'"):
        curves_asked(e, e.variants, [], ["stat"])
    with pytest.raises(NotApplicableError, match="'hold_still' is a baseline that does not learn"):
        curves_asked(e, e.variants, ["hold_still"])


def test_a_curves_name_holds_its_sizes():
    assert UNIT.entry == "mlp_k01/state/default"
    unit = curve_unit("mlp_k01", "pose", [20, 10, 20])
    assert unit.entry == "mlp_k01/pose/10-20"
    assert sizes_of(unit) == (10, 20)
    assert sizes_of(UNIT) == ()


def test_a_budget_in_cpu_seconds_gives_every_size_the_steps_of_all_episodes(drawn, tmp_path):
    benchmark, _, _ = drawn
    policies = {"mlp": RAW["policies"]["mlp"] | {"cpu_seconds": 0.1, "settings": {"width": 16}}}
    timed = TinyBenchmark(benchmark.folder, Store(tmp_path / "results").ensure(), RAW | {"policies": policies})
    _, run, why = run_curve(timed)
    assert run.is_success, why
    plan = timed.plan()
    trained = timed.store.made(plan.folder(Unit("mlp_k01/trained_policy", "state"))).summary
    curve = timed.store.made(plan.folder(UNIT)).summary
    assert curve["steps"] == trained["steps"] > 6
    assert curve["checks"]["ends_in_the_table"][0]


def test_the_report_shows_the_curve_from_the_next_run_on(tmp_path):
    folder = write_v3(tmp_path / "tiny", tiny_recording(episodes=14, frames=25))
    benchmark = TinyBenchmark(folder, Store(tmp_path / "results").ensure(), RAW)
    benchmark.run(policies=("mlp",))
    page = benchmark.plan().folder(Unit("benchmark_report")) / "report.html"
    asks = "Not asked yet: <code>demobench curve tiny</code>"
    assert asks in page.read_text()
    _, run, why = run_curve(benchmark)
    assert run.is_success, why
    assert benchmark.run(policies=("mlp",))[0] == ["benchmark_report"]
    shown = page.read_text()
    assert asks not in shown
    assert shown.count("Would more demonstrations help?</h2>") == 1
    said = benchmark.store.made(benchmark.plan().folder(UNIT)).summary["answers"][0]["words"]
    assert said.split(":")[0] in shown
    forgotten = TinyBenchmark(folder, benchmark.store, {**RAW, "policies": {"mlp": {"method": "mlp", "chunks": [4]}}})
    assert forgotten.plan().curves() == []

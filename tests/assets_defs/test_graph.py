"""The whole graph on a tiny data set: what it makes, and what it makes again after a change."""

import json
import re
import shutil

import dagster as dg
import numpy as np
import pytest

from assets_defs.automation import stale_assets
from assets_defs.definitions import build_defs
from assets_defs.launch import open_instance, run_benchmark
from assets_defs.plan import Unit
from pipeline.predict import load_predictions
from pipeline.store import Store
from tests.assets_defs.conftest import TINY, TinyBenchmark, why_failed
from tests.makers import tiny_recording, write_v3


@pytest.fixture
def copy(finished, tmp_path) -> TinyBenchmark:
    """The finished benchmark in a store and data folder of its own, to change things in."""
    shutil.copytree(finished.store.root / "datasets", tmp_path / "results" / "datasets")
    return TinyBenchmark(finished.folder, Store(tmp_path / "results").ensure(), json.loads(json.dumps(TINY)))


def test_everything_is_made_once(finished):
    assert finished.plan().stale() == {}
    for unit in finished.plan().units():
        made = finished.store.made(finished.plan().folder(unit))
        assert made is not None, unit
        assert all(passed for passed, _ in made.summary["checks"].values()), unit
        assert made.seconds > 0
        assert made.peak_memory_mb > 10


def test_the_report_and_the_history_lead_to_each_other(finished):
    place = finished.store.dataset("tiny")
    pages = {page: place / page for page in ("benchmark_report/report.html", "benchmark_history/history.html")}
    for page, path in pages.items():
        (other,) = (p for name, p in pages.items() if name != page)
        leads = re.findall(r'<a href="([^"]+)">', path.read_text(encoding="utf-8"))
        assert [(path.parent / lead).resolve() for lead in leads] == [other.resolve()]


def test_the_table_has_every_policy_and_honest_numbers(finished):
    folder = finished.plan().folder(Unit("benchmark_table"))
    table = json.loads((folder / "table.json").read_text())
    rows = {row["policy"]: row for row in table["policies"]}
    assert set(rows) == {
        "hold_still", "mean_action", "constant_velocity", "nearest_neighbour", "mlp_k01", "mlp_k04",
    }  # fmt: skip
    assert table["dataset"]["episodes"] == 6
    assert len(table["brackets"]) == 6  # two horizons, three losses
    assert all("6 episodes are too few" in bracket["words"] for bracket in table["brackets"])
    assert {c["word"] for c in table["comparisons"]} <= {"better", "worse", "cannot tell"}
    assert rows["hold_still"]["verdict"]["vs_hold_still"] is None
    assert rows["mlp_k01"]["verdict"]["vs_hold_still"] == "cannot tell"  # six episodes cannot tell so many apart
    assert set(rows["mlp_k04"]["verdict"]) == {
        "vs_hold_still", "vs_champion", "vs_hold_still_at_one_second", "vs_champion_at_one_second",
    }  # fmt: skip
    assert rows["hold_still"]["vs_hold_still"] == pytest.approx(1.0)
    assert rows["mlp_k04"]["chunk"] == 4
    assert rows["hold_still"]["chunk"] is None
    assert len(rows["mlp_k04"]["error_by_horizon"]) == 4
    assert len(rows["hold_still"]["error_by_horizon"]) == 11, "the largest chunk is 4, one second is 10 frames away"
    assert rows["mlp_k01"]["windows_test"] == 6 * (30 - 2), "every episode is held out once"
    # The number in the table, once more the long way round: mean over episodes of each episode's mean.
    predicted = load_predictions(finished.plan().folder(Unit("mlp_k01/predictions", "state")))
    recorded = np.load(finished.plan().folder(Unit("demonstrations")) / "frames" / "column-000.npy")
    episodes = [
        np.mean(
            [np.abs(predicted.actions[:, m, 0] - recorded[t]) for m, t in enumerate(predicted.anchors) if t // 30 == e]
        )
        for e in range(6)
    ]
    assert rows["mlp_k01"]["first_step_mae"] == pytest.approx(np.mean(episodes), rel=1e-5)


def test_a_longer_training_makes_policies_stale_and_nothing_before_them(copy):
    copy.raw["benchmark"]["steps"] = 7
    stale = copy.plan().stale()
    assert {u.asset for u in stale} == {
        *(f"mlp_k0{k}/{kind}" for k in (1, 4) for kind in ("trained_policy", "predictions", "rollouts")),
        "benchmark_table", "rollout_video", "benchmark_report", "mcap_log", "rerun_recording",
    }  # fmt: skip


def test_a_new_chunk_size_trains_that_policy_alone(copy):
    copy.raw["policies"]["mlp"]["chunks"] = [1, 4, 2]
    trained = {u.asset for u in copy.plan().stale() if u.kind == "trained_policy"}
    assert trained == {"mlp_k02/trained_policy"}


def test_a_touched_folder_is_read_again_and_nothing_more(copy, tmp_path):
    moved = tmp_path / "tiny"
    shutil.copytree(copy.folder, moved)
    copy.folder = moved
    before = {u: copy.store.made(copy.plan().folder(u)) for u in copy.plan().units()}
    assert Unit("demonstrations") in copy.plan().stale()
    copy.run()
    changed = {u.asset for u, made in before.items() if copy.store.made(copy.plan().folder(u)) != made}
    assert changed == {"demonstrations"}, "the content is the same, so everything behind it is kept"


def test_other_data_under_the_same_name_makes_everything_again(copy, tmp_path):
    moved = tmp_path / "tiny"
    write_v3(moved, tiny_recording(episodes=6, frames=30, seed=5))
    copy.folder = moved
    before = {u: copy.store.made(copy.plan().folder(u)).fingerprint for u in copy.plan().units()}
    copy.run()
    assert all(copy.store.made(copy.plan().folder(u)).fingerprint != f for u, f in before.items())


def test_units_of_the_users_own_reach_the_table(copy):
    copy.raw["datasets"] = {"tiny": {"units": "degrees"}}
    copy.run()
    table = copy.plan().folder(Unit("benchmark_table")) / "table.json"
    assert json.loads(table.read_text())["dataset"]["action_units"] == ["deg", "deg"]
    assert copy.plan().stale() == {}


def test_a_variant_never_overwrites(copy):
    before = {u: copy.store.made(copy.plan().folder(u)) for u in copy.plan().units()}
    assets, _ = copy.run(protocol="notebook", policies=("mlp",), chunks=(1,))
    assert "mlp_k01/predictions" in assets
    assert "mlp_k04/predictions" not in assets
    assert (copy.store.root / "datasets" / "tiny+notebook" / "benchmark_table" / "table.json").exists()
    assert {u: copy.store.made(copy.plan().folder(u)) for u in copy.plan().units()} == before


def test_a_selection_shows_in_the_partitions_table_beside_what_is_fresh(copy):
    copy.raw["policies"]["mlp"]["chunks"] = [1, 4, 2]
    copy.run(policies=("mlp",), chunks=(2,))
    table = json.loads((copy.plan().folder(Unit("benchmark_table")) / "table.json").read_text())
    assert {"mlp_k01", "mlp_k02", "mlp_k04"} <= {row["policy"] for row in table["policies"]}


def test_a_damaged_result_is_made_again(copy):
    folder = copy.plan().folder(Unit("mlp_k01/predictions", "state"))
    (folder / "made.json").write_text("{")
    assert Unit("mlp_k01/predictions", "state") in copy.plan().stale()
    copy.run()
    assert copy.plan().stale() == {}


def test_graph_groups_and_dependencies(finished):
    graph = finished.defs().resolve_asset_graph()
    groups = {node.group_name for node in graph.asset_nodes}
    assert {"data", "floor", "benchmark", "looking", "hold_still", "mlp_k01", "mlp_k04"} <= groups
    table = graph.get(dg.AssetKey(["benchmark_table"]))
    assert dg.AssetKey(["mlp_k04", "predictions"]) in table.parent_keys
    for node in graph.asset_nodes:
        assert node.description, node.key
        assert node.kinds, node.key


def test_every_asset_says_what_it_cost_and_shows_something(finished):
    with open_instance(finished.store.root) as instance:
        for node in finished.defs().resolve_asset_graph().asset_nodes:
            if node.key.to_user_string() in ("learning_curve", "scored_predictions"):
                continue  # no part of a benchmark
            event = instance.get_latest_materialization_event(node.key)
            assert event is not None, node.key
            metadata = event.asset_materialization.metadata
            assert {"seconds", "peak_memory_mb"} <= set(metadata), node.key
            assert len(metadata) > 3, node.key
            assert event.asset_materialization.tags["dagster/data_version"]


def test_a_policy_that_the_file_got_since_is_left_out_of_what_was_registered_before(copy):
    before = copy.target().experiment
    shutil.copytree(copy.store.dataset("tiny"), copy.store.dataset("older"))
    copy.store.register("older", before.model_dump(mode="json"))
    copy.raw["policies"]["near"] = {"method": "lwr", "chunks": [1]}
    defs = build_defs(copy.config, config_dir=copy.folder, store=copy.store)
    near = [dg.AssetKey(["near_k01", kind]) for kind in ("trained_policy", "predictions", "rollouts")]
    with open_instance(copy.store.root) as instance:
        run = run_benchmark(instance, defs, "older", [*near, dg.AssetKey(["benchmark_table"])])
        assert run.is_success, why_failed(instance, run)
        said = instance.get_latest_materialization_event(near[1]).asset_materialization.metadata["why_none"].value
        table = instance.get_latest_materialization_event(dg.AssetKey(["benchmark_table"])).asset_materialization
    assert said.startswith("'older' was benchmarked from the command line with the policies of that time, and near_k01")
    assert said.endswith(f"demobench run {copy.folder} takes those of the file as it is now.")
    assert not copy.store.folder("older", "near_k01").exists()
    assert "mae_mlp_k04_state" in table.metadata
    assert stale_assets(defs.resources["workbench"], "older") == []


def test_a_policy_for_other_data_sets_makes_nothing_and_says_so(copy):
    copy.raw["datasets"] = {"other": {"source": "elsewhere"}}
    copy.raw["policies"]["theirs"] = {"method": "lwr", "chunks": [1], "datasets": ["other"]}
    defs = build_defs(copy.config, config_dir=copy.folder, store=copy.store)
    assert stale_assets(defs.resources["workbench"], "tiny") == []
    theirs = [dg.AssetKey(["theirs_k01", kind]) for kind in ("trained_policy", "predictions", "rollouts")]
    with open_instance(copy.store.root) as instance:
        run = run_benchmark(instance, defs, "tiny", theirs)
        assert run.is_success, why_failed(instance, run)
        for key in theirs:
            said = instance.get_latest_materialization_event(key).asset_materialization.metadata["why_none"].value
            assert said == "theirs_k01 is for other data sets only: other."
    assert not copy.store.folder("tiny", "theirs_k01").exists()

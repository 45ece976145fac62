"""What the UI says is out of date is what the plan says, and Dagster's own "unsynced" is never wrong."""

import json
import shutil

import dagster as dg
import pytest
from dagster._core.definitions.data_version import CachingStaleStatusResolver, StaleStatus
from dagster._core.loader import LoadingContextForTest

from assets_defs.launch import open_instance, run_benchmark
from assets_defs.plan import CODE_VERSIONS
from assets_defs.up_to_date import CHECK, out_of_date, say_what_is_out_of_date
from pipeline.store import Store
from tests.assets_defs.conftest import TINY, TinyBenchmark


@pytest.fixture
def copy(finished, tmp_path) -> TinyBenchmark:
    """The finished benchmark with what Dagster knows of it, to change things in."""
    shutil.copytree(finished.store.root, tmp_path / "results")
    return TinyBenchmark(finished.folder, Store(tmp_path / "results").ensure(), json.loads(json.dumps(TINY)))


def served(benchmark: TinyBenchmark) -> dg.Definitions:
    """The definitions as the UI has them: settings of the file alone."""
    from assets_defs.definitions import build_defs

    return build_defs(benchmark.config, config_dir=benchmark.folder, store=benchmark.store)


def unsynced(instance: dg.DagsterInstance, defs: dg.Definitions, key: str = "tiny") -> set[str]:
    """What Dagster itself takes for out of date: as the UI's own question, `staleStatus`."""
    graph = defs.get_repository_def().asset_graph
    asked = CachingStaleStatusResolver(instance, graph, LoadingContextForTest(instance))
    keys = graph.materializable_asset_keys
    return {one.to_user_string() for one in keys if asked.get_status(one, key) == StaleStatus.STALE}


def said(instance: dg.DagsterInstance, defs: dg.Definitions, cursor: str | None = None) -> dg.SensorResult:
    """A tick of the sensor; Dagster is told what it found, as by its daemon."""
    workbench = {"workbench": defs.resources["workbench"]}
    found = say_what_is_out_of_date(dg.build_sensor_context(instance=instance, resources=workbench, cursor=cursor))
    for event in found.asset_events:
        instance.report_runless_asset_event(event)
    return found


def test_settings_that_changed_are_said_by_the_check_until_the_results_are_made(copy):
    with open_instance(copy.store.root) as instance:
        first = said(instance, served(copy))
        assert first.asset_events[0].passed
        assert first.asset_events[0].metadata["why"].value == "tiny: up to date"
        assert said(instance, served(copy), first.cursor).asset_events == []

        copy.raw["benchmark"]["steps"] = 7
        defs = served(copy)
        planned = {unit.asset for unit in copy.plan().stale()}
        assert set(out_of_date(defs.resources["workbench"], "tiny")) == planned
        assert {"mlp_k01/trained_policy", "benchmark_table"} <= planned
        assert unsynced(instance, defs) == set(), "Dagster cannot know"
        (check,) = said(instance, defs, first.cursor).asset_events
        assert (check.check_name, check.passed, check.severity) == (CHECK, False, dg.AssetCheckSeverity.WARN)
        assert check.metadata["why"].value == f"tiny: {len(planned)} assets are out of date"
        assert "mlp_k01/trained_policy | its data, settings or code changed" in check.metadata["out_of_date"].value

        copy.run()
        assert out_of_date(defs.resources["workbench"], "tiny") == {}
        assert unsynced(instance, defs) == set()
        assert said(instance, defs, first.cursor).asset_events[0].passed


def test_it_is_said_again_where_a_run_ended_before_it_could_say_it(copy, monkeypatch):
    defs = served(copy)
    with open_instance(copy.store.root) as instance:
        before = said(instance, defs)
        monkeypatch.setattr("assets_defs.benchmark.record", lambda *_: 1 / 0)
        assert not run_benchmark(instance, defs, "tiny", [dg.AssetKey(["benchmark_table"])]).is_success
        (again,) = said(instance, defs, before.cursor).asset_events
        assert again.passed


def test_code_that_changed_is_unsynced_and_in_the_plan(copy, monkeypatch):
    monkeypatch.setitem(CODE_VERSIONS, "predictions", "changed")
    defs = served(copy)
    with open_instance(copy.store.root) as instance:
        dagster = unsynced(instance, defs)
    assert dagster == {a.key.to_user_string() for a in defs.assets if a.key.path[-1] == "predictions"}
    assert dagster < set(out_of_date(defs.resources["workbench"], "tiny")), "the plan also names what follows"


def test_another_budget_in_the_launchpad_leaves_the_data_sets_own_results_as_they_are(copy):
    defs = served(copy)
    chosen = [
        dg.AssetKey(["demonstrations"]),
        dg.AssetKey(["episode_split"]),
        dg.AssetKey(["mlp_k01", "trained_policy"]),
    ]
    trained = chosen[-1]
    with open_instance(copy.store.root) as instance:
        before = instance.get_latest_materialization_event(trained).asset_materialization
        run = defs.resolve_job_def("benchmark").execute_in_process(
            {"resources": {"budget": {"config": {"steps": 3}}}}, instance, "tiny", asset_selection=chosen
        )
        assert run.success
        key = copy.target(steps=3).key

        def latest(partition: str) -> dg.AssetMaterialization:
            asked = dg.AssetRecordsFilter(trained, asset_partitions=[partition])
            return instance.fetch_materializations(asked, limit=1).records[0].asset_materialization

        assert latest(key).metadata["training"].value != before.metadata["training"].value
        assert latest("tiny").metadata["made_instead"].value == key
        assert "training" not in latest("tiny").metadata, "other numbers are no part of the history"
        assert latest("tiny").tags["dagster/data_version"] == before.tags["dagster/data_version"]
        assert unsynced(instance, defs) == set()
        assert out_of_date(defs.resources["workbench"], "tiny") == {}

"""What runs by itself."""

import dagster as dg
import pytest

from assets_defs.automation import register_datasets
from assets_defs.launch import open_instance
from assets_defs.resources import Workbench
from pipeline.experiment import variants
from tests.assets_defs.conftest import TINY, TinyBenchmark


@pytest.fixture
def fresh(tiny_folder, tmp_path) -> TinyBenchmark:
    from pipeline.store import Store

    return TinyBenchmark(tiny_folder, Store(tmp_path / "results").ensure(), TINY)


def workbench(benchmark: TinyBenchmark) -> Workbench:
    return benchmark.defs().resources["workbench"]


def test_the_sensor_makes_partitions_of_the_files_and_the_stores_data_sets(fresh):
    fresh.store.register("from-the-command-line", fresh.target().experiment.model_dump(mode="json"))
    with open_instance(fresh.store.root) as instance:
        context = dg.build_sensor_context(instance=instance, resources={"workbench": workbench(fresh)})
        result = register_datasets(context)
        assert result.dynamic_partitions_requests[0].partition_keys == ["tiny", "from-the-command-line"]
        instance.add_dynamic_partitions("datasets", ["tiny", "from-the-command-line"])
        context = dg.build_sensor_context(instance=instance, resources={"workbench": workbench(fresh)})
        assert "already" in register_datasets(context).skip_reason.skip_message


def schedule_tick(benchmark: TinyBenchmark, instance: dg.DagsterInstance):
    defs = benchmark.defs()
    schedule = defs.resolve_schedule_def("weekly_rebenchmark")
    context = dg.build_schedule_context(
        instance=instance, resources={"workbench": workbench(benchmark)}, repository_def=defs.get_repository_def()
    )
    return schedule.evaluate_tick(context)


def test_the_schedule_asks_for_what_is_stale_and_skips_when_nothing_is(fresh, finished):
    with open_instance(fresh.store.root) as instance:
        instance.add_dynamic_partitions("datasets", ["tiny"])
        requests = schedule_tick(fresh, instance).run_requests
        assert [r.partition_key for r in requests] == ["tiny"]
        assert dg.AssetKey(["mlp_k01", "trained_policy"]) in requests[0].asset_selection
    with open_instance(finished.store.root) as instance:
        tick = schedule_tick(finished, instance)
        assert not tick.run_requests
        assert "up to date" in tick.skip_message


def test_policies_that_must_be_named_are_not_in_the_jobs(fresh):
    raw = {
        **TINY,
        "policies": {**TINY["policies"], "notebook_pusht": {"method": "notebook_pusht", "only_when_named": True}},
    }
    benchmark = TinyBenchmark(fresh.folder, fresh.store, raw)
    job = benchmark.defs().resolve_job_def("benchmark")
    keys = {key.to_user_string() for key in job.asset_layer.executable_asset_keys}
    assert "mlp_k01/trained_policy" in keys
    assert not any("notebook_pusht" in key for key in keys)
    assert variants(benchmark.config.policies)

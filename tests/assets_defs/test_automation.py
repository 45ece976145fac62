"""What runs by itself."""

import dagster as dg
import pytest
from dagster._core.definitions.partitions.context import partition_loading_context

from assets_defs.automation import register_datasets
from assets_defs.definitions import build_defs
from assets_defs.launch import open_instance
from assets_defs.resources import Workbench
from pipeline.config import parse_config
from pipeline.experiment import variants
from pipeline.store import Store
from tests.assets_defs.conftest import TINY, TinyBenchmark
from tests.lerobot_format.hub_server import running_hub
from tests.makers import tiny_recording, write_v3


@pytest.fixture
def fresh(tiny_folder, tmp_path) -> TinyBenchmark:
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


@pytest.fixture
def on_hub(tmp_path, monkeypatch):
    """A benchmark of a data set on a local Hub, as a function that evaluates the sensor with a cursor; and the Hub."""
    with running_hub() as hub:
        for name, value in {"HF_ENDPOINT": hub.url, "HF_HUB_CACHE": str(tmp_path / "cache")}.items():
            monkeypatch.setenv(name, value)
        hub.push("owner/tiny", write_v3(tmp_path / "first", tiny_recording(6, 30)))
        config = parse_config(
            {"datasets": {"tiny": {"source": "hub:owner/tiny"}}, "policies": TINY["policies"]}, "test"
        )
        store = Store(tmp_path / "results").ensure()
        defs = build_defs(config, config_dir=tmp_path, store=store)

        def tick(cursor):
            with open_instance(store.root) as instance:
                instance.add_dynamic_partitions("datasets", ["tiny"])
                context = dg.build_sensor_context(
                    instance=instance, cursor=cursor, resources={"workbench": defs.resources["workbench"]},
                    repository_def=defs.get_repository_def(),
                )  # fmt: skip
                with partition_loading_context(dynamic_partitions_store=instance):
                    return defs.resolve_sensor_def("new_hub_revision").evaluate_tick(context)

        yield hub, tick


def test_a_revision_that_moves_asks_for_a_run_once(on_hub, tmp_path):
    hub, tick = on_hub
    first = tick(None)
    assert [(r.partition_key, r.run_key) for r in first.run_requests] == [
        ("tiny", f"tiny@{hub.repositories['owner/tiny'].refs['main']}")
    ]
    assert "no data set of the Hub has moved" in tick(first.cursor).skip_message
    commit = hub.push("owner/tiny", write_v3(tmp_path / "second", tiny_recording(6, 30, seed=1)))
    second = tick(first.cursor)
    assert [r.run_key for r in second.run_requests] == [f"tiny@{commit}"]
    assert dg.AssetKey(["demonstrations"]) in second.run_requests[0].asset_selection


def test_a_hub_out_of_reach_is_no_news(on_hub):
    hub, tick = on_hub
    hub.failure = 503
    assert "no data set of the Hub has moved" in tick(None).skip_message

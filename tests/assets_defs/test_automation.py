"""What runs by itself."""

import json
import re
import threading
import time
from datetime import UTC, datetime, timedelta
from itertools import takewhile

import dagster as dg
import pytest
from dagster._core.definitions.partitions.context import partition_loading_context
from dagster._utils.schedules import schedule_execution_time_iterator

from assets_defs.automation import _commits, register_datasets, run_failed
from assets_defs.benchmark import gate_words
from assets_defs.definitions import build_defs
from assets_defs.launch import open_instance, run_benchmark
from assets_defs.resources import Workbench
from pipeline.config import parse_config
from pipeline.errors import ConfigError
from pipeline.experiment import variants
from pipeline.lerobot_format.hub import fetch
from pipeline.notify import LOG, send
from pipeline.statistics.regression import FALSE_ALARMS_AT_MOST
from pipeline.store import Made, Store
from tests.assets_defs.conftest import TINY, TinyBenchmark
from tests.lerobot_format.hub_server import running_hub
from tests.makers import tiny_recording, write_v3
from tests.test_notify import listening

MONDAY = datetime(2026, 3, 2, 3, 0, tzinfo=UTC)


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


def schedule_tick(benchmark: TinyBenchmark, instance: dg.DagsterInstance, at: datetime = MONDAY):
    defs = benchmark.defs()
    schedule = defs.resolve_schedule_def("weekly_rebenchmark")
    context = dg.build_schedule_context(
        instance=instance, resources={"workbench": workbench(benchmark)}, repository_def=defs.get_repository_def(),
        scheduled_execution_time=at,
    )  # fmt: skip
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


def commit_of(hub) -> str:
    return hub.repositories["owner/tiny"].refs["main"]


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


def test_a_hub_out_of_reach_is_asked_again_and_the_cursor_is_kept(on_hub, tmp_path):
    hub, tick = on_hub
    hub.failure = 503
    silent = tick(None)
    assert not silent.run_requests
    assert silent.skip_message == (
        "no data set of the Hub has moved; asked again at the next tick, as the Hub did not say: tiny"
    )
    hub.failure = None
    first = tick(silent.cursor)
    assert [r.run_key for r in first.run_requests] == [f"tiny@{commit_of(hub)}"]
    hub.failure = 503
    assert tick(first.cursor).cursor == first.cursor
    hub.failure = None
    assert not tick(tick(first.cursor).cursor).run_requests, "it was asked for once"


def test_a_hub_out_of_reach_does_not_move_a_data_set_back_to_what_the_cache_holds(on_hub, tmp_path):
    hub, tick = on_hub
    fetch("owner/tiny")
    commit = hub.push("owner/tiny", write_v3(tmp_path / "second", tiny_recording(6, 30, seed=1)))
    moved = tick(None)
    assert [r.run_key for r in moved.run_requests] == [f"tiny@{commit}"]
    hub.failure = 503
    later = tick(moved.cursor)
    assert not later.run_requests
    assert later.cursor == moved.cursor


def test_a_data_set_that_the_hub_does_not_know_does_not_keep_the_others_from_theirs(on_hub, tmp_path):
    hub, _ = on_hub
    sources = {"gone": {"source": "hub:owner/gone"}, "tiny": {"source": "hub:owner/tiny"}}
    config = parse_config({"datasets": sources, "policies": TINY["policies"]}, "test")
    assert dict(_commits(config)) == {"gone": None, "tiny": commit_of(hub)}


def test_a_data_set_that_is_gone_does_not_keep_the_others_from_their_runs(fresh, tmp_path):
    fresh.raw = TINY | {"datasets": {"gone": {"source": str(tmp_path / "nowhere")}}}
    with fresh.store.publish(fresh.store.folder("gone", "demonstrations")) as draft:  # it was there once
        fresh.store.write_made(draft, Made("read then", summary={"asked": {}}))
    with open_instance(fresh.store.root) as instance:
        instance.add_dynamic_partitions("datasets", ["gone", "tiny"])
        requests = {r.partition_key: r for r in schedule_tick(fresh, instance, MONDAY).run_requests}
    assert set(requests) == {"gone", "tiny"}
    assert requests["tiny"].run_key == "tiny@2026-03-02T03:00Z"
    assert requests["gone"].asset_selection == [dg.AssetKey(["demonstrations"])], (
        "its run says what is wrong, and stops"
    )
    assert len(requests["tiny"].asset_selection) > 10


# When the clock says so ----------------------------------------------------------------------------------------------


def test_the_schedule_ticks_on_mondays_at_three_utc_and_runs_what_is_stale_then(fresh):
    with open_instance(fresh.store.root):
        schedule = fresh.defs().resolve_schedule_def("weekly_rebenchmark")
    since = datetime(2026, 2, 25, 12, 0, tzinfo=UTC)
    ticks = schedule_execution_time_iterator(
        since.timestamp(), schedule.cron_schedule, schedule.execution_timezone or "UTC"
    )
    assert [next(ticks).isoformat() for _ in range(3)] == [
        "2026-03-02T03:00:00+00:00", "2026-03-09T03:00:00+00:00", "2026-03-16T03:00:00+00:00",
    ]  # fmt: skip
    a_second = timedelta(seconds=1)
    for moment, due in ((MONDAY - a_second, MONDAY), (MONDAY + a_second, MONDAY + timedelta(days=7))):
        assert next(schedule_execution_time_iterator(moment.timestamp(), schedule.cron_schedule, "UTC")) == due
    with open_instance(fresh.store.root) as instance:
        assert "register_datasets makes them" in schedule_tick(fresh, instance, MONDAY).skip_message
        instance.add_dynamic_partitions("datasets", ["tiny"])
        (request,) = schedule_tick(fresh, instance, MONDAY).run_requests
    assert request.partition_key == "tiny"
    assert request.tags["dagster/schedule_name"] == "weekly_rebenchmark"


def test_another_time_is_a_setting(fresh):
    fresh.raw = TINY | {"schedule": {"cron": "30 1 * * *"}}
    with open_instance(fresh.store.root):
        assert fresh.defs().resolve_schedule_def("weekly_rebenchmark").cron_schedule == "30 1 * * *"
        specs = fresh.defs().resolve_assets_def(dg.AssetKey(["benchmark_table"])).check_specs
    (gate,) = [spec for spec in specs if spec.name == "champion_not_worse"]
    assert not gate.blocking
    assert gate.description == gate_words("30 1 * * *")


@pytest.mark.parametrize("cron", ["", "weekly", "0 3 * *", "0 0 3 * * 1", "0 24 * * *", "0 3 30 2 *", "@mondays"])
def test_a_cron_line_that_is_none_is_one_message(cron, tmp_path):
    config = parse_config({"schedule": {"cron": cron}}, "test")
    with pytest.raises(
        ConfigError, match=re.escape(f"[schedule] cron is '{cron}', which is no time. Write minute, hour")
    ):
        build_defs(config, config_dir=tmp_path)


@pytest.mark.parametrize(
    ("cron", "often"),
    [
        ("0 3 * * 1", "52 times"), ("30 1 * * *", "365 times"), ("0 3 1 * *", "12 times"), ("0 9-17 * * mon-fri", "2,347 times"),
        ("0 0 1 1 *", "once"), ("@yearly", "once"), ("0 3 29 2 *", "less than once"), ("@hourly", "8,766 times"),
    ],
)  # fmt: skip
def test_the_gate_says_how_many_false_alarms_a_year_a_schedule_means(cron, often):
    start, end = (datetime(year, 1, 1, tzinfo=UTC).timestamp() for year in (2020, 2024))
    ticks = sum(
        1 for _ in takewhile(lambda t: t.timestamp() < end, schedule_execution_time_iterator(start, cron, "UTC"))
    )
    assert f"At the schedule '{cron}', {often} a year, that is at most" in gate_words(cron)
    (said,) = re.findall(r"at most ([0-9.]+) false alarms a year", gate_words(cron))
    assert float(said) == pytest.approx(FALSE_ALARMS_AT_MOST * ticks / 4, abs=0.05 + 1e-9)


# A run that fails ----------------------------------------------------------------------------------------------------


@pytest.fixture
def failed(tmp_path, monkeypatch):
    """A benchmark whose data set cannot be read, its run, and a function that tells the sensor of it."""
    secret = tmp_path / "hf_abcdefghijklmnop"
    secret.mkdir()
    (secret / "note.txt").write_text("not a data set")
    told = tmp_path / "told.json"
    command = ["/bin/sh", "-c", 'cat >> "$0"', str(told)]
    benchmark = TinyBenchmark(secret, Store(tmp_path / "results").ensure(), TINY | {"notify": {"command": command}})
    benchmark.store.register("tiny", benchmark.target().experiment.model_dump(mode="json"))
    with open_instance(benchmark.store.root) as instance:
        defs = benchmark.defs()
        run = run_benchmark(instance, defs, "tiny", [dg.AssetKey(["demonstrations"])])
        assert not run.is_success

        def tell(said: TinyBenchmark = benchmark):
            event = [entry.dagster_event for entry in instance.all_logs(run.run_id) if entry.is_dagster_event][-1]
            context = dg.build_run_status_sensor_context(
                "run_failed", event, instance, run, resources={"workbench": workbench(said)}
            ).for_run_failure()
            run_failed(context)

        yield benchmark, run, tell, told


def wait_for_messages() -> None:
    """Messages are sent beside the tick."""
    for thread in [thread for thread in threading.enumerate() if thread.name.startswith("tell ")]:
        thread.join(60)
        assert not thread.is_alive()


def test_a_failed_run_is_one_line_and_one_message_without_a_token(failed):
    benchmark, run, tell, told = failed
    tell()
    wait_for_messages()
    (line,) = (benchmark.store.root / LOG).read_text(encoding="utf-8").splitlines()
    short = run.run_id[:8]
    assert re.match(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d UTC tiny failed: demonstrations: ", line)
    assert line.endswith(f"(run {short}; to see more: demobench ui, Runs, {short})")
    assert "***" in line
    assert "hf_abc" not in line
    said = json.loads(told.read_text())
    assert (said["event"], said["dataset"], said["run_id"]) == ("failure", "tiny", run.run_id)
    assert said["words"] in line
    assert "hf_abc" not in told.read_text()


def test_nobody_who_can_be_told_is_one_more_line(failed, monkeypatch):
    monkeypatch.setitem(send.__kwdefaults__, "pause_s", 0.0)
    benchmark, _, tell, _ = failed
    benchmark.raw = benchmark.raw | {"notify": {"command": ["/nowhere/tell"]}}
    tell(benchmark)
    wait_for_messages()
    lines = (benchmark.store.root / LOG).read_text(encoding="utf-8").splitlines()
    assert len(lines) == 2
    assert "the command tell was not told of the failure of tiny: it cannot be started" in lines[1]


def test_a_webhook_that_never_answers_does_not_hold_up_the_sensor(failed, monkeypatch):
    monkeypatch.setitem(send.__kwdefaults__, "timeout_s", 1.0)
    benchmark, run, tell, _ = failed
    with listening(stall_s=30) as (url, got):
        benchmark.raw = benchmark.raw | {"notify": {"webhook": url}}
        start = time.monotonic()
        tell(benchmark)
        assert time.monotonic() - start < 3 * 1.0, "less than three tries take"
        wait_for_messages()
    assert len(got) == 3
    lines = (benchmark.store.root / LOG).read_text(encoding="utf-8").splitlines()
    assert [run.run_id[:8] in line for line in lines] == [True, False]
    assert lines[1].endswith("was not told of the failure of tiny: no answer within 1 s, 3 tries")


def test_the_sensors_that_only_look_and_write_run_by_default(fresh):
    running = {s.name for s in fresh.defs().sensors if s.default_status == dg.DefaultSensorStatus.RUNNING}
    assert running == {"register_datasets", "run_failed", "say_what_is_out_of_date"}

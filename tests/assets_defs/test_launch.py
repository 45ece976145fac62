"""Runs started outside the UI: what the instance keeps of them."""

import os
import signal
import socket
import time
from datetime import UTC, datetime
from types import SimpleNamespace

import dagster as dg
import pytest
from dagster._core.test_utils import freeze_time

from assets_defs.launch import HOST_TAG, PID_TAG, START_S, close_dead_runs, open_instance, run_benchmark
from assets_defs.resources import Budget, Progress, _is_canceling
from pipeline.errors import ConfigError


def test_a_run_can_be_found_and_run_again_by_the_ui(finished):
    with open_instance(finished.store.root) as instance:
        run = instance.get_runs(limit=1)[0]
        assert run.status == dg.DagsterRunStatus.SUCCESS
        assert run.job_name == "benchmark"
        assert run.tags["dagster/partition"] == "tiny"
        assert run.remote_job_origin.location_name == "demobench"
        assert run.remote_job_origin.repository_origin.repository_name == "__repository__"
        assert instance.get_dynamic_partitions("datasets") == ["tiny"]


def test_an_interrupted_run_ends_as_canceled(finished):
    def stop(event: dg.DagsterEvent) -> None:
        if event.event_type_value == "STEP_START":
            signal.raise_signal(signal.SIGINT)

    with open_instance(finished.store.root) as instance:
        with pytest.raises(KeyboardInterrupt):
            run_benchmark(instance, finished.defs(), "tiny", [dg.AssetKey(["episode_split"])], on_event=stop)
        assert instance.get_runs(limit=1)[0].status == dg.DagsterRunStatus.CANCELED


def test_a_run_that_was_terminated_stops_though_the_signal_was_lost(finished):
    with open_instance(finished.store.root) as instance:
        job = finished.defs().resolve_job_def("benchmark")
        run = instance.create_run_for_job(job_def=job, status=dg.DagsterRunStatus.STARTED)
        context = SimpleNamespace(instance=instance, run=run)
        progress = Progress(lambda words: None, lambda: _is_canceling(context), every_s=0)
        progress("training", 1, 2)
        instance.report_run_canceling(run)
        with pytest.raises(dg.DagsterExecutionInterruptedError):
            progress("training", 2, 2)
        instance.report_run_canceled(instance.get_run_by_id(run.run_id))


def test_runs_whose_process_is_gone_are_closed_and_others_left(finished):
    with open_instance(finished.store.root) as instance:
        job = finished.defs().resolve_job_def("benchmark")
        here, before = {HOST_TAG: socket.gethostname()}, dg.DagsterRunStatus.STARTED
        asked = {
            "dead": {PID_TAG: str(2**22 + 1), **here},
            "alive": {PID_TAG: str(os.getpid()), **here},
            "elsewhere": {PID_TAG: str(2**22 + 1), HOST_TAG: "another-machine"},
            "nobody's": {},
        }
        runs = {}
        for name, tags in asked.items():
            tags = {**tags, "dagster/partition": "tiny"}
            runs[name] = instance.create_run_for_job(job_def=job, tags=tags, status=before)
        words = f"closed run {runs['dead'].run_id[:8]} of tiny: the process {2**22 + 1} that made it is gone"
        assert close_dead_runs(instance) == [words]
        assert instance.get_run_by_id(runs["dead"].run_id).status == dg.DagsterRunStatus.FAILURE
        assert {instance.get_run_by_id(runs[name].run_id).status for name in list(asked)[1:]} == {before}
        for name in list(asked)[1:]:
            instance.report_run_failed(runs[name])


def test_a_run_that_never_got_a_process_or_whose_process_left_its_number_to_another_is_closed(finished):
    with open_instance(finished.store.root) as instance:
        job = finished.defs().resolve_job_def("benchmark")
        tags = {"dagster/partition": "tiny"}
        waiting = instance.create_run_for_job(job_def=job, tags=tags, status=dg.DagsterRunStatus.STARTING)
        assert close_dead_runs(instance) == []
        (words,) = close_dead_runs(instance, lambda: time.time() + START_S + 60)
        assert words == f"closed run {waiting.run_id[:8]} of tiny: it was started and never got a process"
        tags |= {PID_TAG: str(os.getpid()), HOST_TAG: socket.gethostname()}
        with freeze_time(datetime(2026, 1, 1, tzinfo=UTC)):
            old = instance.create_run_for_job(job_def=job, tags=tags, status=dg.DagsterRunStatus.STARTED)
        (words,) = close_dead_runs(instance)
        assert words.startswith(f"closed run {old.run_id[:8]} of tiny: the process {os.getpid()}")


def test_a_run_that_is_made_again_is_not_closed_for_the_process_of_the_first_one(finished):
    with open_instance(finished.store.root) as instance:
        job, under_way = finished.defs().resolve_job_def("benchmark"), dg.DagsterRunStatus.STARTED
        tags = {PID_TAG: str(2**22 + 1), HOST_TAG: socket.gethostname(), "dagster/partition": "tiny"}
        first = instance.create_run_for_job(job_def=job, tags=tags, status=dg.DagsterRunStatus.SUCCESS)
        tags["dagster/parent_run_id"] = first.run_id
        second = instance.create_run_for_job(job_def=job, tags=tags, status=under_way)
        assert close_dead_runs(instance) == []
        assert instance.get_run_by_id(second.run_id).status == under_way
        instance.add_run_tags(second.run_id, {PID_TAG: str(2**22 + 2)})
        (words,) = close_dead_runs(instance)
        assert words.startswith(f"closed run {second.run_id[:8]} of tiny: the process {2**22 + 2}")


def test_another_budget_in_the_launchpad_is_the_command_lines_variant(finished):
    workbench = finished.defs().resources["workbench"]
    context = dg.build_asset_context(partition_key="tiny")
    assert workbench.open(context, Budget()).plan.key == "tiny"
    assert workbench.open(context, Budget(seeds=2, steps=6)).plan.key == "tiny", "the file's own numbers change nothing"
    opened = workbench.open(context, Budget(seeds=1))
    assert opened.plan.key == finished.target(seeds=1).key != "tiny"
    assert opened.experiment.seeds == 1
    assert finished.store.experiments()[opened.plan.key]["seeds"] == 1
    with pytest.raises(ConfigError, match="no observation set 'stat'"):
        workbench.open(context, Budget(observations=["stat"]))


def test_a_run_says_who_makes_it_and_where_its_results_are_seen(finished):
    with open_instance(finished.store.root) as instance:
        run = next(run for run in instance.get_runs() if "demobench/report" in run.tags)
        table = instance.get_latest_materialization_event(dg.AssetKey(["benchmark_table"])).asset_materialization
    assert run.tags[PID_TAG] == str(os.getpid())
    assert run.tags["demobench/report"] == "http://127.0.0.1:3001/tiny/benchmark_report/report.html"
    assert run.tags["demobench/history"] == "http://127.0.0.1:3001/tiny/benchmark_history/history.html"
    assert run.tags["demobench/mlflow"].startswith("http://127.0.0.1:5000/#/experiments/")
    assert run.tags["demobench/mlflow"].endswith("/runs?viewStateShareKey=demobench&compareRunsMode=CHART")
    assert {name: table.metadata[name].value for name in ("report", "mlflow")} == {
        name: run.tags[f"demobench/{name}"] for name in ("report", "mlflow")
    }

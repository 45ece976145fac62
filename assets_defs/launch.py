"""Starting runs from outside the UI, so that the UI shows them and can run them again.

The one file that touches Dagster's internals (`dagster._core`); a test runs it against the installed version.
What belongs here: the instance in the results folder, creating and executing a run, closing runs that died.
"""

import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import dagster as dg
import psutil
from dagster._core.definitions.job_base import InMemoryJob
from dagster._core.errors import DagsterExecutionInterruptedError
from dagster._core.execution.api import execute_run_iterator
from dagster._core.instance.ref import InstanceRef
from dagster._core.remote_origin import (
    ManagedGrpcPythonEnvCodeLocationOrigin,
    RemoteJobOrigin,
    RemoteRepositoryOrigin,
)
from dagster._core.types.loadable_target_origin import LoadableTargetOrigin

from assets_defs.automation import BENCHMARK
from assets_defs.data import PARTITIONS
from assets_defs.definitions import LOCATION
from assets_defs.resources import HOST_TAG, PID_TAG

MODULE = "assets_defs.definitions"
START_S = 600
"""Longer than Dagster takes to start a run's process, on a busy machine, too."""

INSTANCE_SETTINGS = """\
# Written by demobench; delete it to get the defaults back.
telemetry:
  enabled: false
nux:
  enabled: false
concurrency:
  runs:
    # One run a data set at a time: two would write the same folders.
    tag_concurrency_limits:
      - key: dagster/partition
        limit: 1
        value:
          applyLimitPerUniqueValue: true
"""


def prepare_home(store_root: Path) -> Path:
    """The Dagster home inside the results folder, with its settings."""
    home = store_root / "dagster"
    home.mkdir(parents=True, exist_ok=True)
    settings = home / "dagster.yaml"
    if not settings.exists():
        settings.write_text(INSTANCE_SETTINGS, encoding="utf-8")
    return home


@contextmanager
def open_instance(store_root: Path) -> Iterator[dg.DagsterInstance]:
    """The persistent instance of a results folder."""
    with dg.DagsterInstance.from_ref(InstanceRef.from_dir(str(prepare_home(store_root)))) as instance:
        yield instance


def close_dead_runs(instance: dg.DagsterInstance, clock: Callable[[], float] = time.time) -> list[str]:
    """Runs of this machine whose process is gone are marked as failed; returns what to say of each.

    A run that waits for its process longer than any start takes never gets one: whoever started it was stopped.
    """
    under_way = [dg.DagsterRunStatus.STARTING, dg.DagsterRunStatus.STARTED, dg.DagsterRunStatus.CANCELING]
    words = []
    for record in instance.get_run_records(dg.RunsFilter(statuses=under_way)):
        why = _why_dead(instance, record, clock())
        if why is not None:
            run = record.dagster_run
            instance.report_run_failed(run, message=f"{why[0].upper()}{why[1:]}.")
            words.append(f"closed run {run.run_id[:8]} of {run.tags.get('dagster/partition', 'no data set')}: {why}")
    return words


def _why_dead(instance: dg.DagsterInstance, record: dg.RunRecord, now_s: float) -> str | None:
    """Why a run that is under way will never end; None where its process is there, or nobody here can tell."""
    tags = record.dagster_run.tags
    if HOST_TAG not in tags or _is_parents(instance, tags):
        waited_s = now_s - record.update_timestamp.timestamp()
        return "it was started and never got a process" if waited_s > START_S else None
    started_s = record.start_time or record.create_timestamp.timestamp()
    if tags[HOST_TAG] != socket.gethostname() or _runs(int(tags[PID_TAG]), started_s):
        return None
    return f"the process {tags[PID_TAG]} that made it is gone"


def _is_parents(instance: dg.DagsterInstance, tags: Mapping[str, str]) -> bool:
    """Whether the process that a run names is that of the run which it repeats: it brings the tags along, until it has its own."""
    parent = instance.get_run_by_id(tags["dagster/parent_run_id"]) if "dagster/parent_run_id" in tags else None
    return parent is not None and parent.tags.get(PID_TAG) == tags[PID_TAG]


def _runs(pid: int, started_s: float) -> bool:
    """Whether the process that made a run is there; a younger one got its number after it."""
    try:
        return psutil.Process(pid).create_time() < started_s + 60
    except psutil.NoSuchProcess:
        return False


class Interrupts:
    """Ctrl-C that cannot be lost.

    Python drops an exception that a signal raises inside a garbage-collection callback, which a long training runs into
    sooner or later. The signal's number is kept in a pipe, and `check`, called between two pieces of work, raises again.
    """

    def __enter__(self) -> "Interrupts":
        self._read, self._write = os.pipe()
        os.set_blocking(self._read, False)
        os.set_blocking(self._write, False)
        self._before = signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
        self._hook, sys.unraisablehook = sys.unraisablehook, self._unraisable
        return self

    def __exit__(self, *_: object) -> None:
        sys.unraisablehook = self._hook
        signal.set_wakeup_fd(self._before)
        os.close(self._read)
        os.close(self._write)

    def _unraisable(self, dropped: Any) -> None:
        if dropped.exc_type not in (DagsterExecutionInterruptedError, KeyboardInterrupt):
            self._hook(dropped)

    def check(self) -> None:
        """Raise DagsterExecutionInterruptedError where Ctrl-C came since the last check."""
        try:
            received = os.read(self._read, 4096)
        except BlockingIOError:
            return
        if signal.SIGINT in received:
            raise DagsterExecutionInterruptedError


def run_benchmark(
    instance: dg.DagsterInstance,
    defs: dg.Definitions,
    partition: str,
    assets: Sequence[dg.AssetKey],
    observations: Sequence[str] = (),
    policies: Sequence[str] = (),
    on_event: Callable[[dg.DagsterEvent], None] | None = None,
    *,
    job_name: str = BENCHMARK,
    ops: Mapping[str, Any] | None = None,
) -> dg.DagsterRun:
    """Run the selected assets of one partition in this process; returns the finished run.

    `observations` and `policies` are what was asked for, where that is not everything; `ops` the settings of single assets.
    `on_event` sees every Dagster event as it happens. Ctrl-C ends the run as CANCELED and is raised again.
    """
    instance.add_dynamic_partitions(str(PARTITIONS.name), [partition])
    selection = set(assets)
    job = defs.resolve_job_def(job_name).get_subset(asset_selection=selection)
    run_config: dict[str, Any] = {"loggers": {"console": {"config": {"log_level": "CRITICAL"}}}}
    if ops:
        run_config["ops"] = {name: {"config": dict(settings)} for name, settings in ops.items()}
    asked = {"observations": list(observations), "policies": list(policies)}
    run_config["resources"] = {"budget": {"config": {name: value for name, value in asked.items() if value}}}
    run = instance.create_run_for_job(
        job_def=job,
        run_config=run_config,
        asset_selection=frozenset(selection),
        tags={
            "dagster/partition": partition,
            PID_TAG: str(os.getpid()),
            HOST_TAG: socket.gethostname(),
        },
        remote_job_origin=_job_origin(job_name),
        job_code_origin=None,
    )
    interrupted = False
    try:
        for event in execute_run_iterator(InMemoryJob(job), run, instance):
            interrupted = interrupted or _is_interrupt(event)
            if on_event:
                on_event(event)
    except (KeyboardInterrupt, DagsterExecutionInterruptedError):
        interrupted = True
    finished = instance.get_run_by_id(run.run_id)
    if interrupted:
        instance.report_run_canceling(finished)
        instance.report_run_canceled(finished)
        raise KeyboardInterrupt
    return finished


def _is_interrupt(event: dg.DagsterEvent) -> bool:
    data = event.event_specific_data
    error = getattr(data, "error", None)
    while error is not None:
        if error.cls_name in ("DagsterExecutionInterruptedError", "KeyboardInterrupt"):
            return True
        error = error.cause
    return False


def _job_origin(job_name: str) -> RemoteJobOrigin:
    """Where the UI finds this job: the same module and location name as in workspace.yaml."""
    target = LoadableTargetOrigin(executable_path=sys.executable, module_name=MODULE, working_directory=str(Path.cwd()))
    location = ManagedGrpcPythonEnvCodeLocationOrigin(target, LOCATION)
    return RemoteJobOrigin(RemoteRepositoryOrigin(location, "__repository__"), job_name)

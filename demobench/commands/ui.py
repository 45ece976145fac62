"""`demobench ui`: Dagster and MLflow as two child processes on 127.0.0.1, the store's files beside them; stopped together."""

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from rich.console import Console

from assets_defs.links import HOST, Served, remember_served
from demobench.commands.files import FileServer
from demobench.commands.session import Session, open_session, tell_mlflow
from pipeline.errors import DemobenchError
from pipeline.sinks.to_mlflow import tracking_uri, without_secret

LOOK_S = 30
"""How often runs are looked for whose process is gone."""


def serve(port: int, mlflow_port: int, files_port: int, config_path: Path | None, store_path: str | None) -> None:
    """Start the servers and wait; Ctrl-C or SIGTERM stops them.

    Raises:
        DemobenchError: a port is in use, a server ended by itself, or the schedule's cron line is none.
    """
    from assets_defs.automation import check_cron

    session = open_session(config_path, store_path)
    check_cron(session.config)
    session.store.ensure()
    sqlite = session.config.tracking.mlflow == "sqlite"
    wanted = {"--port": port, "--files-port": files_port} | ({"--mlflow-port": mlflow_port} if sqlite else {})
    for option, number in wanted.items():
        _check_free(number, option)
    if len(set(wanted.values())) < len(wanted):
        raise DemobenchError(f"Every server needs a port of its own: {', '.join(wanted)} are not all different.")
    _close_dead_runs(session)
    remember_served(session.store, Served(f"http://{HOST}:{files_port}", f"http://{HOST}:{mlflow_port}"))
    # Set before the servers start: a signal that a shell told us to ignore would be ignored by them too.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    tell_mlflow(session)
    with tempfile.TemporaryDirectory(prefix="demobench-") as scratch, FileServer(session.store, files_port):
        processes = {"Dagster": _dagster(session, port, Path(scratch), config_path)}
        if sqlite:
            processes["MLflow"] = _mlflow(session, mlflow_port)
        try:
            mlflow = f"http://{HOST}:{mlflow_port}" if sqlite else session.config.tracking.mlflow
            _announce(session.console, f"http://{HOST}:{port}", mlflow, f"http://{HOST}:{files_port}")
            _wait(processes, lambda: _close_dead_runs(session))
        except KeyboardInterrupt:
            session.console.print("stopped")
        finally:
            _stop(list(processes.values()))


def _check_free(port: int, option: str) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            raise DemobenchError(
                f"Port {port} on {HOST} cannot be used: {error.strerror}. Choose another with {option}."
            ) from None


def _close_dead_runs(session: Session) -> None:
    from assets_defs.launch import close_dead_runs, open_instance

    with open_instance(session.store.root) as instance:
        for words in close_dead_runs(instance):
            session.console.print(words, soft_wrap=True)


def _dagster(session: Session, port: int, scratch: Path, config_path: Path | None) -> subprocess.Popen:
    from assets_defs.launch import prepare_home

    workspace = scratch / "workspace.yaml"
    workspace.write_text(
        "load_from:\n  - python_module:\n      module_name: assets_defs.definitions\n      location_name: demobench\n"
    )
    environment = {
        "DAGSTER_HOME": str(prepare_home(session.store.root)),
        "DEMOBENCH_STORE": str(session.store.root),
        # dagster dev still works and needs no project file; its own advice to move on is not the reader's concern.
        "PYTHONWARNINGS": "ignore",
    }
    if config_path is not None:
        environment["DEMOBENCH_CONFIG"] = str(config_path.absolute())
    command = [sys.executable, "-m", "dagster", "dev", "-w", str(workspace), "-h", HOST, "-p", str(port)]
    return _start(command, environment)


def _mlflow(session: Session, port: int) -> subprocess.Popen:
    command = [sys.executable, "-m", "mlflow", "server", "--host", HOST, "--port", str(port), "--workers", "1",
               "--backend-store-uri", tracking_uri("sqlite", session.store.root),
               "--default-artifact-root", (session.store.root / "mlartifacts").as_uri()]  # fmt: skip
    return _start(command, {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false", "MLFLOW_DISABLE_TELEMETRY": "true"})


def _start(command: list[str], environment: Mapping[str, str]) -> subprocess.Popen:
    # A group of its own, so that stopping it reaches the server's children; the terminal's Ctrl-C comes to us alone.
    return subprocess.Popen(
        command,
        env={**os.environ, **environment},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def _announce(console: Console, dagster: str, mlflow: str, files: str) -> None:
    console.print(f"Dagster  {dagster}   (ready in about 15 s)")
    console.print(f"MLflow   {without_secret(mlflow)}")
    console.print(f"Reports  {files}")
    console.print("Ctrl-C stops all.")


def _wait(processes: Mapping[str, subprocess.Popen], look: Callable[[], None]) -> None:
    """Until a server ends. Every `LOOK_S` a `look` at what else may have ended: a killed run keeps its data set from the next."""
    looked = time.monotonic()
    while True:
        for name, process in processes.items():
            if process.poll() is not None:
                raise DemobenchError(
                    f"{name} ended by itself with status {process.returncode}. Try its command alone to see why: "
                    f"{' '.join(process.args)}"
                )
        if time.monotonic() - looked > LOOK_S:
            look()
            looked = time.monotonic()
        time.sleep(0.5)


def _stop(processes: list[subprocess.Popen]) -> None:
    for process in processes:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGINT)
    for process in processes:
        try:
            process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)

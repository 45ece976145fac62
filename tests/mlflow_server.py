"""A real MLflow server on the loopback, which can be stopped and started again over the same database."""

import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

HOST = "127.0.0.1"


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return probe.getsockname()[1]


class MlflowServer:
    """Its own process; `backend` is where it keeps runs, a file of the folder by default."""

    def __init__(self, folder: Path, backend: str | None = None):
        self.folder, self.port = folder, free_port()
        self.backend = backend or f"sqlite:///{folder / 'server.db'}"
        self.process: subprocess.Popen | None = None

    @property
    def address(self) -> str:
        return f"http://{HOST}:{self.port}"

    def start(self, environment: dict[str, str] | None = None) -> "MlflowServer":
        command = [sys.executable, "-W", "ignore", "-m", "mlflow", "server", "--host", HOST, "--port", str(self.port),
                   "--workers", "1", "--backend-store-uri", self.backend,
                   "--artifacts-destination", str(self.folder / "artifacts")]  # fmt: skip
        quiet = {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false", "MLFLOW_DISABLE_TELEMETRY": "true"}
        with (self.folder / "server.log").open("ab") as log:
            self.process = subprocess.Popen(
                command,
                env={**os.environ, **quiet, **(environment or {})},
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        end = time.monotonic() + 400
        while time.monotonic() < end:
            assert self.process.poll() is None, (self.folder / "server.log").read_text()[-2000:]
            try:
                if urllib.request.urlopen(f"{self.address}/health", timeout=5).status == 200:
                    return self
            except OSError:
                time.sleep(0.2)
        raise AssertionError("the server did not answer")

    def stop(self) -> None:
        if self.process is not None and self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait(timeout=30)

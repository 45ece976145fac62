"""`demobench ui` as people meet it: real servers on loopback, looked at with a real Chromium."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest

from tests.makers import tiny_recording, write_v3

pytestmark = pytest.mark.slow

CHROMIUM = shutil.which("chromium")
CONFIG = """
[benchmark]
seeds = 1
steps = 4
folds = 1
threads = 1
[datasets.tape]
source = "tape"
[policies.mlp]
method = "mlp"
chunks = [1]
"""
REEXECUTE = """
mutation Again($parent: String!) {
  launchRunReexecution(reexecutionParams: {parentRunId: $parent, strategy: ALL_STEPS}) {
    __typename
    ... on LaunchRunSuccess { run { runId } }
    ... on PythonError { message }
  }
}"""


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def wait_for(question, seconds: float):
    """Ask until there is an answer; a server that is not up yet says nothing."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        try:
            if answer := question():
                return answer
        except OSError:
            pass
        time.sleep(0.5)
    pytest.fail(f"no answer within {seconds} s")


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    """A finished run of the command line, and both servers over its store."""
    place = tmp_path_factory.mktemp("user")
    write_v3(place / "tape", tiny_recording(episodes=6, frames=40))
    (place / "demobench.toml").write_text(CONFIG)
    environment = {**os.environ, "NO_COLOR": "1"}
    command = [sys.executable, "-m", "demobench.cli"]
    subprocess.run([*command, "run"], cwd=place, env=environment, check=True, timeout=300, capture_output=True)
    port, mlflow_port = free_port(), free_port()
    ports = ["--port", str(port), "--mlflow-port", str(mlflow_port)]
    process = subprocess.Popen([*command, "ui", *ports], cwd=place, env=environment, stdout=subprocess.PIPE, text=True)
    dagster, mlflow = f"http://127.0.0.1:{port}", f"http://127.0.0.1:{mlflow_port}"
    try:
        wait_for(lambda: urllib.request.urlopen(f"{dagster}/server_info", timeout=5).status == 200, 120)
        wait_for(lambda: urllib.request.urlopen(f"{mlflow}/health", timeout=5).status == 200, 120)
        yield place, dagster, mlflow
    finally:
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=60)
    assert "stopped" in out
    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.1", port)) != 0, "Dagster is still there after Ctrl-C"


def graphql(address: str, query: str, **variables) -> dict:
    body = json.dumps({"query": query, "variables": variables}).encode()
    request = urllib.request.Request(f"{address}/graphql", body, {"Content-Type": "application/json"})
    with urllib.request.urlopen(request, timeout=60) as answer:
        return json.load(answer)["data"]


def runs(address: str) -> list[dict]:
    query = "{runsOrError {... on Runs {results {runId status parentRunId}}}}"
    return graphql(address, query)["runsOrError"]["results"]


def test_the_ui_runs_the_command_lines_run_again(served):
    place, dagster, _ = served
    (first,) = runs(dagster)
    assert first["status"] == "SUCCESS"
    before = {p: p.read_text() for p in (place / "results" / "datasets").rglob("made.json")}
    answer = graphql(dagster, REEXECUTE, parent=first["runId"])["launchRunReexecution"]
    assert answer["__typename"] == "LaunchRunSuccess", answer
    again = answer["run"]["runId"]
    done = wait_for(
        lambda: [r for r in runs(dagster) if r["runId"] == again and r["status"] in ("SUCCESS", "FAILURE")], 240
    )
    assert done[0]["status"] == "SUCCESS"
    after = {p: p.read_text() for p in (place / "results" / "datasets").rglob("made.json")}
    assert after == before, "nothing was stale, so the second run made nothing again"


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine (Debian: apt-get install chromium)")
def test_chromium_sees_the_graph_the_run_and_mlflow(served, tmp_path):
    from playwright.sync_api import sync_playwright

    _, dagster, mlflow = served
    errors: list[str] = []
    with sync_playwright() as play:
        flags = ["--no-sandbox", "--disable-background-networking", "--disable-component-update", "--disable-sync"]
        browser = play.chromium.launch(executable_path=CHROMIUM, args=flags)
        page = browser.new_page(viewport={"width": 1600, "height": 1000})
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        page.goto(f"{dagster}/asset-groups")
        page.get_by_text("mlp_k01").first.wait_for(timeout=60_000)
        page.get_by_text("benchmark").first.wait_for(timeout=60_000)
        page.goto(f"{dagster}/runs")
        page.get_by_text("tape").first.wait_for(timeout=60_000)
        page.get_by_text("Success").first.wait_for(timeout=60_000)
        page.goto(f"{dagster}/assets/benchmark_table?partition=tape")
        page.get_by_text("first_step_mae_hold_still_state").first.wait_for(timeout=60_000)
        page.goto(f"{mlflow}/#/experiments")
        page.get_by_text("tape").first.wait_for(timeout=60_000)
        browser.close()
    assert not [e for e in errors if dagster in e]


def test_a_port_in_use_is_one_message(served):
    place, dagster, _ = served
    port = dagster.rsplit(":", 1)[1]
    words = [sys.executable, "-m", "demobench.cli", "ui", "--port", port]
    out = subprocess.run(words, cwd=place, capture_output=True, text=True, timeout=60, check=False)
    assert out.returncode == 2
    assert f"Port {port} on 127.0.0.1 cannot be used" in " ".join(out.stderr.split())
    assert Path(place / "results").is_dir()

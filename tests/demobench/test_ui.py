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
[datasets.film]
source = "film"
[policies.mlp]
method = "mlp"
chunks = [1]
"""
PATIENCE_MS = 120_000
ENDED = ("SUCCESS", "FAILURE", "CANCELED")
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
    write_v3(place / "film", tiny_recording(episodes=6, frames=40, seed=1))
    (place / "demobench.toml").write_text(CONFIG)
    environment = {**os.environ, "NO_COLOR": "1"}
    command = [sys.executable, "-m", "demobench.cli"]
    subprocess.run([*command, "run", "tape"], cwd=place, env=environment, check=True, timeout=300, capture_output=True)
    port, mlflow_port, files_port = free_port(), free_port(), free_port()
    ports = ["--port", str(port), "--mlflow-port", str(mlflow_port), "--files-port", str(files_port)]
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
    """All runs, the newest first, with the data set and the links that their tags name."""
    query = "{runsOrError {... on Runs {results {runId status parentRunId tags {key value}}}}}"
    found = graphql(address, query)["runsOrError"]["results"]
    return [
        run
        | {"tags": (tags := {t["key"]: t["value"] for t in run["tags"]}), "partition": tags.get("dagster/partition")}
        for run in found
    ]


def partitions(address: str) -> list[str]:
    query = '{assetNodeOrError(assetKey: {path: ["demonstrations"]}) {... on AssetNode {partitionKeys}}}'
    return graphql(address, query)["assetNodeOrError"]["partitionKeys"]


def test_the_ui_runs_the_command_lines_run_again(served):
    place, dagster, _ = served
    first = runs(dagster)[-1]
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


TICKS = """
{
  sensorsOrError(repositorySelector: {repositoryName: "__repository__", repositoryLocationName: "demobench"}) {
    ... on Sensors { results { name sensorState { ticks(limit: 1) { status } } } }
  }
}"""


def has_ticked(address: str, sensor: str) -> bool:
    found = graphql(address, TICKS)["sensorsOrError"].get("results", [])
    return any(one["name"] == sensor and one["sensorState"]["ticks"] for one in found)


def test_a_run_of_the_command_line_that_fails_is_a_line_in_the_log(served):
    place, dagster, _ = served
    broken = write_v3(place / "broken", tiny_recording(episodes=6, frames=40))
    (data,) = broken.glob("data/*/*.parquet")
    data.write_bytes(data.read_bytes()[:200])
    wait_for(lambda: has_ticked(dagster, "run_failed"), 120)  # what failed before its first tick it does not tell
    command = [sys.executable, "-m", "demobench.cli", "run", "broken"]
    assert subprocess.run(command, cwd=place, capture_output=True, timeout=300, check=False).returncode == 2
    log = place / "results" / "automation.log"
    wait_for(log.exists, 120)
    (failed,) = [run for run in runs(dagster) if run["partition"] == "broken"]
    (line,) = log.read_text(encoding="utf-8").splitlines()
    assert f" UTC broken failed: demonstrations: {data} cannot be read as parquet" in line
    assert line.endswith(f"(run {failed['runId'][:8]}; to see more: demobench ui, Runs, {failed['runId'][:8]})")


@pytest.fixture(scope="module")
def window():
    """A page of a real browser, and what any page that it opened complained about."""
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine (Debian: apt-get install chromium)")
    from playwright.sync_api import sync_playwright

    complaints: list[str] = []

    def listen(page) -> None:
        page.on(
            "console",
            lambda said: complaints.append(f"{said.text} {said.location['url']}") if said.type == "error" else None,
        )
        page.on("pageerror", lambda error: complaints.append(str(error)))

    with sync_playwright() as play:
        flags = ["--no-sandbox", "--disable-background-networking", "--disable-component-update", "--disable-sync"]
        browser = play.chromium.launch(executable_path=CHROMIUM, args=flags, timeout=PATIENCE_MS)
        context = browser.new_context(viewport={"width": 1600, "height": 1000})
        context.set_default_timeout(PATIENCE_MS)
        context.on("page", listen)
        yield context.new_page(), complaints
        browser.close()


def test_a_whole_graph_is_made_from_the_ui_and_leads_to_its_report_and_to_mlflow(served, window):
    place, dagster, mlflow = served
    page, complaints = window
    page.goto(f"{dagster}/asset-groups")
    for group in ("data", "floor", "mlp_k01", "benchmark", "looking"):
        page.get_by_text(group, exact=True).first.wait_for()

    wait_for(
        lambda: "film" in partitions(dagster), 120
    )  # a sensor makes it known; the list in the page does not wait for it
    launch(page, dagster, "film")
    made = wait_for(lambda: [r for r in runs(dagster) if r["partition"] == "film" and r["status"] in ENDED], 500)
    assert [run["status"] for run in made] == ["SUCCESS"]
    table = json.loads((place / "results" / "datasets" / "film" / "benchmark_table" / "table.json").read_text())

    page.goto(f"{dagster}/assets/benchmark_table?partition=film")
    still = next(row["first_step_mae"] for row in table["policies"] if row["policy"] == "hold_still")
    page.get_by_text("mae_hold_still_state").first.wait_for()
    page.get_by_text(f"{still:.4g}", exact=True).first.wait_for()

    with page.expect_popup() as opened:
        page.get_by_role("link", name="/film/benchmark_report/report.html").first.click()
    opened.value.get_by_role("heading", name="film", exact=True).wait_for()
    opened.value.locator("[data-chart] svg").first.wait_for()
    with page.expect_popup() as opened:
        page.get_by_role("link", name=f"{mlflow}/#/experiments/").first.click()
    opened.value.get_by_text("mlp_k01/state").first.wait_for()

    page.goto(f"{dagster}/assets/mlp_k01/trained_policy?partition=film")
    with page.expect_popup() as opened:
        page.get_by_role("link", name=f"{mlflow}/#/runs/").first.click()
    opened.value.get_by_text("mlp_k01/state").first.wait_for()
    # MLflow's page asks its own server who is logged in, which a server without users does not know.
    assert not [said for said in complaints if not said.endswith("/ajax-api/2.0/mlflow/users/current")]


def launch(page, dagster: str, partition: str) -> None:
    """Start the job `benchmark` for one data set with the mouse, as people do."""
    page.goto(f"{dagster}/locations/demobench/jobs/benchmark")
    page.get_by_role("button", name="Materialize all").first.click()
    page.get_by_role("button", name="Confirm").click()  # what must be named (learning_curve, …) is not there
    page.get_by_text("Select a partition or create one").first.click()
    page.get_by_text(partition, exact=True).locator("visible=true").last.click()
    page.get_by_text("Launch runs to materialize").click()  # closes the list
    page.get_by_role("button", name="Launch 1 run").click()


@pytest.mark.parametrize("option", ["--port", "--files-port", "--mlflow-port"])
def test_a_port_in_use_is_one_message(served, option):
    place, dagster, _ = served
    port = dagster.rsplit(":", 1)[1]
    words = [sys.executable, "-m", "demobench.cli", "ui", option, port]
    out = subprocess.run(words, cwd=place, capture_output=True, text=True, timeout=60, check=False)
    assert out.returncode == 2
    said = " ".join(out.stderr.split())
    assert said.startswith(f"error: Port {port} on 127.0.0.1 cannot be used")
    assert said.endswith(f"Choose another with {option}.")


def test_two_servers_on_one_port_is_one_message(tmp_path):
    port = str(free_port())
    words = [sys.executable, "-m", "demobench.cli", "ui", "--port", port, "--files-port", port]
    out = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False)
    assert out.returncode == 2
    assert "Every server needs a port of its own" in " ".join(out.stderr.split())

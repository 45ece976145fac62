"""`demobench ui` as people meet it: real servers on loopback, looked at with a real Chromium."""

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request

import pytest

from assets_defs.plan import Plan
from demobench.commands.session import known_target, open_session
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
MANY_STEPS = 400_000
LAUNCH = """
mutation Launch($asked: ExecutionParams!) {
  launchRun(executionParams: $asked) {
    __typename
    ... on LaunchRunSuccess { run { runId } }
    ... on PythonError { message }
  }
}"""
TERMINATE = """
mutation Stop($id: String!) {
  terminateRun(runId: $id, terminatePolicy: SAFE_TERMINATE) {
    __typename
    ... on TerminateRunFailure { message }
    ... on PythonError { message }
  }
}"""
BACKFILL = """
mutation Backfill($asked: LaunchBackfillParams!) {
  launchPartitionBackfill(backfillParams: $asked) {
    __typename
    ... on LaunchBackfillSuccess { backfillId }
    ... on PythonError { message }
  }
}"""
BACKFILL_STATUS = """
query Status($id: String!) {
  partitionBackfillOrError(backfillId: $id) {
    ... on PartitionBackfill {
      status
      assetBackfillData {
        assetBackfillStatuses {
          ... on AssetPartitionsStatusCounts { assetKey { path } numPartitionsMaterialized }
        }
      }
    }
  }
}"""
CHECKS = """
{
  assetNodeOrError(assetKey: {path: ["benchmark_table"]}) {
    ... on AssetNode {
      assetChecksOrError {
        ... on AssetChecks {
          checks {
            name
            executionForLatestMaterialization {
              evaluation {
                success
                metadataEntries { label ... on TextMetadataEntry { text } ... on MarkdownMetadataEntry { mdStr } }
              }
            }
          }
        }
      }
    }
  }
}"""
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
    write_v3(place / "more" / "side", tiny_recording(episodes=6, frames=40, seed=2))
    (place / "demobench.toml").write_text(CONFIG)
    environment = {**os.environ, "NO_COLOR": "1"}
    command = [sys.executable, "-m", "demobench.cli"]
    # One that the file names, and a folder that it does not.
    run = [*command, "run", "tape", "more/side", "--policies", "mlp"]
    subprocess.run(run, cwd=place, env=environment, check=True, timeout=500, capture_output=True)
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
    query = "{runsOrError {... on Runs {results {runId status tags {key value} stepStats {stepKey status}}}}}"
    found = graphql(address, query)["runsOrError"]["results"]
    return [
        run
        | {"tags": (tags := {t["key"]: t["value"] for t in run["tags"]}), "partition": tags.get("dagster/partition")}
        for run in found
    ]


def partitions(address: str) -> list[str]:
    query = '{assetNodeOrError(assetKey: {path: ["demonstrations"]}) {... on AssetNode {partitionKeys}}}'
    return graphql(address, query)["assetNodeOrError"]["partitionKeys"]


def ended(address: str, run_id: str, seconds: float = 240) -> str:
    """How a run ended."""
    found = wait_for(lambda: [r for r in runs(address) if r["runId"] == run_id and r["status"] in ENDED], seconds)
    return found[0]["status"]


def again(address: str, run_id: str) -> str:
    """Re-execute a run as the UI does; the new run's id."""
    answer = graphql(address, REEXECUTE, parent=run_id)["launchRunReexecution"]
    assert answer["__typename"] == "LaunchRunSuccess", answer
    return answer["run"]["runId"]


@pytest.mark.parametrize("key", ["tape", "side"])
def test_the_ui_runs_the_command_lines_run_again(served, key):
    place, dagster, _ = served
    first = next(run for run in runs(dagster) if run["partition"] == key and "dagster/parent_run_id" not in run["tags"])
    assert first["status"] == "SUCCESS"
    folder = place / "results" / "datasets" / key
    before = {p: p.read_text() for p in folder.rglob("made.json")}
    (folder / "windows" / "made.json").unlink()
    assert ended(dagster, again(dagster, first["runId"])) == "SUCCESS"
    after = {p: p.read_text() for p in folder.rglob("made.json")}
    assert set(after) == set(before)
    assert {p.parent.name for p in before if before[p] != after[p]} <= {"windows"}, "what was not stale is kept"


def test_all_data_sets_are_made_by_one_backfill(served):
    place, dagster, _ = served
    wait_for(lambda: {"tape", "film", "side"} <= set(partitions(dagster)), 120)
    assets = ("demonstrations", "episode_split", "windows")
    asked = {"assetSelection": [{"path": [name]} for name in assets], "partitionNames": ["tape", "film", "side"]}
    answer = graphql(dagster, BACKFILL, asked=asked)["launchPartitionBackfill"]
    assert answer["__typename"] == "LaunchBackfillSuccess", answer

    def done() -> dict | None:
        found = graphql(dagster, BACKFILL_STATUS, id=answer["backfillId"])["partitionBackfillOrError"]
        return None if found["status"] == "REQUESTED" else found

    found = wait_for(done, 400)
    assert found["status"] == "COMPLETED_SUCCESS"
    counts = found["assetBackfillData"]["assetBackfillStatuses"]
    assert {c["assetKey"]["path"][0]: c["numPartitionsMaterialized"] for c in counts} == dict.fromkeys(assets, 3)
    made = {run["partition"]: run["status"] for run in runs(dagster) if "dagster/backfill" in run["tags"]}
    assert made == dict.fromkeys(("tape", "film", "side"), "SUCCESS")
    for name in assets:
        assert (place / "results" / "datasets" / "film" / name / "made.json").exists()


def start_training(address: str, partition: str) -> dict:
    """Launch a training that takes minutes, as the launchpad does; the run once it is at it."""
    assets = [["demonstrations"], ["episode_split"], ["windows"], ["mlp_k01", "trained_policy"]]
    asked = {
        "selector": {
            "repositoryName": "__repository__",
            "repositoryLocationName": "demobench",
            "jobName": "benchmark",
            "assetSelection": [{"path": path} for path in assets],
        },
        "runConfigData": {"resources": {"budget": {"config": {"steps": MANY_STEPS}}}},
        "executionMetadata": {"tags": [{"key": "dagster/partition", "value": partition}]},
    }
    answer = graphql(address, LAUNCH, asked=asked)["launchRun"]
    assert answer["__typename"] == "LaunchRunSuccess", answer
    step = {"stepKey": "mlp_k01__trained_policy", "status": "IN_PROGRESS"}
    found = wait_for(
        lambda: [r for r in runs(address) if r["runId"] == answer["run"]["runId"] and step in r["stepStats"]], 240
    )
    return found[0]


def half_made(place) -> list[str]:
    """What is in the store of results that are not whole."""
    folders = [p for p in (place / "results" / "datasets").glob("*/mlp_k01/trained_policy/*") if p.is_dir()]
    return [str(p) for p in folders if not (p / "made.json").exists() or p.name.startswith(".")]


def test_a_run_that_is_stopped_in_the_ui_is_canceled_leaves_nothing_and_can_go_on(served):
    place, dagster, _ = served
    wait_for(lambda: "film" in partitions(dagster), 120)
    run_id = start_training(dagster, "film")["runId"]
    answer = graphql(dagster, TERMINATE, id=run_id)["terminateRun"]
    assert answer["__typename"] == "TerminateRunSuccess", answer
    assert ended(dagster, run_id, 60) == "CANCELED"
    assert half_made(place) == []
    (variant,) = (place / "results" / "datasets").glob("film+*")  # another number of steps is another key
    kept = {p: p.read_text() for p in variant.rglob("made.json")}
    assert {p.parent.name for p in kept} >= {"demonstrations", "episode_split", "windows"}
    second = again(dagster, run_id)
    wait_for(lambda: [r for r in runs(dagster) if r["runId"] == second and r["status"] == "STARTED"], 120)
    assert {p: p.read_text() for p in kept} == kept, "it goes on from what was finished"
    graphql(dagster, TERMINATE, id=second)
    assert ended(dagster, second, 120) == "CANCELED"


def test_a_run_of_the_ui_that_is_killed_fails_at_once(served):
    _, dagster, _ = served
    wait_for(lambda: "film" in partitions(dagster), 120)
    run = start_training(dagster, "film")
    os.kill(int(run["tags"]["demobench/pid"]), signal.SIGKILL)
    assert ended(dagster, run["runId"], 60) == "FAILURE"


def kill_a_training(place) -> int:
    """Kill a run of the command line in the middle of a training; its process."""
    command = [sys.executable, "-m", "demobench.cli", "run", "film", "--policies", "mlp", "--steps", str(MANY_STEPS)]
    process = subprocess.Popen(command, cwd=place, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        wait_for(lambda: [path for path in half_made(place) if f".{process.pid}." in path], 300)
    finally:
        process.kill()
        process.wait(timeout=60)
    return process.pid


def test_a_run_of_the_command_line_that_is_killed_is_closed_by_the_ui(served):
    place, dagster, _ = served
    pid = str(kill_a_training(place))
    killed = next(run for run in runs(dagster) if run["tags"].get("demobench/pid") == pid)
    assert ended(dagster, killed["runId"], 240) == "FAILURE"


def test_the_next_start_names_a_killed_run_closes_it_and_clears_what_it_was_writing(tmp_path):
    write_v3(tmp_path / "film", tiny_recording(episodes=6, frames=40))
    (tmp_path / "demobench.toml").write_text(CONFIG.replace('[datasets.tape]\nsource = "tape"\n', ""))
    pid = kill_a_training(tmp_path)
    assert half_made(tmp_path), "a killed process cannot clean up behind itself"
    ports = [f"--{name}={free_port()}" for name in ("port", "mlflow-port", "files-port")]
    words = [sys.executable, "-u", "-m", "demobench.cli", "ui", *ports]
    process = subprocess.Popen(words, cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    try:
        said = process.stdout.readline()
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
    assert re.fullmatch(
        rf"closed run [0-9a-f]{{8}} of film\+[0-9a-f]{{8}}: the process {pid} that made it is gone\n", said
    )
    assert half_made(tmp_path) == []


def planned(place) -> set[str]:
    """The assets that `demobench run tape` would make."""
    session = open_session(place / "demobench.toml", None)
    target = known_target("tape", session)
    plan = Plan(session.store, target.key, target.experiment, tuple(target.experiment.variants))
    return {unit.asset for unit, why in plan.stale().items() if why != "never made"}


def stale(address: str, partition: str) -> set[str]:
    """What Dagster marks as unsynced."""
    query = "query Q($p: [String!]) {assetNodes {assetKey {path} staleStatusByPartition(partitions: $p)}}"
    nodes = graphql(address, query, p=[partition])["assetNodes"]
    return {"/".join(n["assetKey"]["path"]) for n in nodes if n["staleStatusByPartition"] == ["STALE"]}


def said_of_the_table(address: str) -> dict[str, str | bool | None]:
    """What the check `up_to_date` says now."""
    checks = graphql(address, CHECKS)["assetNodeOrError"]["assetChecksOrError"]["checks"]
    found = next(c["executionForLatestMaterialization"] for c in checks if c["name"] == "up_to_date")
    if found is None or found["evaluation"] is None:  # a table is being made just now
        return {"passed": None}
    words = {e["label"]: e.get("text") or e.get("mdStr") for e in found["evaluation"]["metadataEntries"]}
    return words | {"passed": found["evaluation"]["success"]}


def test_what_the_ui_says_is_out_of_date_is_what_a_run_would_make(served):
    place, dagster, _ = served
    file, before = place / "demobench.toml", (place / "demobench.toml").read_text()
    wait_for(lambda: (now := said_of_the_table(dagster))["passed"] and "tape" in now["why"], 150)
    assert planned(place) == stale(dagster, "tape") == set()
    file.write_text(before.replace("steps = 4", "steps = 5"))
    try:
        graphql(dagster, 'mutation {reloadRepositoryLocation(repositoryLocationName: "demobench") {__typename}}')
        said = wait_for(lambda: (now := said_of_the_table(dagster))["passed"] is False and now, 150)
        assets = planned(place)
        assert said["why"] == f"tape: {len(assets)} assets are out of date", (
            "the folder keeps the settings it was run with"
        )
        assert {line.split(" | ")[1] for line in said["out_of_date"].splitlines()[2:]} == assets
        assert "mlp_k01/trained_policy" in assets
        assert stale(dagster, "tape") <= assets
    finally:
        file.write_text(before)
        graphql(dagster, 'mutation {reloadRepositoryLocation(repositoryLocationName: "demobench") {__typename}}')
    wait_for(lambda: said_of_the_table(dagster)["passed"], 150)


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
    wait_for(lambda: log.exists() and " broken failed" in log.read_text(encoding="utf-8"), 120)
    (failed,) = [run for run in runs(dagster) if run["partition"] == "broken"]
    (line,) = [line for line in log.read_text(encoding="utf-8").splitlines() if " broken " in line]
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
    before = {run["runId"] for run in runs(dagster)}
    launch(page, dagster, "film")
    made = wait_for(lambda: [r for r in runs(dagster) if r["runId"] not in before and r["status"] in ENDED], 500)
    assert [(run["partition"], run["status"]) for run in made] == [("film", "SUCCESS")]
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

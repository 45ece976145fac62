"""Tables that are made one after another: the history, the champion and the gate, in Dagster and in the store."""

import json
from urllib.parse import urlsplit
from urllib.request import urlopen

import dagster as dg
import mlflow
import pytest

from assets_defs.launch import open_instance, run_benchmark
from assets_defs.links import FILES_PORT
from assets_defs.plan import SUMMARIES, Unit
from assets_defs.resources import asset_keys
from demobench.commands.curve import run_curve
from demobench.commands.files import FileServer
from pipeline.history import read_history
from pipeline.notify import LOG
from pipeline.sinks.to_mlflow import tracking_uri
from pipeline.store import Store
from tests.assets_defs.conftest import TinyBenchmark, why_failed
from tests.makers import tiny_recording, write_v3

pytestmark = pytest.mark.slow

LATER = tuple(Unit(asset) for asset in SUMMARIES if asset != "benchmark_table")
"""What is made from the table, which is not looked at here."""

POLICY = """
class Mine:
    '''The state goes half of the way to its command in every frame: so goes on what was commanded; `off` beside it.'''

    def __init__(self, off=0.0):
        self.off = off

    def fit(self, observations, actions, mask, seed):
        self.luck = 0.002 * seed

    def predict(self, observations):
        before, now = observations[:, -2], observations[:, -1]
        return (2 * now - before + self.off + self.luck)[:, None]
"""


CONFIG = """
[benchmark]
seeds = 2
folds = 2
steps = 1
threads = 1
[datasets.tiny]
source = "{folder}"
champion = "mean_action"
[policies.mine]
method = "{method}"
chunks = [1]
settings = {{off = 0.0}}
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A benchmark whose champion is a baseline, and a function that makes the next table, of a policy that is so far off."""
    folder = write_v3(tmp_path_factory.mktemp("data") / "tiny", tiny_recording(episodes=16, frames=30))
    home = tmp_path_factory.mktemp("history")
    (home / "mine.py").write_text(POLICY)
    told = home / "told"
    benchmark = TinyBenchmark(folder, Store(home / "results").ensure(), {
        "benchmark": {"seeds": 2, "folds": 2, "steps": 1, "threads": 1},
        "datasets": {"tiny": {"champion": "mean_action"}},
        "notify": {"command": ["/bin/sh", "-c", 'cat >> "$0"; echo >> "$0"', str(told)]},
    })  # fmt: skip

    def run(off: float, seeds: int = 2) -> tuple[dict, dict, list[dict]]:
        """The table's metadata, the gate's check, and what was told."""
        told.unlink(missing_ok=True)
        mine = {"method": f"{home / 'mine.py'}:Mine", "chunks": [1], "settings": {"off": off}}
        benchmark.raw |= {"policies": {"mine": mine}, "benchmark": benchmark.raw["benchmark"] | {"seeds": seeds}}
        benchmark.store.register("tiny", benchmark.target().experiment.model_dump(mode="json"))
        up_to_the_table = [unit for unit in benchmark.plan().stale() if unit not in LATER]
        with open_instance(benchmark.store.root) as instance:
            done = run_benchmark(instance, benchmark.defs(), "tiny", asset_keys(up_to_the_table))
            assert done.is_success, why_failed(instance, done)
            event = instance.get_latest_materialization_event(dg.AssetKey(["benchmark_table"]))
            metadata = {name: value.value for name, value in event.asset_materialization.metadata.items()}
            key = dg.AssetCheckKey(dg.AssetKey(["benchmark_table"]), "champion_not_worse")
            record = instance.event_log_storage.get_latest_asset_check_execution_by_key([key])[key]
            check = record.event.dagster_event.asset_check_evaluation_data
        said = [json.loads(line) for line in told.read_text().splitlines()] if told.exists() else []
        return metadata, {"passed": check.passed, "why": check.metadata["why"].value}, said

    return benchmark, run


def holder_of_the_alias(benchmark: TinyBenchmark) -> str:
    """The MLflow run whose model is `models:/tiny@champion`."""
    client = mlflow.MlflowClient(tracking_uri("sqlite", benchmark.store.root))
    return client.get_model_version_by_alias("tiny", "champion").run_id


def run_of(benchmark: TinyBenchmark, policy: str) -> str:
    """The MLflow run of a policy as it is trained now."""
    made = benchmark.store.made(benchmark.plan().folder(Unit(f"{policy}/trained_policy", "state")))
    return made.summary["mlflow_run_id"]


def draw_a_curve(benchmark: TinyBenchmark) -> list[str]:
    """Launch the job `curve` as from the UI, without naming a policy; returns the curves that there are then."""
    with open_instance(benchmark.store.root) as instance:
        curve, sizes = dg.AssetKey(["learning_curve"]), {"learning_curve": {"sizes": [4]}}
        run = run_benchmark(instance, benchmark.defs(), "tiny", [curve], job_name="curve", ops=sizes)
        assert run.is_success, why_failed(instance, run)
    return [unit.entry for unit in benchmark.plan().curves()]


def curve_of_the_command_line(benchmark: TinyBenchmark) -> str:
    """Whose curve `demobench curve tiny` shows; it is there, so nothing is trained."""
    file, shown = benchmark.store.root / "demobench.toml", benchmark.store.root / "curve.json"
    method = benchmark.raw["policies"]["mine"]["method"]
    file.write_text(CONFIG.format(folder=benchmark.folder, method=method))
    run_curve(
        "tiny", policy=None, sizes="4", more=8, worthwhile=0.5, choices={"observations": None}, config_path=file,
        store_path=str(benchmark.store.root), json_to=str(shown),
    )  # fmt: skip
    return json.loads(shown.read_text())["policy"]


def test_the_champion_is_promoted_watched_and_told_of(made):
    benchmark, run = made
    # The first table: what is better than the champion that was named takes its place, from the next table on.
    metadata, check, told = run(0.0)
    assert (metadata["champion"], metadata["champion_from_now_on"]) == ("mean_action/state", "mine_k01/state")
    assert check == {"passed": True, "why": "There is no earlier result of it to compare with."}
    assert [(t["event"], t["dataset"]) for t in told] == [("new champion", "tiny")]
    assert told[0]["words"].startswith(
        "From the next table on the champion is mine_k01/state: better than mean_action/state"
    )
    assert told[0]["numbers"]["difference"] < 0
    assert set(benchmark.plan().stale()) == set(LATER), "a promotion makes no table stale"
    assert "data:image/png;base64" in metadata["history_chart"]
    assert holder_of_the_alias(benchmark) == run_of(benchmark, "mine_k01"), (
        "MLflow's champion is who is champion from now on"
    )
    assert draw_a_curve(benchmark) == ["mine_k01/state/4"]
    assert curve_of_the_command_line(benchmark) == "mine_k01"
    assert set(benchmark.plan().stale()) == set(LATER), "nor does its learning curve"

    first_run = run_of(benchmark, "mine_k01")

    # The second: the new champion is what rows are compared with, and it got worse.
    metadata, check, told = run(0.3)
    assert metadata["champion"] == "mine_k01/state"
    assert metadata["regression"] == "worse"
    assert holder_of_the_alias(benchmark) == run_of(benchmark, "mine_k01") != first_run
    assert not check["passed"]
    assert check["why"].startswith("It got worse than the result of 20")
    assert [t["event"] for t in told] == ["regression"]
    assert told[0]["numbers"]["difference"] == pytest.approx(0.15, abs=0.15)
    table = json.loads((benchmark.plan().folder(Unit("benchmark_table")) / "table.json").read_text())
    rivals = {c["b"] for c in table["comparisons"]}
    assert rivals == {"hold_still/state", "mine_k01/state"}
    assert set(benchmark.plan().stale()) == set(LATER)

    # The third: with other settings nothing is said of it, and whoever is worse takes nobody's place.
    metadata, check, told = run(0.3, seeds=3)
    assert metadata["regression"] == "not comparable"
    assert check["passed"]
    assert check["why"].startswith("It cannot be compared with the result of 20")
    assert "budget differs: 2 seeds" in check["why"]
    assert (metadata["champion"], told) == ("mine_k01/state", [])
    assert "champion_from_now_on" not in metadata

    # All are in the store, with everything that a reader of the history needs.
    first, second, third = read_history(benchmark.store, "tiny")
    assert (first.promotion["verdict"], second.promotion, second.named) == ("better", None, "mean_action")
    assert len({line.table for line in (first, second, third)}) == 3
    assert {row["policy"] for row in second.rows} == {row["policy"] for row in table["policies"]}
    with FileServer(benchmark.store, 0) as server:
        address = urlsplit(metadata["history"])  # as Dagster links to it; another port while it is served here
        assert address.port == FILES_PORT
        page = urlopen(f"http://127.0.0.1:{server.server_port}{address.path}", timeout=30).read().decode()
    assert page.count("<tr>") == 4
    assert first.content_hash[:12] in page
    assert not (benchmark.store.root / LOG).exists()

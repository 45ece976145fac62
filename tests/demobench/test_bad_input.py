"""What cannot be trained, asked or rolled out, as `demobench run` meets it: one message each, the other policies' results kept."""

import io
import json
import re
import shutil
import sys

import numpy as np
import pytest
from rich.console import Console

from assets_defs.plan import Unit
from demobench.commands.run import run_benchmarks
from demobench.commands.session import Session
from pipeline.errors import DemobenchError
from pipeline.simulate import pusht
from pipeline.store import Store
from tests.assets_defs.conftest import TinyBenchmark

RAW = {
    "benchmark": {"seeds": 1, "steps": 3, "rollouts": 2, "threads": 1},
    "datasets": {
        "tiny": {
            "simulator": "pusht", "kind": "position", "circular": ["block_angle_rad"], "exclude": list(range(8, 200)),
            "observations": {"pose": ["observation.state", "observation.environment_state"]},
        }
    },
    "policies": {"mlp": {"method": "mlp", "chunks": [4, 16]}},
}  # fmt: skip
NETWORKS = ("mlp_k04", "mlp_k16")


def run(benchmark: TinyBenchmark, monkeypatch, raw: dict) -> tuple[dict, str, DemobenchError | None]:
    """`demobench run` with another configuration in the same store: the JSON, what is shown, and what it ends in."""
    benchmark = TinyBenchmark(benchmark.folder, benchmark.store, raw)
    console = Console(width=200, file=io.StringIO(), record=True)
    session = Session(benchmark.config, benchmark.store.root, benchmark.store, console)
    monkeypatch.setattr("demobench.commands.run.open_session", lambda *_: session)
    choices = dict.fromkeys(("policies", "chunks", "observations"))
    said, failure = benchmark.store.root / "said.json", None
    try:
        run_benchmarks(["tiny"], choices=choices, config_path=None, store_path=None, json_to=str(said))
    except DemobenchError as error:
        failure = error
    return json.loads(said.read_text())[0], " ".join(console.export_text().split()), failure


def changed(number: int, **dataset) -> dict:
    """The configuration with so many roll-outs, which makes only them stale, and other settings of the data set."""
    return RAW | {
        "benchmark": RAW["benchmark"] | {"rollouts": number},
        "datasets": {"tiny": RAW["datasets"]["tiny"] | dataset},
    }


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> TinyBenchmark:
    benchmark = TinyBenchmark("embedded:pusht_sim", Store(tmp_path_factory.mktemp("bad")).ensure(), RAW)
    benchmark.run()
    return benchmark


@pytest.fixture(scope="module")
def before(made) -> dict[str, float]:
    """Every row's error as it was when all was well."""
    table = json.loads((made.plan().folder(Unit("benchmark_table")) / "table.json").read_text())
    assert all(row["rollouts"]["n"] == 2 for row in table["policies"] if row["policy"] in NETWORKS)
    return {row["policy"]: row["first_step_mae"] for row in table["policies"]}


def expect(found: dict, shown: str, before: dict[str, float], why: dict[str, str]) -> None:
    """Rows and errors are as before; those named say why they were not rolled out, in the JSON and below the table."""
    rows = {row["policy"]: row for row in found["policies"]}
    assert {name: row["first_step_mae"] for name, row in rows.items()} == before
    for name in NETWORKS:
        if name in why:
            assert rows[name]["rollouts"] is None
            assert why[name] in rows[name]["no_rollouts"]
            said = [found.split(", ") for found in re.findall(r"no roll-outs of ([^:]+): ", shown)]
            # Hold-still is rolled out, too: what keeps everybody from it keeps hold-still.
            assert set(why) in [set(names) - {"hold_still"} for names in said]
            assert why[name] in shown
        else:
            assert (rows[name]["rollouts"]["n"], rows[name]["no_rollouts"]) == (found_number(found), None)
    assert "Traceback" not in shown


def found_number(found: dict) -> int:
    return max(row["rollouts"]["n"] for row in found["policies"] if row["rollouts"])


def both(words: str) -> dict[str, str]:
    return dict.fromkeys(NETWORKS, words)


@pytest.mark.slow
def test_a_simulator_that_is_not_installed(made, before, monkeypatch):
    monkeypatch.setitem(sys.modules, "gym_pusht.envs.pusht", None)
    found, shown, failure = run(made, monkeypatch, changed(3))
    assert failure is None
    expect(found, shown, before, both("pip install 'demobench[pusht]'"))


@pytest.mark.slow
def test_a_data_set_whose_actions_do_not_fit(made, before, monkeypatch):
    found, shown, failure = run(made, monkeypatch, changed(4, simulator="so101"))
    assert failure is None
    expect(found, shown, before, both("has 2 columns (x_px, y_px); expected 6 columns"))


@pytest.mark.slow
def test_limits_that_contradict_each_other(made, before, monkeypatch):
    """Each is fine alone; the simulator's table ends before the configuration's begins."""
    found, shown, failure = run(made, monkeypatch, changed(5, safety={"low": {"px": 600.0}}))
    assert failure is None
    expect(found, shown, before, both("nothing is both 600 or more and 512 or less"))


@pytest.mark.slow
def test_a_limit_of_a_column_that_there_is_not(made, before, monkeypatch):
    found, shown, failure = run(made, monkeypatch, changed(6, safety={"low": {"z_px": 1.0}}))
    assert failure is None
    expect(found, shown, before, both("neither an action column nor a unit here. Known: x_px, y_px, px"))


@pytest.mark.slow
def test_physics_that_blows_up(made, before, monkeypatch):
    make = pusht.make_environment

    def thrown(number: int):
        environment = make(number)
        if number == 1:
            environment.block.velocity = (1e300, 0.0)
        return environment

    monkeypatch.setattr(pusht, "make_environment", thrown)
    found, shown, failure = run(made, monkeypatch, changed(7))
    assert failure is None
    expect(found, shown, before, both("physics of PushT blew up at frame 1 of start state 1"))


@pytest.fixture
def weights(made):
    """The folders of two policies' weights, put back afterwards."""
    folders = {name: made.plan().folder(Unit(f"{name}/trained_policy", "pose")) / "fold_0" for name in NETWORKS}
    kept = {name: folder.with_name(f"kept_{name}") for name, folder in folders.items()}
    for name, folder in folders.items():
        shutil.copytree(folder, kept[name])
    yield folders
    for name, folder in folders.items():
        shutil.rmtree(folder)
        kept[name].rename(folder)


@pytest.mark.slow
def test_actions_that_are_not_finite(made, before, monkeypatch, weights):
    from safetensors.numpy import load_file, save_file

    file = weights["mlp_k04"] / "weights.safetensors"
    arrays = load_file(file)
    arrays["layer2.bias"] = np.full_like(arrays["layer2.bias"], np.nan)
    save_file(arrays, file)
    found, shown, failure = run(made, monkeypatch, changed(8))
    assert failure is None
    expect(found, shown, before, {"mlp_k04": "'mlp_k04' answered with NaN or infinite actions in a roll-out"})


@pytest.mark.slow
def test_a_checkpoint_of_another_architecture(made, before, monkeypatch, weights):
    shutil.copy(weights["mlp_k16"] / "weights.safetensors", weights["mlp_k04"])
    found, shown, failure = run(made, monkeypatch, changed(9))
    assert failure is None
    expect(found, shown, before, {"mlp_k04": "cannot be read"})


@pytest.mark.slow
def test_a_checkpoint_of_another_data_set(made, before, monkeypatch, weights):
    file = weights["mlp_k04"] / "policy.json"
    described = json.loads(file.read_text())
    described["trained_on"]["content_hash"] = "0123456789abcdef"
    file.write_text(json.dumps(described))
    found, shown, failure = run(made, monkeypatch, changed(10))
    assert failure is None
    expect(found, shown, before, {"mlp_k04": "is 0123456789ab, expected"})


BAD = """import numpy as np


class Bad:
    def fit(self, observations, actions, mask, seed):
        self.shape = list(actions.shape[1:])

    def predict(self, observations):
        return np.full((len(observations), *self.shape), np.nan)
"""


@pytest.mark.slow
def test_policies_that_fail_leave_the_others_in_the_table(made, before, monkeypatch, tmp_path):
    """A camera that is absent, and answers that are not finite: both are named below the others' table, whenever it is run."""
    (tmp_path / "bad.py").write_text(BAD)
    policies = {
        "look": {"method": "image", "chunks": [1, 4]},
        "bad": {"method": f"{tmp_path / 'bad.py'}:Bad", "chunks": [4]},
        "net": {"method": "mlp", "chunks": [2]},
    }
    raw = changed(2) | {"policies": RAW["policies"] | policies}
    for _ in range(2):
        found, shown, failure = run(made, monkeypatch, raw)
        rows = {row["policy"]: row["first_step_mae"] for row in found["policies"]}
        assert set(rows) == {*before, "net_k02"}
        assert {name: rows[name] for name in before} == before
        assert rows["net_k02"] is not None
        assert "net_k02" in shown
        lines = sorted(str(failure).splitlines())
        assert lines[0].startswith("bad_k04: predictions: check 'finite' failed: pose: ")
        assert "numbers are not finite" in lines[0]
        assert lines[1] == "look_k01, look_k04: A camera is asked for, and the data set 'tiny' has none."
        assert len(lines) == 2

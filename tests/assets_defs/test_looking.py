"""The recordings of a benchmark with a simulator: what every policy did in closed loop is in both."""

import shutil

import pytest
from mcap.reader import make_reader
from rerun.chunk import RrdReader

from assets_defs.looking import START_STATES
from assets_defs.plan import Unit
from pipeline.store import Store
from tests.assets_defs.conftest import TinyBenchmark

RAW = {
    "benchmark": {"seeds": 2, "steps": 3, "rollouts": START_STATES + 1, "threads": 1},
    "datasets": {"tiny": {"simulator": "pusht", "kind": "position", "exclude": list(range(8, 200)), "floor_horizons": [0]}},
    "policies": {"mlp": {"method": "mlp", "chunks": [1, 4]}},
}  # fmt: skip
POLICIES = ("hold_still", "mlp_k01", "mlp_k04")


@pytest.fixture(scope="module")
def driven(tmp_path_factory) -> TinyBenchmark:
    """A whole benchmark of eight demonstrations of PushT."""
    made = TinyBenchmark("embedded:pusht_sim", Store(tmp_path_factory.mktemp("driven")).ensure(), RAW)
    made.run()
    return made


def recordings(benchmark: TinyBenchmark) -> tuple[dict[str, set[str]], dict[str, set[str]]]:
    """Policy → the start states that the MCAP file and the Rerun recording show of it."""
    folder = benchmark.plan().folder
    in_mcap: dict[str, set[str]] = {}
    with (folder(Unit("mcap_log")) / "held_out.mcap").open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            if channel.topic.endswith("/start_state"):
                said = message.data[8:-1].decode().partition(":")[0]
                in_mcap.setdefault(channel.topic.split("/")[2], set()).add(said)
    in_rerun: dict[str, set[str]] = {}
    for path in RrdReader(folder(Unit("rerun_recording")) / "held_out.rrd").store().schema().entity_paths():
        parts = path.strip("/").split("/")
        if parts[0] == "rollouts":
            in_rerun.setdefault(parts[1], set()).add(parts[3])
    return in_mcap, in_rerun


@pytest.mark.slow
def test_both_recordings_show_every_policy_from_the_first_start_states(driven):
    in_mcap, in_rerun = recordings(driven)
    numbers = range(START_STATES)
    assert in_mcap == {policy: {f"start state {n}" for n in numbers} for policy in POLICIES}
    assert in_rerun == {policy: {f"start_{n:03d}" for n in numbers} for policy in POLICIES}


@pytest.mark.slow
def test_roll_outs_whose_file_is_damaged_are_left_out_and_said_so(driven, tmp_path):
    store = Store(shutil.copytree(driven.store.root, tmp_path / "copy"))
    benchmark = TinyBenchmark(driven.folder, store, RAW)
    plan = benchmark.plan()
    (scenes,) = (plan.folder(Unit("mlp_k04/rollouts", "state")) / "seed_0").glob("scenes.*")
    scenes.write_bytes(b"damaged")
    for name in ("mcap_log", "rerun_recording"):
        shutil.rmtree(plan.folder(Unit(name)))
    stale, _ = benchmark.run()
    assert sorted(stale) == ["mcap_log", "rerun_recording"]
    for name in ("mcap_log", "rerun_recording"):
        (why,) = store.made(plan.folder(Unit(name))).summary["left_out"]
        assert why.startswith("roll-outs of mlp_k04 (state): ")
        assert "scenes.safetensors is damaged" in why
    assert all(set(found) == {"hold_still", "mlp_k01"} for found in recordings(benchmark))

"""What policies can be given by configuration: each of it makes exactly their own results stale; CPU-seconds are remembered."""

import json
import shutil

import pytest

from assets_defs.plan import Unit
from pipeline.store import Store
from pipeline.train import weights_hash
from tests.assets_defs.conftest import TinyBenchmark

NET = {
    "method": "mlp", "chunks": [4], "history": 2, "actions": "relative", "cpu_seconds": 0.2,
    "augment": {"noise": 0.01}, "settings": {"blocks": 1, "width": 16},
}  # fmt: skip
RAW = {
    "benchmark": {"seeds": 2, "folds": 2, "steps": 6, "threads": 1},
    "policies": {
        "net": NET,
        "mlp": {"method": "mlp", "chunks": [4]},
        "flow": {"method": "flow", "chunks": [4], "settings": {"blocks": 1, "width": 16, "euler_steps": 2}},
    },
}
TRAINED = Unit("net_k04/trained_policy", "state")


def with_net(**changes) -> dict:
    return RAW | {"policies": RAW["policies"] | {"net": NET | changes}}


@pytest.fixture(scope="module")
def made(tiny_folder, tmp_path_factory) -> TinyBenchmark:
    benchmark = TinyBenchmark(tiny_folder, Store(tmp_path_factory.mktemp("given")).ensure(), RAW)
    benchmark.run()
    return benchmark


def stale(made: TinyBenchmark, raw: dict) -> set[str]:
    changed = TinyBenchmark(made.folder, made.store, raw)
    return {unit.asset for unit in changed.plan().stale() if unit.kind == "trained_policy"}


def test_it_runs_and_nothing_is_left(made):
    assert made.plan().stale() == {}
    policy = json.loads((made.plan().folder(TRAINED) / "fold_0/policy.json").read_text())["settings"]
    assert policy["transform"]["history"] == 2
    assert policy["made_with"]["blocks"] == 1


@pytest.mark.parametrize(
    "changes",
    [
        {"history": 3}, {"actions": "absolute"}, {"cpu_seconds": 0.3}, {"cpu_seconds": None, "steps": 5},
        {"augment": {"noise": 0.02}}, {"settings": {"blocks": 1, "width": 16, "dropout": 0.1}},
    ],
    ids=str,
)  # fmt: skip
def test_what_matters_to_its_weights_makes_it_stale_and_nothing_else(made, changes):
    assert stale(made, with_net(**changes)) == {"net_k04/trained_policy"}


@pytest.mark.parametrize("changes", [{"execute": 2}, {"ensemble": True}, {"delay": 1, "execute": 1}], ids=str)
def test_how_chunks_are_carried_out_makes_only_roll_outs_stale(made, changes):
    changed = TinyBenchmark(made.folder, made.store, with_net(**changes))
    assert {unit.asset for unit in changed.plan().stale() if "/" in unit.asset} == {"net_k04/rollouts"}


@pytest.mark.parametrize(
    ("changes", "whose"),
    [
        ({"rollouts": 9}, ["flow_k04", "hold_still", "mlp_k04", "net_k04"]),
        ({"rollouts_from": 500}, ["flow_k04", "hold_still", "mlp_k04", "net_k04"]),
        ({"rollout_seeds": 2}, ["flow_k04", "mlp_k04", "net_k04"]),
    ],
    ids=str,
)
def test_from_where_and_with_how_many_seeds_makes_only_roll_outs_stale(made, changes, whose):
    """What is not trained has no seeds."""
    changed = TinyBenchmark(made.folder, made.store, RAW | {"benchmark": RAW["benchmark"] | changes})
    stale_now = {unit.asset for unit in changed.plan().stale() if "/" in unit.asset}
    others = {"mean_action", "constant_velocity", "nearest_neighbour"} if "rollout_seeds" not in changes else set()
    assert stale_now == {f"{policy}/rollouts" for policy in {*whose, *others}}


def test_a_file_of_derived_features_is_watched(made, tmp_path):
    prints = [made.plan().fingerprint(TRAINED)]
    for factor in (1, 2):
        (tmp_path / "mine.py").write_text(f"def far(seen): return {factor} * seen['observation.state'][:, -1]")
        raw = with_net(features=f"{tmp_path / 'mine.py'}:far")
        prints.append(TinyBenchmark(made.folder, made.store, raw).plan().fingerprint(TRAINED))
    assert len(set(prints)) == 3


def test_a_default_that_is_written_out_changes_nothing(made):
    assert stale(made, with_net(settings={"blocks": 1, "width": 16, "dropout": 0.0, "loss": "l1"})) == set()


def test_a_budget_of_its_own_does_not_depend_on_the_benchmark_s(made):
    more = with_net() | {"benchmark": RAW["benchmark"] | {"steps": 7}}
    assert stale(made, more) == {"mlp_k04/trained_policy", "flow_k04/trained_policy"}


def test_a_budget_on_the_command_line_is_for_every_policy(made):
    policies = made.target(steps=9).experiment.policies
    assert (policies["net"].cpu_seconds, policies["net"].steps) == (None, None)
    assert made.target(steps=9).key != "tiny"


def test_every_fold_and_every_later_training_has_the_recorded_steps(made):
    folder, summary = made.plan().folder(TRAINED), made.store.made(made.plan().folder(TRAINED)).summary
    steps = [json.loads((folder / f"fold_{n}/training.json").read_text())["steps"][-1] for n in (0, 1)]
    assert steps == [summary["steps"]] * 2
    before = [weights_hash(folder / f"fold_{n}") for n in (0, 1)]
    shutil.rmtree(folder)
    made.run()
    assert [weights_hash(folder / f"fold_{n}") for n in (0, 1)] == before


def test_the_table_says_budgets_and_scores_of_samples(made):
    table = json.loads((made.plan().folder(Unit("benchmark_table")) / "table.json").read_text())
    rows = {row["policy"]: row for row in table["policies"]}
    assert table["budget"]["own"] == {"net_k04": "0.2 CPU-seconds"}
    assert rows["net_k04"]["steps"] == made.store.made(made.plan().folder(TRAINED)).summary["steps"] > 1
    assert rows["net_k04"]["cpu_s"] > 0
    assert rows["net_k04"]["samples"] is None
    assert 0 < rows["flow_k04"]["latency_ms"] <= rows["flow_k04"]["latency_p99_ms"]
    assert rows["flow_k04"]["deadline_ms"] == 400  # four actions at 10 fps
    samples = rows["flow_k04"]["samples"]
    assert 0 < samples["energy"]["value"] < samples["of_one"]["value"]
    assert len(samples["by_horizon"]["energy"]) == 4

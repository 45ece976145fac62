"""`demobench rollouts` and what it shares with `demobench export`: trained policies found, rolled out, refused."""

import io
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from assets_defs.launch import open_instance, run_benchmark
from assets_defs.plan import Unit
from assets_defs.resources import asset_keys
from demobench.commands.export import run_export
from demobench.commands.rollouts import run_rollouts
from demobench.commands.session import Session
from demobench.commands.trained import find_trained
from pipeline.errors import ConfigError, PolicyError, StoreError
from pipeline.folds import load_fold
from pipeline.simulate.trial import roll_out
from pipeline.store import Store
from pipeline.types import Execution
from tests.assets_defs.conftest import TinyBenchmark
from tests.demobench.test_cli import demobench

RAW = {
    "benchmark": {"seeds": 2, "steps": 3, "rollouts": 2, "threads": 1},
    "datasets": {
        "tiny": {
            "simulator": "pusht", "kind": "position", "circular": ["block_angle_rad"], "exclude": list(range(8, 200)),
            "observations": {
                "position": ["observation.state"], "pose": ["observation.state", "observation.environment_state"],
            },
        }
    },
    "policies": {
        "mlp": {"method": "mlp", "chunks": [4, 16], "execute": 4},
        "net": {"method": "mlp", "chunks": [4], "settings": {"blocks": 1, "width": 8}, "observations": ["pose"]},
        "late": {"method": "mlp", "chunks": [4], "only_when_named": True},
        "recipe": {
            "method": "mlp", "chunks": [4], "observations": ["pose"], "history": 2, "actions": "relative",
            "features": "pusht_block_frame", "augment": {"noise": {"px": 1.0, "rad": 0.02}, "symmetry": "pusht_mirror"},
            "steps": 2, "execute": 2, "delay": 1,
            "settings": {
                "blocks": 1, "width": 8, "loss": "huber", "dropout": 0.1, "warmup": 1, "cosine": True, "clip": 1.0, "ema": True,
                "bf16": True,
            },
        },
    },
}  # fmt: skip


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> TinyBenchmark:
    """Eight demonstrations of PushT and trained policies; nothing else of the benchmark."""
    store = Store(tmp_path_factory.mktemp("driven")).ensure()
    benchmark = TinyBenchmark("embedded:pusht_sim", store, RAW)
    target = benchmark.target()
    store.register(target.key, target.experiment.model_dump(mode="json"))
    wanted = ("demonstrations", "episode_split", "windows", "trained_policy")
    units = [unit for unit in benchmark.plan().stale() if unit.kind in wanted]
    with open_instance(store.root) as instance:
        names = [v.name for v in target.selected]
        assert run_benchmark(instance, benchmark.defs(), target.key, asset_keys(units), (), names).is_success
    return benchmark


@pytest.fixture
def session(made, monkeypatch, tmp_path) -> Session:
    console = Console(width=120, record=True, file=io.StringIO())
    session = Session(made.config, tmp_path, made.store, console)
    for command in ("rollouts", "export"):
        monkeypatch.setattr(f"demobench.commands.{command}.open_session", lambda *_: session)
    return session


def roll(address, **asked):
    options = {
        "execute": None, "delay": None, "ensemble": False, "carry_on": False, "seeds": None, "starts": 3, "first": None,
        "config_path": None,
        "store_path": None, "json_to": None,
    }  # fmt: skip
    run_rollouts(address, **options | asked)


def test_every_chunk_in_every_way_it_allows(session, tmp_path):
    said = tmp_path / "said.json"
    roll("tiny/mlp/pose", execute="2,8", delay="0,1", ensemble=True, json_to=str(said))
    found = json.loads(said.read_text())
    keys = ("execute", "ensemble", "delay")
    ways = [(row["chunk"], *(row["execution"][key] for key in keys)) for row in found["rows"]]
    assert ways == [
        (4, 2, False, 0), (4, 2, False, 1), (4, 1, True, 0), (4, 1, True, 1),
        (16, 2, False, 0), (16, 2, False, 1), (16, 8, False, 0), (16, 8, False, 1), (16, 1, True, 0), (16, 1, True, 1),
    ]  # fmt: skip
    assert [(one["policy"], one["execution"]["delay"]) for one in found["left_out"]] == [("mlp_k04", 0), ("mlp_k04", 1)]
    assert all("execute = 8" in one["why"] for one in found["left_out"])
    assert found["start_states"] == {"first": 2, "n": 3}
    assert all(row["n"] == 3 and row["success_interval"][1] < 1 and "intervened" in row for row in found["rows"])
    shown = session.console.export_text()
    assert "left out of mlp_k04: 8 executed, delay 0; 8 executed, delay 1" in shown
    assert "0/3" in shown


def test_carried_on_stands_beside_not_carried_on(session, tmp_path):
    said = tmp_path / "said.json"
    roll("tiny/mlp_k04/pose", execute="2", carry_on=True, json_to=str(said))
    ways = [(row["execution"]["execute"], row["execution"]["carry_on"]) for row in json.loads(said.read_text())["rows"]]
    assert ways == [(2, False), (2, True)]
    shown = session.console.export_text()
    assert "2, on" in shown
    assert "“on”: an answer goes on where the robot has not moved." in shown


def test_left_alone_it_is_as_the_configuration_says(session, made, tmp_path):
    said = tmp_path / "said.json"
    roll("tiny/mlp_k16/pose", first=0, starts=2, json_to=str(said))
    (row,) = json.loads(said.read_text())["rows"]
    assert row["execution"] == {"execute": 4, "ensemble": False, "delay": 0, "carry_on": False}
    (one,) = find_trained("tiny/mlp_k16/pose", session)
    (rolled,) = roll_out(one.task, one.folder)
    assert (rolled.execution, rolled.seed) == (Execution(4), 0)
    assert rolled.best_reward.mean() == row["score"]


def test_several_seeds_act_from_the_same_start_states(session, tmp_path):
    said = tmp_path / "said.json"
    roll("tiny/mlp_k16/pose", seeds=2, first=0, starts=3, json_to=str(said))
    (row,) = json.loads(said.read_text())["rows"]
    assert (row["seeds"], row["n"], row["episodes"]) == (2, 3, 6)
    (one,) = find_trained("tiny/mlp_k16/pose", session)
    first, second = roll_out(one.task, one.folder, seeds=2, start_states=range(3))
    assert (first.seed, second.seed, first.start_states.tolist()) == (0, 1, second.start_states.tolist())
    assert (first.best_reward != second.best_reward).any(), "two networks, not one twice"
    (alone,) = roll_out(one.task, one.folder, start_states=range(3))
    np.testing.assert_array_equal(alone.best_reward, first.best_reward)
    assert row["score"] == pytest.approx(np.mean([first.best_reward, second.best_reward]))
    assert [one["seed"] for one in row["per_seed"]] == [0, 1]
    assert "seeds 0 to 1 of fold 0" in session.console.export_text()


def test_every_key_of_a_policy_reaches_its_training_and_its_roll_outs(session):
    (one,) = find_trained("tiny/recipe/pose", session)
    said = RAW["policies"]["recipe"]
    view = {"actions": "relative", "features": "pusht_block_frame", **said["augment"]}
    assert (one.task.training["given"], one.task.training["steps"]) == (view, 2)
    policy = load_fold(one.task, one.folder, 0)
    assert policy.made_with.model_dump().items() >= said["settings"].items()
    assert (policy.transform.history, policy.transform.relative.tolist()) == (2, [True, True])
    assert policy.transform.derived[0] == "pusht_block_frame"
    assert json.loads((one.folder / "fold_0/training.json").read_text())["steps"][-1] == 2
    (rolled,) = roll_out(one.task, one.folder)
    assert (rolled.execution, len(rolled.success)) == (Execution(2, delay=1), 2)


@pytest.mark.parametrize(
    ("address", "options", "error", "message"),
    [
        (
            "tiny/mlp",
            {},
            ConfigError,
            "several observation sets: position, pose. Name one, for example tiny/mlp/position",
        ),
        ("tiny/mlp/front", {}, ConfigError, "not trained with an observation set 'front'"),
        ("tiny/milp/pose", {}, ConfigError, "no policy 'milp'. Did you mean 'mlp'"),
        ("tin/mlp/pose", {}, ConfigError, "No data set 'tin'.*Did you mean 'tiny'"),
        ("tiny", {}, ConfigError, "'tiny' names no policy"),
        ("tiny/hold_still", {}, ConfigError, "is a baseline"),
        ("tiny/late_k04/pose", {}, StoreError, "no up-to-date weights of late_k04.*demobench run tiny --policies late"),
        ("tiny/mlp_k04/pose", {"execute": "5"}, ConfigError, "mlp_k04: execute = 5 needs a chunk of at least 5"),
        ("tiny/mlp_k04/pose", {"execute": "0"}, ConfigError, "--execute takes whole numbers of at least 1"),
        (
            "tiny/mlp_k04/pose",
            {"seeds": 3},
            ConfigError,
            "--seeds is 3, and mlp_k04 was trained with 2: ask for at most",
        ),
        ("tiny/mlp_k04/pose", {"delay": "x"}, ConfigError, "--delay takes whole numbers of at least 0"),
    ],
)
def test_what_names_nothing_is_one_message(session, address, options, error, message):
    with pytest.raises(error, match=message):
        roll(address, **options)


# Export -------------------------------------------------------------------------------------------------------------------


def write(address, out, seed=0, json_to=None):
    run_export(address, out, seed=seed, config_path=None, store_path=None, json_to=json_to)


def test_a_network_of_the_store_as_a_file(session, tmp_path):
    write("tiny/mlp_k16/pose", tmp_path / "net.onnx", json_to=str(tmp_path / "said.json"))
    said = json.loads((tmp_path / "said.json").read_text())
    assert said["inputs"] == {"observations": [1, 3, 5]}
    assert (said["output"], said["compared"], said["metadata"]["key"]) == ([1, 16, 2], 100, "tiny")
    assert said["metadata"]["action_units"] == ["px", "px"]
    assert said["most_off"] < 0.1
    shown = session.console.export_text().replace("\n", " ")
    assert "observations [1, 3, 5] → actions [1, 16, 2], float32, raw units" in shown
    assert (tmp_path / "net.onnx").stat().st_size == said["bytes"]


@pytest.mark.parametrize(
    ("address", "out", "seed", "message"),
    [
        ("tiny/mlp/pose", "a.onnx", 0, "stands for several policies: mlp_k04, mlp_k16. Export one of them"),
        ("tiny/mlp_k04/pose", "a.txt", 0, "is no place for an ONNX file. Name one that ends in .onnx"),
        ("tiny/mlp_k04/pose", "no/a.onnx", 0, "in a folder that exists"),
        ("tiny/mlp_k04/pose", "a.onnx", 2, "mlp_k04 has no seed 2. Its seeds are 0, 1"),
        ("tiny/hold_still", "a.onnx", 0, "is a baseline"),
    ],
)
def test_what_cannot_be_exported_is_one_message(session, tmp_path, address, out, seed, message):
    with pytest.raises(ConfigError, match=message):
        write(address, tmp_path / out, seed)
    assert list(tmp_path.iterdir()) == []


# Weights that are not a policy's own --------------------------------------------------------------------------------------


def replaced(one, tmp_path, **files):
    """The folder of a policy's weights with some files of others."""
    folder = tmp_path / "weights"
    shutil.copytree(one.folder, folder)
    for name, source in files.items():
        shutil.copy(source / "fold_0" / f"{name}.{'json' if name == 'policy' else 'safetensors'}", folder / "fold_0")
    return folder


def test_weights_of_another_architecture_or_data_set_are_refused(session, made, tmp_path):
    (one,) = find_trained("tiny/mlp_k04/pose", session)
    (long,) = find_trained("tiny/mlp_k16/pose", session)
    (net,) = find_trained("tiny/net/pose", session)
    (blind,) = find_trained("tiny/mlp_k04/position", session)
    with pytest.raises(PolicyError, match="their chunk is 16, expected 4. Somebody replaced them"):
        load_fold(one.task, long.folder, 0)
    with pytest.raises(PolicyError, match="cannot be read.*expected"):
        load_fold(one.task, replaced(one, tmp_path / "a", weights=long.folder), 0)
    with pytest.raises(PolicyError, match="cannot be read|another architecture"):
        load_fold(net.task, replaced(net, tmp_path / "b", weights=one.folder), 0)
    with pytest.raises(PolicyError, match="sees 2 columns and was given 5: it was trained on another data set or"):
        roll_out(one.task, replaced(one, tmp_path / "c", weights=blind.folder, policy=blind.folder))
    folder = replaced(one, tmp_path / "d")
    described = json.loads((folder / "fold_0/policy.json").read_text())
    described["trained_on"]["content_hash"] = "0123456789abcdef"
    (folder / "fold_0/policy.json").write_text(json.dumps(described))
    with pytest.raises(PolicyError, match="their data set .* is 0123456789ab, expected"):
        load_fold(one.task, folder, 0)


def test_weights_of_another_width_are_another_architecture(session, tmp_path):
    (net,) = find_trained("tiny/net/pose", session)
    folder = replaced(net, tmp_path)
    described = json.loads((folder / "fold_0/policy.json").read_text())
    described["settings"]["made_with"]["width"] = 16
    (folder / "fold_0/policy.json").write_text(json.dumps(described))
    with pytest.raises(PolicyError, match="of another architecture than policy.json beside them says"):
        load_fold(net.task, folder, 0)


def test_one_policy_that_cannot_be_rolled_out_leaves_the_others(made):
    """Its record says why; the check that would hold the table back passes."""
    from assets_defs.policies import _roll_out

    class Bench:
        plan, store, experiment = made.plan(), made.store, made.target().experiment

        def progress(self, *_):
            pass

        def task(self, variant, observations):
            return find_trained(f"tiny/{variant.name}/{observations}", session)[0].task

    session = Session(made.config, made.store.root, made.store, Console())
    variant = next(v for v in made.target().selected if v.name == "mlp_k04")
    unit = Unit("mlp_k04/rollouts", "pose")
    weights = made.plan().folder(Unit("mlp_k04/trained_policy", "pose")) / "fold_0/weights.safetensors"
    kept = weights.read_bytes()
    from safetensors.numpy import load_file, save_file

    arrays = load_file(weights)
    arrays["layer2.bias"] = np.full_like(arrays["layer2.bias"], np.nan)
    try:
        save_file(arrays, weights)
        outcome = _roll_out(Bench(), variant, unit, made.store.root)
    finally:
        weights.write_bytes(kept)
    assert outcome.summary["rollouts"] is None
    assert "'mlp_k04' answered with NaN or infinite actions in a roll-out" in outcome.summary["why_not"]
    assert outcome.checks["sane"][0]


# The whole way ------------------------------------------------------------------------------------------------------------


def seed_metrics(uri: str, name: str) -> dict[str, float]:
    """What MLflow holds of one training seed."""
    from mlflow import MlflowClient

    client = MlflowClient(tracking_uri=uri)
    experiments = [experiment.experiment_id for experiment in client.search_experiments()]
    (run,) = client.search_runs(experiments, f"attributes.run_name = '{name}'")
    return run.data.metrics


@pytest.mark.slow
def test_two_seeds_from_the_command_line_to_verdicts(tmp_path):
    """A real run on a few demonstrations of PushT: two seeds and hold-still in closed loop, judged, compared, rolled out again."""
    left_out = list(range(8, 200))
    (tmp_path / "demobench.toml").write_text(
        f"""
        [benchmark]
        seeds = 2
        steps = 20
        rollouts = 6
        rollouts_from = 100
        rollout_seeds = 2
        threads = 1
        [datasets.tape]
        source = "embedded:pusht_sim"
        simulator = "pusht"
        kind = "position"
        circular = ["block_angle_rad"]
        observations = {{pose = ["observation.state", "observation.environment_state"]}}
        exclude = {left_out}
        [policies.mlp]
        method = "mlp"
        chunks = [4, 16]
        """
    )
    run = demobench("run", "tape", "--json", "out.json", cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    (table,) = json.loads((tmp_path / "out.json").read_text())
    rolled = {row["policy"]: row["rollouts"] for row in table["policies"] if row["rollouts"]}
    assert {name: (one["seeds"], one["first"], one["n"]) for name, one in rolled.items()} == {
        "hold_still": (1, 100, 6), "mlp_k04": (2, 100, 6), "mlp_k16": (2, 100, 6),
    }  # fmt: skip
    found = table["closed_loop"]
    assert found["chosen"] == "best"
    assert {c["metric"] for c in found["comparisons"]} == {"success", "score"}
    assert len(found["comparisons"]) == 2 * 2
    assert "6 start states × 2 seeds of fold 0, 95 % over both" in run.stdout
    assert "closed loop: " in run.stdout
    assert "Which policies do better in closed loop?" in Path(tmp_path / table["artifacts"]["report"]).read_text()
    tracked = seed_metrics(table["artifacts"]["mlflow"], "mlp_k04/pose/seed_1")
    assert tracked["rollout_score"] == pytest.approx(rolled["mlp_k04"]["per_seed"][1]["score"])
    words = ("--from", "100", "--starts", "6", "--json", "-")
    again = demobench("rollouts", "tape/mlp_k04/pose", "--seeds", "2", *words, cwd=tmp_path)
    (row,) = json.loads(again.stdout)["rows"]
    assert {key: row[key] for key in rolled["mlp_k04"]} == rolled["mlp_k04"]
    pairs = json.loads(demobench("compare", "tape", "--json", "-", cwd=tmp_path).stdout)["comparisons"]
    driven = [pair for pair in pairs if pair["metric"] in ("success", "score")]
    assert len(driven) == 2 * 3, "all pairs of the three that were rolled out"
    assert demobench("run", "tape", cwd=tmp_path).stdout.count("nothing to compute") == 1

"""`demobench proxy` on stores whose results are real: networks trained for a few steps, their predictions, and roll-outs that were
rolled out or, where success must follow something known, planted. Nothing here looks at tracking or pictures: they are left out."""

import io
import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from assets_defs.plan import Plan, Unit
from demobench.commands.proxy import run_proxy
from demobench.commands.session import Session
from pipeline.config import Config, parse_config
from pipeline.errors import ConfigError, StoreError
from pipeline.execution import settled
from pipeline.experiment import from_config
from pipeline.folds import PolicyTask, predict_folds, split_of, train_folds
from pipeline.lerobot_format.quality import inspect_dataset
from pipeline.lerobot_format.read import load_experiment
from pipeline.lerobot_format.saved import save_demonstrations
from pipeline.offline_scores import drawing, near_contact, offline_scores
from pipeline.predict import save_predictions
from pipeline.simulate.trial import roll_out, save_rollouts
from pipeline.split import save_split
from pipeline.store import Made, Store
from pipeline.types import Rollouts

TINY = {"blocks": 1, "width": 8, "batch": 16}
METHODS = {
    "mlp": TINY, "gmm": TINY, "flow": TINY | {"euler_steps": 2}, "diffusion": TINY | {"noise_steps": 4, "sampling_steps": 2},
    "lwr": {"neighbours": 4}, "act": {"width": 8, "heads": 2, "layers": 1, "latent": 2, "batch": 16},
}  # fmt: skip


@dataclass
class Filled:
    """A store with the results of a configuration, and that configuration."""

    config: Config
    store: Store


def configured(policies, seeds, **dataset) -> Config:
    return parse_config(
        {
            "benchmark": {"seeds": seeds, "steps": 3, "rollouts": 2, "rollout_seeds": seeds, "threads": 1},
            "datasets": {
                name: {
                    "source": "embedded:pusht_sim", "simulator": "pusht", "kind": "position", "circular": ["block_angle_rad"],
                    "exclude": list(range(first + 8, 200)) + list(range(first)),
                    "observations": {"pose": ["observation.state", "observation.environment_state"]},
                }
                for name, first in (("tiny", 0), ("other", 8))
            },
            "policies": policies,
        },
        "test",
    )  # fmt: skip


def fill(config: Config, store: Store, name: str, roll) -> Filled:
    """Train, predict and roll out as the benchmark does; `roll(task, folder of weights, predictions)` gives roll-outs."""
    experiment = from_config(config, name, Path("/"))
    store.register(name, experiment.model_dump(mode="json"))
    plan = Plan(store, name, experiment, tuple(experiment.variants), look_at_source=False)
    demos, semantics = load_experiment(experiment, Path("/"))
    split = split_of(experiment, demos)

    def publish(unit: Unit, write, summary, fingerprint=None) -> None:
        plan.forget()
        with store.publish(plan.folder(unit)) as draft:
            write(draft)
            store.write_made(draft, Made(fingerprint or plan.fingerprint(unit), summary=summary))

    facts = {"asked": plan.asked_of_source(), "inspect": inspect_dataset(demos, semantics)}
    publish(Unit("demonstrations"), lambda d: save_demonstrations(demos, d / "frames"), facts, demos.content_hash)
    publish(Unit("episode_split"), lambda d: save_split(split, d / "split.json"), {"hash": split.hash})
    for variant in (v for v in experiment.variants if v.is_trained):
        task = PolicyTask(demos, semantics, split, experiment.observation_sets[0], variant, experiment)
        units = [Unit(f"{variant.name}/{kind}", "pose") for kind in ("trained_policy", "predictions", "rollouts")]
        publish(units[0], lambda d, task=task: train_folds(task, d, d.with_name(".unfinished")), {})
        weights = plan.folder(units[0])
        predicted, _ = predict_folds(task, weights)
        publish(units[1], lambda d, predicted=predicted: save_predictions(predicted, d), {})
        rolled = roll(task, weights, predicted)
        publish(units[2], lambda d, rolled=rolled: save_rollouts(rolled, d), {"why_not": None})
    return Filled(config, store)


def planted(follows: str | None, seed: int, starts: int = 100):
    """Roll-outs in which success follows an offline score of the very network, or nothing."""
    random = np.random.default_rng(seed)

    def roll(task, weights, predicted) -> list[Rollouts]:
        execution = settled(task.policy.execution, task.variant.chunk)
        near = near_contact(task.demos, task.semantics)
        scores = offline_scores(task, predicted, execution, near, drawing(task, weights))
        found = []
        for at, number in enumerate(predicted.seeds):
            level = random.normal() if follows is None else (60.0 - scores[follows][at]) / 12.0
            best = np.where(random.uniform(size=starts) < 1 / (1 + np.exp(-level)), 1.0, random.uniform(size=starts))
            found.append(
                Rollouts(
                    "pusht",
                    "planted",
                    task.variant.name,
                    "pose",
                    np.arange(starts),
                    best == 1.0,
                    best,
                    0.95 * best,
                    np.full(starts, 300),
                    None,
                    execution=execution,
                    seed=number,
                )
            )
        return found

    return roll


@pytest.fixture(scope="module")
def few(tmp_path_factory) -> Filled:
    """Four networks in the simulator, from two start states each."""
    config = configured({"mlp": {"method": "mlp", "chunks": [8, 16], "settings": TINY, "execute": 8}}, seeds=2)
    store = Store(tmp_path_factory.mktemp("few")).ensure()
    return fill(config, store, "tiny", lambda task, weights, _: roll_out(task, weights))


def ask(benchmark, monkeypatch, tmp_path, *datasets, **asked):
    """What is printed, and the JSON."""
    console = Console(width=120, record=True, file=io.StringIO())
    session = Session(benchmark.config, tmp_path, benchmark.store, console)
    monkeypatch.setattr("demobench.commands.proxy.open_session", lambda *_: session)
    said = tmp_path / "said.json"
    options = {"observations": None, "chunks": None, "config_path": None, "store_path": None}
    run_proxy(datasets, **options | asked, json_to=str(said))
    return console.export_text(), json.loads(said.read_text())


def test_too_few_checkpoints_end_in_cannot_tell(few, monkeypatch, tmp_path):
    text, said = ask(few, monkeypatch, tmp_path, "tiny")
    (found,) = said["data_sets"]
    assert found["methods"] == {"mlp": 4}
    assert found["start_states"] == [2, 2]
    assert "gym-pusht" in found["simulator"]
    assert "cannot tell: not enough: has 4 of 24 distinct checkpoints" in " ".join(text.split())
    assert all(one["overall"] is None for one in found["targets"]["success"]["scores"])
    assert set(found["rows"][0]) >= {
        "whole_chunk_mae",
        "executed_mae",
        "energy",
        "near_contact_mae",
        "success",
        "score",
    }
    assert 0.1 < found["near_contact"] < 1
    assert said["answers"] == []


def test_chunks_choose(few, monkeypatch, tmp_path):
    _, said = ask(few, monkeypatch, tmp_path, "tiny", chunks="8", observations="pose")
    assert {(row["policy"], row["chunk"]) for row in said["data_sets"][0]["rows"]} == {("mlp_k08", 8)}


def test_what_is_missing_is_left_out_with_a_reason(few, monkeypatch, tmp_path):
    folder = few.store.folder("tiny", "mlp_k08/rollouts", "pose")
    kept = (folder / "made.json").read_text()
    (folder / "made.json").unlink()
    try:
        text, said = ask(few, monkeypatch, tmp_path, "tiny")
    finally:
        (folder / "made.json").write_text(kept)
    assert {"what": "tiny/mlp_k08/pose", "why": "no up-to-date roll-outs"} in said["data_sets"][0]["left_out"]
    assert "left out: tiny/mlp_k08/pose (no up-to-date roll-outs)" in text


def test_what_cannot_be_asked(few, monkeypatch, tmp_path):
    with pytest.raises(ConfigError, match="one data set, or two different ones"):
        ask(few, monkeypatch, tmp_path, "tiny", "tiny")
    with pytest.raises(ConfigError, match="No data set 'tinny'"):
        ask(few, monkeypatch, tmp_path, "tinny")
    with pytest.raises(ConfigError, match="no observation set 'poes'"):
        ask(few, monkeypatch, tmp_path, "tiny", observations="poes")
    nothing = replace(few, store=Store(tmp_path / "nothing").ensure())
    with pytest.raises(StoreError, match="demobench run tiny"):
        ask(nothing, monkeypatch, tmp_path, "tiny")


# Enough of them -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def many(tmp_path_factory) -> Filled:
    """Two data sets, six methods; what is carried out is what success follows on both."""
    store = Store(tmp_path_factory.mktemp("many")).ensure()
    config = configured({m: {"method": m, "chunks": [2, 4], "settings": made} for m, made in METHODS.items()}, seeds=3)
    for seed, name in enumerate(("tiny", "other")):
        fill(config, store, name, planted("executed_mae", seed))
    return Filled(config, store)


@pytest.mark.slow
def test_named_on_one_data_set_and_tested_on_the_other(many, monkeypatch, tmp_path):
    text, said = ask(many, monkeypatch, tmp_path, "tiny", "other")
    for found in said["data_sets"]:
        # Six methods × 2 chunks × 3 seeds. Locally weighted regression has no seeds: its three networks are one.
        assert found["methods"] == {"act": 6, "diffusion": 6, "flow": 6, "gmm": 6, "lwr": 2, "mlp": 6}
        assert {left["why"] for left in found["left_out"]} == {"it answers as seed 0 does"}
        success = found["targets"]["success"]
        assert success["ceiling"] > 0.8
        executed = next(one for one in success["scores"] if one["score"] == "executed_mae")
        assert executed["overall"]["interval"][0] > 0
    first = said["answers"][0]
    assert (first["target"], first["word"]) == ("success", "yes")
    assert "yes: Named on the first data set" in " ".join(text.split())
    assert "surely above zero" in first["words"]


@pytest.mark.slow
def test_one_data_set_alone_names_and_does_not_test(many, monkeypatch, tmp_path):
    text, said = ask(many, monkeypatch, tmp_path, "tiny")
    assert said["answers"] == []
    assert "Highest on this data set" in text
    assert "partly luck" in text


@pytest.mark.slow
def test_the_same_demonstrations_are_no_second_data_set(many, monkeypatch, tmp_path):
    copy = many.store.folder("copy", "demonstrations").parent
    copy.symlink_to(many.store.folder("tiny", "demonstrations").parent)
    try:
        with pytest.raises(ConfigError, match="the same demonstrations"):
            ask(many, monkeypatch, tmp_path, "tiny", "copy")
        # As another experiment on the same data and split it adds nothing that is not there already.
        _, said = ask(many, monkeypatch, tmp_path, "tiny")
    finally:
        copy.unlink()
    (found,) = said["data_sets"]
    assert found["checkpoints"] == 32
    assert "an experiment before it has this policy and seed already" in {left["why"] for left in found["left_out"]}

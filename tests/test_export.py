"""ONNX files answer as PyTorch does, and say what they need."""

import json
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest

from pipeline.config import parse_config
from pipeline.errors import NotApplicableError, PolicyError, StoreError
from pipeline.experiment import from_config
from pipeline.export import MOST_OFF, export_policy, most_off, onnx_of
from pipeline.folds import PolicyTask, split_of
from pipeline.policies.transform import derive
from pipeline.types import ACTION, STATE
from tests.hand_made import random_walks, semantics
from tests.policies.test_methods import ALL, NETWORKS, lay, train
from tests.policies.test_transform import WITH_POSE, pusht

PUSHT = {"actions": "relative", "features": "pusht_block_frame"}


def session_of(content: bytes) -> onnxruntime.InferenceSession:
    onnx.checker.check_model(onnx.load_model_from_string(content))
    return onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])


@pytest.mark.parametrize("given", [{}, PUSHT], ids=["absolute", "relative, derived"])
@pytest.mark.parametrize("method", NETWORKS)
def test_every_network_answers_the_same(method, given):
    demos, meaning = pusht()
    windows = lay(demos, meaning, WITH_POSE)
    policy = train(method, windows, seeds=(3,), given=given).policy
    content, inputs = onnx_of(policy, windows, {"names": ["x", "y"], "units": "px"})
    session = session_of(content)
    seen = windows.observations()
    expected = policy.predict(seen)[0]
    assert np.ptp(expected, axis=0).min() > 1e-3
    for row in (0, 5, len(windows) - 1):
        asked = {"observations": seen.values[row : row + 1].astype(np.float32)}
        if given:
            asked["derived"] = derive("pusht_block_frame", policy.transform.widths, asked["observations"]).astype(
                np.float32
            )
        if policy.nets[0].draws:
            asked["noise"] = policy._noise(3, seen.values[row : row + 1], 1, policy.nets[0]).numpy()
        assert {name: array.shape for name, array in asked.items()} == inputs
        (answer,) = session.run(["actions"], asked)
        assert answer.shape == (1, 4, 2)
        np.testing.assert_allclose(answer[0], expected[row], rtol=1e-4, atol=0.02)
    assert most_off(content, policy, windows)[1] < MOST_OFF
    assert dict(session.get_modelmeta().custom_metadata_map) == {"names": '["x", "y"]', "units": "px"}


@pytest.mark.parametrize("actions", ["absolute", "relative"])
@pytest.mark.parametrize("plain", [True, False], ids=["plain", "network"])
def test_angles_go_in_and_come_out_in_the_recording_s_branch(plain, actions):
    demos = random_walks()
    windows = lay(demos, semantics(demos, circular={ACTION: (False, True), STATE: (False, True)}))
    given = {} if plain or actions == "absolute" else {"actions": actions}
    settings = {"blocks": 0, "dropout": 0.0, "warmup": 0, "cosine": False, "ema": False, "clip": 0.0} if plain else {}
    policy = train("mlp", windows, seeds=(0,), given=given, settings=settings).policy
    assert hasattr(policy, "stack") == plain
    content, _ = onnx_of(policy, windows, {})
    assert 0 <= most_off(content, policy, windows)[1] < MOST_OFF
    (answer,) = session_of(content).run(None, {"observations": windows.observations(slice(0, 1)).values})
    np.testing.assert_allclose(answer[0], policy.predict(windows.observations(slice(0, 1)))[0, 0], atol=1e-4)


@pytest.fixture(scope="module")
def task() -> PolicyTask:
    demos, meaning = pusht(episodes=10)
    raw = {
        "benchmark": {"folds": 1, "history": 2},
        "datasets": {"made": {"source": "made", "observations": {"pose": list(WITH_POSE.features)}}},
        "policies": {"net": {"method": "mlp", "chunks": [4]}},
    }
    experiment = from_config(parse_config(raw, "test"), "made", Path())
    variant = next(v for v in experiment.variants if v.name == "net_k04")
    return PolicyTask(demos, meaning, split_of(experiment, demos), WITH_POSE, variant, experiment)


def test_the_file_says_what_a_robot_needs_to_know(task, tmp_path):
    fold = task.split.folds[0]
    policy = train("act", task.windows(fold.train, fold), seeds=(2,)).policy
    made = export_policy(task, policy, tmp_path / "net.onnx", {"fingerprint": "f00"})
    said = {p.key: p.value for p in onnx.load(tmp_path / "net.onnx").metadata_props}
    assert json.loads(said["observation_names"]) == [
        n for key in WITH_POSE.features for n in task.demos.features[key].names
    ]
    assert json.loads(said["action_units"]) == ["px", "px"]
    assert json.loads(said["observation_features"]) == {"observation.state": 2, "observation.environment_state": 3}
    assert (said["history"], said["chunk"], said["seed"], said["fps"]) == ("2", "4", "2", str(task.demos.fps))
    assert (said["content_hash"], said["fingerprint"], said["policy"]) == (task.demos.content_hash, "f00", "net_k04")
    assert (made.inputs, made.output) == ({"observations": (1, 2, 5)}, (1, 4, 2))
    assert 0 < made.compared <= 100
    assert made.bytes == (tmp_path / "net.onnx").stat().st_size


def test_what_is_no_network_is_refused_by_name(task, tmp_path):
    policy = train("lwr", task.windows(task.split.folds[0].train, task.split.folds[0])).policy
    with pytest.raises(NotApplicableError, match="'net_k04' cannot be exported: the method 'mlp' is no network"):
        export_policy(task, policy, tmp_path / "net.onnx", {})
    assert set(ALL) - set(NETWORKS) == {"lwr"}
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_answers_otherwise_is_not_written(task, tmp_path, monkeypatch):
    fold = task.split.folds[0]
    policy = train("mlp", task.windows(fold.train, fold), seeds=(0,)).policy
    monkeypatch.setattr("pipeline.export.MOST_OFF", 0.0)
    with pytest.raises(PolicyError, match="answers otherwise than PyTorch: up to .* Nothing was written"):
        export_policy(task, policy, tmp_path / "net.onnx", {})
    assert list(tmp_path.iterdir()) == []
    monkeypatch.undo()
    with pytest.raises(StoreError, match="cannot be written"):
        export_policy(task, policy, tmp_path / "no" / "net.onnx", {})

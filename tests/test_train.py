"""Training through the one call there is: files, leakage, known results."""

import json

import numpy as np
import pytest

from pipeline.errors import PolicyError
from pipeline.methods import METHODS
from pipeline.predict import predict_policy
from pipeline.statistics.metrics import episode_errors, summarise
from pipeline.train import load_trained, save_trained, train_policy, weights_hash
from pipeline.types import Fold, Split
from pipeline.windows import make_windows
from tests.hand_made import STATE_ONLY, changed, random_walks, semantics

TRAIN, TEST = (0, 2, 3), (1, 4)
WITHOUT_CAMERA = [name for name, method in METHODS.items() if not method.camera]


def lay(demos, method="mlp", episodes=TRAIN):
    chunk = 4 if METHODS[method].chunk == "set" else 1
    settings = {"statistics_episodes": TRAIN, "protocol": "strict", "history": 3, "chunk": chunk}
    return make_windows(demos, semantics(demos), STATE_ONLY, episodes, **settings, recipe=METHODS[method].recipe)


@pytest.mark.parametrize("method", WITHOUT_CAMERA)
def test_every_method_comes_back_from_its_files(method, tmp_path):
    demos = random_walks()
    trained = train_policy(method, lay(demos, method), seeds=(0, 3), steps=3)
    save_trained(trained, tmp_path / "policy")
    again = load_trained(tmp_path / "policy")
    seen = lay(demos, method, TEST).observations()
    np.testing.assert_array_equal(again.policy.predict(seen, 5), trained.policy.predict(seen, 5))
    assert (again.method, again.parameters, again.train_s) == (method, trained.parameters, trained.train_s)
    np.testing.assert_array_equal(again.losses, trained.losses)
    np.testing.assert_array_equal(again.steps_logged, trained.steps_logged)
    assert again.policy.seeds == ((0, 3) if METHODS[method].trained else (0,))
    assert {path.suffix for path in (tmp_path / "policy").iterdir()} == {".safetensors", ".json"}


@pytest.mark.parametrize("method", WITHOUT_CAMERA)
def test_held_out_episodes_leave_no_trace(method, tmp_path):
    """Change every value of the held-out episodes: normaliser, windows and weights stay the same, byte for byte."""
    hashes = []
    for number, demos in enumerate((random_walks(), changed(random_walks(), TEST))):
        windows = lay(demos, method)
        save_trained(train_policy(method, windows, seeds=(0, 1), steps=4), tmp_path / str(number))
        hashes.append((windows.normalizer.hash(), windows.hash(), weights_hash(tmp_path / str(number))))
    assert hashes[0] == hashes[1]


def test_a_changed_training_episode_does_leave_a_trace(tmp_path):
    for number, demos in enumerate((random_walks(), changed(random_walks(), [2]))):
        save_trained(train_policy("mlp", lay(demos), seeds=(0,), steps=4), tmp_path / str(number))
    assert weights_hash(tmp_path / "0") != weights_hash(tmp_path / "1")


def test_progress_is_reported():
    calls = []
    train_policy("mlp", lay(random_walks()), seeds=(0,), steps=3, on_step=lambda *call: calls.append(call))
    assert [call[:2] for call in calls] == [(1, 3), (2, 3), (3, 3)]


def test_an_unknown_method_is_refused_with_a_suggestion():
    with pytest.raises(PolicyError, match=r"No method 'mpl'\. Did you mean 'mlp'"):
        train_policy("mpl", lay(random_walks()), seeds=(0,), steps=1)


@pytest.mark.parametrize("damage", ["missing", "cut", "method"])
def test_files_that_cannot_be_read_are_one_message(damage, tmp_path):
    folder = tmp_path / "policy"
    save_trained(train_policy("mlp", lay(random_walks()), seeds=(0,), steps=1), folder)
    weights = folder / "weights.safetensors"
    if damage == "missing":
        weights.unlink()
    elif damage == "cut":
        weights.write_bytes(weights.read_bytes()[:100])
    else:
        (folder / "policy.json").write_text(json.dumps({"method": "from the future", "settings": {}}))
    with pytest.raises(PolicyError, match=r"trained policy in .* cannot be read.*Train it again"):
        load_trained(folder)


@pytest.mark.slow
def test_the_notebook_s_error_on_pusht(shared_data):
    """20,059 training and 5,591 test frames; mean over seeds of the L2 error between 21.4 and 22.3 px."""
    from pipeline.lerobot_format.read import read_dataset

    demos = read_dataset(shared_data / "pusht", name="pusht")
    split = Split((Fold(tuple(range(164)), tuple(range(164, 206))),), 0, "hash")
    settings = {"protocol": "notebook", "history": 3, "chunk": 1, "recipe": "every_frame"}
    train, test = (
        make_windows(demos, semantics(demos), STATE_ONLY, part, statistics_episodes=range(206), **settings)
        for part in (range(164), range(164, 206))
    )
    trained = train_policy("notebook_pusht", train, seeds=range(5), steps=3000, threads=2)
    found = predict_policy(trained.policy, test, name="p", observations="state", fold=0)
    errors = episode_errors(found, demos, semantics(demos), split, protocol="notebook")
    l2 = summarise(errors, protocol="notebook", fps=demos.fps, chunk=1)["first_step_l2"]
    assert (len(train), len(test)) == (20_059, 5_591)
    assert 21.4 < l2 < 22.3

"""A class of the user's own: the documentation's example through the whole pipeline, what is kept, and clear messages."""

import re
from pathlib import Path

import numpy as np
import pytest

from pipeline.config import parse_config
from pipeline.errors import ConfigError, PolicyError
from pipeline.experiment import from_config
from pipeline.methods import METHODS
from pipeline.policies.own import load_own_class, source_hash
from pipeline.train import load_trained, save_trained, train_policy
from tests.hand_made import random_walks
from tests.test_train import TEST, lay

DOCS = Path(__file__).parents[2] / "docs/own_policies.md"


@pytest.fixture
def write(tmp_path):
    """Write a file with a class in it; its address."""

    def written(text: str, name: str = "Mine") -> str:
        (tmp_path / "mine.py").write_text(text)
        return f"{tmp_path / 'mine.py'}:{name}"

    return written


@pytest.fixture
def ridge(write):
    """The documentation's example."""
    code = re.search(r"```python\n(.*?)```", DOCS.read_text(), re.DOTALL)[1]
    return write(code, "RidgePolicy")


def fit(address, **more):
    return train_policy(address, lay(random_walks(), address), seeds=(0, 3), steps=3, **more)


def test_the_documented_example_comes_back_from_its_files(ridge, tmp_path):
    trained = fit(ridge, settings={"penalty": 1e-4})
    save_trained(trained, tmp_path / "policy")
    again = load_trained(tmp_path / "policy")
    seen = lay(random_walks(), ridge, TEST).observations()
    predicted = trained.policy.predict(seen)
    assert predicted.shape == (2, len(seen), 4, 2)
    np.testing.assert_array_equal(again.policy.predict(seen), predicted)
    assert again.policy.objects[1].penalty == 1e-4
    assert (again.policy.seeds, again.parameters) == ((0, 3), trained.policy.objects[0].weights.size)
    np.testing.assert_array_equal(again.policy.one_seed(1).predict(seen)[0], predicted[1])
    assert {path.suffix for path in (tmp_path / "policy").iterdir()} == {".safetensors", ".json"}


def test_it_learns_what_least_squares_learns(ridge):
    windows = lay(random_walks(), ridge)
    policy = fit(ridge, settings={"penalty": 0.0}).policy
    seen = windows.observations().values.reshape(len(windows), -1)
    seen = np.column_stack([seen, np.ones(len(seen))])
    actions, mask = windows.targets()
    known = mask[:, 3]
    expected = np.linalg.lstsq(seen[known].astype(np.float64), actions[known, 3], rcond=None)[0]
    np.testing.assert_allclose(policy.objects[0].weights[:, 3], expected, rtol=0.02, atol=1e-3)


STORED = """
import json
class Mine:
    def fit(self, observations, actions, mask, seed):
        self.anything = {1, 2, seed}
        self.answer = actions.mean(axis=0)
    def predict(self, observations):
        return self.answer[None].repeat(len(observations), axis=0) + max(self.anything)
    def save(self, folder):
        (folder / "deeper").mkdir()
        (folder / "deeper/a.json").write_text(json.dumps([sorted(self.anything), self.answer.tolist()]))
    def load(self, folder):
        import numpy as np
        anything, answer = json.loads((folder / "deeper/a.json").read_text())
        self.anything, self.answer = set(anything), np.array(answer, np.float32)
"""


def test_a_class_may_keep_itself(write, tmp_path):
    trained = fit(write(STORED))
    save_trained(trained, tmp_path / "policy")
    seen = lay(random_walks(), "mlp", TEST).observations()
    again = load_trained(tmp_path / "policy").policy
    np.testing.assert_allclose(again.predict(seen), trained.policy.predict(seen))
    assert again.objects[1].anything == {1, 2, 3}


HEAD = """class Mine:
    def predict(self, observations): return {answer}
    def fit(self, observations, actions, mask, seed):
        {fit}
"""


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("class Other: pass", "has no class 'Mine'"),
        ("class Mine: pass", "has no method 'fit(observations, actions, mask, seed)'"),
        (
            "class Mine:\n    def fit(self, x, y): pass\n    def predict(self, x): pass",
            "'fit' takes 2 arguments beside self",
        ),
        ("import nowhere_to_be_found", "importing it raised ModuleNotFoundError"),
        ("class Mine(", "importing it raised SyntaxError"),
        (HEAD.format(answer="None", fit="self.net = open"), "the attribute 'net' is a builtin_function_or_method"),
        (
            HEAD.format(answer="None", fit="1 / 0"),
            r"fit raised ZeroDivisionError: division by zero \(mine.py, line 4\)",
        ),
        (HEAD.format(answer="None", fit="pass") + "    def save(self, folder): pass", "only one of save"),
        (HEAD.format(answer="None", fit="pass") + "    def __init__(self, rate): pass", "__init__ raised TypeError"),
    ],
)
def test_what_is_wrong_is_said_in_one_message(write, text, words):
    with pytest.raises(PolicyError, match=words.replace("(obs", r"\(obs").replace("seed)", r"seed\)")):
        fit(write(text))


def test_a_wrong_shape_is_said(write):
    policy = fit(write(HEAD.format(answer="observations", fit="pass"))).policy
    with pytest.raises(PolicyError, match=r"returned an array of shape .*; expected \(\d+, 4, 2\)"):
        policy.predict(lay(random_walks(), "mlp", TEST).observations())


def test_no_such_file_or_module(tmp_path):
    with pytest.raises(PolicyError, match="there is no file"):
        load_own_class(f"{tmp_path}/nothing.py:Mine")
    with pytest.raises(PolicyError, match="no module 'nothing.at_all' can be imported here"):
        load_own_class("nothing.at_all:Mine")


def test_a_module_that_is_installed():
    with pytest.raises(PolicyError, match="'fit' takes 1 argument"):
        load_own_class("pipeline.policies.mlp:Mlp")


def test_a_changed_file_is_another_policy(write):
    before = source_hash(write(STORED))
    assert source_hash(write(STORED + "\n")) != before
    assert METHODS["x.py:Y"].trained
    assert "x.py:Y" in METHODS
    assert "mlp2" not in METHODS
    assert "external" not in METHODS, "predictions made elsewhere can be looked up, not trained"
    assert METHODS["external"].trained


def test_in_the_configuration(tmp_path):
    toml = {"datasets": {"d": {"source": "d"}}, "policies": {"mine": {"method": "m.py:Mine", "chunks": [1, 16]}}}
    experiment = from_config(parse_config(toml, "file"), "d", tmp_path)
    assert experiment.policies["mine"].method == f"{tmp_path}/m.py:Mine"
    assert [v.name for v in experiment.variants if v.family == "mine"] == ["mine_k01", "mine_k16"]
    with pytest.raises(
        ConfigError, match=r"\[policies.own\] features is not for the method 'm.py:Mine'. It takes history"
    ):
        parse_config({"policies": {"own": {"method": "m.py:Mine", "chunks": [1], "features": "a.py:b"}}}, "file")
    with pytest.raises(ConfigError, match="A class of your own is named by its file or module"):
        parse_config({"policies": {"mlp": {"method": "external", "chunks": [1]}}}, "file")

"""The configuration file: what it takes, and what it says when something is wrong."""

from pathlib import Path

import pytest

from pipeline.config import Config, check_slug, hash_of, load_config, parse_config
from pipeline.errors import ConfigError

ROOT = Path(__file__).resolve().parents[1]


def test_shipped_file_is_the_built_in_default():
    assert load_config(ROOT / "demobench.toml") == Config()


@pytest.mark.parametrize(
    ("raw", "words"),
    [
        ({"benchmark": {"seed": 3}}, ["unknown key 'seed' in [benchmark]", "Did you mean 'seeds'?"]),
        ({"bench": {}}, ["unknown key 'bench' at the top level", "'benchmark'"]),
        ({"policies": {"a": {"method": "mpl", "chunks": [1]}}}, ["method 'mpl' does not exist", "Did you mean 'mlp'?"]),
        ({"datasets": {"x": {"sorce": "y", "source": "z"}}}, ["unknown key 'sorce' in [datasets.x]", "'source'"]),
        ({"store": {"path": "s3://bucket/x"}}, ["a URL", "give a path"]),
        ({"tracking": {"mlflow": "postgres"}}, ["[tracking] mlflow", "sqlite"]),
        ({"datasets": {"..": {"source": "x"}}}, ["cannot be a name"]),
        ({"datasets": {"a/b": {"source": "x"}}}, ["cannot be a name"]),
        ({"benchmark": {"seeds": 0}}, ["benchmark.seeds", "greater than or equal to 1"]),
        ({"benchmark": {"protocol": "loose"}}, ["benchmark.protocol", "'strict' or 'notebook'"]),
        (
            {"policies": {"mlp": {"method": "mlp", "chunks": [1], "observations": ["stat"]}}},
            ["[policies.mlp] sees the observation set 'stat'", "Did you mean 'state'"],
        ),
    ],
)
def test_mistakes_are_named(raw, words):
    with pytest.raises(ConfigError) as caught:
        parse_config(raw, "demobench.toml")
    for word in ["demobench.toml", *words]:
        assert word in str(caught.value)


def test_no_such_file_and_not_toml(tmp_path):
    with pytest.raises(ConfigError, match="No configuration file at"):
        load_config(tmp_path / "absent.toml")
    (tmp_path / "bad.toml").write_text("[benchmark\nseeds = 3")
    with pytest.raises(ConfigError, match="cannot be read as TOML"):
        load_config(tmp_path / "bad.toml")


@pytest.mark.parametrize("name", ["..", "a..b", "/etc", "a/b", ".hidden", "", "x" * 81, "a b", "a\n"])
def test_names_that_could_walk_out_of_a_folder_are_refused(name):
    with pytest.raises(ConfigError):
        check_slug(name, "test")


def test_hash_does_not_depend_on_the_order_of_keys():
    assert hash_of({"a": 1, "b": [1, 2]}) == hash_of({"b": [1, 2], "a": 1})
    assert hash_of({"a": 1}) != hash_of({"a": 2})

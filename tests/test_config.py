"""The configuration file: what it takes, and what it says when something is wrong."""

from pathlib import Path

import pytest

from pipeline.config import AugmentConfig, Config, PolicyConfig, check_slug, hash_of, load_config, parse_config
from pipeline.errors import ConfigError
from pipeline.experiment import from_config

ROOT = Path(__file__).resolve().parents[1]


def test_shipped_file_is_the_built_in_default():
    assert load_config(ROOT / "demobench.toml") == Config()


@pytest.mark.parametrize("file", sorted((ROOT / "experiments").glob("*.toml")), ids=lambda file: file.stem)
def test_every_experiment_of_the_docs_is_read(file):
    config = load_config(file)
    ((name, dataset),) = config.datasets.items()
    made = from_config(config, name, file.parent)
    assert dataset.champion.split("/")[0] in [variant.name for variant in made.variants]
    assert file.name in (ROOT / "docs" / "closed_loop.md").read_text()


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
        (
            {"policies": {"a": {"method": "mlp", "chunks": [1], "settings": {"blcks": 2}}}},
            ["[policies.a]", "no setting 'blcks'", "Did you mean 'blocks'?"],
        ),
        (
            {"policies": {"a": {"method": "mlp", "chunks": [1], "augment": {"symetry": "x"}}}},
            ["unknown key 'symetry' in [policies.a.augment]", "Did you mean 'symmetry'?"],
        ),
        (
            {"policies": {"a": {"method": "mlp", "chunks": [1], "features": "pusht_blockframe"}}},
            ["features 'pusht_blockframe' do not exist", "Did you mean 'pusht_block_frame'?"],
        ),
        (
            {"policies": {"a": {"method": "mlp", "chunks": [1], "augment": {"symmetry": "mirror"}}}},
            ["augment.symmetry 'mirror' does not exist", "pusht_mirror"],
        ),
        (
            {"policies": {"a": {"method": "lwr", "chunks": [1], "augment": {"noise": 0.1}}}},
            ["augment.noise is not for the method 'lwr'", "symmetry"],
        ),
        ({"policies": {"a": {"method": "hold_still", "history": 2}}}, ["history is not for the method 'hold_still'"]),
        ({"policies": {"a": {"method": "flow", "chunks": [1], "steps": 9, "cpu_seconds": 9}}}, ["two budgets"]),
        ({"policies": {"a": {"method": "notebook_pusht", "settings": {"width": 9}}}}, ["takes none"]),
        (
            {"policies": {"a": {"method": "act", "chunks": [1], "settings": {"width": 30, "heads": 4}}}},
            ["[policies.a] width is 30"],
        ),
        ({"benchmark": {"seeds": 0}}, ["benchmark.seeds", "greater than or equal to 1"]),
        ({"benchmark": {"seeds": 2, "rollout_seeds": 3}}, ["rollout_seeds is 3 and seeds is 2", "lower rollout_seeds"]),
        ({"benchmark": {"rollouts_from": -1}}, ["benchmark.rollouts_from", "greater than or equal to 0"]),
        ({"benchmark": {"protocol": "loose"}}, ["benchmark.protocol", "'strict' or 'notebook'"]),
        (
            {"policies": {"mlp": {"method": "mlp", "chunks": [1], "observations": ["stat"]}}},
            ["[policies.mlp] sees the observation set 'stat'", "Did you mean 'state'"],
        ),
        (
            {"policies": {"a": {"method": "mlp", "chunks": 16}}},
            ["policies.a.chunks: ", "should be a list, such as [1, 16] (got 16)"],
        ),
        (
            {"policies": {"a": {"method": "mlp", "chunks": [1, 0]}}},
            ["policies.a.chunks.value 2: ", "greater than or equal to 1"],
        ),
        (
            {"datasets": {"tape": {"source": "x", "kind": "torque"}}},
            [
                "datasets.tape.kind: Input should be 'auto', or: ",
                "'position', 'velocity', 'delta' or 'other'",
                "(got 'torque')",
            ],
        ),
        (
            {"policies": {"a": {"method": "mlp", "chunks": [1], "settings": {"blocks": "3"}}}},
            ["[policies.a] settings.blocks", "valid integer"],
        ),
        (
            {"policies": {"mlp": {"method": "mlp", "chunks": [1], "datasets": ["so100_sim"]}}},
            ["[policies.mlp] is for the data set 'so100_sim'", "Did you mean 'so101_sim'"],
        ),
        (
            {
                "policies": {
                    "mlp": {"method": "mlp", "chunks": [1], "datasets": ["so101_sim"], "observations": ["position"]}
                }
            },
            ["[policies.mlp] sees the observation set 'position', which none of its data sets has"],
        ),
    ],
)
def test_mistakes_are_named(raw, words):
    with pytest.raises(ConfigError) as caught:
        parse_config(raw, "demobench.toml")
    for word in ["demobench.toml", *words]:
        assert word in str(caught.value)


def test_what_a_policy_was_not_given_is_not_in_its_hash():
    """Keys that came later must not make results stale that do not use them."""
    policy = Config().policies["mlp"]
    assert set(policy.model_dump()) == {"method", "chunks", "observations", "only_when_named"}
    asked = PolicyConfig(method="flow", chunks=(16,), history=2, augment=AugmentConfig(symmetry="pusht_mirror"))
    assert PolicyConfig.model_validate(asked.model_dump(mode="json")) == asked
    assert asked.given == {"history": 2, "symmetry": "pusht_mirror"}
    assert asked.view == {"symmetry": "pusht_mirror"}


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

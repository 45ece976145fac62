"""From words on the command line to experiments and the keys they are stored under."""

from pathlib import Path

import pytest

from pipeline.config import Config, parse_config
from pipeline.errors import ConfigError
from pipeline.experiment import Choices, known_as, parse_chunks, resolve_target, select_rows, variants

CONFIG = parse_config(
    {
        "datasets": {"tape": {"source": "data/tape"}, "pusht_sim": {"source": "embedded:pusht_sim"}},
        "policies": {"mlp": {"method": "mlp", "chunks": [1, 16]}},
    },
    "test",
)
HERE = Path("/somewhere")


def target(word="tape", registered=None, **choices):
    return resolve_target(word, CONFIG, HERE, Choices(**choices), registered or {})


def test_a_name_of_the_file_keeps_its_name_and_resolves_its_folder():
    found = target()
    assert found.key == "tape"
    assert found.experiment.dataset.source == "/somewhere/data/tape"
    assert [v.name for v in found.selected] == [
        "hold_still", "mean_action", "constant_velocity", "nearest_neighbour", "mlp_k01", "mlp_k16",
    ]  # fmt: skip


def test_the_protocol_alone_names_a_variant_in_words():
    assert target(protocol="notebook").key == "tape+notebook"
    assert target(protocol="strict").key == "tape"


def test_other_settings_make_a_variant_with_a_hash():
    two_seeds = target(seeds=2)
    assert two_seeds.key.startswith("tape+")
    assert two_seeds.key == target(seeds=2).key != target(seeds=3).key
    assert two_seeds.experiment.seeds == 2
    assert target(seeds=5).key == "tape", "the file's own number changes nothing"


def test_a_budget_and_its_number_of_steps_are_the_same_settings():
    assert target(steps=600).key == target(budget="quick").key
    assert target(steps=601).experiment.budget is None


def test_selecting_makes_no_variant_and_baselines_are_always_there():
    found = target(policies=("mlp",), chunks=(16,))
    assert found.key == "tape"
    assert found.file_has_it
    assert [v.name for v in found.selected][-1] == "mlp_k16"
    assert {"hold_still", "nearest_neighbour"} <= {v.name for v in found.selected}
    assert "mlp_k01" not in {v.name for v in found.selected}


def test_a_chunk_that_the_file_lacks_makes_a_variant_the_ui_cannot_run():
    found = target(chunks=(8,))
    assert found.key.startswith("tape+")
    assert not found.file_has_it
    assert "mlp_k08" in {v.name for v in found.selected}


TWO = {
    "datasets": {"tape": {"source": "tape"}, "other": {"source": "other"}},
    "policies": {
        "mlp": {"method": "mlp", "chunks": [1, 16]},
        "long": {"method": "mlp", "chunks": [32], "execute": 16},
        "theirs": {"method": "mlp", "chunks": [4], "datasets": ["other"]},
    },
}


def of_two(dataset, **choices):
    return resolve_target(dataset, parse_config(TWO, "test"), HERE, Choices(**choices), {})


def test_chunk_sizes_that_the_file_has_select_and_others_go_to_every_policy_that_can_carry_them_out():
    found = of_two("tape", chunks=(1, 16))
    assert found.key == "tape"
    assert {v.name for v in found.selected if v.is_trained} == {"mlp_k01", "mlp_k16"}
    assert {v.name for v in of_two("tape", chunks=(8,)).selected if v.is_trained} == {"mlp_k08"}
    assert {v.name for v in of_two("tape", chunks=(24,)).selected if v.is_trained} == {"mlp_k24", "long_k24"}
    with pytest.raises(ConfigError, match=r"\[policies.long\] execute = 16"):
        of_two("tape", chunks=(8,), policies=("mlp", "long"))


def test_a_policy_made_for_one_data_set_is_in_no_other_and_changes_nothing_there():
    assert "theirs_k04" in {v.name for v in of_two("other").selected}
    mine = of_two("tape").experiment
    assert "theirs_k04" not in {v.name for v in mine.variants}
    without = {name: policy for name, policy in TWO["policies"].items() if name != "theirs"}
    plain = resolve_target("tape", parse_config(TWO | {"policies": without}, "test"), HERE, Choices(), {}).experiment
    assert mine == plain
    without["theirs"] = {"method": "mlp", "chunks": [4]}
    plain = resolve_target("other", parse_config(TWO | {"policies": without}, "test"), HERE, Choices(), {}).experiment
    assert of_two("other").experiment == plain
    with pytest.raises(ConfigError, match="No policy 'theirs'"):
        of_two("tape", policies=("theirs",))


def test_unknown_words_are_answered_with_the_nearest():
    with pytest.raises(ConfigError, match="Did you mean 'tape'"):
        target("tapes")
    with pytest.raises(ConfigError, match="No policy 'mpl'. Did you mean 'mlp'"):
        target(policies=("mpl",))
    with pytest.raises(ConfigError, match="no observation set 'stat'. Did you mean 'state'"):
        target(observations=("stat",))
    with pytest.raises(ConfigError, match="whole numbers"):
        parse_chunks("1,two")


def test_a_folder_gets_its_name_and_a_hash_when_that_is_taken(tmp_path):
    folder = tmp_path / "my data!"
    folder.mkdir()
    first = target(str(folder))
    assert first.key == "my-data"
    again = target(str(folder), registered={first.key: first.experiment.model_dump(mode="json")})
    assert again.key == first.key
    other = target(str(folder), registered={first.key: {"dataset": {"source": "/elsewhere"}}})
    assert other.key.startswith("my-data-")
    # It keeps that name when the other is gone, and a name belongs to somebody though only with other settings.
    assert target(str(folder), registered={other.key: other.experiment.model_dump(mode="json")}).key == other.key
    assert target(str(folder), registered={f"{first.key}+1a2b": {"dataset": {"source": "/elsewhere"}}}).key == other.key
    named_like_the_file = tmp_path / "tape"
    named_like_the_file.mkdir()
    assert target(str(named_like_the_file)).key.startswith("tape-")


def test_hub_addresses_are_data_sets():
    found = target("hub:lerobot/pusht@main")
    assert found.key == "pusht"
    assert found.experiment.dataset.source == "hub:lerobot/pusht@main"


def test_chunks_are_zero_padded_and_wrong_chunks_refused():
    names = [v.name for v in variants(Config().policies)]
    assert names == ["mlp_k01", "mlp_k04", "mlp_k16", "mlp_k32", "recipe_k32", "notebook_pusht"]
    with pytest.raises(ConfigError, match="needs chunk sizes"):
        variants(parse_config({"policies": {"mlp": {"method": "mlp"}}}, "t").policies)
    with pytest.raises(ConfigError, match="takes none"):
        variants(parse_config({"policies": {"x": {"method": "hold_still", "chunks": [1]}}}, "t").policies)


def test_a_data_set_that_was_benchmarked_before_is_found_by_its_key():
    variant = target(seeds=2)
    registered = {variant.key: variant.experiment.model_dump(mode="json")}
    again = target(variant.key, registered)
    assert again.key == variant.key
    assert again.experiment == variant.experiment
    with pytest.raises(ConfigError, match="Did you mean"):
        target("tap", registered)


def test_rows_of_other_observation_sets_are_left_out_and_baselines_stay():
    config = parse_config({"policies": {"mlp": {"method": "mlp", "chunks": [1]}}}, "test")
    asked = resolve_target("pusht_sim", config, HERE, Choices(observations=("pose",)), {})
    rows = [
        {"policy": "mlp_k01", "method": "mlp", "observations": "pose"},
        {"policy": "mlp_k01", "method": "mlp", "observations": "position"},
        {"policy": "nearest_neighbour", "method": "nearest_neighbour", "observations": "position"},
        {"policy": "hold_still", "method": "hold_still", "observations": "position"},
        {"policy": "elsewhere", "method": "mlp", "observations": "pose"},
    ]
    assert select_rows(rows, asked) == [rows[0], rows[3]]


def test_a_data_set_is_found_by_its_short_name_as_long_as_there_is_one():
    config = parse_config({"datasets": {"own": {"source": "own"}}}, "file")

    def known(name, *keys, **more):
        kept = target().experiment.model_dump(mode="json")
        return known_as(name, config, {key: kept | more.get(key[-1], {}) for key in keys})

    assert known("tape", "tape+1234abcd", "other") == "tape+1234abcd"
    assert known("tape", "tape", "tape+1234abcd") == "tape"
    assert known("own", "own+1234abcd") == "own"
    assert known("nothing", "tape+1234abcd") == "nothing"
    assert known("tape", "tape+a", "tape+a+b", "tape+a+b+c") == "tape+a"
    with pytest.raises(
        ConfigError, match=r"several settings: tape\+a \(standard .*\); tape\+b \(.*folds 3.*\). Name one"
    ):
        known("tape", "tape+b", "tape+a", b={"folds": 3})


# Closed loop ----------------------------------------------------------------------------------------------------------


def test_where_and_with_how_many_seeds_policies_are_rolled_out():
    found = target(rollouts=9, rollout_seeds=2).experiment
    assert (found.start_states, found.rollout_seeds) == (range(9), 2)
    assert target(rollouts=9).key.startswith("tape+")
    later = parse_config(
        {"benchmark": {"rollouts": 5, "rollouts_from": 1000}, "datasets": {"x": {"source": "x"}}}, "test"
    )
    assert resolve_target("x", later, HERE, Choices(), {}).experiment.start_states == range(1000, 1005)


def test_no_more_seeds_are_rolled_out_than_are_trained():
    with pytest.raises(ConfigError, match="rollout_seeds is 6 and seeds is 5: only what is trained can be rolled out"):
        target(rollout_seeds=6)
    three = parse_config({"benchmark": {"rollout_seeds": 3}, "datasets": {"x": {"source": "x"}}}, "test")
    found = resolve_target("x", three, HERE, Choices(seeds=2), {}).experiment
    assert (found.seeds, found.rollout_seeds) == (2, 2), "fewer seeds on the command line are fewer everywhere"


def test_experiments_that_were_stored_before_there_were_seeds_to_roll_out_are_the_same():
    stored = target().experiment.model_dump(mode="json")
    assert not {"rollout_seeds", "rollouts_from"} & set(stored)
    assert target("tape", {"tape": stored}).experiment == target().experiment


def test_what_is_trained_is_rolled_out_and_of_the_rest_hold_still():
    driven = {v.name for v in target().experiment.variants if v.is_rolled_out}
    assert driven == {"hold_still", "mlp_k01", "mlp_k16"}

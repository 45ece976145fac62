"""Which features are the action and the state, their names and units, and episodes that are left out: as set, from the
configuration file to the columns.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from assets_defs.plan import Plan
from pipeline.config import DatasetConfig, load_config, parse_config
from pipeline.errors import ConfigError, DatasetError
from pipeline.experiment import Experiment, from_config
from pipeline.lerobot_format.columns import arrange, choose_roles
from pipeline.lerobot_format.read import check_experiment, load_experiment, read_dataset
from pipeline.store import Store
from pipeline.types import ACTION, STATE, ColumnChoice, Demonstrations, Feature
from pipeline.windows import make_windows
from tests.makers import Recording, edit_info, tiny_recording, write_v2, write_v3

DOCS = Path(__file__).parents[2] / "docs/configuration.md"
ARM, GRIPPER, FORCE, VELOCITY = (f"observation.{part}" for part in ("arm", "gripper", "force", "arm_velocity"))


def several(episodes: int = 4, frames: int = 20) -> Recording:
    """A recording whose state could be several features; two of them call a column `x`."""
    made = tiny_recording(episodes, frames)
    random, total = np.random.default_rng(1), episodes * frames

    def values(width: int) -> np.ndarray:
        return random.standard_normal((total, width)).astype(np.float32)

    parts = {
        ARM: (("x", "y"), values(2), "float32"),
        GRIPPER: (None, values(1), "float32"),
        FORCE: (("x", "torque_nm"), values(2), "float32"),
        VELOCITY: (None, values(2), "float32"),
    }
    return replace(made, features=made.features | parts)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return write_v3(tmp_path_factory.mktemp("columns") / "set", several())


def chosen(folder: Path, **choice) -> Demonstrations:
    return read_dataset(folder, name="set", choice=ColumnChoice(**choice))


# What is chosen is what is there


def test_nothing_is_chosen_and_nothing_changes(folder: Path):
    made = several()
    read = chosen(folder)
    assert set(read.columns) == set(made.features)
    for key, (_, values, _) in made.features.items():
        np.testing.assert_array_equal(read.columns[key], values)
    assert list(read.columns)[:2] == [ACTION, STATE]
    assert read.warnings == ()


def test_features_side_by_side_are_the_state(folder: Path):
    made = several()
    read = chosen(folder, state=(FORCE, ARM))
    np.testing.assert_array_equal(read.columns[STATE], np.hstack([made.features[key][1] for key in (FORCE, ARM)]))
    assert read.features[STATE].names == ("force.x", "torque_nm", "arm.x", "y")
    assert read.features[STATE].units == (None, "N·m", None, None)
    for key in (FORCE, ARM):  # each may still be seen by itself
        np.testing.assert_array_equal(read.columns[key], made.features[key][1])
    assert read.warnings == ()


def test_one_feature_takes_the_name_of_its_part(folder: Path):
    made = several()
    read = chosen(folder, state=(GRIPPER,), action=(ARM,))
    np.testing.assert_array_equal(read.columns[STATE], made.features[GRIPPER][1])
    np.testing.assert_array_equal(read.columns[ACTION], made.features[ARM][1])
    assert read.features[ACTION].names == ("x", "y")
    assert read.features[STATE].names == ("gripper",)
    assert not {ARM, GRIPPER} & set(read.columns)
    assert read.columns.keys() == read.features.keys()


def test_the_recorded_state_may_be_a_part_of_the_state(folder: Path):
    made = several()
    read = chosen(folder, state=(STATE, GRIPPER))
    np.testing.assert_array_equal(read.columns[STATE], np.hstack([made.features[key][1] for key in (STATE, GRIPPER)]))
    assert read.features[STATE].names == ("joint_0", "joint_1", "gripper")


def test_an_action_in_parts_is_one_and_nobody_sees_its_parts(folder: Path):
    made = several()
    read = chosen(folder, action=(GRIPPER, FORCE))
    np.testing.assert_array_equal(read.columns[ACTION], np.hstack([made.features[key][1] for key in (GRIPPER, FORCE)]))
    assert GRIPPER not in read.columns
    assert FORCE not in read.features


def test_names_that_clash_have_the_features_in_front():
    parts = {key: Feature(key, ("x",), (None,)) for key in ("left.arm", "right.arm", ACTION)}
    columns = {key: np.zeros((2, 1), np.float32) for key in parts}
    roles = choose_roles(list(parts), ColumnChoice(state=("left.arm", "right.arm")), "set")
    _, features = arrange(columns, parts, roles)
    assert features[STATE].names == ("left.arm.x", "right.arm.x")


def test_names_that_clash_whatever_is_in_front_are_numbered():
    parts = {"a": Feature("a", ("x", "b.x"), (None,) * 2), "b": Feature("b", ("x", "a.x"), (None,) * 2)}
    parts[ACTION] = Feature(ACTION, ("x",), (None,))
    columns = {key: np.zeros((2, len(feature.names)), np.float32) for key, feature in parts.items()}
    _, features = arrange(columns, parts, choose_roles(list(parts), ColumnChoice(state=("a", "b")), "set"))
    assert len(set(features[STATE].names)) == 4


widths = st.lists(st.integers(1, 4), min_size=2, max_size=5)


@settings(max_examples=60, deadline=None)
@given(widths=widths, order=st.randoms(use_true_random=False), names=st.sampled_from(["same", "own", "number"]))
def test_choosing_features_is_putting_them_side_by_side(widths: list[int], order, names: str):
    keys = [f"part.{i}" for i in range(len(widths))]
    columns = {ACTION: np.zeros((3, 1), np.float32)}
    features = {ACTION: Feature(ACTION, ("a",), (None,))}
    for number, (key, width) in enumerate(zip(keys, widths, strict=True)):
        columns[key] = np.arange(3 * width, dtype=np.float32).reshape(3, width) + 100 * number
        said = {"same": "x", "own": f"{number}x", "number": ""}[names]
        features[key] = Feature(key, tuple(f"{said}{i}" for i in range(width)), (f"u{number}",) * width)
    order.shuffle(keys)
    roles = choose_roles(list(columns), ColumnChoice(state=tuple(keys)), "set")
    before = {key: values.copy() for key, values in columns.items()}
    arranged, described = arrange(columns, features, roles)
    np.testing.assert_array_equal(arranged[STATE], np.concatenate([columns[key] for key in keys], axis=1))
    assert described[STATE].units == sum((features[key].units for key in keys), ())
    assert len(set(described[STATE].names)) == arranged[STATE].shape[1]
    assert arranged.keys() == described.keys()
    for key, values in before.items():  # what was given is as it was
        np.testing.assert_array_equal(columns[key], values)


def test_one_hash_however_the_state_came_about(folder: Path, tmp_path: Path):
    """A state of one part, chosen, is the same demonstrations as a data set that keeps it as `observation.state`."""
    made = several()
    recorded = {key: made.features[key] for key in (ACTION, "next.done")} | {STATE: made.features[ARM]}
    others = {key: made.features[key] for key in (GRIPPER, FORCE, VELOCITY)}
    whole = write_v3(tmp_path / "whole", replace(made, features=recorded | others))
    assert chosen(folder, state=(ARM,)).content_hash == chosen(whole).content_hash
    assert chosen(folder, state=(ARM,)).content_hash != chosen(folder, state=(ARM, GRIPPER)).content_hash


# Units


def test_units_of_all_columns_or_by_name(folder: Path):
    everywhere = chosen(folder, units="degrees", state=(FORCE,))
    assert everywhere.features[ACTION].units == ("deg", "deg")
    assert everywhere.features[STATE].units == ("deg", "deg")
    assert everywhere.features[ARM].units == (None, None)
    some = chosen(folder, units={"joint_1": "rad", "x": "ticks"}, state=(FORCE,))
    assert some.features[ACTION].units == (None, "rad")
    assert some.features[STATE].units == ("ticks", "N·m")


@pytest.mark.parametrize("unit", ["", "  ", "d" * 25, "de\ng", "\x1b[31m"])
def test_a_unit_that_is_no_word(folder: Path, unit: str):
    with pytest.raises(ConfigError, match="expected a short word such as"):
        chosen(folder, units={"joint_0": unit})


# Refused choices


@pytest.mark.parametrize(
    ("choice", "words"),
    [
        ({"state": ("observation.arms",)}, r"state names .*observation\.arms.*Did you mean 'observation\.arm'\?"),
        ({"action": ("actions",)}, r"action names .*actions.*Did you mean 'action'\?"),
        ({"action": ("frame_index",)}, "which .* does not have as numbers. Known: action, "),
        ({"state": (ARM, ACTION)}, "state names 'action', which is the action"),
        ({"action": (ARM,), "state": (ARM,)}, "which is the action"),
        ({"state": (ARM, GRIPPER, ARM)}, "state names a feature twice"),
        ({"units": {"joint_7": "deg"}}, r"units names the column 'joint_7'.*Did you mean 'joint_[01]'\?"),
        ({"units": {"y": "m"}}, "units names the column 'y', which neither action nor observation.state has"),
        ({"exclude": (1, 9)}, "exclude names the episode 9, .*its 4 episodes are numbered 0 to 3"),
        ({"exclude": (0, 1, 2, 3)}, "exclude leaves out all 4 episodes"),
    ],
)
def test_a_choice_that_cannot_be(folder: Path, choice: dict, words: str):
    with pytest.raises(ConfigError, match=words) as caught:
        chosen(folder, **choice)
    assert "\n" not in str(caught.value)


def test_a_chosen_feature_that_is_no_numbers(tmp_path: Path):
    folder = write_v3(tmp_path / "set", several())
    edit_info(folder, lambda info: info["features"][ARM].update(dtype="string"))
    with pytest.raises(DatasetError, match=r"'observation\.arm' is string \[2\]; expected numbers"):
        chosen(folder, state=(ARM,))


@pytest.mark.parametrize(
    ("toml", "words"),
    [
        ({"state": []}, "datasets.mine.state"),
        ({"state": "observation.arm"}, "datasets.mine.state"),
        ({"exclude": [-1]}, "datasets.mine.exclude.value 1"),
        ({"exclude": ["a"]}, "datasets.mine.exclude.value 1"),
        ({"features": ["x.parquet"]}, "datasets.mine.features"),
        ({"units": 3}, "datasets.mine.units"),
        ({"excluded": [1]}, "unknown key 'excluded' in .*Did you mean 'exclude'"),
    ],
)
def test_settings_that_cannot_be(toml: dict, words: str):
    with pytest.raises(ConfigError, match=words):
        parse_config({"datasets": {"mine": {"source": "x"} | toml}}, "demobench.toml")


# Episodes that are left out


@pytest.mark.parametrize("write", [write_v2, write_v3, lambda f, made: write_v3(f, made, episodes_per_file=1)])
def test_excluded_episodes_are_not_there(tmp_path: Path, write):
    made = several()
    read = chosen(write(tmp_path / "set", made), exclude=(0, 2))
    kept = np.r_[20:40, 60:80]
    assert read.episode_ids.tolist() == [1, 3]
    assert read.episode_starts.tolist() == [0, 20, 40]
    assert read.excluded == (0, 2)
    assert read.tasks == ("pull", "pull")
    for key, (_, values, _) in made.features.items():
        np.testing.assert_array_equal(read.columns[key], values[kept])
    assert read.warnings == ()


def test_a_bad_episode_can_be_excluded(tmp_path: Path):
    """The refusal says how, and the file of an excluded episode need not even be there."""
    folder = write_v2(tmp_path / "set", several())
    (folder / "data/chunk-000/episode_000002.parquet").unlink()
    with pytest.raises(DatasetError, match=r"episode_000002\.parquet is missing"):
        chosen(folder)
    assert chosen(folder, exclude=(2,)).episode_ids.tolist() == [0, 1, 3]


# The whole way from the file


FILE = """
[datasets.mine]
source = "set"
state = ["observation.arm", "observation.gripper"]
units = { joint_0 = "degrees", joint_1 = "degrees", x = "mm" }
exclude = [2, 1, 2]
observations = { state = ["observation.state"], all = ["observation.state", "score"], seen = ["observation.force"] }

[datasets.mine.features]
score = "scores/score.parquet"
"""


def scores(path: Path, episodes: int = 4, frames: int = 20) -> np.ndarray:
    """A file of two numbers a frame."""
    values = np.random.default_rng(2).standard_normal((episodes * frames, 2)).astype(np.float32)
    rows = {
        "episode_index": np.repeat(np.arange(episodes), frames),
        "frame_index": np.tile(np.arange(frames), episodes),
        "value": pa.array(values.tolist(), pa.list_(pa.float32())),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table(rows), path)
    return values


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A configuration file, its data set and its joined feature."""
    (tmp_path / "demobench.toml").write_text(FILE)
    write_v3(tmp_path / "set", several())
    scores(tmp_path / "scores/score.parquet")
    return tmp_path


def experiment_of(place: Path) -> Experiment:
    return from_config(load_config(place / "demobench.toml"), "mine", place)


def test_from_the_configuration_to_the_columns(place: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir("/")  # every path is relative to the file
    made, kept = several(), np.r_[0:20, 60:80]
    demos, semantics = load_experiment(experiment_of(place), place)
    state = np.hstack([made.features[key][1] for key in (ARM, GRIPPER)])
    np.testing.assert_array_equal(demos.columns[STATE], state[kept])
    np.testing.assert_array_equal(demos.columns[ACTION], made.features[ACTION][1][kept])
    np.testing.assert_array_equal(demos.columns["score"], scores(place / "again.parquet")[kept])
    assert demos.features[STATE].units == ("mm", None, None)
    assert demos.features[ACTION].units == ("deg", "deg")
    assert (demos.excluded, demos.episode_ids.tolist()) == ((1, 2), [0, 3])
    assert len(semantics.kinds) == 2


def test_an_observation_set_may_name_a_joined_feature_and_one_that_is_not_the_state(place: Path):
    experiment = experiment_of(place)
    demos, semantics = load_experiment(experiment, place)
    seen = {}
    for observation_set in experiment.observation_sets:
        shape = {"statistics_episodes": [0], "protocol": "strict", "history": 3, "chunk": 2}
        seen[observation_set.name] = make_windows(demos, semantics, observation_set, [0, 1], **shape).values
    assert {name: values.shape for name, values in seen.items()} == {"state": (40, 3), "all": (40, 5), "seen": (40, 2)}
    np.testing.assert_array_equal(seen["all"], np.hstack([demos.columns[STATE], demos.columns["score"]]))


def test_a_joined_feature_may_be_the_state(tmp_path: Path):
    made = several()
    folder, values = write_v2(tmp_path / "set", made), scores(tmp_path / "score.parquet")
    read = chosen(folder, state=("score", ARM), features={"score": tmp_path / "score.parquet"})
    np.testing.assert_array_equal(read.columns[STATE], np.hstack([values, made.features[ARM][1]]))
    assert read.features[STATE].names == ("0", "1", "x", "y")


def test_what_is_checked_before_any_work(place: Path):
    check_experiment(experiment_of(place), place)
    (place / "scores/score.parquet").unlink()
    with pytest.raises(DatasetError, match=r"features\] score: there is no file .*score\.parquet"):
        check_experiment(experiment_of(place), place)
    (place / "demobench.toml").write_text(FILE.replace("observation.arm", "observation.arms"))
    scores(place / "scores/score.parquet")
    with pytest.raises(ConfigError, match=r"Did you mean 'observation\.arm'"):
        check_experiment(experiment_of(place), place)


def test_a_misspelt_feature_of_an_observation_set_is_refused_before_any_work(place: Path):
    """By the lists in meta/ alone where a run begins, and by whatever reads the data set."""
    wrong = 'seen = ["observation.forse"]'
    (place / "demobench.toml").write_text(FILE.replace('seen = ["observation.force"]', wrong))
    message = r"observation set 'seen' asks for 'observation.forse'.*Did you mean 'observation\.force'"
    for check in (check_experiment, load_experiment):
        with pytest.raises(ConfigError, match=message):
            check(experiment_of(place), place)
    (place / "demobench.toml").write_text(FILE.replace('seen = ["observation.force"]', 'seen = ["action"]'))
    with pytest.raises(ConfigError, match="a policy would see what it is to predict"):
        check_experiment(experiment_of(place), place)


def test_the_documented_example(tmp_path: Path):
    example = re.search(r"```toml\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.DOTALL)[1]
    (tmp_path / "demobench.toml").write_text(example)
    joints = ("shoulder", "elbow", "gripper")
    made = tiny_recording(40, 20, joints=3, names=joints)
    action, state = made.features[ACTION], made.features[STATE][1]
    parts = {f"{STATE}.arm": (joints[:2], state[:, :2], "float32"), f"{STATE}.gripper": (None, state[:, 2:], "float32")}
    write_v3(tmp_path / "recordings/tape", replace(made, features={"actions": action} | parts))
    scores(tmp_path / "recordings/force.parquet", episodes=40)
    demos, _ = load_experiment(from_config(load_config(tmp_path / "demobench.toml"), "tape", tmp_path), tmp_path)
    assert demos.episodes == 38
    kept = ~np.isin(np.repeat(np.arange(40), 20), demos.excluded)
    np.testing.assert_array_equal(demos.columns[STATE], state[kept])
    assert demos.features[STATE].names == demos.features[ACTION].names == joints
    assert demos.features[STATE].units == demos.features[ACTION].units == ("deg", "deg", "mm")
    assert demos.warnings == ()


# What makes a reading stale


def plan_of(place: Path, text: str) -> Plan:
    (place / "demobench.toml").write_text(text)
    return Plan(Store(place / "results"), "mine", experiment_of(place), ())


def test_the_settings_of_data_sets_that_use_no_option_are_what_they_were(place: Path):
    plan = plan_of(place, '[datasets.mine]\nsource = "set"\n')
    settings = {"source": str(place / "set"), "kind": "auto", "circular": None}
    assert plan._meaning()["settings"] == settings
    assert set(plan.asked_of_source()) == {"stamp", "settings", "code"}
    assert not DatasetConfig.optional & set(plan.experiment.model_dump(mode="json")["dataset"])


@pytest.mark.parametrize(
    "line",
    [
        'state = ["observation.arm"]',
        'action = "observation.arm"',
        'units = "deg"',
        "exclude = [3]",
        'features = { score = "scores/score.parquet" }',
    ],
)
def test_each_option_makes_the_reading_stale_and_survives_the_store(place: Path, line: str):
    plain = plan_of(place, '[datasets.mine]\nsource = "set"\n')
    other = plan_of(place, f'[datasets.mine]\nsource = "set"\n{line}\n')
    assert plain._meaning() != other._meaning()
    again = Experiment.model_validate_json(other.experiment.model_dump_json())
    assert again == other.experiment


def test_a_joined_file_that_changes_makes_the_reading_stale(place: Path):
    plan = plan_of(place, FILE)
    before = plan.asked_of_source()
    assert plan.asked_of_source() == before
    scores(place / "scores/score.parquet", frames=21)
    assert plan.asked_of_source() != before

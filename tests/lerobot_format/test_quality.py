"""Kinds, circular and dead columns, the clock: known truths, on made and on real demonstrations."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import ConfigError
from pipeline.lerobot_format.kinds import wrap
from pipeline.lerobot_format.quality import (
    dead_by_unit,
    dead_columns,
    dead_warnings,
    inspect_dataset,
    resolve_semantics,
    usual_range,
)
from pipeline.lerobot_format.read import read_dataset
from pipeline.types import ACTION, STATE, Demonstrations
from tests.makers import Recording, demonstrations_of, tiny_demonstrations, tiny_recording

ENVIRONMENT = "observation.environment_state"


def with_feature(recording: Recording, key: str, names: tuple[str, ...], values: np.ndarray) -> Recording:
    return replace(recording, features=recording.features | {key: (names, values.astype(np.float32), "float32")})


def random_walk(recording: Recording, columns: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(sum(recording.lengths), columns)).cumsum(0)


# Kinds


@pytest.mark.parametrize("fps", [10.0, 30.0])
@pytest.mark.parametrize("kind", ["position", "velocity", "delta"])
@pytest.mark.parametrize("names", [("joint_0", "joint_1"), ("0", "1"), ("a", "b")])
def test_the_kind_is_seen_in_the_values(kind: str, fps: float, names: tuple[str, str]):
    demos = tiny_demonstrations(kind=kind, fps=fps, names=names)
    semantics = resolve_semantics(demos)
    assert semantics.kinds == (kind, kind)
    assert semantics.warnings == ()
    assert semantics.state_column == ((None, None) if kind == "delta" else (0, 1))


def test_a_real_arm_lags_and_is_still_seen_as_position():
    """The state follows with five frames of delay and a little noise."""
    random = np.random.default_rng(0)
    recording = tiny_recording(5, 200, joints=3)
    command = np.concatenate([np.sin(np.arange(200)[:, None] / 40 + random.uniform(0, 6, 3)) for _ in range(5)])
    state = np.roll(command, 5, axis=0) + random.normal(0, 0.02, command.shape)
    names = ("joint_0", "joint_1", "joint_2")
    made = with_feature(with_feature(recording, ACTION, names, command), STATE, names, state)
    assert resolve_semantics(demonstrations_of(made)).kinds == ("position",) * 3


def test_tracking_lag_is_the_mean_distance_from_action_to_state():
    demos = tiny_demonstrations()
    expected = np.abs(demos.columns[ACTION].astype(float) - demos.columns[STATE]).mean(0)
    np.testing.assert_allclose(resolve_semantics(demos).tracking_lag, expected, rtol=1e-12)


def test_state_columns_are_matched_by_name_before_place():
    recording = tiny_recording(joints=2)
    values = recording.features[STATE][1][:, ::-1]
    wide = np.hstack([random_walk(recording, 2), values, random_walk(recording, 2, seed=1)])
    names = ("joint_1.vel", "joint_0.vel", "joint_1.pos", "joint_0.pos", "battery", "tilt")
    semantics = resolve_semantics(demonstrations_of(with_feature(recording, STATE, names, wide)))
    assert semantics.kinds == ("position", "position")
    assert semantics.state_column == (3, 2)


def test_a_state_column_of_another_name_is_found_by_its_values():
    recording = tiny_recording(joints=2, names=("left", "right"))
    state = np.hstack([random_walk(recording, 1), recording.features[STATE][1]])
    semantics = resolve_semantics(demonstrations_of(with_feature(recording, STATE, ("x", "y", "z"), state)))
    assert semantics.kinds == ("position", "position")
    assert semantics.state_column == (1, 2)


def test_a_gripper_that_the_state_lacks_is_other():
    recording = tiny_recording(kind="velocity", joints=2)
    names, values, _ = recording.features[ACTION]
    gripper = (np.arange(len(values)) // 17 % 2)[:, None]
    made = with_feature(recording, ACTION, (*names, "gripper"), np.hstack([values, gripper]))
    semantics = resolve_semantics(demonstrations_of(made))
    assert semantics.kinds == ("velocity", "velocity", "other")
    assert semantics.state_column == (0, 1, None)
    assert semantics.tracking_lag == (None, None, None)
    assert semantics.warnings == ()


def test_noise_is_other_and_the_doubt_is_said():
    recording = tiny_recording()
    noise = np.random.default_rng(0).normal(size=(240, 2))
    semantics = resolve_semantics(demonstrations_of(with_feature(recording, ACTION, ("joint_0", "joint_1"), noise)))
    assert semantics.kinds == ("other", "other")
    assert len(semantics.warnings) == 2
    assert all("unsure" in warning and "Set `kind`" in warning for warning in semantics.warnings)


def test_a_name_decides_where_the_values_do_not_and_not_against_clear_values():
    recording = tiny_recording()
    names = ("joint_0_vel", "joint_1_vel")
    noise = np.random.default_rng(0).normal(size=(240, 2))
    unclear = resolve_semantics(demonstrations_of(with_feature(recording, ACTION, names, noise)))
    assert unclear.kinds == ("velocity", "velocity")
    assert "only its name says so" in unclear.warnings[0]
    steady = tiny_recording(frames=200)
    values = np.vstack([steady.features[STATE][1][1:], steady.features[STATE][1][-1:]])
    against = resolve_semantics(demonstrations_of(with_feature(steady, ACTION, names, values)))
    assert against.kinds == ("position", "position")
    assert "its name says velocity" in against.warnings[0]


def test_a_column_that_never_moves_follows_the_others():
    recording = tiny_recording(kind="velocity", joints=3)
    names, values, _ = recording.features[ACTION]
    values = values.copy()
    values[:, 1] = 0
    semantics = resolve_semantics(demonstrations_of(with_feature(recording, ACTION, names, values)))
    assert semantics.kinds == ("velocity",) * 3
    assert semantics.warnings == ("action: joint_1 hardly moves (dead); left out of errors divided by the deviation.",)


def test_a_unit_that_makes_a_moving_column_dead_is_asked_about():
    """A gripper from 0 to 1 that somebody said is in millimetres."""
    demos = tiny_demonstrations()
    features = {
        key: replace(feature, units=(None, "mm")) if key in (ACTION, STATE) else feature
        for key, feature in demos.features.items()
    }
    wrong = replace(demos, features=features)
    assert dead_columns(wrong, ACTION).tolist() == [False, True]
    assert dead_by_unit(wrong, ACTION).tolist() == [False, True]
    assert not dead_by_unit(demos, ACTION).any()
    action, state = dead_warnings(wrong)
    assert action.startswith(
        "action: joint_1 hardly moves for mm (dead); left out of errors divided by the deviation. Is that"
    )
    assert "the unit?" in state
    assert "`units`" in state
    still = {key: np.zeros_like(values) for key, values in demos.columns.items()}
    assert not dead_by_unit(replace(wrong, columns=still), ACTION).any(), "no unit makes it move"


def test_kinds_as_set():
    demos = tiny_demonstrations()
    assert resolve_semantics(demos, kind="delta").kinds == ("delta", "delta")
    mixed = resolve_semantics(demos, kind={"joint_1": "other"})
    assert mixed.kinds == ("position", "other")
    assert mixed.state_column == (0, None)
    assert mixed.tracking_lag[1] is None


def test_kinds_set_wrongly():
    demos = tiny_demonstrations()
    with pytest.raises(ConfigError, match=r"'joint_11', which does not exist\. Did you mean 'joint_1'\?"):
        resolve_semantics(demos, kind={"joint_11": "other"})
    recording = tiny_recording(joints=2)
    names, values, _ = recording.features[ACTION]
    made = with_feature(recording, ACTION, (*names, "gripper.grip"), np.hstack([values, random_walk(recording, 1)]))
    with pytest.raises(ConfigError, match=r'no column of observation.state.*kind = \{"gripper.grip" = "other"\}'):
        resolve_semantics(demonstrations_of(made), kind="position")


# Circular columns


@given(st.floats(-1e4, 1e4))
def test_wrap_is_the_same_angle_within_half_a_turn(angle: float):
    wrapped = wrap(np.array(angle))
    assert -math.pi < wrapped <= math.pi + 1e-9
    assert math.isclose(math.cos(wrapped), math.cos(angle), abs_tol=1e-6)
    assert math.isclose(math.sin(wrapped), math.sin(angle), abs_tol=1e-6)


def turning(names: tuple[str, ...], *, unwrapped: bool = False, centred: bool = False) -> Demonstrations:
    """Two columns beside the arm: one that turns round and round, one that swings."""
    recording = tiny_recording(4, 60)
    turn = np.concatenate([np.linspace(0, 9, 60)] * 4)
    turn = turn if unwrapped else wrap(turn) if centred else turn % (2 * math.pi)
    swing = np.sin(np.arange(240) / 5)
    return demonstrations_of(with_feature(recording, ENVIRONMENT, names, np.stack([turn, swing], 1)))


@pytest.mark.parametrize("centred", [False, True])
@pytest.mark.parametrize("names", [("block_angle_rad", "tilt_rad"), ("yaw", "pitch"), ("eef.roll", "eef.pitch")])
def test_an_angle_that_wraps_is_found(names: tuple[str, str], centred: bool):
    semantics = resolve_semantics(turning(names, centred=centred))
    assert semantics.circular[ENVIRONMENT] == (True, False)
    assert names[0] in semantics.warnings[0]


def test_an_angle_that_counts_turns_does_not_wrap():
    assert resolve_semantics(turning(("block_angle_rad", "tilt_rad"), unwrapped=True)).circular[ENVIRONMENT] == (
        False,
        False,
    )


def test_a_jump_between_episodes_is_not_a_wrap():
    recording = tiny_recording(2, 60)
    angle = np.concatenate([np.full(60, 0.1), np.full(60, 6.1)]) + np.sin(np.arange(120)) / 20
    demos = demonstrations_of(with_feature(recording, ENVIRONMENT, ("block_angle_rad",), angle[:, None]))
    assert resolve_semantics(demos).circular[ENVIRONMENT] == (False,)


def test_a_column_of_no_known_unit_that_jumps_by_a_turn_is_mentioned():
    semantics = resolve_semantics(turning(("motor_3", "motor_4")))
    assert semantics.circular[ENVIRONMENT] == (False, False)
    assert any("'motor_3' jumps by a whole turn" in warning for warning in semantics.warnings)


def test_circular_as_set():
    demos = turning(("motor_3", "block_angle_rad"))
    assert resolve_semantics(demos, circular=[]).circular[ENVIRONMENT] == (False, False)
    assert resolve_semantics(demos, circular=["motor_3"]).circular[ENVIRONMENT] == (True, False)
    assert resolve_semantics(demos, circular=[f"{ENVIRONMENT}/motor_3"]).circular[ENVIRONMENT] == (True, False)
    with pytest.raises(ConfigError, match=r"'motor_5', which does not exist\. Did you mean 'motor_3'\?"):
        resolve_semantics(demos, circular=["motor_5"])
    with pytest.raises(ConfigError, match=r"in px\. Only angles in radians"):
        resolve_semantics(turning(("angle_px", "tilt")), circular=["angle_px"])


def test_a_circular_position_is_circular_on_both_sides_and_its_lag_is_wrapped():
    recording = tiny_recording(4, 60, joints=1)
    command = np.concatenate([np.linspace(0, 9, 60)] * 4)[:, None]
    state = command - 0.2
    made = with_feature(recording, ACTION, ("wrist_rad",), command % (2 * math.pi))
    made = with_feature(made, STATE, ("wrist_rad",), state % (2 * math.pi))
    semantics = resolve_semantics(demonstrations_of(made))
    assert semantics.kinds == ("position",)
    assert semantics.circular[ACTION] == semantics.circular[STATE] == (True,)
    assert semantics.tracking_lag[0] == pytest.approx(0.2, abs=1e-5)


# Dead columns


@pytest.mark.parametrize(
    ("names", "deviation", "dead"),
    [
        (("x_px", "y_px"), 0.4, True),
        (("x_px", "y_px"), 0.6, False),
        (("x_rad", "y_rad"), 0.005, True),
        (("x_rad", "y_rad"), 0.008, False),
        (("x_m", "y_m"), 0.002, False),
        (("a", "b"), 0.0009, True),
        (("a", "b"), 0.0011, False),
        (("a", "b"), 0.0, True),
    ],
)
def test_dead_is_a_thousandth_of_the_usual_range(names: tuple[str, str], deviation: float, dead: bool):
    recording = tiny_recording()
    wobble = 10 + deviation * np.where(np.arange(240) % 2, 1, -1)
    demos = demonstrations_of(with_feature(recording, ENVIRONMENT, names, np.stack([wobble, np.arange(240)], 1)))
    np.testing.assert_array_equal(dead_columns(demos, ENVIRONMENT), [dead, False])


def test_small_steps_of_no_known_unit_are_not_dead():
    recording = tiny_recording()
    steps = np.random.default_rng(0).normal(0, 0.0005, (240, 3)) * [1, 0.3, 0]
    demos = demonstrations_of(with_feature(recording, ACTION, ("x", "y", "z"), steps))
    np.testing.assert_array_equal(dead_columns(demos, ACTION), [False, False, True])


def test_dead_over_some_frames_only():
    recording = tiny_recording()
    values = np.zeros((240, 1))
    values[100:, 0] = np.arange(140)
    demos = demonstrations_of(with_feature(recording, ENVIRONMENT, ("x_px",), values))
    assert dead_columns(demos, ENVIRONMENT, slice(0, 100)).tolist() == [True]
    assert dead_columns(demos, ENVIRONMENT, np.arange(90, 130)).tolist() == [False]


def test_usual_ranges():
    assert usual_range("px") == 512
    assert usual_range("rad") == pytest.approx(2 * math.pi)
    assert usual_range(None) is usual_range("bananas") is None


# The clock


def test_an_uneven_clock_and_a_wrong_rate_are_said():
    random = np.random.default_rng(0)
    demos = tiny_demonstrations()
    uneven = np.concatenate([np.cumsum(random.uniform(0.05, 0.35, 40)) for _ in range(6)])
    warnings = resolve_semantics(replace(demos, timestamps=uneven)).warnings
    assert any(warning.startswith("Uneven clock") and "0.100 s by fps" in warning for warning in warnings)
    slow = resolve_semantics(replace(demos, timestamps=demos.timestamps * 2)).warnings
    assert "ticks every 0.200 s, but fps = 10 says 0.100 s" in slow[0]


# The summary


def test_the_summary_is_json_and_counts(tmp_path: Path):
    demos = replace(tiny_demonstrations(), warnings=("from reading",))
    summary = inspect_dataset(demos, resolve_semantics(demos))
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary
    assert summary["episodes"] == 6
    assert summary["frames"] == 240
    assert summary["episode_length"] == {"min": 40, "median": 40.0, "max": 40}
    assert summary["action_kinds"] == ["position", "position"]
    assert summary["tasks"] == {"push": 3, "pull": 3}
    assert summary["warnings"] == ["from reading"]
    by_key = {feature["key"]: feature for feature in summary["features"]}
    assert by_key["next.done"]["mean"] == [pytest.approx(6 / 240)]
    assert by_key[STATE]["dead"] == [False, False]


def test_numbers_that_are_not_there_are_null_in_the_summary():
    recording = tiny_recording()
    made = with_feature(recording, "next.reward", ("reward",), np.full((240, 1), np.nan))
    demos = demonstrations_of(made)
    summary = inspect_dataset(demos, resolve_semantics(demos))
    assert summary["features"][-1]["mean"] == [None]


# The real ones


def test_so101_lags_as_measured(shared_data: Path):
    semantics = resolve_semantics(read_dataset(shared_data / "so101_pick_place_tape", name="tape"))
    assert semantics.kinds == ("position",) * 6
    assert np.round(semantics.tracking_lag, 3).tolist() == [1.159, 4.066, 5.111, 1.755, 1.021, 1.818]
    assert semantics.warnings == ()


@pytest.mark.parametrize("name", ["pusht", "pusht_image"])
def test_pusht_is_positions(shared_data: Path, name: str):
    semantics = resolve_semantics(read_dataset(shared_data / name, name=name))
    assert semantics.kinds == ("position", "position")
    assert semantics.state_column == (0, 1)
    np.testing.assert_allclose(semantics.tracking_lag, [14.548, 14.948], atol=5e-4)


def test_pusht_image_turns(shared_data: Path):
    semantics = resolve_semantics(read_dataset(shared_data / "pusht_image", name="pusht_image"))
    assert semantics.circular[ENVIRONMENT] == (False, False, True)
    assert not any(any(flags) for key, flags in semantics.circular.items() if key != ENVIRONMENT)
    assert len(semantics.warnings) == 1


def test_cr5_is_velocities_with_a_gripper_and_a_dead_joint(shared_data: Path):
    demos = read_dataset(shared_data / "cr5_banana", name="cr5")
    semantics = resolve_semantics(demos)
    assert semantics.kinds == ("velocity",) * 6 + ("other",)
    assert semantics.state_column == (0, 1, 2, 3, 4, 5, None)
    assert dead_columns(demos, ACTION).tolist() == [False] * 5 + [True, False]
    assert dead_columns(demos, STATE).tolist() == [False] * 5 + [True]
    assert [warning.split()[0] for warning in semantics.warnings] == ["action:", "observation.state:", "Uneven"]

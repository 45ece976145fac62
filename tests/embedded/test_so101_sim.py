"""The embedded so101_sim is what its card says, and its frames are what the simulator gives."""

import json

import numpy as np
import pytest

from pipeline.config import load_config
from pipeline.embedded import embedded_folder
from pipeline.lerobot_format.read import read_dataset
from pipeline.simulate.recording import Recording, start_number
from pipeline.simulate.so101 import ENCODER_DEG, POSE, SO101, World
from pipeline.simulate.so101_card import card
from pipeline.simulate.so101_world import versions
from pipeline.types import ACTION, STATE, ObservationSet


@pytest.fixture(scope="module")
def demos():
    settings = load_config(None).datasets["so101_sim"]
    return read_dataset(embedded_folder("so101_sim"), name="so101_sim", choice=settings.choice(None))


@pytest.fixture(scope="module")
def recording():
    return json.loads((embedded_folder("so101_sim") / "meta/recording.json").read_text())


def test_it_is_small_and_reads_without_a_warning(demos):
    size = sum(path.stat().st_size for path in embedded_folder("so101_sim").rglob("*") if path.is_file())
    assert size < 0.8e6
    assert demos.warnings == ()
    assert (demos.fps, demos.episodes, demos.robot_type) == (30, 50, "so101_follower")


def test_the_card_is_made_from_the_recording_and_the_data(demos, recording):
    text = (embedded_folder("so101_sim") / "README.md").read_text()
    tuples = {key: tuple(recording[key]) for key in ("interval", "episodes_by_strategy")}
    assert card(Recording(**(recording | tuples))) == text
    strategy = demos.columns["strategy"][demos.episode_starts[:-1], 0]
    assert recording["episodes_by_strategy"] == [int((strategy == 0).sum()), int((strategy == 1).sum())]
    assert (recording["episodes"], recording["frames"]) == (demos.episodes, demos.frames)
    assert recording["failures"] == recording["attempts"] - recording["episodes"]
    assert recording["frames_median"] == np.median(demos.lengths)


def test_both_strategies_are_there_often(recording):
    assert min(recording["episodes_by_strategy"]) > 15


def test_every_demonstration_goes_through_the_stages_and_ends_in_success(demos):
    reward, success = demos.columns["next.reward"][:, 0], demos.columns["next.success"][:, 0] > 0
    np.testing.assert_array_equal(success, reward == 1)
    for episode in range(demos.episodes):
        frames = demos.episode(episode)
        assert np.unique(reward[frames]).tolist() == [0, 0.25, 0.5, 0.75, 1]
        assert (np.diff(reward[frames]) >= 0).all()
        assert success[frames][-1]
    np.testing.assert_array_equal(np.flatnonzero(demos.columns["next.done"][:, 0]), demos.episode_starts[1:] - 1)


def test_the_cube_ends_on_the_target_and_began_elsewhere(demos):
    pose = demos.columns[POSE]
    first, last = demos.episode_starts[:-1], demos.episode_starts[1:] - 1
    away = np.linalg.norm(pose[:, :2] - pose[:, 5:7], axis=1)
    assert away[last].max() < 0.03
    assert away[first].min() > 0.079
    assert np.abs(pose[last, 2] - 0.015).max() < 0.001
    np.testing.assert_allclose(np.hypot(pose[:, 3], pose[:, 4]), 1, atol=2e-3)


def test_values_are_what_encoders_report(demos):
    for key in (STATE, ACTION):
        columns = demos.columns[key]
        assert (columns >= SO101.action_low - 1).all()
        assert (columns <= SO101.action_high + 1).all()
        steps = columns[:, :5].astype(np.float64) / ENCODER_DEG
        np.testing.assert_allclose(steps, np.round(steps), atol=1e-3)


def test_the_follower_runs_a_few_frames_behind_the_leader(demos):
    """In each joint: the state resembles the action of some frames before more than that of the same frame."""
    state, action = demos.columns[STATE], demos.columns[ACTION]
    for joint in range(6):
        off = [
            np.abs(state[lag : demos.frames, joint] - action[: demos.frames - lag, joint]).mean() for lag in range(8)
        ]
        assert 2 <= int(np.argmin(off)) <= 6


def test_it_can_be_rolled_out_with_both_observation_sets(demos):
    for name, features in load_config(None).datasets["so101_sim"].observations.items():
        assert SO101().fits(demos, ObservationSet(name, features)) is None


def test_replaying_the_actions_gives_the_recorded_frames(demos, recording):
    """action[t] goes with observation[t]; the follower was told nothing but the recorded actions."""
    if recording["versions"] != versions():
        pytest.skip(f"recorded with {recording['versions']}, installed are {versions()}")
    starts = {}
    for number in (start_number(recording["seed"], attempt) for attempt in range(recording["attempts"])):
        starts[tuple(np.concatenate(World(number).observe()).tolist())] = number
    for episode in range(0, demos.episodes, 10):
        frames = demos.episode(episode)
        shown = np.concatenate([demos.columns[STATE][frames], demos.columns[POSE][frames]], axis=1)
        world = World(starts[tuple(shown[0].tolist())])
        for row, action in zip(shown, demos.columns[ACTION][frames], strict=True):
            np.testing.assert_array_equal(np.concatenate(world.observe()), row)
            world.advance(action)
        assert world.stands


def test_no_roll_out_begins_where_a_demonstration_began(demos):
    shown = SO101().start(range(200)).observe()
    rolled = {tuple(row) for row in shown[POSE].tolist()}
    recorded = {tuple(row) for row in demos.columns[POSE][demos.episode_starts[:-1]].tolist()}
    assert len(rolled) == 200
    assert not rolled & recorded

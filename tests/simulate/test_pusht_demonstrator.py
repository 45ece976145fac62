"""The scripted demonstrator: what it records, that it can be recorded again, and how it refuses."""

import json

import numpy as np
import pytest

from pipeline.embedded import embedded_folder
from pipeline.errors import StoreError
from pipeline.lerobot_format.read import read_dataset
from pipeline.simulate.pusht import BLOCK, versions
from pipeline.simulate.pusht_card import card
from pipeline.simulate.pusht_demonstrator import record_pusht
from pipeline.simulate.pusht_planner import Planner, State
from pipeline.simulate.recording import Recording, start_number
from pipeline.types import ACTION, STATE, ColumnChoice

EPISODES = 2


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    told = []
    folder = tmp_path_factory.mktemp("record") / "again"
    record_pusht(folder, episodes=EPISODES, seed=0, workers=1, on_episode=lambda *at: told.append(at))
    assert told == [(1, 2), (2, 2)]
    return folder


def test_the_embedded_data_can_be_recorded_again(recorded):
    """Same seed, same content, to the last bit: with the versions that the card names."""
    embedded = embedded_folder("pusht_sim")
    made_with = json.loads((embedded / "meta/recording.json").read_text())["versions"]
    if made_with != versions():
        pytest.skip(f"recorded with {made_with}, installed are {versions()}: other physics, other demonstrations")
    again, first = read_dataset(recorded, name="again"), read_dataset(embedded, name="pusht_sim")
    frames = slice(0, first.episode(EPISODES - 1).stop)
    assert again.frames == frames.stop
    assert set(again.columns) == set(first.columns)
    for key, values in again.columns.items():
        np.testing.assert_array_equal(values, first.columns[key][frames], err_msg=key)
    later = ColumnChoice(exclude=tuple(range(EPISODES, first.episodes)))
    assert again.content_hash == read_dataset(embedded, name="pusht_sim", choice=later).content_hash


def test_the_number_of_processes_changes_nothing(recorded, tmp_path):
    record_pusht(tmp_path / "two", episodes=EPISODES, seed=0, workers=2)
    one, two = read_dataset(recorded, name="a"), read_dataset(tmp_path / "two", name="a")
    assert one.content_hash == two.content_hash
    assert (recorded / "README.md").read_bytes() == (tmp_path / "two/README.md").read_bytes()


def test_another_seed_gives_other_demonstrations(recorded, tmp_path):
    record_pusht(tmp_path / "other", episodes=1, seed=1, workers=1)
    one, other = read_dataset(recorded, name="a"), read_dataset(tmp_path / "other", name="b")
    assert (one.columns[BLOCK][0] != other.columns[BLOCK][0]).any()


def test_a_folder_with_something_in_it_is_left_alone(tmp_path):
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(StoreError, match="exists already and is not empty"):
        record_pusht(tmp_path, episodes=1, workers=1)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_start_numbers_never_meet_those_of_roll_outs():
    assert start_number(0, 0) == 2**32
    assert start_number(1, 0) > start_number(0, 10**6)


class _Episode:
    def __init__(self, strategy: int, frames: int):
        self.strategy, self.action = strategy, np.zeros((frames, 2))


def test_the_card_says_how_the_data_came_about():
    kept = [_Episode(strategy, frames) for strategy, frames in [(0, 50), (1, 90), (1, 100)]]
    recording = Recording.of(kept, seed=7, attempts=4, versions={"gym-pusht": "0.1.8", "pymunk": "6.11.1"})
    text = card(recording)
    # Clopper–Pearson for 3 of 4: Beta quantiles, 0.1941 and 0.9937.
    for words in (
        "Simulated", "--episodes 3 --seed 7", "gym-pusht 0.1.8, pymunk 6.11.1", "3 of 4 = 0.750", "0.194 … 0.994",
        "1 failed attempt was left out", "1 anticlockwise (0), 2 clockwise (1)", "50 … 100, median 90", "240 frames",
    ):  # fmt: skip
        assert words in text
    assert json.loads(json.dumps(recording.as_dict()))["failures"] == 1


@pytest.mark.parametrize("direction", [1, -1])
def test_the_planner_pushes_a_block_home_that_is_one_push_away(direction):
    """20 px off along its own foot: a push at the foot's end, through the mass centre, is all it takes."""
    angle = np.pi / 4
    block = (256 - 20 * np.sin(angle), 256 + 20 * np.cos(angle), angle)
    planner = Planner(direction)
    push = planner.next_push(State((60.0, 450.0), (0.0, 0.0), block))
    assert push is not None
    assert planner.distance(block) == pytest.approx(20)
    assert planner.distance(push.block) < 2
    assert all(0 <= value <= 512 for target in push.targets for value in target)


def test_the_goal_is_at_distance_zero_however_often_it_is_turned():
    planner = Planner(1)
    for turns in (-1, 0, 3):
        assert planner.distance((256.0, 256.0, np.pi / 4 + 2 * np.pi * turns)) == pytest.approx(0, abs=1e-9)


def test_recorded_features_have_the_usual_names(recorded):
    demos = read_dataset(recorded, name="again")
    assert demos.features[STATE].names == demos.features[ACTION].names == ("x_px", "y_px")
    assert demos.features[BLOCK].names == ("block_x_px", "block_y_px", "block_angle_rad")
    assert demos.features[BLOCK].units == ("px", "px", "rad")
    assert demos.fps == 10
    assert demos.warnings == ()

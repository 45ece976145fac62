"""The embedded pusht_sim is what its card says, and its frames are what the simulator gives."""

import json

import numpy as np
import pytest

from pipeline.embedded import EMBEDDED, embedded_folder
from pipeline.errors import DatasetError
from pipeline.lerobot_format.read import read_dataset
from pipeline.simulate.pusht import BLOCK, PushT, advance, make_environment, pose_columns, versions
from pipeline.simulate.pusht_card import card
from pipeline.simulate.recording import Recording, start_number
from pipeline.types import ACTION, STATE, ObservationSet


@pytest.fixture(scope="module")
def demos():
    return read_dataset(embedded_folder("pusht_sim"), name="pusht_sim")


@pytest.fixture(scope="module")
def recording():
    return json.loads((embedded_folder("pusht_sim") / "meta/recording.json").read_text())


def test_an_unknown_name_gets_a_suggestion():
    with pytest.raises(DatasetError, match="Did you mean 'pusht_sim'"):
        embedded_folder("pusht")
    assert EMBEDDED == ("pusht_sim", "so101_sim")


def test_it_is_small_and_reads_without_a_warning(demos):
    size = sum(path.stat().st_size for path in embedded_folder("pusht_sim").rglob("*") if path.is_file())
    assert size < 1.3e6
    assert demos.warnings == ()
    assert (demos.fps, demos.episodes) == (10, 200)


def test_the_card_is_made_from_the_recording_and_the_data(demos, recording):
    text = (embedded_folder("pusht_sim") / "README.md").read_text()
    tuples = {key: tuple(recording[key]) for key in ("interval", "episodes_by_strategy")}
    assert card(Recording(**(recording | tuples))) == text
    strategy = demos.columns["strategy"][demos.episode_starts[:-1], 0]
    assert recording["episodes_by_strategy"] == [int((strategy == 0).sum()), int((strategy == 1).sum())]
    assert (recording["episodes"], recording["frames"]) == (demos.episodes, demos.frames)
    assert recording["failures"] == recording["attempts"] - recording["episodes"]
    assert recording["frames_median"] == np.median(demos.lengths)


def test_both_strategies_are_there_often(recording):
    assert min(recording["episodes_by_strategy"]) > 70


def test_every_demonstration_ends_in_success_and_not_before(demos):
    coverage, success = demos.columns["next.coverage"][:, 0], demos.columns["next.success"][:, 0]
    np.testing.assert_array_equal(success > 0, coverage > 0.95)
    last = demos.episode_starts[1:] - 1
    ends = np.zeros(demos.frames, dtype=bool)
    ends[last] = ends[last - 1] = True
    np.testing.assert_array_equal(success > 0, ends)
    np.testing.assert_array_equal(np.flatnonzero(demos.columns["next.done"][:, 0]), last)
    np.testing.assert_allclose(demos.columns["next.reward"][:, 0], np.minimum(1, coverage / 0.95), rtol=1e-6)
    assert demos.lengths.max() <= 301
    np.testing.assert_array_equal(demos.columns[ACTION][last], demos.columns[ACTION][last - 1])


def test_values_lie_on_the_table(demos):
    for key in (STATE, ACTION):
        assert demos.columns[key].min() >= 0
        assert demos.columns[key].max() <= 512
    angle = demos.columns[BLOCK][:, 2]
    assert 0 <= angle.min() < angle.max() <= np.float32(2 * np.pi)


def test_it_can_be_rolled_out(demos):
    assert PushT().fits(demos, ObservationSet("pose", (STATE, BLOCK))) is None


def test_replaying_the_actions_gives_the_recorded_frames(demos, recording):
    """action[t] goes with observation[t]; the environment saw nothing but the recorded actions."""
    if recording["versions"] != versions():
        pytest.skip(f"recorded with {recording['versions']}, installed are {versions()}")
    starts = {
        tuple(np.concatenate([columns[STATE][0], columns[BLOCK][0]]).tolist()): number
        for number in (start_number(recording["seed"], attempt) for attempt in range(recording["attempts"]))
        for columns in [pose_columns([make_environment(number)])]
    }
    for episode in range(0, demos.episodes, 40):
        frames = demos.episode(episode)
        shown = np.concatenate([demos.columns[STATE][frames], demos.columns[BLOCK][frames]], axis=1)
        environment = make_environment(starts[tuple(shown[0].tolist())])
        for row, action in zip(shown, demos.columns[ACTION][frames], strict=True):
            columns = pose_columns([environment])
            np.testing.assert_array_equal(np.concatenate([columns[STATE][0], columns[BLOCK][0]]), row)
            advance(environment, float(action[0]), float(action[1]))


def test_no_roll_out_begins_where_a_demonstration_began(demos):
    shown = PushT().start(range(200)).observe()
    rolled = {tuple(row) for row in np.concatenate([shown[STATE], shown[BLOCK]], axis=1).tolist()}
    first = demos.episode_starts[:-1]
    recorded = np.concatenate([demos.columns[STATE][first], demos.columns[BLOCK][first]], axis=1)
    assert not rolled & {tuple(row) for row in recorded.tolist()}

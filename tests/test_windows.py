"""Windows: which anchors there are, what each sees, and which actions are masked; known counts on real data."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import ConfigError, DatasetError, NotApplicableError
from pipeline.types import ACTION, STATE, ObservationSet
from pipeline.windows import make_windows
from tests.hand_made import POSE, STATE_ONLY, changed, demonstrations, random_walks, semantics


def lay(demos, episodes=None, **more):
    episodes = range(demos.episodes) if episodes is None else episodes
    settings = {"statistics_episodes": episodes, "protocol": "strict", "history": 3, "chunk": 4}
    return make_windows(demos, semantics(demos), STATE_ONLY, episodes, **settings | more)


@given(
    lengths=st.lists(st.integers(6, 12), min_size=1, max_size=4),
    history=st.integers(1, 3),
    chunk=st.integers(1, 4),
    own=st.integers(1, 6),
)
def test_gathering_agrees_with_a_loop(lengths, history, chunk, own):
    demos = random_walks(tuple(lengths))
    windows = lay(demos, history=history, chunk=chunk, own_history=own)
    seen, (actions, mask) = windows.observations(), windows.targets()
    position = 0
    for episode in range(demos.episodes):
        frames = demos.episode(episode)
        state, action = demos.columns[STATE][frames], demos.columns[ACTION][frames]
        for t in range(history - 1, len(state)):
            assert windows.anchors[position] == frames.start + t
            for back in range(own):
                np.testing.assert_array_equal(seen.values[position, own - 1 - back], state[max(t - back, 0)])
            for ahead in range(chunk):
                assert mask[position, ahead] == (t + ahead < len(action))
                if mask[position, ahead]:
                    np.testing.assert_array_equal(actions[position, ahead], action[t + ahead])
            before = action[t - 1] if t else np.full(2, np.nan)
            np.testing.assert_array_equal(seen.previous_action[position], before)
            position += 1
    assert position == len(windows)


def test_all_chunks_and_histories_share_the_anchors():
    demos = random_walks()
    first = lay(demos, chunk=1)
    for other in (
        lay(demos, chunk=8),
        lay(demos, own_history=1),
        lay(demos, own_history=7),
        lay(demos, recipe="every_frame"),
    ):
        np.testing.assert_array_equal(first.anchors, other.anchors)
    assert lay(demos, recipe="every_frame").history == 1


def test_a_part_of_the_windows_is_that_part_of_all():
    windows = lay(random_walks())
    index = np.array([5, 0, 9])
    np.testing.assert_array_equal(windows.observations(index).values, windows.observations().values[index])
    np.testing.assert_array_equal(windows.targets(index)[0], windows.targets()[0][index])
    np.testing.assert_array_equal(windows.observations(slice(2, 5)).state, windows.observations().state[2:5])


def test_an_observation_set_puts_its_features_side_by_side():
    walks = random_walks((8, 8))
    pose = np.arange(48).reshape(16, 3)
    demos = demonstrations({**walks.columns, POSE: pose}, (8, 8))
    both = ObservationSet("pose", (STATE, POSE))
    windows = make_windows(
        demos, semantics(demos), both, [1], statistics_episodes=[0], protocol="strict", history=2, chunk=1
    )
    seen = windows.observations()
    assert seen.values.shape == (7, 2, 5)
    np.testing.assert_array_equal(seen.values[0, -1, 2:], pose[9])
    np.testing.assert_array_equal(seen.state[..., :2], seen.values[..., :2])


def test_notebook_anchors_leave_the_last_admissible_window_out():
    demos = random_walks((9, 7))
    windows = lay(demos, protocol="notebook", chunk=4)
    assert windows.anchors.tolist() == [2, 3, 4, 9 + 2]
    assert lay(demos, protocol="notebook", chunk=4, recipe="every_frame").anchors.tolist() == list(range(16))


def test_the_hash_covers_what_is_seen_and_nothing_else():
    demos = random_walks()
    windows = lay(demos, [0, 1, 3])
    assert lay(changed(demos, [2, 4]), [0, 1, 3]).hash() == windows.hash()
    assert lay(changed(demos, [3]), [0, 1, 3]).hash() != windows.hash()
    assert lay(demos, [0, 1, 3], chunk=5).hash() != windows.hash()


@pytest.mark.parametrize(("chunk", "train", "test"), [(1, 11_844, 2_960), (32, 10_604, 2_650)])
def test_the_notebook_counts_on_a_real_arm(shared_data, chunk, train, test):
    from pipeline.lerobot_format.read import read_dataset

    demos = read_dataset(shared_data / "so101_pick_place_tape", name="tape")
    assert len(lay(demos, range(40), protocol="notebook", chunk=chunk)) == train
    assert len(lay(demos, range(40, 50), protocol="notebook", chunk=chunk)) == test


def test_the_notebook_counts_on_pusht(shared_data):
    from pipeline.lerobot_format.read import read_dataset

    demos = read_dataset(shared_data / "pusht", name="pusht")
    parts = [
        lay(demos, part, protocol="notebook", chunk=1, recipe="every_frame") for part in (range(164), range(164, 206))
    ]
    assert [len(part) for part in parts] == [20_059, 5_591]


def test_an_episode_shorter_than_the_history_is_refused():
    with pytest.raises(DatasetError, match=r"Episode 11 .* has 2 frames, and the history is 3.*at most 2"):
        lay(random_walks((9, 2, 8)))


def test_a_chunk_longer_than_every_episode_is_refused():
    with pytest.raises(ConfigError, match=r"A chunk of 8 actions is longer than every episode.*at most 7"):
        lay(random_walks((9, 7)), chunk=8)


def test_no_window_is_refused():
    with pytest.raises(DatasetError, match="No window of 3 frames and 6 actions fits into the 1 episodes"):
        lay(random_walks((9, 7)), [1], protocol="notebook", chunk=6)


def test_an_unknown_feature_is_refused_with_a_suggestion():
    demos = random_walks()
    wrong = ObservationSet("mine", ("observation.stat",))
    with pytest.raises(ConfigError, match=r"asks for 'observation.stat'.*Did you mean 'observation.state'"):
        make_windows(
            demos, semantics(demos), wrong, [0], statistics_episodes=[0], protocol="strict", history=3, chunk=1
        )


def test_the_notebook_is_refused_where_an_action_commands_no_state():
    walks = random_walks()
    gripper = np.zeros((walks.frames, 1))
    demos = demonstrations(
        {STATE: walks.columns[STATE], ACTION: np.hstack([walks.columns[ACTION], gripper])}, walks.lengths
    )
    with pytest.raises(NotApplicableError, match=r"2 state → 3 action columns\) a2 commands none.*'strict'"):
        lay(demos, protocol="notebook")
    assert len(lay(demos)) > 0

"""The same recording twice."""

import numpy as np
import pytest

from tests.inspection.making import arm_takes, found, look


def test_a_whole_copy_is_named_once_and_worth_leaving_out():
    takes = arm_takes()
    takes.append(takes[3].frames(slice(None)))
    (finding,) = found(takes, "duplicate")
    assert finding.episode == 26
    assert "the same recording as episode 13:" in finding.words
    assert "agree exactly" in finding.words
    assert look(takes).exclude == (26,)


def test_a_shifted_and_cut_copy_is_found_with_its_shift():
    takes = arm_takes()
    takes.append(takes[3].frames(slice(12, 90), new_clock=True))
    (finding,) = found(takes, "duplicate")
    assert finding.episode == 26
    assert "shifted by 12 frames: 78 of its 78 frames" in finding.words


def test_a_copy_that_begins_before_and_ends_earlier_is_found():
    """Both have frames of their own: recordings of one take by two recorders."""
    takes = arm_takes()
    whole = takes[3]
    takes[3] = whole.frames(slice(0, 90))
    takes.append(whole.frames(slice(15, None), new_clock=True))
    (finding,) = found(takes, "duplicate")
    assert "shifted by 15 frames" in finding.words


@pytest.mark.parametrize("noise", [0.01, 0.05])
def test_a_copy_with_a_little_noise_is_found(noise):
    """Degrees, of joints that go 30 to 50: rounding, or another encoder."""
    takes, random = arm_takes(), np.random.default_rng(0)
    copy = takes[3].frames(slice(None))
    copy.state = copy.state + noise * random.normal(size=copy.state.shape)
    takes.append(copy)
    (finding,) = found(takes, "duplicate")
    assert "of their range" in finding.words


def test_three_copies_name_two():
    takes = arm_takes()
    takes += [takes[3].frames(slice(None)), takes[3].frames(slice(5, None), new_clock=True)]
    assert len({finding.episode for finding in found(takes, "duplicate")}) == 2


def test_the_same_path_again_by_hand_is_no_copy():
    """People who repeat a task are a few degrees off; so is this arm, by two."""
    assert not found(arm_takes(60), "duplicate")


def test_one_episode_is_no_pair():
    assert not found(arm_takes(1), "duplicate")


def test_episodes_that_rest_in_the_same_pose_are_no_copies():
    takes = arm_takes()
    for place in (2, 5):
        takes[place] = takes[place].frames([0] * 60, new_clock=True)
        takes[place].state[:] = takes[place].action[:] = 1.0
    assert not found(takes, "duplicate")

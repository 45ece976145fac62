"""Seconds in which nothing moves, and leaps."""

import numpy as np
import pytest

from tests.inspection.making import FPS, arm_takes, found, only

FIVE_S = round(5 * FPS)


@pytest.mark.parametrize("where", ["begins", "ends"])
def test_five_idle_seconds_are_found_in_their_episode(where):
    takes = arm_takes()
    last = len(takes[5].seconds) - 1
    places = np.r_[[0] * FIVE_S, 0 : last + 1] if where == "begins" else np.r_[0 : last + 1, [last] * FIVE_S]
    takes[5] = takes[5].frames(places, new_clock=True)
    finding = only(takes, "idle", 5)
    assert f"It {where} with 5." in finding.words
    assert finding.value == pytest.approx(5.2, abs=0.4)
    assert not finding.grave, "waiting may be the task"


def test_a_data_set_that_waits_everywhere_is_told_so_once():
    takes = [take.frames(np.r_[[0] * 50, 0 : len(take.seconds)], new_clock=True) for take in arm_takes()]
    findings = found(takes, "idle")
    assert [finding.episode for finding in findings] == [None]
    assert "a policy learns to wait there" in findings[0].words


@pytest.mark.parametrize("feature", ["action", "state"])
@pytest.mark.parametrize("stays", [False, True], ids=["for_a_frame", "from_there_on"])
def test_a_leap_is_found_where_it_is(feature, stays):
    takes = arm_takes()
    values = getattr(takes[7], feature)
    values[60 : None if stays else 61, 2] += 25.0
    finding = only(takes, "jump", 7)
    assert "joint_2.pos jumps by 2" in finding.words
    assert "between frames 59 and 60" in finding.words or "between frames 60 and 61" in finding.words


def test_a_gripper_that_switches_does_not_leap():
    """The clean arm switches its gripper's command by its whole range, twice an episode."""
    takes = arm_takes()
    assert max(np.abs(np.diff(take.action[:, -1])).max() for take in takes) == 40.0
    assert not found(takes, "jump")


def test_a_switch_of_any_name_does_not_leap():
    names = ("joint_0.pos", "joint_1.pos", "joint_2.pos", "valve")
    assert not found(arm_takes(), "jump", names=names)


def test_what_covers_lost_frames_is_no_leap():
    """A step over six lost frames is seven steps long, and takes seven ticks."""
    takes = arm_takes()
    takes[3] = takes[3].frames(np.delete(np.arange(100), slice(40, 46)))
    assert not found(takes, "jump")

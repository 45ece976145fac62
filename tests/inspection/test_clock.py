"""The recorded clock against fps."""

import numpy as np
import pytest

from tests.inspection.making import FPS, arm_takes, found, joined, only


def test_another_rate_than_fps_says_is_found_and_both_are_named():
    (finding,) = found(joined(arm_takes(), fps=30.0), "clock")
    assert finding.episode is None
    assert "20 frames a second; fps = 30 says 0.033 s" in finding.words
    assert finding.value == pytest.approx(0.05)


@pytest.mark.parametrize("fps", [19.5, 20.5])
def test_a_rate_that_is_nearly_reached_is_none(fps):
    assert not found(joined(arm_takes(), fps=fps), "clock")


def test_lost_frames_are_a_gap_in_their_episode():
    takes = arm_takes()
    takes[3] = takes[3].frames(np.delete(np.arange(100), slice(40, 46)))
    finding = only(takes, "clock", 3)
    assert "0.35 s pass between frames 39 and 40, 7 ticks: frames are missing." in finding.words
    assert not finding.grave


def test_three_lost_frames_are_found_though_the_clock_jitters():
    takes, random = arm_takes(), np.random.default_rng(0)
    for take in takes:
        take.seconds = take.seconds + random.uniform(-0.1, 0.1, len(take.seconds)) / FPS
    takes[3] = takes[3].frames(np.delete(np.arange(100), slice(40, 43)))
    only(takes, "clock", 3)


def test_a_second_without_frames_is_worth_leaving_the_episode_out():
    takes = arm_takes()
    takes[3] = takes[3].frames(np.delete(np.arange(100), slice(40, 65)))
    assert only(takes, "clock", 3).grave


def test_an_uneven_clock_is_told_once_with_its_worst_episode():
    takes, random = arm_takes(), np.random.default_rng(0)
    for place, take in enumerate(takes):
        late = random.random(len(take.seconds)) < (0.3 if place == 5 else 0.03)
        take.seconds = take.seconds + np.where(late, 0.4 / FPS, 0.0)
    (finding,) = found(takes, "clock")
    assert finding.episode is None
    assert "most in episode 15" in finding.words
    off = np.abs(np.concatenate([np.diff(take.seconds) for take in takes]) - 1 / FPS) > 0.2 / FPS
    assert finding.value == pytest.approx(off.mean())


def test_jitter_of_a_tenth_of_a_tick_is_fine():
    takes, random = arm_takes(), np.random.default_rng(0)
    for take in takes:
        take.seconds = take.seconds + random.uniform(-0.05, 0.05, len(take.seconds)) / FPS
    assert not found(takes, "clock")


@pytest.mark.parametrize("back", [0.0, 0.2])
def test_time_that_stands_still_or_runs_backwards_is_grave(back):
    takes = arm_takes()
    takes[2].seconds[50:] -= takes[2].seconds[50] - takes[2].seconds[49] + back
    finding = only(takes, "clock", 2)
    assert finding.grave
    assert finding.value == 1


def test_an_episode_at_a_rate_of_its_own_is_grave():
    takes = arm_takes()
    takes[4].seconds = takes[4].seconds * 1.5
    finding = only(takes, "clock", 4)
    assert finding.grave
    assert "ticks every 0.075 s, that of the other episodes every 0.050 s" in finding.words


def test_a_single_frame_has_no_clock():
    takes = [take.frames(slice(0, 1)) for take in arm_takes(3)]
    assert not found(takes, "clock")

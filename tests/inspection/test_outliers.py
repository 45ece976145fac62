"""Episodes unlike the others."""

import numpy as np
import pytest

from pipeline.inspection.outliers import _nearest
from tests.inspection.making import arm_takes, found, look, only


@pytest.mark.parametrize("frames", [4, 15])
def test_an_episode_that_is_too_short_is_grave(frames):
    takes = arm_takes()
    takes[8] = takes[8].frames(slice(0, frames))
    finding = only(takes, "short", 8)
    assert finding.grave
    assert finding.value == frames
    assert f"It has {frames} frames" in finding.words


def test_an_episode_in_which_nothing_moves_is_grave():
    takes = arm_takes()
    takes[8] = takes[8].frames([0] * 120, new_clock=True)
    finding = only(takes, "short", 8)
    assert finding.grave
    assert "Nothing moves in all of its 120 frames" in finding.words


@pytest.mark.parametrize("times", [0.25, 4])
def test_an_odd_length_is_found(times):
    takes = arm_takes()
    places = np.arange(0, len(takes[8].seconds) - 1, 1 / times).astype(int)
    takes[8] = takes[8].frames(places, new_clock=True)
    assert any(f"It has {len(places)} frames" in f.words for f in found(takes, "outlier") if f.episode == 18)


def test_a_far_start_is_found_with_its_joint():
    takes = arm_takes()
    fade = np.clip(1 - np.arange(len(takes[8].seconds)) / 40, 0, 1)
    takes[8].action[:, 0] -= 60 * fade
    takes[8].state[:, 0] -= 60 * fade
    words = [f.words for f in found(takes, "outlier") if f.episode == 18]
    assert any("observation.state/joint_0.pos" in said for said in words), words
    assert {f.episode for f in found(takes, "outlier")} == {18}


def test_an_odd_path_is_found():
    takes = arm_takes()
    away = np.sin(np.linspace(0, np.pi, len(takes[8].seconds)))[:, None] * np.array([-90, 80, -70, 0])
    takes[8].action += away
    takes[8].state += away
    findings = found(takes, "outlier")
    assert {f.episode for f in findings} == {18}
    assert any("path is unlike" in f.words for f in findings)


def test_two_ways_round_have_no_outliers():
    """Half of the episodes go the other way: neither half is odd."""
    takes = arm_takes(20)
    for take in takes[::2]:
        take.action[:, :3] *= -1
        take.state[:, :3] *= -1
    assert not found(takes, "outlier")


def test_few_episodes_are_not_compared():
    takes = arm_takes(4)
    takes[1].action += 100
    takes[1].state += 100
    assert not found(takes, "outlier")


def test_a_slow_start_is_no_odd_path():
    """Paths are compared between the idle start and end."""
    takes = arm_takes()
    takes[8] = takes[8].frames(np.r_[[0] * 60, 0 : len(takes[8].seconds)], new_clock=True)
    assert {f.check for f in look(takes).findings} == {"idle"}


def test_the_nearest_others_are_those_of_a_loop():
    vectors = np.random.default_rng(0).normal(size=(25, 4, 3))
    flat = vectors.reshape(25, 12)
    slow = [sorted(np.sqrt(((flat - one) ** 2).mean(axis=1)))[2] for one in flat]  # itself, the first, the second
    assert np.allclose(_nearest(vectors), slow)

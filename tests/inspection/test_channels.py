"""Columns that are dead, clipped or frozen."""

import numpy as np
import pytest

from pipeline.types import ACTION, STATE
from tests.hand_made import demonstrations
from tests.inspection.making import FPS, arm_takes, found, joined, look, only


def test_a_dead_column_is_named_in_action_and_state():
    takes = arm_takes()
    for take in takes:
        take.action[:, 1] = take.state[:, 1] = 3.0
    findings = found(takes, "dead")
    assert {finding.column for finding in findings} == {"action/joint_1.pos", "observation.state/joint_1.pos"}
    assert all("lies between 3 and 3" in finding.words for finding in findings)
    assert look(takes).lag_frames[1] is None


def test_a_column_that_is_dead_by_its_unit_alone_asks_for_the_unit():
    demos = joined(arm_takes())
    units = {key: ("mm", *feature.units[1:]) for key, feature in demos.features.items()}
    small = {key: values * [0.01, *[1] * (values.shape[1] - 1)] for key, values in demos.columns.items()}
    findings = found(demonstrations(small, demos.lengths, fps=FPS, units=units), "dead")
    assert len(findings) == 2
    assert all("next to nothing for mm. Is that the unit?" in finding.words for finding in findings)
    assert all("`units`" in finding.words for finding in findings)


def test_many_dead_columns_are_counted():
    demos = joined(arm_takes())
    state = np.hstack([demos.columns[STATE], np.ones((demos.frames, 6))])
    wide = demonstrations({ACTION: demos.columns[ACTION], STATE: state}, demos.lengths, fps=FPS)
    (finding,) = found(wide, "dead")
    assert finding.words == "6 of 10 columns of observation.state hardly move."


@pytest.mark.parametrize("share", [0.1, 0.25])
def test_a_clipped_command_is_found_with_its_longest_stretch(share):
    takes = arm_takes()
    limit = np.quantile(np.concatenate([take.action[:, 0] for take in takes]), 1 - share)
    for take in takes:
        take.action[:, 0] = np.minimum(take.action[:, 0], limit)
    (finding,) = found(takes, "saturated")
    assert finding.column == "action/joint_0.pos"
    assert 0.7 * share < finding.value < share + 0.01, "frames in which nothing else moves do not count"
    assert f"{limit:.4g}" in finding.words


def test_resting_at_a_stop_is_not_clipping():
    """The arm is folded at the ends of all its ranges for three seconds before each episode; nothing else moves then."""
    takes = []
    for take in arm_takes():
        lowest = np.minimum.reduce([other.action.min(axis=0) for other in arm_takes()]) - 1
        take.action = np.vstack([np.tile(lowest, (60, 1)), take.action])
        take.state = np.vstack([np.tile(lowest, (60, 1)), take.state])
        take.seconds = np.arange(len(take.action)) / FPS
        takes.append(take)
    assert not found(takes, "saturated")


@pytest.mark.parametrize("seconds", [1.0, 2.0])
def test_a_joint_that_freezes_while_it_is_told_to_move_is_grave(seconds):
    takes = arm_takes()
    frames = slice(20, 20 + round(seconds * FPS))
    takes[4].state[frames, 0] = takes[4].state[20, 0]
    finding = only(takes, "frozen", 4)
    assert finding.grave
    assert finding.column == "observation.state/joint_0.pos"
    assert "repeats exactly for" in finding.words
    assert look(takes).exclude == (14,)


@pytest.mark.parametrize("seconds", [0.5, 1.5])
def test_telemetry_that_repeats_altogether_is_found(seconds):
    """Sooner than one joint: no three joints stick at once."""
    takes = arm_takes()
    takes[4].state[20 : 20 + round(seconds * FPS)] = takes[4].state[20]
    assert only(takes, "frozen", 4).grave


def test_an_arm_that_rests_altogether_is_not_frozen():
    takes = [
        take.frames([*range(60), *[60] * 20, *range(60, len(take.seconds))], new_clock=True) for take in arm_takes()
    ]
    assert not found(takes, "frozen")


def test_a_column_that_one_episode_never_moves_is_found():
    takes = arm_takes()
    takes[4].state[:, 1] = 7.25
    words = [f.words for f in found(takes, "frozen") if f.episode == 14]
    assert any("joint_1.pos is 7.25 from the first frame to the last" in said for said in words)


def test_a_gripper_that_squeezes_what_it_holds_is_not_frozen():
    """Closed on an object, its state stays while its command goes on: in every episode."""
    takes = arm_takes()
    for take in takes:
        take.state[:, -1] = np.maximum(take.state[:, -1], 15.0)
    assert not found(takes, "frozen")


def test_a_joint_at_rest_repeats_and_is_not_frozen():
    takes = arm_takes()
    for take in takes:
        take.state = np.round(take.state / 0.5) * 0.5
    assert not found(takes, "frozen")

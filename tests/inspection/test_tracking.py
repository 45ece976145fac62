"""Does the arm follow, and how late: correlation against a slow one, and faults planted in one episode or all."""

import numpy as np
import pytest

from pipeline.inspection.look import inspect
from pipeline.inspection.survey import Survey
from pipeline.inspection.tracking import EARLY, _correlate, follow
from pipeline.lerobot_format.quality import resolve_semantics
from pipeline.types import ACTION
from tests.inspection.making import FPS, arm_takes, found, joined, look, only


def survey_of(takes) -> Survey:
    demos = joined(takes)
    return Survey(demos, resolve_semantics(demos, kind="position", circular=[]))


def delay(take, frames: int) -> None:
    take.state = np.vstack([np.repeat(take.state[:1], frames, axis=0), take.state[:-frames]])


def test_the_sums_at_every_lag_are_those_of_a_loop():
    survey = survey_of(arm_takes(3))
    told, done = np.random.default_rng(0).normal(size=(2, survey.demos.frames)).astype(np.float32)
    lags, table = _correlate(survey, told, done)
    assert lags[0] == -EARLY
    for episode in range(3):
        frames = survey.demos.episode(episode)
        one, other = told[frames].astype(float), done[frames].astype(float)
        for row, lag in enumerate(lags):
            slow = sum(one[t] * other[t + lag] for t in range(len(one)) if 0 <= t + lag < len(one))
            assert table[row, episode] == pytest.approx(slow, rel=1e-4, abs=1e-3)


@pytest.mark.parametrize("frames", [1, 3, 7])
def test_a_state_that_is_later_by_so_many_frames_adds_them_to_the_lag(frames):
    """A joint half of the way to its command each frame is between 1 and 2 frames late by itself. Episodes end at rest."""
    takes = [take.frames([*range(len(take.seconds)), *[-1] * 10], new_clock=True) for take in arm_takes()]
    before = [following.lag for following in follow(survey_of(takes))]
    for take in takes:
        delay(take, frames)
    after = [following.lag for following in follow(survey_of(takes))]
    assert np.allclose(np.subtract(after, before), frames, atol=0.15)
    assert 1 < before[0] < 2


def test_the_lag_is_that_of_the_correlation_of_differences_by_numpy():
    takes = arm_takes(1)
    (following, *_) = follow(survey_of(takes))
    told, done = np.diff(takes[0].action[:, 0]), np.diff(takes[0].state[:, 0])
    slow = np.correlate(done, told, mode="full")
    assert abs(following.lag - (int(np.argmax(slow)) - (len(told) - 1))) <= 0.5


@pytest.mark.parametrize("frames", [5, 10])
def test_one_late_episode_is_found(frames):
    takes = arm_takes()
    delay(takes[6], frames)
    finding = only(takes, "tracking", 6)
    assert "frames late, in the other episodes 1." in finding.words


def test_a_joint_that_goes_its_own_way_is_found():
    takes, random = arm_takes(), np.random.default_rng(0)
    takes[6].state[:, 1] = 20 + np.cumsum(random.normal(size=len(takes[6].state)))
    assert any("does not follow action/joint_1.pos" in f.words for f in found(takes, "tracking") if f.episode == 16)


def test_states_before_their_commands_are_told_of_the_whole_data_set():
    takes = arm_takes()
    for take in takes:
        take.action = np.vstack([np.repeat(take.action[:1], 3, axis=0), take.action[:-3]])
    findings = found(takes, "tracking")
    assert {finding.episode for finding in findings} == {None}
    assert "actions seem to be stored too late" in findings[0].words


def test_an_arm_that_is_half_a_second_late_is_told_of():
    takes = arm_takes()
    for take in takes:
        delay(take, round(0.6 * FPS))
    (finding, *_) = found(takes, "tracking")
    assert "s late" in finding.words
    assert finding.episode is None


@pytest.mark.parametrize(("kind", "rate"), [("velocity", FPS), ("delta", 1.0)])
def test_rates_are_followed_too(kind, rate):
    takes = arm_takes()
    for take in takes:
        take.action = np.gradient(take.action, axis=0) * rate
    delay(takes[6], 8)
    demos = joined(takes)
    said = inspect(demos, resolve_semantics(demos, kind=kind, circular=[])).findings
    assert {f.episode for f in said if f.check == "tracking"} == {16}


def test_where_no_state_goes_with_an_action_the_lag_is_not_known():
    takes = arm_takes()
    for take in takes:
        take.action[:, 0] = np.random.default_rng(1).normal(size=len(take.action))
    assert look(takes).lag_frames[0] is None
    assert not [f for f in found(takes, "tracking") if f.column == f"{ACTION}/joint_0.pos"]

"""Arithmetic within episodes: fast against slow and obvious."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pipeline.inspection.survey import MOVED, Survey, per_episode, robust, runs
from pipeline.lerobot_format.quality import resolve_semantics
from pipeline.types import ACTION, STATE
from tests.hand_made import demonstrations, semantics
from tests.inspection.making import arm_takes, joined

episodes = st.lists(st.lists(st.booleans(), min_size=1, max_size=7), min_size=1, max_size=5)


def flat(parts: list[list[bool]]) -> np.ndarray:
    return np.array([value for part in parts for value in part])


def starts_of(lengths) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)


def slow_runs(parts: list[list[bool]]) -> list[tuple[int, int]]:
    """Walk along every episode and note where True begins and ends."""
    found, offset = [], 0
    for part in parts:
        began = None
        for place, yes in enumerate([*part, False]):
            if yes and began is None:
                began = place
            if not yes and began is not None:
                found.append((offset + began, offset + place))
                began = None
        offset += len(part)
    return found


@given(episodes)
def test_runs_are_those_of_a_walk_along_each_episode(parts):
    first, stop = runs(flat(parts), starts_of([len(part) for part in parts]))
    assert list(zip(first.tolist(), stop.tolist(), strict=True)) == slow_runs(parts)


@given(episodes)
def test_sums_per_episode(parts):
    values = flat(parts).astype(np.float32) * 0.5
    sums = per_episode(values, starts_of([len(part) for part in parts]))
    assert sums.tolist() == [0.5 * sum(part) for part in parts]


def test_steps_stay_within_episodes_and_angles_wrap():
    state = np.array([[0.0], [1.0], [3.0], [9.0], [3.1], [-3.1]])
    demos = demonstrations({STATE: state, ACTION: state}, [4, 2])
    plain = Survey(demos, semantics(demos))
    assert np.allclose(plain.steps(plain.column(STATE, 0)), [1, 2, 6, 0, -6.2, 0], atol=1e-6)
    turning = Survey(demos, semantics(demos, circular={STATE: (True,)}))
    assert np.allclose(turning.steps(turning.column(STATE, 0))[4], 2 * np.pi - 6.2, atol=1e-6)


def test_idle_frames_are_those_of_a_loop():
    demos = joined(arm_takes(6))
    survey = Survey(demos, resolve_semantics(demos, kind="position", circular=[]))
    begins, ends = survey.moved
    for episode in range(demos.episodes):
        frames = demos.episode(episode)
        columns = [
            (demos.columns[feature][frames, i], MOVED * survey.spans[feature][i])
            for feature in (STATE, ACTION)
            for i in np.flatnonzero(~survey.dead[feature])
        ]
        moved = [t for t in range(frames.stop - frames.start) if any(abs(v[t] - v[0]) > far for v, far in columns)]
        away = [t for t in range(frames.stop - frames.start) if any(abs(v[t] - v[-1]) > far for v, far in columns)]
        assert begins[episode] == moved[0]
        assert ends[episode] == frames.stop - frames.start - 1 - away[-1]


def test_an_episode_in_which_nothing_moves_is_idle_throughout():
    takes = arm_takes(6)
    takes[2] = takes[2].frames([0] * 50, new_clock=True)
    demos = joined(takes)
    begins, ends = Survey(demos, resolve_semantics(demos, kind="position", circular=[])).moved
    assert begins[2] == ends[2] == 50


@given(st.floats(-5, 5), st.floats(0.1, 10))
def test_the_robust_deviation_of_a_gaussian_is_its_deviation(centre, deviation):
    grid = np.linspace(-3, 3, 4001)
    density = np.exp(-0.5 * grid**2)
    drawn = np.interp(np.linspace(0.001, 0.999, 2001), np.cumsum(density) / density.sum(), grid)
    middle, wide = robust(centre + deviation * drawn)
    assert abs(middle - centre) < 0.01 * deviation
    assert abs(wide / deviation - 1) < 0.01


def test_steps_command_the_state_of_their_name():
    """`Semantics` names no state for steps; whether the arm follows them is a question all the same."""
    demos = joined(arm_takes(4))
    meaning = resolve_semantics(demos, kind="delta", circular=[])
    assert meaning.state_column == (None,) * 4
    assert Survey(demos, meaning).partners == (0, 1, 2, 3)

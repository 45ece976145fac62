"""Baselines: what standing still and going on mean for every kind of action column."""

import numpy as np
import pytest

from pipeline.methods import METHODS
from pipeline.policies import Plan
from pipeline.types import ACTION, STATE, Observations
from pipeline.windows import make_windows
from tests.hand_made import STATE_ONLY, demonstrations, random_walks, semantics

KINDS = ("position", "velocity", "delta", "other", "position")
COMMANDS = (1, 0, None, None, None)


def fitted(method: str, demos, meaning, protocol: str = "strict"):
    windows = make_windows(
        demos, meaning, STATE_ONLY, [0, 1], statistics_episodes=[0, 1], protocol=protocol, history=2, chunk=1
    )
    return METHODS[method].load_class().fit(windows, Plan((0,), 0))[0], windows


def of_every_kind():
    generator = np.random.default_rng(0)
    demos = demonstrations({STATE: generator.normal(size=(16, 2)), ACTION: generator.normal(size=(16, 5))}, (8, 8))
    return demos, semantics(demos, kinds=KINDS, state_column=COMMANDS)


def test_holding_still_goes_by_kind():
    policy, windows = fitted("hold_still", *of_every_kind())
    seen = windows.observations()
    answer = policy.predict(seen, 3)
    assert answer.shape == (1, len(windows), 3, 5)
    assert answer.dtype == np.float32
    for horizon in range(3):
        now = answer[0, :, horizon]
        np.testing.assert_array_equal(now[:, 0], seen.state[:, -1, 1])  # a position: the state it commands
        np.testing.assert_array_equal(now[:, 1:3], 0)  # a velocity and a difference: zero
        np.testing.assert_array_equal(now[:, 3:], seen.previous_action[:, 3:])  # other; a position without a state


def test_constant_velocity_goes_on_as_in_the_last_frame():
    policy, windows = fitted("constant_velocity", *of_every_kind())
    seen = windows.observations()
    answer = policy.predict(seen, 3)[0]
    step = seen.state[:, -1, 1] - seen.state[:, -2, 1]
    for horizon in range(3):
        np.testing.assert_allclose(answer[:, horizon, 0], seen.state[:, -1, 1] + (horizon + 1) * step, rtol=1e-5)
        np.testing.assert_array_equal(answer[:, horizon, 1:], seen.previous_action[:, 1:])


def test_constant_velocity_turns_the_short_way_round():
    angle = np.array([[6.2], [0.1], [0.3], [0.5]] * 2)
    demos = demonstrations({STATE: angle, ACTION: angle}, (4, 4), units={STATE: ("rad",), ACTION: ("rad",)})
    meaning = semantics(demos, circular={STATE: (True,), ACTION: (True,)})
    policy, windows = fitted("constant_velocity", demos, meaning)
    expected = 0.1 + (0.1 - 6.2 + 2 * np.pi)
    assert policy.predict(windows.observations(slice(0, 1)))[0, 0, 0, 0] == pytest.approx(expected, rel=1e-5)
    policy, windows = fitted("constant_velocity", demos, meaning, "notebook")
    assert policy.predict(windows.observations(slice(0, 1)))[0, 0, 0, 0] == pytest.approx(0.1 + 0.1 - 6.2, rel=1e-5)


def test_one_frame_of_history_has_no_velocity():
    policy, windows = fitted("constant_velocity", *of_every_kind())
    seen = windows.observations()
    single = Observations(seen.values[:, -1:], seen.state[:, -1:], seen.previous_action)
    np.testing.assert_array_equal(policy.predict(single)[0, :, 0, 0], seen.state[:, -1, 1])


@pytest.mark.parametrize("method", ["hold_still", "constant_velocity"])
def test_the_first_frame_of_an_episode_has_an_answer(method):
    demos, meaning = of_every_kind()
    policy, _ = fitted(method, demos, meaning)
    state = np.ones((1, 2, 2), np.float32)
    first = Observations(state, state, np.full((1, 5), np.nan, np.float32))
    answer = policy.predict(first, 2)[0, 0]
    np.testing.assert_array_equal(answer[:, 1:3], 0)
    np.testing.assert_allclose(answer[0, 3:], demos.columns[ACTION].mean(axis=0)[3:], rtol=1e-5)


def test_the_mean_action_is_that_of_the_training_episodes():
    demos = random_walks()
    policy, windows = fitted("mean_action", demos, semantics(demos))
    answer = policy.predict(windows.observations(), 4)
    mean = demos.columns[ACTION][: demos.episode_starts[2]].mean(axis=0)
    np.testing.assert_allclose(answer, np.broadcast_to(mean, answer.shape), rtol=1e-5)


def test_the_mean_of_angles_is_a_direction():
    angle = np.array([0.1, 2 * np.pi - 0.1, 0.1, 2 * np.pi - 0.1] * 2)[:, None]
    demos = demonstrations({STATE: angle, ACTION: angle}, (4, 4))
    policy, windows = fitted("mean_action", demos, semantics(demos, circular={ACTION: (True,)}))
    assert policy.predict(windows.observations())[0, 0, 0, 0] == pytest.approx(0.0, abs=1e-5)


def test_a_data_set_without_a_state_repeats_the_previous_action():
    demos = demonstrations({"observation.force": np.arange(16.0)[:, None], ACTION: np.arange(16.0)[:, None]}, (8, 8))
    force = type(STATE_ONLY)("force", ("observation.force",))
    windows = make_windows(
        demos, semantics(demos), force, [0], statistics_episodes=[0], protocol="strict", history=2, chunk=1
    )
    policy, _ = METHODS["hold_still"].load_class().fit(windows, Plan((0,), 0))
    np.testing.assert_array_equal(policy.predict(windows.observations())[0, :, 0, 0], np.arange(0.0, 7.0))

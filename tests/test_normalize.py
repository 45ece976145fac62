"""Scaling: there and back, circles stay circles, and nothing of the held-out episodes enters."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.normalize import Normalizer, fit_normalizer, fit_notebook_scaler, fit_scaler
from pipeline.types import ACTION, STATE
from tests.hand_made import POSE, STATE_ONLY, changed, demonstrations, random_walks, semantics

FLAT = np.zeros(3, bool)


def test_encoding_and_decoding_are_inverse():
    values = np.array([[1.0, 20.0, -3.0], [2.0, 10.0, -3.5], [4.0, 0.0, -7.0]], np.float32)
    scaler = fit_scaler(values, FLAT, FLAT)
    encoded = scaler.encode(values)
    np.testing.assert_allclose(encoded.mean(axis=0), 0, atol=1e-6)
    np.testing.assert_allclose(encoded.std(axis=0), 1, atol=1e-6)
    np.testing.assert_allclose(scaler.decode(encoded), values, atol=1e-5)


def test_a_column_that_does_not_move_keeps_its_scale():
    values = np.array([[1.0, 5.0], [2.0, 5.0], [3.0, 5.0]], np.float32)
    scaler = fit_scaler(values, np.zeros(2, bool), np.array([False, True]))
    assert scaler.scale[1] == 1.0
    np.testing.assert_allclose(scaler.encode(np.float32([[2.0, 5.5]]))[0], [0.0, 0.5], atol=1e-6)


@given(st.lists(st.floats(-50, 50), min_size=2, max_size=20))
def test_angles_come_back_on_the_branch_of_the_data(angles):
    values = np.array(angles, np.float32)[:, None]
    scaler = fit_scaler(values, np.array([True]), np.array([False]))
    back = scaler.decode(scaler.encode(values))
    turns = (back - values) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-4)
    assert (np.abs(back - scaler.centre) <= np.pi + 1e-3).all()


def test_distances_on_a_circle_do_not_depend_on_where():
    around = np.linspace(0, 2 * np.pi, 50, endpoint=False)[:, None]
    scaler = fit_scaler(np.float32(np.vstack([around, around[:10]])), np.array([True]), np.array([False]))
    steps = np.linalg.norm(np.diff(scaler.encode(around), axis=0), axis=1)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-5)
    ends = scaler.encode(np.array([[0.01], [2 * np.pi - 0.01]]))
    assert np.linalg.norm(ends[0] - ends[1]) < 0.1


def test_the_notebook_divides_by_the_deviation_whatever_it_is():
    values = np.array([[1.0, 5.0], [3.0, 5.0]], np.float32)
    scaler = fit_notebook_scaler(values)
    np.testing.assert_allclose(scaler.scale, [1.0, 1e-6])
    np.testing.assert_allclose(scaler.mean, [2.0, 5.0])


def test_the_notebook_scales_actions_like_the_states_they_command():
    demos = random_walks(columns=3)
    meaning = semantics(demos, state_column=(2, 0, 1))
    fitted = fit_normalizer(demos, meaning, STATE_ONLY.features, range(5), protocol="notebook", state_for_actions=True)
    np.testing.assert_allclose(fitted.actions.mean, fitted.observations.mean[[2, 0, 1]])
    np.testing.assert_allclose(fitted.actions.scale, fitted.observations.scale[[2, 0, 1]])


def test_statistics_come_from_the_training_episodes_alone():
    demos = random_walks()

    def fitted(data):
        return fit_normalizer(data, semantics(data), STATE_ONLY.features, [0, 2, 3], protocol="strict").hash()

    assert fitted(demos) == fitted(changed(demos, [1, 4]))
    assert fitted(demos) != fitted(changed(demos, [2]))


def test_a_set_with_an_angle_is_one_column_wider_and_survives_storing():
    walks = random_walks()
    pose = np.random.default_rng(0).uniform(0, 2 * np.pi, (walks.frames, 3))
    demos = demonstrations({**walks.columns, POSE: pose}, walks.lengths, units={POSE: ("px", "px", "rad")})
    meaning = semantics(demos, circular={POSE: (False, False, True)})
    fitted = fit_normalizer(demos, meaning, (STATE, POSE), range(5), protocol="strict")
    assert fitted.observations.width == 6
    assert fitted.actions.width == demos.columns[ACTION].shape[1]
    again = Normalizer.from_arrays(fitted.arrays())
    assert again.hash() == fitted.hash()
    values = np.hstack([demos.columns[STATE], demos.columns[POSE]])
    np.testing.assert_array_equal(again.observations.encode(values), fitted.observations.encode(values))
    assert fit_normalizer(demos, meaning, (STATE, POSE), range(5), protocol="notebook").observations.width == 5


@pytest.mark.parametrize("key", [STATE, ACTION])
def test_columns_of_a_real_arm_that_do_not_move_are_found(shared_data, key):
    from pipeline.lerobot_format.read import read_dataset

    demos = read_dataset(shared_data / "cr5_banana", name="cr5")
    fitted = fit_normalizer(demos, semantics(demos), (STATE,), range(12), protocol="strict")
    scaler = fitted.observations if key == STATE else fitted.actions
    names = demos.features[key].names
    assert [name for name, scale in zip(names, scaler.scale, strict=True) if scale == 1.0] == [names[5]]

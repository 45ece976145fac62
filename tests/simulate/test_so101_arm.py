"""The arm's inverse kinematics against the model itself, and its units."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.simulate.so101_arm import (
    HIGH_RAD,
    JOINTS,
    LOW_RAD,
    Grasp,
    InverseKinematics,
    least_rolls,
    to_angles,
    to_columns,
)
from pipeline.simulate.so101_world import model

GRASPS = st.builds(
    Grasp,
    st.floats(0.14, 0.26),
    st.floats(-0.9, 0.9),
    st.floats(0.015, 0.085),
    st.floats(-math.pi / 2, math.pi / 2),
    st.floats(0.012, 0.024),
)


@pytest.fixture(scope="module")
def arm():
    return InverseKinematics(model())


def errors(arm: InverseKinematics, angles: np.ndarray, grasp: Grasp) -> tuple[float, float]:
    """m and rad between where the hand is and where it should be."""
    at, frame = arm.forward(angles, grasp.point_in_hand())
    turned = np.clip((np.trace(grasp.frame().T @ frame) - 1) / 2, -1, 1)
    return float(np.linalg.norm(at - grasp.point())), math.acos(turned)


@settings(max_examples=60, deadline=None)
@given(grasp=GRASPS)
def test_every_grasp_within_reach_is_solved_within_the_limits(arm, grasp):
    angles = arm.cold(grasp)
    assert angles is not None
    metres, radians = errors(arm, angles, grasp)
    assert metres < 1e-3
    assert radians < math.radians(3)
    assert (angles >= LOW_RAD[:5]).all()
    assert (angles <= HIGH_RAD[:5]).all()


@settings(max_examples=50, deadline=None)
@given(grasp=GRASPS, nudge=st.lists(st.floats(-0.1, 0.1), min_size=5, max_size=5))
def test_a_search_from_nearby_finds_the_same_answer(arm, grasp, nudge):
    angles = arm.cold(grasp)
    again = arm.near(grasp, angles + np.array(nudge))
    assert again is not None
    np.testing.assert_allclose(arm.forward(again, grasp.point_in_hand())[0], grasp.point(), atol=1e-3)


def test_the_derivative_is_that_of_the_model(arm):
    """The analytic rows against finite differences, where the residual is small."""
    grasp = Grasp(0.22, 0.4, 0.05, 0.3, 0.02)
    q = arm.cold(grasp) + 0.02
    asked = grasp.point(), grasp.frame(), grasp.point_in_hand()
    _, jacobian = arm._residual(q, *asked)
    for j in range(5):
        step = np.zeros(5)
        step[j] = 1e-6
        slope = (arm._residual(q + step, *asked)[0] - arm._residual(q - step, *asked)[0]) / 2e-6
        np.testing.assert_allclose(-slope, jacobian[:, j], atol=2e-3)


@pytest.mark.parametrize(
    "grasp", [Grasp(0.6, 0, 0.05, 0, 0.02), Grasp(0.2, 2.2, 0.05, 0, 0.02), Grasp(0.2, 0, 0.05, math.pi, 0.02)]
)
def test_what_is_out_of_reach_is_none(arm, grasp):
    assert arm.cold(grasp) is None


def test_limits_and_names_are_those_of_the_model():
    world = model()
    assert tuple(world.joint(i).name for i in range(6)) == JOINTS
    np.testing.assert_allclose(world.jnt_range[:6], np.column_stack([LOW_RAD, HIGH_RAD]), atol=1e-12)


def test_columns_are_degrees_and_percent():
    np.testing.assert_allclose(to_columns(LOW_RAD)[[0, 5]], [-110, 0], atol=1e-6)
    np.testing.assert_allclose(to_columns(HIGH_RAD)[[0, 5]], [110, 100], atol=1e-6)


@given(st.lists(st.floats(-3, 3), min_size=6, max_size=6))
def test_columns_and_angles_are_inverse(angles):
    np.testing.assert_allclose(to_angles(to_columns(np.array(angles))), angles, atol=1e-12)


@given(st.floats(-10, 10))
def test_of_four_sides_the_one_that_turns_the_wrist_least_comes_first(yaw):
    rolls = least_rolls(yaw + k * math.pi / 2 for k in range(4))
    assert abs(rolls[0]) <= math.pi / 4 + 1e-9
    assert math.pi / 4 - 1e-9 <= abs(rolls[1]) <= math.pi / 2 + 1e-9
    assert sorted(map(abs, rolls)) == list(map(abs, rolls))

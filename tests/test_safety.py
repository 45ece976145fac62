"""The safety layer: whatever goes in, no output breaks a limit."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.config import SafetyConfig, parse_config
from pipeline.embedded import embedded_folder
from pipeline.errors import ConfigError
from pipeline.lerobot_format.read import read_dataset
from pipeline.safety import NOT_FINITE, REPEATED, RUNS, TOLERANCE, Guard, Limits, Workspace, tighter
from pipeline.simulate.pusht import PushT
from pipeline.simulate.so101 import SO101
from pipeline.types import ACTION, STATE, Feature

NAMES = ("a", "b")
ANY = st.one_of(
    st.floats(width=32, allow_nan=True, allow_infinity=True),
    st.floats(-3, 3),
    st.sampled_from([np.nan, np.inf, -np.inf, 1e300]),
)


def limits_of(low, high, per_frame, **more) -> Limits:
    return Limits(NAMES, np.array(low, float), np.array(high, float), np.array(per_frame, float), **more)


def around(actions: np.ndarray) -> np.ndarray:
    """A robot of two joints and two links of length 1: where its hand is."""
    shoulder, elbow = actions[:, 0], actions[:, 0] + actions[:, 1]
    return np.stack([np.cos(shoulder) + np.cos(elbow), np.sin(shoulder) + np.sin(elbow)], axis=1)


@st.composite
def a_robot(draw):
    """Limits, where three robots begin, and what they are asked in each frame."""
    low = np.array([draw(st.floats(-2, 1.9)) for _ in NAMES])
    high = low + [draw(st.floats(1e-6, 4)) for _ in NAMES]
    per_frame = [draw(st.one_of(st.floats(1e-4, 5), st.just(np.inf))) for _ in NAMES]
    start = np.array([[draw(ANY) for _ in NAMES] for _ in range(3)])
    start = np.where(np.isfinite(start), start, 0.0)
    asked = np.array([[[draw(ANY) for _ in NAMES] for _ in range(3)] for _ in range(draw(st.integers(1, 6)))])
    return limits_of(low, high, per_frame, stop_after=draw(st.sampled_from([None, 1, 2]))), start, asked


def check(guard: Guard, limits: Limits, asked: np.ndarray) -> None:
    """Every output keeps every limit; the columns change by no more than they may from each to the next."""
    before = guard.previous.copy()
    for actions in asked:
        stopped = guard.stopped != RUNS
        passed = guard(actions, np.ones(len(actions), bool))
        assert passed.dtype == np.float32
        assert (passed.astype(float) >= limits.low).all()
        assert (passed.astype(float) <= limits.high).all()
        moved = np.abs(passed.astype(float) - before.astype(float))
        assert (moved <= limits.per_frame * (1 + 1e-12) + 1e-300).all()
        if limits.workspace is not None:
            assert limits.workspace.holds(passed).all()
        assert (passed[stopped] == before[stopped]).all()
        before = passed


@settings(max_examples=400, deadline=None)
@given(a_robot())
def test_no_output_breaks_a_limit(robot):
    limits, start, asked = robot
    check(Guard(limits, start), limits, asked)


@settings(max_examples=200, deadline=None)
@given(a_robot(), st.floats(-2.1, 1.5), st.floats(0.2, 2), st.floats(-2.1, 1.5), st.floats(0.2, 2))
def test_no_output_leaves_the_workspace(robot, x, width, y, height):
    limits, start, asked = robot
    box = Workspace(np.array([x, y]), np.array([x + width, y + height]), around)
    limits = limits_of(limits.low, limits.high, limits.per_frame, workspace=box)
    try:
        guard = Guard(limits, start)
    except ConfigError:
        return
    check(guard, limits, asked)


def test_the_arm_s_workspace_holds_whatever_is_asked():
    simulator, random = SO101(), np.random.default_rng(0)
    limits, standing = simulator.limits(), simulator.start(range(4)).standing()
    guard = Guard(limits, standing)
    goals = random.uniform(limits.low - 50, limits.high + 50, (6, 4, 6)).repeat(25, axis=0)
    check(guard, limits, goals)
    assert (guard.interventions > 50).all()
    assert (guard.stopped == RUNS).all()
    assert limits.workspace.place(guard.previous.astype(float))[:, 2].min() >= 0


def test_what_is_within_passes_untouched():
    limits = limits_of([0, -1], [512, 1], [np.inf, 0.5])
    guard = Guard(limits, np.zeros((1, 2)))
    for action in ([511.9999, 0.3], [0, 0.79], [512, 1]):
        asked = np.array([action], np.float32)
        np.testing.assert_array_equal(guard(asked, np.array([True])), asked)
    assert guard.interventions.tolist() == [0]


@settings(max_examples=200, deadline=None)
@given(a_robot())
def test_what_is_counted_is_what_changed_an_action_by_more_than_the_tolerance(robot):
    """Against the plain definition, frame by frame; how far it was changed is summed over what is counted."""
    limits, start, asked = robot
    limits = limits_of(limits.low, limits.high, limits.per_frame)
    guard, ranges = Guard(limits, start), limits.ranges
    for actions in asked:
        before, sums, running = guard.interventions.copy(), guard.corrections.copy(), guard.stopped == RUNS
        passed = guard(actions, np.ones(3, bool))
        with np.errstate(over="ignore"):
            wanted = actions.astype(np.float32).astype(float)
        for i in np.flatnonzero(running):
            finite = np.isfinite(wanted[i]).all()
            far = max(abs(passed[i] - wanted[i]) / ranges) if finite else 0.0
            assert guard.interventions[i] - before[i] == (far > 0.01 or not finite)
            sums[i] += far if far > 0.01 else 0.0
        np.testing.assert_allclose(guard.corrections, sums, rtol=1e-12)
    assert (guard.interventions <= len(asked)).all()


@settings(max_examples=200, deadline=None)
@given(a_robot())
def test_the_count_does_not_move_a_limit(robot):
    """What is passed on is the same whether the change is counted or not: it keeps the limits to the last bit."""
    limits, start, _ = robot
    # Frame after frame a hair further than may be.
    hair = np.nextafter(np.float32(limits.high), np.float32(np.inf)).astype(float)
    guard = Guard(replace(limits, per_frame=np.full(2, np.inf)), start)
    check(guard, guard.limits, np.tile(hair, (4, 3, 1)))
    assert (guard.previous.astype(float) <= limits.high).all()


@pytest.mark.parametrize(
    ("low", "high", "per_frame", "expected"),
    [
        ([-100, 0], [100, 100], [np.inf, np.inf], [200, 100]),
        ([-100, 0], [100, 100], [10, 50], [100, 100]),
        ([-np.inf, -np.inf], [np.inf, 5], [3, np.inf], [30, 1]),
        ([2, 2], [2, 2], [np.inf, 3], [1, 1]),
    ],
    ids=["low to high", "ten frames where that is less", "no finite range", "a column that is held"],
)
def test_a_column_s_range_is_what_it_can_reach(low, high, per_frame, expected):
    assert limits_of(low, high, per_frame).ranges.tolist() == expected


def test_a_gripper_held_at_its_limit_is_no_intervention():
    """Asked to close a hair further than it can: held exactly, not counted, and it does not stop the robot."""
    limits = limits_of([0, 0], [100, 100], [np.inf, np.inf], stop_after=2)
    guard, one = Guard(limits, np.array([[50.0, 0.0]])), np.array([True])
    for _ in range(50):
        np.testing.assert_array_equal(guard(np.array([[50.0, -100 * TOLERANCE]]), one), [[50, 0]])
    assert (guard.interventions.tolist(), guard.corrections.tolist(), guard.stopped.tolist()) == ([0], [0], [RUNS])
    for _ in range(2):
        guard(np.array([[50.0, -4.0]]), one)
    assert (guard.interventions.tolist(), guard.stopped.tolist()) == ([2], [REPEATED])
    assert guard.corrections[0] == pytest.approx(0.08)


@pytest.mark.parametrize(("name", "simulator"), [("so101_sim", SO101), ("pusht_sim", PushT)])
def test_followers_are_further_than_the_tolerance_from_their_leaders(name, simulator):
    """The reason for the tolerance, in every column of the demonstrations: a robot is not where it is told to be."""
    demos, ranges = read_dataset(embedded_folder(name), name=name), simulator().limits().ranges
    behind = np.abs(demos.columns[ACTION] - demos.columns[STATE]).mean(axis=0) / ranges
    assert (behind > TOLERANCE).all()
    assert behind.max() < 10 * TOLERANCE


def test_a_speed_limit_is_measured_from_what_was_passed_on():
    guard = Guard(limits_of([-9, -9], [9, 9], [1, np.inf]), np.array([[0.5, 0]]))
    assert [guard(np.array([[9, 9]]), np.array([True]))[0].tolist() for _ in range(3)] == [[1.5, 9], [2.5, 9], [3.5, 9]]
    assert guard.interventions.tolist() == [3]


def test_an_action_is_shortened_to_the_edge_of_the_workspace():
    box = Workspace(np.array([-9.0, -9.0]), np.array([9.0, 1.0]), lambda actions: actions)
    guard = Guard(limits_of([-9, -9], [9, 9], [np.inf, np.inf], workspace=box), np.zeros((1, 2)))
    passed = guard(np.array([[2.0, 2.0]]), np.array([True]))[0]
    assert passed == pytest.approx([1, 1], abs=1e-3)


def test_it_stops_for_good():
    limits = limits_of([-1, -1], [1, 1], [np.inf, np.inf], stop_after=2)
    guard, everyone = Guard(limits, np.zeros((3, 2))), np.ones(3, bool)
    guard(np.array([[0.1, 0.1], [np.nan, 0], [5, 0]]), everyone)
    assert guard.stopped.tolist() == [RUNS, NOT_FINITE, RUNS]
    guard(np.array([[0.2, 5], [0, 0], [5, 0]]), everyone)
    assert guard.stopped.tolist() == [RUNS, NOT_FINITE, REPEATED]
    passed = guard(np.array([[0.3, 0.3]] * 3), everyone)
    np.testing.assert_allclose(passed, [[0.3, 0.3], [0, 0], [1, 0]])
    assert guard.interventions.tolist() == [1, 1, 2]


def test_those_that_do_not_run_are_not_counted():
    guard = Guard(limits_of([-1, -1], [1, 1], [np.inf, np.inf]), np.zeros((2, 2)))
    guard(np.full((2, 2), np.nan), np.array([True, False]))
    assert guard.interventions.tolist() == [1, 0]
    assert guard.stopped.tolist() == [NOT_FINITE, RUNS]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: limits_of([1, 0], [0, 1], [1, 1]), "limits of 'a' contradict each other: nothing is both 1 or more and 0 or less"),
        (lambda: limits_of([0, np.nan], [0, 1], [1, 1]), "limits of 'b' contradict"),
        (lambda: limits_of([0, 0], [1, 1], [1, 0]), "'b' may change by 0 a frame: it could never move"),
        (
            lambda: limits_of([0, 0], [1, 1], [1, 1], workspace=Workspace(np.zeros(2), np.zeros(2), around)),
            "limits of the workspace contradict",
        ),
        (
            lambda: Guard(
                limits_of([0, 0], [1, 1], [1, 1], workspace=Workspace(np.full(2, 5), np.full(2, 6), around)), np.zeros((1, 2))
            ),
            "begins at .* outside its workspace",
        ),
        (lambda: Guard(limits_of([0, 0], [1, 1], [1, 1]), np.full((1, 2), np.nan)), "does not say where it is"),
    ],
)  # fmt: skip
def test_limits_that_contradict_each_other_are_refused(make, message):
    with pytest.raises(ConfigError, match=message):
        make()


# The configuration --------------------------------------------------------------------------------------------------------


FEATURE = Feature(ACTION, ("pan", "grip"), ("deg", "%"))


def test_the_configuration_s_limits_hold_beside_the_robot_s():
    own = limits_of([-90, 0], [90, 100], [10, 10], workspace=Workspace(np.zeros(3), np.ones(3), lambda a: a))
    asked = SafetyConfig(
        low={"deg": -30}, high={"grip": 200, "deg": 45}, per_frame={"pan": 2}, stop_after=7,
        workspace={"low": (0.5, -3, 0), "high": (2, 2, 0.5)},
    )  # fmt: skip
    found = tighter(own, asked, FEATURE)
    assert (found.low.tolist(), found.high.tolist(), found.per_frame.tolist()) == ([-30, 0], [45, 100], [2, 10])
    assert (found.names, found.stop_after) == (("pan", "grip"), 7)
    assert found.workspace.low.tolist() == [0.5, 0, 0]
    assert found.workspace.high.tolist() == [1, 1, 0.5]


@pytest.mark.parametrize(
    ("safety", "message"),
    [
        (
            {"low": {"pam": 1}},
            "for 'pam', which is neither an action column nor a unit here. Known: pan, grip, deg, %",
        ),
        ({"low": {"pan": 100}}, "limits of 'pan' contradict each other: nothing is both 100 or more and 90 or less"),
        ({"workspace": {"low": (0, 0, 0), "high": (1, 1, 1)}}, "a workspace needs forward kinematics"),
    ],
)
def test_limits_that_the_robot_cannot_keep_are_refused(safety, message):
    with pytest.raises(ConfigError, match=message):
        tighter(limits_of([-90, 0], [90, 100], [10, 10]), SafetyConfig(**safety), FEATURE)


@pytest.mark.parametrize(
    ("safety", "message"),
    [
        ({"low": {"deg": 1}, "high": {"deg": 0}}, "limits of 'deg' contradict each other"),
        ({"workspace": {"low": [0, 0, 0], "high": [1, 0, 1]}}, "low must be below high everywhere"),
        ({"per_frame": {"deg": 0}}, "greater than 0"),
        ({"lowest": {}}, "unknown key 'lowest' in .*safety.*Did you mean 'low'"),
        ({"high": {"deg": float("nan")}}, "finite"),
    ],
)
def test_a_file_with_limits_that_cannot_be_is_refused(safety, message):
    with pytest.raises(ConfigError, match=message):
        parse_config({"datasets": {"tape": {"source": "somewhere", "safety": safety}}}, "file")

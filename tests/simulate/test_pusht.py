"""The fast PushT against the environment itself, and what it refuses."""

import subprocess
import sys

import numpy as np
import pytest

from pipeline.errors import NotApplicableError
from pipeline.simulate import load_simulator, simulator_for
from pipeline.simulate.pusht import BLOCK, PushT, environment_class, make_environment
from pipeline.types import ACTION, STATE, Demonstrations, Feature, ObservationSet

POSE = ObservationSet("pose", (STATE, BLOCK))


def demonstrations(**changes) -> Demonstrations:
    """Three frames that fit PushT, with features replaced by `key=(names, units, values)`."""
    px, block = ("x_px", "y_px"), ("block_x_px", "block_y_px", "block_angle_rad")
    features = {
        ACTION: (px, ("px", "px"), np.full((3, 2), 200.0)),
        STATE: (px, ("px", "px"), np.full((3, 2), 190.0)),
        BLOCK: (block, ("px", "px", "rad"), np.full((3, 3), 3.0)),
    } | changes
    features = {key: value for key, value in features.items() if value is not None}
    return Demonstrations(
        name="mine",
        source="test",
        revision=None,
        fps=10.0,
        robot_type=None,
        columns={key: values.astype(np.float32) for key, (_, _, values) in features.items()},
        features={key: Feature(key, names, units) for key, (names, units, _) in features.items()},
        episode_starts=np.array([0, 3]),
        episode_ids=np.array([0]),
        timestamps=np.arange(3) / 10,
        tasks=("",),
        cameras=(),
        warnings=(),
        content_hash="",
    )


def slow_coverage(environment) -> float:
    """As `PushTEnv` does it, with the two bars in the order in which they were made rather than in that of a set."""
    from gym_pusht.envs.pusht import pymunk_to_shapely

    goal = pymunk_to_shapely(environment.get_goal_pose_body(environment.goal_pose), environment._block_shapes)
    return goal.intersection(pymunk_to_shapely(environment.block, environment._block_shapes)).area / goal.area


def test_steps_are_those_of_the_environment_to_the_last_bit():
    numbers = range(8)
    fast, slow = PushT().start(numbers), [environment_class()(obs_type="state") for _ in numbers]
    for number, environment in zip(numbers, slow, strict=True):
        environment.reset(seed=number)
    random, touched, covered = np.random.default_rng(0), 0, 0
    for _ in range(50):
        actions = np.clip(fast.observe()[BLOCK][:, :2] + random.uniform(-70, 70, (8, 2)), 0, 512).astype(np.float32)
        outcome = fast.step(actions, np.ones(8, dtype=bool))
        shown = fast.observe()
        for i, environment in enumerate(slow):
            state, reward, terminated, _, info = environment.step(actions[i])
            touched += info["n_contacts"] > 0
            covered += info["coverage"] > 0
            np.testing.assert_array_equal(shown[STATE][i], state[:2].astype(np.float32))
            np.testing.assert_array_equal(shown[BLOCK][i], state[2:].astype(np.float32))
            assert outcome.coverage[i] == slow_coverage(environment)
            assert outcome.coverage[i] == pytest.approx(info["coverage"], abs=1e-12)
            assert outcome.reward[i] == pytest.approx(reward, abs=1e-12)
            assert outcome.success[i] == terminated
    assert min(touched, covered) > 50


def test_coverage_of_known_places():
    environments = PushT().start([0])
    (environment,) = environments._environments
    environment.agent.position = (20, 20)
    environment.block.angle = np.pi / 4
    # 10 px across the foot of the T: a strip of 10 × 30 at the end of the bar and one of 10 × 90 along the stem are bare.
    for shift, expected in [(0, 1.0), (10, 1 - 10 * (30 + 90) / 6300), (200, 0.0)]:
        environment.block.position = (256 + shift * np.cos(np.pi / 4), 256 + shift * np.sin(np.pi / 4))
        assert environments._coverage([environment])[0] == pytest.approx(expected, abs=1e-9)


def test_only_running_environments_move():
    environments = PushT().start([3, 4])
    before = environments.observe()
    outcome = environments.step(np.full((2, 2), 256.0), np.array([True, False]))
    after = environments.observe()
    assert (before[STATE][0] != after[STATE][0]).any()
    np.testing.assert_array_equal(before[STATE][1], after[STATE][1])
    assert outcome.coverage[1] == 0


def test_a_start_state_is_its_number():
    shown = PushT().start([5, 6, 5]).observe()
    np.testing.assert_array_equal(shown[BLOCK][0], shown[BLOCK][2])
    assert (shown[BLOCK][0] != shown[BLOCK][1]).any()
    environment = environment_class()(obs_type="state")
    state, _ = environment.reset(seed=5)
    np.testing.assert_array_equal(np.concatenate([shown[STATE][0], shown[BLOCK][0]]), state.astype(np.float32))


def test_no_window_is_opened():
    import pygame

    PushT().start([0]).step(np.zeros((1, 2)), np.array([True]))
    assert not pygame.display.get_init()


def test_nothing_is_imported_before_it_is_used():
    code = (
        "import sys, pipeline.simulate.rollout, pipeline.simulate.pusht, pipeline.simulate.pusht_demonstrator\n"
        "print(sorted({'gym_pusht', 'gymnasium', 'pymunk', 'pygame', 'shapely', 'torch'} & set(sys.modules)))"
    )
    shown = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == "[]"


def test_importing_the_simulator_says_nothing():
    code = "from pipeline.simulate import load_simulator; load_simulator('pusht')"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout + shown.stderr == ""


def test_a_simulator_that_is_not_installed_names_the_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "gym_pusht.envs.pusht", None)
    with pytest.raises(NotApplicableError, match=r"pip install 'demobench\[pusht\]'"):
        load_simulator("pusht")


def test_an_unknown_simulator_gets_a_suggestion():
    with pytest.raises(NotApplicableError, match="Did you mean 'pusht'"):
        load_simulator("push")


@pytest.mark.parametrize("features", [(STATE,), (STATE, BLOCK), (BLOCK,)])
def test_fitting_columns_are_accepted(features):
    assert simulator_for("pusht", demonstrations(), ObservationSet("some", features)).name == "pusht"


def test_columns_without_units_are_accepted_when_their_numbers_are_px():
    motors, nothing = ("motor_0", "motor_1"), (None, None)
    demos = demonstrations(
        **{
            ACTION: (motors, nothing, np.full((3, 2), 400.0)),
            STATE: (motors, nothing, np.full((3, 2), 300.0)),
        }
    )
    assert PushT().fits(demos, ObservationSet("state", (STATE,))) is None


@pytest.mark.parametrize(
    ("key", "replacement", "message"),
    [
        (ACTION, (("a", "b", "c"), ("px",) * 3, np.ones((3, 3))), r"has 3 columns \(a, b, c\); expected 2 columns"),
        (ACTION, (("pan_deg", "lift_deg"), ("deg", "deg"), np.ones((3, 2))), "'pan_deg', is in deg; expected px"),
        (ACTION, (("x", "y"), (None, None), np.full((3, 2), -0.5)), "names no unit; expected px"),
        (BLOCK, (tuple("0123456789abcdef"), (None,) * 16, np.ones((3, 16))), "has 16 columns .* expected 3 columns"),
        (BLOCK, None, f"no feature {BLOCK}"),
    ],
)
def test_columns_that_do_not_fit_are_named(key, replacement, message):
    with pytest.raises(NotApplicableError, match=message):
        simulator_for("pusht", demonstrations(**{key: replacement}), POSE)


def test_a_feature_that_the_simulator_does_not_show_is_named():
    with pytest.raises(NotApplicableError, match=r"needs observation\.force.*\[datasets\.mine\.observations\]"):
        simulator_for("pusht", demonstrations(), ObservationSet("touch", (STATE, "observation.force")))


def test_the_real_demonstrations_fit(shared_data):
    from pipeline.lerobot_format.read import read_dataset

    assert PushT().fits(read_dataset(shared_data / "pusht_image", name="pusht_image"), POSE) is None
    assert PushT().fits(read_dataset(shared_data / "pusht", name="pusht"), ObservationSet("state", (STATE,))) is None
    arm = read_dataset(shared_data / "so101_pick_place_tape", name="tape")
    assert "action has 6 columns" in (PushT().fits(arm, POSE) or "")


def test_make_environment_keeps_the_physics():
    """Contacts are no longer counted; everything else is as it was."""
    ours, theirs = make_environment(11), environment_class()(obs_type="state")
    theirs.reset(seed=11)
    for target in np.linspace((60, 60), (450, 450), 40):
        a, b = ours.step(target)[0], theirs.step(target)[0]
    np.testing.assert_array_equal(a, b)

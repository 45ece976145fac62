"""A policy's own view: what is encoded is decoded, relative actions and derived features on tiny arrays."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.errors import PolicyError
from pipeline.policies.pusht_views import BLOCK, CORNERS, block_frame
from pipeline.policies.transform import Transform, derive, fit_transform
from pipeline.types import ACTION, STATE, ObservationSet
from pipeline.windows import make_windows
from tests.hand_made import POSE, STATE_ONLY, demonstrations, random_walks, semantics

WITH_POSE = ObservationSet("pose", (STATE, POSE))


def lay(demos, meaning=None, seen=STATE_ONLY, **more):
    settings = {"statistics_episodes": range(demos.episodes), "protocol": "strict", "history": 2, "chunk": 3}
    return make_windows(demos, meaning or semantics(demos), seen, range(demos.episodes), **settings | more)


def pusht(frames=12, episodes=3, seed=0):
    """Agent and block somewhere on the table, targets near the agent."""
    generator = np.random.default_rng(seed)
    agent = generator.uniform(100, 400, (frames * episodes, 2))
    block = np.column_stack(
        [generator.uniform(150, 350, (frames * episodes, 2)), generator.uniform(0, 6.28, frames * episodes)]
    )
    columns = {STATE: agent, POSE: block, ACTION: agent + generator.normal(0, 20, agent.shape)}
    units = {STATE: ("px", "px"), ACTION: ("px", "px"), POSE: ("px", "px", "rad")}
    demos = demonstrations(columns, (frames,) * episodes, units=units)
    return demos, semantics(demos, circular={POSE: (False, False, True)})


# Relative actions -------------------------------------------------------------------------------------------------------


def test_relative_actions_are_target_minus_state_over_each_step_s_rms():
    demos = random_walks()
    windows = lay(demos)
    transform = fit_transform(windows, actions="relative")
    values, (actions, inside) = windows.observations().values, windows.targets()
    moved = actions - values[:, -1, None]
    expected_rms = [np.sqrt((moved[inside[:, k], k].astype(float) ** 2).mean(axis=0)) for k in range(3)]
    np.testing.assert_allclose(transform.rms, expected_rms, rtol=1e-6)
    assert transform.rms[2].mean() > 1.2 * transform.rms[0].mean()
    encoded = transform.encode_actions(actions, transform.now(values))
    np.testing.assert_allclose(encoded, moved / transform.rms, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("how", ["absolute", "relative"])
@pytest.mark.parametrize("angle", [False, True])
def test_what_is_encoded_is_decoded(how, angle):
    demos = random_walks()
    circular = {ACTION: (False, angle)} if angle else {}
    windows = lay(demos, semantics(demos, kinds=("position", "position"), circular=circular))
    transform = fit_transform(windows, actions=how)
    values, (actions, _) = windows.observations().values, windows.targets()
    now = transform.now(values)
    back = transform.decode_actions(transform.encode_actions(actions, now)[None], now)[0]
    turns = (back - actions)[..., 1] / (2 * np.pi)
    if angle:
        np.testing.assert_allclose(turns, turns.round(), atol=1e-5)
        back[..., 1] = actions[..., 1]
    np.testing.assert_allclose(back, actions, rtol=1e-5, atol=1e-5)


def test_a_relative_angle_goes_the_short_way_round_and_is_answered_in_the_recording_s_branch():
    state = np.tile([[0.1], [6.2]], (10, 1))
    demos = demonstrations({STATE: state, ACTION: np.roll(state, 1)}, (10, 10), units={ACTION: ("rad",)})
    windows = lay(demos, semantics(demos, circular={ACTION: (True,), STATE: (True,)}), chunk=1)
    transform = fit_transform(windows, actions="relative")
    values, (actions, _) = windows.observations().values, windows.targets()
    now = transform.now(values)
    encoded = transform.encode_actions(actions, now)
    assert np.abs(encoded * transform.rms).max() < 0.3
    np.testing.assert_allclose(transform.decode_actions(encoded, now), actions, atol=1e-5)


def test_only_positions_are_relative():
    demos = random_walks(columns=3)
    windows = lay(demos, semantics(demos, kinds=("position", "velocity", "other"), state_column=(2, None, None)))
    transform = fit_transform(windows, actions="relative")
    assert transform.relative.tolist() == [True, False, False]
    values, (actions, _) = windows.observations().values, windows.targets()
    now = transform.now(values)
    np.testing.assert_array_equal(now[:, 0], values[:, -1, 2])
    encoded = transform.encode_actions(actions, now)
    absolute = windows.normalizer.actions.encode(actions)
    np.testing.assert_allclose(encoded[..., :2], absolute[..., 1:], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(transform.decode_actions(encoded, now), actions, rtol=1e-5, atol=1e-5)


def test_where_nothing_is_relative_it_is_refused():
    demos = random_walks()
    with pytest.raises(PolicyError, match=r"no action column .* is a position .*a0 velocity, a1 delta"):
        fit_transform(lay(demos, semantics(demos, kinds=("velocity", "delta"))), actions="relative")
    demos, meaning = pusht()
    with pytest.raises(PolicyError, match="would give away what the policy does not see"):
        fit_transform(lay(demos, meaning, ObservationSet("block", (POSE,))), actions="relative")


def test_held_out_episodes_leave_no_trace():
    demos = random_walks()
    changed = {key: values.copy() for key, values in demos.columns.items()}
    for values in changed.values():
        values[demos.episode(3)] += 100
    settings = {"statistics_episodes": (0, 1), "protocol": "strict", "history": 2, "chunk": 3}
    found = [
        fit_transform(make_windows(d, semantics(d), STATE_ONLY, (0, 1), **settings), actions="relative").arrays()
        for d in (demos, replace(demos, columns=changed))
    ]
    for name, array in found[0].items():
        np.testing.assert_array_equal(array, found[1][name])


# Derived features -------------------------------------------------------------------------------------------------------


def test_the_block_frame_by_hand():
    """The agent 80 px beside the top bar's end of a block that is turned by a right angle."""
    agent = np.array([[[200.0, 220.0], [200.0, 240.0]]])
    block = np.array([[[300.0, 240.0, np.pi / 2], [300.0, 240.0, np.pi / 2]]])
    found = block_frame({STATE: agent, BLOCK: block})[0]
    corners, beside, rest = found[:16].reshape(8, 2), found[16:18], found[18:]
    np.testing.assert_allclose(beside, [0.0, 100.0], atol=1e-9)
    np.testing.assert_allclose(rest[:2], np.tanh([0.0, 2.5]), atol=1e-9)
    np.testing.assert_allclose(rest[2:4], np.tanh([44 / 40, -16 / 40]))
    np.testing.assert_allclose(rest[4:6], [np.sin(np.pi / 4), np.cos(np.pi / 4)])
    np.testing.assert_allclose(corners[0], [300.0, 180.0], atol=1e-9)
    np.testing.assert_allclose(rest[6:22], 0.0, atol=1e-9)
    np.testing.assert_allclose(rest[22:], [0.0, 20.0])


def test_the_corners_are_those_of_the_simulator_s_block():
    from pipeline.simulate.pusht_geometry import OUTLINE

    np.testing.assert_array_equal(CORNERS, OUTLINE)


def test_derived_features_come_after_the_columns_and_are_scaled():
    demos, meaning = pusht()
    windows = lay(demos, meaning, WITH_POSE)
    plain, transform = fit_transform(windows), fit_transform(windows, features="pusht_block_frame")
    values = windows.observations().values
    encoded = transform.encode(values)
    width = 2 * (5 + 1)
    np.testing.assert_array_equal(encoded[:, :width], plain.encode(values))
    assert encoded.shape[1] == width + 42
    np.testing.assert_allclose(encoded[:, width:].mean(axis=0), 0, atol=1e-4)
    np.testing.assert_allclose(encoded[:, width:].std(axis=0), 1, atol=1e-4)


def test_one_frame_has_no_displacements():
    demos, meaning = pusht()
    windows = lay(demos, meaning, WITH_POSE, own_history=1)
    values = windows.observations().values
    assert derive("pusht_block_frame", {STATE: 2, POSE: 3}, values).shape[1] == 24


def test_features_that_need_what_is_not_seen_are_refused_by_name():
    demos, _ = pusht()
    words = "derived features 'pusht_block_frame' need 'observation.environment_state', .* It holds observation.state"
    with pytest.raises(PolicyError, match=words):
        fit_transform(lay(demos), features="pusht_block_frame")


OWN = """
import numpy as np
def distance(seen):
    return np.hypot(*seen["observation.state"][:, -1].T)[:, None]
def broken(seen):
    return 1 / 0
def flat(seen):
    return np.zeros(3)
def endless(seen):
    return np.full((len(seen["observation.state"]), 1), np.inf)
"""


@pytest.fixture
def own(tmp_path):
    (tmp_path / "mine.py").write_text(OWN)
    return lambda name: f"{tmp_path / 'mine.py'}:{name}"


def test_a_function_of_the_user_s_own(own):
    windows = lay(random_walks())
    transform = fit_transform(windows, features=own("distance"))
    values = windows.observations().values
    last = transform.encode(values)[:, -1]
    expected = np.hypot(*values[:, -1].T)
    np.testing.assert_allclose(last, (expected - expected.mean()) / expected.std(), rtol=1e-3, atol=1e-3)
    again = Transform.restore(transform.arrays(), transform.settings())
    np.testing.assert_array_equal(again.encode(values), transform.encode(values))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("broken", "raised ZeroDivisionError"),
        ("flat", r"have the shape \(3,\); expected \[41, F\]"),
        ("endless", "not finite everywhere"),
        ("absent", "has no function 'absent'"),
    ],
)
def test_mistakes_in_it_are_one_message(own, name, words):
    with pytest.raises(PolicyError, match=words):
        fit_transform(lay(random_walks()), features=own(name))


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(PolicyError, match='features = ".*": there is no file'):
        fit_transform(lay(random_walks()), features=f"{tmp_path}/nowhere.py:f")

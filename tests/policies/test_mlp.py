"""The MLP and its smaller sister: sizes, learning, angles, and going through files unchanged."""

import numpy as np
import pytest

from pipeline.errors import PolicyError
from pipeline.methods import METHODS
from pipeline.policies import Plan
from pipeline.policies.mlp import Mlp
from pipeline.policies.notebook_pusht import NotebookPushT
from pipeline.train import train_policy
from pipeline.types import ACTION, STATE
from pipeline.windows import make_windows
from tests.hand_made import STATE_ONLY, demonstrations, random_walks, semantics


def lay(demos, meaning=None, **more):
    settings = {"statistics_episodes": range(demos.episodes), "protocol": "strict", "history": 3, "chunk": 1}
    return make_windows(demos, meaning or semantics(demos), STATE_ONLY, range(demos.episodes), **settings | more)


@pytest.mark.parametrize(("chunk", "parameters"), [(1, 275_462), (4, 284_696), (16, 321_632), (32, 370_880)])
def test_the_number_of_parameters_is_the_notebook_s(chunk, parameters):
    windows = lay(random_walks((40, 40), columns=6), chunk=chunk)
    assert Mlp.fit(windows, Plan((0,), 1))[0].parameters == parameters


def test_the_recipes_are_those_that_are_published():
    arm, pusht = Mlp.RECIPE, NotebookPushT.RECIPE
    assert (arm.hidden, arm.loss, arm.batch, arm.learning_rate, arm.weight_decay) == ((512, 512), "l1", 256, 1e-3, 1e-4)
    assert (pusht.hidden, pusht.loss, pusht.batch, pusht.weight_decay) == ((256, 256), "squared", 512, 0.01)


def test_it_learns_a_rule_that_needs_the_history():
    """The action is the last step once more: one frame does not tell, three do."""
    generator = np.random.default_rng(0)
    state = np.concatenate([generator.normal(size=(40, 1)).cumsum(axis=0) for _ in range(8)])
    step = np.diff(state, axis=0, prepend=state[:1])
    demos = demonstrations({STATE: state, ACTION: step}, (40,) * 8)
    errors = {}
    for recipe in ("arm", "every_frame"):
        windows = lay(demos, recipe=recipe)
        policy, _ = Mlp.fit(windows, Plan((0,), 300))
        actions, _ = windows.targets()
        errors[recipe] = np.abs(policy.predict(windows.observations())[0] - actions).mean()
    assert errors["arm"] < 0.1 < 0.5 < errors["every_frame"]


def test_answers_are_chunks_of_every_seed_in_raw_units():
    demos = random_walks((20, 20))
    demos.columns[ACTION][:] += 100
    windows = lay(demos, chunk=4)
    policy, _ = Mlp.fit(windows, Plan((0, 1, 2), 60))
    answer = policy.predict(windows.observations(slice(0, 7)), horizons=99)
    assert answer.shape == (3, 7, 4, 2)
    assert answer.dtype == np.float32
    assert 90 < answer.mean() < 115
    np.testing.assert_allclose(policy.one_seed(1).predict(windows.observations(slice(0, 7)))[0], answer[1], rtol=1e-5)
    assert policy.one_seed(1).seeds == (1,)


@pytest.mark.parametrize("method", ["mlp", "notebook_pusht"])
def test_the_plain_network_overfits_one_episode_and_answers_alone_as_in_company(method):
    turn = np.linspace(0, 2 * np.pi, 40)
    state = 100 * np.column_stack([np.cos(turn), np.sin(turn)])
    demos = demonstrations({STATE: state, ACTION: np.roll(state, -1, axis=0)}, (40,))
    settings = {"statistics_episodes": (0,), "protocol": "strict", "history": 2, "recipe": METHODS[method].recipe}
    windows = make_windows(demos, semantics(demos), STATE_ONLY, (0,), chunk=1, **settings)
    policy = train_policy(method, windows, seeds=(1,), steps=400).policy
    (actions, inside), together = windows.targets(), policy.predict(windows.observations())
    error = np.abs(together[0] - actions)[inside].mean()
    assert error < 0.15 * np.abs(actions - actions.mean(axis=(0, 1)))[inside].mean()
    alone = policy.predict(windows.observations(slice(7, 8)))
    np.testing.assert_allclose(alone[:, 0], together[:, 7], rtol=1e-3, atol=1e-3)


def test_an_angle_that_wraps_is_answered_across_the_seam():
    """Commands just below and just above zero average to zero, not to half a turn."""
    angle = np.tile([[0.05], [2 * np.pi - 0.05]], (20, 1))
    demos = demonstrations({STATE: np.zeros((40, 1)), ACTION: angle}, (20, 20), units={ACTION: ("rad",)})
    windows = lay(demos, semantics(demos, circular={ACTION: (True,)}))
    policy, _ = Mlp.fit(windows, Plan((0,), 100))
    answer = policy.predict(windows.observations())[0, :, 0, 0]
    assert (np.abs(np.sin(answer)) < 0.1).all()
    assert (np.cos(answer) > 0.9).all()


def test_a_policy_that_went_through_arrays_answers_the_same():
    windows = lay(random_walks((20, 20)), chunk=2)
    policy, _ = Mlp.fit(windows, Plan((3, 4), 5))
    again = Mlp.restore(policy.arrays(), policy.settings())
    np.testing.assert_array_equal(again.predict(windows.observations()), policy.predict(windows.observations()))
    assert (again.seeds, again.history, again.chunk) == ((3, 4), 3, 2)


def test_another_history_than_it_was_trained_on_is_refused():
    demos = random_walks((20, 20))
    policy, _ = Mlp.fit(lay(demos), Plan((0,), 1))
    with pytest.raises(PolicyError, match="sees 3 frames at a time and was given 5"):
        policy.predict(lay(demos, own_history=5).observations())

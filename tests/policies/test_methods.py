"""What every trained method of ours owes, whatever it is: it learns, and its answers and bytes can be relied on."""

import importlib
import re

import numpy as np
import pytest

from pipeline.errors import ConfigError, PolicyError
from pipeline.methods import METHODS
from pipeline.policies import Plan
from pipeline.policies.mlp import MlpNetwork
from pipeline.policies.networks import NetworkTraining, Sampler, Shape
from pipeline.policies.transform import fit_transform
from pipeline.settings import SETTINGS, settings_of
from pipeline.train import load_trained, save_trained, train_policy, weights_hash
from pipeline.types import ACTION, STATE, Observations
from pipeline.windows import make_windows
from tests.hand_made import STATE_ONLY, demonstrations, random_walks, semantics
from tests.policies.test_transform import WITH_POSE, pusht

NETWORKS = {
    "mlp": {"blocks": 2, "dropout": 0.1, "width": 32, "warmup": 5, "cosine": True, "ema": True, "clip": 1.0},
    "gmm": {"blocks": 1, "width": 32, "components": 3, "warmup": 5},
    "flow": {"blocks": 2, "width": 48, "euler_steps": 4, "warmup": 5},
    "diffusion": {"blocks": 2, "width": 48, "noise_steps": 20, "sampling_steps": 5, "warmup": 5},
    "act": {"width": 16, "heads": 2, "layers": 1, "latent": 4, "warmup": 5},
}
ALL = NETWORKS | {"lwr": {}}
LEARNING = {
    "mlp": {"dropout": 0.0, "learning_rate": 3e-3},
    "gmm": {"learning_rate": 3e-3, "components": 2},
    "flow": {"learning_rate": 3e-3},
    "diffusion": {"learning_rate": 3e-3, "sampling_steps": 10},
    "act": {"learning_rate": 3e-3, "dropout": 0.0, "width": 32},
    "lwr": {},
}
GIVEN = {"actions": "relative", "noise": 0.01}


def lay(demos, meaning=None, seen=STATE_ONLY, **more):
    settings = {"statistics_episodes": range(demos.episodes), "protocol": "strict", "history": 2, "chunk": 4}
    return make_windows(demos, meaning or semantics(demos), seen, range(demos.episodes), **settings | more)


def train(method, windows=None, steps=12, seeds=(0, 3), given=None, **more):
    settings = ALL[method] | {"batch": 16} if method in NETWORKS else ALL[method]
    settings = settings | more.pop("settings", {})
    given = GIVEN if given is None else given
    given = {key: value for key, value in given.items() if key in METHODS[method].takes}
    windows = lay(random_walks()) if windows is None else windows
    return train_policy(method, windows, seeds=seeds, steps=steps, settings=settings, given=given, **more)


def asked(seen: Observations, rows) -> Observations:
    return Observations(seen.values[rows], seen.state[rows], seen.previous_action[rows])


def test_every_method_with_settings_is_tested_here():
    """But what needs a camera, which has a file of its own (`test_image`)."""
    assert set(ALL) == {method for method in SETTINGS if not METHODS[method].camera}


@pytest.mark.parametrize("method", SETTINGS)
def test_its_file_names_the_paper_that_it_follows_and_where_it_departs(method):
    about = importlib.import_module(METHODS[method].module).__doc__
    assert re.search(r"\b(19|20)\d\d\b", about)
    assert "Departures" in about


@pytest.mark.parametrize("method", ALL)
def test_it_overfits_one_episode(method):
    """A circle with a command ahead of it: after a few hundred steps a tenth of the mean command's error is left."""
    turn = np.linspace(0, 2 * np.pi, 40)
    state = 100 * np.column_stack([np.cos(turn), np.sin(turn)])
    demos = demonstrations({STATE: state, ACTION: np.roll(state, -1, axis=0)}, (40,))
    windows = lay(demos)
    policy = train(method, windows, 400, (1,), {}, settings=LEARNING[method]).policy
    (actions, inside), answer = windows.targets(), policy.predict(windows.observations())[0]
    error = np.abs(answer - actions)[inside].mean()
    assert error < 0.15 * np.abs(actions - actions.mean(axis=(0, 1)))[inside].mean()


@pytest.mark.parametrize("method", ALL)
def test_an_answer_does_not_depend_on_the_rest_of_its_batch(method):
    policy, seen = train(method).policy, lay(random_walks(seed=5)).observations()
    together = policy.predict(seen)
    order = np.random.default_rng(0).permutation(len(seen))
    np.testing.assert_allclose(policy.predict(asked(seen, order)), together[:, order], rtol=1e-3, atol=1e-3)
    for row in (0, 7):
        alone = policy.predict(asked(seen, slice(row, row + 1)))
        np.testing.assert_allclose(alone[:, 0], together[:, row], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("method", ALL)
def test_it_loads_to_the_same_predictions(method, tmp_path):
    trained, seen = train(method), lay(random_walks(seed=5)).observations()
    save_trained(trained, tmp_path)
    again = load_trained(tmp_path)
    np.testing.assert_array_equal(again.policy.predict(seen), trained.policy.predict(seen))
    assert (again.policy.seeds, again.policy.chunk, again.parameters) == ((0, 3), 4, trained.parameters)
    if hasattr(trained.policy, "sample"):
        np.testing.assert_array_equal(again.policy.sample(seen, 3), trained.policy.sample(seen, 3))


class Killed(Exception):
    pass


@pytest.mark.parametrize("method", NETWORKS)
def test_a_killed_training_goes_on_to_the_same_bytes(method, tmp_path):
    """Dropout, noise, shuffles, rates and the average all go on where they were."""

    def stop(done, steps, loss):
        if done == 5:
            raise Killed

    checkpoint = tmp_path / "checkpoint.safetensors"
    plan = {"seeds": (0, 3), "steps": 12, "checkpoint": checkpoint}
    settings = ALL[method] | {"batch": 16}
    cls, windows = METHODS[method].load_class(), lay(random_walks())
    every = {"checkpoint_every_s": 0.0, "settings": settings, "given": GIVEN}
    with pytest.raises(Killed):
        cls.fit(windows, Plan(**plan, **every, on_step=stop))
    steps = []
    resumed, curve = cls.fit(windows, Plan(**plan, **every, on_step=lambda done, *_: steps.append(done)))
    whole, whole_curve = cls.fit(windows, Plan((0, 3), 12, settings=settings, given=GIVEN))
    assert steps == list(range(6, 13))
    np.testing.assert_array_equal(curve.losses, whole_curve.losses)
    for name, array in whole.arrays().items():
        np.testing.assert_array_equal(resumed.arrays()[name], array)


def test_what_trains_nothing_is_the_same_bytes_when_it_is_made_again():
    """Where there are no steps there is no checkpoint: a killed run begins anew, and ends in the same."""
    first, again = train("lwr").policy.arrays(), train("lwr").policy.arrays()
    assert first.keys() == again.keys()
    for name, array in first.items():
        np.testing.assert_array_equal(again[name], array)


@pytest.mark.parametrize("method", NETWORKS)
def test_a_network_does_not_depend_on_those_trained_beside_it(method):
    both, alone = (train(method, seeds=seeds).policy for seeds in ((0, 3), (3,)))
    for name, array in alone.arrays().items():
        np.testing.assert_array_equal(array, both.arrays()[name])
    seen = lay(random_walks()).observations()
    np.testing.assert_allclose(both.one_seed(1).predict(seen), alone.predict(seen))
    assert both.one_seed(1).seeds == (3,)


@pytest.mark.parametrize("method", ALL)
def test_held_out_episodes_and_the_torch_generator_are_left_alone(method, tmp_path):
    import torch

    before = torch.get_rng_state()
    for number, seed in enumerate((1, 2)):
        demos = random_walks()
        noise = np.random.default_rng(seed).normal(size=demos.columns[ACTION][demos.episode(4)].shape)
        demos.columns[ACTION][demos.episode(4)] += noise
        demos.columns[STATE][demos.episode(4)] -= noise
        windows = make_windows(
            demos, semantics(demos), STATE_ONLY, (0, 1, 2, 3), statistics_episodes=(0, 1, 2, 3), protocol="strict",
            history=2, chunk=4,
        )  # fmt: skip
        save_trained(train(method, windows), tmp_path / str(number))
    assert weights_hash(tmp_path / "0") == weights_hash(tmp_path / "1")
    assert torch.equal(before, torch.get_rng_state())


@pytest.mark.parametrize("method", [m for m in ALL if m != "lwr"])
def test_cpu_seconds_come_to_steps_that_give_the_same_bytes(method, tmp_path):
    recorded = tmp_path / "steps.json"
    budget = {"steps": None, "cpu_seconds": 0.3, "recorded": recorded, "seeds": (0,)}
    first, again = train(method, **budget), train(method, **budget)
    assert first.steps > 3
    by_steps = train(method, seeds=(0,), steps=first.steps)
    for name, array in first.policy.arrays().items():
        np.testing.assert_array_equal(array, again.policy.arrays()[name])
        np.testing.assert_array_equal(array, by_steps.policy.arrays()[name])


@pytest.mark.parametrize("method", ALL)
def test_pusht_s_view_goes_through_every_method(method):
    demos, meaning = pusht()
    windows = lay(demos, meaning, WITH_POSE)
    given = {"actions": "relative", "features": "pusht_block_frame", "symmetry": "pusht_mirror", "noise": {"px": 1.0}}
    policy = train(method, windows, 3, given=given).policy
    answer = policy.predict(windows.observations(slice(0, 5)))
    assert answer.shape == (2, 5, 4, 2)
    assert answer.dtype == np.float32
    assert np.isfinite(answer).all()


@pytest.mark.parametrize("method", [m for m in NETWORKS if m != "mlp"])
def test_samples_are_the_same_when_asked_again_and_differ_among_each_other(method):
    policy, seen = train(method).policy, lay(random_walks(seed=5)).observations()
    samples = policy.sample(seen, 3)
    assert samples.shape == (2, 3, len(seen), 4, 2)
    np.testing.assert_array_equal(policy.sample(seen, 3), samples)
    few = policy.sample(asked(seen, slice(4, 6)), 3)
    np.testing.assert_allclose(few, samples[:, :, 4:6], rtol=1e-3, atol=1e-3)
    assert np.abs(samples[:, 0] - samples[:, 1]).mean() > 1e-3
    assert np.abs(samples[:, :, 0] - samples[:, :, 1]).mean() > 1e-3


def two_ways(episodes=60, frames=6):
    """The same state everywhere; half of the episodes go to +1, half to −1, a little off."""
    generator = np.random.default_rng(0)
    way = np.repeat(np.where(np.arange(episodes) % 2, 1.0, -1.0), frames)[:, None]
    action = way + 0.05 * generator.normal(size=way.shape)
    return demonstrations({STATE: 0.1 * generator.normal(size=way.shape), ACTION: action}, (frames,) * episodes)


@pytest.mark.parametrize("method", ["gmm", "flow", "diffusion"])
def test_samples_go_both_ways_and_nowhere_between(method):
    settings = LEARNING[method] | {"batch": 64, "width": 64}
    policy = train(method, lay(two_ways(), chunk=2), 600, (0,), {}, settings=settings).policy
    demos = two_ways(4)
    first = policy.sample(lay(demos, chunk=2).observations(slice(0, 4)), 100)[0, :, :, 0, 0]
    assert 0.3 < (first > 0).mean() < 0.7
    assert (np.abs(np.abs(first) - 1) < 0.35).mean() > 0.8
    acts = policy.predict(lay(demos, chunk=2).observations())[0, :, 0, 0]
    assert (np.abs(np.abs(acts) - 1) < 0.35).mean() > 0.8


def test_a_flow_without_start_noise_draws_nothing():
    policy = train("flow", settings={"start_noise": 0.0}).policy
    seen = lay(random_walks()).observations(slice(0, 1))
    same = Observations(
        np.repeat(seen.values, 2, 0), np.repeat(seen.state, 2, 0), np.repeat(seen.previous_action, 2, 0)
    )
    assert not policy.nets[0].draws
    first, second = policy.predict(same)[0]
    np.testing.assert_allclose(first, second, rtol=1e-5)
    assert np.abs(policy.sample(seen, 2)[:, 0] - policy.sample(seen, 2)[:, 1]).max() > 1e-3


def test_another_history_than_it_was_trained_on_is_refused():
    with pytest.raises(PolicyError, match="sees 2 frames at a time and was given 3"):
        train("flow").policy.predict(lay(random_walks(), own_history=3).observations())


def test_settings_answer_with_did_you_mean():
    with pytest.raises(ConfigError, match="method 'flow' has no setting 'euler_step'. Did you mean 'euler_steps'"):
        train("flow", settings={"euler_step": 3})
    with pytest.raises(ConfigError, match=r"settings\.width: .* \(got 0\)"):
        train("gmm", settings={"width": 0})
    with pytest.raises(ConfigError, match="only 20 noise_steps"):
        train("diffusion", settings={"sampling_steps": 30})
    with pytest.raises(ConfigError, match="multiple of heads"):
        train("act", settings={"heads": 3})


def test_bf16_trains_to_about_the_same_loss():
    windows = lay(random_walks((30, 30)))
    plain, half = (train("mlp", windows, 150, (0,), {}, settings={"bf16": b, "dropout": 0.0}) for b in (False, True))
    assert half.losses[0, -1] == pytest.approx(plain.losses[0, -1], rel=0.15)
    assert half.losses[0, -1] != plain.losses[0, -1]


def test_the_average_and_the_rates_are_what_they_say():
    """Followed by hand, step by step."""
    settings = {"blocks": 1, "width": 8, "warmup": 4, "cosine": True, "ema": True, "batch": 16, "learning_rate": 1e-2}
    windows = lay(random_walks())
    transform = fit_transform(windows)
    sampler = Sampler(windows, transform, None, lambda seen: transform.encode(seen.values))
    shape = Shape(sampler.inputs, 2, 4, transform.width, sampler.limit())
    training = NetworkTraining(MlpNetwork, settings_of("mlp", settings), shape, sampler, Plan((0,), 20))
    name = next(iter(training.tensors))
    average, rates = training.tensors[name].detach().clone(), []
    for step in range(20):
        training.step()
        rates.append(training.optimizer.param_groups[0]["lr"])
        keep = min(0.999, (1 + step) / (10 + step))
        average = keep * average + (1 - keep) * training.tensors[name].detach()
    np.testing.assert_allclose(training.kept[name], average, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(rates[:5], [0.0025, 0.005, 0.0075, 0.01, 0.01])
    np.testing.assert_allclose(rates[12], 0.005, rtol=1e-6)
    assert rates[19] < 2e-4
    decays = [group["weight_decay"] for group in training.optimizer.param_groups]
    assert [{p.ndim for p in group["params"]} for group in training.optimizer.param_groups] == [{2}, {1}]
    assert decays == [1e-4, 0.0]

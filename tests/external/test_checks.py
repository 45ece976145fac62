"""Planted faults are named, and honest policies are never refused, however poor."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.external.anchors import anchors_of
from pipeline.external.checks import check_alignment, mean_of
from pipeline.lerobot_format.quality import resolve_semantics
from pipeline.lerobot_format.read import read_dataset
from pipeline.predict import predict_policy
from pipeline.types import ACTION, STATE
from tests.hand_made import demonstrations, semantics

HISTORY = 3


class Bench:
    """Demonstrations, and what a policy may predict on them."""

    def __init__(self, demos, meaning):
        self.demos, self.semantics = demos, meaning
        self.anchors = anchors_of(demos, HISTORY)
        self.recorded = demos.columns[ACTION][self.anchors].astype(np.float64)
        self.mean, self.deviation = self.recorded.mean(axis=0), self.recorded.std(axis=0)
        self.episode = demos.episode_of_frame[self.anchors]
        self.frame = demos.frame_in_episode[self.anchors]

    @property
    def noise(self):
        """Standard normal numbers, the same whichever test asks first."""
        return np.random.default_rng(0).normal(size=self.recorded.shape)

    def noisy(self, actions, share=0.2):
        return actions + share * self.deviation * self.noise

    def shifted(self, frames):
        first, last = self.demos.episode_starts[self.episode], self.demos.episode_starts[self.episode + 1] - 1
        return self.demos.columns[ACTION][np.clip(self.anchors + frames, first, last)].astype(np.float64)

    def of_episodes(self, order):
        other = np.asarray(order)[self.episode]
        starts, lengths = self.demos.episode_starts[other], self.demos.lengths[other]
        return self.demos.columns[ACTION][starts + np.minimum(self.frame, lengths - 1)].astype(np.float64)

    def check(self, predicted):
        return check_alignment(self.anchors, np.asarray(predicted, np.float32)[:, None], self.demos, self.semantics)


def sweeps(offset=(40.0, -90.0, 10.0), episodes=12):
    """Three joints that sweep through their ranges, each episode in its own way; the state follows three frames behind."""
    random = np.random.default_rng(3)
    states, actions = [], []
    for _ in range(episodes):
        time = np.arange(80)[:, None] / 10
        command = offset + random.uniform(20, 40, 3) * np.sin(
            random.uniform(0.6, 1.4, 3) * time + random.uniform(0, 6, 3)
        )
        actions.append(command)
        states.append(np.concatenate([command[:1]] * 3 + [command[:-3]]))
    demos = demonstrations({STATE: np.concatenate(states), ACTION: np.concatenate(actions)}, [80] * episodes)
    return Bench(demos, semantics(demos))


@pytest.fixture(scope="module")
def bench():
    return sweeps()


HONEST = {
    "mean action": lambda b: np.tile(b.mean, (len(b.anchors), 1)),
    "mean of others": lambda b: b.mean + 0.01 * b.deviation * (b.episode[:, None] % 3),
    "hold still": lambda b: b.demos.columns[STATE][b.anchors],
    "noise like the data": lambda b: b.mean + b.deviation * b.noise,
    "noise of a fresh network": lambda b: 0.1 * b.noise,
    "zeros": lambda b: np.zeros_like(b.recorded),
    "repeats the last action": lambda b: b.shifted(-1),
    "hardly leaves the mean": lambda b: b.mean + 0.0175 * (b.recorded - b.mean),
    "replays one recording": lambda b: b.of_episodes(np.full(b.demos.episodes, 4)),
    "knows how far it is": lambda b: np.stack([np.poly1d(np.polyfit(b.frame, y, 3))(b.frame) for y in b.recorded.T], 1),
    "overshoots": lambda b: b.mean + 3 * (b.recorded - b.mean),
    "biased": lambda b: b.recorded + 0.8 * b.deviation,
    "good": lambda b: b.noisy(b.recorded, 0.05),
    "two joints the wrong way round": lambda b: b.recorded * [-1, -1, 1],
}


@pytest.mark.parametrize("policy", HONEST)
def test_an_honest_policy_is_never_refused(bench, policy):
    assert bench.check(HONEST[policy](bench)).refuse == ()


FAULTS = {
    "two columns swapped": (lambda b: b.noisy(b.recorded[:, [1, 0, 2]]), ["permuted", "a0 holds a1", "a1 holds a0"]),
    "all columns moved": (lambda b: b.noisy(b.recorded[:, [2, 0, 1]]), ["permuted", "Expected the order a0, a1, a2"]),
    "radians": (
        lambda b: np.deg2rad(b.noisy(b.recorded)),
        ["a0, a1, a2 are in another unit", "does not state its own", "as radians are to degrees"],
    ),
    "degrees": (lambda b: np.rad2deg(b.noisy(b.recorded)), ["divided by 57.3, as degrees are to radians"]),
    "metres": (lambda b: b.noisy(b.recorded) / 1000, ["as metres are to millimetres"]),
    "some in radians": (lambda b: b.noisy(b.recorded) * [0.01745, 0.01745, 1], ["a0, a1 are in another unit"]),
    "standardised": (lambda b: (b.noisy(b.recorded) - b.mean) / b.deviation, ["normalised (mean 0 and deviation 1)"]),
    "between -1 and 1": (
        lambda b: 2 * (b.noisy(b.recorded) - b.recorded.min(0)) / np.ptp(b.recorded, axis=0) - 1,
        ["normalised (−1 … 1 between minimum and maximum)", "postprocessor"],
    ),
    "between 0 and 1": (
        lambda b: (b.noisy(b.recorded) - b.recorded.min(0)) / np.ptp(b.recorded, axis=0), ["normalised (0 … 1"],
    ),
    "early": (lambda b: b.noisy(b.shifted(4), 0.1), ["shifted in time", "4 frames later", "add 4 to frame_index"]),
    "the next episode's": (
        lambda b: b.noisy(b.of_episodes((np.arange(12) + 1) % 12)), ["mixed up: 11 of 12", "10 fits 11"],
    ),
    "episodes shuffled": (
        lambda b: b.noisy(b.of_episodes(np.random.default_rng(5).permutation(12))), ["mixed up", "recorded number"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_a_planted_fault_is_named(bench, fault):
    make, expected = FAULTS[fault]
    (text,) = bench.check(make(bench)).refuse
    for words in expected:
        assert words in text


def test_the_unit_of_the_data_set_is_named_only_where_it_is_stated():
    bench = sweeps()
    feature = replace(bench.demos.features[ACTION], units=("deg", None, "mm"))
    stated = Bench(replace(bench.demos, features={**bench.demos.features, ACTION: feature}), bench.semantics)
    (text,) = stated.check(np.deg2rad(stated.noisy(stated.recorded))).refuse
    assert "in another unit than the data set (which has deg and one that it does not state and mm)" in text
    (text,) = bench.check(np.deg2rad(bench.noisy(bench.recorded))).refuse
    assert "which does not state its own" in text


WARNED = {
    "late": (lambda b: b.noisy(b.shifted(-4), 0.1), ["4 frames earlier", "frame_index is off, or the policy repeats"]),
    "an offset": (
        lambda b: b.noisy(b.recorded) + np.array([0, 90, 0]),
        ["off by a constant: a1 by +90.14", "Is zero elsewhere"],
    ),
    "the recording itself": (lambda b: b.recorded, ["exactly the one recorded"]),
    "columns that go with others and fit nowhere": (
        lambda b: b.mean + 3 * (b.recorded - b.mean)[:, [1, 0, 2]] + 2 * b.deviation,
        ["are action columns permuted? a0 holds a1", "they fit no place"],
    ),
    "noise around zero": (lambda b: b.noise, ["mean 0 and deviation 1"]),
}


@pytest.mark.parametrize("oddity", WARNED)
def test_what_an_honest_policy_may_do_too_is_only_warned_of(bench, oddity):
    make, expected = WARNED[oddity]
    found = bench.check(make(bench))
    assert found.refuse == ()
    for words in expected:
        assert words in " ".join(found.warn)


def test_dead_columns_and_angles_that_wrap_are_no_evidence(bench):
    demos = bench.demos
    columns = {**demos.columns, ACTION: demos.columns[ACTION].copy()}
    columns[ACTION][:, 0] = 7.0
    dead = replace(demos, columns=columns)
    wraps = semantics(dead, circular={ACTION: (False, True, False)})
    one = Bench(dead, wraps)
    predicted = one.noisy(one.recorded) * [1, np.pi / 180, 1]
    assert one.check(predicted).refuse == ()
    nothing = semantics(dead, circular={ACTION: (False, True, True)})
    assert Bench(dead, nothing).check(predicted).refuse == ()


def test_the_mean_of_angles_is_a_direction():
    angles = np.array([[[3.1, 1.0]], [[-3.1, 3.0]]], np.float32)
    np.testing.assert_allclose(np.abs(mean_of(angles, np.array([True, False]), (0,))), [[np.pi, 2.0]], rtol=1e-5)


@pytest.mark.parametrize("name", ["so101_pick_place_tape", "cr5_banana", "pusht"])
def test_our_baselines_on_real_demonstrations_are_never_refused(shared_data, name):
    from pipeline.methods import METHODS
    from pipeline.policies import Plan
    from pipeline.types import ObservationSet
    from pipeline.windows import make_windows

    demos = read_dataset(shared_data / name, name=name)
    bench = Bench(demos, resolve_semantics(demos, kind="auto", circular=None))
    train, test = range(0, demos.episodes // 2), range(demos.episodes // 2, demos.episodes)
    seen = ObservationSet("state", (STATE,))
    settings = {"statistics_episodes": train, "protocol": "strict", "history": HISTORY, "chunk": 1}
    held_out = make_windows(demos, bench.semantics, seen, test, **settings)
    for method in ("hold_still", "mean_action", "constant_velocity", "nearest_neighbour"):
        policy, _ = (
            METHODS[method]
            .load_class()
            .fit(make_windows(demos, bench.semantics, seen, train, **settings), Plan((0,), 0))
        )
        predicted = predict_policy(policy, held_out, name=method, observations="state", fold=0)
        found = check_alignment(predicted.anchors, predicted.actions[0], demos, bench.semantics)
        assert found.refuse == (), method

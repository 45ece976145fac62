"""The floors that generators claim, against brute force: many draws in one and the same place."""

import numpy as np
import pytest
from scipy.optimize import minimize

from pipeline.statistics.known_truth.generators import GENERATORS, LOSSES, States
from pipeline.types import ACTION, STATE

DRAWS = 40_000
SETS = [(name, each.name) for name, generator in GENERATORS.items() for each in generator.sets]


def in_one_place(generator, state, hidden) -> States:
    """One and the same state in DRAWS episodes of one frame each, which differ by all that episodes differ by."""
    return States(np.repeat(state[None], DRAWS, axis=0), np.ones(DRAWS, int), hidden)


def brute_force(noise: np.ndarray, random: np.random.Generator) -> dict[str, float]:
    """What the best single answer to these [n, A] actions costs, found by trying; and how far apart they are."""
    spread = noise.std() + 1e-9
    best = minimize(
        lambda c: np.linalg.norm(noise - c * spread, axis=1).mean(), np.zeros(noise.shape[1]), method="Powell"
    )
    medians = [
        minimize(lambda c, column=column: np.abs(column - c[0] * spread).mean(), [0.1], method="Powell").fun
        for column in noise.T
    ]
    apart = noise - random.permutation(noise)
    return {
        "mse": ((noise - noise.mean(axis=0)) ** 2).mean(),
        "mae": np.mean(medians),
        "l2": best.fun,
        "pair_mae": np.abs(apart).mean(),
        "pair_l2": np.linalg.norm(apart, axis=1).mean(),
    }


@pytest.mark.parametrize(("name", "observations"), SETS)
def test_floors_are_those_of_many_draws_in_one_place(name, observations):
    generator, random = GENERATORS[name], np.random.default_rng(0)
    visited = generator.states(random, 50)
    others = generator.states(random, DRAWS // 8)
    for frame in random.choice(len(visited.values), 2):
        hidden = random.choice(others.hidden, DRAWS)
        if observations in ("object", "motion"):  # which tell the hidden number
            hidden = np.full(DRAWS, hidden[0])
        place = in_one_place(generator, visited.values[frame], hidden)
        noise = generator.noise.draw(random, place)
        if name == "two_arms":
            noise = noise[:, :4]  # the same noise in fewer columns: l2 is not compared
        found = brute_force(noise, random)
        one = States(place.values[:1], np.array([1]), hidden[:1])
        claimed = generator.noise.floors(one)[observations]
        for loss in LOSSES:
            if name != "two_arms" or "l2" not in loss:
                expected = float(np.broadcast_to(claimed[loss], 1)[0])
                assert found[loss] == pytest.approx(expected, rel=0.03, abs=1e-6), loss


@pytest.mark.parametrize("name", GENERATORS)
def test_a_data_set_has_the_variance_that_its_truth_says(name):
    """Over whole data sets: the mean action is exactly known, what is left is the floor on the states really visited."""
    generator = GENERATORS[name]
    left, claimed = [], None
    for seed in range(4):
        truth = generator.build(200, seed)
        states = States(truth.demos.columns[STATE].astype(float), truth.demos.lengths, np.empty(0))
        noise = truth.demos.columns[ACTION] - generator.mean(states)
        episode = truth.demos.episode_of_frame
        by_episode = np.bincount(episode, (noise**2).mean(axis=1)) / truth.demos.lengths
        left.append(by_episode.mean())
        claimed = truth.floors["state", 0, "mse"]
    bias = np.mean(noise) ** 2  # `rounded` is off by a little on average in some states
    assert np.mean(left) == pytest.approx(claimed, rel=0.06, abs=1e-9 + bias)


@pytest.mark.parametrize("name", GENERATORS)
def test_data_sets_are_robots_paths(name):
    generator = GENERATORS[name]
    truth, again, other = generator.build(12, 3), generator.build(12, 3), generator.build(12, 4)
    demos = truth.demos
    assert demos.content_hash == again.demos.content_hash != other.demos.content_hash
    assert demos.episodes == 12
    assert demos.lengths.min() >= 40
    assert demos.lengths.max() <= 80
    state = demos.columns[STATE].astype(float)
    if generator.circular:
        state = np.column_stack([state, np.sin(state[:, 2]), np.cos(state[:, 2])])[:, [0, 1, 3, 4]]
    inside = np.diff(demos.episode_of_frame) == 0
    step = np.linalg.norm(np.diff(state, axis=0), axis=1)[inside]
    assert np.median(step) < 0.35 * np.sqrt(state.var(axis=0).sum()), "frames next to each other are far apart"
    assert {key[0] for key in truth.floors} == {each.name for each in truth.sets} == set(generator.dimensions)
    assert all((value > 0) == generator.positive_floor for value in truth.floors.values())


def test_there_are_the_kinds_that_are_asked_for():
    assert len(GENERATORS) >= 12
    dimensions = {count for generator in GENERATORS.values() for count in generator.dimensions.values()}
    assert min(dimensions) == 2
    assert max(dimensions) == 18
    assert any(not generator.smooth for generator in GENERATORS.values())
    assert any(not generator.positive_floor for generator in GENERATORS.values())
    assert any(generator.circular for generator in GENERATORS.values())

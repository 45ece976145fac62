"""Evidence of modes: found where people do two things, and not where noise or a jump only looks like it."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.statistics import modes
from pipeline.statistics.modes import Dips, Mixtures, evidence_of_modes, find_dips
from pipeline.types import ACTION, STATE, ObservationSet
from tests.hand_made import STATE_ONLY, demonstrations, semantics

FEW, LONG = 30, 40


def wandering(random: np.random.Generator, episodes: int = FEW, frames: int = LONG) -> np.ndarray:
    """[E, T, 2] states that move slowly about 0 with deviation 1."""
    state = random.normal(size=(episodes, frames, 2))
    for t in range(1, frames):
        state[:, t] = 0.95 * state[:, t - 1] + 0.312 * state[:, t]
    return state


def recorded(state: np.ndarray, noise: np.ndarray):
    """Actions that follow the state smoothly, plus `noise` [E, T, 2]."""
    episodes, frames, _ = state.shape
    action = np.tanh(state @ np.array([[1.0, 0.4], [-0.3, 0.8]])) + noise
    demos = demonstrations({STATE: state.reshape(-1, 2), ACTION: action.reshape(-1, 2)}, (frames,) * episodes)
    return demos, semantics(demos)


def two_ways(random, state):
    """Each episode goes left or right of everything, four deviations of the noise apart."""
    side = np.sign(random.normal(size=(len(state), 1, 1))) * np.array([1.0, 0.0])
    return 0.4 * random.normal(size=state.shape) + 0.8 * side


def every_frame(random, state):
    side = np.sign(random.normal(size=(*state.shape[:2], 1))) * np.array([1.0, 0.0])
    return 0.4 * random.normal(size=state.shape) + 0.8 * side


def tied_in_time(random, state):
    noise = random.normal(size=state.shape)
    for t in range(1, state.shape[1]):
        noise[:, t] = 0.95 * noise[:, t - 1] + 0.312 * noise[:, t]
    return 0.4 * noise


UNIMODAL = {
    "gaussian": lambda random, state: 0.4 * random.normal(size=state.shape),
    "heteroscedastic": lambda random, state: random.normal(size=state.shape) * (0.1 + 0.6 / (1 + np.exp(-3 * state[..., :1]))),
    "skewed": lambda random, state: 0.4 * random.exponential(size=state.shape),
    "heavy tails": lambda random, state: 0.25 * random.standard_t(3, size=state.shape),
    "correlated": lambda random, state: random.normal(size=state.shape) @ np.array([[0.4, 0.36], [0.0, 0.17]]),
    "flat": lambda random, state: random.uniform(-0.7, 0.7, size=state.shape),
    "tied in time": tied_in_time,
    "offset by episode": lambda random, state: 0.15 * random.normal(size=state.shape)
    + 0.4 * random.normal(size=(len(state), 1, 2)),
    "a jump": lambda random, state: 0.1 * random.normal(size=state.shape) + 1.2 * np.sign(state[..., :1]),
    "no noise": lambda random, state: 0.0 * state,
}  # fmt: skip


@pytest.fixture
def few_steps(monkeypatch):
    """For what does not depend on how well the networks learn."""
    monkeypatch.setattr(modes, "STEPS", 50)


def ask(noise, *, seed: int = 0, horizons=(0,), episodes: int = FEW, frames: int = LONG):
    random = np.random.default_rng(seed)
    state = wandering(random, episodes, frames)
    demos, meaning = recorded(state, noise(random, state))
    return evidence_of_modes(demos, meaning, STATE_ONLY, history=1, horizons=horizons, seed=seed)


# verdicts -------------------------------------------------------------------------------------------------------------


def test_two_ways_are_found_at_every_horizon():
    now, later = ask(every_frame, horizons=(0, 1), frames=60)
    for found in (now, later):
        assert found.found, found
        assert found.interval[0] > 0
        assert found.share_interval[0] > modes.LEAST_SHARE
        assert found.dip_interval[0] > 0
        assert 0.8 < found.disagreement < 1.2
        assert "people did clearly different things" in found.words
    assert (now.horizon, later.horizon) == (0, 1)
    assert json.loads(json.dumps(asdict(now)))["found"] is True


def test_heavy_tails_gain_and_are_no_modes():
    (found,) = ask(UNIMODAL["heavy tails"])
    assert found.interval[0] > 0
    assert found.found is False
    assert "no evidence of several modes: a mixture is more likely" in found.words


@pytest.mark.slow
def test_a_jump_is_no_mode_although_the_mixture_has_two_peaks():
    (found,) = ask(UNIMODAL["a jump"], frames=60)
    assert found.found is False
    assert found.disagreement_interval[1] < 1
    assert found.disagreement < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("kind", UNIMODAL)
def test_one_way_with_any_noise_is_not_called_modes(kind):
    found = [ask(UNIMODAL[kind], seed=seed, episodes=50, frames=60)[0] for seed in range(3)]
    assert not any(evidence.found for evidence in found), found


@pytest.mark.slow
def test_strategies_of_whole_episodes_are_found():
    found = [ask(two_ways, seed=seed, episodes=60, frames=60)[0].found for seed in range(5)]
    assert sum(found) >= 4


@pytest.mark.slow
def test_people_pushing_a_block(shared_data):
    """Real data are answered, at every horizon, within the memory and the time of a laptop."""
    from pipeline.lerobot_format.quality import resolve_semantics
    from pipeline.lerobot_format.read import load_source

    demos = load_source(str(shared_data / "pusht_image"), name="pusht", config_dir=shared_data)
    pose = ObservationSet("pose", (STATE, "observation.environment_state"))
    found = evidence_of_modes(demos, resolve_semantics(demos), pose, history=1, horizons=(0, 7, 15))
    assert [evidence.refused for evidence in found] == [None] * 3
    assert all(evidence.interval[0] > 0 for evidence in found)


# repeatable, honest ---------------------------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_numbers_and_progress_is_told(few_steps):
    random = np.random.default_rng(3)
    state = wandering(random, 12, 15)
    demos, meaning = recorded(state, two_ways(random, state))
    steps = []
    one, two = (
        evidence_of_modes(
            demos, meaning, STATE_ONLY, history=2, horizons=(1,), seed=7, on_step=lambda *told: steps.append(told)
        )
        for _ in range(2)
    )
    assert one == two
    half = len(steps) // 2
    assert steps[:half] == steps[half:]
    assert steps[half - 1][:2] == (2 * modes.STEPS, 2 * modes.STEPS)


@given(st.integers(10, 60), st.integers(2, 5), st.integers(0, 99))
@settings(max_examples=40, deadline=None)
def test_no_episode_trains_or_stops_the_network_that_scores_it(episodes, folds, seed):
    random = np.random.default_rng(seed)
    fold = random.permutation(np.arange(episodes) % folds)
    episode = np.repeat(np.arange(episodes), random.integers(1, 5, size=episodes))
    scored_once = []
    for f in range(folds):
        train, stops, scored = modes._parts(fold, f, episode, random)
        train_episodes, stop_episodes, held_out = (set(episode[part]) for part in (train, stops, scored))
        assert not train_episodes & stop_episodes
        assert not (train_episodes | stop_episodes) & held_out
        assert train_episodes
        assert len(stop_episodes) >= 2
        scored_once.extend(scored)
    assert sorted(scored_once) == list(range(len(episode)))


# refusals -------------------------------------------------------------------------------------------------------------


def refused(demos, meaning, *, horizons=(0,)):
    found = evidence_of_modes(demos, meaning, STATE_ONLY, history=1, horizons=horizons)
    for evidence in found:
        assert (evidence.found, evidence.gain, evidence.interval, evidence.share) == (None,) * 4
        assert evidence.refused in evidence.words
    return found


def test_too_few_episodes_are_refused():
    state = wandering(np.random.default_rng(0), 9, 20)
    (found,) = refused(*recorded(state, 0 * state))
    assert found.refused == "9 episodes are too few: evidence of modes needs 10"


def test_actions_that_do_not_move_are_refused():
    state = wandering(np.random.default_rng(0), 12, 20)
    demos, meaning = recorded(state, 0 * state)
    still = replace(demos, columns={**demos.columns, ACTION: np.ones_like(demos.columns[ACTION])})
    assert "no action column moves" in refused(still, meaning, horizons=(0, 3))[1].refused


def test_angles_are_left_out_by_name_and_refused_alone(few_steps):
    state = wandering(np.random.default_rng(0), 12, 20)
    demos, _ = recorded(state, 0.1 * state)
    both = semantics(demos, circular={ACTION: (True, True)})
    assert "angles that wrap" in refused(demos, both)[0].refused
    one = semantics(demos, circular={ACTION: (False, True)})
    (found,) = evidence_of_modes(demos, one, STATE_ONLY, history=1, horizons=(0,))
    assert found.refused is None
    assert "(Without a1: angles that wrap, or columns that do not move.)" in found.words


def test_a_horizon_longer_than_most_episodes_is_refused(few_steps):
    state = wandering(np.random.default_rng(0), 12, 15)
    demos, meaning = recorded(state, 0.1 * state)
    near, far = evidence_of_modes(demos, meaning, STATE_ONLY, history=1, horizons=(0, 15))
    assert near.refused is None
    assert far.refused == "fewer than 10 episodes are longer than 15 frames"


# dips -----------------------------------------------------------------------------------------------------------------


def mixture(weight, mean, deviation) -> Mixtures:
    """One mixture in one dimension from lists, as [1, C] and [1, C, 1]."""
    weight, mean, deviation = (np.array([values], float) for values in (weight, mean, deviation))
    return Mixtures(weight / weight.sum(), mean[..., None], deviation[..., None])


@pytest.mark.parametrize(
    ("parts", "there"),
    [
        (([1, 1], [0, 3.2], [1, 1]), False),
        (([1, 1], [0, 3.4], [1, 1]), True),
        (([1, 0.05], [0, 6], [1, 1]), False),
        (([0.8, 0.2], [0, 6], [1, 1]), True),
        (([1, 1, 1], [0, 2, 4], [1, 1, 1]), False),
        (([1, 1, 1], [0, 0.5, 5], [1, 1, 1]), True),
        (([1, 1], [0, 0], [0.2, 3]), False),
        (([1, 1], [0, 0], [1, 1]), False),
        (([1], [0], [1]), False),
    ],
)
def test_known_dips(parts, there):
    assert find_dips(mixture(*parts)).there.tolist() == [there]


def density(parts: Mixtures, where: np.ndarray) -> np.ndarray:
    z = (where[:, None] - parts.mean[0, :, 0]) / parts.deviation[0, :, 0]
    return (parts.weight[0] / parts.deviation[0, :, 0] * np.exp(-0.5 * z**2)).sum(axis=1) / np.sqrt(2 * np.pi)


def slow_dip(parts: Mixtures) -> float:
    """The deepest dip of a density in one dimension: the lowest of f over the lower of the two highest peaks beside it,
    among places with enough mass on both sides."""
    where = np.linspace(parts.mean.min() - 1, parts.mean.max() + 1, 4001)
    f, step = density(parts, where), where[1] - where[0]
    mass = np.cumsum(density(parts, np.arange(where[0] - 20, where[0], step))).max() * step + np.cumsum(f) * step
    enough = np.minimum(mass, 1 - mass) >= modes.SMALLEST_SIDE
    left, right = np.maximum.accumulate(f), np.maximum.accumulate(f[::-1])[::-1]
    return float(np.where(enough, f / np.minimum(left, right), np.inf).min())


@given(
    st.lists(st.floats(0.05, 1), min_size=3, max_size=3),
    st.lists(st.floats(-4, 4), min_size=3, max_size=3),
    st.lists(st.floats(0.3, 1.5), min_size=3, max_size=3),
)
@settings(max_examples=150, deadline=None)
def test_dips_are_those_of_a_slow_search(weight, mean, deviation):
    parts = mixture(weight, mean, deviation)
    slow = slow_dip(parts)
    if find_dips(parts).there[0]:
        assert slow <= modes.DIP * 1.02
    else:
        assert slow >= modes.DIP * 0.9 or not _found_between_all(parts)


def _found_between_all(parts: Mixtures) -> bool:
    """The fast search asks for mass on both sides of the deepest place only; the slow one of every place."""
    ratios = [modes._dip_between(parts, j, k)[0][0] for j, k in ((0, 1), (0, 2), (1, 2))]
    return all(np.isfinite(ratios))


@given(st.integers(0, 1000))
@settings(max_examples=30, deadline=None)
def test_turning_and_scaling_the_axes_leaves_dips_alone(seed):
    random = np.random.default_rng(seed)
    weight, mean = random.dirichlet(np.ones(3), 5), 2 * random.normal(size=(5, 3, 2))
    deviation, scale = random.uniform(0.3, 1, (5, 3, 2)), np.array([3.0, -0.2])
    plain, scaled = find_dips(Mixtures(weight, mean, deviation)), find_dips(
        Mixtures(weight, mean * scale, deviation * np.abs(scale))
    )  # fmt: skip
    assert plain.there.tolist() == scaled.there.tolist()
    assert plain.places[plain.there] == pytest.approx(scaled.places[plain.there])


def test_actions_at_the_lower_peak_count_against_those_in_the_dip():
    dips = Dips(np.ones(5, bool), np.ones((5, 1)), np.tile([4.0, 2.0, 0.0], (5, 1)))
    assert modes._emptier(dips, np.array([[4.0], [4.9], [2.1], [0.0], [9.0]])).tolist() == [1, 1, -1, 0, 0]


def test_rounded_actions_are_spread_over_their_step():
    random = np.random.default_rng(0)
    rounded = np.round(random.normal(size=(5000, 1)), 1)
    spread = modes._between_steps(rounded, random)
    assert np.abs(spread - rounded).max() <= 0.05 + 1e-9
    assert len(np.unique(spread)) == 5000
    smooth = random.normal(size=(5000, 1))
    assert np.abs(modes._between_steps(smooth, random) - smooth).max() < 0.01

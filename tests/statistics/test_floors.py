"""The floors: known truths, against slow versions, refusals. Their bias and coverage are the known-truth suite's to measure."""

import numpy as np
import pytest

from pipeline.statistics.floors import (
    FEWEST_EPISODES,
    load_estimates,
    measure_floors,
    save_estimates,
    scored_frames,
    seen_inputs,
    standard_error,
)
from pipeline.statistics.known_truth.generators import GENERATORS
from pipeline.statistics.pilot import fit_pilot
from pipeline.types import ACTION, STATE, Fold, ObservationSet, Split
from tests.hand_made import STATE_ONLY, demonstrations, semantics

ONE_FRAME = ObservationSet("state", (STATE,), history=1)


def all_held_out(episodes):
    everything = tuple(range(episodes))
    return Split((Fold(everything, everything),), 0, "0" * 64)


def noisy(episodes=40, frames=30, spread=2.0, seed=0, columns=2):
    """States on a line that every episode walks along, and actions that scatter about a smooth mean."""
    generator = np.random.default_rng(seed)
    along = np.tile(np.linspace(0, 1, frames), episodes) + 0.3 * np.repeat(generator.normal(size=episodes), frames)
    mean = np.stack([10 * np.sin(along + i) for i in range(columns)], axis=1)
    return demonstrations(
        {STATE: along[:, None], ACTION: mean + spread * generator.normal(size=mean.shape)}, [frames] * episodes
    )


def floors_of(demos, observation_set=ONE_FRAME, horizons=(0,), history=1, split=None, **more):
    split = split or all_held_out(demos.episodes)
    found = measure_floors(demos, semantics(demos, **more), observation_set, split, history=history, horizons=horizons)
    return {(f.horizon, f.loss): f for f in found}


def wiggles(state, frequency):
    """Two columns that no one disagrees about, and that change too fast to follow."""
    return np.concatenate([np.sin(frequency * state), np.cos(frequency * state)], axis=1)


def slow_gamma(demos, nearest=10):
    """Every state against every other, in loops; one column, all episodes of one length."""
    state = demos.columns[STATE][:, 0].astype(float)
    state = (state - state.mean()) / state.std()
    action = demos.columns[ACTION].astype(float)
    episode = demos.episode_of_frame
    inputs = seen_inputs(demos, semantics(demos), (STATE,), 1)
    pilot = fit_pilot(inputs, action, episode, demos.episodes)
    delta, gamma = np.zeros((demos.frames, nearest)), np.zeros((demos.frames, nearest))
    for frame in range(demos.frames):
        best = []
        for other in range(demos.episodes):
            if other != episode[frame]:
                frames = np.flatnonzero(episode == other)
                distance = (state[frames] - state[frame]) ** 2
                best.append((distance.min(), frames[distance.argmin()]))
        for rank, (distance, neighbour) in enumerate(sorted(best)[:nearest]):
            delta[frame, rank] = distance
            expected = pilot.differences(inputs, episode, np.array([frame]), np.array([[neighbour]]))[0, 0]
            gamma[frame, rank] = 0.5 * ((action[frame] - action[neighbour] - expected) ** 2).mean()
    _, intercept = np.polyfit(delta.mean(axis=0), gamma.mean(axis=0), 1)
    return intercept


def test_gamma_is_what_the_slow_obvious_version_gives():
    demos = noisy(episodes=30, frames=12)
    assert floors_of(demos)[0, "rmse"].value ** 2 == pytest.approx(slow_gamma(demos), rel=1e-4)


def test_noise_is_found_and_the_l1_and_l2_floors_lie_in_their_spans():
    found = floors_of(noisy(episodes=60, spread=2.0))
    assert found[0, "rmse"].value == pytest.approx(2.0, rel=0.05)
    low, high = found[0, "rmse"].interval
    assert low < 2.0 < high
    for loss, truth in (("mae", 2.0 * np.sqrt(2 / np.pi)), ("l2", 2.0 * np.sqrt(np.pi / 2))):
        floor = found[0, loss]
        assert floor.value < truth < floor.upper
        assert floor.upper == pytest.approx(2 * floor.value)
        assert floor.interval[0] < floor.value < floor.upper < floor.interval[1]


def test_a_floor_scales_with_the_unit_and_moves_with_no_offset():
    demos = noisy()
    scaled = demonstrations(
        {STATE: 7 * demos.columns[STATE] - 3, ACTION: 100 * demos.columns[ACTION] + 5}, demos.lengths
    )
    for key, floor in floors_of(demos).items():
        assert floors_of(scaled)[key].value == pytest.approx(100 * floor.value, rel=1e-3)


def test_angles_of_actions_are_wrapped():
    generator = np.random.default_rng(0)
    angle = (0.1 * generator.normal(size=(40 * 20, 1))) % (2 * np.pi)
    state = np.tile(np.linspace(0, 1, 20), 40)[:, None] + 0.01 * generator.normal(size=(800, 1))
    demos = demonstrations({STATE: state, ACTION: angle}, [20] * 40)
    assert floors_of(demos, circular={ACTION: (True,)})[0, "rmse"].value == pytest.approx(0.1, rel=0.1)
    assert floors_of(demos)[0, "rmse"].value > 1.0


def test_a_horizon_compares_the_actions_that_follow():
    demos = noisy(frames=20)
    later = demonstrations(
        {STATE: demos.columns[STATE], ACTION: np.roll(demos.columns[ACTION], 3, axis=0)}, demos.lengths
    )
    # The action three steps later of the rolled data is the first one of the others, for frames that have both.
    assert floors_of(later, horizons=(3,))[3, "rmse"].value == pytest.approx(2.0, rel=0.1)


def test_more_frames_show_a_hidden_velocity():
    truth = GENERATORS["two_ways_round"].build(60, seed=1)
    values = {}
    for observation_set in truth.sets:
        split = all_held_out(truth.demos.episodes)
        found = measure_floors(
            truth.demos, truth.semantics, observation_set, split, history=truth.history, horizons=[0]
        )
        values[observation_set.name] = found[0].value
    assert values["motion"] < 0.7 * values["state"]


def test_inputs_hold_the_position_and_its_changes():
    demos = noisy(episodes=3, frames=6)
    seen = seen_inputs(demos, semantics(demos), [STATE], 3)
    assert seen.shape == (18, 3)
    np.testing.assert_allclose(seen.std(axis=0), 1.0, rtol=1e-3)
    assert seen[0, 1] == seen[6, 1] == 0.0, "an episode's first frame is repeated before it"


def test_scored_frames_take_the_same_share_of_each_episode():
    demos = noisy(episodes=4, frames=50)
    chosen = scored_frames(demos, np.array([0, 2]), first=2, most=24)
    assert np.bincount(demos.episode_of_frame[chosen], minlength=4).tolist() == [12, 0, 12, 0]
    assert demos.frame_in_episode[chosen].min() == 2
    assert len(scored_frames(demos, np.array([0, 2]), first=2)) == 96


def test_only_held_out_states_are_scored():
    demos = noisy(episodes=40)
    split = Split((Fold(tuple(range(8, 40)), tuple(range(8))),), 0, "0" * 64)
    influence = floors_of(demos, split=split)[0, "rmse"].influence
    assert np.abs(influence[:8]).mean() > np.abs(influence[8:]).mean()
    assert np.count_nonzero(influence) > 8, "the others are neighbours"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: noisy(episodes=FEWEST_EPISODES - 1), "29 episodes are too few to find neighbours in"),
        (
            lambda d: demonstrations({STATE: d.columns[STATE], ACTION: np.ones((d.frames, 2))}, d.lengths),
            "the recorded actions never change",
        ),
        (
            lambda d: demonstrations({STATE: d.columns[STATE], ACTION: 9 * d.columns[STATE]}, d.lengths),
            "too little to tell it from zero",
        ),
        (
            lambda d: demonstrations({STATE: d.columns[STATE], ACTION: wiggles(d.columns[STATE], 6)}, d.lengths),
            "its squared error on held-out episodes is",
        ),
        (
            lambda d: demonstrations({STATE: d.columns[STATE], ACTION: wiggles(d.columns[STATE], 8)}, d.lengths),
            "two ways of extrapolating contradict each other",
        ),
        (
            lambda d: demonstrations({STATE: d.columns[STATE], ACTION: wiggles(d.columns[STATE], 20)}, d.lengths),
            "the nearest states differ too much",
        ),
    ],
)
def test_refusals_have_reasons(change, words):
    found = floors_of(change(noisy()))
    for floor in found.values():
        assert floor.value is None
        assert floor.interval is None
        assert floor.refused
    assert words in found[0, "rmse"].refused


def test_a_horizon_that_no_episode_reaches_is_refused():
    found = floors_of(noisy(frames=10), horizons=(0, 10))
    assert found[0, "rmse"].value is not None
    assert "no two episodes have an action 10 steps after" in found[10, "rmse"].refused


def test_fewer_than_five_held_out_episodes_are_refused():
    split = Split((Fold(tuple(range(4, 40)), tuple(range(4))),), 0, "0" * 64)
    assert "4 held-out episodes are too few" in floors_of(noisy(), split=split)[0, "mae"].refused


def test_a_deterministic_demonstrator_gets_an_upper_limit():
    truth = GENERATORS["exact"].build(50, seed=0)
    found = measure_floors(
        truth.demos, truth.semantics, truth.sets[0], all_held_out(50), history=truth.history, horizons=[0]
    )
    actions = truth.demos.columns[ACTION]
    for floor in found:
        assert floor.value is None
        assert 0 < floor.below < actions.std()


def floor_of(generator, episodes, seed):
    truth = GENERATORS[generator].build(episodes, seed)
    found = measure_floors(
        truth.demos, truth.semantics, truth.sets[0], all_held_out(episodes), history=truth.history, horizons=[0]
    )
    return found[0], truth.floors["state", 0, "mse"]


def test_a_jump_in_the_mean_is_refused_rather_than_counted_as_disagreement():
    for seed in range(6):
        floor, _ = floor_of("gripper", 60, seed)
        assert "may jump" in floor.refused


def test_a_small_jump_is_taken_off_and_widens_the_interval():
    for seed in range(3):
        floor, truth = floor_of("soft_gripper", 100, seed)
        assert floor.value**2 == pytest.approx(truth, rel=0.1)
        assert floor.wrong > 0.02 * truth
        assert floor.interval[0] ** 2 < truth < floor.interval[1] ** 2


def test_what_the_pilot_takes_away_leaves_little_to_extrapolate():
    """Six joints and little noise: without the pilot the squared floor is 4 to 11 % too high."""
    off = []
    for seed in range(4):
        floor, truth = floor_of("fine_hand", 50, seed)
        off.append(floor.value**2 / truth - 1)
    assert abs(np.mean(off)) < 0.025


def test_the_standard_error_counts_pairs_once():
    influence = np.array([1.0, -1.0, 2.0, -2.0])
    assert standard_error(influence) == pytest.approx(np.sqrt(10 * 4 / 3))
    assert standard_error(influence, 3.0) == pytest.approx(np.sqrt(7 * 4 / 3))
    assert standard_error(influence, 9.0) == pytest.approx(np.sqrt(5 * 4 / 3)), "never less than half"


def test_the_standard_error_is_the_true_spread():
    estimates, errors = [], []
    for seed in range(40):
        floor = floors_of(noisy(episodes=40, frames=15, seed=seed))[0, "rmse"]
        estimates.append(floor.value**2)
        errors.append(standard_error(floor.influence, floor.counted_twice))
    # 40 repeats know a spread to ± 22 %.
    assert 0.75 < np.mean(errors) / np.std(estimates) < 1.5


def test_saved_estimates_come_back(tmp_path):
    demos = noisy()
    found = measure_floors(demos, semantics(demos), STATE_ONLY, all_held_out(40), history=2, horizons=[0, 29])
    save_estimates(found, tmp_path / "estimates.json")
    for before, after in zip(found, load_estimates(tmp_path / "estimates.json"), strict=True):
        assert {**vars(before), "influence": 0, "nearest": 0} == {**vars(after), "influence": 0, "nearest": 0}
        np.testing.assert_array_equal(before.influence, after.influence)

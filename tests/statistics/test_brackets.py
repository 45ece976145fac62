"""Brackets: choosing without flattery, gaps whose intervals hold, what a sensor is worth."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.experiment import Variant
from pipeline.statistics.brackets import Scored, Sight, form_brackets, gap_to_floor, sight_of, value_of_sensors
from pipeline.statistics.floors import measure_floors
from pipeline.types import ACTION, STATE, EpisodeErrors, Fold, ObservationSet, Split
from tests.hand_made import demonstrations, semantics

POSITION = Sight(frozenset({STATE}), 1)
POSE = Sight(frozenset({STATE, "pose"}), 1)
NOISE = 2.0


def task(episodes=120, frames=20, seed=0):
    """Actions that scatter by NOISE about a mean of the state and of a pose; both features, and the mean."""
    generator = np.random.default_rng(seed)
    along = np.tile(np.linspace(0, 1, frames), episodes) + 0.1 * np.repeat(generator.normal(size=episodes), frames)
    pose = np.repeat(generator.choice([-1.0, 1.0], size=episodes), frames) + 0.01 * generator.normal(size=len(along))
    mean = 5 * np.sin(along) + 3 * np.sign(pose)
    action = mean + NOISE * generator.normal(size=len(mean))
    demos = demonstrations({STATE: along[:, None], "pose": pose[:, None], ACTION: action[:, None]}, [frames] * episodes)
    return demos, mean


def floors_of(demos, features=(STATE, "pose"), name="pose", horizons=(0,)):
    everything = tuple(range(demos.episodes))
    split = Split((Fold(everything, everything),), 0, "0" * 64)
    seen = ObservationSet(name, features, history=1)
    return measure_floors(demos, semantics(demos), seen, split, history=1, horizons=list(horizons))


def errors_of(demos, predicted, seeds=1, fold=None):
    """The errors of predictions [N] at the first action."""
    error = np.abs(predicted - demos.columns[ACTION][:, 0])
    sums = [np.add.reduceat(e, demos.episode_starts[:-1]) for e in (error, error**2)]
    shape = (seeds, demos.episodes, 1, 1)
    absolute, squared = (np.broadcast_to(s[None, :, None, None], shape).copy() for s in sums)
    fold = np.zeros(demos.episodes, int) if fold is None else fold
    ones = np.ones((demos.episodes, 1))
    return EpisodeErrors(
        np.arange(demos.episodes), fold, demos.lengths[:, None], absolute, squared, absolute[..., 0].copy(), ones
    )


def scored(name, demos, predicted, sight=POSE, **more):
    return Scored(name, "pose", sight, errors_of(demos, predicted, **more))


def test_what_can_be_gained_at_most_is_no_more_than_both_intervals_allow():
    demos, mean = task(episodes=40)
    policy = scored("off", demos, mean + 2.0)
    (floor,) = [f for f in floors_of(demos) if f.loss == "mae"]
    found = gap_to_floor(policy, floor)
    assert 0 < found.interval[1] <= found.error_interval[1] - floor.interval[0] < found.error_interval[1]


def test_a_perfect_policy_is_at_the_floor():
    demos, mean = task()
    found = gap_to_floor(scored("perfect", demos, mean), floors_of(demos)[0])
    assert found.error == pytest.approx(NOISE, rel=0.05)
    assert found.interval[0] < 0 < found.interval[1]
    assert found.words.startswith("at the floor, within ±")


def test_a_worse_policy_is_above_it_by_what_it_adds():
    demos, mean = task()
    found = gap_to_floor(scored("off", demos, mean + 2.0), floors_of(demos)[0])
    assert found.gap == pytest.approx(np.hypot(NOISE, 2.0) - NOISE, abs=0.1)
    assert found.interval[0] > 0
    assert "above the floor" in found.words


def test_an_l1_gap_is_to_the_lower_end():
    demos, mean = task()
    floor = floors_of(demos)[1]
    found = gap_to_floor(scored("perfect", demos, mean), floor)
    assert found.gap == pytest.approx(found.error - floor.value)
    assert found.words.startswith("at most")


def test_the_interval_of_a_gap_covers_it():
    """Pairing matters: the gap of a perfect policy is zero, and its interval is narrower than the floor's own."""
    inside, narrower = [], []
    for seed in range(60):
        demos, mean = task(episodes=80, seed=seed)
        floor = floors_of(demos)[0]
        gap = gap_to_floor(scored("perfect", demos, mean), floor)
        inside.append(gap.interval[0] <= 0 <= gap.interval[1])
        narrower.append(np.ptp(gap.interval) < np.ptp(floor.interval))
    assert np.mean(inside) >= 0.85  # 60 repeats know 95 % to ± 6 points
    assert np.mean(narrower) > 0.9


def test_a_chunk_that_ends_before_the_horizon_has_no_gap():
    demos, mean = task()
    late = floors_of(demos, horizons=(5,))[0]
    assert gap_to_floor(scored("perfect", demos, mean), late) is None


def test_only_policies_that_see_no_more_than_the_set_count():
    demos, mean = task()
    floors = floors_of(demos, (STATE,), "position")
    knows_more = scored("knows_more", demos, mean, POSE)
    blind = scored("blind", demos, np.full(demos.frames, mean.mean()), Sight(frozenset(), 0))
    brackets = form_brackets(floors, [knows_more, blind], {"position": POSITION})
    assert {b["upper_policy"] for b in brackets} == {"blind/pose"}
    assert form_brackets(floors, [knows_more], {"position": POSITION}) == []


def test_the_best_is_chosen_on_other_episodes():
    """Of many equally good policies the luckiest on the held-out episodes is no better than the rest."""
    demos, mean = task()
    generator = np.random.default_rng(0)
    lucky = [
        scored(f"p{i}", demos, mean + np.repeat(generator.normal(size=demos.episodes), demos.lengths))
        for i in range(20)
    ]
    floor = floors_of(demos)[0]
    least = min(gap_to_floor(one, floor).error for one in lucky)
    (upper,) = [b["upper"] for b in form_brackets([floor], lucky, {"pose": POSE})]
    average = np.mean([gap_to_floor(one, floor).error for one in lucky])
    assert least < upper
    assert upper == pytest.approx(average, rel=0.03)


def test_a_floor_that_a_policy_is_below_is_refused():
    demos, mean = task()
    floor = floors_of(demos)[0]
    cheat = scored("cheat", demos, demos.columns[ACTION][:, 0] + 0.1)
    (bracket,) = form_brackets([floor], [cheat], {"pose": POSE})
    assert bracket["lower"] is None
    assert bracket["gap"] is None
    assert "cheat/pose is significantly below the estimate" in bracket["words"]
    (honest,) = form_brackets([floor], [scored("perfect", demos, mean)], {"pose": POSE})
    assert honest["lower"] == floor.value


def test_a_sensor_is_worth_what_it_reveals():
    demos, _ = task()
    floors = [*floors_of(demos, (STATE,), "position"), *floors_of(demos)]
    sights = {"position": POSITION, "pose": POSE}
    (found,) = value_of_sensors(floors, sights, [])
    assert (found["smaller"], found["larger"]) == ("position", "pose")
    assert found["interval"][0] < np.hypot(NOISE, 3.0) - NOISE < found["interval"][1]
    assert "% of the floor" in found["words"]


def test_where_the_larger_floor_is_refused_a_policy_still_bounds_the_worth():
    demos, mean = task()
    small, large = floors_of(demos, (STATE,), "position")[0], floors_of(demos)[0]
    large = replace(large, value=None, interval=None, refused="too far", below=3.0)
    sights = {"position": POSITION, "pose": POSE}
    brackets = form_brackets([large], [scored("perfect", demos, mean)], sights)
    (found,) = value_of_sensors([small, large], sights, brackets)
    assert found["value"] is None
    assert found["at_least"] == pytest.approx(small.interval[0] - brackets[0]["upper_interval"][1])
    (unknown,) = value_of_sensors([replace(small, value=None, interval=None), large], sights, brackets)
    assert unknown["words"].startswith("not known")


def test_what_policies_see():
    seen = ObservationSet("state", (STATE,))
    kinds = ("position", "position")

    def sight(method, kinds=kinds):
        return sight_of(Variant(method, method, method, None), seen, 3, kinds)

    assert sight("mlp") == Sight(frozenset({STATE}), 3)
    assert sight("notebook_pusht").frames == 1
    assert sight("hold_still").within(POSITION)
    assert not sight("constant_velocity").within(POSITION)
    assert sight("constant_velocity").within(Sight(frozenset({STATE}), 2))
    assert sight("mean_action").within(POSITION)
    assert not sight("hold_still", ("position", "other")).within(POSITION), "it repeats an action that no set shows"

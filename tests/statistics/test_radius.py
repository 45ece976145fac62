"""The radius floor against a loop, and the number it is kept to reproduce."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.statistics.radius import evenly_spaced, load_floors, radius_floor, save_floors
from pipeline.types import ACTION, STATE, ObservationSet
from tests.hand_made import POSE, STATE_ONLY, demonstrations, semantics


def crowd(frames_an_episode: int = 40, episodes: int = 5, units=None):
    generator = np.random.default_rng(0)
    frames = frames_an_episode * episodes
    columns = {
        STATE: 100 * generator.normal(size=(frames, 2)),
        ACTION: generator.normal(size=(frames, 2)),
        POSE: generator.uniform(0, 2 * np.pi, size=(frames, 1)),
    }
    return demonstrations(columns, (frames_an_episode,) * episodes, units=units or {ACTION: ("px", "px")})


def floor_of(demos, **more):
    return radius_floor(demos, semantics(demos), STATE_ONLY, **{"radius": 30.0, "min_neighbours": 3} | more)


@pytest.mark.parametrize("horizon", [0, 3])
def test_it_agrees_with_a_loop(horizon):
    demos = crowd()
    found = floor_of(demos, probes=60, horizon=horizon)
    state, action = (demos.columns[key].astype(float) for key in (STATE, ACTION))
    usable = [f for f in range(demos.frames) if f + horizon < demos.episode(demos.episode_of_frame[f]).stop]
    sizes, spreads, largest = [], [], None
    for probe in np.array(usable)[evenly_spaced(len(usable), 60)]:
        group = [f for f in usable if np.sqrt(((state[f] - state[probe]) ** 2).sum()) <= 30.0]
        if len(group) < 3:
            continue
        chosen = action[np.array(group) + horizon]
        sizes.append(len(group))
        spreads.append(np.mean([np.sqrt(((a - chosen.mean(axis=0)) ** 2).sum()) for a in chosen]))
        if largest is None or len(group) > len(largest[1]):
            largest = (probe, group)
    assert (found.probes, found.median_neighbours) == (len(sizes), np.median(sizes))
    assert found.mean == pytest.approx(np.mean(spreads), rel=1e-6)
    assert found.p90 == pytest.approx(np.percentile(spreads, 90), rel=1e-6)
    assert (found.crowded.probe, found.crowded.frames.tolist()) == largest
    np.testing.assert_array_equal(found.crowded.actions, demos.columns[ACTION][found.crowded.frames + horizon])
    assert (found.unit, found.scaled, found.refused) == ("px", False, None)


def test_the_published_number_on_pusht(shared_data):
    from pipeline.lerobot_format.read import read_dataset

    demos = read_dataset(shared_data / "pusht", name="pusht")
    found = floor_of(demos, radius=2.0, probes=2000, min_neighbours=5)
    assert (found.probes, found.median_neighbours) == (686, 6)
    assert (found.mean, found.p90) == (pytest.approx(16.99, abs=5e-3), pytest.approx(29.57, abs=5e-3))
    assert floor_of(demos, radius=None, min_neighbours=5).mean == found.mean


def test_columns_that_cannot_be_compared_are_scaled():
    demos = crowd(units={STATE: ("px", "px"), POSE: ("rad",)})
    pose = ObservationSet("pose", (STATE, POSE))
    meaning = semantics(demos, circular={POSE: (True,)})
    found = radius_floor(demos, meaning, pose, min_neighbours=2)
    assert found.scaled
    assert found.radius == pytest.approx(0.1 * np.sqrt(4))
    larger = replace(demos, columns={**demos.columns, STATE: 50 * demos.columns[STATE]})
    assert radius_floor(larger, meaning, pose, min_neighbours=2).mean == pytest.approx(found.mean, rel=1e-4)


def test_the_default_radius_is_close_whatever_the_unit():
    demos = crowd()
    small = replace(demos, columns={**demos.columns, STATE: demos.columns[STATE] / 1000})
    assert floor_of(demos, radius=None).radius == 2.0
    found = floor_of(small, radius=None)
    assert (found.scaled, found.radius) == (True, pytest.approx(0.1 * np.sqrt(2)))


def test_a_radius_that_spans_the_data_is_refused():
    found = floor_of(crowd(), radius=100.0)
    assert (found.probes, found.crowded) == (0, None)
    assert np.isnan(found.mean)
    assert "spans the data set" in found.refused


def test_nothing_crowded_enough_is_refused():
    found = floor_of(crowd(), radius=0.01)
    assert found.refused == "none of 200 probes has 3 frames within 0.01"


def test_probes_are_evenly_spaced_and_never_twice():
    np.testing.assert_array_equal(evenly_spaced(11, 6), [0, 2, 4, 6, 8, 10])
    np.testing.assert_array_equal(evenly_spaced(3, 100), [0, 1, 2])


def test_stored_floors_are_the_same_floors(tmp_path):
    floors = [floor_of(crowd()), floor_of(crowd(), radius=0.01)]
    save_floors(floors, tmp_path / "floors.json")
    first, second = load_floors(tmp_path / "floors.json")
    assert (first.mean, first.p90, first.unit) == (floors[0].mean, floors[0].p90, "px")
    np.testing.assert_array_equal(first.crowded.frames, floors[0].crowded.frames)
    np.testing.assert_array_equal(first.crowded.actions, floors[0].crowded.actions)
    assert (second.crowded, second.refused) == (None, floors[1].refused)

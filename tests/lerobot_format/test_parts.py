"""A part of the frames at a time: every frame once, whole episodes, and the same numbers as all at once."""

from itertools import pairwise

import numpy as np

from pipeline.inspection.survey import per_episode
from pipeline.lerobot_format.kinds import steps_of
from pipeline.lerobot_format.parts import AT_A_TIME, blocks, parts
from pipeline.lerobot_format.quality import dead_columns, inspect_dataset, resolve_semantics
from pipeline.types import ACTION, STATE
from tests.hand_made import demonstrations


def test_parts_hold_every_frame_once():
    for frames in (0, 1, AT_A_TIME - 1, AT_A_TIME, AT_A_TIME + 1, 3 * AT_A_TIME):
        covered = np.concatenate([np.arange(frames)[part] for part in parts(frames)] or [np.arange(0)])
        assert covered.tolist() == list(range(frames))
        assert all(part.stop - part.start <= AT_A_TIME for part in parts(frames))


def test_blocks_are_whole_episodes_and_no_larger_than_asked_unless_one_episode_is():
    starts = np.array([0, 3, 4, 20, 21, 24, 30])
    found = list(blocks(starts, 6))
    assert [(episodes.start, episodes.stop) for episodes, _ in found] == [(0, 2), (2, 3), (3, 5), (5, 6)]
    assert [(frames.start, frames.stop) for _, frames in found] == [(0, 4), (4, 20), (20, 24), (24, 30)]


def test_more_frames_than_a_part_give_what_all_at_once_gives():
    lengths = [AT_A_TIME - 7, 30, AT_A_TIME + 3, 1, 50]
    state = np.random.default_rng(0).normal(size=(sum(lengths), 2)).cumsum(axis=0).astype(np.float32)
    demos = demonstrations({STATE: state, ACTION: np.roll(state, -1, axis=0)}, lengths)
    starts, stamps = demos.episode_starts, demos.timestamps
    plain = np.setdiff1d(np.arange(demos.frames), starts[1:] - 1)
    found = list(steps_of(demos))
    assert len(found) > 2
    assert np.array_equal(np.concatenate([steps.first for steps in found]), plain)
    assert np.array_equal(np.concatenate([steps.seconds for steps in found]), stamps[plain + 1] - stamps[plain])
    np.testing.assert_allclose(
        per_episode(state[:, 0], starts), [state[a:b, 0].astype(np.float64).sum() for a, b in pairwise(starts)]
    )
    semantics = resolve_semantics(demos)
    behind = np.abs(demos.columns[ACTION].astype(np.float64) - state).mean(axis=0)
    np.testing.assert_allclose(semantics.tracking_lag, behind)
    summary = inspect_dataset(demos, semantics)["features"]
    deviations = {feature["key"]: feature["std"] for feature in summary}
    np.testing.assert_allclose(deviations[STATE], state.astype(np.float64).std(axis=0))


def test_a_column_that_does_not_move_is_dead_to_the_last_digit():
    values = np.full((2 * AT_A_TIME, 1), 0.1, np.float32)
    demos = demonstrations({STATE: values, ACTION: values}, [len(values)])
    assert dead_columns(demos, STATE).tolist() == [True]

"""The nearest neighbour against a loop that looks at every candidate."""

import numpy as np
import pytest

from pipeline.policies import Plan
from pipeline.policies import nearest_neighbour as module
from pipeline.policies.nearest_neighbour import NearestNeighbour
from pipeline.types import ACTION, STATE, ObservationSet
from pipeline.windows import make_windows
from tests.hand_made import POSE, STATE_ONLY, demonstrations, random_walks, semantics


def lay(demos, meaning, observation_set, episodes, train, history=3):
    settings = {"statistics_episodes": train, "protocol": "strict", "history": history, "chunk": 1}
    return make_windows(demos, meaning, observation_set, episodes, **settings)


def slowly(train, test, horizon):
    """One query, one candidate at a time; ties go to the window that reaches farthest, then to the earliest."""
    encode = train.normalizer.observations.encode
    candidates, queries = encode(train.observations().values), encode(test.observations().values)
    actions, answers = train.demos.columns[ACTION], []
    for query in queries:
        best = None
        for position, candidate in enumerate(candidates):
            remaining = train.end_frame[position] - 1 - train.anchors[position]
            if horizon > remaining:
                continue
            distance = float(((query.astype(float) - candidate.astype(float)) ** 2).sum())
            rank = (round(distance, 9), -min(remaining, 5), position)
            if best is None or rank < best[0]:
                best = (rank, actions[train.anchors[position] + horizon])
        answers.append(best[1])
    return np.array(answers)


@pytest.mark.parametrize("block", [2, 4096])
def test_it_agrees_with_a_loop_over_everything(monkeypatch, block):
    monkeypatch.setattr(module, "QUERIES", block)
    monkeypatch.setattr(module, "CANDIDATES", block)
    walks = random_walks((9, 7, 6, 12, 8, 10))
    pose = np.random.default_rng(3).uniform(0, 2 * np.pi, (walks.frames, 1))
    demos = demonstrations({**walks.columns, POSE: pose}, walks.lengths, units={POSE: ("rad",)})
    meaning = semantics(demos, circular={POSE: (True,)})
    both = ObservationSet("both", (STATE, POSE))
    train, test = (lay(demos, meaning, both, part, [0, 2, 3, 5]) for part in ([0, 2, 3, 5], [1, 4]))
    policy, _ = NearestNeighbour.fit(train, Plan((0,), 0))
    answer = policy.predict(test.observations(), 6)
    assert answer.shape == (1, len(test), 6, 2)
    for horizon in range(6):
        np.testing.assert_array_equal(answer[0, :, horizon], slowly(train, test, horizon))


def test_equally_near_windows_are_told_apart_the_same_way():
    state = np.tile(np.arange(6.0)[:, None], (3, 1))
    demos = demonstrations({STATE: state, ACTION: np.arange(18.0)[:, None]}, (6, 6, 6))
    train, test = (lay(demos, semantics(demos), STATE_ONLY, part, [0, 1], history=1) for part in ([0, 1], [2]))
    policy, _ = NearestNeighbour.fit(train, Plan((0,), 0))
    np.testing.assert_array_equal(policy.predict(test.observations())[0, :, 0, 0], np.arange(6.0))


def test_it_knows_its_own_training_windows_by_heart():
    demos = random_walks()
    train = lay(demos, semantics(demos), STATE_ONLY, range(5), range(5))
    policy, _ = NearestNeighbour.fit(train, Plan((0,), 0))
    answer = policy.predict(train.observations())[0, :, 0]
    np.testing.assert_array_equal(answer, demos.columns[ACTION][train.anchors])


def test_beyond_the_longest_training_episode_the_last_answer_is_repeated():
    demos = random_walks((5, 5, 30))
    train, test = (lay(demos, semantics(demos), STATE_ONLY, part, [0, 1]) for part in ([0, 1], [2]))
    policy, _ = NearestNeighbour.fit(train, Plan((0,), 0))
    answer = policy.predict(test.observations(), 8)[0]
    assert np.isfinite(answer).all()
    for horizon in range(3, 8):
        np.testing.assert_array_equal(answer[:, horizon], answer[:, 2])


def test_it_remembers_frames_not_windows():
    demos = random_walks((60, 60))
    train = lay(demos, semantics(demos), STATE_ONLY, [0, 1], [0, 1], history=50)
    policy, _ = NearestNeighbour.fit(train, Plan((0,), 0))
    assert sum(array.size for array in policy.arrays().values()) < 10 * demos.frames

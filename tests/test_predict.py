"""Asking policies: in blocks, over folds, and as a temporal ensemble against a loop."""

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline import predict
from pipeline.errors import StoreError
from pipeline.methods import METHODS
from pipeline.policies import Plan
from pipeline.predict import (
    FEWEST,
    join_folds,
    latency_ms,
    load_predictions,
    predict_policy,
    save_predictions,
    temporal_ensemble,
)
from pipeline.train import train_policy
from pipeline.windows import make_windows
from tests.hand_made import STATE_ONLY, random_walks, semantics


def lay(demos, episodes, chunk=4):
    settings = {"statistics_episodes": (0, 1), "protocol": "strict", "history": 3, "chunk": chunk}
    return make_windows(demos, semantics(demos), STATE_ONLY, episodes, **settings)


@pytest.fixture(scope="module")
def trained():
    return train_policy("mlp", lay(random_walks(), (0, 1)), seeds=(4, 7), steps=3)


def ask(policy, windows, fold=0, **more):
    return predict_policy(policy, windows, name="p", observations="state", fold=fold, **more)


def test_blocks_do_not_matter(trained, monkeypatch):
    windows = lay(random_walks(), (2, 3))
    whole = ask(trained.policy, windows)
    monkeypatch.setattr(predict, "BLOCK", 3)
    parts = ask(trained.policy, windows)
    assert whole.actions.shape == (2, len(windows), 4, 2)
    np.testing.assert_allclose(parts.actions, whole.actions, rtol=1e-5)
    np.testing.assert_array_equal(parts.anchors, windows.anchors)
    assert whole.seeds == (4, 7)


def test_some_seeds_can_be_kept(trained):
    windows = lay(random_walks(), (2,))
    only = ask(trained.policy, windows, seeds=(7,))
    assert only.seeds == (7,)
    np.testing.assert_array_equal(only.actions[0], ask(trained.policy, windows).actions[1])


def test_a_policy_without_a_chunk_answers_the_horizons_asked_for():
    windows = lay(random_walks(), (2,), chunk=1)
    policy, _ = METHODS["hold_still"].load_class().fit(windows, Plan((0,), 0))
    found = ask(policy, windows, seeds=(0, 1, 2), horizons=9)
    assert (found.seeds, found.actions.shape[2]) == ((0,), 9)


def test_folds_are_joined_in_order(trained):
    demos = random_walks()
    parts = [ask(trained.policy, lay(demos, (episode,)), fold) for fold, episode in enumerate((3, 2))]
    joined = join_folds(parts)
    assert joined.fold.tolist() == [0] * len(parts[0].anchors) + [1] * len(parts[1].anchors)
    np.testing.assert_array_equal(joined.actions[:, joined.fold == 1], parts[1].actions)
    inside = joined.in_frames(demos.episode(2))
    np.testing.assert_array_equal(joined.anchors[inside], parts[1].anchors)


def test_stored_predictions_are_the_same_predictions(trained, tmp_path):
    found = ask(trained.policy, lay(random_walks(), (2, 3)))
    save_predictions(found, tmp_path / "predictions")
    again = load_predictions(tmp_path / "predictions")
    assert (again.policy, again.observations, again.seeds) == ("p", "state", (4, 7))
    for name in ("anchors", "fold", "actions"):
        np.testing.assert_array_equal(getattr(again, name), getattr(found, name))


def test_predictions_that_are_not_there_are_one_message(tmp_path):
    with pytest.raises(StoreError, match=r"predictions in .* cannot be read"):
        load_predictions(tmp_path)


def test_a_call_takes_time(trained):
    windows = lay(random_walks(), (2,))
    median, late = latency_ms(trained.policy, windows, calls=25)
    assert 0 < median <= late < 1000


def test_a_slow_policy_is_asked_less_often():
    class Slow:
        asked = 0

        def predict(self, observation):
            assert len(observation) == 1
            self.asked += 1
            time.sleep(0.02 if self.asked == 7 else 0.002)

    policy = Slow()
    median, late = latency_ms(policy, lay(random_walks(), (2,)), calls=200, most_s=0.01)
    assert policy.asked == 1 + FEWEST
    assert 2 <= median < 10 < late


def slow_ensemble(actions, anchors, demos, m):
    """ACT's rule for one frame at a time: the oldest prediction weighs most."""
    answers = np.empty((actions.shape[0], len(anchors), actions.shape[3]))
    for position, frame in enumerate(anchors):
        votes = []
        for asked in range(frame - actions.shape[2] + 1, frame + 1):
            same = asked >= 0 and demos.episode_of_frame[asked] == demos.episode_of_frame[frame]
            if same and asked in anchors:
                votes.append(actions[:, list(anchors).index(asked), frame - asked])
        weights = np.exp(-m * np.arange(len(votes)))
        answers[:, position] = sum(w * v for w, v in zip(weights / weights.sum(), votes, strict=True))
    return answers


@given(chunk=st.integers(1, 6), m=st.floats(0, 1), shuffled=st.booleans(), gaps=st.booleans())
def test_the_temporal_ensemble_agrees_with_a_loop(chunk, m, shuffled, gaps):
    demos = random_walks((9, 7, 12))
    generator = np.random.default_rng(chunk)
    anchors = lay(demos, (0, 2), chunk).anchors
    if gaps:
        anchors = np.delete(anchors, [2, 5])
    if shuffled:
        anchors = generator.permutation(anchors)
    actions = generator.normal(size=(2, len(anchors), chunk, 3)).astype(np.float32)
    found = temporal_ensemble(actions, anchors, demos.episode_starts, m=m)
    np.testing.assert_allclose(found, slow_ensemble(actions, anchors, demos, m), rtol=1e-4, atol=1e-5)


def test_angles_are_averaged_as_directions():
    actions = np.array([0.1, 9.0, 0.0, 2 * np.pi - 0.1], np.float32).reshape(1, 2, 2, 1)[:, :, ::-1]
    starts = np.array([0, 5])
    circular = np.array([True])
    first, second = temporal_ensemble(actions, np.array([1, 2]), starts, circular=circular, m=0.0)[0, :, 0]
    assert np.cos(first) == pytest.approx(np.cos(9.0), abs=1e-5)
    mean = np.arctan2(np.sin(0.1) + np.sin(-0.1), np.cos(0.1) + np.cos(0.1))
    assert second == pytest.approx(mean, abs=1e-5)

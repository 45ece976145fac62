"""Offline scores of one network: by hand on demonstrations whose every number is known, and beside the product's own metrics."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.config import parse_config
from pipeline.experiment import from_config
from pipeline.folds import PolicyTask, predict_folds, split_of, train_folds
from pipeline.offline_scores import AHEAD, BACK, drawing, energy_of_span, near_contact, offline_scores
from pipeline.predict import temporal_ensemble
from pipeline.statistics.metrics import score_task
from pipeline.types import ACTION, STATE, Execution, Predictions
from tests.hand_made import POSE, STATE_ONLY, demonstrations, random_walks, semantics

SMALL = {"blocks": 1, "width": 16, "batch": 16}


def task_of(demos, method="mlp", settings=None, chunk=4):
    raw = {
        "benchmark": {"history": 1, "seeds": 2, "folds": 1, "test_share": 0.4, "steps": 5, "threads": 1},
        "datasets": {"d": {"source": "d"}},
        "policies": {"p": {"method": method, "chunks": [chunk], "settings": settings or {}}},
    }
    experiment = from_config(parse_config(raw, "test"), "d", Path("/"))
    (variant,) = [v for v in experiment.variants if v.family == "p"]
    return PolicyTask(demos, semantics(demos), split_of(experiment, demos), STATE_ONLY, variant, experiment)


def off_by(task, errors) -> Predictions:
    """Predictions at every held-out anchor that are what was recorded plus errors [S, K, A]."""
    fold = task.split.folds[0]
    windows = task.windows(fold.test, fold)
    recorded, _ = windows.targets()
    actions = recorded[None] + np.asarray(errors, np.float32)[:, None]
    zeros = np.zeros(len(windows), np.int64)
    return Predictions("p_k04", "state", tuple(range(len(errors))), windows.anchors, zeros, actions)


def test_by_hand():
    task = task_of(random_walks((20, 22, 25, 21, 24)))
    errors = np.zeros((2, 4, 2))
    errors[0, :, 0], errors[1] = [1.0, 2.0, 3.0, 10.0], 3.0
    near = np.zeros(task.demos.frames, bool)
    near[task.demos.episode(task.split.folds[0].test[0])] = True
    found = offline_scores(task, off_by(task, errors), Execution(2, False, 1), near, None)
    # Columns are averaged: half of what the first column is off. Executed: the second and third action.
    assert found["whole_chunk_mae"] == pytest.approx([(1 + 2 + 3 + 10) / 8, 3.0], rel=1e-4)
    assert found["executed_mae"] == pytest.approx([(2 + 3) / 4, 3.0], rel=1e-4)
    assert found["near_contact_mae"] == pytest.approx([(2 + 3) / 4, 3.0], rel=1e-4)
    # A point mass: the length of the error over both frames, √(4 + 9), over √2; in an episode's last frame 2 alone.
    lengths = [task.demos.lengths[e] for e in task.split.folds[0].test]
    by_episode = [((n - 2) * np.sqrt(13 / 2) + 2) / (n - 1) for n in lengths]
    assert found["energy"] == pytest.approx([np.mean(by_episode), 3 * np.sqrt(2)], rel=1e-4)


def test_near_contact_looks_at_those_frames_alone():
    task = task_of(random_walks((20, 22, 25, 21, 24)))
    predicted = off_by(task, np.zeros((1, 4, 2)))
    near = np.zeros(task.demos.frames, bool)
    middle = predicted.anchors[3:9]
    near[middle] = True
    predicted.actions[:, 3:9] += 2.0
    found = offline_scores(task, predicted, Execution(1), near, None)
    assert found["near_contact_mae"] == pytest.approx([2.0], rel=1e-4)
    assert found["executed_mae"] < 1.0
    assert "near_contact_mae" not in offline_scores(task, predicted, Execution(1), None, None)


def test_the_whole_chunk_is_the_products_own_metric(tmp_path):
    task = task_of(random_walks((12, 14, 11, 13, 12)))
    train_folds(task, tmp_path / "trained", tmp_path / "unfinished")
    predicted, _ = predict_folds(task, tmp_path / "trained")
    found = offline_scores(task, predicted, Execution(4), None, drawing(task, tmp_path / "trained"))
    of_seeds = [metrics["whole_chunk_mae"] for metrics in score_task(task, predicted).seed_metrics]
    assert found["whole_chunk_mae"] == pytest.approx(of_seeds)
    assert found["executed_mae"] == pytest.approx(of_seeds)  # all of it is carried out


def test_where_units_differ_columns_count_alike():
    walks = random_walks((20, 22, 25, 21, 24))
    columns = {key: values * np.array([1.0, 1000.0]) for key, values in walks.columns.items()}
    demos = demonstrations(columns, walks.lengths, units={ACTION: ("deg", "px")})
    errors = np.zeros((2, 4, 2))
    errors[0, :, 0], errors[1, :, 1] = 1.0, 1000.0
    task = task_of(demos)
    found = offline_scores(task, off_by(task, errors), Execution(4), None, None)
    train = np.concatenate([walks.columns[ACTION][walks.episode(e)] for e in task.split.folds[0].train]).std(axis=0)
    for name, times in (("executed_mae", 0.5), ("energy", 1.0)):
        assert found[name] == pytest.approx(times / train, rel=1e-3), name


def test_an_ensemble_is_scored_on_what_it_averages():
    task = task_of(random_walks((20, 22, 25, 21, 24)))
    random = np.random.default_rng(0)
    predicted = off_by(task, np.zeros((1, 4, 2)))
    predicted.actions[:] += random.normal(size=predicted.actions.shape)
    found = offline_scores(task, predicted, Execution(1, True, 0), None, None)
    averaged = temporal_ensemble(predicted.actions, predicted.anchors, task.demos.episode_starts)[0]
    off = np.abs(averaged - task.demos.columns[ACTION][predicted.anchors]).mean(axis=1)
    episode = task.demos.episode_of_frame[predicted.anchors]
    assert found["executed_mae"] == pytest.approx([np.mean([off[episode == e].mean() for e in np.unique(episode)])])


# energy ---------------------------------------------------------------------------------------------------------------


def test_the_energy_score_of_a_point_mass_is_the_length_of_its_error():
    random = np.random.default_rng(1)
    samples, recorded = random.normal(size=(2, 1, 5, 3, 2)), random.normal(size=(5, 3, 2))
    inside = np.ones((5, 3), bool)
    inside[4, 1:] = False
    found = energy_of_span(samples, recorded, inside, circular=np.zeros(2, bool), scale=np.ones(2))
    off = np.where(inside[..., None], samples[:, 0] - recorded, 0.0)
    assert found == pytest.approx(np.sqrt((off**2).sum(axis=(2, 3)) / inside.sum(axis=1)))


def test_two_whole_strategies_score_better_than_their_mixture_frame_by_frame():
    """Every frame is ±1 with equal chance either way; only the span as one vector tells a strategy from frames at random."""
    random = np.random.default_rng(2)
    recorded = np.repeat(random.choice([-1.0, 1.0], size=(400, 1, 1)), 6, axis=1)
    strategies = np.repeat(random.choice([-1.0, 1.0], size=(1, 16, 400, 1, 1)), 6, axis=3)
    frames = random.choice([-1.0, 1.0], size=(1, 16, 400, 6, 1))
    whole, mixed, middle = (
        energy_of_span(samples, recorded, np.ones((400, 6), bool), circular=np.zeros(1, bool), scale=np.ones(1)).mean()
        for samples in (strategies, frames, np.zeros((1, 1, 400, 6, 1)))
    )
    assert whole == pytest.approx(0.5, abs=0.05)  # E|x − y| − ½ E|x − x′| = 1 − ½
    assert whole < mixed - 0.1
    assert whole < middle - 0.1


def test_a_policy_that_draws_is_scored_on_its_samples(tmp_path):
    task = task_of(random_walks((12, 14, 11, 13, 12)), "flow", SMALL | {"euler_steps": 2})
    train_folds(task, tmp_path / "trained", tmp_path / "unfinished")
    predicted, _ = predict_folds(task, tmp_path / "trained")
    draw = drawing(task, tmp_path / "trained")
    how = Execution(2, False, 1)
    drawn, point = (offline_scores(task, predicted, how, None, d)["energy"] for d in (draw, None))
    assert drawn.shape == (2,)
    assert not np.allclose(drawn, point)
    samples = draw(predicted.anchors[:3])
    assert samples.shape == (2, 16, 3, 4, 2)
    recorded = np.stack([task.demos.columns[ACTION][a + 1 : a + 3] for a in predicted.anchors[:3]])
    one = energy_of_span(
        samples[:, :, :, 1:3], recorded, np.ones((3, 2), bool), circular=np.zeros(2, bool), scale=np.ones(2)
    )
    assert one.shape == (2, 3)
    assert drawing(task_of(task.demos), _trained(tmp_path, task.demos)) is None


def _trained(tmp_path, demos):
    train_folds(task_of(demos), tmp_path / "plain", tmp_path / "unfinished_plain")
    return tmp_path / "plain"


# near contact ---------------------------------------------------------------------------------------------------------


def pushed(noise=0.0, still=30, moving=10, circular=False):
    """Two episodes: an object stands, moves, and stands; the second begins where the first does not."""
    ramp = np.concatenate([np.zeros(still), np.arange(1, moving + 1) * 5.0, np.full(still, 5.0 * moving)])
    x = np.concatenate([ramp, ramp + 300.0])
    if circular:
        x = np.mod(x / 25.0 + 6.0, 2 * np.pi)
    x = x + noise * np.random.default_rng(0).normal(size=len(x))
    target = np.repeat([100.0, 40.0], len(ramp))  # differs between episodes, moves in none
    columns = {POSE: np.stack([x, target], axis=1), STATE: np.zeros((len(x), 2)), ACTION: np.zeros((len(x), 2))}
    return demonstrations(columns, (len(ramp), len(ramp)))


def test_frames_around_a_motion_are_near_contact():
    demos = pushed()
    near = near_contact(demos, semantics(demos))
    first = near[demos.episode(0)]
    # It moves between frames 29 and 30 first, and between 38 and 39 last.
    assert np.flatnonzero(first).tolist() == list(range(30 - AHEAD, 39 + BACK))
    assert np.array_equal(first, near[demos.episode(1)])


def test_a_pose_with_noise_moves_no_more():
    # 1 % of the deviation is 1.5; noise of 2 alone would be a motion everywhere.
    clean, noisy = (near_contact(d, semantics(d)) for d in (pushed(), pushed(noise=2.0)))
    assert noisy.mean() < clean.mean() + 0.05
    assert noisy[: 30 - AHEAD].mean() < 0.1
    assert noisy[34:36].all()


def test_an_angle_that_wraps_is_no_jump():
    demos = pushed(circular=True)
    turns = semantics(demos, circular={POSE: (True, False)})
    near = near_contact(demos, turns)
    assert np.flatnonzero(near[demos.episode(0)]).tolist() == list(range(30 - AHEAD, 39 + BACK))


def test_without_objects_it_says_why():
    walks = random_walks()
    assert "does not say where its objects are" in near_contact(walks, semantics(walks))
    demos = pushed(moving=0)
    assert "ever moves" in near_contact(demos, semantics(demos))

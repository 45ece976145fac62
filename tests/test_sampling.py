"""Scores of samples: by hand, against the plain score of each anchor, and through a whole run."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.config import parse_config
from pipeline.experiment import from_config
from pipeline.folds import PolicyTask, split_of, train_folds
from pipeline.sampling import of_episodes, sampled_scores
from pipeline.statistics.distributions import score_samples
from pipeline.train import load_trained
from pipeline.types import ACTION, STATE
from tests.hand_made import STATE_ONLY, demonstrations, random_walks, semantics

SMALL = {"blocks": 1, "width": 16, "batch": 16, "euler_steps": 2}


def task_of(demos, method="flow", settings=SMALL, **policy):
    raw = {
        "benchmark": {"history": 1, "seeds": 2, "folds": 1, "test_share": 0.4, "steps": 5, "threads": 1},
        "datasets": {"d": {"source": "d"}},
        "policies": {"p": {"method": method, "chunks": [3], "settings": settings, **policy}},
    }
    experiment = from_config(parse_config(raw, "test"), "d", Path("/"))
    (variant,) = [v for v in experiment.variants if v.family == "p"]
    return PolicyTask(demos, semantics(demos), split_of(experiment, demos), STATE_ONLY, variant, experiment)


def test_an_episode_counts_once():
    values = np.array([[1.0, 2.0, 3.0, 10.0, np.nan], [3.0, 4.0, 5.0, 20.0, np.nan]])
    found = of_episodes(values, np.array([4, 4, 4, 7, 9]), np.zeros(5, int))
    assert found["value"] == pytest.approx(((1 + 2 + 3) / 3 + (3 + 4 + 5) / 3 + 10 + 20) / 4)


def test_they_are_those_of_every_anchor(tmp_path):
    demos = random_walks((12, 14, 11, 13, 12, 10))
    task = task_of(demos)
    train_folds(task, tmp_path / "trained", tmp_path / "unfinished")
    found = sampled_scores(task, tmp_path / "trained")
    policy = load_trained(tmp_path / "trained/fold_0").policy
    held_out = task.windows(task.split.folds[0].test, task.split.folds[0])
    samples, (recorded, inside) = policy.sample(held_out.observations(), 16), held_out.targets()
    episode = demos.episode_of_frame[held_out.anchors]
    for horizon in (0, 2):
        scores = score_samples(samples[:, :, :, horizon], recorded[:, horizon])
        use = inside[:, horizon]
        expected = np.mean([scores.energy[:, use & (episode == e)].mean() for e in np.unique(episode)])
        assert found["by_horizon"]["energy"][horizon] == pytest.approx(expected, rel=1e-5)
    assert found["energy"]["value"] == pytest.approx(found["by_horizon"]["energy"][0])
    assert found["of_mean"]["value"] <= found["of_one"]["value"]
    assert (found["count"], found["in_deviations"]) == (16, False)


def test_where_units_differ_they_are_in_deviations(tmp_path):
    walks = random_walks((12, 12, 12, 12, 12))
    scaled = {key: values * np.array([1.0, 1000.0]) for key, values in walks.columns.items()}
    plain, mixed = (
        demonstrations({STATE: scaled[STATE], ACTION: scaled[ACTION]}, (12,) * 5, units={ACTION: units})
        for units in (("px", "px"), ("px", "rad"))
    )
    found = []
    for number, demos in enumerate((plain, mixed)):
        task = task_of(demos)
        train_folds(task, tmp_path / f"trained{number}", tmp_path / f"unfinished{number}")
        found.append(sampled_scores(task, tmp_path / f"trained{number}"))
    assert [one["in_deviations"] for one in found] == [False, True]
    assert found[0]["energy"]["value"] > 50 * found[1]["energy"]["value"]


def test_policies_that_do_not_draw_have_none(tmp_path):
    task = task_of(random_walks(), "lwr", {})
    train_folds(task, tmp_path / "trained", tmp_path / "unfinished")
    assert sampled_scores(task, tmp_path / "trained") is None

"""Our own policies' predictions, sent as a file, give our own rows; samples, anchors and refusals beside it."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest

from pipeline.errors import ConfigError, DatasetError, NotApplicableError
from pipeline.external.anchors import anchors_of, require_strict, write_anchors
from pipeline.external.scoring import score_file
from pipeline.external.training import EVERY_FOLD, Training
from pipeline.statistics.distributions import score_samples
from pipeline.types import ACTION
from tests.external.conftest import HISTORY, Rows
from tests.statistics.test_metrics import scored, task_of


def exported(predictions, demos) -> Rows:
    """A policy's predictions as anybody would send them."""
    seeds = len(predictions.seeds)
    episode = demos.episode_of_frame[predictions.anchors]
    return Rows(
        {
            "episode_index": np.tile(demos.episode_ids[episode], seeds).tolist(),
            "frame_index": np.tile(demos.frame_in_episode[predictions.anchors], seeds).tolist(),
            "action": predictions.actions.reshape(-1, *predictions.actions.shape[2:]).tolist(),
            "seed": np.repeat(predictions.seeds, len(episode)).tolist(),
        }
    )


def trained_by_fold(split, demos) -> Training:
    numbers = {k: tuple(demos.episode_ids[list(f.train)].tolist()) for k, f in enumerate(split.folds)}
    tests = {k: tuple(demos.episode_ids[list(f.test)].tolist()) for k, f in enumerate(split.folds)}
    return Training(numbers, tests, "our split")


@pytest.fixture(scope="module")
def ours(place, tmp_path_factory):
    """A trained policy of two seeds with its score."""
    task = task_of(place.demos, "mlp_k04")
    score, predictions = scored(task, tmp_path_factory.mktemp("ours"))
    return task, score, predictions


def score_rows(rows, task, path, **more):
    settings = {"name": "sent", "observations": None, "training": trained_by_fold(task.split, task.demos)} | more
    return score_file(
        rows.write(path),
        demos=task.demos,
        semantics=task.semantics,
        split=task.split,
        experiment=task.experiment,
        **settings,
    )


def test_our_own_predictions_give_our_own_row(ours, tmp_path):
    task, score, predictions = ours
    found = score_rows(exported(predictions, task.demos), task, tmp_path / "p.parquet")
    for name, array in vars(score.errors).items():
        np.testing.assert_allclose(getattr(found.score.errors, name), array, rtol=1e-6, atol=1e-9, err_msg=name)
    assert json.dumps(found.score.metrics) == json.dumps(score.metrics), "to the last bit"
    assert found.held_out.seen is False
    assert found.predictions.observations == "elsewhere"
    json.dumps(found.summary(task.demos), allow_nan=False)


def test_a_fold_alone_gives_that_folds_errors(ours, tmp_path):
    task, score, predictions = ours
    rows = exported(predictions, task.demos)
    test = task.split.folds[2].test
    keep = [i for i, number in enumerate(rows.columns["episode_index"]) if number - 10 in test]
    training = Training({EVERY_FOLD: trained_by_fold(task.split, task.demos).episodes[2]}, {}, "fold 2")
    found = score_rows(rows.at(keep), task, tmp_path / "p.parquet", training=training)
    at = np.isin(score.errors.episodes, test)
    assert found.score.errors.episodes.tolist() == list(test)
    np.testing.assert_allclose(found.score.errors.absolute, score.errors.absolute[:, at], rtol=1e-6)
    np.testing.assert_allclose(found.score.errors.scale, score.errors.scale[at], rtol=1e-6)
    assert found.score.errors.fold.tolist() == [0] * len(test)


def test_samples_are_scored_by_their_mean_and_the_energy_score_at_every_step(place, tmp_path):
    """Chunks of 12 steps at 10 frames a second: the first action, one second ahead, and every step between."""
    task, steps = task_of(place.demos, "mlp_k04"), 12
    demos, anchors = place.demos, anchors_of(place.demos, HISTORY)
    episode = demos.episode_of_frame[anchors]
    frames = anchors[:, None] + np.arange(steps)
    inside = frames < demos.episode_starts[episode + 1][:, None]
    recorded = demos.columns[ACTION][np.minimum(frames, demos.frames - 1)]
    samples = recorded + np.random.default_rng(2).normal(size=(6, *recorded.shape)).astype(np.float32)
    samples[:, ~inside] = 9e3  # what lies past the end of an episode is nobody's business
    rows = place.rows(steps=1).but(fold=None)
    several = {name: values * 6 for name, values in rows.columns.items()}
    several |= {"action": samples.reshape(-1, steps, 3).tolist(), "sample": np.repeat(range(6), len(anchors)).tolist()}
    found = score_rows(Rows(several), task, tmp_path / "p.parquet", training=None)
    assert found.samples["count"] == 6
    assert found.samples["in_deviations"] is False
    for name in ("energy", "of_mean", "of_one"):
        by_hand = []
        for k in range(steps):
            slow = getattr(score_samples(samples[None, :, inside[:, k], k], recorded[inside[:, k], k]), name)[0]
            by_hand.append(np.mean([slow[episode[inside[:, k]] == e].mean() for e in range(6)]))
        np.testing.assert_allclose(found.samples["by_horizon"][name], by_hand, rtol=1e-6)
        for scores, value in ((found.samples, by_hand[0]), (found.samples["at_one_second"], by_hand[10])):
            assert scores[name]["value"] == pytest.approx(value, rel=1e-6)
            low, high = scores[name]["interval"]
            assert low < value < high
    np.testing.assert_allclose(found.predictions.actions[0, :, 0], samples[:, :, 0].mean(axis=0), atol=1e-5)
    assert found.score.metrics["first_step_l2"] == pytest.approx(found.samples["of_mean"]["value"], rel=1e-6)


def test_samples_of_a_short_chunk_have_nothing_one_second_ahead(place, tmp_path):
    rows = place.rows(steps=2).but(fold=None)
    two = {name: values * 2 for name, values in rows.columns.items()} | {
        "sample": np.repeat((0, 1), len(rows.columns["seed"]))
    }
    found = score_rows(Rows(two), task_of(place.demos, "mlp_k04"), tmp_path / "p.parquet", training=None)
    assert found.samples["at_one_second"] is None
    assert len(found.samples["by_horizon"]["energy"]) == 2


def test_a_misaligned_file_is_refused_with_its_name(ours, tmp_path):
    task, _, predictions = ours
    rows = exported(predictions, task.demos)
    good = task.demos.columns[ACTION][np.minimum(predictions.anchors[:, None] + np.arange(4), task.demos.frames - 1)]
    swapped = np.tile(good[..., [1, 0, 2]], (2, 1, 1)).tolist()
    with pytest.raises(DatasetError, match=r"p\.parquet: action columns are permuted: a0 holds a1"):
        score_rows(rows.but(action=swapped), task, tmp_path / "p.parquet")


def test_only_under_the_strict_protocol(ours, tmp_path):
    task = ours[0]
    require_strict("strict")
    experiment = task.experiment.model_copy(update={"protocol": "notebook"})
    with pytest.raises(NotApplicableError, match="windows of its own"):
        score_file(
            tmp_path / "p.parquet", name="x", observations=None, training=None, demos=task.demos,
            semantics=task.semantics, split=task.split, experiment=experiment,
        )  # fmt: skip


def test_folds_of_another_split_are_refused(ours, tmp_path):
    task, _, predictions = ours
    rows = exported(predictions, task.demos)
    with pytest.raises(ConfigError, match="have fold 9"):
        score_rows(rows.but(fold=[9] * len(rows.columns["seed"])), task, tmp_path / "p.parquet")


def test_anchors_say_what_to_fill_in(place, tmp_path):
    path = tmp_path / "a.parquet"
    count = write_anchors(path, place.demos, place.split, HISTORY)
    file = pq.read_table(path)
    assert file.num_rows == count == place.demos.frames - 6 * (HISTORY - 1)
    assert file.column_names == ["episode_index", "frame_index", "fold"]
    described = json.loads(file.schema.metadata[b"demobench"])
    assert described == {
        "dataset": "hand_made", "content_hash": "0" * 64, "fps": 10.0, "history": HISTORY,
        "action_names": ["a0", "a1", "a2"], "split_hash": place.split.hash,
    }  # fmt: skip
    for row in file.to_pylist():
        assert row["frame_index"] >= HISTORY - 1
        assert row["episode_index"] - 10 in place.split.folds[row["fold"]].test
    test = place.split.folds[0].test
    assert write_anchors(path, place.demos, place.split, HISTORY, test) < count
    assert set(pq.read_table(path)["episode_index"].to_pylist()) == {10 + e for e in test}
    assert [p.name for p in tmp_path.iterdir()] == ["a.parquet"]

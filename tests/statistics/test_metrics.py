"""Errors and metrics against loops over single numbers, and against what the notebook found."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.config import BenchmarkConfig, Config, DatasetConfig
from pipeline.experiment import from_config
from pipeline.folds import PolicyTask, predict_folds, train_folds
from pipeline.split import make_split
from pipeline.statistics.intervals import estimate_mean
from pipeline.statistics.metrics import episode_errors, load_errors, save_errors, score_task, summarise
from pipeline.types import ACTION, STATE, Fold, Predictions, Split
from pipeline.windows import make_windows
from tests.hand_made import STATE_ONLY, demonstrations, random_walks, semantics

SPLIT = Split((Fold((0, 2, 3), (1, 4)),), 0, "hash")


def predicted(demos, *, seeds: int = 2, chunk: int = 4, off: float = 1.0, seed: int = 0) -> Predictions:
    """Noise around what was recorded, at every held-out anchor."""
    generator = np.random.default_rng(seed)
    windows = make_windows(
        demos, semantics(demos), STATE_ONLY, (1, 4), statistics_episodes=(0, 2, 3), protocol="strict", history=3,
        chunk=chunk,
    )  # fmt: skip
    recorded, mask = windows.targets()
    actions = recorded + off * generator.normal(size=(seeds, *recorded.shape))
    actions[:, ~mask] = 1e9
    folds = np.zeros(len(windows), np.int64)
    return Predictions("p", "state", tuple(range(seeds)), windows.anchors, folds, actions.astype(np.float32))


def slow_errors(predictions, demos):
    """{(seed, episode, horizon): [error [A], …]}, one number at a time."""
    found = {}
    for position, anchor in enumerate(predictions.anchors):
        episode = int(demos.episode_of_frame[anchor])
        for seed in range(predictions.actions.shape[0]):
            for horizon in range(predictions.actions.shape[2]):
                if anchor + horizon < demos.episode(episode).stop:
                    error = predictions.actions[seed, position, horizon] - demos.columns[ACTION][anchor + horizon]
                    found.setdefault((seed, episode, horizon), []).append(error.astype(float))
    return found


def test_sums_agree_with_a_loop():
    demos = random_walks()
    predictions = predicted(demos)
    errors = episode_errors(predictions, demos, semantics(demos), SPLIT, protocol="strict")
    assert errors.episodes.tolist() == [1, 4]
    for (seed, episode, horizon), listed in slow_errors(predictions, demos).items():
        row = errors.episodes.tolist().index(episode)
        assert errors.anchors[row, horizon] == len(listed)
        np.testing.assert_allclose(errors.absolute[seed, row, horizon], np.abs(listed).sum(axis=0), rtol=1e-5)
        np.testing.assert_allclose(errors.squared[seed, row, horizon], np.square(listed).sum(axis=0), rtol=1e-5)
        norms = [np.sqrt((error**2).sum()) for error in listed]
        np.testing.assert_allclose(errors.l2[seed, row, horizon], sum(norms), rtol=1e-5)
    np.testing.assert_allclose(errors.scale[0], demos.columns[ACTION][train_frames(demos)].std(axis=0), rtol=1e-5)


def train_frames(demos):
    return np.flatnonzero(np.isin(demos.episode_of_frame, SPLIT.folds[0].train))


@pytest.mark.parametrize("protocol", ["strict", "notebook"])
def test_metrics_agree_with_a_loop(protocol):
    demos = random_walks(fps=2.0)
    predictions = predicted(demos)
    errors = episode_errors(predictions, demos, semantics(demos), SPLIT, protocol=protocol)
    found = summarise(errors, protocol=protocol, fps=2.0, chunk=4)
    slow = slow_errors(predictions, demos)

    def mean(horizon, what):
        by_seed = []
        for seed in range(2):
            lists = [[what(e) for e in slow[seed, episode, horizon]] for episode in (1, 4)]
            pooled = np.concatenate(lists).mean()
            by_seed.append(np.mean([np.mean(values) for values in lists]) if protocol == "strict" else pooled)
        return np.mean(by_seed)

    def size(error):
        return np.abs(error).mean()

    assert found["first_step_mae"] == pytest.approx(mean(0, size), rel=1e-5)
    assert found["at_one_second_mae"] == pytest.approx(mean(2, size), rel=1e-5)
    assert found["first_step_rmse"] == pytest.approx(np.sqrt(mean(0, lambda e: (e**2).mean())), rel=1e-5)
    assert found["first_step_l2"] == pytest.approx(mean(0, np.linalg.norm), rel=1e-5)
    np.testing.assert_allclose(found["error_by_horizon"], [mean(h, size) for h in range(4)], rtol=1e-5)
    np.testing.assert_allclose(found["error_by_joint"], [mean(0, lambda e, a=a: abs(e[a])) for a in (0, 1)], rtol=1e-5)
    if protocol == "strict":
        assert found["whole_chunk_mae"] == pytest.approx(np.mean(found["error_by_horizon"]))
    scale = demos.columns[ACTION][train_frames(demos)].std(axis=0)
    assert found["scaled"] == pytest.approx(np.mean(found["error_by_joint"] / scale), rel=1e-5)


def test_an_episode_counts_once_under_strict_and_by_its_frames_under_notebook():
    demos = random_walks((20, 13, 20, 20, 103))
    predictions = predicted(demos, seeds=1, chunk=1, off=0.0)
    short = np.isin(predictions.anchors, np.arange(demos.frames)[demos.episode(1)])
    actions = predictions.actions.copy()
    actions[0, short] += 1.0
    predictions = replace(predictions, actions=actions)
    found = {
        protocol: summarise(
            episode_errors(predictions, demos, semantics(demos), SPLIT, protocol=protocol),
            protocol=protocol, fps=10, chunk=1,
        )["first_step_mae"]
        for protocol in ("strict", "notebook")
    }  # fmt: skip
    assert found["strict"] == pytest.approx(1 / 2, rel=1e-4)
    assert found["notebook"] == pytest.approx(11 / (11 + 101), rel=1e-4)


def test_errors_of_angles_are_wrapped_but_not_in_the_notebook():
    angle = np.full((12, 1), 0.1)
    demos = demonstrations({STATE: angle, ACTION: angle}, (6, 6))
    meaning = semantics(demos, circular={ACTION: (True,)})
    split = Split((Fold((0,), (1,)),), 0, "hash")
    actions = np.full((1, 4, 1, 1), 2 * np.pi, np.float32)
    predictions = Predictions("p", "state", (0,), np.arange(8, 12), np.zeros(4, np.int64), actions)
    for protocol, expected in (("strict", 0.1), ("notebook", 2 * np.pi - 0.1)):
        errors = episode_errors(predictions, demos, meaning, split, protocol=protocol)
        assert errors.absolute.sum() / 4 == pytest.approx(expected, rel=1e-4)


def test_a_chunk_that_ends_before_a_second_has_no_error_there():
    demos = random_walks()
    errors = episode_errors(predicted(demos), demos, semantics(demos), SPLIT, protocol="strict")
    found = summarise(errors, protocol="strict", fps=4, chunk=4)
    assert found["at_one_second_mae"] is None
    assert found["interval"]["at_one_second_mae"] is None
    assert summarise(errors, protocol="strict", fps=3.2, chunk=4)["at_one_second_mae"] is not None
    assert summarise(errors, protocol="strict", fps=3, chunk=None)["whole_chunk_mae"] is None


def test_columns_that_do_not_move_are_left_out_of_scaled():
    walks = random_walks()
    still = np.hstack([walks.columns[ACTION], np.full((walks.frames, 1), 4.0)])
    demos = demonstrations({STATE: walks.columns[STATE], ACTION: still}, walks.lengths)
    errors = episode_errors(predicted(demos), demos, semantics(demos), SPLIT, protocol="strict")
    assert np.isnan(errors.scale[:, 2]).all()
    found = summarise(errors, protocol="strict", fps=10, chunk=4)
    assert np.isnan(found["scaled_by_joint"][2])
    assert found["scaled"] == pytest.approx(found["scaled_by_joint"][:2].mean())


def test_a_prediction_that_is_no_number_shows():
    demos = random_walks()
    predictions = predicted(demos)
    predictions.actions[0, 0, 0, 0] = np.nan
    errors = episode_errors(predictions, demos, semantics(demos), SPLIT, protocol="strict")
    found = summarise(errors, protocol="strict", fps=10, chunk=4)
    assert np.isnan(found["first_step_mae"])
    assert np.isnan(found["whole_chunk_mae"])


def test_stored_errors_are_the_same_errors(tmp_path):
    demos = random_walks()
    errors = episode_errors(predicted(demos), demos, semantics(demos), SPLIT, protocol="strict")
    save_errors(errors, tmp_path / "errors.safetensors")
    for name, array in vars(load_errors(tmp_path / "errors.safetensors")).items():
        np.testing.assert_array_equal(array, getattr(errors, name))


def task_of(demos, variant: str, protocol: str = "strict", folds="auto", **benchmark) -> PolicyTask:
    settings = BenchmarkConfig(**{"protocol": protocol, "seeds": 2, "steps": 5, "threads": 1} | benchmark)
    config = Config(benchmark=settings, datasets={"x": DatasetConfig(source="/x")})
    experiment = from_config(config, "x", Path("/"))
    split = make_split(demos, protocol=protocol, folds=folds, test_share=0.2, seed=0, has_simulator=False)
    (chosen,) = (v for v in experiment.variants if v.name == variant)
    return PolicyTask(demos, semantics(demos), split, STATE_ONLY, chosen, experiment)


def scored(task: PolicyTask, folder: Path):
    (folder / "unfinished").mkdir()
    train_folds(task, folder / "trained", folder / "unfinished")
    predictions, _ = predict_folds(task, folder / "trained")
    return score_task(task, predictions), predictions


def test_hold_still_is_exactly_as_good_as_hold_still(tmp_path):
    score, _ = scored(task_of(random_walks((40,) * 6), "hold_still"), tmp_path)
    assert score.metrics["vs_hold_still"] == 1.0
    assert score.metrics["hold_still_by_horizon"] == score.metrics["error_by_horizon"]
    assert score.metrics["ensembled_first_step_mae"] is None
    assert len(score.seed_metrics) == 1


def test_every_policy_is_held_against_hold_still_on_its_own_anchors(tmp_path):
    demos = random_walks((60,) * 6)
    score, predictions = scored(task_of(demos, "mlp_k04"), tmp_path)
    metrics = score.metrics
    assert sorted(score.errors.episodes.tolist()) == list(range(6))
    still = np.abs(demos.columns[STATE] - demos.columns[ACTION])[predictions.anchors]
    assert metrics["hold_still_by_horizon"][0] == pytest.approx(still.mean(), rel=1e-4)
    assert metrics["vs_hold_still"] == pytest.approx(metrics["hold_still_by_horizon"][0] / metrics["first_step_mae"])
    assert [len(metrics[name]) for name in ("error_by_horizon", "hold_still_by_horizon")] == [4, 4]
    assert set(metrics["error_by_joint"]) == {"a0", "a1"}
    assert metrics["ensembled_first_step_mae"] > 0
    by_seed = [seed["first_step_mae"] for seed in score.seed_metrics]
    assert np.mean(by_seed) == pytest.approx(metrics["first_step_mae"])
    low, high = metrics["interval"]["first_step_mae"]
    assert low < metrics["first_step_mae"] < high
    assert metrics["interval_method"] == "bootstrap-t"
    errors = score.errors
    mean = estimate_mean(errors.absolute[:, :, 0].mean(axis=2) / errors.anchors[:, 0], None, errors.fold)
    assert (low, high) == pytest.approx(mean.interval)
    assert mean.seed_df == len(np.unique(errors.fold)) == 5, "two seeds, five folds"


@pytest.mark.parametrize(("variant", "windows", "own"), [("mlp_k01", 2_960, 2.5497), ("mlp_k32", 2_650, 2.8033)])
def test_the_notebook_s_numbers_on_a_real_arm(shared_data, tmp_path, variant, windows, own):
    from pipeline.lerobot_format.read import read_dataset

    demos = read_dataset(shared_data / "so101_pick_place_tape", name="tape")
    score, predictions = scored(task_of(demos, variant, "notebook", seeds=1, steps=1), tmp_path)
    assert predictions.actions.shape[1] == windows
    assert score.metrics["hold_still_by_horizon"][0] == pytest.approx(own, abs=5e-5)
    assert score.metrics["vs_hold_still"] * score.metrics["first_step_mae"] == pytest.approx(2.5497, abs=5e-5)


def test_under_strict_every_policy_has_the_same_anchors(tmp_path):
    demos = random_walks((50, 45, 60, 70, 41))
    anchors = []
    for variant in ("hold_still", "mlp_k01", "mlp_k16", "notebook_pusht"):
        folder = tmp_path / variant
        folder.mkdir()
        anchors.append(scored(task_of(demos, variant), folder)[1].anchors.tolist())
    assert all(other == anchors[0] for other in anchors)

"""Training on nested parts of the training episodes."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.config import parse_config
from pipeline.curve import (
    Subset,
    curve_sizes,
    nested_subsets,
    predict_subset,
    require_learning,
    subset_task,
    train_subsets,
)
from pipeline.errors import ConfigError, NotApplicableError
from pipeline.experiment import Choices, Variant, resolve_target
from pipeline.folds import PolicyTask
from pipeline.lerobot_format.quality import resolve_semantics
from pipeline.predict import predict_policy
from pipeline.statistics.curve_reading import keep_errors
from pipeline.statistics.metrics import load_errors
from pipeline.train import train_policy
from pipeline.types import Fold, ObservationSet, Split
from tests.hand_made import changed
from tests.makers import tiny_demonstrations


def split_of(train: int, folds: int = 1) -> Split:
    tests = [tuple(range(f * 5, f * 5 + 5)) for f in range(folds)]
    everything = range(train + 5)
    return Split(tuple(Fold(tuple(e for e in everything if e not in t), t) for t in tests), 3, "hash")


def task_of(demos, split: Split, method: str = "mlp", steps: int = 4) -> PolicyTask:
    raw = {
        "benchmark": {"seeds": 2, "steps": steps, "threads": 1},
        "policies": {"mlp": {"method": "mlp", "chunks": [1]}},
    }
    config = parse_config({**raw, "datasets": {"tiny": {"source": "."}}}, "test")
    experiment = resolve_target("tiny", config, Path.cwd(), Choices(), {}).experiment
    variant = next(v for v in experiment.variants if v.method == method)
    semantics = resolve_semantics(demos, kind="position", circular=None)
    return PolicyTask(demos, semantics, split, ObservationSet("state", ("observation.state",)), variant, experiment)


@pytest.mark.parametrize(
    ("train", "expected"), [(8, [4]), (9, [4]), (16, [4, 8]), (40, [5, 10, 20]), (164, [20, 41, 82]), (24, [4, 6, 12])]
)
def test_sizes_halve_down_to_four(train, expected):
    assert curve_sizes(split_of(train)) == expected


def test_sizes_that_are_asked_for():
    assert curve_sizes(split_of(40), [20, 10, 20, 40]) == [10, 20], "sorted, each once; the full size is there anyway"


@pytest.mark.parametrize(
    ("train", "asked", "kind", "words"),
    [
        (7, [], NotApplicableError, "needs at least 8 training episodes, and here there are 7"),
        (40, [10, 41], ConfigError, "--sizes has 41, and there are 40 training episodes"),
        (40, [0], ConfigError, "Sizes lie between 1 and 40"),
        (40, [40], ConfigError, "needs a smaller size, for example 20"),
    ],
)
def test_sizes_that_make_no_curve(train, asked, kind, words):
    with pytest.raises(kind, match=words):
        curve_sizes(split_of(train), asked)


def test_baselines_that_do_not_learn_have_no_curve():
    for name in ("hold_still", "mean_action", "constant_velocity"):
        with pytest.raises(NotApplicableError, match=f"'{name}' is a baseline that does not learn"):
            require_learning(Variant(name, name, name, None))
    require_learning(Variant("nearest_neighbour", "nearest_neighbour", "nearest_neighbour", None))


@pytest.mark.parametrize("folds", [1, 3])
def test_subsets_are_nested_seeded_and_never_held_out(folds):
    split = split_of(30, folds)
    subsets = nested_subsets(split, [4, 8, 16])
    assert len(subsets) == 3 * (3 if folds == 1 else folds)
    assert subsets == nested_subsets(split, [16, 8, 4])
    by_place = {(s.fold, s.order, s.size): set(s.episodes) for s in subsets}
    for (fold, order, size), episodes in by_place.items():
        assert episodes <= set(split.folds[fold].train)
        if size < 16:
            assert episodes < by_place[fold, order, 2 * size]
    assert len({s.episodes for s in subsets if s.size == 4}) > 1, "orders and folds differ"
    assert {s for s in subsets if s.size == 8} <= set(nested_subsets(split, [8])), (
        "a size does not depend on the others"
    )


def test_a_subset_is_what_it_would_be_if_nothing_else_had_been_recorded():
    """Scaling and weights come from the subset alone: change every other training episode, and its predictions are the same."""
    demos, split = tiny_demonstrations(15, 20), split_of(10)
    subset = nested_subsets(split, [4])[0]
    others = [e for e in split.folds[0].train if e not in subset.episodes]
    found = []
    for data in (demos, changed(demos, others)):
        task = subset_task(task_of(data, split), subset)
        found.append(predict_subset(task, subset, None).actions)
    np.testing.assert_array_equal(*found)


def test_a_subset_of_everything_is_the_benchmarks_own_policy():
    demos, split = tiny_demonstrations(15, 20), split_of(10)
    task = task_of(demos, split)
    fold = split.folds[0]
    everything = Subset(0, 0, fold.train)
    windows = task.windows(fold.train, fold)
    trained = train_policy("mlp", windows, seeds=task.seeds, steps=4, threads=1)
    held_out = task.windows(fold.test, fold)
    expected = predict_policy(trained.policy, held_out, name="mlp_k01", observations="state", fold=0, seeds=task.seeds)
    found = predict_subset(subset_task(task, everything), everything, None)
    np.testing.assert_array_equal(found.actions, expected.actions)
    np.testing.assert_array_equal(found.anchors, expected.anchors)


def test_a_stopped_run_goes_on_and_finished_subsets_are_kept(tmp_path):
    task = task_of(tiny_demonstrations(15, 20), split_of(10))

    class Stop(Exception):
        pass

    def stop(done: int, total: int, words: str) -> None:
        assert total == 2 * 3 * 4
        if done > 9:
            raise Stop

    with pytest.raises(Stop):
        train_subsets(task, [4, 5], tmp_path / "kept", keep_errors, stop)
    before = {p.name: p.stat().st_mtime_ns for p in (tmp_path / "kept").glob("fold*")}
    assert len(before) == 2
    train_subsets(task, [4, 5], tmp_path / "kept", keep_errors)
    after = {p.name: p.stat().st_mtime_ns for p in (tmp_path / "kept").iterdir()}
    assert len(after) == 6, "no checkpoint and no draft is left"
    assert before.items() <= after.items()
    train_subsets(task, [4, 5], tmp_path / "whole", keep_errors)
    for path in (tmp_path / "whole").iterdir():
        np.testing.assert_array_equal(load_errors(path).absolute, load_errors(tmp_path / "kept" / path.name).absolute)
        assert load_errors(path).episodes.tolist() == [0, 1, 2, 3, 4], "every size is scored on the same episodes"


def test_the_nearest_neighbour_has_a_curve(tmp_path):
    task = task_of(tiny_demonstrations(15, 20), split_of(10), "nearest_neighbour")
    calls = []
    train_subsets(task, [5], tmp_path, keep_errors, lambda *call: calls.append(call))
    assert [call[:2] for call in calls] == [(1, 3), (2, 3), (3, 3)]
    assert len(list(tmp_path.glob("*.safetensors"))) == 3

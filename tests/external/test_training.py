"""What a policy was trained on, from files that anybody may have written, and which episodes count then."""

import json

import numpy as np
import pytest

from demobench.commands.split import split_json
from pipeline.errors import ConfigError
from pipeline.external.training import EVERY_FOLD, Training, held_out_of, lerobot_training_file, read_training


def written(path, value):
    path.write_text(value if isinstance(value, str) else json.dumps(value))
    return path


def test_a_split_of_ours_with_and_without_the_fold(place, tmp_path):
    whole = read_training(written(tmp_path / "s.json", split_json(place.split, place.demos, None)), place.demos)
    assert whole.by_fold
    assert set(whole.episodes) == set(range(5))
    assert whole.episodes[1] == tuple(10 + e for e in place.split.folds[1].train)
    one = read_training(written(tmp_path / "s.json", split_json(place.split, place.demos, 1)), place.demos)
    assert one.episodes == {EVERY_FOLD: whole.episodes[1]}
    assert one.words == "s.json, fold 1 of 5"


def test_a_list_and_lerobots_own_file(place, tmp_path):
    assert read_training(written(tmp_path / "l.json", [10, 12]), place.demos).episodes == {EVERY_FOLD: (10, 12)}
    config = {"dataset": {"repo_id": "me/tape", "episodes": [11]}, "policy": {}}
    found = read_training(written(tmp_path / "train_config.json", config), place.demos)
    assert found.episodes == {EVERY_FOLD: (11,)}
    assert "trained on me/tape" in found.words
    config["dataset"]["episodes"] = None
    assert read_training(written(tmp_path / "train_config.json", config), place.demos).episodes == {EVERY_FOLD: None}


@pytest.mark.parametrize("inside", ["", "pretrained_model", "checkpoints/last/pretrained_model"])
def test_lerobots_file_is_found_beside_the_weights(tmp_path, inside):
    assert lerobot_training_file(tmp_path) is None
    (tmp_path / inside).mkdir(parents=True, exist_ok=True)
    written(tmp_path / inside / "train_config.json", {})
    assert lerobot_training_file(tmp_path) == tmp_path / inside / "train_config.json"


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("[1, 2", ["is not JSON"]),
        ("[" * 100_000, ["is not JSON"]),
        ({"episodes": [1]}, ["does not say which episodes", "split --format json", "train_config.json"]),
        ([10, "11"], ["must be a list of episode_index numbers"]),
        ([10, True], ["must be a list of episode_index numbers"]),
        ([10, 99], ["episode 99 was trained on", "it has 10 to 15", "another data set"]),
        ({"folds": []}, ["folds must be a list"]),
        ({"folds": [{"train": [10]}]}, ["with train and test"]),
        ({"folds": [{"train": 10, "test": []}]}, ["train of fold 0 must be a list"]),
        ({"fold": 3, "folds": [{"train": [10], "test": [11]}]}, ["fold is 3, and there are folds 0 to 0"]),
        ({"content_hash": "f" * 64, "folds": []}, ["a split of other data", "ffffffffffff", "000000000000"]),
        ({"dataset": {"episodes": "all"}}, ["dataset.episodes must be a list"]),
    ],
)
def test_a_fault_is_named(place, tmp_path, value, expected):
    path = written(tmp_path / "t.json", value)
    with pytest.raises(ConfigError) as caught:
        read_training(path, place.demos)
    for words in (str(path), *expected):
        assert words in str(caught.value)


def test_a_file_that_is_not_there_or_far_too_long(place, tmp_path, monkeypatch):
    with pytest.raises(ConfigError, match="cannot be read"):
        read_training(tmp_path / "absent.json", place.demos)
    monkeypatch.setattr("pipeline.external.training.LARGEST", 10)
    with pytest.raises(ConfigError, match="at most 10"):
        read_training(written(tmp_path / "t.json", list(range(10, 15))), place.demos)


def all_folds(place) -> Training:
    train = {k: tuple(10 + e for e in f.train) for k, f in enumerate(place.split.folds)}
    return Training(train, {k: tuple(10 + e for e in f.test) for k, f in enumerate(place.split.folds)}, "ours")


def test_what_it_was_trained_on_is_left_out(place):
    one = Training({EVERY_FOLD: (10, 11)}, {}, "list")
    found = held_out_of(range(6), None, one, place.demos)
    assert found.episodes.tolist() == [2, 3, 4, 5]
    assert found.train == ((0, 1),)
    assert found.seen is False
    assert "4 episodes that it was not trained on (list); 2 more were predicted but trained on" in found.words


def test_seen_in_training(place):
    for one in (Training({EVERY_FOLD: (10, 11, 12)}, {}, "list"), Training({EVERY_FOLD: None}, {}, "all of them")):
        found = held_out_of([0, 2], None, one, place.demos)
        assert found.seen is True
        assert found.episodes.tolist() == [0, 2]
        assert "seen in training" in found.words


def test_nothing_is_known(place):
    found = held_out_of(range(6), None, None, place.demos)
    assert found.seen is None
    assert found.episodes.tolist() == list(range(6))
    assert "nothing is known about the episodes it was trained on" in found.words
    assert "--trained-on" in found.words


def test_each_fold_has_a_network_of_its_own(place):
    held = np.array([next(k for k, f in enumerate(place.split.folds) if e in f.test) for e in range(6)])
    for column in (held, None):
        found = held_out_of(range(6), column, all_folds(place), place.demos)
        assert found.seen is False
        assert found.fold.tolist() == held.tolist()
        assert found.train == tuple(f.train for f in place.split.folds)
    wrong = (held + 1) % 5
    found = held_out_of(range(6), wrong, all_folds(place), place.demos)
    assert found.seen is True, "every network predicted what it was trained on"


def test_folds_that_fit_nothing(place):
    with pytest.raises(ConfigError, match="have fold 7, and ours has folds 0 to 4"):
        held_out_of([0, 1], np.array([0, 7]), all_folds(place), place.demos)
    partial = Training({0: (10,), 1: (11,)}, {0: (12,), 1: (13,)}, "two")
    with pytest.raises(ConfigError, match="cover episode 10, which no fold of two holds out"):
        held_out_of([0, 2], None, partial, place.demos)

"""Splits: every episode on one side of every fold, drawn by seed, and by nothing that was recorded."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import ConfigError, NotApplicableError
from pipeline.split import load_split, make_split, save_split
from tests.hand_made import changed, random_walks

STRICT = {"protocol": "strict", "folds": "auto", "test_share": 0.2, "seed": 0, "has_simulator": False}


def walks(episodes: int):
    return random_walks((3,) * episodes)


@given(episodes=st.integers(2, 130), folds=st.integers(1, 6), share=st.floats(0.01, 0.99), seed=st.integers(0, 99))
def test_folds_partition_the_episodes(episodes, folds, share, seed):
    folds = min(folds, episodes)
    split = make_split(walks(episodes), **STRICT | {"folds": folds, "test_share": share, "seed": seed})
    held_out = [episode for fold in split.folds for episode in fold.test]
    for fold in split.folds:
        assert fold.train
        assert fold.test
        assert sorted(fold.train + fold.test) == list(range(episodes))
    assert len(held_out) == len(set(held_out))
    if folds > 1:
        assert sorted(held_out) == list(range(episodes))


@pytest.mark.parametrize(
    ("episodes", "has_simulator", "folds"), [(99, False, 5), (100, False, 1), (99, True, 1), (3, False, 3)]
)
def test_auto_holds_every_episode_out_once_on_small_data(episodes, has_simulator, folds):
    split = make_split(walks(episodes), **STRICT | {"has_simulator": has_simulator})
    assert len(split.folds) == folds


def test_one_fold_holds_out_the_share_asked_for():
    split = make_split(walks(200), **STRICT)
    assert [(len(fold.train), len(fold.test)) for fold in split.folds] == [(160, 40)]


@pytest.mark.parametrize(("episodes", "train"), [(206, 164), (50, 40), (12, 9), (2, 1)])
def test_notebook_trains_on_the_first_eighty_percent(episodes, train):
    (fold,) = make_split(walks(episodes), **STRICT | {"protocol": "notebook", "folds": 5}).folds
    assert fold.train == tuple(range(train))
    assert fold.test == tuple(range(train, episodes))


def test_same_seed_same_split_and_another_seed_another():
    first, again, other = (make_split(walks(30), **STRICT | {"seed": seed}) for seed in (1, 1, 2))
    assert first == again
    assert first.hash != other.hash


def test_the_episodes_drawn_do_not_depend_on_what_was_recorded():
    demos = walks(20)
    assert make_split(demos, **STRICT).folds == make_split(changed(demos, range(20)), **STRICT).folds


def test_a_stored_split_is_the_same_split(tmp_path):
    split = make_split(walks(12), **STRICT)
    save_split(split, tmp_path / "split.json")
    assert load_split(tmp_path / "split.json") == split


def test_more_folds_than_episodes_are_refused():
    with pytest.raises(ConfigError, match=r"folds = 9, but .* 4 episodes.*at most 4"):
        make_split(walks(4), **STRICT | {"folds": 9})


def test_one_episode_cannot_be_split():
    with pytest.raises(NotApplicableError, match=r"1 episode\. A benchmark needs two"):
        make_split(walks(1), **STRICT)

"""Rows from elsewhere are compared with ours on the episodes that both hold out."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.external.pairing import (
    SEEN,
    UNKNOWN,
    Rival,
    common_errors,
    compare_common,
    compare_elsewhere,
    on_episodes,
)
from pipeline.statistics.comparisons import compare_errors, judge
from pipeline.types import EpisodeErrors


def errors_of(episodes, level=1.0, seeds=2, horizons=12, fold=None, seed=0) -> EpisodeErrors:
    """Made-up errors; an episode's own are the same whoever else is there."""
    per_episode = []
    for episode in episodes:
        random = np.random.default_rng([seed, episode])
        per_episode.append(level * random.gamma(4.0, 0.25, (seeds, horizons, 2)))
    count = len(episodes)
    absolute = np.stack(per_episode, axis=1) * 10 if count else np.zeros((seeds, 0, horizons, 2))
    return EpisodeErrors(
        np.asarray(episodes, np.int64), np.zeros(count, np.int64) if fold is None else np.asarray(fold, np.int64),
        np.full((count, horizons), 10), absolute, absolute**2, absolute.sum(axis=3), np.ones((count, 2)),
    )  # fmt: skip


@given(st.sets(st.integers(0, 11)), st.sets(st.integers(0, 11)))
def test_common_episodes_are_those_of_both_with_their_own_numbers(of_a, of_b):
    a, b = errors_of(sorted(of_a)), errors_of(sorted(of_b), level=2.0)
    here, there = common_errors(a, b)
    assert here.episodes.tolist() == there.episodes.tolist() == sorted(of_a & of_b)
    for place, episode in enumerate(here.episodes):
        np.testing.assert_array_equal(here.absolute[:, place], a.absolute[:, sorted(of_a).index(episode)])
        np.testing.assert_array_equal(there.l2[:, place], b.l2[:, sorted(of_b).index(episode)])


def test_folds_stay_where_both_have_the_same_and_count_as_one_otherwise():
    a = errors_of(range(6), fold=[0, 0, 1, 1, 2, 2])
    same = errors_of(range(2, 6), fold=[3, 3, 7, 7])
    assert [e.fold.tolist() for e in common_errors(a, same)] == [[0, 0, 1, 1]] * 2
    other = errors_of(range(2, 6), fold=[0, 1, 0, 1])
    assert [e.fold.tolist() for e in common_errors(a, other)] == [[0] * 4] * 2


def test_equal_episodes_give_what_ours_give_each_other():
    a, b = errors_of(range(8)), errors_of(range(8), level=1.5, seed=1)
    ours = compare_errors(a, b, 0, "strict")
    assert compare_common(Rival("a/x", a, True), Rival("b/y", b, True), 0, "strict") == ours


def test_fewer_in_common_is_said_and_below_five_there_is_no_verdict():
    a, b = errors_of(range(3, 12)), errors_of(range(6), level=3.0)
    found = compare_common(Rival("a/x", a, True), Rival("b/y", b, True), 0, "strict")
    (verdict,) = judge([("a/x", "b/y", "first_step_mae", found)])
    assert verdict.word == "cannot tell"
    assert verdict.words == "needs at least 5 episodes that both hold out; there are 3"
    nothing = compare_common(Rival("a/x", errors_of([1]), True), Rival("b/y", errors_of([2]), True), 0, "strict")
    assert nothing == "no episode is held out by both"


def test_what_was_seen_in_training_is_not_compared():
    a, b = errors_of(range(8)), errors_of(range(8))
    why = compare_common(Rival("a/x", a, True, seen=True), Rival("b/y", b, True), 0, "strict")
    assert why == f"a/x was {SEEN}"


def test_each_row_from_elsewhere_is_a_family_of_its_own():
    still, champion = (
        Rival("hold_still/s", errors_of(range(10), 3.0, 1), False),
        Rival("mlp/s", errors_of(range(10), 1.2), True),
    )
    good, unknown = (
        Rival("good/e", errors_of(range(10), seed=4), True),
        Rival("unknown/e", errors_of(range(10), seed=5), True, None),
    )
    alone = compare_elsewhere([good], [still, champion], 10.0, "strict")
    both = compare_elsewhere([good, unknown], [still, champion], 10.0, "strict")
    assert both[: len(alone)] == alone, "another row changes nothing"
    assert {(c.b, c.metric) for c in alone} == {
        (b, metric) for b in ("hold_still/s", "mlp/s") for metric in ("first_step_mae", "at_one_second_mae")
    }
    assert alone[0].word == "better"
    assert all(c.words.endswith(UNKNOWN) for c in both[len(alone) :])
    (seen,) = compare_elsewhere([Rival("seen/e", good.errors, True, True)], [still], 10.0, "strict")
    assert (seen.word, seen.metric) == ("not comparable", "first_step_mae")


@pytest.mark.parametrize("episodes", [[], [2, 5]])
def test_errors_on_some_episodes(episodes):
    found = on_episodes(errors_of(range(6)), np.array(episodes, int))
    assert found.episodes.tolist() == episodes
    assert found.absolute.shape == (2, len(episodes), 12, 2)

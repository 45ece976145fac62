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
    judge_with_elsewhere,
    on_episodes,
)
from pipeline.statistics.comparisons import compare_errors, judge, table_comparisons
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


def a_table(*elsewhere: Rival):
    """Hold-still, a champion and another policy of ours, with rows from elsewhere."""
    ours = [
        Rival("hold_still/s", errors_of(range(10), 3.0, 1), False),
        Rival("mlp/s", errors_of(range(10), 1.2), True),
        Rival("other/s", errors_of(range(10), seed=4), True),
    ]
    rows = [(*one.address.split("/"), one.errors) for one in ours]
    found = table_comparisons(rows, "mlp", 10.0, "strict")
    return found, judge_with_elsewhere(found, ours, elsewhere, 10.0, "strict")


def test_equal_predictions_get_equal_verdicts_in_one_family():
    found, judged = a_table(Rival("sent/e", errors_of(range(10), seed=4), True))
    of = {(c.a, c.b, c.metric): c for c in judged}
    assert [(c.a, c.b, c.metric, c.p) for c in judged[: len(found)]] == [(c.a, c.b, c.metric, c.p) for c in found]
    pairs = [key for key in of if key[0] == "sent/e"]
    assert {(b, metric) for _, b, metric in pairs} == {(c.b, c.metric) for c in found if c.a == "other/s"}
    for _, b, metric in pairs:
        ours, sent = of["other/s", b, metric], of["sent/e", b, metric]
        assert (sent.word, sent.p, sent.p_holm, sent.interval) == (ours.word, ours.p, ours.p_holm, ours.interval)
    family = sum(c.p_holm is not None for c in judged)
    assert min(c.p_holm for c in judged if c.p_holm) == pytest.approx(family * min(c.p for c in judged if c.p))


def test_without_rows_from_elsewhere_nothing_changes():
    found, judged = a_table()
    assert judged == found


def test_what_nobody_knows_is_said_and_what_was_seen_is_not_compared():
    _, judged = a_table(Rival("u/e", errors_of(range(10)), True, None), Rival("s/e", errors_of(range(10)), True, True))
    assert all(c.words.endswith(UNKNOWN) for c in judged if c.a == "u/e")
    assert {(c.word, c.metric) for c in judged if c.a == "s/e"} == {("not comparable", "first_step_mae")}


def test_a_champion_without_a_row_stays_without():
    ours = [Rival("hold_still/s", errors_of(range(10), 3.0, 1), False)]
    found = table_comparisons(
        [("hold_still", "s", ours[0].errors), ("a", "s", errors_of(range(10)))], "gone", 10.0, "strict"
    )
    ours.append(Rival("a/s", errors_of(range(10)), True))
    judged = judge_with_elsewhere(found, ours, [Rival("x/e", errors_of(range(5)), True)], 10.0, "strict")
    assert {c.b for c in judged if c.a == "x/e"} == {"hold_still/s"}
    assert [c.words for c in judged if c.b == "gone"] == ["the champion 'gone' has no up-to-date result here"]


@pytest.mark.parametrize("episodes", [[], [2, 5]])
def test_errors_on_some_episodes(episodes):
    found = on_episodes(errors_of(range(6)), np.array(episodes, int))
    assert found.episodes.tolist() == episodes
    assert found.absolute.shape == (2, len(episodes), 12, 2)

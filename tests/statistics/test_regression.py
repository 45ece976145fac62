"""The gate: what it stops, what it lets pass, and what it does not compare."""

import numpy as np
import pytest

from pipeline.statistics.regression import CONDITIONS, MARGIN, compare_with_before, first_step, what_changed
from pipeline.types import EpisodeErrors

ALIKE = {
    "content_hash": "c" * 64,
    "split": "5" * 64,
    "history": 3,
    "protocol": "strict",
    "budget": "5 seeds × 600 steps",
}


def errors(means: np.ndarray, horizons: int = 1) -> EpisodeErrors:
    """[S, E] means as sums over four anchors an episode, equal at every horizon, of two action columns."""
    seeds, episodes = means.shape
    anchors = np.full((episodes, horizons), 4)
    absolute = np.broadcast_to(4 * means[:, :, None, None], (seeds, episodes, horizons, 2)).copy()
    return EpisodeErrors(
        np.arange(episodes),
        np.arange(episodes) % 2,
        anchors,
        absolute,
        absolute**2,
        absolute[..., 0],
        np.ones((episodes, 2)),
    )


def drawn(seed: int, seeds: int = 5, episodes: int = 20) -> np.ndarray:
    random = np.random.default_rng(seed)
    hard = np.random.default_rng(0).uniform(1, 3, episodes)
    return hard * (1 + 0.01 * random.normal(size=(seeds, episodes)))


def gate(now, before, **more):
    return compare_with_before(errors(now), errors(before), "strict", is_trained=True, **more)


@pytest.mark.parametrize(
    ("times", "word"),
    [(1.0, "cannot tell"), (1.02, "cannot tell"), (1.2, "worse"), (0.98, "cannot tell"), (0.8, "better")],
)
def test_a_fifth_is_seen_and_two_hundredths_are_let_pass(times, word):
    found = gate(times * drawn(1), drawn(2))
    assert found.word == word
    assert found.difference == pytest.approx((times - 1) * 2, abs=0.15)
    assert (found.a, found.b, found.metric) == ("now", "before", "first_step_mae")


def test_what_is_within_the_margin_says_so():
    found = gate((1 + MARGIN / 2) * drawn(1), drawn(2))
    assert found.p < 0.05
    assert found.words.endswith("higher: not surely more than the 5 % that two trainings may differ by")


def test_one_network_is_not_its_method():
    found = gate(2 * drawn(1, seeds=1), drawn(2, seeds=1))
    assert (found.word, found.words) == (
        "cannot tell", "needs at least 2 seeds: one network differs from the next where nothing changed",
    )  # fmt: skip
    baseline = compare_with_before(errors(2 * drawn(1, 1)), errors(drawn(2, 1)), "strict", is_trained=False)
    assert baseline.word == "worse", "a baseline has no seeds"


def test_too_few_episodes_give_no_verdict():
    assert gate(2 * drawn(1, episodes=4), drawn(2, episodes=4)).word == "cannot tell"


def test_other_episodes_are_not_compared():
    found = gate(drawn(1), drawn(2, episodes=19))
    assert (found.word, found.difference) == ("not comparable", None)
    assert found.words.startswith("held-out episodes differ: 20 and 19")


def test_a_prediction_that_is_no_number_is_not_compared():
    broken = drawn(1)
    broken[0, 3] = np.nan
    assert gate(broken, drawn(2)).words == "a prediction is no number"


@pytest.mark.parametrize("name", CONDITIONS)
def test_the_first_condition_that_differs_is_named(name):
    assert what_changed(ALIKE, ALIKE) is None
    other = {"content_hash": "d" * 64, "split": "6" * 64, "history": 1, "protocol": "notebook", "budget": "3 seeds"}
    changed = what_changed(ALIKE | {name: other[name]}, ALIKE)
    assert changed.startswith(f"{CONDITIONS[name]} differs: ")
    assert len(changed) < 90, "hashes are shortened"
    found = gate(3 * drawn(1), drawn(2), changed=changed)
    assert (found.word, found.words) == ("not comparable", changed)


def test_what_is_kept_is_the_first_step():
    kept = first_step(errors(drawn(1), horizons=8))
    assert (kept.absolute.shape, kept.l2.shape, kept.anchors.shape) == ((5, 20, 1, 2), (5, 20, 1), (20, 1))
    assert gate(drawn(1), drawn(2)).difference == pytest.approx(
        compare_with_before(kept, errors(drawn(2)), "strict", is_trained=True).difference
    )

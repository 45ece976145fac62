"""The history of tables: what an entry holds, who is champion after it, and what keeps a verdict from being told twice."""

from datetime import UTC, datetime

import numpy as np
import pytest

from pipeline.errors import StoreError
from pipeline.history import (
    Result,
    append,
    champion_of,
    describe,
    in_words,
    is_news,
    kept_errors,
    read_history,
    regression_words,
)
from pipeline.store import Store
from tests.sinks.making import (
    make_closed_loop,
    make_comparison,
    make_demos,
    make_driven,
    make_row,
    make_semantics,
    make_table,
)
from tests.statistics.test_regression import drawn, errors

DEMOS = make_demos()
WHEN = datetime(2026, 3, 2, 3, 0, 5, tzinfo=UTC)
K01, K04, STILL = "mlp_k01/state", "mlp_k04/state", "hold_still/state"


@pytest.fixture
def store(tmp_path) -> Store:
    return Store(tmp_path / "results").ensure()


def table(*comparisons: dict, **changes) -> dict:
    return make_table(DEMOS, make_semantics(DEMOS)) | {"comparisons": list(comparisons)} | changes


def results(k01: float = 1.0, run: int = 0, budget: str = "2 seeds × 600 steps") -> dict[str, Result]:
    """Fresh results of every row; errors of mlp_k01 so many times as large as usual."""
    return {
        address: Result(f"{address} {run}", address != STILL, budget, errors(times * drawn(seed + 10 * run)))
        for seed, (address, times) in enumerate({K01: k01, K04: 1.2, STILL: 4.0}.items())
    }


def made(
    store: Store, fingerprint: str, of: dict[str, Result], *comparisons: dict, named: str | None = "mlp_k01", **changes
):
    """Describe a table as the asset does, and append it."""
    lines = read_history(store, "tape")
    champion = champion_of(lines, named)
    line, kept = describe(
        table(*comparisons, **changes), fingerprint, lines, named=named, champion=champion, history=3, code="0.1.0 (abc1234)",
        when=WHEN, results=of, before=kept_errors(store, "tape"),
    )  # fmt: skip
    append(store, "tape", line, kept)
    return line


def test_an_entry_says_when_of_what_and_how_good(store):
    line = made(store, "f1", results())
    assert read_history(store, "tape")[0].rows == list(line.rows)
    (read,) = read_history(store, "tape")
    assert (read.when, read.table, read.code) == ("2026-03-02T03:00:05Z", "f1", "0.1.0 (abc1234)")
    assert (read.revision, read.content_hash) == (DEMOS.revision, DEMOS.content_hash)
    assert read.rows[1] == {
        "policy": "mlp_k04", "observations": "state", "method": "mlp", "seeds": 2, "first_step_mae": 5.5,
        "vs_hold_still": 20 / 5.5, "interval": [pytest.approx(4.95), pytest.approx(6.05)],
        "rollouts": {"n": 50, "success": 0.82, "success_interval": [0.69, 0.91]},
    }  # fmt: skip
    assert (read.champion, read.promotion, read.regression) == (K01, None, None)
    assert in_words(read) == f"The champion is {K01}. There is no earlier result of it to compare with."


def test_entries_are_appended_and_never_changed(store):
    made(store, "f1", results())
    first = store.folder("tape", "benchmark_history", "000001")
    before = {path.name: path.read_bytes() for path in first.iterdir()}
    for run in range(2, 12):
        made(store, f"f{run}", results(run=run))
    assert [line.table for line in read_history(store, "tape")] == [f"f{run}" for run in range(1, 12)]
    assert {path.name: path.read_bytes() for path in first.iterdir()} == before
    assert sum(path.stat().st_size for path in first.iterdir()) < 30_000


def test_a_write_that_fails_leaves_no_entry(store, monkeypatch):
    made(store, "f1", results())
    monkeypatch.setattr(
        Store, "write_made", staticmethod(lambda *_: (_ for _ in ()).throw(OSError(28, "No space left")))
    )
    with pytest.raises(StoreError, match="No space left"):
        made(store, "f2", results(run=1))
    assert [line.table for line in read_history(store, "tape")] == ["f1"]


def test_a_damaged_entry_is_named(store):
    made(store, "f1", results())
    (store.folder("tape", "benchmark_history", "000001") / "made.json").write_text("{")
    with pytest.raises(StoreError, match=r"000001/made.json cannot be read, and who the champion is depends on it"):
        read_history(store, "tape")


# The champion --------------------------------------------------------------------------------------------------------


def test_only_better_changes_the_champion_and_only_from_the_next_table_on(store):
    for word in ("worse", "cannot tell", "not comparable"):
        assert made(store, word, results(), make_comparison(K04, K01, word)).promotion is None
    line = made(store, "f1", results(), make_comparison(K04, K01, "better"))
    assert (line.champion, line.next_champion) == (K01, K04)
    assert line.promotion == {
        "policy": K04, "over": K01, "verdict": "better", "words": "error 78 % lower", "first_step_mae": 5.5, "champions": 4.5,
        "difference": -15.5, "interval": [-17.0, -14.0], "p": 0.001, "p_holm": 0.002,
    }  # fmt: skip
    assert in_words(line).endswith(
        f"From the next table on the champion is {K04}: better than {K01} (error 78 % lower, p 0.002)."
    )
    after = made(store, "f2", results(), make_comparison(K01, K04, "worse"))
    assert (after.champion, after.promotion) == (K04, None)
    assert champion_of(read_history(store, "tape"), "mlp_k01") == K04, "nothing takes it back"


def test_another_champion_in_the_configuration_begins_anew(store):
    made(store, "f1", results(), make_comparison(K04, K01, "better"))
    lines = read_history(store, "tape")
    assert champion_of(lines, "mlp_k01") == K04
    assert champion_of(lines, "hold_still") == "hold_still"
    assert champion_of(lines, None) is None
    assert champion_of([], "mlp_k01") == "mlp_k01"
    made(store, "f2", results(), named="hold_still")
    assert champion_of(read_history(store, "tape"), "mlp_k01") == "mlp_k01", (
        "and so does the first when it is named again"
    )


def test_of_several_that_are_better_the_best_is_promoted(store):
    better = [make_comparison(a, STILL, "better") for a in (K04, K01)]
    assert made(store, "f1", results(), *better, named="hold_still").promotion["policy"] == K01


def test_better_now_and_worse_in_a_second_is_no_promotion(store):
    ahead = make_comparison(K04, K01, "worse", metric="at_one_second_mae")
    assert made(store, "f1", results(), make_comparison(K04, K01, "better"), ahead).promotion is None
    ahead = make_comparison(K04, K01, "cannot tell", metric="at_one_second_mae")
    assert made(store, "f2", results(), make_comparison(K04, K01, "better"), ahead).promotion["policy"] == K04


@pytest.mark.parametrize(("success", "score"), [("worse", "cannot tell"), ("cannot tell", "worse"), ("worse", "worse")])
def test_better_at_the_first_action_and_worse_in_closed_loop_is_no_promotion(store, success, score):
    better, driven = make_comparison(K04, K01, "better"), make_closed_loop(*make_driven(K04, K01, success, score))
    assert made(store, "f1", results(), better, closed_loop=driven).promotion is None
    driven = make_closed_loop(*make_driven(K04, K01, "cannot tell", "better"))
    assert made(store, "f2", results(), better, closed_loop=driven).promotion["policy"] == K04


def test_one_network_is_not_promoted_over_a_method(store):
    rows = [row | {"seeds": 1} if row["policy"] == "mlp_k04" else row for row in table()["policies"]]
    assert made(store, "f1", results(), make_comparison(K04, K01, "better"), policies=rows).promotion is None


def test_what_was_predicted_elsewhere_cannot_be_trained_anew_and_is_not_promoted(store):
    rows = [*table()["policies"], make_row("my_act", "external", DEMOS, error=1.0)]
    better = make_comparison("my_act/state", K01, "better")
    assert made(store, "f1", results(), better, policies=rows).promotion is None


def test_a_baseline_that_is_better_is_not_promoted(store):
    assert made(store, "f1", results(), make_comparison(STILL, K01, "better")).promotion is None


def test_a_champion_that_has_no_row_or_several_is_kept_by_name(store):
    line = made(store, "f1", results(), named="mlp_k16")
    assert (line.champion, line.kept, line.regression) == ("mlp_k16", None, None)
    rows = [*table()["policies"], make_row("mlp_k01", "mlp", DEMOS, error=1.0, observations="pose")]
    assert made(store, "f2", results(), policies=rows).champion == "mlp_k01"


def test_without_a_champion_nothing_is_watched(store):
    line = made(store, "f1", results(), named=None)
    assert not line.got_worse
    assert in_words(line).startswith("No champion is named, so nothing is watched")
    assert kept_errors(store, "tape") == {}


# The regression gate -------------------------------------------------------------------------------------------------


def test_a_champion_that_got_worse_is_told_once(store):
    made(store, "f1", results())
    line = made(store, "f2", results(k01=1.3, run=1))
    assert line.got_worse
    assert line.regression["difference"] == pytest.approx(0.6, abs=0.1)
    assert regression_words(line).startswith(
        "It got worse than the result of 2026-03-02 (0.1.0 (abc1234)): error 30 % higher"
    )
    lines = read_history(store, "tape")
    assert is_news(line, lines[:1])
    again = made(store, "f3", results(k01=1.3, run=1))
    assert again.got_worse, "a table made again from the same results still says so"
    assert not is_news(again, lines)
    assert not made(store, "f4", results(run=2)).got_worse


def test_the_same_result_is_compared_with_the_one_before_it(store):
    made(store, "f1", results())
    assert made(store, "f2", results()).regression is None, "it was not trained anew"
    assert made(store, "f3", results(run=1)).regression["word"] == "cannot tell"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"protocol": "notebook"}, "protocol differs: strict before, notebook now"),
        ({"split": {"hash": "cd34" * 16, "folds": []}}, "split differs: ab12ab12ab12 before, cd34cd34cd34 now"),
        (
            {"dataset": table()["dataset"] | {"content_hash": "f" * 64}},
            "data hash differs: c0ffee000000 before, ffffffffffff now",
        ),
    ],
)
def test_other_conditions_are_not_comparable_and_the_first_is_named(store, changes, words):
    made(store, "f1", results())
    line = made(store, "f2", results(k01=3.0, run=1), **changes)
    assert (line.regression["word"], line.regression["words"]) == ("not comparable", words)
    assert not line.got_worse
    assert regression_words(line).startswith("It cannot be compared with the result of 2026-03-02")


def test_another_budget_is_not_comparable(store):
    made(store, "f1", results())
    line = made(store, "f2", results(k01=3.0, run=1, budget="2 seeds × 30 steps"))
    assert line.regression["words"] == "budget differs: 2 seeds × 600 steps before, 2 seeds × 30 steps now"


def test_after_a_promotion_the_new_champion_is_watched(store):
    made(store, "f1", results(), make_comparison(K04, K01, "better"))
    np.testing.assert_array_equal(kept_errors(store, "tape")[0].absolute, results()[K04].errors.absolute)
    line = made(store, "f2", results(k01=9.0, run=1))
    assert (line.champion, line.regression["a"], line.regression["word"]) == (K04, K04, "cannot tell")

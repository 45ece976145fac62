"""What is said of a table: only what a comparison or a floor of the table carries."""

import pytest

from pipeline.sinks.findings import (
    BEST,
    DRIVEN_ALONE,
    Command,
    Strong,
    ahead,
    answer,
    answers,
    champion,
    deadline_words,
    driven_family_words,
    driven_word,
    driven_words,
    family,
    gap_parts,
    gap_words,
    interval_words,
    limit_words,
    name_in,
    safety_words,
    stopped_words,
    success_words,
    without_floor,
)

from .making import (
    make_bracket,
    make_closed_loop,
    make_comparison,
    make_driven,
    make_floor,
    make_gap,
    make_refusal,
    make_row,
    make_verdict,
)  # fmt: skip


def said(table) -> list[str]:
    """Every sentence, question by question, closed loop last: `answer` has it first where somebody succeeds."""
    found = answers(table)
    last = found.pop(DRIVEN_ALONE, [])
    return ["".join(sentence) for sentence in (*(one for sentences in found.values() for one in sentences), *last)]


def test_success_comes_first_and_failure_last(table):
    assert next(iter(answers(table))) == DRIVEN_ALONE
    assert "".join(answer(table)[0]).startswith("In closed loop mlp_k04 seeing state succeeds most often: ")
    for row in table["policies"]:
        if row["rollouts"]:
            row["rollouts"] |= {"success": 0.0, "successes": 0}
    assert next(reversed(answers(table))) == DRIVEN_ALONE
    assert "".join(answer(table)[0]).startswith("Closest to the demonstrations is ")


def test_the_answer_of_a_benchmark(table):
    assert said(table) == [
        "Closest to the demonstrations is mlp_k01 seeing state: in 2 episodes that it never saw its next action is off by 4.50 px "
        "on average [4.05, 4.95] (first-step MAE). It is better than hold-still, whose error is 4.44 times as large.",
        "Whether it is better than the second, mlp_k04, is not tested here; demobench compare small/mlp_k01/state "
        "small/mlp_k04/state tells.",
        "It is 1.62 px RMSE above the floor [1.25, 2.00]: for policies seeing state that is 4.00 px RMSE at the first action.",
        "In closed loop mlp_k04 seeing state succeeds most often: 41 of 50 (69–91 %).",
    ]
    closest, second, *_ = answers(table)[BEST]
    assert Strong("better than hold-still") in closest
    assert Command("demobench compare small/mlp_k01/state small/mlp_k04/state") in second


def test_a_mean_over_columns_of_different_units_has_none(table):
    table["dataset"]["action_units"] = ["deg", "%"]
    assert "its next action is off by 4.50 on average over columns of different units [4.05, 4.95]" in said(table)[0]


def test_answers_stand_under_the_questions_that_they_answer(table):
    assert {question: len(sentences) for question, sentences in answers(table).items()} == {
        "Which policy is best?": 2, "How good can it get?": 1, "How does it do by itself?": 1,
    }  # fmt: skip
    table |= {"policies": table["policies"][:1], "brackets": []}
    table["policies"][0] |= {"above_floor": [], "first_step_mae": None}
    assert answers(table) == {}


def test_where_nobody_succeeds_only_scores_are_compared(table):
    table["policies"][0]["rollouts"] = table["policies"][1]["rollouts"] | {"success": 0.0, "score": 0.1}
    table["closed_loop"] = make_closed_loop(*make_driven("mlp_k01/state", "mlp_k04/state", "cannot tell", "worse"))
    assert said(table)[-1].startswith("Against it in closed loop – success: cannot tell: mlp_k01")
    table["policies"][1]["rollouts"]["success"] = 0.0
    assert said(table)[-1] == "Against it in closed loop – score: worse: mlp_k01."


@pytest.mark.parametrize("success", [0.06, 0.0])
def test_where_a_task_has_stages_they_are_counted(table, success):
    """Those of the policy that succeeds most often, or comes closest."""
    stages = {"stages": ["reached", "grasped", "placed"], "stage_counts": [48, 17, round(50 * success)]}
    next(row for row in table["policies"] if row["rollouts"])["rollouts"] |= {"success": success} | stages
    assert said(table)[-1].endswith(f". Of its 50 roll-outs: reached 48, grasped 17, placed {round(50 * success)}.")


def test_how_chunks_were_carried_out_is_said_where_it_is_not_as_usual(table):
    rolled = next(row for row in table["policies"] if row["rollouts"])["rollouts"]
    rolled["execution"] = {"execute": 4, "ensemble": False, "delay": 0}
    assert driven_words(table) == []
    rolled["execution"] = {"execute": 2, "ensemble": False, "delay": 1}
    assert driven_words(table) == ["roll-outs of mlp_k04: 2 actions of each chunk, 1 frame late"]
    table["policies"][0]["rollouts"] = rolled
    assert driven_words(table) == ["roll-outs of mlp_k01, mlp_k04: 2 actions of each chunk, 1 frame late"]


def test_what_the_safety_layer_did_and_why_there_are_no_roll_outs_is_said(table):
    rolled = next(row for row in table["policies"] if row["rollouts"])["rollouts"]
    rolled |= {"interventions": 0, "intervened": 0.0, "stopped": 0, "stopped_not_finite": 0}
    assert driven_words(table) == safety_words(table) == stopped_words(table) == []
    rolled |= {
        "interventions": 30,
        "intervened": 0.0123,
        "mean_intervention": 0.0345,
        "stopped": 4,
        "stopped_not_finite": 3,
    }
    table["policies"][0]["no_rollouts"] = "it does not fit"
    stopped = "4 of 50 episodes stopped, 3 for actions that are not finite"
    assert safety_words(table) == [
        "the safety layer stepped in (it changed an action by more than 1 % of a column's range): mlp_k04 in 1.2 % of the frames, "
        f"by 3.5 % on average ({stopped})",
    ]
    assert stopped_words(table) == [f"the safety layer stopped episodes: mlp_k04 {stopped}"]
    assert driven_words(table) == ["no roll-outs of mlp_k01: it does not fit"]


@pytest.mark.parametrize(
    ("delay", "words"), [(0, "it is asked every 100 ms"), (2, "roll-outs reckon with 2 frames, 100 ms")]
)
def test_who_misses_a_deadline_is_said_with_the_deadline(table, delay, words):
    execution = {"execute": 2, "ensemble": False, "delay": delay}
    assert deadline_words(table) == []
    table["policies"][1] |= {
        "latency_p99_ms": 250.0, "deadline_ms": 100.0, "misses_deadline": True, "execution": execution,
    }  # fmt: skip
    (said,) = deadline_words(table)
    late = "one call in a hundred of mlp_k04 takes 250 ms or more on this machine"
    assert said == f"{late}, and {words}: it misses its deadline"


def test_nothing_is_called_better_without_a_test(table):
    table["comparisons"] = []
    for row in table["policies"]:
        row["verdict"] = make_verdict()
    first = said(table)[0]
    assert first.endswith("its next action is off by 4.50 px on average [4.05, 4.95] (first-step MAE). ")


@pytest.mark.parametrize(
    ("word", "words"),
    [
        ("cannot tell", "It cannot be told from hold-still: about 90 held-out episodes would do."),
        ("not comparable", "It cannot be compared with hold-still: about 90 held-out episodes would do."),
    ],
)
def test_a_doubt_is_said_with_its_reason(table, word, words):
    reason = "about 90 held-out episodes would do"
    table["comparisons"][0] = make_comparison("mlp_k01/state", "hold_still/state", word, words=reason)
    assert said(table)[0].endswith(words)


def test_one_seed_is_one_network(table):
    table["policies"][0]["seeds"] = 1
    assert said(table)[0].endswith("With one seed this is about one network, not its method.")


def test_those_that_are_no_better_than_hold_still_are_named(demos, table):
    for place, word in enumerate(("cannot tell", "worse", "worse")):
        verdict = make_verdict(vs_hold_still=word)
        table["policies"].append(make_row(f"act_k{place}", "act", demos, error=30.0 + place, verdict=verdict))
    assert (
        "At the first step act_k0 cannot be told from hold-still. Worse than hold-still at the first step: act_k1 and act_k2."
    ) in said(table)


def test_long_lists_are_cut(demos, table):
    verdict = make_verdict(vs_hold_still="worse")
    table["policies"] += [make_row(f"p{i}", "act", demos, error=30.0 + i, verdict=verdict) for i in range(9)]
    assert "Worse than hold-still at the first step: p0, p1, p2 and 6 more." in said(table)


@pytest.mark.parametrize(
    ("a", "b", "word", "expected"),
    [
        ("mlp_k01/state", "mlp_k04/state", "better", "It is better than the second, mlp_k04."),
        ("mlp_k04/state", "mlp_k01/state", "worse", "It is better than the second, mlp_k04."),
        ("mlp_k04/state", "mlp_k01/state", "cannot tell", "It cannot be told from the second, mlp_k04: the reason."),
    ],
)
def test_the_second_is_told_apart_only_by_a_comparison(table, a, b, word, expected):
    table["comparisons"].append(make_comparison(a, b, word, words="the reason"))
    assert said(table)[1] == expected


def test_the_champion(table):
    assert champion(table) is None
    table["comparisons"].append(make_comparison("mlp_k04/state", "mlp_k01/state", "worse"))
    table["policies"][1]["verdict"] = make_verdict(vs_hold_still="better", vs_champion="worse")
    assert champion(table) == "mlp_k01/state"
    assert "At the first step, against the champion mlp_k01 – worse: mlp_k04." in said(table)


def test_a_champion_that_has_no_row_is_said_to_have_none(table):
    why = "the champion 'gone' has no up-to-date result here"
    for row in table["policies"][:2]:
        row["verdict"] = make_verdict(vs_hold_still="better", vs_champion="not comparable")
        table["comparisons"].append(make_comparison(f"{row['policy']}/state", "gone", "not comparable", words=why))
    assert f"Nothing can be compared with the champion: {why}." in said(table)
    assert family(table) == 2


def test_hold_still_can_be_the_champion(table):
    for row in table["policies"][:2]:
        row["verdict"] = make_verdict(vs_hold_still="better", vs_champion="better")
    assert champion(table) == "hold_still/state"


@pytest.mark.parametrize(
    ("interval", "there"),
    [([1.9, 3.6], "mlp_k01 is above, so there is room for a better one"), ([1.9, 4.6], "mlp_k01 may be there already")],
)
def test_where_squared_errors_have_no_floor_the_absolute_ones_are_asked(table, interval, there):
    for row in table["policies"]:
        row["above_floor"] = []
    mae = make_floor("mae", value=1.6, upper=3.2, interval=interval)
    table["floor"]["estimates"] = [make_refusal(), mae]
    table["brackets"] = [make_bracket(lower=None, words="refused"), make_bracket("mae")]
    (found,) = [sentence for sentence in said(table) if "floor of the MAE" in sentence]
    assert found.startswith("At the first action the floor of the MAE lies between 1.60 and 3.20 px [1.90, ")
    assert found.endswith(f"for policies seeing state: {there}.")
    mae["refused"], mae["value"] = "too far", None
    assert not [sentence for sentence in said(table) if "floor of the MAE" in sentence]


def test_a_refused_floor_is_said_with_what_is_known(table):
    table["policies"][0]["above_floor"] = []
    table["floor"]["estimates"] = [make_refusal()]
    table["brackets"] = [make_bracket(lower=None)]
    known = "No floor of the RMSE can be given at the first action for policies seeing state: the states differ. It is not above"
    assert f"{known} 5.62 px, which mlp_k01 reaches." in said(table)
    table["floor"]["estimates"] = [make_refusal(below=3.3444)]
    assert any("It is not above 3.34 px." in sentence for sentence in said(table))
    assert without_floor(table) == {"state": "the states differ: too much"}
    assert limit_words(table, make_refusal(below=None), None) == ""


def test_a_floor_that_a_policy_refutes_is_withdrawn(table):
    table["brackets"][0] |= {"lower": None, "words": "refused: mlp_k01/state is significantly below the estimate"}
    assert without_floor(table) == {"state": "mlp_k01/state is significantly below the estimate"}


def test_one_sentence_looks_further_ahead(table):
    table["brackets"] += [make_bracket(horizon=10), make_bracket("mae", horizon=10)]
    table["brackets"] += [make_bracket(horizon=5), make_bracket("l2", horizon=12)]
    (found,) = [sentence for sentence in said(table) if "ahead" in sentence]
    assert found == (
        "One second ahead, of policies seeing state, mlp_k01 comes closest to their floor: 5.62 px RMSE, "
        "1.62 px [1.25, 2.00] above the floor."
    )


def test_gaps_in_words():
    assert gap_parts(make_gap()) == ("1.62", "[1.25, 2.00]")
    assert gap_parts(make_gap(gap=0.1, interval=[-0.75, 0.5])) == ("at the floor", "±0.750")
    assert gap_parts(make_gap(gap=-1.0, interval=[-2.0, -0.5])) == ("below", "so the floor is wrong")
    assert gap_parts(make_gap(interval=None)) == ("1.62", "")
    assert gap_words(make_bracket("mae")) == "at most 2.00 above the floor"
    whole = make_bracket("mae", interval=[0.5, make_bracket()["upper"]])
    assert gap_words(whole) == "how far above the floor cannot be told"
    assert gap_words(make_bracket(interval=[-0.75, 0.5])) == "at the floor, within ±0.750"
    assert gap_words(make_bracket(lower=None)) == ""


def test_times_and_names(demos, table):
    assert [ahead(h, 10.0) for h in (0, 10, 7)] == ["first action", "one second ahead", "0.7 s ahead"]
    assert name_in(table, "mlp_k01/state") == "mlp_k01"
    table["policies"].append(make_row("mlp_k01", "mlp", demos, observations="pose"))
    assert name_in(table, "mlp_k01/state") == "mlp_k01 (state)"
    assert name_in(table, "mlp_k01") == "mlp_k01"


def test_how_intervals_were_made(table):
    assert interval_words(table) == "95 % interval: bootstrap-t over held-out episodes and seeds"
    table["split"]["folds"] *= 5
    for row in table["policies"]:
        row |= {"seeds": 1, "interval_method": "t"}
    assert interval_words(table) == "95 % interval: t over held-out episodes, for these folds"
    for row in table["policies"]:
        row |= {"interval": {"first_step_mae": None}, "interval_method": None}
    assert interval_words(table) == "no interval below 5 held-out episodes"


# Closed loop ----------------------------------------------------------------------------------------------------------


def test_verdicts_in_closed_loop_are_against_whoever_does_best_there(table):
    worse = make_driven("mlp_k01/state", "mlp_k04/state", "worse", "worse")
    table["closed_loop"] = make_closed_loop(*worse, *make_driven("hold_still/state", "mlp_k04/state", "worse", "worse"))
    assert said(table)[-1] == "Against it in closed loop – success and score: worse: mlp_k01 and hold_still."
    unsure = make_driven("mlp_k01/state", "mlp_k04/state", "cannot tell", "worse", needs_episodes=120)
    table["closed_loop"] = make_closed_loop(
        *unsure, *make_driven("hold_still/state", "mlp_k04/state", "worse", "worse")
    )
    assert said(table)[-1] == (
        "Against it in closed loop – success: cannot tell: mlp_k01 (it would take about 120 start states); worse: hold_still. "
        "Score: worse: mlp_k01 and hold_still."
    )
    assert driven_family_words(table).startswith(
        "6 comparisons in a family of their own, against mlp_k04, which does best from"
    )
    assert "all pairs count" in driven_family_words(table)
    assert driven_word(table, "mlp_k01/state") == "cannot tell"
    assert driven_word(table, "mlp_k04/state") is None


def test_where_the_best_in_closed_loop_is_not_shown_it_is_named(table):
    worse = make_driven("mlp_k04/state", "act_k16/state", "worse", "worse")
    table["closed_loop"] = make_closed_loop(*worse, *make_driven("gone/state", "act_k16/state", "worse", "worse"))
    assert said(table)[-1] == (
        "Against act_k16, which does best in closed loop of all there is – success and score: worse: mlp_k04."
    )


def test_verdicts_in_closed_loop_are_against_the_champion_where_it_was_rolled_out(table):
    better = make_driven("mlp_k04/state", "mlp_k01/state", "better", "better")
    table["closed_loop"] = make_closed_loop(*better, chosen="champion", family=2)
    assert said(table)[-1] == "In closed loop, against the champion mlp_k01 – success and score: better: mlp_k04."
    assert driven_family_words(table).startswith(
        "2 comparisons in a family of their own, against the champion, mlp_k01;"
    )


def test_nothing_is_said_of_seeds_that_were_not_rolled_out(table):
    rolled = next(row for row in table["policies"] if row["rollouts"])["rollouts"]
    assert success_words(table) == "50 start states, one network (seed 0 of fold 0), Clopper–Pearson 95 %"
    rolled |= {"seeds": 3, "episodes": 150}
    assert success_words(table) == "50 start states × 3 seeds of fold 0, 95 % over both"
    assert said(table)[-1] == (
        "In closed loop mlp_k04 seeing state succeeds most often: 123 of 150 (69–91 %), 3 training seeds from 50 start states."
    )
    for row in table["policies"]:
        row["rollouts"] = None
    assert success_words(table) == ""
    assert driven_family_words(table) == ""

"""The page's sections on floors, sensors and comparisons: every number with its reason, and no wall of them."""

import html
import re

import pytest

from pipeline.sinks.report_sections import (
    MOST_LINES,
    closed_loop_section,
    comparison_section,
    floor_section,
    modes_section,
    sensor_section,
    verdict,
)  # fmt: skip

from .making import (
    make_bracket,
    make_closed_loop,
    make_comparison,
    make_driven,
    make_floor,
    make_refusal,
    make_sensor,
)  # fmt: skip


def words_of(section: str) -> str:
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", section)).split())


def test_floors_are_listed_with_what_lies_between(table):
    text = words_of(floor_section(table, []))
    assert (
        "First action state 3 frames RMSE 4.00 [3.60, 4.40] 5.62 mlp_k01 1.62 px [1.25, 2.00] above the floor" in text
    )
    assert (
        "First action state 3 frames MAE 2.50 to 5.00 [2.25, 5.50] 4.50 mlp_k01 At most 2.00 px above the floor" in text
    )


def test_a_refusal_has_its_reason_and_what_is_known(table):
    table["floor"]["estimates"].append(make_refusal(horizon=10))
    table["brackets"].append(make_bracket(horizon=10, lower=None))
    text = words_of(floor_section(table, []))
    assert (
        "One second ahead state 3 frames RMSE none 5.62 mlp_k01 No floor: the states differ: too much. It is not above"
        in text
    )


def test_a_floor_beyond_every_policy_is_listed(table):
    table["floor"]["estimates"].append(make_floor(horizon=20))
    assert "2 s ahead state 3 frames RMSE 4.00 [3.60, 4.40] – no policy looks so far" in words_of(
        floor_section(table, [])
    )


def test_nothing_measured_no_section(table):
    assert floor_section(table | {"brackets": []}, []) is None
    assert sensor_section(table) is None
    assert comparison_section(table | {"comparisons": []}) is None


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        ({}, "1.50 [1.00, 2.00], 38 % of the floor"),
        ({"value": 0.1, "interval": [-1.0, 1.2]}, "no fall seen 0.100 [-1.00, 1.20]"),
        ({"value": None, "interval": None, "at_least": 3.0}, "at least 3.00"),
    ],
)
def test_what_a_sensor_is_worth(table, more, expected):
    table["sensors"] = [make_sensor(**more)]
    table["floor"]["estimates"].append(make_floor(observations="pose", history=1))
    text = words_of(sensor_section(table))
    assert text.endswith(f"From what is seen, to more First action state 3 frames → pose 1 frame {expected}")


def test_where_nothing_is_known_of_any_sensor_there_is_a_sentence_and_no_table(table):
    unknown = {"value": None, "interval": None}
    table["sensors"] = [make_sensor(**unknown), make_sensor(**unknown, horizon=10)]
    section = sensor_section(table)
    assert "<table" not in section
    assert "Not known for state to pose: no floor could be given" in words_of(section)
    table["sensors"] = [make_sensor(**unknown), make_sensor(horizon=10)]
    assert "not known 1.50" in words_of(sensor_section(table))


def test_modes_say_where_and_when_once(table):
    answer = {
        "observations": "state",
        "horizon": 0,
        "words": "With 'state' at horizon 0 there is no evidence.",
        "refused": None,
    }
    table["modes"] = [answer, answer | {"horizon": 10, "words": None, "refused": "too few episodes"}]
    text = words_of(modes_section(table))
    assert "First action state There is no evidence." in text
    assert text.endswith("One second ahead state Not looked for: too few episodes")


def test_pairs_of_sets_have_one_line_for_all_horizons(table):
    table["sensors"] = [make_sensor(), make_sensor(horizon=10), make_sensor(larger="all", horizon=10)]
    section = sensor_section(table)
    assert section.count("<tr>") == 3
    assert "state 3 frames → all – 1.50" in words_of(section)


def test_comparisons_say_their_family(table):
    doubt = {"difference": 0.25, "interval": [-1.0, 1.5], "p_holm": 0.6, "words": "needs at least 9 held-out episodes"}
    table["comparisons"].append(make_comparison("mlp_k04/state", "mlp_k01/state", "cannot tell", **doubt))
    text = words_of(comparison_section(table))
    assert "3 comparisons in one family; a verdict needs p ≤ 0.05 after Holm's correction." in text
    assert "mlp_k01 first action hold_still ✓ better −15.5 [−17.0, −14.0] 0.002 1.50 Error 78 % lower" in text
    assert "mlp_k01 ? cannot tell +0.250 [−1.00, 1.50] 0.600 1.50 Needs at least 9 held-out episodes" in text


def test_what_cannot_be_compared_says_why(table):
    table["comparisons"] = [make_comparison("a/state", "gone", "not comparable", words="split differs: 1a and 2b")]
    text = words_of(comparison_section(table))
    assert "No difference was tested: a verdict needs at least five held-out episodes." in text
    assert text.endswith("a first action gone – not comparable – – – Split differs: 1a and 2b")


def test_closed_loop_has_a_family_of_its_own(table):
    assert closed_loop_section(table) is None
    table["closed_loop"] = make_closed_loop(*make_driven("mlp_k01/state", "mlp_k04/state", "worse", "cannot tell"))
    text = words_of(closed_loop_section(table))
    assert (
        "6 comparisons in a family of their own, against mlp_k04, which does best from these very start states" in text
    )
    assert "One network of each is compared, its success by McNemar's exact test" in text
    assert "mlp_k01 success mlp_k04 ✗ worse −0.300 [−0.450, −0.150] 0.002 1.50 0.3 lower" in text
    assert "mlp_k01 score mlp_k04 ? cannot tell" in text
    table["policies"][1]["rollouts"]["seeds"] = 3
    assert "Of each start state the mean over training seeds is compared" in words_of(closed_loop_section(table))


def test_long_tables_are_folded_away(table):
    table["comparisons"] *= MOST_LINES
    section = comparison_section(table)
    assert "<details>" in section
    assert "All 24 comparisons: 24 better" in words_of(section)
    table["comparisons"] = table["comparisons"][:MOST_LINES]
    assert "<details>" not in comparison_section(table)


def test_a_verdict_is_a_mark_and_a_word():
    assert verdict("cannot tell") == '<span class="verdict cannot-tell">? cannot tell</span>'
    assert verdict(None) == "–"

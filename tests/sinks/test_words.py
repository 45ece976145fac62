"""Numbers as they are printed."""

import math

import pytest

from pipeline.sinks.words import common_unit, decimals_for, plural, show, show_interval


@pytest.mark.parametrize(
    ("value", "text"),
    [(1.2345, "1.23"), (0.012345, "0.0123"), (123.4, "123"), (12345.6, "12,346"), (0.0, "0.00"), (-2.5, "-2.50")],
)
def test_three_significant_digits(value, text):
    assert show(value) == text


@pytest.mark.parametrize("value", [None, math.nan, math.inf])
def test_what_is_not_a_number_is_a_dash(value):
    assert show(value) == "–"
    assert show_interval([1.0, value]) == ""


def test_a_column_has_the_decimals_of_its_smallest_value():
    assert decimals_for([12.0, 0.5, None, math.nan, 0.0]) == 3
    assert decimals_for([]) == 2
    assert show(12.0, 3) == "12.000"


def test_intervals_units_and_plurals():
    assert show_interval([4.8, 5.441], 2) == "[4.80, 5.44]"
    assert show_interval(None) == ""
    assert [common_unit(u) for u in (["px", "px"], ["px", "rad"], [None, None], [])] == [
        "px",
        "mixed units",
        None,
        None,
    ]
    assert [plural(1, "seed"), plural(1200, "seed")] == ["1 seed", "1,200 seeds"]

"""Colours can be read on their ground, and belong to a policy whatever else is drawn."""

import itertools

import pytest

from pipeline.sinks.page_style import PAGE
from pipeline.sinks.palette import GRID, TRAINED, all_colours, dash_of, is_baseline, policy_colours


def luminance(colour: str) -> float:
    """Relative luminance as WCAG 2.1 defines it."""
    channels = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one: str, other: str) -> float:
    low, high = sorted([luminance(one), luminance(other)])
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("colour", [colour for colour in all_colours() if colour != GRID])
def test_every_mark_stands_out_on_light_and_dark_ground(colour):
    assert contrast(colour.light, PAGE.light) >= 3
    assert contrast(colour.dark, PAGE.dark) >= 3


def test_colours_are_different_so_that_a_theme_can_swap_each():
    assert len({colour.light for colour in all_colours()}) == len(all_colours())


def test_a_policy_keeps_its_colour_in_any_order():
    names = ["mlp_k01", "mlp_k16", "hold_still", "act_k16"]
    expected = policy_colours(names)
    assert all(policy_colours(order) == expected for order in itertools.permutations(names))
    assert policy_colours(names * 2) == expected


def test_the_first_seven_trained_policies_have_seven_colours():
    colours = policy_colours([f"mlp_k{k:02d}" for k in range(8)])
    assert len(set(colours.values())) == len(TRAINED) == 7


def test_baselines_are_dashed_and_trained_policies_are_not():
    assert is_baseline("hold_still")
    assert not is_baseline("mlp_k01")
    assert len({dash_of(name) for name in ("hold_still", "mean_action", "nearest_neighbour", "mlp_k01")}) == 4


def test_colours_on_dark_ground_as_numbers():
    assert TRAINED[0].rgb_on_dark == (0x4A, 0xA8, 0xE8)

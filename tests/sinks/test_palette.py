"""Colours can be read on their ground, and belong to a policy whatever else is drawn."""

import itertools

import pytest

from pipeline.sinks.page_style import PAGE
from pipeline.sinks.palette import (
    BASELINES,
    FAILURE,
    GRID,
    INK,
    SUCCESS,
    TRAINED,
    all_colours,
    is_baseline,
    policy_colours,
    policy_dashes,
)

from .colour_vision import confused, difference


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


def test_baselines_are_dashed_and_the_first_seven_trained_policies_are_not():
    assert is_baseline("hold_still")
    assert not is_baseline("mlp_k01")
    dashes = policy_dashes([*BASELINES, *(f"mlp_k{k:02d}" for k in range(8))])
    assert len({dashes[name] for name in BASELINES}) == 4
    assert {dashes[f"mlp_k{k:02d}"] for k in range(7)} == {(1, 0)}
    assert dashes["mlp_k07"] not in {(1, 0), *(dashes[name] for name in BASELINES)}


def test_the_difference_of_colours_is_that_of_the_published_pairs():
    pairs = [
        ((50, 2.6772, -79.7751), (50, 0, -82.7485), 2.0425), ((50, 2.5, 0), (73, 25, -18), 27.1492),
        ((22.7233, 20.0904, -46.6940), (23.0331, 14.9730, -42.5619), 2.0373), ((50, 0, 0), (50, -1, 2), 2.3669),
    ]  # fmt: skip
    assert [difference(one, other) for one, other, _ in pairs] == pytest.approx(
        [known for *_, known in pairs], abs=1e-4
    )


@pytest.mark.parametrize("ground", ["light", "dark"])
def test_any_two_trained_policies_are_told_apart_without_red_green_or_blue_cones(ground):
    for one, other in itertools.combinations(TRAINED, 2):
        assert not confused(getattr(one, ground), getattr(other, ground)), (one, other)
    assert not confused(getattr(SUCCESS, ground), getattr(FAILURE, ground))
    for one in (TRAINED[0], FAILURE):
        assert not confused(getattr(one, ground), getattr(INK, ground))


def test_the_colours_that_were_here_before_would_be_confused():
    assert confused("#d55e00", "#8f8500") == ["no red cones", "no green cones"]


@pytest.mark.parametrize("ground", ["light", "dark"])
def test_lines_that_could_be_confused_by_colour_have_another_dash(ground):
    names = [*BASELINES, *(f"mlp_k{k:02d}" for k in range(35))]
    colours, dashes = policy_colours(names), policy_dashes(names)
    for one, other in itertools.combinations(names, 2):
        same = confused(getattr(colours[one], ground), getattr(colours[other], ground))
        assert dashes[one] != dashes[other] or not same, (one, other, same)


def test_colours_on_dark_ground_as_numbers():
    assert TRAINED[0].rgb_on_dark == (0x1E, 0xA6, 0xF1)

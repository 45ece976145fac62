"""How numbers, units and intervals are printed on the page. What does not belong here: HTML."""

import math
from collections.abc import Iterable, Sequence
from typing import Any

DASH = "–"
"""Printed where a value does not apply."""


def is_number(value: Any) -> bool:
    return value is not None and math.isfinite(value)


def show(value: float | None, decimals: int | None = None) -> str:
    """A number with three significant digits, or with as many decimals as its column has; `–` where there is none."""
    if not is_number(value):
        return DASH
    return f"{value:,.{decimals_for([value]) if decimals is None else decimals}f}"


def decimals_for(values: Iterable[float | None]) -> int:
    """Decimals that give the smallest of some numbers three significant digits, and none to hundreds."""
    sizes = [abs(v) for v in values if is_number(v) and v != 0]
    return min(max(2 - math.floor(math.log10(min(sizes))), 0), 6) if sizes else 2


def show_interval(interval: Sequence[float] | None, decimals: int | None = None) -> str:
    """`[4.80, 5.44]`, or nothing where there is no interval."""
    if interval is None or not all(map(is_number, interval)):
        return ""
    decimals = decimals_for(interval) if decimals is None else decimals
    return f"[{show(interval[0], decimals)}, {show(interval[1], decimals)}]"


def common_unit(units: Sequence[str | None]) -> str | None:
    """The unit that all columns share; `mixed units` where they do not; None where it is unknown."""
    kinds = set(units)
    if len(kinds) > 1:
        return "mixed units"
    return kinds.pop() if kinds else None


def plural(count: int, word: str) -> str:
    return f"{count:,} {word}{'' if count == 1 else 's'}"


def percent(share: float) -> str:
    """`0.34 %`, `12 %`: two digits below a tenth, whole per cents above."""
    return f"{100 * share:.2g} %" if share < 0.1 else f"{100 * share:,.0f} %"

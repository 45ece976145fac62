"""Colours, dashes and the looks of charts: a policy has the same everywhere, recordings included.

What belongs here: which colour means what, on light and on dark ground. What does not: drawing.

The hues are near those of Okabe & Ito (2008), darkened for white paper and lightened for dark ground, and then moved as far
as it took to tell any two apart without red or green cones too: tests hold them to that. Colours come again after seven
policies, so every line has a dash beside its colour. Baselines are near-grey, so that colour is left for what was trained.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Colour:
    """One colour as `#rrggbb` on white and on dark ground."""

    light: str
    dark: str

    @property
    def rgb_on_dark(self) -> tuple[int, int, int]:
        red, green, blue = bytes.fromhex(self.dark[1:])
        return red, green, blue


INK = Colour("#1c2126", "#e8eaed")
MUTED = Colour("#59626c", "#a3abb5")
GRID = Colour("#e4e7eb", "#30363d")
SUCCESS = Colour("#0a7cb5", "#58b8ee")
FAILURE = Colour("#c05502", "#f58b4c")

TRAINED = (
    Colour("#006ecd", "#1ea6f1"),  # blue
    Colour("#e16e04", "#de8148"),  # orange
    Colour("#0a7d5c", "#2ecf9f"),  # bluish green
    Colour("#b15a8d", "#e39cca"),  # reddish purple
    Colour("#ae8e5f", "#eab029"),  # ochre
    Colour("#2e96cf", "#97d8ff"),  # sky blue
    Colour("#756203", "#f8ef46"),  # yellow
)
ROLES = {
    "ground": GRID,
    "target": TRAINED[2],
    "object": TRAINED[4],
    "robot": TRAINED[0],
    "way": MUTED,
    "plan": TRAINED[1],
}
"""The things of a simulator, in a video and in Rerun (`simulate.scene`)."""

BASELINES = {
    "hold_still": Colour("#6b7177", "#b4bac1"),
    "nearest_neighbour": Colour("#8a6d4b", "#c9ab87"),
    "constant_velocity": Colour("#72789b", "#a9b0d6"),
    "mean_action": Colour("#7d8a6a", "#b6c4a0"),
}
DASHES = {
    "hold_still": (7, 4),
    "nearest_neighbour": (2, 2),
    "constant_velocity": (8, 3, 2, 3),
    "mean_action": (1, 4),
}
ROUNDS = ((1, 0), (11, 3), (5, 2), (9, 2, 2, 2), (3, 3, 9, 3))
"""Dashes of trained policies: solid for the first seven, another for each seven more."""


def is_baseline(policy: str) -> bool:
    """Whether a policy is one of those that every benchmark holds for comparison; they learn no weights."""
    return policy in BASELINES


def policy_colours(policies: Iterable[str]) -> dict[str, Colour]:
    """Colour of each policy, by name: equal sets of policies get equal colours whatever their order.

    From the eighth trained policy on, colours come again, with another dash (`policy_dashes`).
    """
    names = sorted(set(policies))
    colours = {name: TRAINED[place % len(TRAINED)] for place, name in enumerate(_trained(names))}
    return {name: BASELINES[name] if name in BASELINES else colours[name] for name in names}


def policy_dashes(policies: Iterable[str]) -> dict[str, tuple[int, ...]]:
    """The dash of each policy's line, in pixels on and off: no two of them share both colour and dash."""
    names = sorted(set(policies))
    dashes = {name: ROUNDS[place // len(TRAINED) % len(ROUNDS)] for place, name in enumerate(_trained(names))}
    return {name: DASHES[name] if name in BASELINES else dashes[name] for name in names}


def _trained(names: Iterable[str]) -> list[str]:
    return [name for name in names if name not in BASELINES]


def all_colours() -> tuple[Colour, ...]:
    """Every colour that a chart may use; no two are the same on light ground."""
    return (INK, MUTED, GRID, SUCCESS, FAILURE, *TRAINED, *BASELINES.values())


CONFIG: dict[str, Any] = {
    "font": "system-ui, -apple-system, 'Segoe UI', Roboto, 'DejaVu Sans', sans-serif",
    "background": "#ffffff",
    "view": {"stroke": None},
    "axis": {
        "labelColor": MUTED.light, "titleColor": MUTED.light, "gridColor": GRID.light, "domain": False, "ticks": False,
        "labelPadding": 6, "labelFontSize": 11, "titleFontSize": 12, "titleFontWeight": "normal", "titlePadding": 8,
        "labelFlush": False,
    },
    "legend": {
        "labelColor": INK.light, "orient": "bottom", "title": None, "labelFontSize": 12, "symbolStrokeWidth": 2.5,
        "symbolSize": 160, "columnPadding": 14, "labelLimit": 220, "columns": 3,
    },
    "text": {"color": INK.light, "fontSize": 12},
}  # fmt: skip
"""How every chart looks; given to Vega-Lite beside the chart, on the page and for pictures alike."""

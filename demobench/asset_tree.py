"""A run as a tree that is drawn again and again: what was kept, what is made, what is at work, what waits.

What belongs here: which asset stands where, its mark and its words, and what is folded where the screen is too low. What does
not: Dagster's events, and when it is drawn (`progress`).
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from rich.console import Console, ConsoleOptions, RenderResult
from rich.spinner import Spinner
from rich.text import Text
from rich.tree import Tree

State = Literal["kept", "made", "runs", "failed", "waits"]

MARKS: dict[State, tuple[str, str]] = {
    "kept": ("✓", "dim"), "made": ("✓", "green"), "runs": ("▸", "bold cyan"), "failed": ("✗", "red"), "waits": ("·", "dim"),
}  # fmt: skip
GROUPS = {
    "demonstrations": "data", "episode_split": "data", "windows": "data", "multimodality_floor": "floors",
    "action_modes": "floors", "learning_curve": "curve", "scored_predictions": "elsewhere",
}  # fmt: skip
WORDS = {
    "demonstrations": "read", "episode_split": "split", "multimodality_floor": "floors", "action_modes": "modes",
    "trained_policy": "trained", "rollouts": "roll-outs", "learning_curve": "learning curve",
    "scored_predictions": "scored", "benchmark_table": "table", "benchmark_report": "report", "mcap_log": "MCAP",
    "rerun_recording": "Rerun", "rollout_video": "video",
}  # fmt: skip
RESULTS = "results"
BAR = 24
LEAST_FOLDED = 2


@dataclass
class _Asset:
    word: str
    state: State
    seconds: float = 0.0

    def text(self) -> Text:
        mark, style = MARKS[self.state]
        cost = f" {self.seconds:,.1f} s" if self.state == "made" else " kept" if self.state == "kept" else ""
        return Text.assemble(
            (f"{mark} ", style), (self.word, "bold" if self.state == "runs" else "" if cost else "dim"), (cost, "dim")
        )


@dataclass
class _Count:
    """How far the asset at work is."""

    what: str
    done: int
    total: int
    note: str
    since: float = field(default_factory=time.monotonic)

    def text(self) -> Text:
        share = min(self.done / self.total, 1.0) if self.total else 0.0
        full = round(BAR * share)
        parts = [f"{self.done:,}/{self.total:,}"] if self.total > 1 else []
        spent = time.monotonic() - self.since
        if self.total > 1 and self.done and spent > 1:
            parts += [f"{self.done / spent:,.0f}/s" if self.done > spent else ""]
            parts += [f"{clock(spent * (self.total - self.done) / self.done)} left"]
        words = "  ".join(filter(None, [*parts, self.note]))
        return Text.assemble(f"{self.what}  ", ("━" * full, "cyan"), ("─" * (BAR - full), "dim"), f"  {words}")


def clock(seconds: float) -> str:
    """83 → 1:23."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


class AssetTree:
    """The assets of a run by group, a policy a group. A rich renderable that fits on the screen it is drawn on.

    assets  every asset that belongs to it, inputs first: `windows`, `mlp_k04/trained_policy`
    stale   those of them that are made
    """

    def __init__(self, title: str, words: str, assets: Sequence[str], stale: Sequence[str]):
        self._title, self._words = title, words
        self._since = time.monotonic()
        self._assets = {
            a: _Asset(_word(a), "waits" if a in stale else "kept") for a in dict.fromkeys([*assets, *stale])
        }
        self._groups: dict[str, list[str]] = {}
        for asset in self._assets:
            self._groups.setdefault(_group(asset), []).append(asset)
        self._at_work: str | None = None
        self._count: _Count | None = None
        self._spinner = Spinner("dots", style="cyan")

    @property
    def made(self) -> int:
        return sum(asset.state == "made" for asset in self._assets.values())

    @property
    def to_make(self) -> int:
        return sum(asset.state != "kept" for asset in self._assets.values())

    @property
    def seconds(self) -> float:
        return time.monotonic() - self._since

    def start(self, asset: str) -> None:
        self._at_work, self._count = asset, None
        if asset in self._assets:
            self._assets[asset].state = "runs"

    def finish(self, asset: str, seconds: float) -> None:
        if asset in self._assets:
            self._assets[asset].state, self._assets[asset].seconds = "made", seconds

    def fail(self, asset: str) -> None:
        if asset in self._assets:
            self._assets[asset].state = "failed"

    def count(self, what: str, done: int, total: int, note: str) -> None:
        """What the asset at work says about itself."""
        before = self._count
        if before is not None and before.what == what and before.done <= done:
            before.done, before.total, before.note = done, total, note
        else:
            self._count = _Count(what, done, total, note)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield self._drawn(console.height)

    def _drawn(self, height: int) -> Tree:
        title = Text.assemble(
            self._spinner.render(time.monotonic()), " ", (self._title, "bold"),
            f"  {self._words} · {self.made} of {self.to_make} made · {clock(self.seconds)}",
        )  # fmt: skip
        tree = Tree(_one_line(title), guide_style="dim")
        # The cursor's line and the title's, and the line of the bar.
        for name, assets in self._folded(height - 3):
            here = tree.add(_one_line(self._line(name, assets)))
            if self._count is not None and self._at_work in assets:
                here.add(_one_line(self._count.text()))
        return tree

    def _line(self, name: str, assets: Sequence[str]) -> Text:
        width = max(len(group) for group in self._groups)
        if name not in self._groups:
            return Text(name, style="dim")
        cells = [self._assets[asset].text() for asset in assets]
        return Text("  ").join([Text(name.ljust(width), style="bold" if self._at_work in assets else ""), *cells])

    def _folded(self, room: int) -> list[tuple[str, list[str]]]:
        """The groups; where there is no room for all, those that are made become one line, and then those that wait."""
        shown = list(self._groups.items())
        for states, words in (({"made", "kept"}, "more made or kept"), ({"waits", "kept"}, "more wait")):
            if len(shown) <= room:
                break
            fits = [group for group in shown if {self._assets[asset].state for asset in group[1]} <= states]
            # Those next to the one at work stay in sight.
            leave = len(fits) - max(len(shown) - room + 1, LEAST_FOLDED)
            kept = max(leave, 0)
            folded = fits[: len(fits) - kept] if "made" in states else fits[kept:]
            if len(folded) < LEAST_FOLDED:
                continue
            place = shown.index(folded[0])
            shown = [group for group in shown if group not in folded]
            shown.insert(place, (f"{len(folded)} {words}", []))
        return shown


def _one_line(text: Text) -> Text:
    text.no_wrap, text.overflow = True, "ellipsis"
    return text


def _group(asset: str) -> str:
    policy, _, kind = asset.rpartition("/")
    return policy or GROUPS.get(kind, RESULTS)


def _word(asset: str) -> str:
    kind = asset.rpartition("/")[2]
    return WORDS.get(kind, kind)

"""What of the held-out predictions a reader may look at on the page: episodes, policies, columns and horizons, and no more.

What belongs here: choosing, thinning out and rounding, and saying in words what was left out. What does not: drawing
(`held_out_chart`), numbers that stand for a policy (`statistics`).
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.methods import METHODS
from pipeline.sinks.findings import ahead, is_seen
from pipeline.sinks.words import plural
from pipeline.types import ACTION, STATE, Demonstrations, Predictions, Semantics

MOST_NUMBERS = 120_000
"""So many numbers are kept at most, some five characters each: they add less than a megabyte to a page."""
MOST_EPISODES, FEWEST_EPISODES, MOST_LINES, MOST_POINTS, FEWEST_POINTS = 12, 3, 7, 150, 40
RECORDED, STATE_LINE = "recorded", "state"


@dataclass(frozen=True)
class HeldOut:
    """Lines to choose among, each of one episode, action column and horizon.

    rows       one a line: `episode`, `column`, `what` (recorded, state, or a policy), `y` [n] values with None where there is
               none, `first` and `every` in seconds; of policies `sees` (None: whatever set is chosen) and `ahead`; `turn` where
               the column is an angle
    episodes, columns, horizons, sets   what can be chosen, in words, in order; the horizon to begin with is `begin`
    policies   whose lines there are, best first step on top
    left_out   in words; empty where everything is there
    """

    rows: list[dict[str, Any]]
    episodes: tuple[str, ...]
    columns: tuple[str, ...]
    horizons: tuple[str, ...]
    begin: str
    sets: tuple[str, ...]
    policies: tuple[str, ...]
    left_out: str


def held_out_lines(
    table: Mapping[str, Any], demos: Demonstrations, semantics: Semantics, predictions: Sequence[Predictions]
) -> HeldOut | None:
    """Lines of the best trained policies of every observation set and of hold-still; None where nothing was predicted."""
    chosen, absent = _policies(table, predictions)
    if not chosen:
        return None
    best = chosen[0]
    steps = _horizons(chosen, demos.fps)
    names = _column_names(demos)
    episodes = np.unique(np.concatenate([demos.episode_of_frame[one.anchors] for one in chosen]))
    per_frame = len(names) * (2 + sum(h < one.actions.shape[2] for one in chosen for h in steps))
    count, points = _that_fits(len(episodes), per_frame)
    shown = _spread(demos, best, episodes, count)
    words = [ahead(h, demos.fps) for h in steps]
    labels = _labels(demos, shown)
    rows = [
        row for e in sorted(shown) for row in _episode(demos, semantics, chosen, e, labels[e], names, steps, points)
    ]
    longest = max(demos.episode(e).stop - demos.episode(e).start for e in shown)
    sets = dict.fromkeys(one.observations for one in chosen if _asks(one.policy))
    begin = ahead(_begin(chosen, steps, demos.fps), demos.fps)
    return HeldOut(
        rows, tuple(labels[e] for e in sorted(shown)), tuple(names), tuple(words), begin,
        tuple(sets) if len(sets) > 1 else (), tuple(dict.fromkeys(one.policy for one in chosen)),
        _said(len(shown), len(episodes), best, -(-longest // points), absent),
    )  # fmt: skip


def _asks(policy: str) -> bool:
    return policy not in METHODS or METHODS[policy].uses_observations


def _policies(table: Mapping[str, Any], predictions: Sequence[Predictions]) -> tuple[list[Predictions], list[str]]:
    """Of every observation set the trained policies with the lowest first-step error, and hold-still; who is left out."""
    known = {(one.policy, one.observations): one for one in predictions if len(one.anchors)}
    rows = [row for row in table["policies"] if (row["policy"], row["observations"]) in known and not is_seen(row)]
    rows.sort(key=lambda row: np.nan_to_num(row["first_step_mae"] or np.inf, nan=np.inf))
    trained = [row for row in rows if row["method"] not in METHODS or METHODS[row["method"]].trained] or rows
    taken, absent = [], []
    for row in trained:
        same = [other for other in taken if other["observations"] == row["observations"]]
        (taken if len(same) < MOST_LINES else absent).append(row)
    still = [row for row in rows if row["method"] == "hold_still" and row not in taken]
    names = [row["policy"] for row in taken]
    found = [known[row["policy"], row["observations"]] for row in (*taken, *still)]
    return found, [row["policy"] for row in absent if row["policy"] not in names]


def _horizons(chosen: Sequence[Predictions], fps: float) -> list[int]:
    """The first action, a quarter, a half, one and two seconds ahead, as far as any trained policy looks."""
    longest = max(one.actions.shape[2] for one in [c for c in chosen if c.policy not in METHODS] or chosen)
    asked = (0, *(round(seconds * fps) for seconds in (0.25, 0.5, 1.0, 2.0)))
    return sorted({h for h in asked if h < longest})


def _begin(chosen: Sequence[Predictions], steps: Sequence[int], fps: float) -> int:
    """The furthest horizon up to a second that at least half of the trained policies reach: there is most to compare."""
    reach = [one.actions.shape[2] for one in chosen if one.policy not in METHODS] or [max(steps) + 1]
    return max(h for h in steps if h <= round(fps) and (h == 0 or 2 * sum(h < k for k in reach) >= len(reach)))


def _column_names(demos: Demonstrations) -> list[str]:
    """Action columns with their units, all different."""
    feature = demos.features[ACTION]
    return [f"{name} ({unit or 'unit unknown'})" for name, unit in zip(feature.names, feature.units, strict=True)]


def _that_fits(episodes: int, per_frame: int) -> tuple[int, int]:
    """How many episodes, of how many points each: fewer points first, then fewer episodes, then fewer points again."""
    count = min(episodes, MOST_EPISODES)
    points = min(MOST_POINTS, MOST_NUMBERS // (per_frame * count))
    if points < FEWEST_POINTS:
        count = min(count, max(FEWEST_EPISODES, MOST_NUMBERS // (per_frame * FEWEST_POINTS)))
        points = min(FEWEST_POINTS, MOST_NUMBERS // (per_frame * count))
    return count, max(points, 2)


def _spread(demos: Demonstrations, best: Predictions, episodes: np.ndarray, count: int) -> list[int]:
    """Episodes from the one that the best policy is closest to, to the one that it is furthest from."""
    errors = np.abs(best.actions[0, :, 0] - demos.columns[ACTION][best.anchors]).mean(axis=1)
    of = demos.episode_of_frame[best.anchors]
    mean = [errors[of == e].mean() if (of == e).any() else np.inf for e in episodes]
    order = episodes[np.argsort(mean, kind="stable")]
    return [int(e) for e in order[np.linspace(0, len(order) - 1, count).round().astype(int)]]


def _labels(demos: Demonstrations, shown: Sequence[int]) -> dict[int, str]:
    """Recorded numbers, and which is which end of the spread."""
    labels = {e: str(demos.episode_ids[e]) for e in shown}
    if len(shown) > 1:
        labels[shown[0]] += " (smallest error)"
        labels[shown[-1]] += " (largest error)"
    return labels


def _episode(
    demos: Demonstrations, semantics: Semantics, chosen: Sequence[Predictions], episode: int, label: str,
    names: Sequence[str], steps: Sequence[int], points: int,
) -> Iterator[dict[str, Any]]:  # fmt: skip
    """Every line of one episode."""
    frames = demos.episode(episode)
    length = frames.stop - frames.start
    every = -(-length // points)
    recorded = demos.columns[ACTION][frames]
    for column, name in enumerate(names):
        decimals = _decimals(demos.columns[ACTION][:, column])
        turn = {"turn": True} if any(semantics.circular.get(ACTION, ())) and semantics.circular[ACTION][column] else {}
        same = {"episode": label, "column": name, "first": 0, "every": float(f"{every / demos.fps:.6g}"), **turn}
        yield {**same, "what": RECORDED, "y": _rounded(recorded[::every, column], decimals)}
        where = semantics.state_column[column]
        if semantics.kinds[column] == "position" and where is not None:
            yield {**same, "what": STATE_LINE, "y": _rounded(demos.columns[STATE][frames, where][::every], decimals)}
        for one in chosen:
            inside = one.in_frames(frames)
            sees = one.observations if _asks(one.policy) else None
            for h in (h for h in steps if h < one.actions.shape[2]):
                values = np.full(length, np.nan)
                at = one.anchors[inside] - frames.start + h
                values[at[at < length]] = one.actions[0, inside[at < length], h, column]
                line = {"what": one.policy, "sees": sees, "ahead": ahead(h, demos.fps)}
                yield {**same, **line, "y": _rounded(values[::every], decimals)}


def _decimals(values: np.ndarray) -> int:
    """Decimals that make a thousand steps, at least, of what a column covers."""
    covers = float(np.nanmax(values) - np.nanmin(values)) or 1.0
    return max(0, 3 - math.floor(math.log10(covers)))


def _rounded(values: np.ndarray, decimals: int) -> list[float | int | None]:
    found = [round(float(v), decimals) if math.isfinite(v) else None for v in values]
    return [int(v) if v is not None and v == int(v) else v for v in found]


def _said(shown: int, there: int, best: Predictions, every: int, absent: Sequence[str]) -> str:
    """What a reader cannot choose here."""
    said = []
    if shown < there:
        said.append(
            f"{plural(shown, 'episode')} of {there} held out, spread from the smallest to the largest first-step error of "
            f"{best.policy} ({best.observations})"
        )
    if every > 1:
        said.append(f"of long episodes one frame in {every}")
    if absent:
        said.append(f"not {', '.join(absent)}")
    return f"To keep the file small: {'; '.join(said)}." if said else ""

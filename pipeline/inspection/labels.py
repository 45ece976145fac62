"""What people wrote beside the numbers: tasks in words, and units."""

import math
import re
from collections import defaultdict
from collections.abc import Iterator

import numpy as np

from pipeline.inspection.finding import Finding
from pipeline.inspection.survey import Survey
from pipeline.types import ACTION, STATE

_RATIOS = {
    180 / math.pi: "degrees against radians",
    1000.0: "millimetres against metres",
    100.0: "hundredths against ones",
}
"""Factors between an action and its state that come from units, and what they tell."""

AGREE = 0.9
"""Correlation over all frames from which action and state speak of the same thing."""


def check_labels(survey: Survey) -> Iterator[Finding]:
    yield from _tasks(survey)
    yield from _units(survey)


def _tasks(survey: Survey) -> Iterator[Finding]:
    tasks = survey.demos.tasks
    empty = [survey.id(e) for e, words in enumerate(tasks) if not words.strip()]
    if empty and len(empty) < len(tasks):
        some = ", ".join(map(str, empty[:5])) + (" …" if len(empty) > 5 else "")
        yield Finding(
            "label", None, "task", len(empty), 0,
            f"{len(empty)} of {len(tasks)} episodes have no task in words (episodes {some}); the others have one.",
        )  # fmt: skip
    spellings: dict[str, set[str]] = defaultdict(set)
    for words in tasks:
        spellings[re.sub(r"[\W_]+", " ", words.lower()).strip()].add(words)
    for written in spellings.values():
        if len(written) > 1:
            both = " and ".join(f"“{words[:60]}”" for words in sorted(written)[:2])
            yield Finding(
                "label", None, "task", len(written), 1,
                f"One task is written in {len(written)} ways ({both}): they count as different tasks.",
            )  # fmt: skip


def _units(survey: Survey) -> Iterator[Finding]:
    """Action columns that go with the state column of their own name, but in another unit."""
    states = survey.demos.features[STATE].names
    for position, name in enumerate(survey.demos.features[ACTION].names):
        if name not in states:
            continue
        column, state = survey.column(ACTION, position), survey.column(STATE, states.index(name))
        if column.is_rate:
            continue
        factor = _factor(survey, column.values, state.values)
        for ratio, words in _RATIOS.items():
            if factor and abs(math.log(max(factor, 1 / factor) / ratio)) < 0.1:
                yield Finding(
                    "label", None, column.key, factor, 1.0,
                    f"{column.key} follows {state.key} but is {factor:.3g} times as large: {words}?",
                )  # fmt: skip


def _factor(survey: Survey, action: np.ndarray, state: np.ndarray) -> float | None:
    """How many times the action is the state, where they go together."""
    action, state = (values[:: max(1, len(values) // 100_000)].astype(np.float64) for values in (action, state))
    spread = action.std() * state.std()
    if spread == 0 or ((action - action.mean()) * (state - state.mean())).mean() / spread < AGREE:
        return None
    return float(action.std() / state.std())

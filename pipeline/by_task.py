"""The errors of one policy, task by task, where a data set has several.

What belongs here: which episodes are of which task, and the mean over them. What does not: the mean's making
(`statistics`), or showing it (`table`).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.statistics.intervals import estimate_mean
from pipeline.statistics.metrics import estimate, span_means
from pipeline.types import EpisodeErrors, Protocol

MOST_TASKS = 12
"""More than so many are no table any more."""


def errors_by_task(errors: EpisodeErrors, tasks: Sequence[str], protocol: Protocol) -> dict[str, dict[str, Any]]:
    """The error of the first action on the held-out episodes of each task; empty with one task, or with very many.

    Parameters
    ----------
    tasks : [E] the task of every episode of the data set, in words.

    Returns
    -------
    dict : task → `first_step_mae`, `episodes` held out and `interval` (None below five of them), in the order of the data set.
    """
    names = list(dict.fromkeys(tasks))
    if not 2 <= len(names) <= MOST_TASKS:
        return {}
    mine = np.array([tasks[episode] for episode in errors.episodes])
    means, counts = span_means(errors, errors.absolute, slice(0, 1))
    found = {}
    for name in names:
        use = (mine == name) & (counts > 0)
        if use.any():
            values, weights = means[:, use].mean(axis=2), counts[use] if protocol == "notebook" else None
            mean = estimate_mean(values, weights, errors.fold[use])
            found[name] = {
                "first_step_mae": estimate(values, counts[use], protocol),
                "episodes": int(use.sum()),
                "interval": None if mean.interval is None else list(mean.interval),
            }
    return found

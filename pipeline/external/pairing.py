"""Comparing predictions from elsewhere with ours: on the episodes that both hold out.

What belongs here: choosing common episodes, before any test is asked. What does not: the tests (`statistics.comparisons`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.statistics.comparisons import Comparison, Paired, compare_errors, horizons_in_common, judge
from pipeline.types import EpisodeErrors, Protocol

SEEN = "seen in training: its error here says nothing about other episodes"
UNKNOWN = "; nothing is known about the episodes it was trained on"


@dataclass(frozen=True)
class Rival:
    """One row of a table: its address, its errors, whether it has seeds.

    seen   whether it was trained on the episodes it is scored on; None: nothing is known; ours never are
    """

    address: str
    errors: EpisodeErrors
    trained: bool
    seen: bool | None = False


def on_episodes(errors: EpisodeErrors, episodes: np.ndarray) -> EpisodeErrors:
    """The errors on some of the episodes (positions, ascending)."""
    keep = np.isin(errors.episodes, episodes)
    return EpisodeErrors(
        errors.episodes[keep], errors.fold[keep], errors.anchors[keep], errors.absolute[:, keep], errors.squared[:, keep],
        errors.l2[:, keep], errors.scale[keep],
    )  # fmt: skip


def common_errors(a: EpisodeErrors, b: EpisodeErrors) -> tuple[EpisodeErrors, EpisodeErrors]:
    """Both on the episodes that both hold out.

    Where the two do not share folds, each counts as one fold: a seed of it stands for that seed in all of them, which leaves
    the variance of seeds as it is and costs degrees of freedom.
    """
    common = np.intersect1d(a.episodes, b.episodes)
    a, b = on_episodes(a, common), on_episodes(b, common)
    fold_a, fold_b = (np.unique(errors.fold, return_inverse=True)[1].astype(np.int64) for errors in (a, b))
    if not np.array_equal(fold_a, fold_b):
        fold_a = fold_b = np.zeros(len(common), np.int64)
    return replace(a, fold=fold_a), replace(b, fold=fold_b)


def compare_common(a: Rival, b: Rival, horizon: int, protocol: Protocol) -> Paired | str:
    """Compare two rows at a horizon on the episodes that both hold out, or say why they cannot be compared."""
    for one in (a, b):
        if one.seen:
            return f"{one.address} was {SEEN}"
    errors = common_errors(a.errors, b.errors)
    if not len(errors[0].episodes):
        return "no episode is held out by both"
    found = compare_errors(*errors, horizon, protocol, trained=(a.trained, b.trained))
    whole = len(errors[0].episodes) == len(a.errors.episodes) == len(b.errors.episodes)
    return found if isinstance(found, str) or whole else replace(found, sampled="episodes that both hold out")


def judge_with_elsewhere(
    found: Sequence[Comparison], ours: Sequence[Rival], elsewhere: Sequence[Rival], fps: float, protocol: Protocol
) -> list[Comparison]:
    """A table's comparisons with the rows from elsewhere in the same family, so that equal predictions get equal verdicts.

    Each row from elsewhere is compared with the rivals that ours are compared with. Like any other row it makes the family
    larger, and so the others' p after Holm.

    Parameters
    ----------
    found : what `table_comparisons` says of ours.
    """
    if not elsewhere:
        return list(found)
    named = {one.address: one for one in ours}
    metrics = {"first_step_mae": 0, "at_one_second_mae": round(fps)}
    listed: list[tuple[str, str, str, Paired | str]] = []
    for c in found:
        comparable = c.word != "not comparable"
        pair = compare_common(named[c.a], named[c.b], metrics[c.metric], protocol) if comparable else c.words
        listed.append((c.a, c.b, c.metric, pair))
    rivals = [named[address] for address in dict.fromkeys(c.b for c in found) if address in named]
    for row in elsewhere:
        for rival in rivals:
            reached = {"first_step_mae": 0} if row.seen else horizons_in_common(row.errors, rival.errors, fps)
            for metric, horizon in reached.items():
                listed.append((row.address, rival.address, metric, compare_common(row, rival, horizon, protocol)))
    unknown = {row.address for row in elsewhere if row.seen is None}
    return [replace(c, words=c.words + UNKNOWN) if c.a in unknown else c for c in judge(listed)]

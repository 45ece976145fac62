"""The regression gate: is a policy that was trained anew worse than it was before?

What belongs here: the comparison of two results of one policy, and what keeps them from being compared. What does not: which
two (`pipeline.history`), how often the gate is wrong (`known_truth.gate`).

The gate asks one question a table, so there is no family to correct for. A verdict between two results is about these training
episodes and these seeds; two trainings of one method differ by a little more than that. So the gate takes two seeds or more,
and an error must have risen by more than MARGIN beyond chance.
"""

from collections.abc import Mapping
from dataclasses import replace

from pipeline.statistics.comparisons import Comparison, compare_errors, judge
from pipeline.types import EpisodeErrors, Protocol

METRIC = "first_step_mae"
FEWEST_SEEDS = 2
MARGIN = 0.05
"""Without it, a mean over nearest neighbours whose training episodes were drawn anew was stopped 7 times of 50."""

FALSE_ALARMS_AT_MOST, POWER = 0.052, 0.99
"""What the check's description tells, both of 50 episodes: the upper limit that the known-truth suite measured without MARGIN,
which MARGIN can only lower, and the lower limit of `python -m speed.gate` (docs/automation.md); a test holds that study to both."""

CONDITIONS = {
    "content_hash": "data hash",
    "split": "split",
    "history": "anchors (frames of history)",
    "protocol": "protocol",
    "budget": "budget",
}
"""What must be equal before two results are compared, in the order in which a difference is told."""


def first_step(errors: EpisodeErrors) -> EpisodeErrors:
    """The errors at the first action alone: what is kept of a result, and small."""
    return EpisodeErrors(
        episodes=errors.episodes,
        fold=errors.fold,
        anchors=errors.anchors[:, :1],
        absolute=errors.absolute[:, :, :1],
        squared=errors.squared[:, :, :1],
        l2=errors.l2[:, :, :1],
        scale=errors.scale,
    )


def what_changed(now: Mapping[str, object], before: Mapping[str, object]) -> str | None:
    """The first condition under which two results differ, in words; None where both were made alike."""
    for name, words in CONDITIONS.items():
        if now[name] != before[name]:
            return f"{words} differs: {_short(before[name])} before, {_short(now[name])} now"
    return None


def _short(value: object) -> str:
    return value[:12] if isinstance(value, str) and len(value) >= 40 else str(value)


def compare_with_before(
    now: EpisodeErrors,
    before: EpisodeErrors,
    protocol: Protocol,
    *,
    is_trained: bool,
    changed: str | None = None,
    name: str = "now",
) -> Comparison:
    """Whether a policy is better or worse than its earlier result on the same episodes, paired by episode.

    Parameters
    ----------
    is_trained : whether its seeds differ; baselines have one result.
    changed : what keeps the two from being compared (`what_changed`).
    name : of the policy, for the verdict.

    Returns
    -------
    Comparison : of `name` with "before"; with one seed of a trained policy, and within the margin, "cannot tell".
    """
    trained = (is_trained, is_trained)
    (found,) = judge([(name, "before", METRIC, changed or compare_errors(now, before, 0, protocol, trained=trained))])
    if found.word not in ("better", "worse"):
        return found
    if is_trained and min(len(now.absolute), len(before.absolute)) < FEWEST_SEEDS:
        words = f"needs at least {FEWEST_SEEDS} seeds: one network differs from the next where nothing changed"
        return replace(found, word="cannot tell", words=words)
    times = 1 + MARGIN if found.word == "better" else 1 / (1 + MARGIN)
    beyond = compare_errors(replace(now, absolute=times * now.absolute), before, 0, protocol, trained=trained)
    (sure,) = judge([(name, "before", METRIC, beyond)])
    if sure.word == found.word:
        return found
    words = f"{found.words}: not surely more than the {100 * MARGIN:.0f} % that two trainings may differ by"
    return replace(found, word="cannot tell", words=words)

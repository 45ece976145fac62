"""Whether a data set's columns are what a simulator shows and takes.

What belongs here: the question that is the same for every simulator. What does not: what a simulator's own columns are.
"""

from collections.abc import Callable, Mapping, Sequence

from pipeline.types import ACTION, Demonstrations, ObservationSet


def misfit(
    demos: Demonstrations,
    observation_set: ObservationSet,
    world: str,
    shown: Mapping[str, Sequence[str]],
    problem_of: Callable[[str], str | None],
) -> str | None:
    """Why policies of these demonstrations cannot be asked in a world, in one message; None where they can.

    Args:
        world: its name in a sentence.
        shown: feature key → the columns that the world shows under it.
        problem_of: what is wrong with a feature of the data set, if anything; asked for the action and what is seen.
    """
    cannot = f"Policies of '{demos.name}' cannot be rolled out in {world}"
    for key in (ACTION, *observation_set.features):
        if key != ACTION and key not in shown:
            known = " and ".join(f"{k} ({len(names)} columns)" for k, names in shown.items())
            return (
                f"{cannot}: the observation set '{observation_set.name}' needs {key}, which the simulator does not "
                f"show. It shows {known}; name a set of these under [datasets.{demos.name}.observations]."
            )
        problem = problem_of(key)
        if problem:
            return f"{cannot}: {problem}"
    return None


def misnumbered(demos: Demonstrations, key: str, expected: Sequence[str]) -> str | None:
    """What is wrong where a feature is not there, or has another number of columns."""
    wanted = f"{len(expected)} columns ({', '.join(expected)})"
    feature = demos.features.get(key)
    if feature is None:
        return f"the data set has no feature {key}; expected {wanted}."
    if len(feature.names) != len(expected):
        return f"{key} has {len(feature.names)} columns ({', '.join(feature.names[:6])}); expected {wanted}."
    return None

"""How a policy's chunks are carried out: what can be asked for, and whether it goes together with a chunk.

What belongs here: checks and words. What does not: doing it (`simulate.rollout`).

A policy is asked at frame 0 and after every `execute` frames. Its answer is there `delay` frames later and holds the actions of
the frame it was asked at and of those after it, so the first `delay` of them are over; until it is there the one before goes on.
Before the first answer is there the robot stands still.

A policy that answers the same to the same and begins its answer by standing still stands still for ever; people pause, and the
middle of what they did is often to wait. `carry_on` lets such a pause end: a robot that stands where it stood is not asked anew.
"""

from dataclasses import replace

from pipeline.errors import ConfigError
from pipeline.types import Execution

USUAL = 8
"""Actions carried out of each chunk where nothing is said, or all that a shorter chunk has."""
STILL = 0.002
"""Of a column's range: a robot of which no column has moved further has not moved (PushT: 1 px, SO-101: about half a degree)."""


def settled(execution: Execution, chunk: int) -> Execution:
    """The same with `execute` known, for a policy that answers `chunk` actions.

    Raises:
        ConfigError: its parts contradict each other, or the chunk.
    """
    execute, delay = execution.execute, execution.delay
    if execution.ensemble and execute not in (None, 1):
        raise ConfigError(
            f"execute = {execute} and ensemble contradict each other: a temporal ensemble asks at every frame. Keep one of them."
        )
    if execution.ensemble and execution.carry_on:
        raise ConfigError(
            "ensemble and carry_on contradict each other: a temporal ensemble never follows a single answer. Keep one of them."
        )
    if execution.ensemble:
        execute = 1
    if delay >= chunk:
        raise ConfigError(
            f"delay = {delay}, and a chunk of {_actions(chunk)} is over before its first action can begin. "
            f"Use a chunk of at least {delay + max(execute or 1, delay)}."
        )
    if execute is None:
        execute = min(USUAL, chunk - delay)
    if execute + delay > chunk:
        after = f" after a delay of {delay}" if delay else ""
        raise ConfigError(
            f"execute = {execute}{after} needs a chunk of at least {execute + delay} actions, and this one has {chunk}. "
            f"Use a longer chunk, or execute at most {chunk - delay}."
        )
    if delay > execute:
        raise ConfigError(
            f"delay = {delay} is longer than the {_frames(execute)} between two questions: the policy would be asked while it "
            f"still thinks. Execute at least {delay} actions of a chunk of at least {2 * delay}."
        )
    return replace(execution, execute=execute)


def words(execution: Execution) -> str:
    """As people read it: `8 actions of each chunk`, `a temporal ensemble`, with the delay where there is one."""
    how = "a temporal ensemble" if execution.ensemble else f"{_actions(execution.execute or USUAL)} of each chunk"
    late = f", {_frames(execution.delay)} late" if execution.delay else ""
    on = ", carried on where the robot stands still" if execution.carry_on else ""
    return how + late + on


def _actions(count: int) -> str:
    return f"{count} action{'s' * (count != 1)}"


def _frames(count: int) -> str:
    return f"{count} frame{'s' * (count != 1)}"

"""Every error a user can cause, in one tree.

    DemobenchError
    ├── ConfigError           a setting is unknown, contradictory or out of range
    ├── DatasetError          the demonstrations cannot be read or make no sense
    │   └── HubError          the Hub said no, or could not be reached
    ├── NotApplicableError    the question has no answer for this data set (no simulator, too few episodes)
    ├── PolicyError           a policy cannot be trained, loaded or asked
    └── StoreError            results cannot be read or written

A message says what is wrong, where, what was expected and what to do. Programming faults are not in this tree: they keep
their traceback.
"""

import re
from collections.abc import Iterable
from difflib import get_close_matches

_OBEYED = re.compile(r"[\x00-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")


class DemobenchError(Exception):
    """Base of every error that is shown to the user as one message, without a traceback."""


class ConfigError(DemobenchError):
    """A setting is unknown, contradictory or out of range."""


class DatasetError(DemobenchError):
    """A data set cannot be read, or what it says about itself is not so."""


class HubError(DatasetError):
    """The Hub refused a request or could not be reached."""


class NotApplicableError(DemobenchError):
    """The question has no answer for this data set."""


class PolicyError(DemobenchError):
    """A policy cannot be trained, loaded or asked."""


class StoreError(DemobenchError):
    """Results cannot be read or written."""


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """A sentence that names the closest known word, or lists all of them. Empty when nothing is known."""
    known = sorted(set(known))
    close = get_close_matches(word, known, n=1, cutoff=0.6)
    if close:
        return f"Did you mean '{close[0]}'?"
    return f"Known: {', '.join(known)}." if known else ""


def printable(words: str) -> str:
    """Words that somebody else wrote, without the characters that a terminal obeys: control characters, and those that turn
    the direction of writing. White space among them becomes a space, the rest a replacement character.
    """
    return _OBEYED.sub(lambda found: " " if found[0].isspace() else "\N{REPLACEMENT CHARACTER}", words)

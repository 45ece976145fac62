"""A part of the frames at a time, so that what is worked out from a million of them takes little memory beside them.

What does not belong here: what is worked out.
"""

from collections.abc import Iterator

import numpy as np

AT_A_TIME = 2**16
"""Frames that are looked at together."""


def parts(frames: int) -> list[slice]:
    """All frames, AT_A_TIME of them at a time."""
    return [slice(start, min(start + AT_A_TIME, frames)) for start in range(0, frames, AT_A_TIME)]


def blocks(starts: np.ndarray, most: int = AT_A_TIME) -> Iterator[tuple[slice, slice]]:
    """Whole episodes, `most` frames of them at a time (more where one episode has more): their positions, their frames.

    `starts` [E + 1] is as `Demonstrations.episode_starts`.
    """
    first = 0
    while first < len(starts) - 1:
        stop = max(first + 1, int(np.searchsorted(starts, starts[first] + most, side="right")) - 1)
        yield slice(first, stop), slice(int(starts[first]), int(starts[stop]))
        first = stop

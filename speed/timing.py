"""Timing two things in turn, so that a machine that slows down slows both."""

import statistics
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Ratio:
    """How many times longer `plain` takes than `ours`: the median over pairs, and the smallest and largest."""

    median: float
    low: float
    high: float
    ours_s: float
    plain_s: float


def seconds(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def compare(ours: Callable[[], object], plain: Callable[[], object], pairs: int = 5) -> Ratio:
    """Run both once to warm up, then in turn."""
    ours(), plain()
    times = [(seconds(ours), seconds(plain)) for _ in range(pairs)]
    ratios = [b / a for a, b in times]
    return Ratio(
        statistics.median(ratios),
        min(ratios),
        max(ratios),
        statistics.median(a for a, _ in times),
        statistics.median(b for _, b in times),
    )


def peak_mb(work: Callable[[], object]) -> float:
    """The peak of memory that Python and numpy allocate during the work."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()

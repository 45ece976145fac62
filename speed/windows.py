"""Cutting windows: gathered in batches from indices, against the plain loop that copies one window at a time."""

import numpy as np

from pipeline.types import ACTION
from pipeline.windows import Windows, rows
from speed.timing import compare, peak_mb

BATCH = 4096


def gathered(windows: Windows) -> float:
    """Every window once, a batch at a time; the sum keeps the work from being skipped."""
    total = 0.0
    for start in range(0, len(windows), BATCH):
        index = slice(start, start + BATCH)
        seen = rows(windows.values, windows.history_frames(index))
        actions, mask = windows.targets(index)
        total += float(seen[0, 0, 0]) + float(actions[0, 0, 0]) + float(mask[0, 0])
    return total


def looped(windows: Windows) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The obvious way: for every anchor slice its history and its chunk, pad at the end, stack all of them."""
    values, actions = windows.values, windows.demos.columns[ACTION]
    seen, targets, masks = [], [], []
    for anchor, first, end in zip(windows.anchors, windows.first_frame, windows.end_frame, strict=True):
        start = max(int(anchor) - windows.history + 1, int(first))
        history = values[start : anchor + 1]
        history = np.concatenate([values[first : first + 1]] * (windows.history - len(history)) + [history])
        chunk = actions[anchor : min(int(anchor) + windows.chunk, int(end))]
        missing = windows.chunk - len(chunk)
        seen.append(history)
        targets.append(np.concatenate([chunk] + [chunk[-1:]] * missing))
        masks.append(np.arange(windows.chunk) < len(chunk))
    return np.stack(seen), np.stack(targets), np.stack(masks)


def measure(windows: Windows) -> list[str]:
    ratio = compare(lambda: gathered(windows), lambda: looped(windows))
    ours, plain = peak_mb(lambda: gathered(windows)), peak_mb(lambda: looped(windows))
    return [
        f"windows, chunk {windows.chunk}: {len(windows) / ratio.ours_s:,.0f} a second, {ratio.median:.0f} times the plain loop "
        f"({ratio.low:.0f} to {ratio.high:.0f}); peak memory {ours:.1f} MB against {plain:.1f} MB"
    ]

"""The statistics that LeRobot keeps beside the data: of every column, over the data set and over each episode.

They are for LeRobot's own tools. Nothing in demobench scales by them: its statistics come from training episodes only.
"""

import numpy as np

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


def column_stats(values: np.ndarray) -> dict[str, np.ndarray]:
    """Statistics over the frames of `values` [n, D]: each [D] float64 in the column's unit, `count` [1] int64.

    The deviation is that of the values given (divided by n). Quantiles lie between neighbouring values.
    """
    exact = values.astype(np.float64)
    stats = {"min": exact.min(0), "max": exact.max(0), "mean": exact.mean(0), "std": exact.std(0)}
    stats["count"] = np.array([len(exact)], np.int64)
    stats.update(zip(QUANTILES, np.quantile(exact, list(QUANTILES.values()), axis=0), strict=True))
    return stats

"""Many lines as one column of Rerun's, made at once: its own conversion takes them one at a time, most of a recording's seconds.

What belongs here: layout in memory. What does not: which lines there are.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import pyarrow as pa


def as_strips(lines: Sequence[np.ndarray], dimensions: int) -> "pa.Array":
    """Lines [p, d] of any lengths, in the plane (d = 2) or in space (3), as `LineStrips2D` or `LineStrips3D` take them."""
    import pyarrow as pa
    import rerun as rr

    point, strip = {
        2: (rr.encodings.Vec2DBatch, rr.components.LineStrip2DBatch),
        3: (rr.encodings.Vec3DBatch, rr.components.LineStrip3DBatch),
    }[dimensions]
    ends = np.concatenate([[0], np.cumsum([len(line) for line in lines])]).astype(np.int32)
    points = np.concatenate([np.zeros((0, dimensions)), *lines]).astype(np.float32)
    return pa.ListArray.from_arrays(ends, point(points).as_arrow_array(), type=strip([]).as_arrow_array().type)

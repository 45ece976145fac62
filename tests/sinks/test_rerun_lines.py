"""Lines that are laid out at once are what Rerun's own conversion makes of them."""

import numpy as np
import pytest
import rerun as rr

from pipeline.sinks.rerun_lines import as_strips


@pytest.mark.parametrize(
    ("dimensions", "plain"), [(2, rr.components.LineStrip2DBatch), (3, rr.components.LineStrip3DBatch)]
)
def test_they_are_what_rerun_makes_of_them_one_at_a_time(dimensions, plain):
    rng = np.random.default_rng(0)
    lines = [rng.normal(size=(count, dimensions)) for count in (3, 1, 0, 7)]
    assert as_strips(lines, dimensions).equals(plain(lines).as_arrow_array())


def test_no_lines_are_none():
    assert len(as_strips([], 2)) == 0

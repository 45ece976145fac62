"""Points and paths around the block, against the environment's own shapes and against plain distances."""

import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.simulate.pusht import make_environment
from pipeline.simulate.pusht_geometry import (
    ARRIVE_PX,
    CONTACTS,
    ESCAPE_PX,
    FINGER_PX,
    MASS_CENTRE,
    OUTLINE,
    STANDOFF_PX,
    length,
    targets_along,
    to_block,
    to_world,
    walk,
)

px = st.floats(-500, 500)
poses = st.tuples(px, px, st.floats(-10, 10))
BLOCK = shapely.Polygon(OUTLINE)


def test_the_outline_is_that_of_the_environment():
    environment = make_environment(0)
    bars = [shapely.Polygon(shape.get_vertices()) for shape in environment._block_shapes]
    assert shapely.union_all(bars).symmetric_difference(BLOCK).area == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose(environment.block.center_of_gravity, MASS_CENTRE)
    (finger,) = environment.agent.shapes
    assert finger.radius == FINGER_PX


@given(poses, st.tuples(px, px))
def test_block_and_world_are_inverse(pose, point):
    assert to_block(pose, to_world(pose, point)) == pytest.approx(point, abs=1e-6)


def test_world_agrees_with_the_physics():
    block = make_environment(4).block
    pose = (*block.position, block.angle)
    assert to_world(pose, (15.0, 48.0)) == pytest.approx(tuple(block.local_to_world((15.0, 48.0))))


@pytest.mark.parametrize("contact", CONTACTS)
def test_a_finger_at_a_contact_touches_only_there(contact):
    assert BLOCK.exterior.distance(shapely.Point(contact.x, contact.y)) == 0
    for gap in (0.0, STANDOFF_PX):
        finger = shapely.Point(contact.finger(gap))
        assert not BLOCK.contains(finger)
        assert BLOCK.distance(finger) >= FINGER_PX + min(gap, ARRIVE_PX) - 1e-9


@given(st.lists(st.tuples(px, px), min_size=2, max_size=6), st.floats(1, 50))
def test_targets_are_evenly_spaced_and_end_at_the_end(path, speed):
    targets = targets_along(path, speed)
    assert targets[-1] == path[-1]
    assert len(targets) == max(1, math.ceil(length(path) / speed))
    gaps = [math.dist(a, b) for a, b in zip([path[0], *targets], targets, strict=False)]
    assert max(gaps) <= speed * (1 + 1e-9) + 1e-9


angles = st.floats(0, 2 * math.pi)


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(CONTACTS), angles, st.floats(160, 300), st.sampled_from([1, -1]))
def test_a_walk_keeps_away_from_the_block(contact, angle, distance, direction):
    start = (distance * math.cos(angle), 45 + distance * math.sin(angle))
    path = walk(start, contact.finger(STANDOFF_PX), direction)
    assert path is not None
    assert (path[0], path[-1]) == (start, contact.finger(STANDOFF_PX))
    # The outline's rounded growth is drawn with short straight lines, a little inside of the true curve.
    assert shapely.LineString(path).distance(BLOCK) >= FINGER_PX + ARRIVE_PX - 0.2


def test_the_two_directions_go_around_different_sides():
    start, goal = (0.0, -60.0), (0.0, 160.0)
    one, other = walk(start, goal, 1), walk(start, goal, -1)
    assert one is not None
    assert other is not None
    assert max(x for x, _ in one) > 60
    assert min(x for x, _ in other) < -60


def test_a_finger_that_touches_the_block_steps_back_first():
    start = (0.0, -FINGER_PX)
    path = walk(start, (0.0, 160.0), 1)
    assert path is not None
    assert path[1] == pytest.approx((0.0, -FINGER_PX - ESCAPE_PX))

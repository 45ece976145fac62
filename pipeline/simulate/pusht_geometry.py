"""The T-shaped block of PushT as plain geometry: where a finger can touch it and how to walk around it.

What belongs here: points, outlines and paths in the block's own frame (px, the angle of the block taken out). What
does not: physics, choosing a push.

A pose is (x px, y px, angle rad) of the block's frame, whose origin lies in the middle of the T's flat top.
"""

import math
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from shapely.geometry import LinearRing, Polygon

Point = tuple[float, float]
Pose = tuple[float, float, float]

FINGER_PX = 15.0
"""Radius of the finger."""
STANDOFF_PX = 6.0
"""Between finger and block when a push begins."""
WALK_PX = 10.0
"""A path keeps at least this far from the block, because a fast finger cuts corners; …"""
ARRIVE_PX = 2.0
"""… only its last leg, which ends next to the block, may come this close."""
ESCAPE_PX = 12.0
"""A finger that is closer than a path may come steps back to here first."""
RING_PX = 16.0
"""The ring around the block, which paths follow when the block is in their way, leaves this much room."""
RING_POINTS = 28

OUTLINE: tuple[Point, ...] = (
    (-60, 0), (60, 0), (60, 30), (15, 30), (15, 120), (-15, 120), (-15, 30), (-60, 30),
)  # fmt: skip
MASS_CENTRE: Point = (0.0, 45.0)


class Contact(NamedTuple):
    """A point of the outline that can be pushed, and the direction out of the block there (block frame)."""

    x: float
    y: float
    out_x: float
    out_y: float

    def finger(self, gap: float) -> Point:
        """The finger's centre when it is `gap` px from touching this point."""
        return (self.x + self.out_x * (FINGER_PX + gap), self.y + self.out_y * (FINGER_PX + gap))


def _contacts() -> tuple[Contact, ...]:
    """A few places on each side, so that a demonstrator has habits: with thirty-odd, no two pushes are alike."""
    sides = []
    for side in (1, -1):
        sides += [Contact(side * 60, 15, side, 0), Contact(side * 46, 30, 0, 1)]
        sides += [Contact(side * 15, y, side, 0) for y in (48, 108)]
    return (*(Contact(x, 0, 0, -1) for x in (-48, 0, 48)), *sides, Contact(0, 120, 0, 1))


CONTACTS = _contacts()


def to_world(pose: Pose, point: Point) -> Point:
    """A point of the block's frame on the table."""
    x, y, angle = pose
    cos, sin = math.cos(angle), math.sin(angle)
    return (x + cos * point[0] - sin * point[1], y + sin * point[0] + cos * point[1])


def to_block(pose: Pose, point: Point) -> Point:
    """A point of the table in the block's frame: the inverse of `to_world`."""
    x, y, angle = pose
    cos, sin = math.cos(angle), math.sin(angle)
    dx, dy = point[0] - x, point[1] - y
    return (cos * dx + sin * dy, cos * dy - sin * dx)


def length(path: list[Point]) -> float:
    """Px along a path."""
    return sum(math.dist(a, b) for a, b in pairwise(path))


def targets_along(path: list[Point], speed: float) -> list[Point]:
    """Points along a path, evenly spaced and at most `speed` px apart, the last at its end; the first is one step
    in."""
    total = length(path)
    steps = max(1, math.ceil(total / speed))
    points, walked, leg = [], 0.0, 0
    for k in range(1, steps):
        distance = total * k / steps
        while leg < len(path) - 2 and walked + math.dist(path[leg], path[leg + 1]) < distance:
            walked += math.dist(path[leg], path[leg + 1])
            leg += 1
        a, b = path[leg], path[leg + 1]
        share = (distance - walked) / (math.dist(a, b) or 1.0)
        points.append((a[0] + (b[0] - a[0]) * share, a[1] + (b[1] - a[1]) * share))
    return [*points, path[-1]]


@cache
def _grown(by: float) -> "Polygon":
    """The block grown by the finger's radius and `by` px: where the finger's centre may not be."""
    import shapely

    grown = shapely.Polygon(OUTLINE).buffer(FINGER_PX + by)
    shapely.prepare(grown)
    return grown


@cache
def _ring() -> tuple[Point, ...]:
    """Points around the block's convex hull, in the direction in which the block's angle grows."""
    import shapely

    ring: LinearRing = shapely.Polygon(OUTLINE).convex_hull.buffer(FINGER_PX + RING_PX, quad_segs=2).exterior
    points = [ring.interpolate(i / RING_POINTS, normalized=True).coords[0] for i in range(RING_POINTS)]
    return tuple(points if ring.is_ccw else points[::-1])


def is_clear(a: Point, b: Point, gap: float) -> bool:
    """True where a finger that moves straight from a to b leaves `gap` px between itself and the block."""
    import shapely

    return not _grown(gap).intersects(shapely.LineString([a, b]))


def walk(start: Point, goal: Point, direction: int) -> list[Point] | None:
    """A path for the finger that keeps away from the block: straight where that is possible, else around the block.

    Args:
        direction: +1 walks around in the direction in which the block's angle grows, −1 the other way.

    Returns:
        The path with both ends, or None where there is none.
    """
    import shapely

    path, here = [start], start
    if _grown(WALK_PX).contains(shapely.Point(start)):
        edge = _grown(ESCAPE_PX).exterior
        here = edge.interpolate(edge.project(shapely.Point(start))).coords[0]
        path.append(here)
    if is_clear(here, goal, ARRIVE_PX):
        return [*path, goal]
    first, last = _ring_entry(here, WALK_PX), _ring_entry(goal, ARRIVE_PX)
    if first is None or last is None:
        return None
    ring = _ring()
    steps = (direction * (last - first)) % RING_POINTS
    around = [ring[(first + direction * k) % RING_POINTS] for k in range(steps + 1)]
    return path[:-1] + _pull_tight([here, *around]) + [goal]


def _ring_entry(point: Point, gap: float) -> int | None:
    """The nearest point of the ring that can be reached in a straight line."""
    ring = _ring()
    for i in sorted(range(RING_POINTS), key=lambda i: math.dist(ring[i], point)):
        if is_clear(ring[i], point, gap):
            return i
    return None


def _pull_tight(points: list[Point]) -> list[Point]:
    """The path with every corner left out that a straight line can do without."""
    path, k = [points[0]], 0
    while k < len(points) - 1:
        further = len(points) - 1
        while further > k + 1 and not is_clear(points[k], points[further], WALK_PX):
            further -= 1
        path.append(points[further])
        k = further
    return path

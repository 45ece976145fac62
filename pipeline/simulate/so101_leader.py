"""The scripted leader of the SO-101: how a person's hand could lead the arm from a start state to a placed cube.

What belongs here: the way of the leader arm, frame by frame, and how it is made less than perfect. What does not: what the
follower makes of it and recording it (`so101_demonstrator`).

A way is planned once, from the start state, and then followed without looking: legs between waypoints, each with the speed
profile of least jerk (Flash and Hogan 1985, doi:10.1523/JNEUROSCI.05-07-01688.1985). What a setting draws depends on the
start state's number alone.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.simulate.so101_arm import HIGH_RAD, LOW_RAD, PAN_AXIS_X_M, Grasp, InverseKinematics, least_rolls
from pipeline.simulate.so101_world import CUBE_M, FPS, Start

HOVER_M, GRASP_M, PLACE_M = 0.085, 0.018, 0.021
"""Heights of the grasp point: above the cube, at it, and when it is let go."""
WIDE_RAD, SHUT_RAD, LET_GO_RAD = 0.75, 0.08, 0.6
"""The gripper around the cube, told to close on it (the cube stops it at about 0.2), and when it lets go."""
ASIDE_M = 0.006
"""The fixed jaw comes down this far beside the cube, and moves up to it while the other one closes."""
APPROACH_S, DESCEND_S, CLOSE_S, LIFT_S, PLACE_S, OPEN_S, RETREAT_S, HOME_S = 1.3, 0.8, 0.5, 0.7, 0.8, 0.5, 0.7, 1.2
CARRY_S, CARRY_S_PER_ROOT_M = 0.6, 2.5
SETTLE_S, GRIP_S = 0.15, 0.2
"""It rests this long above the cube and the target, and once the jaws are shut."""
REMEMBERS = 0.9
"""How much of the hand's unsteadiness is left after a frame."""


@dataclass(frozen=True)
class Hand:
    """How the leader is less than perfect; every range is drawn from anew for each demonstration.

    reaction_frames  it begins to move after so many frames, at least and at most
    duration         the share of its usual time that a leg takes
    pause_chance     of a pause above the cube, and of one above the target …
    pause_s          … and how long it is
    bow              how far the way of the cube bends outwards or inwards, as a share of its length
    unsteady_deg     standard deviation of what is added to every joint
    """

    reaction_frames: tuple[int, int] = (0, 14)
    duration: tuple[float, float] = (0.85, 1.2)
    pause_chance: float = 0.3
    pause_s: tuple[float, float] = (0.2, 0.6)
    bow: tuple[float, float] = (-0.15, 0.15)
    unsteady_deg: float = 0.35


@dataclass(frozen=True)
class _Point:
    """A waypoint: a grasp and the opening of the gripper."""

    grasp: Grasp
    gripper_rad: float


def lead(
    start: Start, strategy: int, hand: Hand, random: np.random.Generator, arm: InverseKinematics
) -> np.ndarray | None:
    """[F, 6] rad, where the leader is in each frame; None where the arm cannot get there.

    Args:
        strategy: 0 takes the side of the cube that needs the least roll of the wrist, 1 the next one.
    """
    way = _Way(start.angles_rad, hand, random, arm)
    way.rest(random.integers(*hand.reaction_frames, endpoint=True) / FPS, exactly=True)
    if not _task(way, start, strategy):
        return None
    angles = np.array(way.angles)
    unsteady = np.array(list(_unsteadiness(len(angles), random))) * math.radians(hand.unsteady_deg)
    return np.clip(angles + unsteady, LOW_RAD, HIGH_RAD)


def _task(way: "_Way", start: Start, strategy: int) -> bool:
    """Pick up, carry, place, and go home; False as soon as a leg cannot be done."""
    radius, azimuth = _polar(start.cube[:2])
    yaws = least_rolls(start.cube[2] - azimuth + k * math.pi / 2 for k in range(4))
    held = CUBE_M / 2
    at_cube = Grasp(radius, azimuth, GRASP_M, yaws[strategy], held)
    radius, azimuth = _polar(start.target)
    at_target = replace(at_cube, radius_m=radius, azimuth_rad=azimuth, height_m=PLACE_M)
    open_at = [_Point(replace(g, reach_m=held + ASIDE_M), WIDE_RAD) for g in (_above(at_cube), at_cube)]
    shut_at = [_Point(g, SHUT_RAD) for g in (at_cube, _above(at_cube), _above(at_target), at_target)]
    let_go = [_Point(replace(g, reach_m=held + ASIDE_M), LET_GO_RAD) for g in (at_target, _above(at_target))]
    way_m = math.hypot(at_target.radius_m - at_cube.radius_m, 0.2 * (at_target.azimuth_rad - at_cube.azimuth_rad))
    return (
        way.reach(APPROACH_S, open_at[0])
        and way.maybe_pause()
        and way.move(DESCEND_S, open_at[0], open_at[1])
        and way.rest(SETTLE_S)
        and way.move(CLOSE_S, open_at[1], shut_at[0])
        and way.rest(GRIP_S)
        and way.move(LIFT_S, shut_at[0], shut_at[1])
        and way.move(CARRY_S + CARRY_S_PER_ROOT_M * math.sqrt(way_m), shut_at[1], shut_at[2], bows=True)
        and way.maybe_pause()
        and way.move(PLACE_S, shut_at[2], shut_at[3])
        and way.rest(SETTLE_S)
        and way.move(OPEN_S, shut_at[3], let_go[0])
        and way.move(RETREAT_S, let_go[0], let_go[1])
        and way.glide(HOME_S, np.array([*start.angles_rad[:5], LET_GO_RAD]))
    )


def _polar(place: np.ndarray) -> tuple[float, float]:
    """Radius (m) and azimuth (rad) of x, y from the pan axis."""
    x, y = place[0] - PAN_AXIS_X_M, place[1]
    return math.hypot(x, y), math.atan2(y, x)


def _above(grasp: Grasp) -> Grasp:
    return replace(grasp, height_m=HOVER_M)


class _Way:
    """Frames of the leader so far, and legs that add to them. A leg returns whether it could be done."""

    def __init__(self, angles_rad: np.ndarray, hand: Hand, random: np.random.Generator, arm: InverseKinematics):
        self.angles = [angles_rad.copy()]
        self._hand, self._random, self._arm = hand, random, arm

    def rest(self, seconds: float, exactly: bool = False) -> bool:
        frames = round(seconds * FPS) if exactly else self._frames(seconds)
        self.angles += [self.angles[-1]] * frames
        return True

    def maybe_pause(self) -> bool:
        if self._random.random() < self._hand.pause_chance:
            self.rest(self._random.uniform(*self._hand.pause_s), exactly=True)
        return True

    def glide(self, seconds: float, goal: np.ndarray) -> bool:
        """Every joint straight to its goal."""
        first = self.angles[-1]
        self.angles += [first + share * (goal - first) for share in _least_jerk(self._frames(seconds))]
        return True

    def reach(self, seconds: float, point: _Point) -> bool:
        """From wherever the arm is to a waypoint, joint by joint."""
        goal = self._arm.cold(point.grasp)
        return goal is not None and self.glide(seconds, np.array([*goal, point.gripper_rad]))

    def move(self, seconds: float, a: _Point, b: _Point, bows: bool = False) -> bool:
        """The grasp point from a to b on a line (in polar coordinates about the pan axis), perhaps a bent one."""
        bow = self._bow(a.grasp, b.grasp) if bows else 0.0
        for share in _least_jerk(self._frames(seconds)):
            radius, azimuth, height, reach = (
                (1 - share) * before + share * after for before, after in zip(_place(a), _place(b), strict=True)
            )
            radius += bow * 4 * share * (1 - share)
            grasp = Grasp(radius, azimuth, height, a.grasp.yaw_rad, reach)
            angles = self._arm.near(grasp, self.angles[-1])
            if angles is None:
                return False
            gripper = (1 - share) * a.gripper_rad + share * b.gripper_rad
            self.angles.append(np.array([*angles, gripper]))
        return True

    def _bow(self, a: Grasp, b: Grasp) -> float:
        length = math.hypot(b.radius_m - a.radius_m, 0.2 * (b.azimuth_rad - a.azimuth_rad))
        return self._random.uniform(*self._hand.bow) * length

    def _frames(self, seconds: float) -> int:
        return max(1, round(seconds * self._random.uniform(*self._hand.duration) * FPS))


def _place(point: _Point) -> Sequence[float]:
    g = point.grasp
    return g.radius_m, g.azimuth_rad, g.height_m, g.reach_m


def _least_jerk(frames: int) -> list[float]:
    """Shares of the way after each of so many frames; the last is 1."""
    times = [(k + 1) / frames for k in range(frames)]
    return [10 * t**3 - 15 * t**4 + 6 * t**5 for t in times]


def _unsteadiness(frames: int, random: np.random.Generator) -> Iterator[np.ndarray]:
    """[6] a frame, of unit variance: it drifts."""
    error = random.standard_normal(6)
    for _ in range(frames):
        yield error
        error = REMEMBERS * error + math.sqrt(1 - REMEMBERS**2) * random.standard_normal(6)

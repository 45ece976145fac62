"""Choosing a push in PushT by trying pushes in a second environment: the scripted demonstrator's judgement.

What belongs here: trying straight pushes against every part of the block and choosing one. What does not: carrying
them out and recording them (`pusht_demonstrator`), geometry (`pusht_geometry`).

Pushes are tried in an environment of the planner's own, whose bodies are set to where the recorded ones are. The
recorded environment only ever sees the demonstration's own actions, so replaying these from the same start state
gives the same frames, bit for bit: Chipmunk's solver remembers contacts, and trying pushes in the recorded
environment would leave traces in that memory.
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pipeline.simulate.pusht import TABLE_PX, advance, make_environment
from pipeline.simulate.pusht_geometry import (
    CONTACTS,
    MASS_CENTRE,
    STANDOFF_PX,
    Contact,
    Point,
    Pose,
    length,
    targets_along,
    to_block,
    to_world,
    walk,
)

if TYPE_CHECKING:
    from gym_pusht.envs.pusht import PushTEnv

WALK_SPEED_PX = 18.0
PUSH_SPEED_PX = 12.0
"""Px that the target moves in a frame. The finger lags about two frames behind."""
PAUSE_FRAMES = 2
"""The target rests this long before a push and after it, so that the finger arrives."""
ANGLE_PX = 100.0
"""What a radian of the block's angle weighs against px of its mass centre. More than on the block's rim (60 px), so
that the angle is put right first: a push that turns the block also moves it, one through its mass centre does not
turn it."""
FRAME_PX = 0.3
"""What a frame costs: a push must bring the block this much closer for every frame it takes …"""
NEAR_PX = 40.0
"""… and in proportion less when the block is nearer to the goal than this."""
ANOTHER_PX = 1.5
"""What having to push once more costs, because a push that is only thought of looks better than it is."""
LONGEST_PUSH_PX = 140.0
BEYOND_PX = (0.0, 1.5, 3.0)
"""A push is tried with its last target this far beyond the place that the finger should reach: it lags, and leaves
early."""
SHORTLIST = 8
"""Pushes that are tried in full, with the walk to them …"""
LOOKAHEAD = 4
"""… and the best of those, which are judged by the push that could follow."""
DETOUR = 1.5
"""The demonstrator walks around the block in its own direction unless that is this much longer than the other way."""
MARGIN_PX = 2.0
"""Targets stay this far inside the action space."""


@dataclass(frozen=True)
class State:
    """Where everything is: finger (px), its velocity (px/s), pose of the block."""

    finger: Point
    velocity: Point
    block: Pose


@dataclass(frozen=True)
class Push:
    """A push that was tried: the frames' targets, where it leaves the block according to the trial, and what it costs.

    The first `walk_frames` targets lead to where the push begins.
    """

    targets: list[Point]
    block: Pose
    cost: float
    walk_frames: int


@dataclass(frozen=True)
class _Idea:
    """A push tried without the walk to it: contact, where the finger ends, how good the best moment was."""

    contact: Contact
    end: Point
    cost: float


def state_of(environment: "PushTEnv") -> State:
    agent, block = environment.agent, environment.block
    return State(tuple(agent.position), tuple(agent.velocity), (*block.position, block.angle))


class Planner:
    """Chooses pushes towards the goal pose.

    Args:
        direction: the strategy, +1 or −1: which way around the block the demonstrator prefers to walk.
    """

    def __init__(self, direction: int):
        self._direction = direction
        self._trial = make_environment(0)
        x, y, angle = (float(value) for value in self._trial.goal_pose)
        self._goal_centre, self._goal_angle = to_world((x, y, angle), MASS_CENTRE), angle

    def distance(self, block: Pose) -> float:
        """How far a pose is from the goal, in px."""
        turn = math.remainder(block[2] - self._goal_angle, 2 * math.pi)
        return math.dist(to_world(block, MASS_CENTRE), self._goal_centre) + ANGLE_PX * abs(turn)

    def next_push(self, state: State) -> Push | None:
        """The best push found, or None where the finger can get nowhere."""
        frame_px = FRAME_PX * min(1.0, self.distance(state.block) / NEAR_PX)
        pushes = []
        for idea in self._ideas(state.block, frame_px)[:SHORTLIST]:
            path = self._walk(state, idea.contact)
            if path is not None:
                tried = [self._try_in_full(state, path, idea, beyond, frame_px) for beyond in BEYOND_PX]
                pushes.append(min(tried, key=lambda push: push.cost))
        pushes = sorted(pushes, key=lambda push: push.cost)[:LOOKAHEAD]
        return min(pushes, key=lambda push: self._cost_after_another(push, frame_px), default=None)

    def _cost_after_another(self, push: Push, frame_px: float) -> float:
        """What a push and the best one after it cost together; one push alone is stuck where only two can help."""
        distance, costs = self.distance(push.block), []
        for idea in self._ideas(push.block, frame_px):
            walk_px = math.dist(push.targets[-1], to_world(push.block, idea.contact.finger(STANDOFF_PX)))
            costs.append(idea.cost + frame_px * (walk_px / WALK_SPEED_PX + 2 * PAUSE_FRAMES))
        return push.cost - distance + min(distance, *(cost + ANOTHER_PX for cost in costs))

    def _ideas(self, block: Pose, frame_px: float) -> list[_Idea]:
        """A push at every contact, cheapest first."""
        ideas = (self._try_contact(block, contact, frame_px) for contact in CONTACTS)
        return sorted((idea for idea in ideas if idea), key=lambda idea: idea.cost)

    def _try_contact(self, block: Pose, contact: Contact, frame_px: float) -> _Idea | None:
        """Push straight in at a contact and remember the moment at which the block was closest to the goal."""
        if not _on_table(to_world(block, contact.finger(STANDOFF_PX))):
            return None
        dt = self._trial.dt
        speed = PUSH_SPEED_PX * self._trial.control_hz
        inwards = to_world((0.0, 0.0, block[2]), (-contact.out_x * speed, -contact.out_y * speed))
        self._place(State(to_world(block, contact.finger(0.5)), inwards, block))
        best: _Idea | None = None
        for step in range(1, int(LONGEST_PUSH_PX / (speed * dt)) + 1):
            self._trial.space.step(dt)
            now = state_of(self._trial)
            if not _on_table(now.finger):
                break
            cost = self.distance(now.block) + frame_px * step * dt * self._trial.control_hz
            if best is None or cost < best.cost:
                best = _Idea(contact, now.finger, cost)
            elif cost > best.cost + 40:
                break
        return best

    def _try_in_full(self, state: State, path: list[Point], idea: _Idea, beyond: float, frame_px: float) -> Push:
        """The same push with the walk to it, frame by frame, as the demonstrator would carry it out."""
        inwards = to_world((0.0, 0.0, state.block[2]), (-idea.contact.out_x, -idea.contact.out_y))
        standoff, end = path[-1], (idea.end[0] + beyond * inwards[0], idea.end[1] + beyond * inwards[1])
        targets = targets_along(path, WALK_SPEED_PX) + [standoff] * PAUSE_FRAMES
        walk_frames = len(targets)
        targets += targets_along([standoff, end], PUSH_SPEED_PX) + [end] * PAUSE_FRAMES
        self._place(state)
        for target in targets:
            advance(self._trial, *target)
        block = state_of(self._trial).block
        return Push(targets, block, self.distance(block) + frame_px * len(targets), walk_frames)

    def _walk(self, state: State, contact: Contact) -> list[Point] | None:
        """The way to a contact, on the table: around the block in the preferred direction unless that is a long
        detour."""
        start, goal = to_block(state.block, state.finger), contact.finger(STANDOFF_PX)
        ways = []
        for direction in (self._direction, -self._direction):
            way = walk(start, goal, direction)
            if way is not None:
                ways.append([_clamped(to_world(state.block, point)) for point in way])
        if len(ways) == 2 and length(ways[0]) > DETOUR * length(ways[1]):
            return ways[1]
        return ways[0] if ways else None

    def _place(self, state: State) -> None:
        """Put the trial's bodies into a state, with no memory of earlier contacts."""
        agent, block, space = self._trial.agent, self._trial.block, self._trial.space
        agent.position, agent.velocity = (-2 * TABLE_PX, -2 * TABLE_PX), (0, 0)
        _set_pose(block, state.block)
        for _ in range(space.collision_persistence + 1):
            space.step(self._trial.dt)
        agent.position, agent.velocity = state.finger, state.velocity
        _set_pose(block, state.block)


def _set_pose(block, pose: Pose) -> None:
    """The angle first: setting it turns the block about its mass centre and so moves its frame."""
    block.angle = pose[2]
    block.position = pose[:2]
    block.velocity, block.angular_velocity = (0, 0), 0


def _on_table(point: Point) -> bool:
    return all(MARGIN_PX <= value <= TABLE_PX - MARGIN_PX for value in point)


def _clamped(point: Point) -> Point:
    """A point of a path around a block that lies close to the edge of the table."""
    low, high = MARGIN_PX, TABLE_PX - MARGIN_PX
    return (min(max(point[0], low), high), min(max(point[1], low), high))

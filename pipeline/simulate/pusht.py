"""PushT (`gym-pusht`): a round finger pushes a T-shaped block onto its outline. Positions in px of a 512 × 512 table.

What belongs here: stepping many environments at once and measuring how much of the goal is covered, bit for bit as
`PushTEnv.step` does it, several times faster. What does not: rendering (nothing here opens a window or draws),
roll-outs, the scripted demonstrator.

Start state n is `PushTEnv.reset(seed=n)`. The demonstrations that ship with the project start from numbers of 2³² and
above (`pusht_demonstrator`), so that no roll-out begins where a demonstration began.
"""

import math
import warnings
from collections.abc import Sequence
from importlib import metadata
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import NotApplicableError
from pipeline.safety import Limits
from pipeline.simulate import Outcome
from pipeline.simulate.columns import misfit, misnumbered
from pipeline.types import ACTION, STATE, Demonstrations, ObservationSet

if TYPE_CHECKING:
    from gym_pusht.envs.pusht import PushTEnv

BLOCK = "observation.environment_state"
COLUMNS = {STATE: ("x_px", "y_px"), BLOCK: ("block_x_px", "block_y_px", "block_angle_rad")}
TABLE_PX = 512.0
FPS = 10
MAX_STEPS = 300
FARTHEST_PX = 1e4
"""Whatever is farther away has left the physics: walls stand around the table."""
SUCCESS_COVERAGE = 0.95
"""An episode succeeds above this coverage, and reward is 1 from here on: min(1, coverage / 0.95)."""


def environment_class() -> type["PushTEnv"]:
    """`PushTEnv`, imported when it is needed.

    Raises:
        NotApplicableError: gym-pusht is not installed.
    """
    try:
        with warnings.catch_warnings():
            # pygame asks setuptools' pkg_resources for its fonts; the category of its warning depends on setuptools.
            warnings.filterwarnings("ignore", message="pkg_resources is deprecated")
            from gym_pusht.envs.pusht import PushTEnv
    except ImportError as error:
        raise NotApplicableError(
            f"The PushT simulator is not installed ({error}). Install it with: pip install 'demobench[pusht]'"
        ) from None
    return PushTEnv


def versions() -> dict[str, str]:
    """The packages that PushT's physics and coverage depend on."""
    return {name: metadata.version(name) for name in ("gym-pusht", "pymunk", "shapely")}


def make_environment(number: int) -> "PushTEnv":
    """One environment at start state `number`."""
    environment = environment_class()(obs_type="state")
    environment.reset(seed=number)
    for shape in environment.space.shapes:
        # The environment counts contacts between shapes of type 0, for its `info` only: as much work as the physics.
        shape.collision_type = 1
    return environment


def advance(environment: "PushTEnv", x: float, y: float) -> None:
    """One frame (0.1 s) towards the target (x, y) in px: `PushTEnv.step` without its observation, reward and coverage.

    The order of the arithmetic is the environment's own, on plain floats: a contact turns one different last bit into
    px.
    """
    agent, space, dt = environment.agent, environment.space, environment.dt
    k_p, k_v = environment.k_p, environment.k_v
    for _ in range(int(1 / (dt * environment.control_hz))):
        (px, py), (vx, vy) = agent.position, agent.velocity
        agent.velocity = (vx + (k_p * (x - px) + k_v * (0 - vx)) * dt, vy + (k_p * (y - py) + k_v * (0 - vy)) * dt)
        space.step(dt)


class Coverage:
    """The share of the goal that the block covers, for many environments at once.

    Equal to `PushTEnv`'s to the last bit when the two bars are taken in the same order. The environment takes them in
    that of a Python set, which changes from process to process, and its last bit with it; here the order is fixed.
    """

    def __init__(self, environment: "PushTEnv"):
        import shapely

        # [2, 4, 2] in the block's frame
        self._corners = np.array([shape.get_vertices() for shape in environment._block_shapes])
        goal = environment.get_goal_pose_body(environment.goal_pose)
        self._goal = self._geometry([goal])[0]
        self._goal_area = shapely.area(self._goal)

    def __call__(self, environments: Sequence["PushTEnv"]) -> np.ndarray:
        """[R] coverage in 0 … 1."""
        import shapely

        blocks = self._geometry([environment.block for environment in environments])
        return shapely.area(shapely.intersection(self._goal, blocks)) / self._goal_area

    def _geometry(self, bodies: Sequence) -> np.ndarray:
        """[R] multi-polygons of the two bars of the T. Terms are added in the order in which Chipmunk adds them."""
        import shapely

        cos, sin = np.array([body.rotation_vector for body in bodies])[:, :, None, None].transpose(1, 0, 2, 3)
        tx, ty = np.array([body.position for body in bodies])[:, :, None, None].transpose(1, 0, 2, 3)
        x, y = self._corners[None, :, :, 0], self._corners[None, :, :, 1]
        world = np.stack([cos * x + -sin * y + tx, sin * x + cos * y + ty], axis=-1)  # [R, 2, 4, 2]
        return shapely.multipolygons(shapely.polygons(world))


def pose_columns(environments: Sequence["PushTEnv"]) -> dict[str, np.ndarray]:
    """What the data set calls state and environment state: [R, 2] px and [R, 3] px, px, rad in 0 … 2π; float32."""
    agents = np.array([environment.agent.position for environment in environments])
    blocks = np.array([[*environment.block.position, environment.block.angle] for environment in environments])
    blocks[:, 2] %= 2 * np.pi
    return {STATE: agents.astype(np.float32), BLOCK: blocks.astype(np.float32)}


class PushTEnvironments:
    """R PushT environments that step together (see `pipeline.simulate.Environments`)."""

    def __init__(self, numbers: Sequence[int]):
        self._numbers, self._frame = list(numbers), 0
        self._environments = [make_environment(number) for number in numbers]
        self._coverage = Coverage(self._environments[0])

    def observe(self) -> dict[str, np.ndarray]:
        return pose_columns(self._environments)

    def step(self, actions: np.ndarray, running: np.ndarray) -> Outcome:
        """See `pipeline.simulate.Environments`.

        Raises:
            NotApplicableError: the physics blew up.
        """
        moving = np.flatnonzero(running)
        self._frame += 1
        for i in moving:
            advance(self._environments[i], float(actions[i, 0]), float(actions[i, 1]))
            if not _is_physics(self._environments[i]):
                raise NotApplicableError(
                    f"The physics of PushT blew up at frame {self._frame} of start state {self._numbers[i]}: the finger or the "
                    "block is where nothing can be. Install the versions of gym-pusht and pymunk that constraints.txt names, or "
                    "leave roll-outs of this data set out."
                )
        coverage = np.zeros(len(self._environments))
        if len(moving):
            coverage[moving] = self._coverage([self._environments[i] for i in moving])
        return Outcome(reward_of(coverage), coverage, coverage > SUCCESS_COVERAGE)

    def standing(self) -> np.ndarray:
        return self.observe()[STATE]

    def effector(self) -> np.ndarray:
        return np.array([environment.agent.position for environment in self._environments])


def _is_physics(environment: "PushTEnv") -> bool:
    """Whether everything is somewhere; the walls keep it near the table."""
    agent, block = environment.agent, environment.block
    return all(abs(place) < FARTHEST_PX for place in (*agent.position, *block.position)) and math.isfinite(block.angle)


def reward_of(coverage: np.ndarray) -> np.ndarray:
    """min(1, coverage / 0.95), the environment's reward."""
    return np.clip(coverage / SUCCESS_COVERAGE, 0.0, 1.0)


class PushT:
    """The PushT simulator (see `pipeline.simulate.Simulator`)."""

    name = "pusht"
    max_steps = MAX_STEPS

    def __init__(self):
        environment_class()

    def version(self) -> str:
        return ", ".join(f"{name} {version}" for name, version in versions().items())

    def limits(self) -> Limits:
        """The table. The finger follows its target as fast as its own control lets it."""
        return Limits(COLUMNS[STATE], np.zeros(2), np.full(2, TABLE_PX), np.full(2, np.inf))

    def start(self, numbers: Sequence[int]) -> PushTEnvironments:
        return PushTEnvironments(numbers)

    def fits(self, demos: Demonstrations, observation_set: ObservationSet) -> str | None:
        return misfit(demos, observation_set, "PushT", COLUMNS, lambda key: _problem(demos, key))


def _problem(demos: Demonstrations, key: str) -> str | None:
    """Why a feature is not what PushT calls by that key. A unit that is not known is judged by the size of the
    numbers."""
    expected = COLUMNS[STATE if key == ACTION else key]
    problem = misnumbered(demos, key, expected)
    if problem:
        return problem
    feature = demos.features[key]
    units = tuple(name.rsplit("_", 1)[-1] for name in expected)
    for name, unit, want in zip(feature.names, feature.units, units, strict=True):
        if unit is not None and unit != want:
            return f"{key}, column '{name}', is in {unit}; expected {want}."
    values = demos.columns[key][:, :2]
    if feature.units[0] is None and (values.min() < 0 or not 2 < values.max() <= TABLE_PX):
        return (
            f"{key} runs from {values.min():.3g} to {values.max():.3g} and names no unit; "
            f"expected px in 0 … {TABLE_PX:.0f}."
        )
    return None

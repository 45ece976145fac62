"""Roll-outs as things to see: where they are against the simulators themselves, and the plan against known answers."""

import numpy as np
import pytest

from pipeline.simulate.pusht import BLOCK, Coverage, make_environment
from pipeline.simulate.scene import drawing_of, frames_of, plan_ahead
from pipeline.simulate.so101 import POSE, SO101, World
from pipeline.simulate.so101_world import CUBE_M, model
from pipeline.types import STATE, Scenes

LINE = Scenes(
    {STATE: np.array([[[0.0], [1.0], [2.0], [3.0], [np.nan]]], np.float32)},
    np.array([0, 2]),
    np.array([[[[10.0], [11.0], [12.0]], [[20.0], [21.0], [22.0]]]], np.float32),
)
"""One episode of four frames on a line, asked at frames 0 and 2 for three actions."""


def shapes_of(simulator: str, scenes: Scenes, row: int = 0) -> dict:
    return {shape.name: shape for shape in drawing_of(simulator).shapes(scenes, row)}


def test_an_episode_ends_where_its_frames_do():
    assert frames_of(LINE, 0, STATE)[:, 0].tolist() == [0, 1, 2, 3]


def test_the_plan_is_what_is_left_of_the_last_answer():
    plan = plan_ahead(LINE, 0, frames_of(LINE, 0, STATE), lambda actions: actions)[:, 0, :, 0]
    nothing = np.nan
    expected = [[0, 10, 11, 12], [1, 11, 12, nothing], [2, 20, 21, 22], [nothing] * 4]
    np.testing.assert_array_equal(plan, expected)


def test_a_simulator_that_nobody_drew_has_no_drawing():
    assert drawing_of("line") is None


def test_the_block_and_its_goal_lie_where_the_environment_has_them():
    environment = make_environment(3)
    block, agent = environment.block, environment.agent
    shown = {
        STATE: np.array([[[*agent.position]]], np.float32),
        BLOCK: np.array([[[*block.position, block.angle]]], np.float32),
    }
    shapes = shapes_of("pusht", Scenes(shown, np.array([0]), np.zeros((1, 1, 1, 2), np.float32)))
    coverage = Coverage(environment)
    import shapely

    [exact] = coverage._geometry([block])
    drawn = shapely.Polygon(shapes["block"].points[0, 0])
    assert shapely.area(shapely.symmetric_difference(drawn, shapely.union_all(exact))) < 1
    goal = shapely.Polygon(shapes["goal"].points[0, 0])
    assert shapely.area(shapely.symmetric_difference(goal, shapely.union_all(coverage._goal))) < 1
    np.testing.assert_allclose(shapes["finger"].points[0, 0].mean(axis=0), agent.position, atol=1e-3)


@pytest.fixture(scope="module")
def arm() -> tuple[World, dict]:
    world = World(5)
    state, pose = world.observe()
    told = np.broadcast_to(state, (1, 1, 4, 6)).astype(np.float32)
    return world, shapes_of("so101", Scenes({STATE: state[None, None], POSE: pose[None, None]}, np.array([0]), told))


def test_the_jaws_end_at_the_pads_and_the_cube_stands_where_it_is(arm):
    world, shapes = arm
    tips = shapes["jaws"].points[0][:, 1]
    for side in ("fixed", "moving"):
        pad = world.data.geom(f"{side}_jaw_pad").xpos
        assert np.linalg.norm(tips - pad, axis=1).min() < 0.01, f"{side}: within the pad's length"
    cube = shapes["cube"].points[0].reshape(-1, 3)
    np.testing.assert_allclose(cube.mean(axis=0), world.data.qpos[6:9], atol=2e-4)
    edges = np.linalg.norm(np.diff(shapes["cube"].points[0], axis=1), axis=2)
    np.testing.assert_allclose(edges, CUBE_M, rtol=1e-3)
    at = shapes["target"].points[0, 0].mean(axis=0)[:2]
    np.testing.assert_allclose(at, world.start.target, atol=2e-4)


def test_faces_of_the_cube_look_outwards(arm):
    faces = arm[1]["cube"].points[0]
    normals = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    assert ((faces.mean(axis=1) - faces.mean(axis=(0, 1))) * normals).sum(axis=1).min() > 0


def test_an_opening_gripper_is_drawn_open():
    shut, open_ = (SO101.action_low.copy(), SO101.action_low.copy())
    shut[5], open_[5] = 0, 60
    gaps = []
    for columns in (shut, open_):
        shown = {
            STATE: columns[None, None].astype(np.float32),
            POSE: np.array([[[0.2, 0, 0.015, 1, 0, 0.2, 0.1]]], "f4"),
        }
        jaws = shapes_of("so101", Scenes(shown, np.array([0]), np.zeros((1, 1, 1, 6), "f4")))["jaws"].points[0][:, 1]
        gaps.append(np.linalg.norm(jaws[1] - jaws[3]))
    assert gaps[1] > gaps[0] + 0.03
    assert model().nq == 13

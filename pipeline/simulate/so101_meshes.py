"""The SO-101's links as they look, from the meshes of the installed model, coarse enough for a recording.

What belongs here: shapes of links and where they are. What does not: the world around the arm (`so101_world`), colours (`sinks`).
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from pipeline.simulate.so101_arm import to_angles
from pipeline.simulate.so101_world import model

COARSE_M = 0.004
"""Corners of one cell of this size become one: a few triangles in a hundred are left, and the arm still looks like itself."""


@dataclass(frozen=True)
class Link:
    """One rigid part: corners [v, 3] in metres and triangles [t, 3] in its own frame; `body` is its number in the model."""

    name: str
    body: int
    corners: np.ndarray
    triangles: np.ndarray


@cache
def links() -> tuple[Link, ...]:
    """Every part of the arm that has a mesh, from the base outwards.

    Raises:
        NotApplicableError: the model is not installed.
    """
    world = model()
    found: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
    for geom in range(world.ngeom):
        mesh = int(world.geom_dataid[geom])
        if mesh >= 0 and world.geom_contype[geom] == 0:  # what is there to collide with is not there to look at
            found.setdefault(int(world.geom_bodyid[geom]), []).append(_mesh(world, geom, mesh))
    return tuple(Link(world.body(body).name, body, *_joined(parts)) for body, parts in sorted(found.items()))


def poses(columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns of a data set [n, 6] → where each link is [links, n, 3], and how it is turned [links, n, 4] as x, y, z, w."""
    import mujoco

    world, bodies = model(), [link.body for link in links()]
    data, places, turns = mujoco.MjData(world), [], []
    for angles in to_angles(columns):
        data.qpos[:6] = angles
        mujoco.mj_kinematics(world, data)
        places.append(data.xpos[bodies].copy())
        turns.append(data.xquat[bodies][:, [1, 2, 3, 0]])
    return np.stack(places, axis=1), np.stack(turns, axis=1)


def _mesh(world, geom: int, mesh: int) -> tuple[np.ndarray, np.ndarray]:
    """Corners in the frame of the geom's body, and triangles."""
    import mujoco

    first, count = world.mesh_vertadr[mesh], world.mesh_vertnum[mesh]
    face, faces = world.mesh_faceadr[mesh], world.mesh_facenum[mesh]
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, world.geom_quat[geom])
    corners = world.mesh_vert[first : first + count] @ turn.reshape(3, 3).T + world.geom_pos[geom]
    return _coarse(corners, world.mesh_face[face : face + faces])


def _coarse(corners: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners of one cell of a grid become their mean; triangles that thereby lose a corner, or lie on another, go."""
    cells, member = np.unique(np.floor(corners / COARSE_M).astype(np.int64), axis=0, return_inverse=True)
    member = member.ravel()
    means = np.stack([np.bincount(member, corners[:, axis], len(cells)) for axis in range(3)], axis=1)
    kept = member[triangles]
    kept = kept[(np.diff(np.sort(kept, axis=1), axis=1) > 0).all(axis=1)]
    _, first = np.unique(np.sort(kept, axis=1), axis=0, return_index=True)
    return means / np.bincount(member, minlength=len(cells))[:, None], kept[np.sort(first)]


def _joined(parts: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    before = np.cumsum([0, *(len(corners) for corners, _ in parts)])
    triangles = [part + start for (_, part), start in zip(parts, before[:-1], strict=True)]
    return np.concatenate([corners for corners, _ in parts]), np.concatenate(triangles)

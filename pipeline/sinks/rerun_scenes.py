"""What was recorded, as things in a plane or in space, with the chunks that policies predict now.

    /episode_007/path/goal, block           PushT's, beside the path
    /episode_007/scene/arm/<link>           the SO-101 by its own meshes
    /episode_007/scene/<thing>              what stands beside it
    /episode_007/scene/<policy>/<set>       where the fingertips would go

What belongs here: things as Rerun's entities. What does not: what the things are (`simulate.recorded`), roll-outs
(`rerun_rollouts`).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.simulate.recorded import Arm, things_of
from pipeline.sinks.palette import INK, MUTED, ROLES, is_baseline
from pipeline.sinks.rerun_lines import as_strips
from pipeline.sinks.rerun_rollouts import FRAME, NEARER, TIME, send_shape
from pipeline.types import STATE, Demonstrations, Predictions

PLACES = 8
"""Of a chunk in space, so many actions are drawn, evenly spread and with the last one."""
CHUNKS_HZ = 10.0


def send_things(recording: Any, root: str, demos: Demonstrations, episode: int) -> None:
    for shape in things_of(demos, episode):
        send_shape(recording, f"{root}/{shape.name}", shape, demos.timestamps[demos.episode(episode)])


def send_arm(
    recording: Any,
    root: str,
    demos: Demonstrations,
    episode: int,
    arm: Arm,
    predictions: Sequence[Predictions],
    colours: Sequence[Any],
) -> None:
    """Links once, where they are in every frame; the way of the fingertips, and what of it policies predict."""
    import rerun as rr

    frames = demos.episode(episode)
    state, seconds = demos.columns[STATE][frames], demos.timestamps[frames]
    recording.log(root, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    send_things(recording, root, demos, episode)
    times = _times(seconds, np.arange(len(seconds)))
    for link, places, turns in zip(arm.links, *arm.poses(state), strict=True):
        entity = f"{root}/arm/{link.name}"
        recording.log(entity, _mesh(link), static=True)
        recording.send_columns(entity, times, rr.Transform3D.columns(translation=places, quaternion=turns))
    tips = arm.fingertips(state)
    recording.log(f"{root}/way", rr.LineStrips3D([tips], colors=[MUTED.rgb_on_dark], radii=[-0.75]), static=True)
    for one, colour in zip(predictions, colours, strict=True):
        if not is_baseline(one.policy) and one.actions.shape[2] > 1:
            _send_chunks(
                recording, [*root.strip("/").split("/"), one.policy, one.observations], arm, one, frames, colour, demos
            )


def _send_chunks(
    recording: Any, entity: list[str], arm: Arm, one: Predictions, frames: slice, colour: Any, demos
) -> None:
    """A few times a second: from where the fingertips are, through where they are told to be."""
    import rerun as rr

    inside = one.in_frames(frames)[:: max(round(demos.fps / CHUNKS_HZ), 1)]
    if len(inside) == 0:
        return
    ahead = np.unique(np.linspace(0, one.actions.shape[2] - 1, PLACES).round().astype(int))
    anchors = one.anchors[inside]
    begin = arm.fingertips(demos.columns[STATE][anchors])[:, None]
    strips = np.concatenate([begin, arm.fingertips(one.actions[0, inside][:, ahead])], axis=1)
    path = rr.new_entity_path(entity)
    recording.log(path, rr.LineStrips3D.from_fields(colors=[colour], radii=[-1.5]), static=True)
    lines = rr.LineStrips3D.columns(strips=as_strips(list(strips), 3))
    recording.send_columns(path, _times(demos.timestamps[frames], anchors - frames.start), lines)


def arm_view(root: str, arm: Arm) -> Any:
    """The arm from where a person would stand."""
    import rerun.blueprint as rrb

    target, eye = np.array(arm.view.looks_at), np.array(arm.view.eye)
    controls = rrb.EyeControls3D(position=target + NEARER * (eye - target), look_target=target, eye_up=[0, 0, 1])
    return rrb.Spatial3DView(
        origin=root,
        name="the arm as recorded, and where chunks lead (m)",
        eye_controls=controls,
        line_grid=rrb.LineGrid3D(visible=False),
    )


def _times(seconds: np.ndarray, places: np.ndarray) -> list[Any]:
    import rerun as rr

    return [rr.TimeColumn(TIME, duration=seconds[places]), rr.TimeColumn(FRAME, sequence=places)]


def _mesh(link: Any) -> Any:
    """A link in the robot's colour, jaws and motors alike; light comes from its own normals."""
    import rerun as rr

    colour = bytes.fromhex((ROLES["robot"] if "jaw" not in link.name else INK).dark[1:])
    return rr.Mesh3D(
        vertex_positions=link.corners.astype(np.float32),
        triangle_indices=link.triangles.astype(np.uint32),
        vertex_normals=_normals(link.corners, link.triangles),
        albedo_factor=list(colour),
    )


def _normals(corners: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """[v, 3] the mean of the triangles around each corner, by area."""
    a, b, c = (corners[triangles[:, k]] for k in range(3))
    face = np.cross(b - a, c - a)
    found = np.zeros_like(corners)
    for k in range(3):
        np.add.at(found, triangles[:, k], face)
    length = np.linalg.norm(found, axis=1, keepdims=True)
    return (found / np.where(length > 0, length, 1)).astype(np.float32)

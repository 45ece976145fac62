"""Roll-outs in a Rerun recording: what there was to see, with the chunk predicted just now, all policies side by side.

    /rollouts/<policy>/<observations>/start_003/<thing>    in the plane or in space, as the simulator is drawn

What belongs here: shapes as Rerun's entities, and their tabs. What does not: where things are (`simulate.scene`), held-out episodes
(`to_rerun`).

The way of the effector is there from the start to the end, so that a chunk can be held against what then happened.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.simulate.scene import Camera, Drawing, Shape, drawing_of
from pipeline.sinks.palette import ROLES
from pipeline.sinks.rerun_lines import as_strips
from pipeline.types import Rollouts, Scenes

TIME, FRAME = "time", "frame"

NEARER = 0.6
"""A viewer sees a wider angle than a picture of the drawing does, so its eye stands nearer."""


@dataclass(frozen=True)
class Driven:
    """Roll-outs to show: of the first start states, as many as there are scenes."""

    rollouts: Rollouts
    scenes: Scenes

    @property
    def drawing(self) -> Drawing:
        return drawing_of(self.rollouts.simulator)

    @property
    def start_states(self) -> list[int]:
        """The numbers of those shown."""
        return self.rollouts.start_states[: len(self.scenes.chunks)].tolist()

    def ended(self, row: int) -> str:
        word = self.drawing.done if self.rollouts.success[row] else "failed"
        return f"{word}, {self.rollouts.steps[row] / self.drawing.fps:.1f} s"

    def words(self, row: int) -> str:
        """Which start state, and how it ended."""
        return f"start state {self.rollouts.start_states[row]}: {self.ended(row)}"

    def root(self, row: int) -> str:
        """The entity of one start state, by its number."""
        import rerun as rr

        number = self.rollouts.start_states[row]
        return rr.new_entity_path(["rollouts", self.rollouts.policy, self.rollouts.observations, f"start_{number:03d}"])


def send_rollouts(recording: Any, driven: Driven) -> None:
    """All start states of one policy."""
    import rerun as rr

    fps = driven.drawing.fps
    for row in range(len(driven.scenes.chunks)):
        root = driven.root(row)
        if isinstance(driven.drawing.view, Camera):
            recording.log(root, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for shape in driven.drawing.shapes(driven.scenes, row):
            send_shape(recording, f"{root}/{shape.name}", shape, np.arange(len(shape.points)) / fps)


def rollouts_tabs(driven: Sequence[Driven]) -> list[Any]:
    """A tab a start state; in it a view for each policy, named after how it ended."""
    import rerun.blueprint as rrb

    views: dict[int, list[Any]] = {}
    for one in driven:
        for row, number in enumerate(one.start_states):
            views.setdefault(number, []).append(_view(one, row))
    return [rrb.Grid(*views[number], name=f"start state {number}") for number in sorted(views)]


def _view(driven: Driven, row: int) -> Any:
    import rerun.blueprint as rrb

    drawing = driven.drawing
    name = f"{driven.rollouts.policy} ({driven.rollouts.observations}): {driven.ended(row)}"
    if not isinstance(drawing.view, Camera):
        (left, top), (right, bottom) = drawing.view.low, drawing.view.high
        bounds = rrb.VisualBounds2D(x_range=[left, right], y_range=[top, bottom])
        return rrb.Spatial2DView(origin=driven.root(row), name=name, visual_bounds=bounds)
    target, eye = np.array(drawing.view.looks_at), np.array(drawing.view.eye)
    nearer = target + NEARER * (eye - target)
    eye = rrb.EyeControls3D(position=nearer, look_target=target, eye_up=[0, 0, 1])
    return rrb.Spatial3DView(
        origin=driven.root(row), name=name, eye_controls=eye, line_grid=rrb.LineGrid3D(visible=False)
    )


def send_shape(recording: Any, entity: str, shape: Shape, seconds: np.ndarray) -> None:
    """Looks once, places at the time of every frame; polygons of the plane by their outline."""
    import rerun as rr

    count, dimensions = len(shape.points), shape.points.shape[-1]
    still = count == 1
    colour = [bytes.fromhex(ROLES[shape.role].dark[1:])[channel] for channel in range(3)]
    times = [rr.TimeColumn(TIME, duration=seconds), rr.TimeColumn(FRAME, sequence=np.arange(count))]
    if not shape.width and dimensions == 3:
        recording.log(entity, _mesh_looks(shape, colour), static=True)
        places = shape.points.reshape(count, -1, 3)
        columns = rr.Mesh3D.columns(vertex_positions=places.reshape(-1, 3)).partition([places.shape[1]] * count)
        if still:
            recording.log(entity, rr.Mesh3D.from_fields(vertex_positions=places[0]), static=True)
        else:
            recording.send_columns(entity, times, columns)
        return
    lines = rr.LineStrips2D if dimensions == 2 else rr.LineStrips3D
    closed = shape.points if shape.width else np.concatenate([shape.points, shape.points[:, :, :1]], axis=2)
    strips = [[line[np.isfinite(line[:, 0])] for line in frame] for frame in closed]
    strips = [[line for line in frame if len(line) > 1] for frame in strips]
    radius = shape.width / 2 if shape.width else -1.5
    recording.log(entity, lines.from_fields(colors=[colour], radii=[radius]), static=True)
    if still:
        recording.log(entity, lines.from_fields(strips=strips[0]), static=True)
        return
    columns = lines.columns(strips=as_strips([line for frame in strips for line in frame], dimensions))
    recording.send_columns(entity, times, columns.partition([len(frame) for frame in strips]))


def _mesh_looks(shape: Shape, colour: Sequence[int]) -> Any:
    """Triangles of convex faces, a colour a face: light comes from above."""
    import rerun as rr

    _, faces, corners, _ = shape.points.shape
    fan = np.array([[0, k, k + 1] for k in range(1, corners - 1)])
    triangles = (fan + corners * np.arange(faces)[:, None, None]).reshape(-1, 3)
    first = shape.points[0]
    normals = np.cross(first[:, 1] - first[:, 0], first[:, 2] - first[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    light = 0.7 + 0.3 * np.abs(normals[:, 2:]) - 0.12 * np.abs(normals[:, 1:2])
    colours = np.repeat(np.round(light * np.array(colour)).astype(np.uint8), corners, axis=0)
    return rr.Mesh3D.from_fields(triangle_indices=triangles, vertex_colors=colours)

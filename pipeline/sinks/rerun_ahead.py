"""What comes next, drawn ahead of the time cursor: for every joint the actions that were recorded, and each policy's chunk.

    /episode_007/ahead/lanes                   a line a joint, with its name
    /episode_007/ahead/recorded                [joints] what was commanded from the cursor on
    /episode_007/ahead/<policy>/<observations> [joints] the chunk that the policy predicts at the cursor

What belongs here: chunks of joints as lines in a plane of their own, because a plot over time cannot depend on the cursor. What
does not: positions in a plane (`to_rerun`) and in space (`rerun_scenes`).

A lane is as high as the joint's recorded range in the episode; to the right is the future, as long as the longest chunk. Below the
lanes are the seconds.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.sinks.palette import GRID, INK, MUTED, is_baseline
from pipeline.sinks.rerun_lines import as_strips
from pipeline.sinks.rerun_rollouts import FRAME, TIME
from pipeline.types import ACTION, Demonstrations, Predictions

LANE = 0.8
"""Of each unit of height the part that a lane fills."""
ASPECT = 0.75
"""Width over height of a view that stands alone in its column, on a window of 1500 × 900 px."""
LEFT, RIGHT, TOP, BOTTOM = 0.42, 0.12, 0.2, 0.6
"""Room for names and seconds: left and right in widths of the lanes, above and below in units of height."""
POINTS = 9
"""Of a longer chunk so many actions are drawn, evenly spread, with the first and the last."""
HZ = 10.0
OVER = 0.2
"""How far a line may leave its lane, in heights of it."""


def with_chunks(predictions: Sequence[Predictions]) -> list[int]:
    """The places of trained policies that say more than one action."""
    return [p for p, one in enumerate(predictions) if not is_baseline(one.policy) and one.actions.shape[2] > 1]


def send_ahead(
    recording: Any,
    root: str,
    demos: Demonstrations,
    episode: int,
    predictions: Sequence[Predictions],
    colours: Sequence,
    views: int,
) -> None:
    """`views` are how many stand in the column: the lanes get the shape that is left for them."""
    import rerun as rr

    shown = with_chunks(predictions)
    if not shown:
        return
    frames = demos.episode(episode)
    longest = max(predictions[p].actions.shape[2] for p in shown)
    lanes = _Lanes(demos.columns[ACTION][frames], longest, views)
    root = f"{root}/ahead"
    every = max(round(demos.fps / HZ), 1)
    _send_names(recording, root, demos, lanes)
    here = np.arange(0, frames.stop - frames.start, every)
    recording.log(f"{root}/recorded", rr.LineStrips2D.from_fields(colors=[INK.rgb_on_dark], radii=[-1.5]), static=True)
    _send(recording, f"{root}/recorded", demos, frames, here, lanes.recorded(here))
    for place in shown:
        one = predictions[place]
        inside = one.in_frames(frames)[::every]
        entity = rr.new_entity_path([*root.strip("/").split("/"), one.policy, one.observations])
        recording.log(entity, rr.LineStrips2D.from_fields(colors=[colours[place]], radii=[-1.0]), static=True)
        if len(inside):
            _send(
                recording,
                entity,
                demos,
                frames,
                one.anchors[inside] - frames.start,
                lanes.drawn(one.actions[0, inside]),
            )


class _Lanes:
    """Where values of an episode's recorded actions [n, A] lie, when the longest chunk has `longest` actions."""

    def __init__(self, recorded: np.ndarray, longest: int, views: int):
        self._recorded, self.longest, self.count = recorded, longest, recorded.shape[1]
        self._low, high = recorded.min(axis=0), recorded.max(axis=0)
        self._range = np.where(high > self._low, high - self._low, 1.0)
        self.wide = _wide(self.count, views)

    def drawn(self, values: np.ndarray) -> list[np.ndarray]:
        """Actions from a frame on [m, K, A] → m × A lines [points, 2]; the second axis points down."""
        at = np.unique(np.linspace(0, values.shape[1] - 1, POINTS).round().astype(int))
        share = np.clip((values[:, at] - self._low) / self._range, -OVER, 1 + OVER)
        y = np.arange(self.count) + LANE * (1 - share)
        x = np.broadcast_to((self.wide * at / max(self.longest - 1, 1))[None, :, None], y.shape)
        lines = np.stack([x, y], axis=-1).transpose(0, 2, 1, 3).reshape(-1, len(at), 2)
        return [line[np.isfinite(line).all(axis=1)] for line in lines]

    def recorded(self, places: np.ndarray) -> list[np.ndarray]:
        """As many as the longest chunk from each of these frames on, up to the episode's end."""
        ahead = places[:, None] + np.arange(self.longest)
        inside = ahead < len(self._recorded)
        values = self._recorded[np.minimum(ahead, len(self._recorded) - 1)].astype(np.float64)
        return self.drawn(np.where(inside[..., None], values, np.nan))


def _send(recording: Any, entity: str, demos: Demonstrations, frames: slice, places: np.ndarray, lines: list) -> None:
    import rerun as rr

    seconds = demos.timestamps[frames][places]
    times = [rr.TimeColumn(TIME, duration=seconds), rr.TimeColumn(FRAME, sequence=places)]
    columns = rr.LineStrips2D.columns(strips=as_strips(lines, 2)).partition([len(lines) // len(places)] * len(places))
    recording.send_columns(entity, times, columns)


def _send_names(recording: Any, root: str, demos: Demonstrations, lanes: _Lanes) -> None:
    import rerun as rr

    feature = demos.features[ACTION]
    middles = np.arange(lanes.count) + LANE / 2
    bottoms = [[[0, y + LANE / 2], [lanes.wide, y + LANE / 2]] for y in middles]
    now = [[0, -0.1], [0, lanes.count]]
    recording.log(f"{root}/lanes", rr.LineStrips2D([*bottoms, now], colors=[GRID.rgb_on_dark], radii=-0.5), static=True)
    end_s = (lanes.longest - 1) / demos.fps
    seconds = [f"+{end_s * share:.2f} s" if share else "now" for share in (0, 0.5, 1)]
    below = [[share * lanes.wide, lanes.count + 0.1] for share in (0, 0.5, 1)]
    ticks = rr.Points2D(below, labels=seconds, radii=-0.1, colors=[MUTED.rgb_on_dark], show_labels=True)
    recording.log(f"{root}/seconds", ticks, static=True)
    names = [f"{n} ({unit})" if unit else n for n, unit in zip(feature.names, feature.units, strict=True)]
    places = [[-0.22 * lanes.wide, y] for y in middles]
    labels = rr.Points2D(places, labels=names, radii=-0.1, colors=[MUTED.rgb_on_dark], show_labels=True)
    recording.log(f"{root}/names", labels, static=True)


def _wide(joints: int, views: int) -> float:
    """How wide the lanes of so many joints are."""
    return ASPECT * views * (TOP + joints + BOTTOM) / (LEFT + 1 + RIGHT)


def ahead_view(root: str, demos: Demonstrations, predictions: Sequence[Predictions], views: int) -> Any:
    import rerun.blueprint as rrb

    longest = max(predictions[p].actions.shape[2] for p in with_chunks(predictions))
    count = len(demos.features[ACTION].names)
    wide = _wide(count, views)
    bounds = rrb.VisualBounds2D(x_range=[-LEFT * wide, (1 + RIGHT) * wide], y_range=[-TOP, count + BOTTOM])
    return rrb.Spatial2DView(
        origin=f"{root}/ahead",
        name=f"the next {(longest - 1) / demos.fps:.1f} s from the cursor on · white: recorded",
        visual_bounds=bounds,
    )

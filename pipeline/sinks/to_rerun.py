"""Held-out episodes as one Rerun recording: each joint recorded against predicted, the error over time, and 2-D paths.

    /episode_007/joints/<column>          [frames, series] the state, the recorded action, each policy's first action
    /episode_007/error                    [frames, policies] mean |first action − recorded action| over the columns
    /episode_007/error/floor              where the floor lies that no deterministic policy's mean error is below, if known
    /episode_007/error/disagrees          [frames, policies] the error again, where it is among the policy's largest
    /episode_007/camera/<camera>          the picture of each frame (`rerun_cameras`)
    /episode_007/path/…                   positions in a plane only: where it went, and the chunk predicted just now
    /episode_007/scene/…                  an arm that is known (`rerun_scenes`)
    /episode_007/ahead/…                  joints elsewhere: the chunks predicted just now (`rerun_ahead`)
    /rollouts/…                           roll-outs (`rerun_rollouts`)

What belongs here: entities, their looks, the blueprint, the viewer. What does not: choosing episodes, scores.

Time lines: `time`, seconds from the start of each episode (episodes lie over one another), and `frame`. Policies are
shown by their first seed, at the frames at which they were asked; elsewhere a series has a gap.
"""

import os
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import StoreError
from pipeline.normalize import wrap
from pipeline.simulate.recorded import Arm, arm_of
from pipeline.sinks import replacing
from pipeline.sinks.palette import BASELINES, INK, MUTED, is_baseline, policy_colours
from pipeline.sinks.rerun_ahead import ahead_view, send_ahead, with_chunks
from pipeline.sinks.rerun_cameras import Cameras, camera_entity
from pipeline.sinks.rerun_lines import as_strips
from pipeline.sinks.rerun_rollouts import FRAME, TIME, Driven, rollouts_tabs, send_rollouts
from pipeline.sinks.rerun_scenes import arm_view, send_arm, send_things
from pipeline.sinks.words import common_unit
from pipeline.types import ACTION, STATE, Demonstrations, Predictions, Semantics

EPISODE = "episode_"
VIEWER = "rerun_cli"
START = f"import sys; from {VIEWER}.__main__ import main; sys.exit(main())"
"""`python -m rerun_cli` ends with 0 whatever became of the viewer."""
HIDDEN_AT_FIRST = ("constant_velocity", "mean_action")
DISAGREES = 0.05
"""The share of a policy's answers, those with the largest errors, that are marked: there it disagrees with the recording."""
MARKED = f"◆ a policy's largest {DISAGREES:.0%}"
VIEW_BYTES, BESIDE = 25_000, 4
"""What is written last, the layout and an index of all, takes so much for each view; views of an episode beside its joints'."""
ROW_SHARE, ROOM_SHARE = 0.0355, 0.084
"""The part of a tab's height that the error's view needs for a row of its legend, and for the rest, on a window 900 px high."""
Rgb = tuple[int, int, int]


@dataclass(frozen=True)
class Series:
    """One line of a plot: name in the legend, colour on dark ground, width in points, whether it shows at first."""

    name: str
    colour: Rgb
    width: float
    visible: bool = True


def write_rerun(
    path: Path,
    demos: Demonstrations,
    semantics: Semantics,
    predictions: Sequence[Predictions],
    episodes: Sequence[int],
    *,
    name: str,
    driven: Sequence[Driven] = (),
    floors: Mapping[str, float] | None = None,
    most_bytes: int | None = None,
    everyone: Iterable[str] = (),
) -> list[str]:
    """Write one `.rrd` file that opens with its own layout: a tab an episode, and one for each start state of roll-outs.

    Parameters:
        predictions: of any policies; episodes that a policy was not asked about have no line of it.
        episodes: positions of the episodes to show, in this order.
        name: what the viewer calls the recording.
        driven: roll-outs to show.
        floors: observation set → the floor of the mean error of the first action.
        most_bytes: how large the file may be with cameras in it; None is no limit. Nothing but cameras is left out.
        everyone: all policies of the benchmark, where some are shown: each keeps its colour.

    Returns: why pictures of cameras are missing, if they are.

    Raises:
        StoreError: the file cannot be written.
    """
    import rerun as rr

    predictions = _in_order(predictions)
    lines = [*_recorded_series(), *_policy_series(predictions, everyone)]
    looks, arm, cameras = lines[2:], arm_of(demos), Cameras(demos)
    largest = _largest(demos, semantics, predictions)
    recording = rr.RecordingStream("demobench")
    with replacing(path) as temporary:
        temporary.touch()  # Rerun's own message about a folder that cannot be written names neither cause nor remedy
        recording.save(temporary)
        recording.send_recording_name(name)
        recording.send_property("demobench", rr.AnyValues(**_properties(demos, semantics)))
        for episode in episodes:
            root = episode_root(demos, episode)
            _send_joints(recording, demos, semantics, predictions, episode, lines)
            _send_error(recording, demos, semantics, predictions, episode, looks, floors or {}, largest)
            if has_paths(demos, semantics):
                _send_paths(recording, demos, semantics, predictions, episode, looks)
            else:
                views = 1 + len(demos.cameras) + bool(arm)
                send_ahead(recording, root, demos, episode, predictions, [s.colour for s in looks], views)
            if arm:
                send_arm(recording, f"{root}/scene", demos, episode, arm, predictions, [s.colour for s in looks])
        for one in driven:
            send_rollouts(recording, one)
        recording.flush()
        if most_bytes is not None:
            views = len(episodes) * (len(semantics.kinds) + BESIDE) + sum(len(one.start_states) for one in driven)
            cameras.room = most_bytes - temporary.stat().st_size - VIEW_BYTES * views
        for episode in episodes:
            times = partial(_first_times, demos, demos.episode(episode))
            cameras.send(recording, episode_root(demos, episode), episode, times)
        recording.send_blueprint(_blueprint(demos, semantics, predictions, episodes, driven, cameras, arm))
        recording.flush()
        recording.disconnect()
    return cameras.left_out


def episodes_in(path: Path) -> set[int]:
    """The recorded numbers of the episodes that a recording holds, by Rerun's own reader."""
    from rerun.chunk import RrdReader

    roots = {entity.split("/")[1] for entity in RrdReader(path).store().schema().entity_paths()}
    return {int(root.removeprefix(EPISODE)) for root in roots if root.startswith(EPISODE)}


def view(path: Path, *, wait: bool = True) -> subprocess.Popen:
    """Open a recording in Rerun's viewer, whose server listens on this machine only (127.0.0.1, any free port).

    Raises:
        StoreError: there is no such recording, or the viewer is not installed or cannot be started.
    """
    if not path.is_file():
        raise StoreError(f"There is no recording at {path}. `demobench run` writes one.")
    if find_spec(VIEWER) is None:
        raise StoreError(
            f"Rerun's viewer is not installed here; it comes with rerun-sdk: pip install rerun-sdk==0.41.0. Or open {path} on a "
            "machine that has it; `demobench view` writes an episode to any file with --save."
        )
    command = [sys.executable, "-c", START, "--bind", "127.0.0.1", "--port", "auto", str(path)]
    try:
        viewer = subprocess.Popen(command, env={"RUST_LOG": "error", **os.environ})
    except OSError as error:
        raise StoreError(f"The Rerun viewer cannot be started: {error}. `rerun {path}` opens the same file.") from error
    if wait:
        with suppress(KeyboardInterrupt):
            viewer.wait()
    return viewer


def has_paths(demos: Demonstrations, semantics: Semantics) -> bool:
    """Whether actions are positions in a plane that the state has too, so that a path can be drawn."""
    return (
        STATE in demos.columns
        and semantics.kinds == ("position", "position")
        and all(column is not None for column in semantics.state_column)
        and not any(semantics.circular.get(ACTION, ()))
    )


def episode_root(demos: Demonstrations, episode: int) -> str:
    """The root entity of an episode, by its recorded number: `/episode_007`."""
    return f"/{EPISODE}{demos.episode_ids[episode]:03d}"


def _recorded_series() -> list[Series]:
    return [Series("state", (112, 120, 130), 2.0), Series("recorded action", INK.rgb_on_dark, 3.0)]


def _in_order(predictions: Sequence[Predictions]) -> list[Predictions]:
    """Trained policies, then baselines, then those that are hidden at first: of a long legend the end is cut off."""
    return sorted(predictions, key=lambda one: (is_baseline(one.policy), one.policy in HIDDEN_AT_FIRST))


def _policy_series(predictions: Sequence[Predictions], everyone: Iterable[str]) -> list[Series]:
    """A line a policy × observation set; a policy keeps its colour, a second set is drawn paler."""
    colours = policy_colours([*everyone, *(one.policy for one in predictions)])
    sets: dict[str, list[str]] = {}
    for one in predictions:
        sets.setdefault(one.policy, []).append(one.observations)
    found = []
    for one in predictions:
        known = sets[one.policy]
        paler = min(0.4 * known.index(one.observations), 0.8)
        red, green, blue = (round(c + (255 - c) * paler) for c in colours[one.policy].rgb_on_dark)
        name = one.policy if len(known) == 1 else f"{one.policy} ({one.observations})"
        width = 1.0 if is_baseline(one.policy) else 1.5
        found.append(Series(name, (red, green, blue), width, one.policy not in HIDDEN_AT_FIRST))
    return found


def _properties(demos: Demonstrations, semantics: Semantics) -> dict[str, Any]:
    return {
        "dataset": demos.name,
        "revision": demos.revision or "",
        "content_hash": demos.content_hash,
        "excluded": ", ".join(map(str, demos.excluded)),
        "fps": demos.fps,
        "action_names": list(demos.features[ACTION].names),
        "action_units": [unit or "unknown" for unit in demos.features[ACTION].units],
        "action_kinds": list(semantics.kinds),
    }


def _times(demos: Demonstrations, frames: slice, places: np.ndarray | slice = slice(None)) -> list[Any]:
    """The time columns of some frames (places within the episode)."""
    import rerun as rr

    return [
        rr.TimeColumn(TIME, duration=demos.timestamps[frames][places]),
        rr.TimeColumn(FRAME, sequence=np.arange(frames.stop - frames.start)[places]),
    ]


def _first_times(demos: Demonstrations, frames: slice, count: int) -> list[Any]:
    return _times(demos, frames, slice(count))


def _first_actions(one: Predictions, frames: slice, columns: int) -> np.ndarray:
    """[n, A] the first action predicted at every frame of an episode; NaN where the policy was not asked."""
    actions = np.full((frames.stop - frames.start, columns), np.nan)
    inside = one.in_frames(frames)
    actions[one.anchors[inside] - frames.start] = one.actions[0, inside, 0, :]
    return actions


def _send_series(recording: Any, entity: str, times: list[Any], series: Sequence[Series], values: np.ndarray) -> None:
    """One entity with several lines: values [n, series]. Names and looks are static."""
    import rerun as rr

    looks = rr.SeriesLines(
        names=[s.name for s in series],
        colors=[s.colour for s in series],
        widths=[s.width for s in series],
        visible_series=[s.visible for s in series],
    )
    recording.log(entity, looks, static=True)
    recording.send_columns(entity, times, rr.Scalars.columns(scalars=values))


def _send_joints(recording, demos, semantics, predictions, episode, series) -> None:
    import rerun as rr

    frames = demos.episode(episode)
    action = demos.columns[ACTION][frames]
    predicted = [_first_actions(one, frames, action.shape[1]) for one in predictions]
    for column, joint in enumerate(_column_names(demos)):
        values = [action[:, column], *(p[:, column] for p in predicted)]
        where = semantics.state_column[column]
        has_state = where is not None and semantics.kinds[column] == "position"
        if has_state:
            values.insert(0, demos.columns[STATE][frames, where])
        shown = series if has_state else series[1:]
        entity = rr.new_entity_path([episode_root(demos, episode).strip("/"), "joints", joint])
        _send_series(recording, entity, _times(demos, frames), shown, np.stack(values, axis=1))


def _errors(demos: Demonstrations, semantics: Semantics, one: Predictions) -> np.ndarray:
    """[M] mean |first action − recorded action| over the columns, at every anchor."""
    recorded = demos.columns[ACTION][one.anchors]
    error = one.actions[0, :, 0, :] - recorded
    circular = np.array(semantics.circular.get(ACTION, (False,) * recorded.shape[1]))
    error[:, circular] = wrap(error[:, circular])
    return np.abs(error).mean(axis=1)


def _largest(demos: Demonstrations, semantics: Semantics, predictions: Sequence[Predictions]) -> list[float]:
    """The error from which on each policy is said to disagree: over all that it was asked, not one episode."""
    return [
        float(np.quantile(_errors(demos, semantics, one), 1 - DISAGREES)) if len(one.anchors) else np.inf
        for one in predictions
    ]


def _send_error(recording, demos, semantics, predictions, episode, series, floors, largest) -> None:
    import rerun as rr

    if not predictions:
        return
    frames = demos.episode(episode)
    errors = np.full((frames.stop - frames.start, len(predictions)), np.nan)
    for place, one in enumerate(predictions):
        inside = one.in_frames(frames)
        errors[one.anchors[inside] - frames.start, place] = _errors(demos, semantics, one)[inside]
    entity = f"{episode_root(demos, episode)}/error"
    _send_series(recording, entity, _times(demos, frames), series, errors)
    learned = [p for p, one in enumerate(predictions) if not is_baseline(one.policy)]
    marked = np.where(errors >= np.array(largest), errors, np.nan)[:, learned]
    if np.isfinite(marked).any():
        looks = rr.SeriesPoints(
            names=[MARKED] * len(learned),  # one row of the legend for all of them
            colors=[series[p].colour for p in learned],
            markers=["diamond"] * len(learned),
            marker_sizes=[4.0] * len(learned),
        )
        recording.log(f"{entity}/disagrees", looks, static=True)
        recording.send_columns(f"{entity}/disagrees", _times(demos, frames), rr.Scalars.columns(scalars=marked))
    if floors:
        lines = [Series(f"floor ({name})", INK.rgb_on_dark, 2.0) for name in floors]
        ends = np.array([0, frames.stop - frames.start - 1])
        values = np.tile(list(floors.values()), (2, 1))
        _send_series(recording, f"{entity}/floor", _times(demos, frames, ends), lines, values)


def _send_paths(recording, demos, semantics, predictions, episode, series) -> None:
    """Where the state went (static), where it is now, and the chunk that each policy predicts now."""
    import rerun as rr

    frames = demos.episode(episode)
    root = f"{episode_root(demos, episode)}/path"
    state = demos.columns[STATE][frames][:, list(semantics.state_column)]
    send_things(recording, root, demos, episode)
    recording.log(f"{root}/recorded", rr.LineStrips2D([state], colors=[MUTED.rgb_on_dark], draw_order=0), static=True)
    dot = rr.Points2D.columns(positions=state, colors=[INK.rgb_on_dark] * len(state), radii=np.full(len(state), -4.0))
    recording.send_columns(f"{root}/state", _times(demos, frames), dot)
    for one, look in zip(predictions, series, strict=True):
        inside = one.in_frames(frames)
        if len(inside) == 0:
            continue
        entity = rr.new_entity_path([*root.strip("/").split("/"), one.policy, one.observations])
        chunks = np.concatenate([state[one.anchors[inside] - frames.start][:, None], one.actions[0, inside]], axis=1)
        recording.log(entity, rr.LineStrips2D.from_fields(colors=[look.colour]), static=True)
        strips = rr.LineStrips2D.columns(strips=as_strips(list(chunks), 2))
        recording.send_columns(entity, _times(demos, frames, one.anchors[inside] - frames.start), strips)


def _column_names(demos: Demonstrations) -> list[str]:
    """Names of the action columns, made different where the data set repeats one: they become entities."""
    names = demos.features[ACTION].names
    return [name if names.count(name) == 1 else f"{name}_{place}" for place, name in enumerate(names)]


def _blueprint(demos, semantics, predictions, episodes, driven: Sequence[Driven], cameras: Cameras, arm) -> Any:
    """A tab an episode: joints in a grid, the error below them, what there is to see beside them; then roll-outs."""
    import rerun.blueprint as rrb

    tabs = [_tab(demos, semantics, predictions, episode, cameras, arm) for episode in episodes]
    tabs += rollouts_tabs(driven)
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=0, name="held-out episodes and roll-outs" if driven else "held-out episodes"),
        rrb.TimePanel(state="collapsed", timeline=TIME),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _tab(demos, semantics, predictions, episode: int, cameras: Cameras, arm: Arm | None) -> Any:
    import rerun.blueprint as rrb

    root = episode_root(demos, episode)
    plots = rrb.Grid(*_joint_views(demos, root, episode))
    if predictions:
        shares = _shares(predictions)
        plots = rrb.Vertical(plots, _error_view(demos, root, episode), row_shares=shares)
    seen = [
        rrb.Spatial2DView(origin=camera_entity(root, camera), name=f"camera {camera.key}")
        for camera in cameras.shown(episode)
    ]
    if has_paths(demos, semantics):
        hidden = [f"- {root}/path/{policy}/**" for policy in BASELINES]
        contents = ["+ $origin/**", *hidden]
        unit = common_unit(demos.features[ACTION].units) or "unit unknown"
        seen.append(
            rrb.Spatial2DView(
                origin=f"{root}/path",
                contents=contents,
                name=f"the way recorded, and the chunks predicted now ({unit})",
                visual_bounds=_bounds(demos, semantics),
            )
        )
    if arm:
        seen.append(arm_view(f"{root}/scene", arm))
    if not has_paths(demos, semantics) and with_chunks(predictions):
        seen.append(ahead_view(root, demos, predictions, len(seen) + 1))
    title = f"episode {demos.episode_ids[episode]}"
    if not seen:
        return rrb.Vertical(plots, name=title)
    return rrb.Horizontal(plots, rrb.Vertical(*seen), column_shares=[3, 2], name=title)


def _shares(predictions: Sequence[Predictions]) -> list[float]:
    """Heights of the joints and of the error: its legend is seen whole, but for those that are hidden at first."""
    rows = 1 + sum(one.policy not in HIDDEN_AT_FIRST for one in predictions)  # the floor, and a row each
    error = float(np.clip(ROW_SHARE * rows + ROOM_SHARE, 1 / 3, 1 / 2))
    return [1 - error, error]


def _bounds(demos: Demonstrations, semantics: Semantics) -> Any:
    """The plane of all episodes, so that it stays where it is from one to the next."""
    import rerun.blueprint as rrb

    both = np.concatenate([demos.columns[STATE][:, list(semantics.state_column)], demos.columns[ACTION]])
    low, high = both.min(axis=0), both.max(axis=0)
    margin = 0.04 * (high - low).max()
    (left, top), (right, bottom) = low - margin, high + margin
    return rrb.VisualBounds2D(x_range=[float(left), float(right)], y_range=[float(top), float(bottom)])


def _range(demos: Demonstrations, episode: int, room: float = 0.0) -> Any:
    """The seconds that a plot shows, with room after the end; far enough for a second number on a small plot's axis, which names
    powers of ten only."""
    import rerun as rr
    import rerun.blueprint as rrb

    end_s = max(float(demos.timestamps[demos.episode(episode)].max()), 0.1) * (1 + room)
    end_s = 10.5 if 5 < end_s < 10.5 else end_s
    boundary = rr.TimeRangeBoundary.absolute
    return rrb.archetypes.TimeAxis(view_range=rr.TimeRange(start=boundary(seconds=0.0), end=boundary(seconds=end_s)))


def _joint_views(demos: Demonstrations, root: str, episode: int) -> list[Any]:
    import rerun as rr
    import rerun.blueprint as rrb

    feature = demos.features[ACTION]
    views = []
    for name, unit, entity in zip(feature.names, feature.units, _column_names(demos), strict=True):
        title = f"{name} ({unit})" if unit else name
        views.append(
            rrb.TimeSeriesView(
                origin=rr.new_entity_path([root.strip("/"), "joints", entity]),
                name=title,
                axis_x=_range(demos, episode),
                plot_legend=rrb.PlotLegend(visible=False),
            )
        )
    return views


def _error_view(demos: Demonstrations, root: str, episode: int) -> Any:
    """The error over time. It holds the legend of the whole tab, in room left for it after the episode's end."""
    import rerun.blueprint as rrb

    unit = common_unit(demos.features[ACTION].units)
    title = f"mean |error| of the first action ({unit or 'unit unknown'})"
    return rrb.TimeSeriesView(
        origin=f"{root}/error",
        name=f"{title} · {MARKED} · above, white: recorded",
        axis_x=_range(demos, episode, room=0.4),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
    )

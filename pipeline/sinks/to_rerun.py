"""Held-out episodes as one Rerun recording: each joint recorded against predicted, the error over time, and 2-D paths.

    /episode_007/joints/<column>          [frames, series] the state, the recorded action, each policy's first action
    /episode_007/error                    [frames, policies] mean |first action − recorded action| over the columns
    /episode_007/path/…                   positions in a plane only: where it went, and the chunk predicted just now
    /rollouts/…                           roll-outs (`rerun_rollouts`)

What belongs here: entities, their looks, the blueprint, the viewer. What does not: choosing episodes, scores.

Time lines: `time`, seconds from the start of each episode (episodes lie over one another), and `frame`. Policies are
shown by their first seed, at the frames at which they were asked; elsewhere a series has a gap.
"""

import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import StoreError
from pipeline.normalize import wrap
from pipeline.sinks import replacing
from pipeline.sinks.palette import BASELINES, INK, MUTED, is_baseline, policy_colours
from pipeline.sinks.rerun_rollouts import FRAME, TIME, Driven, rollouts_tab, send_rollouts
from pipeline.sinks.words import common_unit
from pipeline.types import ACTION, STATE, Demonstrations, Predictions, Semantics

EPISODE = "episode_"
VIEWER = "rerun_cli"
HIDDEN_AT_FIRST = ("constant_velocity", "mean_action")
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
) -> None:
    """Write one `.rrd` file that opens with its own layout: a tab an episode, and one for the roll-outs of each policy shown.

    Parameters:
        predictions: of any policies; episodes that a policy was not asked about have no line of it.
        episodes: positions of the episodes to show, in this order.
        name: what the viewer calls the recording.
        driven: roll-outs to show.

    Raises:
        StoreError: the file cannot be written.
    """
    import rerun as rr

    lines = [*_recorded_series(), *_policy_series(predictions)]
    recording = rr.RecordingStream("demobench")
    with replacing(path) as temporary:
        temporary.touch()  # Rerun's own message about a folder that cannot be written names neither cause nor remedy
        recording.save(temporary, default_blueprint=_blueprint(demos, semantics, episodes, driven))
        recording.send_recording_name(name)
        recording.send_property("demobench", rr.AnyValues(**_properties(demos, semantics)))
        for episode in episodes:
            _send_joints(recording, demos, semantics, predictions, episode, lines)
            _send_error(recording, demos, semantics, predictions, episode, lines[2:])
            if has_paths(demos, semantics):
                _send_paths(recording, demos, semantics, predictions, episode, lines[2:])
        for one in driven:
            send_rollouts(recording, one)
        recording.flush()
        recording.disconnect()


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
            f"Rerun's viewer is not installed here; it comes with rerun-sdk: pip install rerun-sdk==0.41.0. Or open "
            f"{path} on a machine that has it."
        )
    command = [sys.executable, "-m", VIEWER, "--bind", "127.0.0.1", "--port", "auto", str(path)]
    try:
        viewer = subprocess.Popen(command)
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


def _policy_series(predictions: Sequence[Predictions]) -> list[Series]:
    """A line a policy × observation set; a policy keeps its colour, a second set is drawn paler."""
    colours = policy_colours(one.policy for one in predictions)
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


def _send_error(recording, demos, semantics, predictions, episode, series) -> None:
    if not predictions:
        return
    frames = demos.episode(episode)
    action = demos.columns[ACTION][frames]
    circular = np.array(semantics.circular.get(ACTION, (False,) * action.shape[1]))
    errors = []
    for one in predictions:
        error = _first_actions(one, frames, action.shape[1]) - action
        error[:, circular] = wrap(error[:, circular])
        errors.append(np.abs(error).mean(axis=1))
    entity = f"{episode_root(demos, episode)}/error"
    _send_series(recording, entity, _times(demos, frames), series, np.stack(errors, axis=1))


def _send_paths(recording, demos, semantics, predictions, episode, series) -> None:
    """Where the state went (static), where it is now, and the chunk that each policy predicts now."""
    import rerun as rr

    frames = demos.episode(episode)
    root = f"{episode_root(demos, episode)}/path"
    state = demos.columns[STATE][frames][:, list(semantics.state_column)]
    recording.log(f"{root}/recorded", rr.LineStrips2D([state], colors=[MUTED.rgb_on_dark], draw_order=0), static=True)
    dot = rr.Points2D.columns(positions=state, colors=[INK.rgb_on_dark] * len(state), radii=np.full(len(state), -4.0))
    recording.send_columns(f"{root}/state", _times(demos, frames), dot)
    for one, look in zip(predictions, series, strict=True):
        inside = one.in_frames(frames)
        if len(inside) == 0:
            continue
        entity = rr.new_entity_path([*root.strip("/").split("/"), one.policy, one.observations])
        chunks = np.concatenate([state[one.anchors[inside] - frames.start][:, None], one.actions[0, inside]], axis=1)
        strips = rr.LineStrips2D.columns(strips=list(chunks), colors=[look.colour] * len(inside))
        recording.send_columns(entity, _times(demos, frames, one.anchors[inside] - frames.start), strips)


def _column_names(demos: Demonstrations) -> list[str]:
    """Names of the action columns, made different where the data set repeats one: they become entities."""
    names = demos.features[ACTION].names
    return [name if names.count(name) == 1 else f"{name}_{place}" for place, name in enumerate(names)]


def _blueprint(demos: Demonstrations, semantics: Semantics, episodes: Sequence[int], driven: Sequence[Driven]) -> Any:
    """A tab an episode: joints in a grid, the error below them, the path beside them where there is one; then roll-outs."""
    import rerun.blueprint as rrb

    tabs = [_tab(demos, semantics, episode) for episode in episodes] + [rollouts_tab(one) for one in driven]
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=0, name="held-out episodes and roll-outs" if driven else "held-out episodes"),
        rrb.TimePanel(state="collapsed", timeline=TIME),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _tab(demos: Demonstrations, semantics: Semantics, episode: int) -> Any:
    import rerun.blueprint as rrb

    root = episode_root(demos, episode)
    plots = [rrb.Grid(*_joint_views(demos, root)), _error_view(demos, root, episode)]
    title = f"episode {demos.episode_ids[episode]}"
    if not has_paths(demos, semantics):
        return rrb.Vertical(*plots, row_shares=[2, 1], name=title)
    hidden = [f"- {root}/path/{policy}/**" for policy in BASELINES]
    path = rrb.Spatial2DView(
        origin=f"{root}/path", contents=["+ $origin/**", *hidden], name="path and predicted chunks"
    )
    return rrb.Horizontal(rrb.Vertical(*plots), path, name=title)


def _joint_views(demos: Demonstrations, root: str) -> list[Any]:
    import rerun as rr
    import rerun.blueprint as rrb

    feature = demos.features[ACTION]
    views = []
    for name, unit, entity in zip(feature.names, feature.units, _column_names(demos), strict=True):
        title = f"{name} ({unit})" if unit else name
        views.append(
            rrb.TimeSeriesView(
                origin=rr.new_entity_path([root.strip("/"), "joints", entity]),
                name=f"{title} · white: recorded",
                plot_legend=rrb.PlotLegend(visible=False),
            )
        )
    return views


def _error_view(demos: Demonstrations, root: str, episode: int) -> Any:
    """The error over time. It holds the legend of the whole tab, in room left for it after the episode's end."""
    import rerun as rr
    import rerun.blueprint as rrb

    unit = common_unit(demos.features[ACTION].units)
    end_s = float(demos.timestamps[demos.episode(episode)].max())
    room = rr.TimeRange(
        start=rr.TimeRangeBoundary.absolute(seconds=0.0),
        end=rr.TimeRangeBoundary.absolute(seconds=max(end_s, 0.1) * 1.4),
    )
    return rrb.TimeSeriesView(
        origin=f"{root}/error",
        name=f"mean |error| of the first action ({unit or 'unit unknown'})",
        axis_x=rrb.archetypes.TimeAxis(view_range=room),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
    )

"""Pictures of single results, as PNG files: what the Dagster UI and MLflow show beside a number.

What belongs here: choosing what of one result to draw. What does not: how a chart looks (`charts`, `planes`), the page
(`figures`).
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.sinks.words import common_unit
from pipeline.types import ACTION, STATE, Demonstrations, RadiusFloor, Semantics

if TYPE_CHECKING:
    from pipeline.train import Trained


def _write(chart: Any, path: Path) -> None:
    from pipeline.sinks.drawing import chart_png

    path.write_bytes(chart_png(chart))


def picture_demonstration(demos: Demonstrations, semantics: Semantics, path: Path) -> None:
    """The first episode: in the plane where its actions are positions in one, else its first action column over time."""
    from pipeline.sinks import charts, planes

    action, frames = demos.features[ACTION], demos.episode(0)
    recorded, unit = demos.columns[ACTION][frames], common_unit(action.units)
    if semantics.kinds == ("position", "position"):
        chart = planes.path_with_chunks(recorded, [], names=action.names, unit=unit, policy="policy")
    else:
        series = {"recorded": recorded[:, 0]}
        if STATE in demos.columns and semantics.state_column[0] is not None and semantics.kinds[0] == "position":
            series["state"] = demos.columns[STATE][frames][:, semantics.state_column[0]]
        seconds = demos.timestamps[frames]
        chart = charts.columns_over_time(seconds, series, unit=action.units[0], name=action.names[0])
    _write(chart, path)


def picture_neighbourhood(demos: Demonstrations, semantics: Semantics, floor: RadiusFloor, path: Path) -> None:
    """The most crowded neighbourhood of a floor in the plane of the first two action columns."""
    from pipeline.sinks import planes

    action, crowded = demos.features[ACTION], floor.crowded
    if crowded is None or len(action.names) < 2:
        return
    columns = semantics.state_column[:2]
    state = None
    if semantics.kinds[:2] == ("position", "position") and None not in columns:
        state = demos.columns[STATE][crowded.probe][list(columns)]
    unit = common_unit(action.units[:2])
    _write(planes.floor_scatter(crowded.actions[:, :2], state, names=action.names[:2], unit=unit), path)


def picture_losses(trained: "Trained", policy: str, everyone: Sequence[str], path: Path) -> None:
    """The loss of every seed. `everyone` names all policies: they decide on the colour of this one."""
    from pipeline.sinks import charts

    _write(charts.loss_curves(trained.steps_logged, trained.losses, policy=policy, everyone=everyone), path)


def picture_horizons(
    metrics: Mapping[str, Any], policy: str, everyone: Sequence[str], demos: Demonstrations, path: Path
) -> None:
    """A policy's error at every horizon beside hold-still's."""
    from pipeline.sinks import charts

    curves = {policy: metrics["error_by_horizon"]}
    if policy != "hold_still":
        curves["hold_still"] = metrics["hold_still_by_horizon"]
    unit = common_unit(demos.features[ACTION].units)
    _write(charts.error_over_horizon(curves, fps=demos.fps, unit=unit, everyone=everyone), path)


def picture_table(table: Mapping[str, Any], path: Path) -> None:
    """First-step errors with their intervals, a bar a policy."""
    from pipeline.sinks import charts

    rows = [row for row in table["policies"] if np.isfinite(row["first_step_mae"] or np.nan)]
    still = next((row["first_step_mae"] for row in rows if row["policy"] == "hold_still"), None)
    _write(charts.chunk_bars(rows, unit=common_unit(table["dataset"]["action_units"]), hold_still=still), path)

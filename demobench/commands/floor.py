"""`demobench floor`: how small an error can get, measured and shown. What does not belong here: any estimator."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from demobench.commands.session import open_dataset, open_session, write_json_to
from pipeline.experiment import parse_horizons, parse_list
from pipeline.types import FloorEstimate, RadiusFloor


def measure_floor(
    argument: str,
    *,
    radius: float | None,
    probes: int,
    min_neighbours: int,
    observations: str | None,
    horizons: str | None,
    config_path: Path | None,
    json_to: str | None,
) -> None:
    """The floors of the states that a benchmark would score, and the notebook's."""
    from pipeline.folds import split_of
    from pipeline.lerobot_format import quality
    from pipeline.statistics.floors import measure_floors
    from pipeline.statistics.radius import radius_floor
    from pipeline.table import dataset_json, floor_json

    session = open_session(config_path, None, json_to)
    asked = parse_horizons(horizons)
    target, demos, semantics = open_dataset(argument, session)
    experiment = target.experiment
    sets = {s.name: s for s in experiment.observation_sets}
    wanted = parse_list(observations) or tuple(sets)
    experiment.require_sets(wanted)
    floors = [
        radius_floor(demos, semantics, sets[name], radius=radius, probes=probes, min_neighbours=min_neighbours)
        for name in wanted
    ]
    split = split_of(experiment, demos)
    settings = {"history": experiment.history, "horizons": asked or experiment.floor_horizons(demos.fps)}
    estimates = [e for name in wanted for e in measure_floors(demos, semantics, sets[name], split, **settings)]
    facts = quality.inspect_dataset(demos, semantics)
    if json_to != "-":
        show_estimates(estimates, facts, session.console)
        show_radius(floors, session.console)
    write_json_to(json_to, {"dataset": dataset_json(facts), "floor": floor_json(floors, estimates)})


def _number(value: float | None, digits: int = 4) -> str:
    return "—" if value is None or value != value else f"{value:.{digits}g}"


LOSSES = {"rmse": "RMSE", "mae": "MAE", "l2": "L2"}


def show_estimates(estimates: Sequence[FloorEstimate], facts: Mapping[str, Any], console: Console) -> None:
    """Every floor in a row: a value with its interval, the span it lies in, or what it does not exceed and why."""
    units = set(facts["action_units"])
    unit = (next(iter(units)) or "unit not stated") if len(units) == 1 else "mixed units"
    table = Table("observations", "frames", "steps ahead", "loss", "floor", "95 % interval", title_justify="left",
                  title=f"How small the error of a deterministic policy can get ({escape(unit)})")  # fmt: skip
    reasons: dict[str, None] = {}
    for floor in estimates:
        if floor.refused:
            reasons[floor.refused] = None
            number = f"[yellow]({list(reasons).index(floor.refused) + 1})[/]"
            value = f"not above {_number(floor.below)} {number}" if floor.below is not None else f"— {number}"
        elif floor.upper is not None:
            value = f"{_number(floor.value)} … {_number(floor.upper)}"
        else:
            value = f"[bold]{_number(floor.value)}[/]"
        interval = f"{_number(floor.interval[0])} … {_number(floor.interval[1])}" if floor.interval else "—"
        table.add_row(
            escape(floor.observations), str(floor.history), str(floor.horizon), LOSSES[floor.loss], value, interval
        )
    console.print(table)
    for number, reason in enumerate(reasons, 1):
        console.print(f"[yellow]({number})[/] {escape(reason)}")
    console.print(
        "A floor belongs to its observation set: a policy that sees more may go below it. RMSE: squared errors, extrapolated to "
        "states that look exactly alike (gamma). MAE and L2: the floor lies between the two ends (pair distance).\n",
        style="dim",
    )


def show_radius(floors: Sequence[RadiusFloor], console: Console) -> None:
    """The notebook's floors, a row each, and what that estimator is worth."""
    table = Table("observations", "radius", "probes", "median group", "mean", "90th percentile", "unit", title_justify="left",
                  title="Spread of the actions among frames that look alike (estimator: radius)")  # fmt: skip
    for floor in floors:
        radius = _number(floor.radius, 3) + (" deviations" if floor.scaled else "")
        if floor.refused:
            table.add_row(escape(floor.observations), radius, str(floor.probes), "—", "—", "—", "")
            continue
        table.add_row(
            escape(floor.observations), radius, str(floor.probes), _number(floor.median_neighbours), f"{floor.mean:.2f}",
            f"{floor.p90:.2f}", floor.unit or "?",
        )  # fmt: skip
    console.print(table)
    for floor in floors:
        if floor.refused:
            console.print(f"[yellow]{escape(floor.observations)}:[/] {escape(floor.refused)}")
    console.print(
        "This is the estimator of the notebook that this project grew from, kept to reproduce its published numbers. It is "
        "biased: a group's own mean is inside the group, neighbours may be copies in time, only dense places count, and a wide "
        "radius adds the variation of the mean. It is an L2 distance, so it bounds no mean absolute error.",
        style="dim",
    )

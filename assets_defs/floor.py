"""The floor: how small can the error of any deterministic policy get on these demonstrations, and do people do several things?"""

from pathlib import Path

import dagster as dg

from assets_defs.data import PARTITIONS, demonstrations, episode_split
from assets_defs.plan import FLOOR, Unit
from assets_defs.resources import Bench, Budget, Outcome, Workbench, check_spec, code_version, result
from assets_defs.show import interval_words, picture, present, table

KEY = dg.AssetKey(["multimodality_floor"])
MODES = dg.AssetKey(["action_modes"])
ESTIMATES = "estimates.json"
"""Where the asset `multimodality_floor` keeps the floors of each loss."""


@dg.asset(
    partitions_def=PARTITIONS,
    group_name="floor",
    kinds={"numpy", "scipy"},
    deps=[demonstrations, episode_split],
    code_version=code_version("multimodality_floor"),
    check_specs=[check_spec(KEY, "answered_or_refused", "Every floor is a finite number or says why there is none.")],
)
def multimodality_floor(
    context: dg.AssetExecutionContext, workbench: dg.ResourceParam[Workbench], budget: Budget
) -> dg.MaterializeResult:
    """How small the error of any deterministic policy can get: people do different things in the same place.

    One floor for every observation set, horizon and loss, on the states where policies are scored: `gamma` for the squared
    error, `pair_distance` for the others; or the reason why there is none. What a policy sees decides what looks alike, so a
    floor for joints says nothing about a policy that sees a camera. `radius` is the notebook's estimator, kept to reproduce
    published numbers; it is biased.
    """
    bench = workbench.open(context, budget)
    unit = Unit("multimodality_floor")
    made = bench.make(unit, lambda draft: _measure(bench, draft))
    folder = bench.plan.folder(unit)
    pictures = {
        f"neighbourhood_{s.name}": picture(folder / f"neighbourhood_{s.name}.png")
        for s in bench.experiment.observation_sets
    }
    header = ["observations", "horizon", "loss", "floor", "not above", "95 % interval", "refused"]
    old = ["observations", "radius", "probes", "median group", "mean", "90th percentile", "unit", "refused"]
    metadata = {
        "floors": table(header, made.summary["estimates"]),
        "radius (the notebook's)": table(old, made.summary["rows"]),
        **pictures,
    }
    return result(bench, KEY, {"": made}, present(metadata), ["answered_or_refused"])


def _measure(bench: Bench, draft: Path) -> Outcome:
    from pipeline.sinks.pictures import picture_neighbourhood
    from pipeline.statistics.floors import measure_floors, save_estimates
    from pipeline.statistics.radius import radius_floor, save_floors

    demos, semantics, sets = bench.demonstrations, bench.semantics, bench.experiment.observation_sets
    floors = [radius_floor(demos, semantics, s, **FLOOR) for s in sets]
    save_floors(floors, draft / "radius.json")
    for floor in floors:
        picture_neighbourhood(demos, semantics, floor, draft / f"neighbourhood_{floor.observations}.png")
    history, horizons = bench.experiment.history, bench.experiment.floor_horizons(demos.fps)
    estimates = []
    for done, s in enumerate(sets):
        bench.progress("floors", done, len(sets), s.name)
        estimates += measure_floors(demos, semantics, s, bench.split, history=history, horizons=horizons)
    save_estimates(estimates, draft / ESTIMATES)
    rows = [(f.observations, f.radius, f.probes, f.median_neighbours, f.mean, f.p90, f.unit, f.refused) for f in floors]
    sound = all(f.refused or (f.mean == f.mean and f.mean >= 0) for f in floors)
    sound &= all((e.value is None) != (e.refused is None) for e in estimates)
    answered = sum(e.value is not None for e in estimates)
    return Outcome(
        {
            "rows": [[None if v != v else v for v in row] for row in rows],
            "estimates": [
                (e.observations, e.horizon, e.loss, e.value, e.upper or e.below, interval_words(e.interval), e.refused)
                for e in estimates
            ],
        },
        {"answered_or_refused": (sound, f"{answered} of {len(estimates)} floors have a value; the rest say why not")},
    )


@dg.asset(
    key=MODES,
    partitions_def=PARTITIONS,
    group_name="floor",
    kinds={"pytorch"},
    deps=[demonstrations],
    code_version=code_version("action_modes"),
    check_specs=[check_spec(MODES, "said_or_refused", "Every observation set and horizon has an answer or a reason.")],
)
def action_modes(
    context: dg.AssetExecutionContext, workbench: dg.ResourceParam[Workbench], budget: Budget
) -> dg.MaterializeResult:
    """Do people do clearly different things at the same observation? Evidence of modes, apart from any floor.

    One small network with one Gaussian against the same network with a mixture, both scored on episodes they did not see.
    Many apparent modes are missing information: look at the larger observation sets.
    """
    bench = workbench.open(context, budget)
    made = bench.make(Unit("action_modes"), lambda draft: _look_for_modes(bench, draft))
    header = ["observations", "horizon", "gain, nats a state", "share of states with several peaks", "answer"]
    return result(bench, MODES, {"": made}, {"modes": table(header, made.summary["rows"])}, ["said_or_refused"])


def _look_for_modes(bench: Bench, draft: Path) -> Outcome:
    from dataclasses import asdict

    from pipeline.statistics.modes import evidence_of_modes
    from pipeline.store import write_json
    from pipeline.table import json_safe

    demos, sets = bench.demonstrations, bench.experiment.observation_sets
    found = []
    for seen in sets:
        found += evidence_of_modes(
            demos,
            bench.semantics,
            seen,
            history=bench.experiment.history,
            horizons=bench.experiment.floor_horizons(demos.fps),
            on_step=lambda done, total, loss, name=seen.name: bench.progress(
                f"modes {name}", done, total, f"loss {loss:.4g}"
            ),
        )
    write_json(draft / "modes.json", json_safe([asdict(one) for one in found]))
    rows = [(one.observations, one.horizon, one.gain, one.share, one.words or one.refused) for one in found]
    answered = sum(one.found is not None for one in found)
    sound = all((one.found is None) == (one.refused is not None) for one in found)
    return Outcome({"rows": rows}, {"said_or_refused": (sound, f"{answered} of {len(found)} answered")})


ASSETS = [multimodality_floor, action_modes]

"""The floor: how small can the error of any deterministic policy get on these demonstrations?"""

import dagster as dg

from assets_defs.data import PARTITIONS, demonstrations
from assets_defs.plan import FLOOR, Unit
from assets_defs.resources import Budget, Outcome, Workbench, check_spec, code_version, result
from assets_defs.show import picture, present, table

KEY = dg.AssetKey(["multimodality_floor"])


@dg.asset(
    partitions_def=PARTITIONS,
    group_name="floor",
    kinds={"numpy", "scipy"},
    deps=[demonstrations],
    code_version=code_version("multimodality_floor"),
    check_specs=[check_spec(KEY, "answered_or_refused", "Every floor is a finite number or says why there is none.")],
)
def multimodality_floor(
    context: dg.AssetExecutionContext, workbench: dg.ResourceParam[Workbench], budget: Budget
) -> dg.MaterializeResult:
    """The spread of actions among frames that look alike: an error that no deterministic policy can go below.

    `radius` is the notebook's estimator, kept to reproduce published numbers. It is biased: it counts each group's own mean,
    copies in time, and the variation of the mean within the radius.
    """
    bench = workbench.open(context, budget)

    def measure(draft):
        from pipeline.sinks.pictures import picture_neighbourhood
        from pipeline.statistics.floors import radius_floor, save_floors

        sets = bench.experiment.observation_sets
        floors = [radius_floor(bench.demonstrations, bench.semantics, s, **FLOOR) for s in sets]
        save_floors(floors, draft / "floors.json")
        for floor in floors:
            name = f"neighbourhood_{floor.observations}.png"
            picture_neighbourhood(bench.demonstrations, bench.semantics, floor, draft / name)
        rows = [
            (f.observations, f.radius, f.probes, f.median_neighbours, f.mean, f.p90, f.unit, f.refused) for f in floors
        ]
        sound = all(f.refused or (f.mean == f.mean and f.mean >= 0) for f in floors)
        return Outcome(
            {"rows": [[None if v != v else v for v in row] for row in rows]},
            {
                "answered_or_refused": (
                    sound,
                    "; ".join(f"{f.observations}: {f.refused or f'{f.mean:.4g}'}" for f in floors),
                )
            },
        )

    unit = Unit("multimodality_floor")
    made = bench.make(unit, measure)
    header = ["observations", "radius", "probes", "median group", "mean", "90th percentile", "unit", "refused"]
    folder = bench.plan.folder(unit)
    pictures = {f"neighbourhood_{s.name}": picture(folder / f"neighbourhood_{s.name}.png") for s in
                bench.experiment.observation_sets}  # fmt: skip
    metadata = {"floor": table(header, made.summary["rows"]), **pictures}
    return result(bench, KEY, {"": made}, present(metadata), ["answered_or_refused"])


ASSETS = [multimodality_floor]

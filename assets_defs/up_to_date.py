"""Which results are out of date, said in the UI: a check of the table, which a sensor keeps true.

Dagster's own "unsynced" compares code and inputs. It cannot know of settings: a code version belongs to an asset, settings to one
of its partitions. The plan knows, and this is where it is shown.
What does not belong here: finding out (`plan`), and making what is out of date (`automation`).
"""

import json
from collections.abc import Mapping

import dagster as dg

from assets_defs.plan import Plan
from assets_defs.resources import Workbench
from assets_defs.show import table
from pipeline.errors import DemobenchError
from pipeline.store import MADE

CHECK = "up_to_date"
TABLE = dg.AssetKey(["benchmark_table"])
WORDS = (
    "The results of every data set that has a table are those that its data, settings and code of today give. Those that are "
    "not are named, with the reason; `demobench run` and Materialize all make them. Looked at every minute; it stops nothing."
)
JUST_MADE = "the table was made just now; what else there is in the store is looked at within a minute"


def out_of_date(workbench: Workbench, key: str) -> dict[str, str]:
    """The assets of a partition that were made and have to be made again, and why; what was never made Dagster shows itself."""
    experiment = workbench.experiment(key)
    # Whether a branch of the Hub moved is a sensor's question, and not every minute's.
    look = not experiment.dataset.source.startswith("hub:")
    plan = Plan(workbench.store, key, experiment, workbench.policies_of(experiment), look_at_source=look)
    found: dict[str, str] = {}
    for unit, why in plan.stale().items():
        if plan.store.made(plan.folder(unit)) and not plan.is_fresh(unit):
            found.setdefault(unit.asset, why)
    return found


def evaluation(found: Mapping[str, Mapping[str, str]]) -> dg.AssetCheckEvaluation:
    """What the check says; `found` is data set → asset → why."""
    rows = [(key, asset, why) for key, stale in found.items() for asset, why in stale.items()]
    words = "; ".join(f"{key}: {len(stale)} assets are out of date" for key, stale in found.items() if stale)
    return dg.AssetCheckEvaluation(
        asset_key=TABLE,
        check_name=CHECK,
        passed=not rows,
        severity=dg.AssetCheckSeverity.WARN,
        metadata={
            "why": words or f"{', '.join(found)}: up to date",
            "out_of_date": table(["data set", "asset", "why"], rows),
        },
    )


def _is_unsaid(instance: dg.DagsterInstance) -> bool:
    """Whether a run that was to say it ended before it did: the UI shows nothing then, until it is said again."""
    last = instance.get_latest_asset_check_evaluation_record(dg.AssetCheckKey(TABLE, CHECK))
    if last is None or last.status.value != "PLANNED":
        return False
    run = instance.get_run_by_id(last.run_id)
    return run is None or run.is_finished


@dg.sensor(
    name="say_what_is_out_of_date",
    minimum_interval_seconds=60,
    default_status=dg.DefaultSensorStatus.RUNNING,
    description=f"Keeps the check `{CHECK}` of benchmark_table true: settings and data may change without a run.",
)
def say_what_is_out_of_date(
    context: dg.SensorEvaluationContext, workbench: dg.ResourceParam[Workbench]
) -> dg.SensorResult | dg.SkipReason:
    """Say it again where it changed, and where a table that was made since said something for its own data set alone."""
    tables, found = {}, {}
    for key in dict.fromkeys([*workbench.config.datasets, *workbench.store.experiments()]):
        made = workbench.store.folder(key, "benchmark_table") / MADE
        if made.exists():
            tables[key] = made.stat().st_mtime_ns
            try:
                found[key] = out_of_date(workbench, key)
            except DemobenchError as error:
                found[key] = {"demonstrations": str(error)}
    cursor = json.dumps([tables, found])
    if not found or (cursor == context.cursor and not _is_unsaid(context.instance)):
        return dg.SensorResult(skip_reason=dg.SkipReason("nothing changed"), cursor=context.cursor)
    return dg.SensorResult(asset_events=[evaluation(found)], cursor=cursor)

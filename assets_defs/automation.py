"""What runs by itself (a weekly schedule, and the sensor that makes the file's data sets appear as partitions), and the jobs."""

from collections.abc import Iterator, Sequence
from typing import Any

import dagster as dg

from assets_defs.data import PARTITIONS
from assets_defs.plan import Plan
from assets_defs.resources import Workbench, asset_keys
from pipeline.config import Config
from pipeline.experiment import Variant

BENCHMARK = "benchmark"
REBENCHMARK = "rebenchmark"
CURVE = "curve"
"""Not part of a benchmark: it trains for longer than one."""


def automation(config: Config, policies: Sequence[Variant]) -> dict[str, list[Any]]:
    """The `jobs`, `schedules` and `sensors` of the definitions."""
    named_only = [v.name for v in policies if v.only_when_named]
    learning_curve = dg.AssetSelection.assets("learning_curve")
    everything = dg.AssetSelection.all() - dg.AssetSelection.groups(*named_only) - learning_curve
    benchmark = dg.define_asset_job(
        BENCHMARK,
        selection=everything,
        description="One whole benchmark of one data set: from its demonstrations to the table, the page and the recordings.",
    )
    rebenchmark = dg.define_asset_job(
        REBENCHMARK,
        selection=everything,
        description="The same, for what is out of date: a result whose data, settings and code did not change is kept.",
    )
    curve = dg.define_asset_job(
        CURVE,
        selection=learning_curve,
        description="Would more demonstrations help? Trains one policy on parts of the training episodes; its predictions must be "
        "there. The policy is the data set's champion, or the one named in the launchpad.",
    )
    return {
        "jobs": [benchmark, rebenchmark, curve],
        "schedules": [_weekly(config, rebenchmark)],
        "sensors": [register_datasets],
    }


def stale_assets(workbench: Workbench, key: str) -> list[dg.AssetKey]:
    """The assets of a partition that have work to do, as keys; policies that must be named are left out."""
    by_itself = tuple(v.name for v in workbench.variants if not v.only_when_named)
    plan = Plan(workbench.store, key, workbench.experiment(key), workbench.variants, by_itself)
    return asset_keys(plan.stale())


def _weekly(config: Config, job: Any) -> dg.ScheduleDefinition:
    @dg.schedule(
        name="weekly_rebenchmark",
        job=job,
        cron_schedule=config.schedule.cron,
        description="Materialises what is out of date, one run a data set; nothing where nothing changed.",
    )
    def weekly_rebenchmark(
        context: dg.ScheduleEvaluationContext, workbench: dg.ResourceParam[Workbench]
    ) -> Iterator[dg.RunRequest | dg.SkipReason]:
        ready = set(context.instance.get_dynamic_partitions(str(PARTITIONS.name)))
        requests = [
            dg.RunRequest(partition_key=key, asset_selection=stale)
            for key in workbench.config.datasets
            if key in ready and (stale := stale_assets(workbench, key))
        ]
        if requests:
            yield from requests
        else:
            yield dg.SkipReason("every data set is up to date")

    return weekly_rebenchmark


@dg.sensor(
    name="register_datasets",
    minimum_interval_seconds=30,
    default_status=dg.DefaultSensorStatus.RUNNING,
    description="Makes every data set of the configuration, and every one that was benchmarked from the command line, a "
    "partition.",
)
def register_datasets(context: dg.SensorEvaluationContext, workbench: dg.ResourceParam[Workbench]) -> dg.SensorResult:
    """Add what is missing; nothing is ever removed."""
    known = set(context.instance.get_dynamic_partitions(str(PARTITIONS.name)))
    wanted = [*workbench.config.datasets, *workbench.store.experiments()]
    missing = [key for key in dict.fromkeys(wanted) if key not in known]
    if not missing:
        return dg.SensorResult(skip_reason=dg.SkipReason("every data set is a partition already"))
    return dg.SensorResult(dynamic_partitions_requests=[PARTITIONS.build_add_request(missing)])

"""What runs by itself (a weekly schedule; sensors of new revisions, new data sets and failed runs), and the jobs."""

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from threading import Thread
from typing import Any

import dagster as dg

from assets_defs.data import PARTITIONS
from assets_defs.plan import Plan, Unit
from assets_defs.resources import Workbench, asset_keys
from assets_defs.up_to_date import say_what_is_out_of_date
from pipeline import errors
from pipeline.config import Config
from pipeline.errors import ConfigError, DemobenchError
from pipeline.experiment import Variant

BENCHMARK = "benchmark"
REBENCHMARK = "rebenchmark"
CURVE = "curve"
"""Not part of a benchmark: it trains for longer than one."""
SCORE = "score"
"""Not part of a benchmark: somebody has to name a file. Its results stay in the table while they are up to date."""


def automation(config: Config, policies: Sequence[Variant]) -> dict[str, list[Any]]:
    """The `jobs`, `schedules` and `sensors` of the definitions."""
    named_only = [v.name for v in policies if v.only_when_named]
    learning_curve = dg.AssetSelection.assets("learning_curve")
    with_scores = dg.AssetSelection.all() - dg.AssetSelection.groups(*named_only) - learning_curve
    everything = with_scores - dg.AssetSelection.assets("scored_predictions")
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
    score = dg.define_asset_job(
        SCORE,
        selection=with_scores,
        description="Predictions made elsewhere become a row of the table: name their file in the launchpad (docs/scoring.md).",
    )
    return {
        "jobs": [benchmark, rebenchmark, curve, score],
        "schedules": [_weekly(config, rebenchmark)],
        "sensors": [register_datasets, _new_revision(rebenchmark), run_failed, say_what_is_out_of_date],
    }


def check_cron(config: Config) -> None:
    """Whether Dagster can work out when it is time.

    Raises:
        ConfigError: the cron line is none, or stands for a day that never comes.
    """
    cron = config.schedule.cron
    try:
        dg.ScheduleDefinition(cron_schedule=cron, job_name=REBENCHMARK)
    except dg.DagsterInvalidDefinitionError:
        raise ConfigError(
            f"[schedule] cron is '{cron}', which is no time. Write minute, hour, day of the month, month and day of the week with "
            'spaces between, for example "0 3 * * 1" (Mondays at 03:00 UTC), or a word like "@weekly".'
        ) from None


def stale_assets(workbench: Workbench, key: str) -> list[dg.AssetKey]:
    """The assets of a partition that have work to do, as keys; policies that must be named are left out."""
    experiment = workbench.experiment(key)
    policies = workbench.policies_of(experiment)
    by_itself = tuple(v.name for v in policies if not v.only_when_named)
    plan = Plan(workbench.store, key, experiment, policies, by_itself)
    return asset_keys(plan.stale())


def requests_for(
    workbench: Workbench, keys: Iterable[str], say: Callable[[str], None], run_key: Callable[[str], str]
) -> list[dg.RunRequest]:
    """A run for each data set that has work to do. One that cannot be looked at must not keep the others from theirs: what is
    wrong with it goes to `say`, and its run, which fails and says the same where people look, is asked for all the same."""
    requests = []
    for key in keys:
        try:
            stale = stale_assets(workbench, key)
        except DemobenchError as error:
            say(f"{key}: {error}")
            stale = asset_keys([Unit("demonstrations")])
        if stale:
            requests.append(dg.RunRequest(run_key=run_key(key), partition_key=key, asset_selection=stale))
    return requests


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
        keys = [key for key in workbench.config.datasets if key in ready]
        tick = context.scheduled_execution_time.strftime("%Y-%m-%dT%H:%MZ")
        requests = requests_for(workbench, keys, context.log.warning, lambda key: f"{key}@{tick}")
        if requests:
            yield from requests
        elif keys:
            yield dg.SkipReason("every data set is up to date")
        else:
            yield dg.SkipReason(
                "no data set of the configuration is a partition yet; the sensor register_datasets makes them"
            )

    return weekly_rebenchmark


def _new_revision(job: Any) -> dg.SensorDefinition:
    @dg.sensor(
        name="new_hub_revision",
        job=job,
        minimum_interval_seconds=900,
        description="Re-benchmarks a data set of the Hub when its branch or tag points at a commit that was not seen before. A "
        "pinned commit never moves; a Hub that is out of reach is asked again at the next tick.",
    )
    def new_hub_revision(
        context: dg.SensorEvaluationContext, workbench: dg.ResourceParam[Workbench]
    ) -> dg.SensorResult | dg.SkipReason:
        seen = json.loads(context.cursor or "{}")
        ready = set(context.instance.get_dynamic_partitions(str(PARTITIONS.name)))
        commits = {key: commit for key, commit in _commits(workbench.config) if key in ready}
        found = {key: commit for key, commit in commits.items() if commit is not None and seen.get(key) != commit}
        if not found:
            silent = [key for key, commit in commits.items() if commit is None]
            again = f"; asked again at the next tick, as the Hub did not say: {', '.join(silent)}" if silent else ""
            return dg.SkipReason(f"no data set of the Hub has moved{again}")
        requests = requests_for(workbench, found, context.log.warning, lambda key: f"{key}@{found[key]}")
        return dg.SensorResult(run_requests=requests, cursor=json.dumps(seen | found))

    return new_hub_revision


def _commits(config: Config) -> Iterator[tuple[str, str | None]]:
    """The data sets of the Hub with the commit that their revision stands for now; None where the Hub does not say. What the
    cache saw last is no answer: it may be older than what was seen here, and would be taken for a move back."""
    from pipeline.lerobot_format.hub import commit_by_hub, parse_repository

    for key, dataset in config.datasets.items():
        if dataset.source.startswith("hub:"):
            yield key, commit_by_hub(*parse_repository(dataset.source.removeprefix("hub:")))


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


@dg.run_failure_sensor(
    name="run_failed",
    minimum_interval_seconds=30,
    default_status=dg.DefaultSensorStatus.RUNNING,
    description="Writes one line to automation.log in the results folder for every run that failed (data set, step, what was "
    "wrong, how to see more), and tells whoever [notify] names.",
)
def run_failed(context: dg.RunFailureSensorContext, workbench: dg.ResourceParam[Workbench]) -> None:
    """One line, one message.

    Dagster gives the sensor 60 s for up to five runs, and tells it of all of them again where it takes longer; a message may take
    half a minute. So it is sent beside the tick.
    """
    from pipeline.notify import log_line, message, send

    run = context.dagster_run
    dataset = run.tags.get("dagster/partition", "no data set")
    words = failure_words([*context.get_step_failure_events(), context.failure_event])
    log_line(
        workbench.store.root,
        f"{dataset} failed: {words} (run {run.run_id[:8]}; to see more: demobench ui, Runs, {run.run_id[:8]})",
    )
    told = message("failure", dataset, words, run_id=run.run_id)
    Thread(target=send, args=(workbench.config.notify, told, workbench.store.root), name=f"tell {run.run_id}").start()


def failure_words(events: Sequence[dg.DagsterEvent]) -> str:
    """The step that failed and the first line of why: of the steps in their order the first that says, else of the run."""
    for event in events:
        error = getattr(event.event_specific_data, "error", None)
        if event.step_key and error is not None:
            return f"{event.step_key.replace('__', '/')}: {_first_line(error)}"
    return next(iter((events[-1].message or "").splitlines()), "") or "for a reason that is in its log"


def _first_line(error: Any) -> str:
    """Of our own error in a chain of causes where there is one, else of the last cause, with its kind."""
    ours = {name for name, cls in vars(errors).items() if isinstance(cls, type) and issubclass(cls, DemobenchError)}
    while True:
        kind, _, words = error.message.strip().partition(": ")
        if kind.split(".")[-1] in ours:
            return next(iter(words.splitlines()), "")
        if error.cause is None:
            return next(iter(error.message.strip().splitlines()), error.cls_name or "")
        error = error.cause

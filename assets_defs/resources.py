"""What assets are given: the workbench (configuration and store) and the budget that the launchpad can change.

A Dagster resource here is a shell around plain objects. What belongs here: opening a partition, and the one way in which an
asset's results are made, published, checked and described. What does not: what any asset computes.
"""

import os
import socket
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import dagster as dg
from pydantic import Field

from assets_defs.plan import CODE_VERSIONS, Plan, Unit
from pipeline.config import Config, hash_of
from pipeline.errors import ConfigError, did_you_mean
from pipeline.experiment import Choices, Experiment, Variant, from_config, variant_key, with_choices
from pipeline.store import Made, Meter, Store

if TYPE_CHECKING:
    from pipeline.sinks.mlflow_outbox import Outbox
    from pipeline.sinks.to_mlflow import Message, RunCard

Say = Callable[[str], None]


PID_TAG, HOST_TAG = "demobench/pid", "demobench/host"
"""The process that makes a run, as tags of the run: where it is gone, so is the run (`launch.close_dead_runs`)."""


class Budget(dg.ConfigurableResource):
    """The few settings people change at launch. Left empty, the data set's own settings hold.

    Other numbers of seeds or steps make a variant: it is stored under a key of its own and never overwrites anything.
    """

    seeds: int | None = Field(None, ge=1, description="Training runs of each policy, from different random numbers.")
    steps: int | None = Field(None, ge=1, description="Training steps of each policy.")
    observations: list[str] = Field(
        default_factory=list, description='Observation sets, by name, for example ["pose"]; empty: all.'
    )
    policies: list[str] = Field(
        default_factory=list,
        description='Policies, by the name of their group, for example ["mlp_k16"]; empty: all but those that must be named.',
    )

    def setup_for_execution(self, context: dg.InitResourceContext) -> None:
        """Note on the run which process makes it. A run that is made again brings the tags of the first one along."""
        if context.instance and context.run:
            made_by = {PID_TAG: str(os.getpid()), HOST_TAG: socket.gethostname()}
            context.instance.add_run_tags(context.run.run_id, made_by)

    def asks_for(self, variant: Variant) -> bool:
        """Whether the launch named this policy, or named none and it need not be named."""
        return variant.name in self.policies if self.policies else not variant.only_when_named


@dataclass(frozen=True)
class Outcome:
    """What making one entry of an asset yielded.

    summary   small and JSON-able; kept in made.json, so that a result that is up to date can be described without work
    checks    check name → (passed, words)
    told      what MLflow is to hear of it, once it is in the store
    """

    summary: Mapping[str, Any]
    checks: Mapping[str, tuple[bool, str]] = field(default_factory=dict)
    told: Sequence["Message"] = ()


class Progress:
    """How assets tell what they are doing; the terminal replaces it with bars. `is_stopped` is asked between pieces of work."""

    def __init__(self, say: Say, is_stopped: Callable[[], bool] = lambda: False, every_s: float = 2.0):
        self._say = say
        self._every_s = every_s
        self._is_stopped = is_stopped
        self._last = self._asked = time.monotonic()

    def __call__(self, what: str, done: int, total: int, note: str = "") -> None:
        if time.monotonic() - self._asked > self._every_s:
            self._asked = time.monotonic()
            if self._is_stopped():
                raise dg.DagsterExecutionInterruptedError
        if done >= total or time.monotonic() - self._last > 10:
            self._last = time.monotonic()
            self._say(f"{what}: {done:,} of {total:,}{', ' + note if note else ''}")


@dataclass(frozen=True)
class Workbench:
    """The configuration, the store, and how to show progress. `progress` is None in the UI: the log is used."""

    config: Config
    config_dir: Path
    store: Store
    variants: tuple[Variant, ...]
    progress: Callable[[str, int, int, str], None] | None = None
    extra: Mapping[str, Experiment] = field(default_factory=dict)

    def experiment(self, key: str) -> Experiment:
        """The settings of a partition: those the command line resolved, else the file's, else as registered."""
        if key in self.extra:
            return self.extra[key]
        if key in self.config.datasets:
            return from_config(self.config, key, self.config_dir)
        registered = self.store.experiments()
        if key not in registered:
            known = did_you_mean(key, [*self.config.datasets, *registered])
            raise ConfigError(f"No data set '{key}' in the configuration or in {self.store.root}. {known}")
        return Experiment.model_validate(registered[key])

    def policies_of(self, experiment: Experiment) -> tuple[Variant, ...]:
        """The policies of an experiment that there are assets for.

        Of the file's policies some are for other data sets only; and what was benchmarked from the command line keeps the
        settings of that time: policies that the file got since are not its.
        """
        defined = {v.name for v in self.variants}
        return tuple(v for v in experiment.variants if v.name in defined)

    def open(self, context: dg.AssetExecutionContext, budget: Budget, look_at_source: bool = False) -> "Bench":
        """The partition of a run, with the budget of its launch. Only the first asset looks at the source."""
        key = context.partition_key
        base = self.experiment(key)
        experiment = with_choices(base, Choices(seeds=budget.seeds, steps=budget.steps))
        if experiment != base:
            key = variant_key(key.split("+")[0], from_base(self, key, base), experiment)
            self.store.register(key, experiment.model_dump(mode="json"))
        experiment.require_sets(budget.observations)
        policies = self.policies_of(experiment)
        plan = Plan(self.store, key, experiment, policies, (), tuple(budget.observations), look_at_source)
        progress = self.progress or Progress(context.log.info, lambda: _is_canceling(context))
        return Bench(self, plan, progress, context.log.warning, context.partition_key, context.log_event)


def _is_canceling(context: dg.AssetExecutionContext) -> bool:
    """Whether Terminate was pressed. Its signal may be lost: Python drops what is raised inside a garbage-collection callback."""
    run = context.instance.get_run_by_id(context.run.run_id)
    return run is not None and run.status == dg.DagsterRunStatus.CANCELING


def from_base(workbench: Workbench, key: str, fallback: Experiment) -> Experiment:
    """The experiment that a partition `tape+something` is a variant of."""
    base = key.split("+")[0]
    try:
        return workbench.experiment(base)
    except ConfigError:
        return fallback


@dataclass(frozen=True)
class Bench:
    """One partition, opened for one asset.

    partition   the run's partition; the plan's is another where the launch asked for another budget
    log_event   how Dagster is told of results of another partition than the run's
    """

    workbench: Workbench
    plan: Plan
    progress: Callable[[str, int, int, str], None]
    warn: Say
    partition: str | None = None
    log_event: Callable[[dg.AssetMaterialization], None] | None = None

    @property
    def store(self) -> Store:
        return self.plan.store

    @property
    def experiment(self) -> Experiment:
        return self.plan.experiment

    def everyone(self, *more: str) -> list[str]:
        """The policies that run by themselves, and those that were named: they decide on colours, the same in every picture."""
        return [*(v.name for v in self.plan.variants if not v.only_when_named), *more]

    @cached_property
    def demonstrations(self):
        from pipeline.lerobot_format.saved import load_demonstrations

        return load_demonstrations(self.plan.folder(Unit("demonstrations")) / "frames")

    @cached_property
    def semantics(self):
        from pipeline.lerobot_format.quality import resolve_semantics

        dataset = self.experiment.dataset
        return resolve_semantics(self.demonstrations, kind=dataset.kind, circular=dataset.circular)

    @cached_property
    def split(self):
        from pipeline.split import load_split

        return load_split(self.plan.folder(Unit("episode_split")) / "split.json")

    def task(self, variant: Variant, observations: str):
        """One policy with one of the observation sets, on these folds."""
        from pipeline.folds import PolicyTask

        seen = next(s for s in self.experiment.observation_sets if s.name == observations)
        return PolicyTask(self.demonstrations, self.semantics, self.split, seen, variant, self.experiment)

    def summary(self, unit: Unit) -> Mapping[str, Any]:
        """What a result says about itself."""
        made = self.store.made(self.plan.folder(unit))
        return made.summary if made else {}

    @cached_property
    def outbox(self) -> "Outbox":
        from pipeline.sinks.mlflow_outbox import Outbox

        return Outbox(self.store, self.workbench.config.tracking.mlflow)

    def run_card(self, variant: Variant, observations: str) -> "RunCard":
        """The MLflow run of one of our policies: that of its weights, to which everything about it is added."""
        from pipeline.sinks.to_mlflow import run_card

        trained = self.plan.fingerprint(Unit(f"{variant.name}/trained_policy", observations))
        return run_card(self.task(variant, observations), self.plan.key, trained)

    def make(self, unit: Unit, work: Callable[[Path], Outcome], fingerprint: Callable[[Outcome], str] | None = None):
        """Make one result unless it is up to date; returns what made it.

        `fingerprint` is for the one result whose fingerprint is known only after reading it (demonstrations).
        """
        folder = self.plan.folder(unit)
        self.plan.forget()
        expected = self.plan.fingerprint(unit)
        made = self.store.made(folder)
        if made is not None and expected is not None and made.fingerprint == expected:
            return made
        if expected is None and fingerprint is None:
            missing = [i for i in self.plan.inputs(unit) if not self.plan.is_fresh(i)]
            names = ", ".join(f"{i.asset} {i.entry}".strip() for i in missing)
            raise ConfigError(
                f"{unit.asset} of '{self.plan.key}' needs {names}, which is missing or out of date. Materialise it first."
            )
        with Meter() as meter, self.store.publish(folder) as draft:
            outcome = work(draft)
            summary = dict(outcome.summary)
            summary["checks"] = {name: list(result) for name, result in outcome.checks.items()}
            made = Made(
                fingerprint(outcome) if fingerprint else expected,
                round(meter.seconds, 3),
                round(meter.peak_memory_mb, 1),
                summary,
            )
            self.store.write_made(draft, made)
            self.post(unit, made.fingerprint, outcome.told)
        self.plan.forget()
        if not outcome.told:
            return made
        self.deliver()
        return self.store.made(folder) or made  # it knows its MLflow run now

    def post(self, unit: Unit, fingerprint: str, messages: Sequence["Message"]) -> None:
        """Keep for MLflow what it is to hear of a result."""
        for message in messages:
            about = "/".join(filter(None, (unit.asset, unit.entry)))
            self.outbox.post(message, self.plan.folder(unit), about, fingerprint)

    def deliver(self) -> None:
        """Send what is kept for MLflow; where it does not answer, say so and go on."""
        delivery = self.outbox.deliver(patient=False)
        if delivery.kept:
            self.warn(
                f"MLflow at {self.outbox.address} cannot be told now ({delivery.why}): {delivery.kept} messages are kept in "
                f"{self.outbox.folder}."
            )


def result(
    bench: Bench,
    asset_key: dg.AssetKey,
    made: Mapping[str, Made],
    metadata: Mapping[str, Any],
    checks: Sequence[str],
    *,
    warnings: Sequence[str] = (),
) -> dg.MaterializeResult:
    """An asset's result: its metadata, its data version, and every declared check; `warnings` are those that stop nothing.

    `made` has one entry an observation set ("" for assets without). A check passes when it passes in every entry.
    """
    version = _version(made)
    costs = {
        "seconds": dg.MetadataValue.float(sum((m.seconds for m in made.values()), 0.0)),
        "peak_memory_mb": dg.MetadataValue.float(max((m.peak_memory_mb for m in made.values()), default=0.0)),
        "stored_in": dg.MetadataValue.path(str(bench.store.dataset(bench.plan.key))),
    }
    metadata = {**metadata, **costs}
    if bench.partition not in (None, bench.plan.key):
        metadata, version = _made_elsewhere(bench, asset_key, made, metadata)
    return dg.MaterializeResult(
        asset_key=asset_key,
        metadata=metadata,
        check_results=[
            *(_check(asset_key, name, made, dg.AssetCheckSeverity.ERROR) for name in checks),
            *(_check(asset_key, name, made, dg.AssetCheckSeverity.WARN) for name in warnings),
        ],
        data_version=dg.DataVersion(version),
    )


def _version(made: Mapping[str, Made]) -> str:
    return hash_of({entry: m.fingerprint for entry, m in made.items()})


def _made_elsewhere(
    bench: Bench, asset_key: dg.AssetKey, made: Mapping[str, Made], metadata: Mapping[str, Any]
) -> tuple[dict[str, Any], str]:
    """Another budget in the launchpad makes results of another partition: Dagster hears of them under that one.

    What the run's own partition holds did not change, and neither does its version nor its numbers over time; returned are both.
    """
    key, asset = bench.plan.key, "/".join(asset_key.path)
    tags = {"dagster/data_version": _version(made)}
    bench.log_event(dg.AssetMaterialization(asset_key, metadata=dict(metadata), partition=key, tags=tags))
    store = bench.store
    own = {entry: there for entry in made if (there := store.made(store.folder(bench.partition, asset, entry)))}
    words = f"This launch asked for other numbers of seeds or steps than '{bench.partition}' has: its results are those of '{key}'."
    return {"made_instead": key, "why": words}, _version(own)


def _check(
    asset_key: dg.AssetKey, name: str, made: Mapping[str, Made], severity: dg.AssetCheckSeverity
) -> dg.AssetCheckResult:
    verdicts = {entry: m.summary["checks"][name] for entry, m in made.items() if name in m.summary["checks"]}
    words = "; ".join(f"{entry}: {w}" if entry else w for entry, (_, w) in verdicts.items())
    return dg.AssetCheckResult(
        asset_key=asset_key,
        check_name=name,
        passed=all(passed for passed, _ in verdicts.values()),
        severity=severity,
        metadata={"why": words or "nothing to check"},
    )


def asset_keys(units: Iterable[Unit]) -> list[dg.AssetKey]:
    """The assets that some results belong to, each once, in order."""
    return list(dict.fromkeys(dg.AssetKey(unit.asset.split("/")) for unit in units))


def check_spec(asset: dg.AssetKey, name: str, description: str) -> dg.AssetCheckSpec:
    """A check that guards a number: when it fails, nothing that follows is made."""
    return dg.AssetCheckSpec(name, asset=asset, description=description, blocking=True)


def warning_spec(asset: dg.AssetKey, name: str, description: str) -> dg.AssetCheckSpec:
    """A check that tells people where to look, and stops nothing."""
    return dg.AssetCheckSpec(name, asset=asset, description=description)


def code_version(kind: str) -> str:
    return CODE_VERSIONS[kind]

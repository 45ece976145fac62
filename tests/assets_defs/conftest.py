"""A tiny benchmark that runs the whole graph in seconds: six short episodes, two seeds, a handful of steps."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import dagster as dg
import pytest

from assets_defs.definitions import build_defs
from assets_defs.launch import open_instance, run_benchmark
from assets_defs.plan import Plan
from assets_defs.resources import asset_keys
from pipeline.config import Config, parse_config
from pipeline.experiment import Choices, Target, resolve_target
from pipeline.store import Store
from tests.makers import tiny_recording, write_v3

TINY = {
    "benchmark": {"seeds": 2, "folds": 2, "steps": 6, "threads": 1},
    "policies": {"mlp": {"method": "mlp", "chunks": [1, 4]}},
}


@dataclass
class TinyBenchmark:
    """A data set of six episodes in a folder, and everything needed to run it as the command line does."""

    folder: Path
    store: Store
    raw: dict

    @property
    def config(self) -> Config:
        said = self.raw.get("datasets", {})
        tiny = {"source": str(self.folder), **said.get("tiny", {})}
        return parse_config({**self.raw, "datasets": {**said, "tiny": tiny}}, "test")

    def target(self, **choices) -> Target:
        return resolve_target("tiny", self.config, self.folder, Choices(**choices), self.store.experiments())

    def plan(self, **choices) -> Plan:
        target = self.target(**choices)
        e = target.experiment
        names = tuple(v.name for v in target.selected)
        return Plan(self.store, target.key, e, tuple(e.variants), names, target.observations)

    def defs(self, **choices) -> dg.Definitions:
        target = self.target(**choices)
        return build_defs(
            self.config, config_dir=self.folder, store=self.store, experiments={target.key: target.experiment}
        )

    def run(
        self, on_event: Callable[[dg.DagsterEvent], None] | None = None, **choices
    ) -> tuple[list[str], dg.DagsterRun]:
        """Make what is stale; returns the assets that were stale and the run."""
        target, stale = self.target(**choices), self.plan(**choices).stale()
        self.store.register(target.key, target.experiment.model_dump(mode="json"))
        assets = asset_keys(stale)
        with open_instance(self.store.root) as instance:
            selected = [v.name for v in target.selected]
            run = run_benchmark(
                instance, self.defs(**choices), target.key, assets, target.observations, selected, on_event
            )
            assert run.is_success, why_failed(instance, run)
        return [a.to_user_string() for a in assets], run


def why_failed(instance: dg.DagsterInstance, run: dg.DagsterRun) -> list[str]:
    """The tracebacks in a run's log."""
    events = [entry.dagster_event for entry in instance.all_logs(run.run_id) if entry.dagster_event]
    errors = [getattr(event.event_specific_data, "error", None) for event in events]
    return [error.to_string() for error in errors if error]


@pytest.fixture(scope="session")
def tiny_folder(tmp_path_factory) -> Path:
    return write_v3(tmp_path_factory.mktemp("data") / "tiny", tiny_recording(episodes=6, frames=30))


@pytest.fixture(scope="session")
def finished(tiny_folder, tmp_path_factory) -> TinyBenchmark:
    """The whole graph, run once for all tests; they only look."""
    made = TinyBenchmark(tiny_folder, Store(tmp_path_factory.mktemp("results")).ensure(), TINY)
    made.run()
    return made

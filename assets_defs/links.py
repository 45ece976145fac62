"""Links from the Dagster UI to where a result is seen in a browser: MLflow's pages, and the files of the store.

A page that comes over http may not open a file of the disk (browsers refuse), so `demobench ui` serves the store's pages and
recordings on 127.0.0.1 beside Dagster and MLflow. It keeps in the store where; until it ran, links point at its default ports.
What does not belong here: serving (`demobench ui`).
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from urllib.parse import quote

import dagster as dg

from assets_defs.plan import Unit
from assets_defs.resources import Bench
from pipeline.store import Made, Store, write_json

HOST = "127.0.0.1"
DAGSTER_PORT, FILES_PORT, MLFLOW_PORT = 3000, 3001, 5000


@dataclass(frozen=True)
class Served:
    """Where `demobench ui` serves, as addresses without a slash at the end."""

    files: str = f"http://{HOST}:{FILES_PORT}"
    mlflow: str = f"http://{HOST}:{MLFLOW_PORT}"


def remember_served(store: Store, served: Served) -> None:
    """Keep where the store is served now; links that are made from here on point there."""
    _kept_in(store).parent.mkdir(parents=True, exist_ok=True)
    write_json(_kept_in(store), asdict(served))


def served(store: Store) -> Served:
    """Where the store was served last."""
    try:
        said = json.loads(_kept_in(store).read_text(encoding="utf-8"))
        return Served(str(said["files"]), str(said["mlflow"]))
    except (OSError, ValueError, KeyError, TypeError):
        return Served()


def _kept_in(store: Store) -> Path:
    return store.root / "dagster" / "served.json"


def file_link(bench: Bench, unit: Unit, name: str) -> str:
    """The address of a file of one result."""
    return _in_folder(bench, unit.asset, name)


def history_link(bench: Bench) -> str:
    """The address of the page of all tables of a data set."""
    from pipeline.history import FOLDER, PAGE

    return _in_folder(bench, FOLDER, PAGE)


def _in_folder(bench: Bench, folder: str, name: str) -> str:
    return f"{served(bench.store).files}/{quote(bench.plan.key)}/{quote(folder)}/{quote(name)}"


def run_link(bench: Bench, run_id: str) -> str:
    """The address of an MLflow run."""
    return f"{_mlflow(bench)}/#/runs/{quote(run_id)}"


def mlflow_links(bench: Bench, made: Mapping[str, Made]) -> dict[str, dg.MetadataValue]:
    """Where the MLflow run of every entry is, or that MLflow has not heard of it yet."""
    runs = {entry: m.summary.get("mlflow_run_id") for entry, m in made.items()}
    return {
        f"mlflow_{entry}": dg.MetadataValue.url(run_link(bench, run_id))
        if run_id
        else dg.MetadataValue.text("not sent yet")
        for entry, run_id in runs.items()
    }


def experiment_link(bench: Bench, experiment_id: str | None) -> str:
    """The address of all policies of a data set side by side in MLflow; of all experiments where its own is not known."""
    from pipeline.sinks.to_mlflow import VIEW

    view = f"/{quote(experiment_id)}/runs?viewStateShareKey={VIEW}&compareRunsMode=CHART" if experiment_id else ""
    return f"{_mlflow(bench)}/#/experiments{view}"


def _mlflow(bench: Bench) -> str:
    from pipeline.sinks.to_mlflow import without_secret

    setting = bench.workbench.config.tracking.mlflow
    return without_secret(setting).rstrip("/") if setting.startswith("http") else served(bench.store).mlflow

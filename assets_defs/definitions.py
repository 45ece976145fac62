"""Everything Dagster is told, put together from a configuration: `build_defs(config)`.

`defs` is what `dagster dev -w workspace.yaml` and `dg` load; it reads the file named by DEMOBENCH_CONFIG, else
`demobench.toml` in the working directory, else the built-in defaults; DEMOBENCH_STORE names another results folder.
"""

import os
from collections.abc import Callable, Mapping
from pathlib import Path

import dagster as dg

from assets_defs import data, floor
from assets_defs.automation import automation, check_cron
from assets_defs.benchmark import benchmark_assets
from assets_defs.curve import curve_assets
from assets_defs.elsewhere import KEY as SCORED
from assets_defs.elsewhere import elsewhere_assets
from assets_defs.looking import looking_assets
from assets_defs.policies import policy_assets
from assets_defs.resources import Budget, Workbench
from pipeline.config import BASELINES, Config, find_config, load_config
from pipeline.experiment import Experiment, variants
from pipeline.store import Store

LOCATION = "demobench"
"""The code location's name; the same in workspace.yaml and pyproject.toml, so that the UI can run a run again."""


def build_defs(
    config: Config,
    *,
    config_dir: Path,
    store: Store | None = None,
    progress: Callable[[str, int, int, str], None] | None = None,
    experiments: Mapping[str, Experiment] | None = None,
) -> dg.Definitions:
    """Fresh definitions: one branch a policy of the configuration (and of `experiments`), one partition a data set.

    Parameters
    ----------
    progress : told what assets are doing; the log is used without it.
    experiments : settings by partition key that the command line resolved; they take precedence over the file's.

    Raises
    ------
    ConfigError : the schedule's cron line is none.
    """
    check_cron(config)
    experiments = dict(experiments or {})
    families = dict(BASELINES) | dict(config.policies)
    for experiment in experiments.values():
        for family, policy in experiment.policies.items():
            known = families.get(family, policy)
            chunks = tuple(sorted({*known.chunks, *policy.chunks}))
            families[family] = known.model_copy(update={"chunks": chunks})
    policies = variants(families)
    store = store or Store(config_dir / config.store.path)
    workbench = Workbench(config, config_dir, store, tuple(policies), progress, experiments)

    branches = [asset for policy in policies for asset in policy_assets(policy)]
    predictions = [a.key for a in branches if a.key.path[-1] == "predictions"]
    rollouts = [a.key for a in branches if a.key.path[-1] == "rollouts"]
    assets = [
        *data.ASSETS,
        *floor.ASSETS,
        *branches,
        *curve_assets(predictions),
        *elsewhere_assets(),
        *benchmark_assets([*predictions, *rollouts, SCORED], floor.ASSETS, config.schedule.cron),
        *looking_assets([*predictions, SCORED], rollouts),
    ]
    return dg.Definitions(
        assets=assets,
        resources={"workbench": workbench, "budget": Budget.configure_at_launch()},
        executor=dg.in_process_executor,
        **automation(config, policies),
    )


@dg.definitions
def defs() -> dg.Definitions:
    """What the UI and `dg` load."""
    path = find_config()
    store = os.environ.get("DEMOBENCH_STORE")
    return build_defs(
        load_config(path), config_dir=path.parent if path else Path.cwd(), store=Store(Path(store)) if store else None
    )

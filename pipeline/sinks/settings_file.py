"""A page's settings as the `demobench.toml` that gives its numbers again.

What belongs here: writing them down. What does not: what they mean (`config`), reading them.
"""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.config import BASELINES, Config
from pipeline.errors import ConfigError
from pipeline.experiment import Choices, Experiment, resolve_target

BENCHMARK = (
    "protocol", "history", "seeds", "test_share", "folds", "split_seed", "rollouts", "rollout_seeds", "rollouts_from",
    "threads", "device",
)  # fmt: skip


def settings_file(experiment: Experiment) -> str:
    """The file that holds this data set alone, with every setting that its numbers depend on."""
    kept = experiment.model_dump(mode="json")
    benchmark = {name: getattr(experiment, name) for name in BENCHMARK}
    dataset = {name: value for name, value in kept["dataset"].items() if name != "budget"}
    if experiment.budget is None:
        benchmark["steps"] = experiment.steps
    else:
        dataset["budget"] = experiment.budget
    policies = {name: kept["policies"][name] for name, own in experiment.policies.items() if own != BASELINES.get(name)}
    tables = {"benchmark": benchmark, f"datasets.{_key(experiment.name)}": dataset}
    tables |= {f"policies.{_key(name)}": policy for name, policy in policies.items()}
    return "\n\n".join(f"[{head}]\n{_lines(table)}" for head, table in tables.items()) + "\n"


def command_is_enough(experiment: Experiment) -> bool:
    """Whether `Experiment.command` gives the same numbers where there is no file: all else is as it is built in."""
    folds = None if experiment.folds == "auto" else int(experiment.folds)
    choices = Choices(seeds=experiment.seeds, steps=experiment.steps, folds=folds, protocol=experiment.protocol)
    try:
        plain = resolve_target(experiment.argument, Config(), Path.cwd(), choices, {}).experiment
    except ConfigError:
        return False
    return _means(plain) == _means(experiment)


def _means(experiment: Experiment) -> Experiment:
    """The experiment without what names it: what it is called, and the word for its steps."""
    dataset = experiment.dataset.model_copy(update={"budget": None})
    return experiment.model_copy(update={"name": "", "budget": None, "dataset": dataset})


def _lines(table: Mapping[str, Any]) -> str:
    return "\n".join(f"{_key(name)} = {_value(value)}" for name, value in table.items() if value is not None)


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _text(name)


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        inside = ", ".join(f"{_key(name)} = {_value(one)}" for name, one in value.items() if one is not None)
        return f"{{ {inside} }}" if inside else "{}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    return _text(value) if isinstance(value, str) else json.dumps(value)


def _text(text: str) -> str:
    """A TOML string: JSON's, whose escapes TOML shares."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")

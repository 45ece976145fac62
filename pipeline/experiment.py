"""What is benchmarked, and how: one `Experiment` is one data set with all the settings that its numbers depend on.

It is Dagster's partition, a folder of the store and the unit of comparison. What belongs here: naming experiments, expanding
policies into variants, and command-line choices. What does not: running anything.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.config import (
    BASELINES,
    BUDGETS,
    BudgetName,
    Config,
    DatasetConfig,
    ObservationConfig,
    PolicyConfig,
    Settings,
    check_policy,
    check_rollout_seeds,
    check_slug,
    hash_of,
)
from pipeline.errors import ConfigError, did_you_mean
from pipeline.methods import BUDGET, EXTERNAL, METHODS, is_own
from pipeline.types import ObservationSet, Protocol


@dataclass(frozen=True)
class Variant:
    """One policy of a benchmark: a method with, where it has one, a chunk size. `name` is `mlp_k16` or `hold_still`."""

    name: str
    family: str
    method: str
    chunk: int | None
    only_when_named: bool = False

    @property
    def is_trained(self) -> bool:
        return METHODS[self.method].trained

    @property
    def is_rolled_out(self) -> bool:
        method = METHODS[self.method]
        return method.trained if method.rolled_out is None else method.rolled_out


class Experiment(Settings):
    """A data set and every setting that its numbers depend on (`device` and `threads` decide the last bits)."""

    name: str
    dataset: DatasetConfig
    policies: dict[str, PolicyConfig]
    protocol: Protocol
    history: int
    seeds: int
    folds: int | str
    test_share: float
    split_seed: int
    budget: BudgetName | None
    steps: int
    rollouts: int
    threads: int
    device: str
    rollout_seeds: int = 1
    rollouts_from: int = 0

    optional = frozenset({"rollout_seeds", "rollouts_from"})

    @property
    def start_states(self) -> range:
        """The numbers of the start states in closed loop."""
        return range(self.rollouts_from, self.rollouts_from + self.rollouts)

    @property
    def observation_sets(self) -> list[ObservationSet]:
        sets = self.dataset.observations.items()
        return [
            ObservationSet(name, seen.features, seen.history)
            if isinstance(seen, ObservationConfig)
            else ObservationSet(name, seen)
            for name, seen in sets
        ]

    @property
    def variants(self) -> list[Variant]:
        return variants(self.policies)

    @property
    def largest_chunk(self) -> int:
        return max((v.chunk or 1 for v in self.variants), default=1)

    def floor_horizons(self, fps: float) -> tuple[int, ...]:
        """How many steps ahead floors are measured: as the file says, else at the first action and one second ahead."""
        return self.dataset.floor_horizons or (0, round(fps))

    @property
    def budget_words(self) -> str:
        steps = f"{self.seeds} seed{'s' * (self.seeds != 1)} × {self.steps:,} steps"
        return f"{self.budget} ({steps})" if self.budget else steps

    def has_own_budget(self, variant: Variant) -> bool:
        """Whether a policy trains for another time than the benchmark says."""
        policy = self.policies.get(variant.family)
        return policy is not None and bool(BUDGET & policy.given.keys())

    def budget_of(self, variant: Variant) -> str:
        """How long one network of a policy trains: by its own budget, where it has one."""
        policy = self.policies[variant.family]
        if policy.cpu_seconds is not None:
            return f"{policy.cpu_seconds:g} CPU-seconds"
        return f"{policy.steps or self.steps:,} steps"

    @property
    def argument(self) -> str:
        """What the data set is called on a command line that may be given anywhere."""
        source = self.dataset.source
        return self.name if source.startswith("embedded:") else source

    @property
    def command(self) -> str:
        """The command line that gives these numbers from anywhere; `--folds` only where it is a number."""
        words = ["demobench", "run", self.argument]
        words += ["--protocol", self.protocol, "--seeds", str(self.seeds), "--steps", str(self.steps)]
        words += ["--folds", str(self.folds)] if self.folds != "auto" else []
        return " ".join(words)

    def require_sets(self, names: Iterable[str]) -> None:
        """Every name must be one of the data set's observation sets.

        Raises:
            ConfigError: it is not ("did you mean").
        """
        for name in names:
            if name not in self.dataset.observations:
                known = did_you_mean(name, self.dataset.observations)
                raise ConfigError(f"The data set '{self.name}' has no observation set '{name}'. {known}")

    def sets_of(self, variant: Variant) -> list[ObservationSet]:
        """The observation sets a policy is asked with on this data set.

        A method whose answer does not depend on the set runs once, under the first set that holds the arm's own state.
        """
        if not METHODS[variant.method].uses_observations:
            with_state = [s for s in self.observation_sets if "observation.state" in s.features]
            return (with_state or self.observation_sets)[:1]
        wanted = self.policies[variant.family].observations
        return [s for s in self.observation_sets if wanted == "all" or s.name in wanted]


def variants(policies: Mapping[str, PolicyConfig]) -> list[Variant]:
    """Expand policies into one variant a chunk size: `[policies.mlp] chunks = [1, 16]` → `mlp_k01`, `mlp_k16`.

    Chunk sizes are zero-padded so that lists sorted by name are sorted by size.
    """
    found = []
    for family, policy in policies.items():
        chunk_kind = METHODS[policy.method].chunk
        if chunk_kind != "set":
            if policy.chunks:
                raise ConfigError(
                    f"[policies.{family}] has chunks, but the method '{policy.method}' takes none. Remove the line."
                )
            chunk = 1 if chunk_kind == "one" else None
            found.append(Variant(family, family, policy.method, chunk, policy.only_when_named))
            continue
        if not policy.chunks:
            raise ConfigError(f"[policies.{family}] needs chunk sizes, for example chunks = [1, 16].")
        for chunk in sorted(set(policy.chunks)):
            found.append(Variant(f"{family}_k{chunk:02d}", family, policy.method, chunk, policy.only_when_named))
    return found


def from_config(config: Config, name: str, config_dir: Path) -> Experiment:
    """The experiment of a data set that the file names.

    Raises:
        ConfigError: the file has no such data set ("did you mean").
    """
    if name not in config.datasets:
        raise no_such_dataset(name, config.datasets)
    return _experiment(config, name, config.datasets[name], config_dir)


def no_such_dataset(name: str, known: Iterable[str]) -> ConfigError:
    """The error for a word that names nothing."""
    return ConfigError(
        f"No data set '{name}': it is neither in the configuration, nor benchmarked before, nor a folder, nor hub:owner/name. "
        f"{did_you_mean(name, known)}"
    )


def _experiment(config: Config, name: str, dataset: DatasetConfig, config_dir: Path) -> Experiment:
    benchmark = config.benchmark
    budget = dataset.budget or benchmark.budget
    steps = BUDGETS[budget]
    if benchmark.steps is not None and dataset.budget is None:
        budget, steps = None, benchmark.steps
    made = Experiment(
        name=name,
        dataset=_absolute_dataset(dataset, config_dir),
        policies=dict(BASELINES)
        | {family: _policy_here(p, config_dir) for family, p in config.policies.items() if p.is_for(name)},
        protocol=benchmark.protocol,
        history=benchmark.history,
        seeds=benchmark.seeds,
        folds=benchmark.folds,
        test_share=benchmark.test_share,
        split_seed=benchmark.split_seed,
        budget=budget,
        steps=steps,
        rollouts=benchmark.rollouts,
        rollout_seeds=benchmark.rollout_seeds,
        rollouts_from=benchmark.rollouts_from,
        threads=benchmark.threads,
        device=benchmark.device,
    )
    _check_champion(made)
    return made


def _check_champion(experiment: Experiment) -> None:
    """The champion is a policy of the experiment, with one of its observation sets where one is named."""
    if experiment.dataset.champion is None:
        return
    policy, _, observations = experiment.dataset.champion.partition("/")
    names = [v.name for v in experiment.variants]
    if policy not in names:
        raise ConfigError(f"[datasets.{experiment.name}] champion: no policy '{policy}'. {did_you_mean(policy, names)}")
    if observations:
        experiment.require_sets([observations])


def absolute_source(source: str, config_dir: Path) -> str:
    """A folder becomes an absolute path, so that the experiment means the same from anywhere."""
    if source.startswith(("embedded:", "hub:")):
        return source
    return str((config_dir / Path(source).expanduser()).resolve())


def _absolute_dataset(dataset: DatasetConfig, config_dir: Path) -> DatasetConfig:
    """The data set with absolute paths: its source's, and those of features that are joined."""
    update: dict[str, Any] = {"source": absolute_source(dataset.source, config_dir)}
    if dataset.features:
        update["features"] = {name: str(path.resolve()) for name, path in dataset.choice(config_dir).features.items()}
    return dataset.model_copy(update=update)


def _policy_here(policy: PolicyConfig, config_dir: Path) -> PolicyConfig:
    """A policy as an experiment keeps it: files of a class and of derived features of the user's own are absolute, likewise;
    which other data sets have it changes nothing here."""
    named = {"method": policy.method, "features": policy.features}
    files = {key: name for key, name in named.items() if name is not None and is_own(name) and ".py:" in name}
    update: dict[str, Any] = {"datasets": "all"}
    update |= {key: str((config_dir / Path(name).expanduser()).resolve()) for key, name in files.items()}
    return policy.model_copy(update=update)


NO_BUDGET = {"steps": None, "cpu_seconds": None}
"""A policy that trains as long as the benchmark says."""


@dataclass(frozen=True)
class Choices:
    """What the command line changed. `policies`, `chunks` and `observations` select; the rest changes the settings."""

    policies: tuple[str, ...] = ()
    chunks: tuple[int, ...] = ()
    observations: tuple[str, ...] = ()
    seeds: int | None = None
    steps: int | None = None
    budget: BudgetName | None = None
    folds: int | None = None
    protocol: Protocol | None = None
    rollouts: int | None = None
    rollout_seeds: int | None = None
    device: str | None = None


@dataclass(frozen=True)
class Target:
    """An experiment, the key it is stored under, and what of it was asked for.

    file_has_it   the served definitions know every policy of it, so that the UI can run it again
    """

    key: str
    experiment: Experiment
    selected: tuple[Variant, ...]
    observations: tuple[str, ...]
    file_has_it: bool


def resolve_target(
    argument: str, config: Config, config_dir: Path, choices: Choices, registered: Mapping[str, Mapping[str, Any]]
) -> Target:
    """From a word on the command line to an experiment.

    Parameters
    ----------
    argument : a data set's name, a folder, or `hub:owner/name[@revision]`.
    registered : `Store.experiments()`, to find a free key for a folder.

    Raises
    ------
    ConfigError : no such data set, policy, chunk or observation set.
    """
    base_key, base = _base(argument, config, config_dir, registered)
    changed = with_choices(base, choices)
    selected = _select(changed, choices)
    changed.require_sets(choices.observations)
    return Target(
        key=variant_key(base_key, base, changed),
        experiment=changed,
        selected=tuple(selected),
        observations=choices.observations,
        file_has_it={v.name for v in changed.variants} <= {v.name for v in base.variants},
    )


def known_as(argument: str, config: Config, registered: Mapping[str, Any]) -> str:
    """The key of a data set that was only ever benchmarked with other settings: `tape` → `tape+3fa9c1d2`.

    Settings that were changed of those (`tape+3fa9c1d2+17ab0c44`) are beside it, and do not take its place.

    Raises:
        ConfigError: there are several.
    """
    if argument in config.datasets or argument in registered:
        return argument
    keys = [key for key in registered if key.split("+")[0] == argument]
    first = min(keys, key=len, default=argument)
    if all(key == first or key.startswith(f"{first}+") for key in keys):
        return first
    described = "; ".join(f"{key} ({_settings_words(registered[key])})" for key in sorted(keys))
    raise ConfigError(f"'{argument}' was benchmarked with several settings: {described}. Name one of them.")


def _settings_words(registered: Mapping[str, Any]) -> str:
    """What most likely tells one benchmark of a data set from another."""
    experiment = Experiment.model_validate(registered)
    families = ", ".join(v.name for v in experiment.variants if v.is_trained and not v.only_when_named)
    return (
        f"{experiment.budget_words}, folds {experiment.folds}, {experiment.protocol}: {families or 'baselines alone'}"
    )


def _base(argument: str, config: Config, config_dir: Path, registered: Mapping[str, Any]) -> tuple[str, Experiment]:
    argument = argument if Path(argument).is_dir() else known_as(argument, config, registered)
    if argument in config.datasets:
        return argument, from_config(config, argument, config_dir)
    if argument in registered:
        return argument, Experiment.model_validate(registered[argument])
    is_path = "/" in argument or argument in (".", "..") or Path(argument).is_dir() or argument.lower().endswith(".zip")
    if not (argument.startswith(("hub:", "embedded:")) or is_path):
        raise no_such_dataset(argument, [*config.datasets, *registered])
    source = absolute_source(argument, Path.cwd())
    for name, dataset in config.datasets.items():
        if absolute_source(dataset.source, config_dir) == source:
            return name, from_config(config, name, config_dir)
    key = _free_key(source, config, registered)
    return key, _experiment(config, key, DatasetConfig(source=source), config_dir)


def _free_key(source: str, config: Config, registered: Mapping[str, Any]) -> str:
    """The key that a source has in the store; for one that is new there its name, with a hash where that is another's."""
    last = re.split(r"[/:]", source.split("@")[0].rstrip("/"))[-1]
    name = re.sub(r"\.{2,}", ".", re.sub(r"[^A-Za-z0-9_.-]", "-", last))[:60].strip("._-") or "dataset"
    hashed = f"{name}-{hash_of(source)[:8]}"

    def owners(base: str) -> set[str]:
        """Of a name, with whatever settings."""
        known = (known for key, known in registered.items() if key.split("+")[0] == base)
        return {one.get("dataset", {}).get("source") for one in known}

    is_there = source in owners(hashed) and source not in owners(name)
    taken = name in config.datasets or owners(name) - {source}
    return check_slug(hashed if is_there or taken else name, f"data set {source}")


def with_choices(base: Experiment, choices: Choices) -> Experiment:
    """The settings that the choices lead to; equal to `base` where they change nothing."""
    updates: dict[str, Any] = {
        field: value
        for field in ("seeds", "folds", "protocol", "rollouts", "rollout_seeds", "device")
        if (value := getattr(choices, field)) is not None and value != getattr(base, field)
    }
    seeds, rolled_out = (updates.get(field, getattr(base, field)) for field in ("seeds", "rollout_seeds"))
    if choices.rollout_seeds is not None:
        check_rollout_seeds(rolled_out, seeds)
    elif rolled_out > seeds:  # fewer seeds on the command line are fewer everywhere
        updates["rollout_seeds"] = seeds
    if choices.budget is not None:
        updates |= {"budget": choices.budget, "steps": BUDGETS[choices.budget]}
    if choices.steps is not None and choices.steps != base.steps:
        named = [name for name, steps in BUDGETS.items() if steps == choices.steps]
        updates |= {"budget": named[0] if named else None, "steps": choices.steps}
    policies = dict(base.policies)
    if choices.budget is not None or choices.steps is not None:
        # Who asks for a budget on the command line wants it for every policy.
        policies = {name: policy.model_copy(update=NO_BUDGET) for name, policy in policies.items()}
    for name in choices.policies:
        if name not in policies and name in METHODS:
            chunks = (choices.chunks or (1, 16)) if METHODS[name].chunk == "set" else ()
            policies[name] = PolicyConfig(method=name, chunks=chunks)
    policies |= _with_chunks(policies, choices)
    if policies != base.policies:
        updates["policies"] = policies
    return base.model_copy(update=updates)


def _with_chunks(policies: Mapping[str, PolicyConfig], choices: Choices) -> dict[str, PolicyConfig]:
    """The policies that chunk sizes which none of them has are added to: all that can carry such chunks out.

    Raises:
        ConfigError: none can, or one that was asked for by name cannot.
    """
    families = {
        family: policy
        for family, policy in policies.items()
        if METHODS[policy.method].chunk == "set" and (not choices.policies or family in choices.policies)
    }
    extra = set(choices.chunks) - {chunk for policy in families.values() for chunk in policy.chunks}
    longer, refused = {}, []
    for family, policy in families.items() if extra else ():
        asked = policy.model_copy(update={"chunks": tuple(sorted(extra.union(policy.chunks)))})
        try:
            check_policy(asked)
        except ConfigError as error:
            refused.append(ConfigError(f"[policies.{family}] {error}"))
        else:
            longer[family] = asked
    if refused and (choices.policies or not longer):
        raise refused[0]
    return longer


def _select(experiment: Experiment, choices: Choices) -> list[Variant]:
    """The variants asked for: baselines always; of the rest those named, or all that need not be named."""
    all_variants = experiment.variants
    known = {v.family for v in all_variants} | {v.name for v in all_variants}
    for name in choices.policies:
        if name not in known:
            raise ConfigError(f"No policy '{name}'. {did_you_mean(name, known | set(METHODS))}")
    chosen = []
    for variant in all_variants:
        named = variant.family in choices.policies or variant.name in choices.policies
        wanted = named if choices.policies else not variant.only_when_named
        if choices.chunks and METHODS[variant.method].chunk == "set" and variant.chunk not in choices.chunks:
            wanted = False
        if wanted or variant.family in BASELINES:
            chosen.append(variant)
    return chosen


def variant_key(base_key: str, base: Experiment, changed: Experiment) -> str:
    """`tape`, `tape+notebook` where only the protocol differs, else `tape+<hash of all settings>`."""
    if changed == base:
        return base_key
    if changed == base.model_copy(update={"protocol": changed.protocol}):
        return f"{base_key}+{changed.protocol}"
    return f"{base_key}+{hash_of(changed)[:8]}"


def parse_list(text: str | None) -> tuple[str, ...]:
    """`"a, b"` → `("a", "b")`."""
    return tuple(part.strip() for part in (text or "").split(",") if part.strip())


def parse_chunks(text: str | None) -> tuple[int, ...]:
    """`"1,16"` → `(1, 16)`; a ConfigError where something is not a whole number of at least 1."""
    return parse_numbers("--chunks", text, 1)


def parse_horizons(text: str | None) -> tuple[int, ...]:
    """`"0,30"` → `(0, 30)`; a ConfigError where something is not a whole number of at least 0."""
    return parse_numbers("--horizons", text, 0)


def parse_sizes(text: str | None) -> tuple[int, ...]:
    """`"10,20"` → `(10, 20)`; a ConfigError where something is not a whole number of at least 1."""
    return parse_numbers("--sizes", text, 1)


def parse_numbers(option: str, text: str | None, least: int) -> tuple[int, ...]:
    """What an option with a list of whole numbers of at least `least` says; a ConfigError where it says something else."""
    try:
        numbers = tuple(int(part) for part in parse_list(text))
    except ValueError:
        numbers = (least - 1,)
    if any(number < least for number in numbers):
        raise ConfigError(f"{option} takes whole numbers of at least {least}, separated by commas, not '{text}'.")
    return numbers


def select_rows(rows: Iterable[Mapping[str, Any]], target: Target) -> list[Mapping[str, Any]]:
    """The rows of a table that a run asked for; a method that sees no observation set is asked for with any.

    What was predicted elsewhere stays: somebody added it to this table by name.
    """
    names = {v.name for v in target.selected}
    return [
        row
        for row in rows
        if row["method"] == EXTERNAL
        or (
            row["policy"] in names
            and (
                not target.observations
                or row["observations"] in target.observations
                or not METHODS[row["method"]].uses_observations
            )
        )
    ]

"""`demobench.toml` → frozen, checked settings. Unknown names answer with "did you mean".

What belongs here: the shape of the file, its defaults, and turning command-line choices into the settings of one run.
What does not: reading data, anything with torch in it.
"""

import hashlib
import json
import os
import re
import tomllib
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal
from urllib.parse import urlsplit

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_serializer, model_validator

from pipeline.errors import ConfigError, did_you_mean
from pipeline.execution import settled
from pipeline.methods import DERIVED, HINDSIGHT, METHODS, SYMMETRIES, is_own
from pipeline.settings import SETTINGS, settings_of
from pipeline.types import AS_USUAL, ActionKind, ColumnChoice, Execution, Protocol

BUDGETS = {"quick": 600, "standard": 3_000, "thorough": 20_000}
"""Training steps of each named budget."""

SLUG = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+-]{0,79}")
BudgetName = Literal["quick", "standard", "thorough"]


class Settings(BaseModel):
    """Base of every block of the file: frozen, and an unknown key is an error.

    A key named in `optional` is left out of a dump where it has its default: a key that is new to the project must not
    change the hash of settings that do not use it.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    optional: ClassVar[frozenset[str]] = frozenset()

    @model_serializer(mode="wrap")
    def _without_unused_options(self, dump):
        unused = {key for key in self.optional if getattr(self, key) == type(self).model_fields[key].default}
        return {key: value for key, value in dump(self).items() if key not in unused}


class StoreConfig(Settings):
    path: str = "results"

    @model_validator(mode="after")
    def _is_a_folder(self):
        if "://" in self.path:
            raise ConfigError(
                f"[store] path is '{self.path}', a URL. Results are kept in a folder: give a path, for example \"results\"."
            )
        return self


class TrackingConfig(Settings):
    mlflow: str = "sqlite"

    @model_validator(mode="after")
    def _known_kind(self):
        if self.mlflow != "sqlite" and not re.match(r"https?://", self.mlflow):
            raise ConfigError(
                f"[tracking] mlflow is '{self.mlflow}'. It is \"sqlite\" (a file in the store) or a server, "
                'for example "http://127.0.0.1:5000".'
            )
        return self


class BenchmarkConfig(Settings):
    protocol: Protocol = "strict"
    history: Annotated[int, Field(ge=1, le=1000)] = 3
    seeds: Annotated[int, Field(ge=1, le=1000)] = 5
    test_share: Annotated[float, Field(gt=0, lt=1)] = 0.2
    folds: Annotated[int, Field(ge=1, le=100)] | Literal["auto"] = "auto"
    budget: BudgetName = "standard"
    steps: Annotated[int, Field(ge=1)] | None = None
    rollouts: Annotated[int, Field(ge=1)] = 50
    rollouts_from: Annotated[int, Field(ge=0)] = 0
    rollout_seeds: Annotated[int, Field(ge=1)] = 1
    split_seed: Annotated[int, Field(ge=0)] = 0
    threads: Annotated[int, Field(ge=1, le=256)] = 2
    device: Literal["auto", "cpu", "cuda"] = "auto"
    executor: Literal["in_process"] = "in_process"

    @model_validator(mode="after")
    def _seeds_are_there(self):
        check_rollout_seeds(self.rollout_seeds, self.seeds)
        return self


def check_rollout_seeds(rolled_out: int, trained: int) -> None:
    """Only what was trained can be rolled out.

    Raises:
        ConfigError: more seeds are to be rolled out than are trained.
    """
    if rolled_out > trained:
        raise ConfigError(
            f"rollout_seeds is {rolled_out} and seeds is {trained}: only what is trained can be rolled out. Raise seeds or lower "
            "rollout_seeds."
        )


class ObservationConfig(Settings):
    """An observation set that sees another number of frames than the benchmark's history."""

    features: tuple[str, ...]
    history: Annotated[int, Field(ge=1, le=1000)] | None = None


Number = Annotated[float, Field(allow_inf_nan=False)]


class WorkspaceConfig(Settings):
    """A box for the effector, m."""

    low: tuple[Number, Number, Number]
    high: tuple[Number, Number, Number]


class SafetyConfig(Settings):
    """Limits of the safety layer beside the simulator's own, by action column or unit.

    low, high   of each column       per_frame  the most that it may change in a frame
    stop_after  interventions in so many frames in a row end an episode
    """

    low: dict[str, Number] = {}
    high: dict[str, Number] = {}
    per_frame: dict[str, Annotated[Number, Field(gt=0)]] = {}
    workspace: WorkspaceConfig | None = None
    stop_after: Annotated[int, Field(ge=1)] | None = None

    @model_validator(mode="after")
    def _limits_can_be_kept(self):
        for word in self.low.keys() & self.high.keys():
            if self.low[word] > self.high[word]:
                raise ConfigError(
                    f"safety: the limits of '{word}' contradict each other: nothing is both {self.low[word]:g} or more and "
                    f"{self.high[word]:g} or less."
                )
        if self.workspace and not all(a < b for a, b in zip(self.workspace.low, self.workspace.high, strict=True)):
            raise ConfigError(
                "safety: the limits of the workspace contradict each other: low must be below high everywhere."
            )
        return self


class DatasetConfig(Settings):
    source: str
    simulator: Literal["pusht", "so101"] | None = None
    budget: BudgetName | None = None
    kind: Literal["auto"] | ActionKind | dict[str, ActionKind] = "auto"
    circular: tuple[str, ...] | None = None
    observations: dict[str, tuple[str, ...] | ObservationConfig] = {"state": ("observation.state",)}
    champion: str | None = None
    floor_horizons: tuple[Annotated[int, Field(ge=0, le=10_000)], ...] | None = None
    state: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    action: str | Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    units: str | dict[str, str] | None = None
    features: dict[str, str] = {}
    exclude: tuple[Annotated[int, Field(ge=0)], ...] = ()
    safety: SafetyConfig = SafetyConfig()

    optional = frozenset({"state", "action", "units", "features", "exclude", "safety"})

    def choice(self, config_dir: Path) -> ColumnChoice:
        """Which columns and episodes are used; the files of joined features are relative to `config_dir`."""
        files = {name: config_dir / Path(file).expanduser() for name, file in self.features.items()}
        action = (self.action,) if isinstance(self.action, str) else self.action
        return ColumnChoice(self.state, action, self.units, files, tuple(sorted(set(self.exclude))))


Noise = Annotated[float, Field(ge=0)] | dict[str, Annotated[float, Field(ge=0)]]


class AugmentConfig(Settings):
    """How training windows are varied.

    noise     on what is seen, anew in every frame: a share of each column's deviation, or by unit or column name
    offset    likewise, but the same in all frames of a window
    symmetry  of the data set, by name; each window of a batch is turned by it or not, by chance
    hindsight  by name: training episodes are told as if they had ended where they should
    """

    noise: Noise = 0.0
    offset: Noise = 0.0
    symmetry: str | None = None
    hindsight: str | None = None


class PolicyConfig(Settings):
    """One entry of [policies]; `settings` are what its method is made with."""

    method: str
    chunks: tuple[Annotated[int, Field(ge=1, le=10_000)], ...] = ()
    observations: Literal["all"] | tuple[str, ...] = "all"
    datasets: Literal["all"] | tuple[str, ...] = "all"
    only_when_named: bool = False
    history: Annotated[int, Field(ge=1, le=1000)] | None = None
    actions: Literal["absolute", "relative"] = "absolute"
    features: str | None = None
    augment: AugmentConfig = AugmentConfig()
    steps: Annotated[int, Field(ge=1)] | None = None
    cpu_seconds: Annotated[float, Field(gt=0)] | None = None
    settings: dict[str, Any] = {}
    execute: Annotated[int, Field(ge=1, le=10_000)] | None = None
    ensemble: bool = False
    delay: Annotated[int, Field(ge=0, le=10_000)] = 0
    carry_on: bool = False

    optional = frozenset(
        {
            "datasets",
            "history",
            "actions",
            "features",
            "augment",
            "steps",
            "cpu_seconds",
            "settings",
            "execute",
            "ensemble",
            "delay",
            "carry_on",
        }
    )

    def is_for(self, dataset: str) -> bool:
        """Whether a data set's benchmark has this policy."""
        return self.datasets == "all" or dataset in self.datasets

    @property
    def given(self) -> dict[str, Any]:
        """What of the keys that not every method takes is used, by the name under which methods list it."""
        used = {key: getattr(self, key) for key in ("history", "features", "steps", "cpu_seconds")}
        used |= {"actions": None if self.actions == "absolute" else self.actions}
        augment = self.augment
        used |= {
            "noise": augment.noise or None,
            "offset": augment.offset or None,
            "symmetry": augment.symmetry,
            "hindsight": augment.hindsight,
        }
        return {key: value for key, value in used.items() if value is not None}

    @property
    def execution(self) -> Execution:
        """How its chunks are carried out in roll-outs; training does not depend on it."""
        return Execution(self.execute, self.ensemble, self.delay, self.carry_on)

    @property
    def view(self) -> dict[str, Any]:
        """What of that its transform and augmentation are made from."""
        keys = ("actions", "features", *AugmentConfig.model_fields)
        return {key: value for key, value in self.given.items() if key in keys}


class ScheduleConfig(Settings):
    cron: str = "0 3 * * 1"


class NotifyConfig(Settings):
    """Who is told of a regression, a failed run and a new champion: a command, a webhook, both, or (by default) nobody."""

    command: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    webhook: str | None = None

    @model_validator(mode="after")
    def _webhook_is_private(self):
        if self.webhook is None:
            return self
        # The address is left out of the message: those of many services are secrets.
        try:
            address = urlsplit(self.webhook)
            scheme, host, _ = address.scheme, address.hostname, address.port
        except ValueError:
            scheme, host = "", None
        if not host or not (scheme == "https" or (scheme == "http" and is_loopback(host))):
            raise ConfigError(
                "[notify] webhook must be an https:// address, or http:// on this machine, for example "
                '"https://example.org/hook" or "http://127.0.0.1:8080/hook".'
            )
        return self


def is_loopback(host: str | None) -> bool:
    """Whether a host is this machine, by its name alone: nothing is looked up."""
    try:
        return host == "localhost" or ip_address(host or "").is_loopback
    except ValueError:
        return False


BASELINES = {
    name: PolicyConfig(method=name) for name in ("hold_still", "mean_action", "constant_velocity", "nearest_neighbour")
}
"""Always in a benchmark; a file need not name them."""

PUSHT_SIM = DatasetConfig(
    source="embedded:pusht_sim",
    simulator="pusht",
    budget="quick",
    kind="position",
    circular=("block_angle_rad",),
    observations={
        "position": ("observation.state",),
        "pose": ("observation.state", "observation.environment_state"),
    },
)

SO101_SIM = DatasetConfig(
    source="embedded:so101_sim",
    simulator="so101",
    budget="quick",
    kind="position",
    circular=(),
    units={
        f"{joint}.pos": "deg" for joint in ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
    }
    | {"gripper.pos": "%"},
    observations={
        "joints": ("observation.state",),
        "pose": ("observation.state", "observation.environment_state"),
    },
)

DEFAULT_DATASETS = {"pusht_sim": PUSHT_SIM, "so101_sim": SO101_SIM}
DEFAULT_POLICIES = {
    "mlp": PolicyConfig(method="mlp", chunks=(1, 4, 16, 32)),
    "recipe": PolicyConfig(
        method="mlp",
        datasets=("so101_sim",),
        observations=("pose",),
        chunks=(32,),
        actions="relative",
        features="so101_hand_frame",
        augment=AugmentConfig(
            symmetry="so101_pan",
            noise={"deg": 0.1, "%": 0.1, "m": 0.0005},
            offset={"deg": 2, "m": 0.001},
        ),
        settings={
            "blocks": 4,
            "warmup": 100,
            "cosine": True,
            "clip": 1.0,
            "ema": True,
            "bf16": True,
            "dropout": 0.1,
        },
        execute=16,
    ),
    "notebook_pusht": PolicyConfig(method="notebook_pusht", only_when_named=True),
}


class Config(Settings):
    """The whole file. What a file leaves out has the defaults of the `demobench.toml` that ships with the project."""

    store: StoreConfig = StoreConfig()
    tracking: TrackingConfig = TrackingConfig()
    benchmark: BenchmarkConfig = BenchmarkConfig()
    datasets: dict[str, DatasetConfig] = DEFAULT_DATASETS
    policies: dict[str, PolicyConfig] = DEFAULT_POLICIES
    schedule: ScheduleConfig = ScheduleConfig()
    notify: NotifyConfig = NotifyConfig()

    @model_validator(mode="after")
    def _names_are_slugs(self):
        for kind, names in (("datasets", self.datasets), ("policies", self.policies)):
            for name in names:
                check_slug(name, f"[{kind}.{name}]")
        return self


def check_slug(name: str, where: str) -> str:
    """Names become folders and Dagster partition keys, so they must be harmless: letters, digits, `_ . + -`, no `..`."""
    if not SLUG.fullmatch(name) or ".." in name:
        raise ConfigError(
            f"{where}: '{name}' cannot be a name. Names start with a letter or digit, hold only letters, digits, '_', '.', "
            "'+' and '-', at most 80 of them, and no '..'."
        )
    return name


def load_config(path: Path | None) -> Config:
    """Read and check a file; `None` gives the built-in defaults.

    Raises:
        ConfigError: no such file, not TOML, an unknown key, a value out of range.
    """
    if path is None:
        return Config()
    try:
        raw = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(
            f"No configuration file at {path}. Leave --config out to use the built-in defaults."
        ) from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{path} cannot be read as TOML: {error}.") from None
    return parse_config(raw, str(path))


def parse_config(raw: dict[str, Any], where: str) -> Config:
    """Check a dictionary as `tomllib` returns it. `where` names the file in messages."""
    try:
        config = Config.model_validate(raw)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None
    except ValidationError as error:
        raise ConfigError(f"{where}: {_first_problem(error)}") from None
    for name, policy in config.policies.items():
        if policy.method not in METHODS:
            raise ConfigError(
                f"{where}: [policies.{name}] method '{policy.method}' does not exist. {did_you_mean(policy.method, METHODS)} "
                'A class of your own is named by its file or module: method = "my_policy.py:MyPolicy".'
            )
        _check_reach(policy, config, f"{where}: [policies.{name}]")
        try:
            check_policy(policy)
        except ConfigError as error:
            raise ConfigError(f"{where}: [policies.{name}] {error}") from None
    return config


def _check_reach(policy: PolicyConfig, config: Config, who: str) -> None:
    """A policy names data sets that there are (those that ship are always there), and observation sets that they have."""
    there_are = DEFAULT_DATASETS | config.datasets
    wanted = config.datasets if policy.datasets == "all" else policy.datasets
    for named in wanted:
        if named not in there_are:
            raise ConfigError(
                f"{who} is for the data set '{named}', which is not in [datasets]. {did_you_mean(named, there_are)}"
            )
    sets = {"state", *(s for named in wanted for s in there_are[named].observations)}
    for named in () if policy.observations == "all" else policy.observations:
        if named not in sets:
            raise ConfigError(
                f"{who} sees the observation set '{named}', which none of its data sets has. {did_you_mean(named, sets)}"
            )


def check_policy(policy: PolicyConfig) -> None:
    """Everything about a policy that can be said without data: its settings, and what its method can be given.

    Raises:
        ConfigError: an unknown setting, something that the method does not take, two budgets, chunks that cannot be carried
            out as asked.
    """
    takes = METHODS[policy.method].takes
    _check_execution(policy)
    for key in policy.given:
        if key not in takes:
            place = f"augment.{key}" if key in AugmentConfig.model_fields else key
            raise ConfigError(
                f"{place} is not for the method '{policy.method}'. It takes {', '.join(sorted(takes)) or 'nothing of the kind'}."
            )
    if policy.steps is not None and policy.cpu_seconds is not None:
        raise ConfigError("has steps and cpu_seconds: two budgets. Keep one.")
    if policy.features is not None and policy.features not in DERIVED and not is_own(policy.features):
        raise ConfigError(
            f"features '{policy.features}' do not exist. {did_you_mean(policy.features, DERIVED)} "
            'A function of your own is named by its file: features = "my_features.py:function".'
        )
    for key, there_are in (("symmetry", SYMMETRIES), ("hindsight", HINDSIGHT)):
        asked = getattr(policy.augment, key)
        if asked is not None and asked not in there_are:
            raise ConfigError(f"augment.{key} '{asked}' does not exist. {did_you_mean(asked, there_are)}")
    if policy.method in SETTINGS:
        settings_of(policy.method, policy.settings)
    elif policy.settings and not is_own(policy.method):
        raise ConfigError(f"has settings, and the method '{policy.method}' takes none. Remove them.")


def _check_execution(policy: PolicyConfig) -> None:
    if policy.execution == AS_USUAL:
        return
    if not METHODS[policy.method].trained:
        raise ConfigError(
            "execute, ensemble, delay and carry_on are for policies that are trained, and baselines are not."
        )
    for chunk in sorted(policy.chunks) or [1]:
        settled(policy.execution, chunk)


def _first_problem(error: ValidationError) -> str:
    problem = error.errors()[0]
    path = [str(part) for part in problem["loc"]]
    if problem["type"] == "extra_forbidden":
        known = _keys_at(path[:-1])
        table = ".".join(path[:-1])
        place = f"in [{table}]" if table else "at the top level"
        return f"unknown key '{path[-1]}' {place}. {did_you_mean(path[-1], known)}"
    where = _place(problem["loc"])
    # Where several kinds of value are allowed there is a problem with each of them.
    same = [_PLAIN.sub(lambda found: PLAIN[found[0]], p["msg"]) for p in error.errors() if _place(p["loc"]) == where]
    return f"{where}: {', or: '.join(dict.fromkeys(same))} (got {problem['input']!r})."


PLAIN = {"a valid tuple": "a list, such as [1, 16]", "a valid dictionary": "a table, such as { name = … }"}
"""What Python calls things → what they are called in a file."""
_PLAIN = re.compile("|".join(PLAIN))
_KIND = re.compile(r"[\[(]|^(str|int|float|bool)$|^constrained-|Config$")


def _place(loc: tuple[str | int, ...]) -> str:
    """Where in the file, as it is written there: pydantic adds which kind of value it tried, and counts from 0."""
    parts = [part for part in loc if isinstance(part, int) or not _KIND.search(part)]
    return ".".join(f"value {part + 1}" if isinstance(part, int) else part for part in parts)


def _keys_at(path: list[str]) -> list[str]:
    """The keys that the file allows at a path such as ["datasets", "pusht_sim"]."""
    blocks = {
        "store": StoreConfig, "tracking": TrackingConfig, "benchmark": BenchmarkConfig,
        "datasets": DatasetConfig, "policies": PolicyConfig, "schedule": ScheduleConfig,
        "notify": NotifyConfig,
    }  # fmt: skip
    model = blocks.get(path[0], Config) if path else Config
    if path[:1] == ["policies"] and path[2:] == ["augment"]:
        model = AugmentConfig
    if path[:1] == ["datasets"] and path[2:] == ["safety"]:
        model = SafetyConfig
    return list(model.model_fields)


def hash_of(settings: Any) -> str:
    """A short, stable name for JSON-able settings: the first 16 hex digits of their sha256."""
    text = json.dumps(settings, sort_keys=True, separators=(",", ":"), default=_plain)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _plain(value: Any) -> Any:
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    raise TypeError(f"{type(value).__name__} has no stable JSON form")


def find_config(given: Path | None = None) -> Path | None:
    """The file to use: the one given, else DEMOBENCH_CONFIG, else `demobench.toml` here; None for the built-in defaults."""
    if given is not None:
        return given.absolute()
    if named := os.environ.get("DEMOBENCH_CONFIG"):
        return Path(named).absolute()
    here = Path("demobench.toml").absolute()
    return here if here.exists() else None

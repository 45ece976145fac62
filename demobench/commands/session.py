"""What every command begins and ends with: the configuration, the store, the data set, and JSON.

What does not belong here: what one command does.
"""

import json
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.markup import escape

from pipeline.config import Config, find_config, load_config
from pipeline.errors import StoreError
from pipeline.experiment import Choices, Target, known_as, no_such_dataset, resolve_target
from pipeline.sinks.words import plural
from pipeline.store import Store, write_json

if TYPE_CHECKING:
    from assets_defs.plan import Plan


@dataclass(frozen=True)
class Session:
    """A configuration, where it lies, its store, and where to print."""

    config: Config
    config_dir: Path
    store: Store
    console: Console


def open_session(config_path: Path | None, store_path: str | None, json_to: str | None = None) -> Session:
    """Read the configuration; with `--json -` everything that is not JSON goes to standard error."""
    path = find_config(config_path)
    config = load_config(path)
    config_dir = path.parent if path else Path.cwd()
    if store_path is not None:
        config = config.model_copy(update={"store": type(config.store)(path=store_path)})
        store = Store(Path.cwd() / Path(store_path).expanduser())
    else:
        store = Store(config_dir / Path(config.store.path).expanduser())
    return Session(config, config_dir, store, Console(stderr=json_to == "-", highlight=False, soft_wrap=False))


def write_json_to(target: str | None, value: Any) -> None:
    """`-` is standard output; anything else a file, written whole or not at all."""
    if target == "-":
        sys.stdout.write(json.dumps(value, indent=1, allow_nan=False) + "\n")
    elif target:
        try:
            write_json(Path(target), value)
        except OSError as error:
            raise StoreError(f"The JSON cannot be written to {target}: {error.strerror}.") from None


def tell_mlflow(session: Session, *, first: bool = False) -> None:
    """Send MLflow what is kept for it, and say in one line what came of that; `first`, before a run, only what was sent."""
    from pipeline.sinks.mlflow_outbox import Outbox

    outbox = Outbox(session.store, session.config.tracking.mlflow)
    delivery = outbox.deliver()
    if delivery.sent:
        session.console.print(
            f"MLflow at {outbox.address} was told what was kept for it: {plural(delivery.sent, 'message')}.",
            soft_wrap=True,
        )
    if delivery.kept and not first:
        session.console.print(
            f"[yellow]MLflow at {outbox.address} cannot be told now ({escape(delivery.why)}): {delivery.kept} results are kept in "
            f"{short(str(outbox.folder))}, and sent by the next demobench run or demobench ui.[/]",
            soft_wrap=True,
        )


def open_dataset(argument: str, session: Session, choices: Choices | None = None) -> tuple[Target, Any, Any]:
    """The data set of a name, folder or Hub address, and what its columns mean."""
    from pipeline.lerobot_format.read import load_experiment

    target = known_target(argument, session, choices)
    return target, *load_experiment(target.experiment, session.config_dir)


def known_target(argument: str, session: Session, choices: Choices | None = None) -> Target:
    """What a data set's name, folder or Hub address means here."""
    registered = session.store.experiments()
    return resolve_target(argument, session.config, session.config_dir, choices or Choices(), registered)


def stored_plan(name: str, session: Session) -> "Plan":
    """The results in the store of the data set that goes by a name.

    The source is not looked at: results can be used although it has moved since; the data hash says what they are of.

    Raises:
        ConfigError: there is no such data set, or the name means several.
    """
    from assets_defs.plan import Plan

    registered = session.store.experiments()
    dataset = known_as(name, session.config, registered)
    if dataset not in registered and dataset not in session.config.datasets:
        raise no_such_dataset(dataset, {*registered, *session.config.datasets})
    target = resolve_target(dataset, session.config, session.config_dir, Choices(), registered)
    variants = tuple(target.experiment.variants)
    return Plan(session.store, target.key, target.experiment, variants, look_at_source=False)


def program(name: str) -> str:
    """How to call a program that was installed beside this one: by name where that finds it, else by its path."""
    here = Path(sys.executable).parent / name
    found = shutil.which(name)
    return name if found and Path(found).resolve() == here.resolve() else short(str(here))


def short(path: str) -> str:
    """Relative to the working directory where that is shorter."""
    prefix, plain = ("sqlite:///", path.removeprefix("sqlite:///")) if path.startswith("sqlite:///") else ("", path)
    try:
        return prefix + str(Path(plain).relative_to(Path.cwd()))
    except ValueError:
        return path

"""`demobench score`: predictions that were made elsewhere become a row of the same table.

What belongs here: from the command's arguments to a run and its table. What does not: reading, checking and scoring predictions
(`pipeline.external`), asking a LeRobot checkpoint (`pipeline.lerobot_bridge`).
"""

import json
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.markup import escape

from demobench.commands.run import check_source, collect, materialise, show
from demobench.commands.session import Session, open_dataset, open_session, tell_mlflow, write_json_to
from pipeline.errors import ConfigError, StoreError, did_you_mean
from pipeline.experiment import Target
from pipeline.store import write_json

if TYPE_CHECKING:
    from assets_defs.elsewhere import Request
    from assets_defs.plan import Plan
    from pipeline.types import Demonstrations, Semantics


@dataclass(frozen=True)
class Opened:
    """A data set that predictions are scored on; `argument` is how the user named it."""

    argument: str
    session: Session
    target: Target
    demos: "Demonstrations"
    semantics: "Semantics"


@dataclass(frozen=True)
class LeRobot:
    """A checkpoint and how it is asked.

    checkpoint  its folder; `name` what its row is called unless told otherwise
    features    a feature of the checkpoint → the data set's feature it is shown
    """

    checkpoint: Path
    name: str
    python: Path
    device: str
    features: Mapping[str, str]


def run_score(
    dataset: str,
    predictions: Path | None,
    *,
    write_anchors: Path | None,
    fold: int | None,
    name: str | None,
    observations: str | None,
    trained_on: Path | None,
    lerobot: str | None,
    lerobot_python: Path | None,
    device: str,
    features: Sequence[str],
    remove: str | None,
    config_path: Path | None,
    store_path: str | None,
    json_to: str | None,
) -> None:
    """Do the one thing that the arguments ask for.

    Raises
    ------
    ConfigError : the arguments ask for nothing, or for several things.
    """
    session = open_session(config_path, store_path, json_to)
    asked = {
        "PREDICTIONS": predictions, "--write-anchors": write_anchors, "--lerobot": lerobot, "--remove": remove,
    }  # fmt: skip
    given = [word for word, value in asked.items() if value is not None]
    if len(given) > 1:
        raise ConfigError(f"{' and '.join(given)} are different things to do. Ask for one at a time.")
    if (lerobot is None) != (lerobot_python is None):
        raise ConfigError("--lerobot CHECKPOINT and --lerobot-python PATH (the Python that has LeRobot) go together.")
    if fold is not None and write_anchors is None:
        raise ConfigError("--fold says which anchors --write-anchors writes; scoring takes the fold from --trained-on.")
    opened = Opened(dataset, session, *open_dataset(dataset, session))
    if not given:
        _list(opened)
    elif write_anchors is not None:
        _write_anchors(opened, write_anchors, fold)
    elif remove is not None:
        _remove(opened, remove, json_to)
    elif predictions is not None:
        _score(opened, _request(opened, predictions, name, trained_on, observations), json_to)
    else:
        folder, called = _checkpoint(lerobot, session)
        ask = LeRobot(folder, called, lerobot_python, device, _features(features, opened.demos))
        _score(opened, _ask_lerobot(opened, ask, name, trained_on, observations), json_to)


def _plan(opened: Opened, asked: Mapping[str, Any] | None = None) -> "Plan":
    """Baselines, and whatever else is there already."""
    from assets_defs.plan import Plan
    from pipeline.config import BASELINES

    experiment = opened.target.experiment
    selected = tuple(v.name for v in experiment.variants if v.family in BASELINES)
    return Plan(
        opened.session.store, opened.target.key, experiment, tuple(experiment.variants), selected, asked=asked or {}
    )


# Anchors --------------------------------------------------------------------------------------------------------------


def _write_anchors(opened: Opened, path: Path, fold: int | None) -> None:
    from demobench.commands.split import split_json
    from pipeline.external.anchors import require_strict, write_anchors
    from pipeline.folds import split_of

    experiment, demos = opened.target.experiment, opened.demos
    require_strict(experiment.protocol)
    split = split_of(experiment, demos)
    split_json(split, demos, fold)  # says so if there is no such fold
    episodes = None if fold is None else split.folds[fold].test
    count = write_anchors(path, demos, split, experiment.history, episodes)
    covered = demos.episodes if episodes is None else len(episodes)
    opened.session.console.print(
        f"Written to {escape(str(path))}: {count:,} anchors of {covered} episodes. Fill in a column `action` (K × A, "
        f"{', '.join(map(escape, demos.features['action'].names))}) and score it with: demobench score "
        f"{escape(opened.argument)} PREDICTIONS.parquet --trained-on FILE. Episodes may be left out whole.",
        soft_wrap=True,
    )


# What is to be scored -------------------------------------------------------------------------------------------------


def _request(
    opened: Opened, predictions: Path, name: str | None, trained_on: Path | None, observations: str | None
) -> "Request":
    from assets_defs.elsewhere import Request, check_name

    experiment = opened.target.experiment
    experiment.require_sets([observations] if observations else [])
    name = name or _slug(predictions.stem)
    check_name(name, experiment)
    return Request(name, predictions.resolve(), trained_on.resolve() if trained_on else None, observations)


def _slug(words: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "_", words).strip("_-")[:60] or "elsewhere"


def _ask_lerobot(
    opened: Opened, ask: LeRobot, name: str | None, trained_on: Path | None, observations: str | None
) -> "Request":
    """Predict with a LeRobot checkpoint, unless the same was predicted before."""
    from pipeline.external.anchors import require_strict, write_anchors
    from pipeline.external.training import lerobot_training_file
    from pipeline.folds import split_of

    experiment, demos, store = opened.target.experiment, opened.demos, opened.session.store
    require_strict(experiment.protocol)
    checkpoint = ask.checkpoint
    trained_on = trained_on or lerobot_training_file(checkpoint)
    folder = store.ensure().dataset(opened.target.key) / ".elsewhere"
    request = _request(opened, folder, name or ask.name, trained_on, observations)
    request = replace(request, predictions=folder / f"{request.name}.parquet")
    episodes = _episodes_to_ask(opened, trained_on)
    stamp = {
        "checkpoint": _stamp(checkpoint),
        "data": demos.content_hash,
        "episodes": episodes,
        "history": experiment.history,
        "features": dict(ask.features),
    }
    if request.predictions.exists() and _read_stamp(request.predictions) == stamp:
        return request
    folder.mkdir(parents=True, exist_ok=True)
    anchors = folder / f".{request.name}.anchors.parquet"
    try:
        write_anchors(anchors, demos, split_of(experiment, demos), experiment.history, episodes)
        _predict(opened, ask, anchors, request.predictions)
    finally:
        anchors.unlink(missing_ok=True)
    write_json(request.predictions.with_suffix(".json"), stamp)
    return request


def _features(pairs: Sequence[str], demos: "Demonstrations") -> dict[str, str]:
    """`observation.environment_state=observation.state` as a mapping.

    Raises:
        ConfigError: it is no pair, or the data set has no such feature.
    """
    found = {}
    for pair in pairs:
        name, equals, column = pair.partition("=")
        if not (name and equals and column):
            raise ConfigError(
                f"--lerobot-feature takes CHECKPOINTS_NAME=DATA_SETS_NAME, not '{pair}', for example "
                "observation.environment_state=observation.state."
            )
        known = [*demos.features, *(camera.key for camera in demos.cameras)]
        if column not in known:
            raise ConfigError(
                f"--lerobot-feature: the data set has no feature '{column}'. {did_you_mean(column, known)}"
            )
        found[name] = column
    return found


def _checkpoint(text: str, session: Session) -> tuple[Path, str]:
    """The folder of a checkpoint, downloaded where it is on the Hub, and what to call its row.

    Raises:
        ConfigError: it is no folder; HubError where the Hub has no such checkpoint.
    """
    if text.startswith("hub:"):
        from pipeline.lerobot_format.hub import fetch_checkpoint

        copy = fetch_checkpoint(text.removeprefix("hub:"))
        for warning in copy.warnings:
            session.console.print(f"[yellow]warning:[/] {escape(warning)}", soft_wrap=True)
        session.console.print(f"{escape(text)}: commit {copy.commit}", soft_wrap=True)
        return copy.folder, _slug(text.split("@")[0].rpartition("/")[2])
    folder = Path(text)
    if not folder.is_dir():
        on_the_hub = f" For a checkpoint on the Hub write hub:{text}." if re.fullmatch(r"[\w.-]+/[\w.-]+", text) else ""
        raise ConfigError(
            f"The checkpoint {text} is no folder. Name the pretrained_model folder, or that of its run.{on_the_hub}"
        )
    return folder, _checkpoint_name(folder)


def _checkpoint_name(checkpoint: Path) -> str:
    """The name of the run that a checkpoint belongs to: what stands before `checkpoints` in its path, else its folder's."""
    parts = checkpoint.absolute().parts
    return _slug(parts[parts.index("checkpoints") - 1] if "checkpoints" in parts[1:] else parts[-1])


def _episodes_to_ask(opened: Opened, trained_on: Path | None) -> list[int]:
    """Positions of the episodes it was not trained on; all that our split holds out where there are none, or nobody knows."""
    from pipeline.external.training import read_training
    from pipeline.folds import split_of

    demos = opened.demos
    held_out = split_of(opened.target.experiment, demos).held_out
    training = read_training(trained_on, demos)
    if training is None:
        return held_out
    lists = list(training.episodes.values())
    if None in lists or len(lists) > 1:
        return held_out
    rest = set(range(demos.episodes)) - {
        p for p, number in enumerate(demos.episode_ids.tolist()) if number in set(lists[0])
    }
    return sorted(rest) or held_out


def _stamp(checkpoint: Path) -> str:
    """Names, sizes and times of the checkpoint's files."""
    from pipeline.config import hash_of

    files = sorted(path for path in checkpoint.rglob("*") if path.is_file())
    return hash_of([[str(p.relative_to(checkpoint)), p.stat().st_size, p.stat().st_mtime_ns] for p in files])


def _read_stamp(predictions: Path) -> Any:
    try:
        return json.loads(predictions.with_suffix(".json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _predict(opened: Opened, ask: LeRobot, anchors: Path, out: Path) -> None:
    from demobench.progress import counting_bar
    from pipeline.lerobot_bridge import predict_with_lerobot, sees_pictures
    from pipeline.lerobot_format.read import folder_of

    session = opened.session
    source, commit = opened.target.experiment.dataset.source, opened.demos.revision
    folder = folder_of(source, session.config_dir, commit=commit, videos=sees_pictures(ask.checkpoint))
    with counting_bar(session.console, "anchors", 1) as count:
        facts = predict_with_lerobot(
            ask.checkpoint,
            ask.python,
            folder,
            anchors,
            out,
            device=ask.device,
            features=ask.features,
            on_progress=count,
        )
    session.console.print(
        f"{escape(facts.policy_type)}, {facts.parameters:,} weights, {facts.chunk} actions a call, sees "
        f"{escape(', '.join(dict.fromkeys(facts.observations)))}",
        soft_wrap=True,
    )
    if facts.started_from:
        session.console.print(
            f"[yellow]warning:[/] its training went on from {escape(facts.started_from)}, whose own episodes are not known",
            soft_wrap=True,
        )


# Scoring --------------------------------------------------------------------------------------------------------------


def _score(opened: Opened, request: "Request", json_to: str | None) -> None:
    """Check the file before any work, make what is stale, show the table."""
    session, target = opened.session, opened.target
    asked = {request.name: request.identity(opened.demos)}
    plan = _plan(opened, asked)
    check_source([target], session)
    with session.store.ensure().lock(target.key):
        if not all(plan.is_fresh(unit) for unit in plan.scored_units() if unit.entry == request.name):
            _check(opened, request)
        _make_stale(opened, plan, request)
    _show_table(opened, plan, request.name, json_to)


def _check(opened: Opened, request: "Request") -> None:
    """Whatever is wrong with the file is said before anything is computed."""
    from pipeline.external.scoring import admit_file
    from pipeline.external.training import read_training

    admit_file(
        request.predictions, training=read_training(request.trained_on, opened.demos), demos=opened.demos,
        semantics=opened.semantics, experiment=opened.target.experiment,
    )  # fmt: skip


def _make_stale(opened: Opened, plan: "Plan", request: "Request | None") -> None:
    from assets_defs.automation import SCORE
    from assets_defs.plan import SCORED

    session, target = opened.session, opened.target
    session.store.register(target.key, target.experiment.model_dump(mode="json"))
    stale = list(plan.stale())
    chosen = replace(target, selected=tuple(v for v in target.experiment.variants if v.name in plan.selected))
    scores = request is not None and any(unit.asset == SCORED for unit in stale)
    materialise(chosen, session, plan.units(), stale, job=SCORE, ops={SCORED: request.config()} if scores else None)


def _show_table(opened: Opened, plan: "Plan", name: str | None, json_to: str | None) -> None:
    """The whole table, the new row marked."""
    target = replace(opened.target, selected=tuple(opened.target.experiment.variants), observations=())
    plan.forget()
    report = collect(target, plan, opened.session)
    marked = next((row for row in report["policies"] if row["policy"] == name), None)
    show(report, target, opened.session, marked and f"{name}/{marked['observations']}")
    tell_mlflow(opened.session)
    write_json_to(json_to, [report])


def _remove(opened: Opened, name: str, json_to: str | None) -> None:
    """Take a row out, and make the table without it."""
    from assets_defs.elsewhere import require_scored

    store, key = opened.session.store, opened.target.key
    plan = _plan(opened)
    unit = require_scored(name, plan)
    check_source([opened.target], opened.session)
    with store.ensure().lock(key):
        try:
            shutil.rmtree(plan.folder(unit))
            for kept in (store.dataset(key) / ".elsewhere").glob(f"{name}.*"):
                kept.unlink()
        except OSError as error:
            raise StoreError(f"'{name}' cannot be removed from {store.root}: {error.strerror}.") from None
        opened.session.console.print(f"'{name}' is removed from the table of '{key}'.")
        _make_stale(opened, plan, None)
    _show_table(opened, plan, None, json_to)


def _list(opened: Opened) -> None:
    """What was scored, and what to do."""
    console, plan = opened.session.console, _plan(opened)
    key = escape(opened.argument)
    for unit in plan.scored_units():
        made = plan.store.made(plan.folder(unit))
        stale = (
            ""
            if plan.is_fresh(unit)
            else " [yellow](not in the table: its data, settings or code changed; score it again)[/]"
        )
        console.print(
            f"{unit.entry}: {escape(made.summary['training'])}; from {escape(made.summary['file'])}{stale}",
            soft_wrap=True,
        )
    if not plan.scored_units():
        console.print(f"Nothing was scored yet for '{key}'.")
    console.print(
        f"Write the rows to fill in with: demobench score {key} --write-anchors anchors.parquet\n"
        f"Score them with:                demobench score {key} PREDICTIONS.parquet --trained-on FILE",
        soft_wrap=True,
    )

"""`demobench split`: which episodes train and which are held out, also in the form that other trainers take."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from demobench.commands.session import open_dataset, open_session, write_json_to
from pipeline.errors import ConfigError, StoreError
from pipeline.store import drafted
from pipeline.types import Demonstrations, Split

Format = Literal["text", "json", "lerobot"]


def run_split(
    dataset: str,
    *,
    form: Format,
    out: Path | None,
    folds: int | None,
    fold: int | None,
    config_path: Path | None,
    store_path: str | None,
    json_to: str | None,
) -> None:
    """Show the folds that a benchmark of this data set uses.

    Raises
    ------
    ConfigError : no such fold.
    """
    from pipeline.experiment import Choices
    from pipeline.folds import split_of

    session = open_session(config_path, store_path, json_to)
    target, demos, _ = open_dataset(dataset, session, Choices(folds=folds))
    found = split_json(split_of(target.experiment, demos), demos, fold)
    if form == "json":
        text = json.dumps(found, indent=1) + "\n"
    elif form == "lerobot":
        text = lerobot_words(found)
    else:
        text = ""
    if out is not None:
        _write(out, text or _as_text(found))
        session.console.print(f"Written to {escape(str(out))}.", soft_wrap=True)
    elif text and json_to != "-":
        print(text, end="")
    elif json_to != "-":
        show_split(found, session.console)
    write_json_to(json_to, found)


def split_json(split: Split, demos: Demonstrations, fold: int | None) -> dict[str, Any]:
    """A split in recorded episode_index numbers, as `score --trained-on` reads it; `fold` is the one that somebody trains on.

    Raises:
        ConfigError: no such fold.
    """
    if fold is not None and fold >= len(split.folds):
        has = f"{len(split.folds)} folds, 0 to {len(split.folds) - 1}" if len(split.folds) > 1 else "one fold, 0"
        raise ConfigError(f"There is no fold {fold}: '{demos.name}' is split into {has}. --folds changes how many.")
    ids = demos.episode_ids
    folds = [{"train": ids[list(f.train)].tolist(), "test": ids[list(f.test)].tolist()} for f in split.folds]
    names = {"dataset": demos.name, "content_hash": demos.content_hash, "split_hash": split.hash}
    return names | {"fold": fold, "folds": folds}


def lerobot_words(found: Mapping[str, Any]) -> str:
    """What LeRobot's trainer takes for one fold, with what it holds out in comments."""
    number = found["fold"] or 0
    fold = found["folds"][number]
    lines = [
        f"# {found['dataset']}, fold {number} of {len(found['folds'])}: {len(fold['train'])} episodes train.",
        f"# Held out ({len(fold['test'])}): {json.dumps(fold['test'])}",
    ]
    if len(found["folds"]) > 1 and found["fold"] is None:
        lines.append(f"# The other folds: --fold 1 to {len(found['folds']) - 1}; one fold for all: --folds 1")
    return "\n".join([*lines, f'--dataset.episodes="{json.dumps(fold["train"], separators=(",", ":"))}"']) + "\n"


def show_split(found: Mapping[str, Any], console: Console) -> None:
    """A fold in a row."""
    count = len(found["folds"])
    console.print(
        f"[bold]{escape(found['dataset'])}[/]  {count} fold{'s' * (count != 1)} · split {found['split_hash'][:12]} · episodes by "
        "their recorded number",
        soft_wrap=True,
    )
    table = Table("fold", "trains", "held out")
    for number, fold in enumerate(found["folds"]):
        if found["fold"] in (None, number):
            table.add_row(
                str(number), str(len(fold["train"])), f"{len(fold['test'])}: {', '.join(map(str, fold['test']))}"
            )
    console.print(table)
    console.print(
        "To train elsewhere without the held-out episodes: --format lerobot (LeRobot's trainer) or --format json (any other; "
        "demobench score --trained-on reads it).",
        style="dim",
    )


def _as_text(found: Mapping[str, Any]) -> str:
    import io

    text = io.StringIO()
    show_split(found, Console(file=text, width=100, color_system=None, highlight=False))
    return text.getvalue()


def _write(path: Path, text: str) -> None:
    """Write whole or not at all."""
    try:
        with drafted(path) as draft:
            draft.write_text(text, encoding="utf-8")
    except OSError as error:
        raise StoreError(f"The split cannot be written to {path}: {error.strerror}.") from None

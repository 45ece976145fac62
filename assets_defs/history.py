"""What happens after a table was made: its entry in the history, the chart of all entries, and telling people and MLflow.

What belongs here: from an opened partition to `pipeline.history`. What does not: who the champion is and whether it got worse
(there), how a message is sent (`pipeline.notify`).
"""

import json
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from assets_defs.plan import Unit
from assets_defs.resources import Bench
from pipeline.experiment import Experiment
from pipeline.store import Made, Store

if TYPE_CHECKING:
    from pipeline.history import Line, Result
    from pipeline.sinks.to_mlflow import Message

Clock = Callable[[], datetime]


def now() -> datetime:
    return datetime.now(UTC)


def history_folder(bench: Bench) -> Path:
    """Where the entries, the page and the chart of a data set lie."""
    from pipeline.history import FOLDER

    return bench.store.folder(bench.plan.key, FOLDER)


def with_champion(store: Store, key: str, experiment: Experiment) -> Experiment:
    """The experiment with the champion that its next table is compared with: the file's, or who took its place since.

    Plans are made of the experiment as it was: a fingerprint that knew of a promotion would make the table stale by it.
    """
    from pipeline.history import champion_of, read_history

    dataset = experiment.dataset
    champion = champion_of(read_history(store, key), dataset.champion)
    return experiment.model_copy(update={"dataset": dataset.model_copy(update={"champion": champion})})


def record(bench: Bench, made: Made, code: str, run_id: str | None, clock: Clock = now) -> "Line":
    """The entry of the table that is there now; written, drawn and told where there is none yet."""
    from pipeline.history import append, champion_of, describe, kept_errors, read_history

    key, named = bench.plan.key, bench.experiment.dataset.champion
    lines = read_history(bench.store, key)
    if lines and lines[-1].table == made.fingerprint:
        return lines[-1]
    table = json.loads((bench.plan.folder(Unit("benchmark_table")) / "table.json").read_text(encoding="utf-8"))
    line, errors = describe(
        table,
        made.fingerprint,
        lines,
        named=named,
        champion=champion_of(lines, named),
        history=bench.experiment.history,
        code=code,
        when=clock(),
        results=_results(bench),
        before=kept_errors(bench.store, key),
    )
    _draw(bench, [*lines, line], table)
    bench.post(Unit("benchmark_table"), made.fingerprint, crown(bench, line.next_champion))
    append(bench.store, key, line, errors)
    bench.deliver()
    _tell(bench, line, lines, run_id)
    return line


def crown(bench: Bench, champion: str | None) -> "list[Message]":
    """MLflow's registry is told whose model has the alias `champion`: that of a row, `policy/observations`, or of a policy that
    has one row."""
    from pipeline.sinks.to_mlflow import about_champion

    rows = [u for u in bench.plan.fresh_policy_units("predictions") if champion in (f"{u.policy}/{u.entry}", u.policy)]
    if len(rows) != 1:
        return []
    variant = next(v for v in bench.plan.variants if v.name == rows[0].policy)
    return [about_champion(bench.run_card(variant, rows[0].entry))]


def _results(bench: Bench) -> "dict[str, Result]":
    """What the rows of the table were made from, by address."""
    from pipeline.history import Result
    from pipeline.statistics.metrics import load_errors

    plan, experiment = bench.plan, bench.experiment
    variants = {v.name: v for v in plan.variants}
    found = {}
    for unit in plan.fresh_policy_units("predictions"):
        variant = variants[unit.policy]
        budget = f"{experiment.seeds} seeds × {experiment.budget_of(variant)}" if variant.is_trained else "none"
        errors = load_errors(plan.folder(unit) / "errors.safetensors")
        found[f"{unit.policy}/{unit.entry}"] = Result(plan.fingerprint(unit), variant.is_trained, budget, errors)
    return found


def _draw(bench: Bench, lines: "list[Line]", table: dict[str, Any]) -> None:
    """The chart and the page of all entries, each written whole."""
    from pipeline.history import PAGE, PICTURE
    from pipeline.sinks import replacing
    from pipeline.sinks.history_page import picture_history, write_history_page
    from pipeline.sinks.words import common_unit

    folder, unit = history_folder(bench), common_unit(table["dataset"]["action_units"])
    picture = picture_history(lines, unit=unit)
    if picture is not None:
        with replacing(folder / PICTURE) as draft:
            draft.write_bytes(picture)
    with replacing(folder / PAGE) as draft:
        write_history_page(lines, draft, name=bench.plan.key, unit=unit)


def _tell(bench: Bench, line: "Line", lines: "list[Line]", run_id: str | None) -> None:
    """Tell whoever wants to be told of a champion that got worse, and of a new one."""
    from pipeline.history import is_news, promotion_words, regression_words
    from pipeline.notify import message, send

    told = []
    if line.got_worse and is_news(line, lines):
        told.append(("regression", f"{line.champion}: {regression_words(line)}", line.regression))
    if line.promotion:
        told.append(("new champion", promotion_words(line), line.promotion))
    for event, words, found in told:
        numbers = {name: value for name, value in found.items() if isinstance(value, int | float | list | tuple)}
        about = {"numbers": numbers, "run_id": run_id, "code": line.code}
        send(bench.workbench.config.notify, message(event, bench.plan.key, words, **about), bench.store.root)

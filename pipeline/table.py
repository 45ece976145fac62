"""The head-to-head table, as JSON and as text.

What belongs here: putting facts, scores, floors and roll-outs into the shape that `demobench run --json` promises, and
drawing it. What does not: working any of them out.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.experiment import Experiment
from pipeline.external.pairing import Rival, compare_elsewhere
from pipeline.sinks.findings import (
    MARKS,
    NOT_HELD,
    Strong,
    address,
    answer,
    champion,
    elsewhere_words,
    families_words,
    first_step_gap,
    gap_parts,
    interval_words,
    is_elsewhere,
    is_seen,
    not_held,
    without_floor,
)
from pipeline.statistics.brackets import Scored, Sight, form_brackets, gap_to_floor, sight_of, value_of_sensors
from pipeline.statistics.comparisons import table_comparisons
from pipeline.types import FloorEstimate, RadiusFloor, Split

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

METRICS = (
    "first_step_mae", "first_step_rmse", "first_step_l2", "at_one_second_mae", "at_one_second_rmse",
    "whole_chunk_mae", "whole_chunk_rmse", "ensembled_first_step_mae", "error_by_horizon", "rmse_by_horizon",
    "hold_still_by_horizon", "error_by_joint", "vs_hold_still", "scaled", "scaled_by_joint", "interval",
    "interval_method",
)  # fmt: skip
"""What a row takes over from a policy's score."""


def build_table(
    facts: Mapping[str, Any],
    experiment: Experiment,
    split: Split,
    floors: Sequence[RadiusFloor],
    estimates: Sequence[FloorEstimate],
    entries: Sequence[Mapping[str, Any]],
    modes: Sequence[Mapping[str, Any]] = (),
) -> dict[str, Any]:
    """The table of one data set.

    Parameters
    ----------
    facts : what `quality.inspect_dataset` found.
    floors, estimates : the notebook's floors, and those that policies are held against.
    entries : one a row: `variant`, `observations`, `metrics` (`metrics.Score.metrics`), `errors` (`EpisodeErrors`),
        `windows_train`, `windows_test`, `latency_ms`, `parameters`, `train_s` and `rollouts` (a summary or None). One that was
        predicted elsewhere also has `elsewhere`: `seen_in_training`, `training` (words), `episodes`, `samples`, `warnings` and
        `sight_stated`.
    modes : `modes.ModesEvidence` as dictionaries.

    Returns
    -------
    dict : JSON-able; rows in the order of their first-step error. A number that is not finite is None.
    """
    rows = [_row(entry, experiment) for entry in entries]
    rows.sort(key=_best_first)
    comparisons = _compare(rows, facts, experiment, entries)
    against_floors = _against_floors(rows, facts, experiment, estimates, entries)
    table = {
        "dataset": dataset_json(facts),
        "protocol": experiment.protocol,
        "budget": {"name": experiment.budget, "steps": experiment.steps, "seeds": experiment.seeds},
        "split": {
            "hash": split.hash,
            "folds": [{"train": list(fold.train), "test": list(fold.test)} for fold in split.folds],
        },
        "floor": floor_json(floors, estimates),
        **against_floors,
        "modes": list(modes),
        "policies": rows,
        "comparisons": comparisons,
        "artifacts": {"report": None, "mcap": None, "rerun": None, "mlflow": None},
    }
    return json_safe(table)


def dataset_json(facts: Mapping[str, Any]) -> dict[str, Any]:
    """The `dataset` object of every command's JSON."""
    keys = (
        "name", "revision", "content_hash", "episodes", "frames", "fps", "action_names", "action_units", "action_kinds",
        "tracking_lag", "excluded", "warnings",
    )  # fmt: skip
    return json_safe({key: facts[key] for key in keys})


def _compare(
    rows: Sequence[dict[str, Any]],
    facts: Mapping[str, Any],
    experiment: Experiment,
    entries: Sequence[Mapping[str, Any]],
) -> list[dict[str, Any]]:
    """Every row against hold-still and against the champion; the words go into the rows' `verdict`."""
    ours = [entry for entry in entries if "elsewhere" not in entry]
    scored = [(entry["variant"].name, entry["observations"], entry["errors"]) for entry in ours]
    champion = experiment.dataset.champion
    baselines = [entry["variant"].name for entry in ours if not entry["variant"].is_trained]
    found = table_comparisons(scored, champion, facts["fps"], experiment.protocol, baselines=baselines)
    rivals = {comparison.b for comparison in found}
    found += compare_elsewhere(
        [_rival(entry) for entry in entries if "elsewhere" in entry],
        [one for one in map(_rival, ours) if one.address in rivals],
        facts["fps"],
        experiment.protocol,
    )
    by_address = {f"{row['policy']}/{row['observations']}": row for row in rows}
    for comparison in found:
        rival = "vs_hold_still" if comparison.b.startswith("hold_still/") else "vs_champion"
        rivals = (
            [rival, "vs_champion"] if champion and comparison.b.split("/")[0] == champion.split("/")[0] else [rival]
        )
        ahead = "_at_one_second" if comparison.metric == "at_one_second_mae" else ""
        for name in rivals:
            seen = by_address[comparison.a].get("seen_in_training")
            by_address[comparison.a]["verdict"][name + ahead] = None if seen else comparison.word
    return [asdict(comparison) for comparison in found]


def _rival(entry: Mapping[str, Any]) -> Rival:
    address = f"{entry['variant'].name}/{entry['observations']}"
    seen = entry["elsewhere"]["seen_in_training"] if "elsewhere" in entry else False
    return Rival(address, entry["errors"], entry["variant"].is_trained, seen)


def _is_held(entry: Mapping[str, Any]) -> bool:
    """Whether a row may be held against a floor: it says what it sees, and was not trained on what it is scored on."""
    elsewhere = entry.get("elsewhere")
    return elsewhere is None or (elsewhere["sight_stated"] and elsewhere["seen_in_training"] is False)


def _against_floors(
    rows: Sequence[dict[str, Any]],
    facts: Mapping[str, Any],
    experiment: Experiment,
    estimates: Sequence[FloorEstimate],
    entries: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """`brackets` and `sensors`; each row's `above_floor` is filled in. `notebook` averages otherwise, so it has none."""
    if experiment.protocol == "notebook" or not estimates:
        return {"brackets": [], "sensors": []}
    history, kinds = experiment.history, facts["action_kinds"]
    sets = {s.name: s for s in experiment.observation_sets}
    sights = {name: Sight(frozenset(s.features), s.history or history) for name, s in sets.items()}
    scored = [
        Scored(
            e["variant"].name,
            e["observations"],
            sight_of(e["variant"], sets[e["observations"]], history, kinds),
            e["errors"],
        )
        for e in entries
        if _is_held(e)
    ]
    brackets = form_brackets(estimates, scored, sights)
    sound = {(b["observations"], b["horizon"], b["loss"]) for b in brackets if b["lower"] is not None}
    by_address = {f"{row['policy']}/{row['observations']}": row for row in rows}
    for one in scored:
        row = by_address[f"{one.policy}/{one.observations}"]
        for floor in estimates:
            key = (floor.observations, floor.horizon, floor.loss)
            if (
                floor.observations != one.observations
                or key not in sound
                or not one.sight.within(sights[one.observations])
            ):
                continue
            if (gap := gap_to_floor(one, floor)) is not None:
                row["above_floor"].append(
                    {"horizon": floor.horizon, "loss": floor.loss, "floor": floor.value, **asdict(gap)}
                )
    return {"brackets": brackets, "sensors": value_of_sensors(estimates, sights, brackets)}


def floor_json(floors: Sequence[RadiusFloor], measured: Sequence[FloorEstimate] = ()) -> dict[str, Any]:
    """The `floor` object: the notebook's estimate of the first observation set, then all estimates."""
    radius = None
    if floors:
        first = floors[0]
        radius = {
            "probes": first.probes, "median_neighbours": first.median_neighbours, "mean": first.mean, "p90": first.p90,
            "observations": first.observations, "radius": first.radius, "scaled": first.scaled, "unit": first.unit,
        }  # fmt: skip
    estimates = [
        {
            "observations": floor.observations, "horizon": floor.horizon, "loss": "l2", "estimator": "radius",
            "value": floor.mean, "interval": None, "refused": floor.refused,
        }
        for floor in floors
    ]  # fmt: skip
    keys = (
        "observations", "history", "horizon", "loss", "estimator", "value", "upper", "interval", "below", "refused", "nearest"
    )  # fmt: skip
    estimates += [{key: getattr(floor, key) for key in keys} for floor in measured]
    return json_safe({"radius": radius, "estimates": estimates})


def _row(entry: Mapping[str, Any], experiment: Experiment) -> dict[str, Any]:
    variant, metrics = entry["variant"], entry["metrics"]
    return {
        "policy": variant.name,
        "method": variant.method,
        "chunk": variant.chunk,
        "observations": entry["observations"],
        "seeds": entry.get("seeds") or (experiment.seeds if variant.is_trained else 1),
        "windows_train": entry["windows_train"],
        "windows_test": entry["windows_test"],
        **{metric: metrics[metric] for metric in METRICS},
        "params": entry["parameters"],
        "train_s": entry["train_s"],
        "latency_ms": entry["latency_ms"],
        "verdict": {
            "vs_hold_still": None,
            "vs_champion": None,
            "vs_hold_still_at_one_second": None,
            "vs_champion_at_one_second": None,
        },
        "above_floor": [],
        "rollouts": entry["rollouts"],
        **entry.get("elsewhere", {}),
    }


def _best_first(row: Mapping[str, Any]) -> tuple:
    error = row["first_step_mae"]
    return np.inf if error is None else error, row["policy"], row["observations"]


def json_safe(value: Any) -> Any:
    """The same without numpy's types; numbers that are not finite become None."""
    if isinstance(value, Mapping):
        return {key: json_safe(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [json_safe(item) for item in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value


def render_table(table: Mapping[str, Any], console: "Console", marked: str | None = None) -> None:
    """Draw the table, best first step on top; below it the answer in words, and what its numbers rest on.

    `marked` is the address of the row that somebody asked about.
    """
    from rich.markup import escape

    dataset = table["dataset"]
    unit = _common_unit(dataset["action_units"])
    console.print()
    console.print(
        f"[bold]{escape(dataset['name'])}[/]  {dataset['episodes']:,} episodes · {dataset['frames']:,} frames · "
        f"{dataset['fps']:g} fps · {len(dataset['action_names'])} action columns ({_units_words(dataset)})",
        soft_wrap=True,
    )
    grid, left_out = _grid(table, unit, console, marked)
    console.print(grid)
    for sentence in answer(table):
        console.print(_styled(sentence))
    console.print()
    narrow = [f"left out for want of width: {', '.join(left_out)} (all in --json)"] if left_out else []
    for line in (*_footnotes(table), *narrow):
        console.print(line, style="dim", soft_wrap=True)
    for warning in dataset["warnings"]:
        console.print(f"[yellow]warning:[/] {escape(warning)}", soft_wrap=True)
    console.print()


def _styled(sentence: Sequence[str]) -> "Text":
    """A sentence with what stands out in bold; names of a data set are text, never markup."""
    from rich.text import Text

    return Text.assemble(*((part, "bold" if isinstance(part, Strong) else "") for part in sentence))


@dataclass(frozen=True)
class _Column:
    """A column of the text table: its head, a cell of a row, and the order in which it gives way (0: never)."""

    head: str
    cell: Callable[[Mapping[str, Any]], str]
    gives_way: int = 0


def _grid(
    table: Mapping[str, Any], unit: str | None, console: "Console", marked: str | None = None
) -> tuple[Any, list[str]]:
    """The table as wide as the console allows, and the heads of the columns that had to be left out."""
    columns, left_out = _columns(table, unit), []
    while True:
        grid = _draw(table["policies"], columns, marked)
        expendable = [column for column in columns if column.gives_way]
        if console.measure(grid, options=console.options.update(width=1000)).maximum <= console.width or not expendable:
            return grid, left_out
        least = min(expendable, key=lambda column: column.gives_way)
        columns.remove(least)
        left_out.append(" ".join(least.head.split()))


def _draw(rows: Sequence[Mapping[str, Any]], columns: Sequence[_Column], marked: str | None = None):
    from rich import box
    from rich.table import Table

    grid = Table(box=box.SIMPLE_HEAD, header_style="bold", pad_edge=False)
    for column in columns:
        grid.add_column(column.head, justify="left" if column.head in ("policy", "sees") else "right", no_wrap=True)
    for row in rows:
        here = address(row) == marked
        learns = row["params"] or is_elsewhere(row)
        cells = [column.cell(row) for column in columns]
        grid.add_row(
            f"→ {cells[0]}" if here else cells[0], *cells[1:], style="bold" if here else "" if learns else "dim"
        )
    return grid


def _columns(table: Mapping[str, Any], unit: str | None) -> list[_Column]:
    """From left to right, those that have something to show."""
    from rich.markup import escape

    rows = table["policies"]
    in_unit = f"\n{unit}" if unit else ""

    def number(key: str, digits: int = 4) -> Callable[[Mapping[str, Any]], str]:
        return lambda row: _number(row[key], digits)

    def score(row: Mapping[str, Any]) -> str:
        return _number(row["rollouts"] and row["rollouts"].get("score"), 3)

    columns = [
        _Column("policy", lambda row: escape(row["policy"]) + (" (seen in training)" if is_seen(row) else "")),
        _Column("sees", lambda row: escape(row["observations"])),
        _Column(f"first step\nMAE{in_unit}", _first_step),
        _Column("\n× hold-still", number("vs_hold_still", 3)),
        *_verdicts(table),
        _Column(f"\nRMSE{in_unit}", number("first_step_rmse"), 4),
    ]
    if any(first_step_gap(row) for row in rows):
        columns.append(_Column("above floor\nRMSE", _above_floor, 9))
    if any(len(row["error_by_joint"]) == 2 for row in rows):
        columns.append(_Column(f"\nL2{in_unit}", number("first_step_l2"), 8))
    if unit is None:
        columns.append(_Column("\nscaled", number("scaled", 3), 5))
    if any(row["at_one_second_mae"] is not None for row in rows):
        columns.append(_Column(f"at 1 s\nMAE{in_unit}", _at_one_second, 10))
    optional = [
        ("whole_chunk_mae", f"whole chunk\nMAE{in_unit}", 7),
        ("ensembled_first_step_mae", f"ensembled\nMAE{in_unit}", 6),
    ]
    columns += [
        _Column(head, number(key), way) for key, head, way in optional if any(row[key] is not None for row in rows)
    ]
    if any(row["rollouts"] for row in rows):
        columns += [_Column("success", _success), _Column("score", score, 11)]
    return [
        *columns,
        _Column("params", lambda row: f"{row['params']:,}" if row["params"] else "—", 3),
        _Column("trained\ns", lambda row: f"{row['train_s']:,.0f}" if row["params"] else "—", 1),
        _Column("call\nms", number("latency_ms", 2), 2),
    ]


def _verdicts(table: Mapping[str, Any]) -> list[_Column]:
    """What the tests say of the first step; a column without a word is left out."""
    rows, named = table["policies"], champion(table)
    heads = {"vs_hold_still": ("against\nhold-still", 13), "vs_champion": ("against\nchampion", 12)}

    def word(row: Mapping[str, Any], rival: str) -> str:
        if rival == "vs_champion" and address(row) == named:
            return "champion"
        return _verdict(row["verdict"][rival])

    return [
        _Column(head, lambda row, rival=rival: word(row, rival), way)
        for rival, (head, way) in heads.items()
        if any(row["verdict"][rival] for row in rows)
    ]


COLOURS = {"better": "green", "worse": "red", "cannot tell": "yellow", "not comparable": "dim"}


def _verdict(word: str | None, *, mark_only: bool = False) -> str:
    if word is None:
        return "—"
    return f"[{COLOURS[word]}]{MARKS[word]}{'' if mark_only else f' {word}'}[/]"


def _above_floor(row: Mapping[str, Any]) -> str:
    gap = first_step_gap(row)
    if gap is None:
        return "—"
    short, beside = gap_parts(gap)
    beside = beside.strip("[]").replace(", ", "–")
    return f"{short} [dim]{beside}[/]" if beside else short


def _at_one_second(row: Mapping[str, Any]) -> str:
    """The error, with the mark of its verdict against hold-still at the same horizon."""
    value, word = _number(row["at_one_second_mae"]), row["verdict"]["vs_hold_still_at_one_second"]
    return f"{value} {_verdict(word, mark_only=True)}" if word else value


def _number(value: float | None, digits: int = 4) -> str:
    return "—" if value is None else f"{value:#.{digits}g}".rstrip(".")


def _first_step(row: Mapping[str, Any]) -> str:
    """The error and its interval."""
    interval = row["interval"].get("first_step_mae")
    value = f"[bold]{_number(row['first_step_mae'])}[/]"
    return f"{value} [dim]{_number(interval[0], 3)}–{_number(interval[1], 3)}[/]" if interval else value


def _success(row: Mapping[str, Any]) -> str:
    rollouts = row["rollouts"]
    if not rollouts:
        return "—"
    interval = rollouts.get("success_interval")
    value = f"{100 * rollouts['success']:.0f} %"
    return f"{value} [dim]{100 * interval[0]:.0f}–{100 * interval[1]:.0f}[/]" if interval else value


def _common_unit(units: Sequence[str | None]) -> str | None:
    return units[0] if units and len(set(units)) == 1 else None


def _units_words(dataset: Mapping[str, Any]) -> str:
    from rich.markup import escape

    units = list(dict.fromkeys(unit or "unit not stated" for unit in dataset["action_units"]))
    words = " and ".join(units)
    return escape(words + (", MAE mixes them: see scaled" if len(units) > 1 else ""))


def _footnotes(table: Mapping[str, Any]) -> list[str]:
    lines = [_setting(table), _means(table)]
    if any(row["verdict"]["vs_hold_still"] for row in table["policies"]):
        lines.append(
            f"against: paired tests over episodes and seeds, {families_words(table)} ✓ better, ✗ worse, ? cannot tell; "
            "at 1 s: against hold-still"
        )
    if any(row["rollouts"] for row in table["policies"]):
        trials = max(row["rollouts"]["n"] for row in table["policies"] if row["rollouts"])
        lines.append(f"success: {trials} start states, one network, Clopper–Pearson 95 % · score: mean best reward")
    if any(first_step_gap(row) for row in table["policies"]):
        lines.append(
            "above floor: the first action's RMSE less the least that a policy of what it sees can have (gamma); "
            "none where a baseline sees more than the set it stands with"
        )
    lines += elsewhere_words(table)
    lines += [f"no floor of '{name}' at the first action: {why}" for name, why in without_floor(table).items()]
    if not_held(table):
        lines.append(NOT_HELD)
    radius = table["floor"]["radius"]
    if radius and radius["mean"] is not None:
        unit = f" {radius['unit']}" if radius["unit"] else ""
        lines.append(
            f"floor by radius (the notebook's, biased), L2, '{radius['observations']}': "
            f"mean {radius['mean']:.2f}{unit}, 90th percentile {radius['p90']:.2f}{unit}, {radius['probes']} probes; "
            "it bounds no MAE"
        )
    if table["dataset"].get("revision"):
        lines.append(f"revision {table['dataset']['revision'][:12]} · split {table['split']['hash'][:12]}")
    return lines


def _setting(table: Mapping[str, Any]) -> str:
    budget, folds = table["budget"], table["split"]["folds"]
    name = f"{budget['name']}, " if budget["name"] else ""
    held_out = sum(len(fold["test"]) for fold in folds)
    split = f"{len(folds)} folds" if len(folds) > 1 else f"1 fold, {len(folds[0]['train'])} episodes train"
    return (
        f"protocol {table['protocol']} · budget {name}{budget['seeds']} seed{'s' * (budget['seeds'] != 1)} × "
        f"{budget['steps']:,} steps · {split}, {held_out} held out"
    )


def _means(table: Mapping[str, Any]) -> str:
    over = "episodes, each counts once" if table["protocol"] == "strict" else "frames"
    return (
        f"mean over {over}, averaged over seeds · {interval_words(table)} · × hold-still above 1: a smaller error than "
        "standing still"
    )

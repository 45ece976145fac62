"""The head-to-head table as JSON.

What belongs here: putting facts, scores, floors and roll-outs into the shape that `demobench run --json` promises. What does
not: working any of them out, or drawing it (`sinks.text_table`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from pipeline.by_task import errors_by_task
from pipeline.execution import settled
from pipeline.experiment import Experiment, Variant
from pipeline.external.pairing import Rival, judge_with_elsewhere
from pipeline.methods import METHODS
from pipeline.statistics.brackets import Scored, Sight, form_brackets, gap_to_floor, sight_of, value_of_sensors
from pipeline.statistics.closed_loop import Driven, closed_loop_verdicts
from pipeline.statistics.comparisons import table_comparisons
from pipeline.types import FloorEstimate, ObservationSet, RadiusFloor, Split

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
        `windows_train`, `windows_test`, `latency_ms`, `latency_p99_ms`, `parameters`, `train_s`, `rollouts` (a summary or None),
        `rolled_out` (what it sums up: `Rollouts`, one a seed) and `no_rollouts` (why there are none where there could be). One
        that was predicted elsewhere also has `elsewhere`:
        `seen_in_training`, `training` (words), `episodes`, `samples`, `warnings` and `sight_stated`.
    modes : `modes.ModesEvidence` as dictionaries.

    Returns
    -------
    dict : JSON-able; rows in the order of their first-step error. A number that is not finite is None.
    """
    rows = [_row(entry, experiment, facts) for entry in entries]
    rows.sort(key=_best_first)
    comparisons = _compare(rows, facts, experiment, entries)
    against_floors = _against_floors(rows, facts, experiment, estimates, entries)
    table = {
        "dataset": dataset_json(facts),
        "protocol": experiment.protocol,
        "budget": {
            "name": experiment.budget,
            "steps": experiment.steps,
            "seeds": experiment.seeds,
            "own": _own_budgets(experiment, entries),
        },
        "split": {
            "hash": split.hash,
            "folds": [{"train": list(fold.train), "test": list(fold.test)} for fold in split.folds],
        },
        "floor": floor_json(floors, estimates),
        **against_floors,
        "modes": list(modes),
        "policies": rows,
        "comparisons": comparisons,
        "closed_loop": closed_loop_verdicts(_driven(rows, entries), experiment.dataset.champion),
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
    elsewhere = [_rival(entry) for entry in entries if "elsewhere" in entry]
    found = judge_with_elsewhere(found, [_rival(entry) for entry in ours], elsewhere, facts["fps"], experiment.protocol)
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


def _driven(rows: Sequence[Mapping[str, Any]], entries: Sequence[Mapping[str, Any]]) -> list[Driven]:
    """What was rolled out, in the order of the rows."""
    rolled = {(e["variant"].name, e["observations"]): e for e in entries if e.get("rolled_out")}
    found = [(row, rolled.get((row["policy"], row["observations"]))) for row in rows]
    return [
        Driven(f"{row['policy']}/{row['observations']}", entry["variant"].is_trained, entry["rolled_out"])
        for row, entry in found
        if entry
    ]


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
            sight_of(e["variant"], _seen_by(e["variant"], sets[e["observations"]], experiment), history, kinds),
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


def _own_budgets(experiment: Experiment, entries: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Policy → its budget in words, for those that do not train as long as the benchmark says."""
    variants = {e["variant"].name: e["variant"] for e in entries}
    return {name: experiment.budget_of(v) for name, v in variants.items() if experiment.has_own_budget(v)}


def _seen_by(variant: Variant, observation_set: ObservationSet, experiment: Experiment) -> ObservationSet:
    """The observation set as a policy sees it: with as many frames as the policy was given, and with its camera."""
    policy = experiment.policies.get(variant.family)
    seen = observation_set
    if policy is not None and policy.history is not None:
        seen = replace(seen, history=policy.history)
    return replace(seen, features=(*seen.features, "camera")) if METHODS[variant.method].camera else seen


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


def _row(entry: Mapping[str, Any], experiment: Experiment, facts: Mapping[str, Any]) -> dict[str, Any]:
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
        "steps": entry.get("steps"),
        "cpu_s": entry.get("cpu_s"),
        "vram_mb": entry.get("vram_mb"),
        "latency_ms": entry["latency_ms"],
        **_deadline(entry, experiment, facts["fps"]),
        "verdict": {
            "vs_hold_still": None,
            "vs_champion": None,
            "vs_hold_still_at_one_second": None,
            "vs_champion_at_one_second": None,
        },
        "above_floor": [],
        "rollouts": entry["rollouts"],
        "no_rollouts": entry.get("no_rollouts"),
        "samples": entry.get("samples"),
        "by_task": errors_by_task(entry["errors"], facts["episode_tasks"], experiment.protocol),
        **entry.get("elsewhere", {}),
    }


def _deadline(entry: Mapping[str, Any], experiment: Experiment, fps: float) -> dict[str, Any]:
    """How late a call is now and then, against the time that there is for it: until the next question, or, where a delay is
    reckoned with, that delay. None where nothing asks it in time: baselines, and what was predicted elsewhere."""
    variant, late = entry["variant"], entry.get("latency_p99_ms")
    policy = experiment.policies.get(variant.family)
    found = {"latency_p99_ms": late, "deadline_ms": None, "misses_deadline": None, "execution": None}
    if late is None or policy is None or not variant.is_trained:
        return found
    execution = settled(policy.execution, variant.chunk or 1)
    deadline = 1e3 / fps * (execution.delay or execution.execute)
    return found | {"deadline_ms": deadline, "misses_deadline": late > deadline, "execution": asdict(execution)}


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

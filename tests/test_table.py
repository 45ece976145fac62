"""The table: the shape that `demobench run --json` promises, and what a reader sees."""

import json
from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from pipeline.sinks.explanations import facts
from pipeline.sinks.text_table import render_table
from pipeline.statistics.closed_loop import summarise_rollouts
from pipeline.statistics.floors import measure_floors
from pipeline.statistics.radius import radius_floor
from pipeline.table import build_table, dataset_json, floor_json, json_safe
from pipeline.types import Rollouts
from tests.hand_made import STATE_ONLY, random_walks, semantics
from tests.sinks.making import (
    make_closed_loop,
    make_comparison,
    make_demos,
    make_driven,
    make_gap,
    make_semantics,
    make_table,
    make_verdict,
)  # fmt: skip
from tests.statistics.test_metrics import scored, task_of

ROLLOUTS = {
    "n": 50, "seeds": 1, "episodes": 50, "successes": 21, "success": 0.42, "success_interval": [0.28, 0.57], "score": 0.83,
}  # fmt: skip
ROW = {
    "policy", "method", "chunk", "observations", "seeds", "windows_train", "windows_test", "first_step_mae",
    "first_step_rmse", "first_step_l2", "at_one_second_mae", "whole_chunk_mae", "error_by_horizon",
    "hold_still_by_horizon", "error_by_joint", "params", "train_s", "latency_ms", "vs_hold_still", "scaled", "interval",
    "interval_method", "verdict", "above_floor", "rollouts", "by_task",
}  # fmt: skip


def facts_of(demos, meaning):
    action = demos.features["action"]
    return {
        "name": "[bold]tape[/]", "revision": None, "content_hash": demos.content_hash, "episodes": demos.episodes,
        "frames": demos.frames, "fps": demos.fps, "action_names": action.names, "action_units": action.units,
        "action_kinds": meaning.kinds, "tracking_lag": meaning.tracking_lag, "warnings": ["a joint hardly moves"],
        "source": "not part of the table", "excluded": demos.excluded, "episode_tasks": demos.tasks,
    }  # fmt: skip


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    demos = random_walks((50,) * 6, units={"action": ("px", "px")})
    entries = []
    for variant in ("mlp_k32", "hold_still", "mlp_k01"):
        task = task_of(demos, variant)
        score, predictions = scored(task, tmp_path_factory.mktemp(variant))
        entries.append({
            "variant": task.variant, "observations": "state", "metrics": score.metrics, "windows_train": 240,
            "windows_test": len(predictions.anchors), "errors": score.errors, "latency_ms": 0.1,
            "latency_p99_ms": 900.0 if variant == "mlp_k01" else 0.3,
            "parameters": 7 * task.variant.is_trained,
            "train_s": 1.5, "rollouts": ROLLOUTS if variant == "mlp_k01" else None,
        })  # fmt: skip
    entries[0]["metrics"]["first_step_rmse"] = float("nan")
    floors = [radius_floor(demos, semantics(demos), STATE_ONLY, min_neighbours=2)]
    estimates = measure_floors(demos, semantics(demos), STATE_ONLY, task.split, history=3, horizons=(0, 10))
    return build_table(facts_of(demos, semantics(demos)), task.experiment, task.split, floors, estimates, entries)


def test_it_has_the_shape_that_is_promised(table):
    assert {"dataset", "protocol", "split", "floor", "brackets", "policies", "artifacts"} <= set(table)
    assert set(table["dataset"]) == {
        "name", "revision", "content_hash", "episodes", "frames", "fps", "action_names", "action_units", "action_kinds",
        "tracking_lag", "excluded", "warnings",
    }  # fmt: skip
    assert {bracket["words"] for bracket in table["brackets"]} == {
        "refused: 6 episodes are too few to find neighbours in; a floor needs 30"
    }
    assert table["sensors"] == []
    assert {(c["a"], c["b"], c["metric"]) for c in table["comparisons"]} == {
        ("mlp_k32/state", "hold_still/state", "first_step_mae"), ("mlp_k01/state", "hold_still/state", "first_step_mae"),
        ("mlp_k32/state", "hold_still/state", "at_one_second_mae"),
    }  # fmt: skip
    assert {"probes", "median_neighbours", "mean", "p90"} <= set(table["floor"]["radius"])
    for row in table["policies"]:
        assert set(row) >= ROW
        assert set(row["verdict"]) == {
            "vs_hold_still", "vs_champion", "vs_hold_still_at_one_second", "vs_champion_at_one_second",
        }  # fmt: skip
        assert (row["verdict"]["vs_hold_still"] is None) == (row["policy"] == "hold_still")
        assert row["above_floor"] == []
        assert len(row["error_by_horizon"]) == len(row["hold_still_by_horizon"])
        assert set(row["error_by_joint"]) == {"a0", "a1"}
    held_out = [episode for fold in table["split"]["folds"] for episode in fold["test"]]
    assert sorted(held_out) == list(range(6))


def test_it_is_json_without_numbers_that_are_none(table):
    again = json.loads(json.dumps(table, allow_nan=False))
    assert again == table
    assert next(row for row in again["policies"] if row["chunk"] == 32)["first_step_rmse"] is None


def test_the_time_there_is_for_a_call_is_that_of_the_actions_carried_out(table):
    """At 10 fps one action lasts 0.1 s, and of a chunk of 32 eight are carried out."""
    rows = {row["policy"]: row for row in table["policies"]}
    period = 1e3 / table["dataset"]["fps"]
    late = {name: (row["deadline_ms"], row["misses_deadline"]) for name, row in rows.items()}
    assert late == {"mlp_k01": (period, period < 900), "mlp_k32": (8 * period, False), "hold_still": (None, None)}
    assert rows["mlp_k32"]["execution"] == {"execute": 8, "ensemble": False, "delay": 0, "carry_on": False}
    assert rows["hold_still"]["latency_p99_ms"] == 0.3


def test_rows_are_sorted_by_the_first_step(table):
    errors = [row["first_step_mae"] for row in table["policies"]]
    assert errors == sorted(errors)


def test_what_does_not_apply_is_null(table):
    rows = {row["policy"]: row for row in table["policies"]}
    assert rows["hold_still"]["chunk"] is None
    assert rows["hold_still"]["whole_chunk_mae"] is None
    assert rows["mlp_k01"]["at_one_second_mae"] is None
    assert rows["mlp_k01"]["interval"]["at_one_second_mae"] is None
    assert rows["mlp_k32"]["at_one_second_mae"] > 0
    assert rows["hold_still"]["seeds"] == 1
    assert rows["mlp_k01"]["seeds"] == 2


def drawn(table, width: int) -> str:
    """What a console of that width shows; a sentence may go on in the next line."""
    out = StringIO()
    render_table(table, Console(file=out, width=width, color_system=None))
    return out.getvalue()


def test_a_reader_sees_what_the_numbers_rest_on(table):
    text = drawn(table, 200)
    for words in (
        "[bold]tape[/]", "px", "mlp_k01", "state", "42 % 28–57", "—", "5 folds, 6 held out", "2 seeds × 5 steps",
        "protocol strict", "95 % interval: bootstrap-t over held-out episodes and seeds, for these folds", "Clopper–Pearson",
        "floor by radius", "3 comparisons in one family",
            "no floor of the RMSE of policies seeing 'state' at the first action: 6 episodes are too few",
        "against", "Closest to the demonstrations is", "No floor of the RMSE can be given at the first action",
    ):  # fmt: skip
        assert words in text
    assert "left out" not in text


def test_several_tasks_have_a_table_of_their_own():
    demos = make_demos()
    table = make_table(demos, make_semantics(demos))
    table["dataset"]["warnings"] = []
    assert "by task" not in drawn(table, 160)
    for number, row in enumerate(table["policies"]):
        row["by_task"] = {
            "[red]pick[/]": {"first_step_mae": 1.25 + number, "episodes": 6, "interval": [1.0, 1.5]},
            "place": {"first_step_mae": 2.5, "episodes": 4, "interval": None},
        }
    text = drawn(table, 160)
    for words in ("first step MAE by task", "[red]pick[/]", "(4 held out)", "1.250 1.00–1.50", "2.500"):
        assert words in text


@pytest.mark.parametrize("width", [60, 80, 100])
def test_a_narrow_console_gets_fewer_columns_not_broken_ones(table, width):
    text = drawn(table, width)
    grid = [line for line in text.splitlines() if line.startswith((" mlp", " hold", " policy"))]
    assert len(grid) == 4
    assert max(map(len, grid)) <= width
    assert "left out for want of width: trained s" in text


def test_lines_below_the_table_break_between_words(table):
    narrow, wide = (drawn(table, width).partition("protocol strict")[2] for width in (80, 500))
    assert max(map(len, narrow.splitlines())) <= 80
    assert max(map(len, wide.splitlines())) > 100
    narrow, _, _ = narrow.partition("left out for want of width")
    assert wide.split()[: len(narrow.split())] == narrow.split()


def test_the_answers_give_way_last():
    """At 80 columns the verdicts, the error one second ahead and the distance to the floor are there; what all rows share is
    not, and neither are the costs of training."""
    demos = make_demos()
    table = make_table(demos, make_semantics(demos))
    table["dataset"]["warnings"] = []
    for row, name in zip(table["policies"], ("constant_velocity", "mlp_k32", "hold_still"), strict=True):
        row.update(policy=name, at_one_second_mae=8.0, above_floor=[], rollouts=None)
        row["verdict"] = make_verdict(vs_hold_still="better", vs_hold_still_at_one_second="worse")
    text = drawn(table, 80)
    (row,) = [line for line in text.splitlines() if line.startswith(" constant_velocity")]
    assert "✓ better" in row
    assert "8.000 ✗" in row
    assert len(row) <= 80
    (left,) = [line for line in text.splitlines() if line.startswith("left out for want of width")]
    assert "sees (state)" in left
    table["policies"][0]["observations"] = "pose"
    assert "sees (" not in drawn(table, 80)


def test_verdicts_and_distances_to_floors_stand_beside_the_numbers():
    demos = make_demos()
    table = make_table(demos, make_semantics(demos))
    table["dataset"]["warnings"] = []
    first, second, still = table["policies"]
    first["verdict"] = make_verdict(vs_hold_still="better", vs_champion="cannot tell")
    second["verdict"] = make_verdict(vs_hold_still="worse", vs_hold_still_at_one_second="worse")
    second["at_one_second_mae"] = 8.0
    still["above_floor"] = [make_gap(interval=[-0.8, 0.5])]
    champion = make_comparison("mlp_k01/state", "mlp_k04/state", "cannot tell", words="needs more")
    table["comparisons"].append(champion)
    lines = drawn(table, 200).splitlines()
    rows = {
        name: next(line for line in lines if line.strip().startswith(name))
        for name in ("mlp_k01", "mlp_k04", "hold_still")
    }
    assert "4.44     ✓ better   ? cannot tell" in rows["mlp_k01"]
    assert "1.62 1.25–2.00" in rows["mlp_k01"]
    assert "✗ worse        champion" in rows["mlp_k04"]
    assert "8.000 ✗" in rows["mlp_k04"]
    assert "at the floor ±0.800" in rows["hold_still"]
    assert "It cannot be told from the second, mlp_k04: needs more." in lines


def test_verdicts_in_closed_loop_stand_beside_success():
    demos = make_demos()
    table = make_table(demos, make_semantics(demos))
    table["dataset"]["warnings"] = []
    table["policies"][0]["rollouts"] = table["policies"][1]["rollouts"] | {
        "success": 0.4,
        "success_interval": [0.27, 0.55],
    }
    worse = make_driven("mlp_k01/state", "mlp_k04/state", "worse", "worse")
    table["closed_loop"] = make_closed_loop(*worse, family=2)
    text = drawn(table, 200)
    assert "40 % 27–55 ✗" in text
    assert "closed loop: 2 comparisons in a family of their own, against mlp_k04, which does best" in text
    assert "success: 50 start states, one network (seed 0 of fold 0), Clopper–Pearson 95 % · score" in text


@pytest.mark.parametrize(("champion", "chosen", "family"), [(None, "best", 6), ("mlp_k01", "champion", 4)])
def test_the_table_judges_what_was_rolled_out(table, tmp_path, champion, chosen, family):
    """Three rows of the real table, rolled out by hand: half, all and none of forty."""
    demos = random_walks((50,) * 6, units={"action": ("px", "px")})
    succeed = {"mlp_k01": np.arange(40) < 20, "mlp_k32": np.arange(40) < 40, "hold_still": np.arange(40) < 0}
    entries = []
    for variant, success in succeed.items():
        task = task_of(demos, variant)
        (tmp_path / variant).mkdir()
        score, _ = scored(task, tmp_path / variant)
        rolled = [
            Rollouts(
                "any", "1", variant, "state", np.arange(40), success, success * 1.0, success * 1.0, np.full(40, 9), None
            )
        ]
        entries.append({
            "variant": task.variant, "observations": "state", "metrics": score.metrics, "windows_train": 240,
            "windows_test": 60, "errors": score.errors, "latency_ms": 0.1, "parameters": 7 * task.variant.is_trained,
            "train_s": 1.5, "rollouts": summarise_rollouts(rolled), "rolled_out": rolled,
        })  # fmt: skip
    dataset = task.experiment.dataset.model_copy(update={"champion": champion})
    experiment = task.experiment.model_copy(update={"dataset": dataset})
    found = build_table(facts_of(demos, semantics(demos)), experiment, task.split, [], [], entries)["closed_loop"]
    assert (found["chosen"], found["family"]) == (chosen, family)
    words = {(c["a"], c["metric"]): c["word"] for c in found["comparisons"]}
    rest = ("mlp_k32/state", "better") if champion else ("mlp_k01/state", "worse")
    assert words == {
        (rest[0], "success"): rest[1], (rest[0], "score"): rest[1],
        ("hold_still/state", "success"): "worse", ("hold_still/state", "score"): "worse",
    }  # fmt: skip


def test_names_are_never_markup_in_a_sentence():
    demos = make_demos()
    table = make_table(demos, make_semantics(demos))
    table["dataset"]["warnings"] = []
    table["policies"][0]["observations"] = "[red]x[/red]"
    assert "seeing [red]x[/red]: in 2 episodes" in drawn(table, 200)


def test_what_a_checkpoint_says_of_its_training_is_never_markup():
    demos = make_demos()
    table = make_table(demos, make_semantics(demos))
    table["dataset"]["warnings"] = []
    elsewhere = {"method": "external", "training": "trained on [/] [red]x", "warnings": ["[bold]odd"], "samples": None}
    table["policies"][0].update(elsewhere, episodes=[1, 2], seen_in_training=None)
    text = drawn(table, 200)
    assert ": trained on [/] [red]x" in text
    assert ": [bold]odd" in text


def test_what_was_left_out_of_every_number_is_said():
    demos = make_demos()
    table = make_table(demos, make_semantics(demos))
    table["dataset"]["warnings"] = []
    words = "left out by the configuration: episodes 3, 17"
    assert "left out by" not in drawn(table, 200)
    table["dataset"]["excluded"] = [3, 17]
    assert f"{words}\n" in drawn(table, 200)
    assert words in facts(table)[0]
    table["dataset"]["excluded"] = list(range(20))
    assert "episodes 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11 …\n" in drawn(table, 200)


def test_parts_that_other_commands_show():
    demos = random_walks((50,) * 2)
    refused = radius_floor(demos, semantics(demos), STATE_ONLY, radius=1e-6)
    shown = floor_json([refused])
    assert shown["radius"]["mean"] is None
    assert shown["estimates"][0]["refused"].startswith("none of")
    assert floor_json([]) == {"radius": None, "estimates": []}
    assert "source" not in dataset_json(facts_of(demos, semantics(demos)))


def test_numpy_does_not_leak_into_json():
    found = json_safe({"a": np.float32(1.5), "b": np.array([1, 2]), "c": (np.bool_(True), np.inf, None, "x")})
    assert found == {"a": 1.5, "b": [1, 2], "c": [True, None, None, "x"]}
    assert type(found["a"]) is float

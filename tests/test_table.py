"""The table: the shape that `demobench run --json` promises, and what a reader sees."""

import json
from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from pipeline.statistics.radius import radius_floor
from pipeline.table import build_table, dataset_json, floor_json, json_safe, render_table
from tests.hand_made import STATE_ONLY, random_walks, semantics
from tests.statistics.test_metrics import scored, task_of

ROLLOUTS = {"n": 50, "successes": 21, "success": 0.42, "success_interval": [0.28, 0.57], "score": 0.83}
ROW = {
    "policy", "method", "chunk", "observations", "seeds", "windows_train", "windows_test", "first_step_mae",
    "first_step_rmse", "first_step_l2", "at_one_second_mae", "whole_chunk_mae", "error_by_horizon",
    "hold_still_by_horizon", "error_by_joint", "params", "train_s", "latency_ms", "vs_hold_still", "scaled", "interval",
    "verdict", "rollouts",
}  # fmt: skip


def facts_of(demos, meaning):
    action = demos.features["action"]
    return {
        "name": "[bold]tape[/]", "revision": None, "content_hash": demos.content_hash, "episodes": demos.episodes,
        "frames": demos.frames, "fps": demos.fps, "action_names": action.names, "action_units": action.units,
        "action_kinds": meaning.kinds, "tracking_lag": meaning.tracking_lag, "warnings": ["a joint hardly moves"],
        "source": "not part of the table",
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
            "windows_test": len(predictions.anchors), "latency_ms": 0.1, "parameters": 7 * task.variant.is_trained,
            "train_s": 1.5, "rollouts": ROLLOUTS if variant == "mlp_k01" else None,
        })  # fmt: skip
    entries[0]["metrics"]["first_step_rmse"] = float("nan")
    floors = [radius_floor(demos, semantics(demos), STATE_ONLY, min_neighbours=2)]
    return build_table(facts_of(demos, semantics(demos)), task.experiment, task.split, floors, entries)


def test_it_has_the_shape_that_is_promised(table):
    assert {"dataset", "protocol", "split", "floor", "brackets", "policies", "artifacts"} <= set(table)
    assert set(table["dataset"]) == {
        "name", "revision", "content_hash", "episodes", "frames", "fps", "action_names", "action_units", "action_kinds",
        "tracking_lag", "warnings",
    }  # fmt: skip
    assert table["brackets"] == []
    assert {"probes", "median_neighbours", "mean", "p90"} <= set(table["floor"]["radius"])
    for row in table["policies"]:
        assert set(row) >= ROW
        assert row["verdict"] == {"vs_hold_still": None, "vs_champion": None}
        assert len(row["error_by_horizon"]) == len(row["hold_still_by_horizon"])
        assert set(row["error_by_joint"]) == {"a0", "a1"}
    held_out = [episode for fold in table["split"]["folds"] for episode in fold["test"]]
    assert sorted(held_out) == list(range(6))


def test_it_is_json_without_numbers_that_are_none(table):
    again = json.loads(json.dumps(table, allow_nan=False))
    assert again == table
    assert next(row for row in again["policies"] if row["chunk"] == 32)["first_step_rmse"] is None


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
    out = StringIO()
    render_table(table, Console(file=out, width=width, color_system=None))
    return out.getvalue()


def test_a_reader_sees_what_the_numbers_rest_on(table):
    text = drawn(table, 170)
    for words in (
        "[bold]tape[/]", "px", "mlp_k01", "state", "42 % 28–57", "—", "5 folds, 6 held out", "2 seeds × 5 steps",
        "protocol strict", "t over held-out episodes", "Clopper–Pearson", "floor by radius",
    ):  # fmt: skip
        assert words in text
    assert "left out" not in text


@pytest.mark.parametrize("width", [60, 80, 100])
def test_a_narrow_console_gets_fewer_columns_not_broken_ones(table, width):
    text = drawn(table, width)
    grid = [line for line in text.splitlines() if line.startswith((" mlp", " hold", " policy"))]
    assert len(grid) == 4
    assert max(map(len, grid)) <= width
    assert "left out for want of width: trained s" in text


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

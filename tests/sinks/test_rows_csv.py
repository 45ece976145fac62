"""The table's rows in a spreadsheet."""

import csv

from pipeline.sinks.rows_csv import write_rows

ROW = {
    "policy": "mlp_k04",
    "method": "mlp",
    "chunk": 4,
    "observations": "pose",
    "seeds": 5,
    "first_step_mae": 1.5,
    "at_one_second_mae": None,
    "whole_chunk_mae": 2.5,
    "interval": {"first_step_mae": [1.25, 1.75], "at_one_second_mae": None},
    "vs_hold_still": 2.0,
    "params": 100,
    "train_s": 0.5,
    "latency_ms": 0.25,
    "verdict": {"vs_hold_still": "better"},
    "rollouts": {"success": 0.5, "score": 0.75, "n": 50},
}


def test_a_row_is_read_back_with_its_interval_and_empty_cells(tmp_path):
    write_rows([ROW, ROW | {"policy": "hold_still", "chunk": None, "rollouts": None}], tmp_path / "rows.csv")
    with (tmp_path / "rows.csv").open(newline="") as file:
        first, second = csv.DictReader(file)
    assert (first["policy"], first["chunk"], second["policy"], second["chunk"]) == ("mlp_k04", "4", "hold_still", "")
    assert [float(first[f"first_step_mae{end}"]) for end in ("", "_low", "_high")] == [1.5, 1.25, 1.75]
    assert first["at_one_second_mae"] == first["at_one_second_mae_low"] == ""
    assert (first["success"], second["success"]) == ("0.5", "")
    assert first["against_hold_still"] == "better"


def test_a_table_without_rows_is_a_file_all_the_same(tmp_path):
    write_rows([], tmp_path / "rows.csv")
    assert (tmp_path / "rows.csv").read_text() == "policy\n"

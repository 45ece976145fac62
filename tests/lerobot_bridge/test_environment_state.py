"""The copy for ACT has the state under both names and is otherwise what was recorded."""

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from pipeline.errors import DatasetError, StoreError
from pipeline.lerobot_bridge.environment_state import ENVIRONMENT_STATE, copy_with_environment_state, main
from pipeline.lerobot_format.read import read_dataset
from pipeline.types import ACTION, STATE
from tests.makers import tiny_recording, write_v2, write_v3


def test_the_state_is_there_twice(tmp_path: Path) -> None:
    source, copy = (
        write_v3(tmp_path / "set", tiny_recording(5, (7, 4, 9, 5, 6)), episodes_per_file=2),
        tmp_path / "copy",
    )
    assert main([str(source), str(copy)]) == 0
    before, after = read_dataset(source, name="set"), read_dataset(copy, name="set")
    for key in (STATE, ACTION):
        np.testing.assert_array_equal(after.columns[key], before.columns[key])
    np.testing.assert_array_equal(after.columns[ENVIRONMENT_STATE], before.columns[STATE])
    np.testing.assert_array_equal(after.episode_starts, before.episode_starts)
    assert after.tasks == before.tasks
    stats = json.loads((copy / "meta/stats.json").read_text())
    assert stats[ENVIRONMENT_STATE] == stats[STATE]
    rows = pq.read_table(copy / "meta/episodes/chunk-000/file-000.parquet")
    assert rows[f"stats/{ENVIRONMENT_STATE}/mean"].to_pylist() == rows[f"stats/{STATE}/mean"].to_pylist()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["copy", "set"]


def test_it_overwrites_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = write_v3(tmp_path / "set", tiny_recording(2, 5))
    assert main([str(source), str(source)]) == 1
    assert "exists already" in capsys.readouterr().err


def test_an_older_folder(tmp_path: Path) -> None:
    source = write_v2(tmp_path / "set", tiny_recording(2, 5))
    with pytest.raises(DatasetError, match="is in format v2.1, and LeRobot trains on v3.0. Convert it first"):
        copy_with_environment_state(source, tmp_path / "copy")


def test_no_data_set(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="Give the folder that has meta/"):
        copy_with_environment_state(tmp_path, tmp_path / "copy")


def test_a_copy_of_a_copy(tmp_path: Path) -> None:
    source = write_v3(tmp_path / "set", tiny_recording(2, 5))
    copy_with_environment_state(source, tmp_path / "copy")
    with pytest.raises(DatasetError, match="has observation.environment_state already: there is nothing to copy"):
        copy_with_environment_state(tmp_path / "copy", tmp_path / "again")


def test_half_a_folder_leaves_nothing(tmp_path: Path) -> None:
    source = write_v3(tmp_path / "set", tiny_recording(2, 5))
    (source / "meta/tasks.parquet").unlink()
    with pytest.raises(StoreError, match=r"tasks.parquet.*A whole LeRobot v3.0 folder has"):
        copy_with_environment_state(source, tmp_path / "copy")
    assert [p.name for p in tmp_path.iterdir()] == ["set"]


def test_usage(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert "usage: python -m pipeline.lerobot_bridge.environment_state" in capsys.readouterr().err

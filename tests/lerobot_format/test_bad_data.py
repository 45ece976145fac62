"""Data files and columns that are wrong: one message each, that says what, where and what to do."""

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from pipeline.lerobot_format.read import read_dataset
from pipeline.types import ACTION, STATE
from tests.makers import edit_info, edit_table, tiny_recording, write_v3

V3_DATA, V3_EPISODES = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"
V2_DATA = "data/chunk-000/episode_000002.parquet"
Message = Callable[[Path], str]


# Data files


@pytest.mark.parametrize("keep", [0, 3, 100, -1, -8])
@pytest.mark.parametrize("file", [V3_DATA, V3_EPISODES, "meta/tasks.parquet"])
def test_a_truncated_parquet_file(message: Message, v3: Path, file: str, keep: int):
    content = (v3 / file).read_bytes()
    (v3 / file).write_bytes(content[:keep])
    assert f"{v3 / file} cannot be read as parquet: it is cut off or damaged. Copy the data set again" in message(v3)


def test_garbage_in_the_middle_of_a_parquet_file(message: Message, v3: Path):
    content = bytearray((v3 / V3_DATA).read_bytes())
    content[4:200] = b"\xff" * 196
    (v3 / V3_DATA).write_bytes(content)
    assert "cut off or damaged" in message(v3)


def test_a_missing_data_file(message: Message, v2: Path):
    (v2 / V2_DATA).unlink()
    assert f"{v2 / V2_DATA} is missing" in message(v2)


def test_a_missing_list_of_episodes_v2(message: Message, v2: Path):
    (v2 / "meta/episodes.jsonl").unlink()
    assert "episodes.jsonl is missing" in message(v2)


def test_a_missing_list_of_episodes_v3(message: Message, v3: Path):
    (v3 / V3_EPISODES).unlink()
    assert "the list of episodes is missing" in message(v3)


@pytest.mark.parametrize("line", ["nonsense", "[1]", '{"episode_index": 1', "3"])
def test_a_damaged_list_of_episodes(message: Message, v2: Path, line: str):
    path = v2 / "meta/episodes.jsonl"
    path.write_text(path.read_text() + line + "\n")
    assert "episodes.jsonl, line 5: expected a JSON object" in message(v2)


@pytest.mark.parametrize(
    "row", [{"episode_index": "1"}, {"episode_index": -1}, {"length": 2.5}, {"length": None}, {"length": 2**60}]
)
def test_a_list_of_episodes_with_impossible_numbers(message: Message, v2: Path, row: dict):
    path = v2 / "meta/episodes.jsonl"
    path.write_text(path.read_text() + json.dumps({"episode_index": 4, "tasks": [], "length": 3} | row) + "\n")
    assert "expected a whole number, 0 or more" in message(v2)


def test_an_episode_that_is_listed_twice(message: Message, v2: Path):
    path = v2 / "meta/episodes.jsonl"
    listed = path.read_text()
    path.write_text(listed * 2)
    read = read_dataset(v2, name="set")
    assert read.episodes == 4
    assert "meta/ lists some episodes several times, each time alike; they count once." in read.warnings
    path.write_text(listed + json.dumps({"episode_index": 0, "tasks": [], "length": 3}))
    assert "lists episode 0 twice, and not alike" in message(v2)


def test_zero_episodes_v2(message: Message, v2: Path):
    (v2 / "meta/episodes.jsonl").write_text("")
    assert "holds no episodes. Record at least one" in message(v2)


def test_zero_episodes_v3(message: Message, v3: Path):
    edit_table(v3 / V3_EPISODES, lambda table: table.slice(0, 0))
    assert "holds no episodes" in message(v3)
    shutil.rmtree(v3 / "meta/episodes")
    edit_info(v3, lambda info: info.update(total_episodes=0))
    assert "holds no episodes" in message(v3)


@pytest.mark.parametrize("length", [19, 21, 1])
def test_lengths_that_contradict_the_data(message: Message, v2: Path, length: int):
    """The frames' own numbers are two witnesses against the list; without them nothing tells who is right."""
    path = v2 / "meta/episodes.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    rows[2]["length"] = length
    path.write_text("\n".join(map(json.dumps, rows)))
    read = read_dataset(v2, name="set")
    assert read.lengths.tolist() == [20] * 4
    assert f"(2: {length}, found 20); the data were believed." in " ".join(read.warnings)
    for file in (v2 / "data").rglob("*.parquet"):
        edit_table(file, lambda table: table.drop_columns(["episode_index", "frame_index"]))
    assert f"{V2_DATA} has 20 frames; the episodes that meta/ lists in it have {length}" in message(v2)


def test_boundaries_that_contradict_the_data(message: Message, v3: Path):
    """The total of the file is right, so only the frames' own numbers show it."""
    truth = read_dataset(v3, name="set")
    edit_table(
        v3 / V3_EPISODES,
        lambda table: table.set_column(table.column_names.index("length"), "length", pa.array([19, 21, 20, 20])),
    )
    read = read_dataset(v3, name="set")
    assert read.content_hash == truth.content_hash
    assert "(0: 19, found 20, 1: 21, found 20); the data were believed." in " ".join(read.warnings)
    edit_table(v3 / V3_DATA, lambda table: table.drop_columns(["frame_index"]))
    assert "episode 0 has 20 frames, but meta/ lists 19" in message(v3)


def test_frames_out_of_order(message: Message, v2: Path):
    truth = read_dataset(v2, name="set")
    edit_table(v2 / V2_DATA, lambda table: table.take([*range(10), 11, 10, *range(12, 20)]))
    read = read_dataset(v2, name="set")
    assert read.content_hash == truth.content_hash
    assert "Frames lay out of order and were sorted by frame_index: episode 2." in read.warnings
    edit_table(v2 / V2_DATA, lambda table: table.take([*range(10), 9, *range(11, 20)]))
    assert "episode 2 has frame_index" in message(v2)
    assert "frames are missing, twice or out of order" in message(v2)


def test_files_in_another_order_than_their_episodes(message: Message, tmp_path: Path):
    folder = write_v3(tmp_path / "set", tiny_recording(4, 20), episodes_per_file=2)
    truth = read_dataset(folder, name="set")
    for file, numbers in (("file-000", [0, 2]), ("file-001", [1, 3])):
        edit_table(
            folder / f"data/chunk-000/{file}.parquet",
            lambda table, numbers=numbers: table.set_column(
                table.column_names.index("episode_index"), "episode_index", pa.array(np.repeat(numbers, 20))
            ),
        )
    edit_table(
        folder / V3_EPISODES,
        lambda table: table.set_column(
            table.column_names.index("data/file_index"), "data/file_index", pa.array([0, 1, 0, 1])
        ),
    )
    read = read_dataset(folder, name="set")
    np.testing.assert_array_equal(read.columns[ACTION][20:40], truth.columns[ACTION][40:60])
    assert "The data files do not hold the episodes in order; they were sorted by episode_index." in read.warnings
    for file in (folder / "data").rglob("*.parquet"):
        edit_table(file, lambda table: table.drop_columns(["episode_index"]))
    assert "the frames have no episode_index that would tell them apart" in message(folder)


# Columns


def replace_column(path: Path, key: str, values: pa.Array) -> None:
    edit_table(path, lambda table: table.set_column(table.column_names.index(key), key, values))


@pytest.mark.parametrize(
    ("values", "got"),
    [
        (
            pa.array([[1.0, 2.0, 3.0]] * 20, pa.list_(pa.float32(), 3)),
            "has 3 a frame; meta/info.json declares 2 numbers",
        ),
        (pa.array([[1.0, 2.0, 3.0]] * 20), "has 3 a frame"),
        (pa.array([1.0] * 20), "has 1 a frame"),
        (pa.array([[1.0, 2.0]] * 19 + [[1.0]]), "has lists of 1 to 2"),
        (pa.array([[1.0, 2.0]] * 19 + [None]), "has a frame without a value"),
        (pa.array([["1", "2"]] * 20), "has values of type string"),
        (pa.array([{"x": 1}] * 20), "has values of type struct"),
    ],
)
@pytest.mark.parametrize("key", [ACTION, STATE])
def test_wrong_shapes(message: Message, v2: Path, key: str, values: pa.Array, got: str):
    replace_column(v2 / V2_DATA, key, values)
    assert f"{V2_DATA}: column '{key}' {got}" in message(v2)


def test_a_declared_shape_that_the_data_do_not_have(message: Message, v3: Path):
    edit_info(v3, lambda info: info["features"][ACTION].update(shape=[3], names=["a", "b", "c"]))
    assert "column 'action' has 2 a frame; meta/info.json declares 3 numbers a frame" in message(v3)


@pytest.mark.parametrize(
    ("value", "shown"),
    [(math.nan, "nan"), (math.inf, "inf"), (-math.inf, "-inf"), (None, "nan"), (1e300, "inf")],
)
@pytest.mark.parametrize("key", [ACTION, STATE])
def test_numbers_that_are_none_name_their_place(message: Message, v2: Path, key: str, value: float | None, shown: str):
    rows = [[0.5, float(i)] for i in range(20)]
    rows[7][1] = value
    replace_column(v2 / V2_DATA, key, pa.array(rows, pa.list_(pa.float64(), 2)))
    text = message(v2)
    assert f"{key} is {shown} in episode 2, frame 7, column 'joint_1'; expected a finite number" in text


def test_nan_in_a_reward_is_no_error(v2: Path):
    for path in sorted((v2 / "data").rglob("*.parquet")):
        edit_table(path, lambda table: table.append_column("next.reward", pa.array([None] * 20, pa.float32())))
    edit_info(
        v2, lambda info: info["features"].update({"next.reward": {"dtype": "float32", "shape": [1], "names": None}})
    )
    assert np.isnan(read_dataset(v2, name="set").columns["next.reward"]).all()


def test_nan_in_the_clock(message: Message, v2: Path):
    replace_column(v2 / V2_DATA, "timestamp", pa.array([0.1] * 19 + [float("nan")], pa.float32()))
    assert "the timestamp of frame 59 is nan" in message(v2)


@pytest.mark.parametrize("key", [ACTION, STATE])
def test_a_column_that_is_declared_and_absent(message: Message, v2: Path, key: str):
    edit_table(v2 / V2_DATA, lambda table: table.drop_columns([key]))
    assert f"{V2_DATA} has no column '{key}', which meta/info.json declares" in message(v2)


def test_another_column_that_is_absent_is_only_left_out(v2: Path):
    edit_table(v2 / V2_DATA, lambda table: table.drop_columns(["next.done"]))
    read = read_dataset(v2, name="set")
    assert "next.done" not in read.columns
    assert "next.done" not in read.features
    assert read.warnings == ("Column 'next.done' is only in some data files; it was left out.",)


def test_whole_numbers_beyond_float32_are_said(v2: Path):
    for path in sorted((v2 / "data").rglob("*.parquet")):
        edit_table(path, lambda table: table.append_column("observation.ticks", pa.array([2**40 + 1] * 20)))
    edit_info(
        v2, lambda info: info["features"].update({"observation.ticks": {"dtype": "int64", "shape": [1], "names": None}})
    )
    assert "too large for float32" in read_dataset(v2, name="set").warnings[0]


def test_more_frames_than_fit_into_memory_are_refused_before_they_are_read(
    message: Message, v3: Path, monkeypatch: pytest.MonkeyPatch
):
    import psutil

    few = psutil.virtual_memory()._replace(available=1000)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: few)
    assert "frames need" in message(v3)
    assert "Use a part of the data set" in message(v3)


def test_lists_that_would_fill_the_memory_are_refused_before_they_are_read(
    message: Message, v2: Path, monkeypatch: pytest.MonkeyPatch
):
    """A few kilobytes of repeated values in 20 rows can stand for gigabytes."""
    import psutil

    some = psutil.virtual_memory()._replace(available=10_000_000)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: some)
    assert read_dataset(v2, name="set").episodes == 4
    replace_column(v2 / V2_DATA, ACTION, pa.array([[0.0] * 100_000] * 20, pa.list_(pa.float32())))
    assert (v2 / V2_DATA).stat().st_size < 100_000
    assert "column 'action' has 100000 a frame; meta/info.json declares 2 numbers a frame" in message(v2)


def test_a_column_that_is_there_twice(message: Message, v2: Path):
    edit_table(v2 / V2_DATA, lambda table: table.append_column(ACTION, table[ACTION]))
    assert "has the column 'action' twice" in message(v2)

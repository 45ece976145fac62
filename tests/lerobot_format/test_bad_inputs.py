"""Everything that can be wrong with a folder: one message each, that says what, where and what to do."""

import json
import math
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import DatasetError, StoreError
from pipeline.lerobot_format.files import fill, inside
from pipeline.lerobot_format.read import (
    load_demonstrations,
    load_source,
    read_dataset,
    save_demonstrations,
    source_stamp,
)
from pipeline.types import ACTION, STATE
from tests.makers import edit_info, edit_table, tiny_demonstrations, tiny_recording, write_v2, write_v3

V3_DATA, V3_EPISODES = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"
V2_DATA = "data/chunk-000/episode_000002.parquet"


@pytest.fixture
def v3(tmp_path: Path) -> Path:
    return write_v3(tmp_path / "set", tiny_recording(4, 20))


@pytest.fixture
def v2(tmp_path: Path) -> Path:
    return write_v2(tmp_path / "set", tiny_recording(4, 20))


def message(folder: Path) -> str:
    """What reading says, on one line and with the place in it."""
    with pytest.raises(DatasetError) as caught:
        read_dataset(folder, name="set")
    text = str(caught.value)
    assert "\n" not in text
    assert str(folder) in text or "info.json" in text
    return text


# The folder


def test_no_such_folder(tmp_path: Path):
    assert "does not exist. Give a LeRobot folder" in message(tmp_path / "nowhere")
    (tmp_path / "file").write_text("")
    assert "is a file, not a folder" in message(tmp_path / "file")


def test_not_a_lerobot_data_set(tmp_path: Path, v3: Path):
    assert f"it has no meta/info.json. Did you mean {v3}?" in message(tmp_path)
    (tmp_path / "empty").mkdir()
    assert "it has no meta/info.json. Give the folder that holds meta/" in message(tmp_path / "empty")


@pytest.mark.parametrize("source", ["sets/nowhere", "nowhere", "/nowhere/at/all"])
def test_a_source_that_is_not_there(tmp_path: Path, source: str):
    with pytest.raises(DatasetError, match="does not exist") as caught:
        load_source(source, name="set", config_dir=tmp_path)
    assert ("write hub:sets/nowhere" in str(caught.value)) == (source == "sets/nowhere")
    with pytest.raises(DatasetError, match="does not exist"):
        source_stamp(source, tmp_path)


def test_a_source_that_is_a_url(tmp_path: Path):
    with pytest.raises(DatasetError, match=r"is a URL\. Give a folder, hub:owner/name"):
        load_source("https://huggingface.co/datasets/lerobot/pusht", name="set", config_dir=tmp_path)


# info.json


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "is not JSON"),
        ("", "is not JSON"),
        ("[1]", "holds a list"),
        ("[" * 100_000, "is not JSON"),
        ("\xff", "cannot be read"),
    ],
    ids=["cut off", "empty", "a list", "too deep", "not text"],
)
def test_info_that_is_not_json(v3: Path, text: str, words: str):
    (v3 / "meta/info.json").write_bytes(text.encode("latin-1"))
    assert words in message(v3)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda info: info.update(codebase_version="v1.6"), "codebase_version is 'v1.6'; v2.0, v2.1 and v3.0 are read"),
        (lambda info: info.pop("codebase_version"), "codebase_version is 'nothing'"),
        (lambda info: info.update(fps=0), "fps is 0; expected a number above 0"),
        (lambda info: info.update(fps=-10), "fps is -10"),
        (lambda info: info.update(fps="10"), "fps is '10'"),
        (lambda info: info.update(fps=True), "fps is True"),
        (lambda info: info.update(fps=float("nan")), "fps is nan"),
        (lambda info: info.pop("fps"), "fps is None"),
        (lambda info: info.pop("features"), "'features' is missing"),
        (
            lambda info: info["features"].update(action={"dtype": "float32", "shape": "2"}),
            "feature 'action' needs a dtype",
        ),
        (lambda info: info["features"].update(action={"dtype": "float32", "shape": [-2]}), "whole numbers above 0"),
        (lambda info: info["features"].update(action=None), "feature 'action' needs a dtype"),
        (lambda info: info["features"].pop("action"), "has no feature 'action'.*It has: observation.state, next.done"),
        (lambda info: info["features"].pop("observation.state"), "has no feature 'observation.state'"),
        (lambda info: info["features"][ACTION].update(dtype="string"), "'action' is string.*expected numbers"),
        (lambda info: info["features"][ACTION].update(shape=[10**6]), "expected numbers, at most 4096 a frame"),
        (lambda info: info.pop("data_path"), "data_path is None; expected a path"),
        (lambda info: info.update(data_path="data/{x}.parquet"), r"uses '\{x\}' in a way that is not known"),
        (lambda info: info.update(data_path="data/{chunk_index.__class__}"), "is not known"),
        (lambda info: info.update(data_path="data/{chunk_index:0999999999d}"), "is not known"),
        (lambda info: info.update(data_path="data/{chunk_index!r}"), "is not known"),
        (lambda info: info.update(data_path="data/{chunk_index"), "is not a template"),
    ],
)
def test_info_that_says_something_impossible(v3: Path, change: Callable, words: str):
    edit_info(v3, change)
    assert re.search(words, message(v3))


# Paths


@pytest.mark.parametrize(
    "path",
    [
        "../outside.parquet",
        "data/../../outside.parquet",
        "/etc/passwd",
        "data/chunk-{chunk_index:03d}/../../../outside",
    ],
)
@pytest.mark.parametrize("write", [write_v2, write_v3])
def test_a_path_that_leads_out_of_the_folder(tmp_path: Path, path: str, write: Callable):
    folder = write(tmp_path / "set", tiny_recording(4, 20))
    (tmp_path / "outside.parquet").write_bytes(next(folder.rglob("data/*/*.parquet")).read_bytes())
    edit_info(
        folder,
        lambda info: info.update(
            data_path=path.replace("chunk_index", "episode_chunk" if write is write_v2 else "chunk_index")
        ),
    )
    assert "leads out of the data set's folder" in message(folder)


def test_a_video_path_that_leads_out_of_the_folder(v3: Path):
    def change(info: dict) -> None:
        info["features"]["../../x"] = {"dtype": "video", "shape": [4, 4, 3]}
        info["video_path"] = "videos/{video_key}.mp4"

    edit_info(v3, change)
    edit_table(
        v3 / V3_EPISODES,
        lambda table: table.append_column("videos/../../x/chunk_index", pa.array([0] * 4)).append_column(
            "videos/../../x/file_index", pa.array([0] * 4)
        ),
    )
    assert "leads out of the data set's folder" in message(v3)


def test_a_link_that_leads_out_of_the_folder(tmp_path: Path, v3: Path):
    shutil.move(v3 / V3_DATA, tmp_path / "elsewhere.parquet")
    (v3 / V3_DATA).symlink_to(tmp_path / "elsewhere.parquet")
    assert "leads out of the data set's folder" in message(v3)


def test_a_link_inside_the_folder_and_a_folder_that_is_a_link_are_fine(tmp_path: Path, v3: Path):
    shutil.move(v3 / V3_DATA, v3 / "here.parquet")
    (v3 / V3_DATA).symlink_to(v3 / "here.parquet")
    (tmp_path / "link").symlink_to(v3)
    assert read_dataset(tmp_path / "link", name="set").episodes == 4


@given(st.text(max_size=30))
def test_whatever_a_path_is_the_file_lies_inside_or_it_is_refused(path: str):
    folder = Path("/tmp")
    try:
        found = inside(folder, fill(path, {"episode_index": 3}))
    except DatasetError:
        return
    assert found.resolve().is_relative_to(folder.resolve())


# Data files


@pytest.mark.parametrize("keep", [0, 3, 100, -1, -8])
@pytest.mark.parametrize("file", [V3_DATA, V3_EPISODES, "meta/tasks.parquet"])
def test_a_truncated_parquet_file(v3: Path, file: str, keep: int):
    content = (v3 / file).read_bytes()
    (v3 / file).write_bytes(content[:keep])
    assert f"{v3 / file} cannot be read as parquet: it is cut off or damaged. Copy the data set again" in message(v3)


def test_garbage_in_the_middle_of_a_parquet_file(v3: Path):
    content = bytearray((v3 / V3_DATA).read_bytes())
    content[4:200] = b"\xff" * 196
    (v3 / V3_DATA).write_bytes(content)
    assert "cut off or damaged" in message(v3)


def test_a_missing_data_file(v2: Path):
    (v2 / V2_DATA).unlink()
    assert f"{v2 / V2_DATA} is missing" in message(v2)


def test_a_missing_list_of_episodes_v2(v2: Path):
    (v2 / "meta/episodes.jsonl").unlink()
    assert "episodes.jsonl is missing" in message(v2)


def test_a_missing_list_of_episodes_v3(v3: Path):
    (v3 / V3_EPISODES).unlink()
    assert "the list of episodes is missing" in message(v3)


@pytest.mark.parametrize("line", ["nonsense", "[1]", '{"episode_index": 1', "3"])
def test_a_damaged_list_of_episodes(v2: Path, line: str):
    path = v2 / "meta/episodes.jsonl"
    path.write_text(path.read_text() + line + "\n")
    assert "episodes.jsonl, line 5: expected a JSON object" in message(v2)


@pytest.mark.parametrize(
    "row", [{"episode_index": "1"}, {"episode_index": -1}, {"length": 2.5}, {"length": None}, {"length": 2**60}]
)
def test_a_list_of_episodes_with_impossible_numbers(v2: Path, row: dict):
    path = v2 / "meta/episodes.jsonl"
    path.write_text(path.read_text() + json.dumps({"episode_index": 4, "tasks": [], "length": 3} | row) + "\n")
    assert "expected a whole number, 0 or more" in message(v2)


def test_an_episode_that_is_listed_twice(v2: Path):
    path = v2 / "meta/episodes.jsonl"
    path.write_text(path.read_text() * 2)
    assert "lists episode 0 twice" in message(v2)


def test_zero_episodes_v2(v2: Path):
    (v2 / "meta/episodes.jsonl").write_text("")
    assert "holds no episodes. Record at least one" in message(v2)


def test_zero_episodes_v3(v3: Path):
    edit_table(v3 / V3_EPISODES, lambda table: table.slice(0, 0))
    assert "holds no episodes" in message(v3)
    shutil.rmtree(v3 / "meta/episodes")
    edit_info(v3, lambda info: info.update(total_episodes=0))
    assert "holds no episodes" in message(v3)


@pytest.mark.parametrize("length", [19, 21, 1])
def test_lengths_that_contradict_the_data(v2: Path, length: int):
    path = v2 / "meta/episodes.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    rows[2]["length"] = length
    path.write_text("\n".join(map(json.dumps, rows)))
    assert f"{V2_DATA} has 20 frames; the episodes that meta/ lists in it have {length}" in message(v2)


def test_boundaries_that_contradict_the_data(v3: Path):
    """The total of the file is right, so only the frames' own episode numbers show it."""
    edit_table(
        v3 / V3_EPISODES,
        lambda table: table.set_column(table.column_names.index("length"), "length", pa.array([19, 21, 20, 20])),
    )
    assert (
        "frame 19 of the data set belongs to episode 0, but the lengths that meta/ lists put it in episode 1"
        in message(v3)
    )


def test_frames_out_of_order(v2: Path):
    edit_table(v2 / V2_DATA, lambda table: table.take([*range(10), 11, 10, *range(12, 20)]))
    assert "episode 2 has frame_index 11 where 10 was expected: frames are missing or out of order" in message(v2)


def test_files_in_another_order_than_their_episodes(tmp_path: Path):
    folder = write_v3(tmp_path / "set", tiny_recording(4, 20), episodes_per_file=2)
    edit_table(
        folder / V3_EPISODES,
        lambda table: table.set_column(
            table.column_names.index("data/file_index"), "data/file_index", pa.array([0, 1, 0, 1])
        ),
    )
    assert "out of order" in message(folder)


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
def test_wrong_shapes(v2: Path, key: str, values: pa.Array, got: str):
    replace_column(v2 / V2_DATA, key, values)
    assert f"{V2_DATA}: column '{key}' {got}" in message(v2)


def test_a_declared_shape_that_the_data_do_not_have(v3: Path):
    edit_info(v3, lambda info: info["features"][ACTION].update(shape=[3], names=["a", "b", "c"]))
    assert "column 'action' has 2 a frame; meta/info.json declares 3 numbers a frame" in message(v3)


@pytest.mark.parametrize(
    ("value", "shown"),
    [(math.nan, "nan"), (math.inf, "inf"), (-math.inf, "-inf"), (None, "nan"), (1e300, "inf")],
)
@pytest.mark.parametrize("key", [ACTION, STATE])
def test_numbers_that_are_none_name_their_place(v2: Path, key: str, value: float | None, shown: str):
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


def test_nan_in_the_clock(v2: Path):
    replace_column(v2 / V2_DATA, "timestamp", pa.array([0.1] * 19 + [float("nan")], pa.float32()))
    assert "the timestamp of frame 59 is nan" in message(v2)


@pytest.mark.parametrize("key", [ACTION, STATE])
def test_a_column_that_is_declared_and_absent(v2: Path, key: str):
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


def test_more_frames_than_fit_into_memory_are_refused_before_they_are_read(v3: Path, monkeypatch: pytest.MonkeyPatch):
    import psutil

    few = psutil.virtual_memory()._replace(available=1000)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: few)
    assert "frames need" in message(v3)
    assert "Use a part of the data set" in message(v3)


# What was kept


@pytest.mark.parametrize("damage", ["cut", "remove", "pickle", "words"])
def test_kept_demonstrations_that_are_damaged(tmp_path: Path, damage: str):
    save_demonstrations(tiny_demonstrations(), tmp_path / "kept")
    path = tmp_path / "kept/column-000.npy"
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:200])
    elif damage == "remove":
        path.unlink()
    elif damage == "pickle":
        np.save(path, np.array([{}], dtype=object))
    else:
        (tmp_path / "kept/meta.json").write_text("{}")
    with pytest.raises(StoreError, match="Remove the folder and run again"):
        load_demonstrations(tmp_path / "kept")

"""Folders, info.json and paths that are wrong: one message each, that says what, where and what to do."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import DatasetError
from pipeline.lerobot_format.files import fill, inside
from pipeline.lerobot_format.read import (
    load_source,
    read_dataset,
    source_stamp,
)
from pipeline.types import ACTION
from tests.makers import edit_info, edit_table, tiny_recording, write_v2, write_v3

V3_DATA, V3_EPISODES = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"
V2_DATA = "data/chunk-000/episode_000002.parquet"
Message = Callable[[Path], str]


# The folder


def test_no_such_folder(message: Message, tmp_path: Path):
    assert "does not exist. Give a LeRobot folder" in message(tmp_path / "nowhere")
    (tmp_path / "file").write_text("")
    assert "is a file, not a folder" in message(tmp_path / "file")


def test_not_a_lerobot_data_set(message: Message, tmp_path: Path, v3: Path):
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
        ("1" * 5000, "is not JSON"),
        ("", "is not JSON"),
        ("[1]", "holds a list"),
        ("[" * 100_000, "is not JSON"),
        ("\xff", "cannot be read"),
    ],
    ids=["cut off", "a long number", "empty", "a list", "too deep", "not text"],
)
def test_info_that_is_not_json(message: Message, v3: Path, text: str, words: str):
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
def test_info_that_says_something_impossible(message: Message, v3: Path, change: Callable, words: str):
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
def test_a_path_that_leads_out_of_the_folder(message: Message, tmp_path: Path, path: str, write: Callable):
    folder = write(tmp_path / "set", tiny_recording(4, 20))
    (tmp_path / "outside.parquet").write_bytes(next(folder.rglob("data/*/*.parquet")).read_bytes())
    edit_info(
        folder,
        lambda info: info.update(
            data_path=path.replace("chunk_index", "episode_chunk" if write is write_v2 else "chunk_index")
        ),
    )
    assert "leads out of the data set's folder" in message(folder)


def test_a_video_path_that_leads_out_of_the_folder(message: Message, v3: Path):
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


def test_a_link_that_leads_out_of_the_folder(message: Message, tmp_path: Path, v3: Path):
    shutil.move(v3 / V3_DATA, tmp_path / "elsewhere.parquet")
    (v3 / V3_DATA).symlink_to(tmp_path / "elsewhere.parquet")
    assert "leads out of the data set's folder" in message(v3)


def test_links_that_go_round_in_a_circle(message: Message, v3: Path):
    (v3 / V3_DATA).unlink()
    (v3 / V3_DATA).symlink_to(v3 / V3_DATA)
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

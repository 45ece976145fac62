"""What the script reads of a data set equals what was recorded, in every layout."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from pipeline.lerobot_bridge.read_folder import DataFolder, Refusal
from pipeline.types import STATE
from tests.makers import tiny_recording, write_v2, write_v3

RECORDING = tiny_recording(5, (7, 4, 9, 5, 6), joints=3)
WRITERS: dict[str, Callable[[Path], Path]] = {
    "v3.0 in one file": lambda folder: write_v3(folder, RECORDING),
    "v3.0 in three files": lambda folder: write_v3(folder, RECORDING, episodes_per_file=2),
    "v2.1": lambda folder: write_v2(folder, RECORDING),
    "v2.0 in two chunks": lambda folder: write_v2(folder, RECORDING, version="v2.0", chunks_size=3),
}


def change_table(folder: Path, change: Callable) -> None:
    for path in (folder / "data").rglob("*.parquet"):
        pq.write_table(change(pq.read_table(path)), path)


@pytest.mark.parametrize("layout", WRITERS)
def test_frames_of_some_episodes(layout: str, tmp_path: Path) -> None:
    data = DataFolder(WRITERS[layout](tmp_path / "set"))
    found = data.frames([1, 4], [STATE])
    assert sorted(found) == [1, 4]
    for episode, table in found.items():
        values = np.array(table[STATE].to_pylist(), np.float32)
        np.testing.assert_array_equal(values, RECORDING.features[STATE][1][RECORDING.slices()[episode]])
        words = {data.tasks()[index] for index in table["task_index"].to_pylist()}
        assert words == {RECORDING.tasks[episode]}


def test_frames_out_of_order(tmp_path: Path) -> None:
    folder = write_v3(tmp_path / "set", RECORDING)
    change_table(folder, lambda table: table.take(np.random.default_rng(0).permutation(table.num_rows)))
    found = DataFolder(folder).frames([2], [STATE])[2]
    assert found["frame_index"].to_pylist() == list(range(9))
    np.testing.assert_array_equal(found[STATE].to_pylist(), RECORDING.features[STATE][1][RECORDING.slices()[2]])


def test_v2_without_index_columns(tmp_path: Path) -> None:
    folder = write_v2(tmp_path / "set", RECORDING)
    change_table(folder, lambda table: table.drop_columns(["episode_index", "frame_index"]))
    found = DataFolder(folder).frames([3], [STATE])
    np.testing.assert_array_equal(found[3][STATE].to_pylist(), RECORDING.features[STATE][1][RECORDING.slices()[3]])


def test_a_missing_column(tmp_path: Path) -> None:
    folder = write_v3(tmp_path / "set", RECORDING)
    change_table(folder, lambda table: table.drop_columns([STATE]))
    with pytest.raises(Refusal, match="observation.state is missing, in some frames at least"):
        DataFolder(folder).frames([0], [STATE])


def test_a_damaged_file(tmp_path: Path) -> None:
    folder = write_v3(tmp_path / "set", RECORDING)
    (folder / "data/chunk-000/file-000.parquet").write_bytes(b"PAR1 and no more")
    with pytest.raises(Refusal, match=r"file-000.parquet cannot be read: ArrowInvalid"):
        DataFolder(folder).frames([0], [STATE])


@pytest.mark.parametrize("template", ["../../{video_key}.mp4", "/etc/{video_key}", "{nobody}", None])
def test_a_video_path_that_leaves_the_folder(tmp_path: Path, template: str | None) -> None:
    folder = write_v3(tmp_path / "set", RECORDING)
    info = json.loads((folder / "meta/info.json").read_text())
    camera = {"dtype": "video", "shape": [8, 8, 3]}
    info |= {"video_path": template, "features": info["features"] | {"observation.images.top": camera}}
    (folder / "meta/info.json").write_text(json.dumps(info))
    data = DataFolder(folder)
    assert data.shape("observation.images.top") == (3, 8, 8)
    with pytest.raises(Refusal, match="leaves the data set|does not say where|is not there"):
        data.pictures("observation.images.top", 0, [0], [0.0])

"""The v3.0 writer: what LeRobot's own loader looks for is there, in the types it expects."""

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from pipeline.errors import StoreError
from pipeline.lerobot_format.read import read_dataset
from pipeline.lerobot_format.stats import column_stats
from pipeline.lerobot_format.write import write_dataset
from pipeline.types import ACTION, STATE
from tests.makers import Recording, tiny_recording, write_v3

EPISODES = "meta/episodes/chunk-000/file-000.parquet"


@pytest.fixture
def recording() -> Recording:
    return tiny_recording(5, [30, 12, 25, 40, 18])


@pytest.fixture
def folder(tmp_path: Path, recording: Recording) -> Path:
    return write_v3(tmp_path / "set", recording, episodes_per_file=2, files_per_chunk=2)


def table(path: Path):
    return pq.ParquetFile(path).read(use_threads=False)


def test_files_and_chunks(folder: Path):
    files = [path.relative_to(folder).as_posix() for path in sorted(folder.rglob("*")) if path.is_file()]
    assert files == [
        "data/chunk-000/file-000.parquet",
        "data/chunk-000/file-001.parquet",
        "data/chunk-001/file-000.parquet",
        EPISODES,
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
    ]


def test_info(folder: Path):
    info = json.loads((folder / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"], info["fps"]) == (5, 125, 2, 10)
    assert isinstance(info["fps"], int)
    assert info["splits"] == {"train": "0:5"}
    assert info["features"][ACTION] == {"dtype": "float32", "shape": [2], "names": ["joint_0", "joint_1"]}
    assert info["features"]["next.done"] == {"dtype": "bool", "shape": [1], "names": None}
    assert list(info["features"])[-5:] == ["timestamp", "frame_index", "episode_index", "index", "task_index"]


def test_data_columns_have_the_types_that_info_declares(folder: Path):
    """LeRobot casts to fixed-size lists, and to plain values where the shape is [1]; it refuses other columns."""
    schema = pq.ParquetFile(folder / "data/chunk-000/file-001.parquet").schema_arrow
    types = {field.name: str(field.type) for field in schema}
    assert types == {
        "action": "fixed_size_list<element: float>[2]",
        "observation.state": "fixed_size_list<element: float>[2]",
        "next.done": "bool",
        "timestamp": "float",
        "frame_index": "int64",
        "episode_index": "int64",
        "index": "int64",
        "task_index": "int64",
    }


def test_the_index_columns(folder: Path):
    data = table(folder / "data/chunk-000/file-001.parquet")
    assert data["episode_index"].to_pylist() == [2] * 25 + [3] * 40
    assert data["index"].to_pylist() == list(range(42, 107))
    assert data["frame_index"].to_pylist() == [*range(25), *range(40)]
    assert data["task_index"].to_pylist() == [0] * 25 + [1] * 40
    np.testing.assert_allclose(data["timestamp"].to_numpy()[:25], np.arange(25) / 10, rtol=1e-6)


def test_the_list_of_episodes(folder: Path, recording: Recording):
    episodes = table(folder / EPISODES).to_pydict()
    assert episodes["episode_index"] == [0, 1, 2, 3, 4]
    assert episodes["length"] == [30, 12, 25, 40, 18]
    assert episodes["tasks"] == [["push"], ["pull"], ["push"], ["pull"], ["push"]]
    assert episodes["dataset_from_index"] == [0, 30, 42, 67, 107]
    assert episodes["dataset_to_index"] == [30, 42, 67, 107, 125]
    assert episodes["data/chunk_index"] == [0, 0, 0, 0, 1]
    assert episodes["data/file_index"] == [0, 0, 1, 1, 0]
    assert episodes["meta/episodes/chunk_index"] == episodes["meta/episodes/file_index"] == [0] * 5
    actions = recording.features[ACTION][1][67:107].astype(float)
    np.testing.assert_allclose(episodes["stats/action/mean"][3], actions.mean(0))
    np.testing.assert_allclose(episodes["stats/action/q90"][3], np.quantile(actions, 0.9, axis=0))
    assert episodes["stats/action/count"][3] == [40]


def test_the_statistics_of_the_whole(folder: Path, recording: Recording):
    stats = json.loads((folder / "meta/stats.json").read_text())
    assert set(stats) == {*recording.features, "timestamp", "frame_index", "episode_index", "index", "task_index"}
    states = recording.features[STATE][1].astype(float)
    assert list(stats[STATE]) == ["min", "max", "mean", "std", "count", "q01", "q10", "q50", "q90", "q99"]
    np.testing.assert_allclose(stats[STATE]["std"], states.std(0))
    np.testing.assert_allclose(stats[STATE]["q50"], np.median(states, axis=0))
    assert stats[STATE]["count"] == [125]


def test_tasks_are_a_pandas_frame_indexed_by_their_words(folder: Path):
    frame = table(folder / "meta/tasks.parquet").to_pandas(use_threads=False)
    assert frame.index.name == "task"
    assert frame.iloc[1].name == "pull"
    assert frame["task_index"].to_dict() == {"push": 0, "pull": 1}


def test_data_is_compressed_with_zstd(folder: Path):
    metadata = pq.ParquetFile(folder / "data/chunk-000/file-000.parquet").metadata
    assert {metadata.row_group(0).column(i).compression for i in range(metadata.num_columns)} == {"ZSTD"}


def test_the_same_arguments_give_the_same_bytes(tmp_path: Path, recording: Recording):
    one, other = write_v3(tmp_path / "one", recording), write_v3(tmp_path / "other", recording)
    for path in sorted(one.rglob("*")):
        if path.is_file():
            assert path.read_bytes() == (other / path.relative_to(one)).read_bytes()


def test_statistics_of_a_few_numbers():
    stats = column_stats(np.array([[0.0, 1.0], [2.0, 1.0]], np.float32))
    assert {
        name: values.tolist() for name, values in stats.items() if name in ("min", "max", "mean", "std", "count")
    } == {
        "min": [0.0, 1.0],
        "max": [2.0, 1.0],
        "mean": [1.0, 1.0],
        "std": [1.0, 0.0],
        "count": [2],
    }


def test_nothing_is_overwritten(folder: Path, recording: Recording):
    before = (folder / "meta/info.json").read_bytes()
    with pytest.raises(StoreError, match="exists already and is not empty"):
        write_v3(folder, recording)
    assert (folder / "meta/info.json").read_bytes() == before


def test_an_empty_folder_may_be_filled(tmp_path: Path, recording: Recording):
    (tmp_path / "set").mkdir()
    assert read_dataset(write_v3(tmp_path / "set", recording), name="set").episodes == 5


def test_a_failure_leaves_nothing_behind(tmp_path: Path, recording: Recording):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StoreError, match="cannot be written"):
        write_v3(tmp_path / "file" / "set", recording)
    with pytest.raises(TypeError):
        write_v3(tmp_path / "set", recording, extra_info={"not json": object()})
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(
    "change",
    [{"episode_lengths": [10, 10]}, {"episode_lengths": []}, {"tasks": ["one"]}, {"episode_lengths": [20, 0]}],
)
def test_arrays_that_do_not_fit_each_other(tmp_path: Path, change: dict):
    features = {ACTION: (["a"], np.zeros((21, 1)), "float32"), STATE: (["a"], np.zeros((21, 1)), "float32")}
    arguments = {"fps": 10, "features": features, "episode_lengths": [10, 11], "tasks": ["", ""]}
    with pytest.raises(ValueError, match=r"tasks|frames"):
        write_dataset(tmp_path / "set", **arguments | change)
    assert not (tmp_path / "set").exists()

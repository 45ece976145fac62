"""Data sets of every version, read: known answers on the real ones and on small ones written here."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.lerobot_format.read import (
    read_dataset,
)
from pipeline.types import ACTION, STATE, Camera
from tests.makers import Recording, demonstrations_of, edit_info, edit_table, tiny_recording, write_v2, write_v3

ENVIRONMENT = "observation.environment_state"


@pytest.fixture
def recording() -> Recording:
    return tiny_recording(5, [30, 12, 25, 40, 18], names=("shoulder_rad", "elbow_rad"))


# What is written is what is read, whatever the layout


@pytest.mark.parametrize(
    "write",
    [
        lambda folder, made: write_v2(folder, made, version="v2.0"),
        lambda folder, made: write_v2(folder, made, version="v2.1"),
        lambda folder, made: write_v2(folder, made, chunks_size=2),
        write_v3,
        lambda folder, made: write_v3(folder, made, episodes_per_file=1),
        lambda folder, made: write_v3(folder, made, episodes_per_file=2, files_per_chunk=2),
    ],
    ids=["v2.0", "v2.1", "v2.1 in chunks", "v3.0", "v3.0 a file an episode", "v3.0 files and chunks"],
)
def test_every_layout_gives_the_recording_and_one_hash(tmp_path: Path, recording: Recording, write):
    read = read_dataset(write(tmp_path / "set", recording), name="set")
    expected = demonstrations_of(recording, timestamps=read.timestamps)
    assert read.features == expected.features
    assert read.fps == 10
    assert read.robot_type == "made"
    assert read.tasks == recording.tasks
    assert read.warnings == ()
    assert read.cameras == ()
    np.testing.assert_array_equal(read.episode_starts, [0, 30, 42, 67, 107, 125])
    np.testing.assert_array_equal(read.episode_ids, range(5))
    np.testing.assert_allclose(read.timestamps, read.frame_in_episode / 10, atol=1e-6)
    for key, values in expected.columns.items():
        assert read.columns[key].dtype == np.float32
        np.testing.assert_array_equal(read.columns[key], values)
    assert read.content_hash == read_dataset(write_v3(tmp_path / "other", recording), name="o").content_hash


def test_names_and_units(tmp_path: Path, recording: Recording):
    feature = read_dataset(write_v3(tmp_path / "set", recording), name="set").features[ACTION]
    assert feature.names == ("shoulder_rad", "elbow_rad")
    assert feature.units == ("rad", "rad")


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["a", "b"], ("a", "b")),
        ({"motors": ["a", "b"]}, ("a", "b")),
        ({"left": ["a"], "right": ["b"]}, ("a", "b")),
        ({"b": 1, "a": 0}, ("a", "b")),
        (None, ("0", "1")),
        ([], ("0", "1")),
        (["a", "b", "c"], ("0", "1")),
        (["a", "a"], ("0", "1")),
    ],
)
def test_feature_names_flat_nested_or_absent(tmp_path: Path, recording: Recording, names, expected: tuple[str, ...]):
    folder = write_v3(tmp_path / "set", recording)
    edit_info(folder, lambda info: info["features"][ACTION].update(names=names))
    read = read_dataset(folder, name="set")
    assert read.features[ACTION].names == expected
    assert len(read.warnings) == (1 if names and len(set(names)) != 2 and isinstance(names, list) else 0)


def test_scalars_booleans_and_lists_of_any_type(tmp_path: Path):
    made = tiny_recording(2, 20, joints=1)
    folder = write_v2(tmp_path / "set", made)

    def lists(table: pa.Table) -> pa.Table:
        values = table["action"].to_pylist()
        return table.set_column(
            table.column_names.index("action"),
            "action",
            pa.array([[value] for value in values], pa.large_list(pa.float64())),
        )

    edit_table(folder / "data/chunk-000/episode_000000.parquet", lists)
    edit_info(folder, lambda info: info["features"]["action"].update(shape=[1]))
    read = read_dataset(folder, name="set")
    np.testing.assert_array_equal(read.columns[ACTION], made.features[ACTION][1])
    assert read.columns["next.done"].dtype == np.float32
    assert read.columns["next.done"].sum() == 2
    assert read.features["next.done"].names == ("done",)


def test_a_feature_of_several_dimensions_is_laid_out_row_by_row(tmp_path: Path):
    made = tiny_recording(2, 20)
    grid = np.arange(2 * 20 * 6, dtype=np.float32).reshape(40, 6)
    folder = write_v3(
        tmp_path / "set", replace(made, features=made.features | {"observation.grid": (None, grid, "float32")})
    )
    edit_info(folder, lambda info: info["features"]["observation.grid"].update(shape=[2, 3]))
    edit_table(
        folder / "data/chunk-000/file-000.parquet",
        lambda table: table.set_column(
            table.column_names.index("observation.grid"), "observation.grid", pa.array(grid.reshape(40, 2, 3).tolist())
        ),
    )
    np.testing.assert_array_equal(read_dataset(folder, name="set").columns["observation.grid"], grid)


def test_words_and_pictures_are_not_columns(tmp_path: Path, recording: Recording):
    folder = write_v3(tmp_path / "set", recording)

    def add(info: dict) -> None:
        info["features"]["language"] = {"dtype": "string", "shape": [1], "names": None}
        info["features"]["observation.depth"] = {"dtype": "float32", "shape": [480, 640], "names": None}
        info["features"]["observation.image"] = {
            "dtype": "image",
            "shape": [3, 48, 64],
            "names": ["channels", "height", "width"],
        }

    edit_info(folder, add)
    read = read_dataset(folder, name="set")
    assert set(read.columns) == {ACTION, STATE, "next.done"}
    assert read.cameras == (Camera("observation.image", 48, 64, None, True),)
    assert [warning.split("'")[1] for warning in read.warnings] == ["language", "observation.depth"]


def test_only_the_columns_that_are_used_are_decoded(tmp_path: Path, recording: Recording):
    """A picture column whose pages are garbage does no harm."""
    folder = write_v3(tmp_path / "set", recording)
    path = folder / "data/chunk-000/file-000.parquet"
    picture = np.random.default_rng(0).bytes(4000)
    edit_table(path, lambda table: table.add_column(0, "observation.image", pa.array([picture] * len(table))))
    content = bytearray(path.read_bytes())
    content[4:4000] = b"\xff" * 3996  # the header of its first page, and its bytes
    path.write_bytes(content)
    with pytest.raises((OSError, pa.ArrowException)):
        pq.ParquetFile(path).read(use_threads=False)
    assert read_dataset(folder, name="set").frames == sum(recording.lengths)


def test_index_columns_are_derived_where_they_are_absent(tmp_path: Path, recording: Recording):
    folder = write_v3(tmp_path / "set", recording, episodes_per_file=2)
    whole = read_dataset(folder, name="set")
    absent = ["timestamp", "frame_index", "episode_index", "index", "task_index"]
    for path in sorted((folder / "data").rglob("*.parquet")):
        edit_table(path, lambda table: table.drop_columns(absent))
    read = read_dataset(folder, name="set")
    np.testing.assert_array_equal(read.episode_starts, whole.episode_starts)
    np.testing.assert_array_equal(read.columns[ACTION], whole.columns[ACTION])
    np.testing.assert_allclose(read.timestamps, whole.timestamps, atol=1e-6)
    assert read.tasks == whole.tasks
    assert len(read.warnings) == 4
    assert all("derived" in warning for warning in read.warnings)


def test_tasks_by_their_index_where_the_list_of_episodes_has_none(tmp_path: Path, recording: Recording):
    folder = write_v2(tmp_path / "set", recording)
    path = folder / "meta/episodes.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    path.write_text("\n".join(json.dumps({key: row[key] for key in ("episode_index", "length")}) for row in rows))
    assert read_dataset(folder, name="set").tasks == recording.tasks


def test_the_recorded_clock_is_kept_as_it_is(tmp_path: Path):
    random = np.random.default_rng(0)
    made = tiny_recording(2, 20)
    clock = np.concatenate([np.cumsum(random.uniform(0.05, 0.3, 20)) for _ in range(2)]).astype(np.float32)
    read = read_dataset(write_v3(tmp_path / "set", made, timestamps=clock), name="set")
    np.testing.assert_array_equal(read.timestamps, clock.astype(np.float64))
    assert read.warnings == ()


def test_a_clock_that_counts_from_elsewhere_is_shifted_and_one_that_stops_is_reported(tmp_path: Path):
    made = tiny_recording(2, 20)
    clock = np.tile(np.arange(20) / 10, 2) + 5000
    clock[3] = clock[2]
    read = read_dataset(write_v3(tmp_path / "set", made, timestamps=clock), name="set")
    assert read.timestamps[0] == read.timestamps[20] == 0
    assert "shifted" in read.warnings[0]
    assert "stands still or runs backwards at 1 frames" in read.warnings[1]


def test_gaps_in_the_episode_numbers_stay(tmp_path: Path, recording: Recording):
    folder = write_v2(tmp_path / "set", recording)
    (folder / "data/chunk-000/episode_000001.parquet").unlink()
    lines = (folder / "meta/episodes.jsonl").read_text().splitlines()
    (folder / "meta/episodes.jsonl").write_text("\n".join(lines[:1] + lines[2:]))
    read = read_dataset(folder, name="set")
    np.testing.assert_array_equal(read.episode_ids, [0, 2, 3, 4])
    assert read.episodes == 4
    assert len(read.warnings) == 2  # total_episodes and total_frames are wrong now
    assert all("the list was believed" in warning for warning in read.warnings)


def test_an_episode_without_frames_is_left_out(tmp_path: Path, recording: Recording):
    folder = write_v2(tmp_path / "set", recording)
    with (folder / "meta/episodes.jsonl").open("a") as file:
        file.write('{"episode_index": 5, "tasks": ["push"], "length": 0}\n')
    edit_info(folder, lambda info: info.update(total_episodes=6))
    read = read_dataset(folder, name="set")
    assert read.episodes == 5
    assert read.warnings == ("Episodes without frames were left out: 5.",)


def test_cameras_present_and_absent(tmp_path: Path, recording: Recording):
    folder = write_v2(tmp_path / "set", recording)
    video = {
        "dtype": "video",
        "shape": [480, 640, 3],
        "names": ["height", "width", "channel"],
        "info": {"video.codec": "av1"},
    }
    template = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
    edit_info(
        folder,
        lambda info: (info["features"].update({"observation.images.top": video}), info.update(video_path=template)),
    )
    read = read_dataset(folder, name="set")
    assert read.cameras == (Camera("observation.images.top", 480, 640, "av1", False),)
    assert "observation.images.top" in read.warnings[0]
    assert read_dataset(folder, name="set", videos_expected=False).warnings == ()
    for episode in range(5):
        path = folder / f"videos/chunk-000/observation.images.top/episode_{episode:06d}.mp4"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"")
    read = read_dataset(folder, name="set")
    assert read.cameras[0].present
    assert read.warnings == ()


def test_a_newer_version_3_is_read_with_a_warning(tmp_path: Path, recording: Recording):
    folder = write_v3(tmp_path / "set", recording)
    edit_info(folder, lambda info: info.update(codebase_version="v3.2"))
    assert "v3.2" in read_dataset(folder, name="set").warnings[0]


# The real ones


@pytest.mark.parametrize(
    ("name", "episodes", "frames", "fps", "action", "state"),
    [
        ("pusht", 206, 25_650, 10, 2, 2),
        ("pusht_image", 206, 25_650, 10, 2, 2),
        ("so101_pick_place_tape", 50, 14_954, 30, 6, 6),
        ("cr5_banana", 12, 2_733, 10, 7, 6),
    ],
)
def test_real_data_sets(shared_data: Path, name: str, episodes: int, frames: int, fps: int, action: int, state: int):
    read = read_dataset(shared_data / name, name=name)
    assert (read.episodes, read.frames, read.fps) == (episodes, frames, fps)
    assert read.columns[ACTION].shape == (frames, action)
    assert read.columns[STATE].shape == (frames, state)
    assert all(read.tasks)
    assert bool(read.warnings) == (name == "pusht")


def test_the_real_details(shared_data: Path):
    pusht = read_dataset(shared_data / "pusht", name="pusht")
    assert pusht.features[ACTION].names == ("motor_0", "motor_1")
    assert pusht.cameras == (Camera("observation.image", 96, 96, "av1", False),)
    assert "observation.image" in pusht.warnings[0]
    image = read_dataset(shared_data / "pusht_image", name="pusht_image")
    np.testing.assert_array_equal(image.columns[ACTION], pusht.columns[ACTION])
    assert image.features[ENVIRONMENT].units == ("px", "px", "rad")
    assert image.cameras[0].present
    turns = np.abs(np.diff(image.columns[ENVIRONMENT][:, 2])) > math.pi
    turns[image.episode_starts[1:-1] - 1] = False
    assert len(set(image.episode_of_frame[:-1][turns])) == 91
    cr5 = read_dataset(shared_data / "cr5_banana", name="cr5")
    assert cr5.cameras == (Camera("observation.images.top", 480, 640, "av1", True),)
    assert set(cr5.tasks) == {"put the banana on the plate"}


@settings(max_examples=20, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 9), min_size=1, max_size=8),
    episodes_per_file=st.integers(1, 4),
    files_per_chunk=st.integers(1, 3),
    joints=st.integers(1, 3),
    seed=st.integers(0, 99),
)
def test_any_recording_survives_the_round_trip(
    tmp_path_factory, lengths: list[int], episodes_per_file: int, files_per_chunk: int, joints: int, seed: int
):
    made = tiny_recording(len(lengths), lengths, joints=joints, seed=seed)
    base = tmp_path_factory.mktemp("any")
    new = read_dataset(
        write_v3(base / "3", made, episodes_per_file=episodes_per_file, files_per_chunk=files_per_chunk), name="n"
    )
    old = read_dataset(write_v2(base / "2", made, chunks_size=files_per_chunk), name="o")
    assert new.content_hash == old.content_hash
    np.testing.assert_array_equal(new.lengths, lengths)
    np.testing.assert_array_equal(new.columns[ACTION], made.features[ACTION][1])


def test_episode_numbers_beyond_32_bits(tmp_path: Path):
    """Numbers are held in 32 bits until one does not fit."""
    recording = tiny_recording(3, 10)
    folder = write_v3(tmp_path / "set", recording)

    def renumbered(table: pa.Table) -> pa.Table:
        numbers = table["episode_index"].to_numpy().astype(np.int64)
        numbers = np.where(numbers == 2, 2**33, numbers)
        return table.set_column(table.schema.get_field_index("episode_index"), "episode_index", pa.array(numbers))

    for path in (*folder.glob("data/*/*.parquet"), *folder.glob("meta/episodes/*/*.parquet")):
        edit_table(path, renumbered)
    read = read_dataset(folder, name="set")
    assert read.episode_ids.tolist() == [0, 1, 2**33]
    np.testing.assert_array_equal(read.columns[ACTION], recording.features[ACTION][1])
    assert read.warnings == read_dataset(write_v3(tmp_path / "plain", recording), name="plain").warnings

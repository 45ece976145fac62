"""Features joined by episode and frame: the right value at each frame whatever the order of the rows, and a clear refusal of a
file that does not fit.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import ConfigError, DatasetError
from pipeline.lerobot_format import arrays
from pipeline.lerobot_format.joined import join_feature
from pipeline.lerobot_format.read import read_dataset
from pipeline.types import ColumnChoice, Feature
from tests.makers import edit_info, tiny_recording, write_v3

IDS, STARTS = np.array([0, 2, 5]), np.array([0, 3, 7, 9])
"""Three episodes of 3, 4 and 2 frames, numbered with gaps."""
EPISODE, FRAME = np.repeat(IDS, [3, 4, 2]), np.array([0, 1, 2, 0, 1, 2, 3, 0, 1])
Table = dict[str, Any]


def rows(**changes: Any) -> Table:
    return {"episode_index": EPISODE, "frame_index": FRAME, "value": np.arange(9) * 1.5} | changes


def write(path: Path, table: Table | pa.Table, **options: Any) -> Path:
    pq.write_table(table if isinstance(table, pa.Table) else pa.table(table), path, **options)
    return path


def joined(path: Path, excluded: tuple[int, ...] = ()) -> tuple[Feature, np.ndarray]:
    return join_feature("score", path, ids=IDS, starts=STARTS, excluded=excluded)


@pytest.fixture
def refusal(tmp_path: Path) -> Callable[[Table], str]:
    """What joining a file says: on one line, with its path."""

    def refuse(table: Table, excluded: tuple[int, ...] = ()) -> str:
        path = write(tmp_path / "score.parquet", table)
        with pytest.raises(DatasetError) as caught:
            joined(path, excluded)
        assert str(caught.value).startswith(str(path))
        assert "\n" not in str(caught.value)
        return str(caught.value)

    return refuse


# Right values


@settings(max_examples=60, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 6), min_size=1, max_size=5),
    width=st.integers(0, 3),
    groups=st.integers(1, 7),
    random=st.randoms(use_true_random=False),
)
def test_every_frame_has_its_own_value_whatever_the_order(tmp_path_factory, lengths, width, groups, random):
    """`width` 0 is a column of numbers; the truth is looked up row by row."""
    ids = np.cumsum([1 + random.randrange(3) for _ in lengths])
    keys = [(int(number), frame) for number, length in zip(ids, lengths, strict=True) for frame in range(length)]
    values = {key: [random.random() for _ in range(width or 1)] for key in keys}
    shuffled = list(keys)
    random.shuffle(shuffled)
    said = [values[key] if width else values[key][0] for key in shuffled]
    table = {"frame_index": [f for _, f in shuffled], "value": said, "episode_index": [e for e, _ in shuffled]}
    path = write(tmp_path_factory.mktemp("join") / "x.parquet", table, row_group_size=groups)
    starts = np.concatenate([[0], np.cumsum(lengths)])
    feature, found = join_feature("score", path, ids=ids, starts=starts, excluded=())
    np.testing.assert_array_equal(found, np.array([values[key] for key in keys], np.float32))
    assert found.dtype == np.float32
    assert feature.names == (("score",) if (width or 1) == 1 else tuple(map(str, range(width))))


def test_many_small_batches_give_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = write(tmp_path / "x.parquet", {key: values[::-1] for key, values in rows().items()})
    whole = joined(path)[1]
    monkeypatch.setattr(arrays, "VALUES_AT_A_TIME", 4)
    np.testing.assert_array_equal(joined(path)[1], whole)


@pytest.mark.parametrize(
    "column",
    [
        pa.array(range(9), pa.int16()),
        pa.array([float(i) for i in range(9)], pa.float64()),
        pa.array([[float(i)] for i in range(9)], pa.large_list(pa.float64())),
        pa.array([[float(i)] for i in range(9)], pa.list_(pa.float32(), 1)),
        pa.array(range(9)).dictionary_encode(),
    ],
    ids=["int16", "double", "large list", "fixed list", "dictionary"],
)
def test_numbers_of_any_type(tmp_path: Path, column: pa.Array):
    found = joined(write(tmp_path / "x.parquet", rows(value=column)))[1]
    np.testing.assert_array_equal(found, np.arange(9, dtype=np.float32)[:, None])


def test_the_index_that_pandas_leaves_is_no_column(tmp_path: Path):
    table = rows() | {"__index_level_0__": np.arange(9)}
    assert joined(write(tmp_path / "x.parquet", table))[1].shape == (9, 1)


def test_rows_of_excluded_episodes_are_passed_over_whatever_they_hold(tmp_path: Path):
    table = rows(
        episode_index=np.concatenate([EPISODE, [9, 9, 9]]),
        frame_index=np.concatenate([FRAME, [0, 0, 77]]),
        value=np.concatenate([np.arange(9), [np.nan] * 3]),
    )
    found = joined(write(tmp_path / "x.parquet", table), excluded=(9,))[1]
    np.testing.assert_array_equal(found[:, 0], np.arange(9))


# Files that do not fit


def test_frames_that_are_missing(refusal):
    text = refusal({key: np.delete(values, [4, 5]) for key, values in rows().items()})
    assert "has no value for 2 of 9 frames, the first is episode 2, frame 1. Write one row for each frame." in text


def test_no_rows_at_all(refusal):
    assert "has no value for 9 of 9 frames, the first is episode 0, frame 0" in refusal(
        {key: values[:0] for key, values in rows().items()}
    )


def test_only_rows_of_excluded_episodes(refusal):
    text = refusal(rows(episode_index=np.full(9, 7), frame_index=np.arange(9)), excluded=(7,))
    assert "has no value for 9 of 9 frames" in text


def test_frames_that_are_there_twice(refusal):
    text = refusal({key: np.append(values, values[8]) for key, values in rows().items()})
    assert "has several values for 1 of 9 frames, the first is episode 5, frame 1" in text


def test_frames_missing_and_twice(refusal):
    text = refusal(rows(frame_index=np.where(FRAME == 2, 1, FRAME)))
    assert "has no value for 2 of 9 frames" in text
    assert "; it has several values for 2 of 9 frames" in text


def test_an_episode_that_is_not_there(refusal):
    text = refusal(rows(episode_index=np.where(EPISODE == 5, 6, EPISODE)))
    assert "has values for episode 6, which the data set does not have. Was it written for another one?" in text


@pytest.mark.parametrize("frame", [2, -1, 2**40])
def test_a_frame_that_is_not_there(refusal, frame: int):
    text = refusal(rows(frame_index=np.append(FRAME[:-1], frame)))
    assert f"has values for episode 5, frame {frame}; the episode has frames 0 to 1" in text


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300, None])
def test_a_value_that_is_no_finite_number(refusal, value: float | None):
    text = refusal(rows(value=pa.array([0.0] * 6 + [value] + [0.0] * 2, pa.float64())))
    assert "'value' is not finite in episode 2, frame 3" in text


@pytest.mark.parametrize(
    ("column", "got"),
    [
        (pa.array([[1.0, 2.0]] * 8 + [[1.0]]), "'value' has lists of 1 to 2"),
        (pa.array([[1.0]] * 8 + [None]), "'value' has a frame without a value"),
        (pa.array([[]] * 9, pa.list_(pa.float32())), "'value' has empty lists"),
        (pa.array(["a"] * 9), "'value' has values of type string"),
        (pa.array([{"x": 1.0}] * 9), "'value' has values of type struct"),
        (pa.array([[0.0] * 5000] * 9), "'value' has 5,000 numbers a frame"),
    ],
)
def test_a_column_that_holds_no_table_of_numbers(refusal, column: pa.Array, got: str):
    text = refusal(rows(value=column))
    assert got in text
    assert "expected episode_index, frame_index and one column of finite numbers, or of lists of one length" in text


def test_words_are_refused_before_they_are_decoded(tmp_path: Path):
    """One long word, repeated, is a few bytes in a file and gigabytes in memory; here its pages are garbage."""
    path = write(tmp_path / "score.parquet", rows(value=["word" * 1000] * 9))
    content = bytearray(path.read_bytes())
    content[4:600] = b"\xff" * 596
    path.write_bytes(content)
    with pytest.raises(DatasetError, match="'value' has values of type string"):
        joined(path)


def test_lists_of_other_lengths_in_another_batch(refusal, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(arrays, "VALUES_AT_A_TIME", 1)
    assert "'value' has 1 and 2 numbers a frame" in refusal(rows(value=pa.array([[1.0]] * 8 + [[1.0, 2.0]])))


@pytest.mark.parametrize(
    ("table", "columns"),
    [
        ({"episode_index": EPISODE, "value": FRAME}, "episode_index, value"),
        ({"episode_index": EPISODE, "frame_index": FRAME}, "episode_index, frame_index"),
        (rows(more=FRAME), "episode_index, frame_index, value, more"),
        ({"episode": EPISODE, "frame_index": FRAME, "value": FRAME}, "episode, frame_index, value"),
    ],
)
def test_other_columns(refusal, table: Table, columns: str):
    assert f"it has the columns {columns}; expected" in refusal(table)


@pytest.mark.parametrize("key", ["episode_index", "frame_index"])
@pytest.mark.parametrize("values", [np.arange(9) + 0.5, [str(i) for i in range(9)], [[i] * 2 for i in range(9)]])
def test_keys_that_are_no_whole_numbers(refusal, key: str, values: Any):
    assert f"'{key}' " in refusal(rows(**{key: values}))


def test_a_file_that_is_no_parquet(tmp_path: Path):
    path = tmp_path / "score.parquet"
    path.write_text("episode_index,frame_index,value\n0,0,1\n")
    with pytest.raises(DatasetError, match=r"score\.parquet cannot be read as parquet"):
        joined(path)


def test_more_numbers_than_fit_into_memory(refusal, monkeypatch: pytest.MonkeyPatch):
    import psutil

    few = psutil.virtual_memory()._replace(available=30)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: few)
    assert "9 frames of 1 numbers need" in refusal(rows())


# With the data set


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_v3(tmp_path / "set", tiny_recording(2, 10))


def with_feature(folder: Path, name: str) -> ColumnChoice:
    table = {"episode_index": np.repeat([0, 1], 10), "frame_index": np.tile(np.arange(10), 2), "value": np.arange(20)}
    return ColumnChoice(features={name: write(folder.parent / "score.parquet", table)})


def test_it_is_a_feature_like_any_other(folder: Path):
    plain, more = (
        read_dataset(folder, name="set", choice=choice) for choice in (ColumnChoice(), with_feature(folder, "score"))
    )
    np.testing.assert_array_equal(more.columns["score"][:, 0], np.arange(20))
    assert more.features["score"] == Feature("score", ("score",), (None,))
    assert more.content_hash != plain.content_hash


@pytest.mark.parametrize("name", ["action", "observation.state", "next.done", "frame_index", "observation.image"])
def test_a_name_that_is_taken(folder: Path, name: str):
    edit_info(
        folder, lambda info: info["features"].update({"observation.image": {"dtype": "image", "shape": [3, 8, 8]}})
    )
    with pytest.raises(ConfigError, match=rf"features\] {name}: the data set has a feature of that name already"):
        read_dataset(folder, name="set", choice=with_feature(folder, name))


def test_frames_that_were_sorted_have_the_values_of_their_numbers(folder: Path):
    """The file's order is not the frames': what counts is `frame_index`."""
    path = folder / "data/chunk-000/file-000.parquet"
    table = pq.read_table(path, use_threads=False)
    pq.write_table(table.take([*range(10, 20), 1, 0, *range(2, 10)]), path)
    found = read_dataset(folder, name="set", choice=with_feature(folder, "score"))
    np.testing.assert_array_equal(found.columns["score"][:, 0], np.arange(20))
    assert len(found.warnings) == 2

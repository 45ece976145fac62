"""Predictions that anybody may have written: read as they are, or refused with what, where and what to do."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import DatasetError
from pipeline.external import reading
from pipeline.external.anchors import anchors_of
from pipeline.external.reading import hash_file, read_answers
from tests.external.conftest import HISTORY


def test_rows_come_back_by_seed_and_anchor(place, tmp_path):
    rows = place.rows(steps=2, seeds=2)
    answers = read_answers(rows.write(tmp_path / "p.parquet"), place.demos, HISTORY)
    anchors = anchors_of(place.demos, HISTORY)
    np.testing.assert_array_equal(answers.anchors, anchors)
    assert answers.covered.tolist() == list(range(6))
    assert answers.seeds == (0, 1)
    assert answers.actions.shape == (2, 1, len(anchors), 2, 3)
    expected = np.array(rows.columns["action"], np.float32).reshape(2, 1, len(anchors), 2, 3)
    np.testing.assert_array_equal(answers.actions, expected)
    held = [next(k for k, fold in enumerate(place.split.folds) if e in fold.test) for e in range(6)]
    assert answers.fold.tolist() == held


@settings(max_examples=15, deadline=None)
@given(st.randoms(use_true_random=False))
def test_the_order_of_rows_does_not_matter(place, tmp_path_factory, random):
    rows = place.rows(steps=1, seeds=2, episodes=[1, 4])
    order = list(range(len(rows.columns["seed"])))
    random.shuffle(order)
    path = tmp_path_factory.mktemp("p") / "p.parquet"
    first = read_answers(rows.write(path), place.demos, HISTORY)
    again = read_answers(rows.at(order).write(path), place.demos, HISTORY)
    for name in ("covered", "anchors", "fold", "actions"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))


@pytest.mark.parametrize("kind", ["large", "fixed", "int", "int32 index", "batches"])
def test_other_ways_to_write_the_same(place, tmp_path, kind, monkeypatch):
    rows = place.rows(steps=2)
    values = np.round(np.array(rows.columns["action"]) * 4)
    types = {
        "large": pa.large_list(pa.large_list(pa.float64())),
        "fixed": pa.list_(pa.list_(pa.float32(), 3), 2),
        "int": pa.list_(pa.list_(pa.int16())),
    }
    action = pa.array(values.astype(int if kind == "int" else float).tolist(), types.get(kind, types["large"]))
    index = pa.array(rows.columns["episode_index"], pa.int32() if kind == "int32 index" else pa.int64())
    if kind == "batches":
        monkeypatch.setattr(reading, "BATCH", 7)
    path = rows.but(action=action, episode_index=index).write(tmp_path / "p.parquet")
    answers = read_answers(path, place.demos, HISTORY)
    np.testing.assert_array_equal(answers.actions[0, 0], values.astype(np.float32))


def test_frames_before_the_first_anchor_are_left_out_with_a_word(place, tmp_path):
    rows = place.rows(episodes=[0], steps=1)
    early = {name: [value[0], *value] for name, value in rows.columns.items()} | {
        "frame_index": [1, *rows.columns["frame_index"]]
    }
    answers = read_answers(rows.but(**early).write(tmp_path / "p.parquet"), place.demos, HISTORY)
    assert len(answers.anchors) == 38
    assert answers.notes == ("1 rows before frame 2 of their episodes are no anchors and are not scored",)


def test_steps_past_every_episode_are_cut(place, tmp_path):
    answers = read_answers(place.rows(steps=60).write(tmp_path / "p.parquet"), place.demos, HISTORY)
    assert answers.actions.shape[3] == 45 - HISTORY + 1
    assert "past the end of every episode" in answers.notes[0]


def replaced(values, row, value):
    return [value if i == row else v for i, v in enumerate(values)]


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda c: {"frame_index": None}, ["has no column 'frame_index'", "Expected episode_index"]),
        (lambda c: {"action": None, "actions": c["action"]}, ["has no column 'action'", "Did you mean 'actions'?"]),
        (lambda c: {"episode_index": [float(v) for v in c["episode_index"]]}, ["'episode_index' is double", "int64"]),
        (lambda c: {"action": [a[0] for a in c["action"]]}, ["'action' is list<", "a list in a list"]),
        (lambda c: {"action": [str(a) for a in c["action"]]}, ["'action' is string", "list<list<float>>"]),
        (lambda c: {"frame_index": replaced(c["frame_index"], 5, None)}, ["'frame_index' is missing in row 5"]),
        (lambda c: {"action": replaced(c["action"], 4, None)}, ["an action is missing in row 4"]),
        (lambda c: {"action": replaced(c["action"], 4, [[1.0] * 3, None])}, ["one of its actions is missing in row 4"]),
        (lambda c: {"action": replaced(c["action"], 4, [[1.0] * 3, [1.0, None, 1.0]])}, ["a number is missing in row 4"]),
        (lambda c: {"action": replaced(c["action"], 6, [[1.0] * 3])}, ["row 6 has 1 actions, earlier rows have 2"]),
        (lambda c: {"action": replaced(c["action"], 0, [])}, ["row 0 has 0 actions"]),
        (
            lambda c: {"action": replaced(c["action"], 6, [[1.0] * 3, [1.0] * 4])},
            ["an action in row 6 has 4 numbers", "3 action columns (a0, a1, a2)"],
        ),
        (
            lambda c: {"action": replaced(c["action"], 6, [[1.0] * 3, [1.0, float("nan"), 1.0]])},
            ["row 6 predicts nan in step 1, column 1", "finite"],
        ),
        (
            lambda c: {"episode_index": replaced(c["episode_index"], 3, 77)},
            ["row 3 is of episode 77", "6 episodes, numbered 10 to 15"],
        ),
        (
            lambda c: {"frame_index": replaced(c["frame_index"], 3, 40)},
            ["row 3 is of frame 40 in episode 10, which has frames 0 to 39"],
        ),
        (lambda c: {"frame_index": replaced(c["frame_index"], 3, -1)}, ["row 3 is of frame -1 in episode 10"]),
        (
            lambda c: {"frame_index": replaced(c["frame_index"], 3, 4)},
            ["rows 2 and 3 both predict episode 10, frame 4", "`seed` or `sample`"],
        ),
        (
            lambda c: {"fold": replaced(c["fold"], 3, 9)},
            ["row 3 gives episode 10 the fold 9, another row gives it", "one fold"],
        ),
        (lambda c: {"seed": replaced(c["seed"], 3, 1)}, ["seed 0 has no prediction of episode 10, frame 5"]),
        (lambda c: {"sample": replaced([0] * len(c["seed"]), 3, 1)}, ["seed 0, sample 0, has no prediction"]),
    ],
)  # fmt: skip
def test_a_fault_is_named(place, refusal, change, expected):
    rows = place.rows(steps=2)
    text = refusal(rows.but(**change(rows.columns)), place.demos)
    for words in expected:
        assert words in text


def test_an_episode_is_whole_or_not_there(place, refusal):
    rows = place.rows(steps=1)
    keep = [row for row in range(len(rows.columns["seed"])) if row not in (7, 8)]
    text = refusal(rows.at(keep), place.demos)
    assert "episode 10, frame 9 is not predicted (2 of this episode's 38 anchors are missing)" in text
    assert "demobench score hand_made --write-anchors" in text


def test_no_rows_and_no_anchors(place, refusal):
    rows = place.rows(steps=1)
    empty = pa.table(rows.columns).slice(0, 0)
    assert "has no rows" in refusal(reading_of(empty), place.demos)
    assert "no row is an anchor" in refusal(rows.at([0]).but(frame_index=[0]), place.demos)


def reading_of(table):
    from tests.external.conftest import Rows

    return Rows({name: table[name] for name in table.column_names})


def test_what_is_no_parquet_file(place, refusal, tmp_path):
    text = tmp_path / "p.csv"
    text.write_text("episode_index,frame_index\n")
    assert "cannot be read as parquet" in refusal(text, place.demos)
    assert "cannot be read as parquet" in refusal(tmp_path / "absent.parquet", place.demos)
    rows = place.rows(steps=1).write(tmp_path / "cut.parquet")
    rows.write_bytes(rows.read_bytes()[:-40])
    assert "cannot be read as parquet" in refusal(rows, place.demos)
    with pytest.raises(DatasetError, match="cannot be read"):
        hash_file(tmp_path / "absent.parquet")


def test_size_is_looked_at_before_memory_is_taken(place, refusal, tmp_path, monkeypatch):
    """One number, repeated: a few kilobytes on disk that would take a hundred times as much in memory."""
    rows, steps, width = 40, 9_000, 3
    inner = pa.ListArray.from_arrays(
        np.arange(0, rows * steps * width + 1, width, dtype=np.int32),
        pa.array(np.zeros(rows * steps * width, np.float32)),
    )
    action = pa.ListArray.from_arrays(np.arange(0, rows * steps + 1, steps, dtype=np.int32), inner)
    path = tmp_path / "p.parquet"
    pq.write_table(pa.table({"episode_index": [10] * rows, "frame_index": [2] * rows, "action": action}), path)
    monkeypatch.setattr(reading, "MOST_BYTES", 2**22)
    assert path.stat().st_size < 2**16
    assert "holds 1,080,080 numbers" in refusal(path, place.demos)
    assert "Predict fewer steps" in refusal(path, place.demos)

"""Data sets as they are found, not as the format promises them: each is read with the right numbers, or refused in plain words.

Every case takes a sound data set, changes one thing that public data sets do differently, and says what must come of it.
The same list is the table in docs/reading.md; `python -m tests.lerobot_format.test_wild` writes it there.
"""

import json
import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from pipeline.errors import DatasetError
from pipeline.lerobot_format.read import read_dataset
from pipeline.types import ACTION, STATE, Demonstrations
from tests.makers import Recording, edit_info, edit_table, tiny_recording, write_v2, write_v3

PAGE = Path(__file__).parents[2] / "docs/reading.md"
BEGIN, END = "<!-- the table: python -m tests.lerobot_format.test_wild -->\n", "<!-- end of the table -->"
EPISODES, LINES = "meta/episodes/chunk-000/file-000.parquet", "meta/episodes.jsonl"
NAMES, NUMBERED = ("shoulder", "elbow", "gripper"), ("0", "1", "2")
ARM, GRIPPER = f"{STATE}.arm", f"{STATE}.gripper"

Change = Callable[[Path], Any]


def usual() -> Recording:
    """Four episodes, three joints."""
    return tiny_recording(4, (20, 12, 16, 14), joints=3, names=NAMES)


def whole_numbers(largest: int = 1000) -> Recording:
    made = usual()
    state = (made.features[STATE][1] * largest).astype(np.int64)
    action = made.features[ACTION][1].astype(np.float64) / 3
    return replace(made, features={ACTION: (NAMES, action, "float64"), STATE: (NAMES, state, "int64")})


@dataclass(frozen=True)
class Case:
    """One deviation.

    what      for the page: what is different
    change    makes it so, in a folder that `write` wrote
    said      a part of each warning, or of the refusal
    episodes  positions of those that are read, all of them with their numbers as recorded
    ids, tasks, names   where they are not those of `episodes` and of the recording (names of the state's columns)
    """

    name: str
    what: str
    change: Change
    said: tuple[str, ...] = ()
    refused: bool = False
    write: Callable[..., Path] = write_v3
    made: Callable[[], Recording] = usual
    episodes: tuple[int, ...] = (0, 1, 2, 3)
    ids: tuple[int, ...] | None = None
    tasks: tuple[str, ...] | None = None
    names: tuple[str, ...] = NAMES


# What changes a data set


def in_turn(*changes: Change) -> Change:
    return lambda folder: [change(folder) for change in changes]


def in_info(change: Callable[[dict[str, Any]], Any]) -> Change:
    return lambda folder: edit_info(folder, change)


def in_features(**of: dict[str, Any]) -> Change:
    """Changes the declarations of features (`state` is short for observation.state), and declares new ones."""

    def change(info: dict[str, Any]) -> None:
        for key, values in of.items():
            info["features"].setdefault(STATE if key == "state" else key, {}).update(values)

    return in_info(change)


def in_files(change: Callable[[pa.Table], pa.Table], files: slice = slice(None)) -> Change:
    """Changes data files."""
    return lambda folder: [edit_table(path, change) for path in sorted((folder / "data").rglob("*.parquet"))[files]]


def in_list(change: Callable[[pa.Table], pa.Table]) -> Change:
    """Changes v3.0's list of episodes."""
    return lambda folder: edit_table(folder / EPISODES, change)


def in_lines(change: Callable[[list[dict[str, Any]]], list[dict[str, Any]]]) -> Change:
    """Changes v2's list of episodes."""

    def apply(folder: Path) -> None:
        rows = [json.loads(line) for line in (folder / LINES).read_text().splitlines()]
        (folder / LINES).write_text("".join(json.dumps(row) + "\n" for row in change(rows)))

    return apply


def put(table: pa.Table, key: str, values: Any) -> pa.Table:
    """The table with other values of one column."""
    values = values if isinstance(values, pa.Array) else pa.array(values)
    return table.set_column(table.column_names.index(key), key, values)


def renamed(old: str, new: str) -> Change:
    return in_turn(
        in_info(lambda info: info["features"].update({new: info["features"].pop(old)})),
        in_files(lambda table: table.rename_columns([new if name == old else name for name in table.column_names])),
    )


def split(key: str, one: str, other: str) -> Change:
    """A feature of three columns in two parts, the first two columns and the third."""

    def declare(info: dict[str, Any]) -> None:
        was = info["features"].pop(key)
        info["features"] |= {one: was | {"shape": [2], "names": list(NAMES[:2])}}
        info["features"] |= {other: was | {"shape": [1], "names": [NAMES[2]]}}

    def divide(table: pa.Table) -> pa.Table:
        values = np.array(table[key].to_pylist(), np.float32)
        table = table.drop_columns([key]).append_column(one, pa.array(values[:, :2].tolist(), pa.list_(pa.float32())))
        return table.append_column(other, pa.array(values[:, 2]))

    return in_turn(in_info(declare), in_files(divide))


def without_episodes(*gone: int) -> Callable[[pa.Table], pa.Table]:
    def change(table: pa.Table) -> pa.Table:
        return table.filter(pa.array(~np.isin(table["episode_index"].to_numpy(), gone)))

    return change


def reordered(order: Sequence[int]) -> Callable[[pa.Table], pa.Table]:
    """Whole episodes in another order."""

    def change(table: pa.Table) -> pa.Table:
        owner = table["episode_index"].to_numpy()
        return table.take(np.concatenate([np.flatnonzero(owner == episode) for episode in order]))

    return change


def other_frame_index(values: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Of the third episode, which v2 keeps in a file of its own."""
    third = slice(2, 3)
    return in_files(lambda table: put(table, "frame_index", values(table["frame_index"].to_numpy())), third)


def with_empty_row_groups(folder: Path) -> None:
    for path in (folder / "data").rglob("*.parquet"):
        table = pq.read_table(path, use_threads=False)
        with pq.ParquetWriter(path, table.schema) as writer:
            for piece in (table.slice(0, 0), table.slice(0, 7), table.slice(0, 0), table.slice(7), table.slice(0, 0)):
                writer.write_table(piece)


def wide_lists(table: pa.Table) -> pa.Table:
    values = [[row] for row in table[STATE].to_pylist()]
    return put(table, STATE, pa.array(values, pa.large_list(pa.list_(pa.float64()))))


def tasks_as_they_stand(folder: Path) -> None:
    """v2's lists with their characters written out, not escaped."""
    rows = [json.loads(line) | {"tasks": ["first\u2028then"]} for line in (folder / LINES).read_text().splitlines()]
    (folder / LINES).write_text("".join(json.dumps(row, ensure_ascii=False) + "\n" for row in rows), encoding="utf-8")


def list_in_two_files(folder: Path) -> None:
    table = pq.read_table(folder / EPISODES, use_threads=False)
    for number, piece in enumerate((table.slice(0, 3), table.slice(3))):
        pq.write_table(piece, folder / f"meta/episodes/chunk-000/file-{number:03d}.parquet")


def one_folder_down(folder: Path) -> None:
    shutil.move(folder, folder.parent / "moved")
    folder.mkdir()
    shutil.move(folder.parent / "moved", folder / "inner")


def files_of_two(folder: Path, recording: Recording) -> Path:
    return write_v3(folder, recording, episodes_per_file=2)


def v2_0(folder: Path, recording: Recording) -> Path:
    return write_v2(folder, recording, version="v2.0")


INDEX = ["timestamp", "frame_index", "episode_index", "index", "task_index"]
TOTALS = ("info.json says total_episodes", "info.json says total_frames")
VIDEO, IMAGE = {"dtype": "video", "shape": [48, 64, 3]}, {"dtype": "image"}
WITHOUT = tuple(f"Column '{key}' is in no data file; it was derived" for key in INDEX if key != "index")

WILD = (
    # Names of features and columns
    Case("actions", "the actions are called `actions`", renamed(ACTION, "actions"),
         ("There is no feature 'action'; it was made of: actions",)),
    Case("qpos", "the state is called `observation.qpos`", renamed(STATE, "observation.qpos"),
         ("There is no feature 'observation.state'; it was made of: observation.qpos",)),
    Case("split state", "the state is in parts, `observation.state.arm` and `observation.state.gripper`",
         split(STATE, ARM, GRIPPER),
         ("it was made of: observation.state.arm, observation.state.gripper",)),
    Case("two states", "two features could be the state, `observation.qpos` and `observation.joint_positions`",
         split(STATE, "observation.joint_positions", "observation.qpos"),
         ("it could be observation.joint_positions or observation.qpos",), refused=True),
    Case("split action", "the actions are in parts, `action.arm` and `action.gripper`",
         split(ACTION, "action.arm", "action.gripper"), ("it was made of: action.arm, action.gripper",)),
    Case("nested names", "names of columns in a mapping, `{\"motors\": […]}`",
         in_features(state={"names": {"motors": list(NAMES)}})),
    Case("no names", "no names of columns", in_features(state={"names": None}), names=NUMBERED),
    Case("too few names", "fewer names than columns", in_features(state={"names": ["arm"]}),
         ("has 3 columns but other names; its columns are numbered instead",), names=NUMBERED),
    # What info.json declares
    Case("bare shape", "a shape that is a number, `\"shape\": 3`", in_features(state={"shape": 3})),
    Case("double", "other names of number types, `double`", in_features(state={"dtype": "double"})),
    Case("words", "features that are no numbers (`string`, `language`)",
         in_features(instruction={"dtype": "string", "shape": [1]}, audio={"dtype": "language", "shape": [1]}),
         ("Feature 'instruction' (string [1]) was left out", "Feature 'audio' (language [1]) was left out")),
    Case("picture without shape", "a picture feature without a shape", in_features(**{"observation.image": IMAGE})),
    Case("no videos", "videos are declared and absent",
         in_features(**{"observation.images.top": VIDEO}),
         ("Camera 'observation.images.top' is declared, but video files are absent",)),
    Case("wrong totals", "wrong totals in info.json",
         in_info(lambda info: info.update(total_episodes=9, total_frames=9)), TOTALS),
    Case("newer", "a newer version, `v3.1`", in_info(lambda info: info.update(codebase_version="v3.1")),
         ("codebase_version is 'v3.1', newer than v3.0; it was read as v3.0",)),
    Case("older", "an older version, `v1.6`", in_info(lambda info: info.update(codebase_version="v1.6")),
         ("v2.0, v2.1 and v3.0 are read",), refused=True),
    Case("own paths", "a `data_path` of its own",
         lambda folder: (shutil.move(folder / "data/chunk-000", folder / "data/all"),
                         edit_info(folder, lambda info: info.update(data_path="data/all/file-{file_index:03d}.parquet")))),
    Case("one folder down", "the data set is one folder further down", one_folder_down, ("Did you mean",), refused=True),
    # Columns
    Case("no index columns", "no `episode_index`, `frame_index`, `timestamp` or `task_index` in the frames",
         in_files(lambda table: table.drop_columns(INDEX)), WITHOUT),
    Case("scalars and lists", "numbers in some files, lists of one number in others",
         in_files(lambda table: put(table, ACTION, [[value] for value in table[ACTION].to_pylist()]), slice(1, 3)),
         write=write_v2, made=lambda: tiny_recording(4, (20, 12, 16, 14), joints=1, names=("joint",)), names=("joint",)),
    Case("lists of lists", "lists in lists, in double precision", in_files(wide_lists)),
    Case("whole numbers", "states in whole numbers, actions in double precision", lambda folder: None, made=whole_numbers),
    Case("large numbers", "whole numbers that float32 cannot hold", lambda folder: None,
         ("holds whole numbers too large for float32; they were rounded",), made=lambda: whole_numbers(2**40)),
    Case("empty row groups", "empty row groups in the data files", with_empty_row_groups),
    Case("a reward in some", "another column only in some files",
         in_files(lambda table: table.drop_columns(["next.done"]), slice(0, 2)),
         ("Column 'next.done' is only in some data files; it was left out",), write=write_v2),
    Case("no action in one", "no actions in one file", in_files(lambda table: table.drop_columns([ACTION]), slice(1, 2)),
         ("has no column 'action', which meta/info.json declares",), refused=True, write=write_v2),
    Case("other width", "another number of columns than declared",
         in_features(state={"shape": [4], "names": [*NAMES, "wrist"]}), ("has 3 a frame",), refused=True),
    Case("gap in the numbers", "an action that is not a number",
         in_files(lambda table: put(table, ACTION, [[None] * 3, *table[ACTION].to_pylist()[1:]]), slice(2, 3)),
         ("action is nan in episode 2, frame 0, column 'shoulder'",), refused=True, write=write_v2),
    # Frames and episodes
    Case("episodes out of order", "episodes out of order in a file", in_files(reordered((2, 0, 3, 1))),
         ("do not hold the episodes in order; they were sorted by episode_index",)),
    Case("frames out of order", "frames out of order", in_files(lambda table: table.take([*range(1, 16), 0]), slice(2, 3)),
         ("Frames lay out of order and were sorted by frame_index: episode 2.",), write=write_v2),
    Case("frames twice", "a frame twice, another not at all",
         in_files(lambda table: table.take([0, 0, *range(2, 16)]), slice(2, 3)),
         ("frames are missing, twice or out of order",), refused=True, write=write_v2),
    Case("counted from 1", "`frame_index` counts from 1", other_frame_index(lambda frame: frame + 1),
         ("frame_index does not start at 0; frames were counted anew: episode 2.",), write=write_v2),
    Case("trimmed", "`frame_index` jumps where idle frames were cut", other_frame_index(lambda frame: frame + 5 * (frame > 9)),
         ("frame_index jumps: frames were taken out",), write=write_v2),
    Case("clock of the day", "timestamps that are the time of day",
         in_files(lambda table: put(table, "timestamp", table["timestamp"].to_numpy() + 5000)),
         ("Timestamps did not start near 0 in every episode; they were shifted",)),
    Case("wrong lengths", "lengths in meta/ that the frames contradict",
         in_list(lambda table: put(table, "length", [19, 13, 16, 14])),
         ("meta/ lists other lengths than the data have (0: 19, found 20, 1: 13, found 12); the data were believed",)),
    Case("wrong lengths, no numbers", "the same, and the frames have no numbers of their own",
         in_turn(in_list(lambda table: put(table, "length", [19, 12, 16, 14])),
                 in_files(lambda table: table.drop_columns(INDEX))),
         ("has 62 frames; the episodes that meta/ lists in it have 61",), refused=True),
    # Episodes that were deleted
    Case("deleted from the list", "frames of an episode that meta/ lists no more", in_list(without_episodes(1)),
         (*TOTALS, "12 frames of episodes that meta/ does not list were left out: 1."), episodes=(0, 2, 3)),
    Case("gap in the episodes", "an episode deleted everywhere, the others keep their numbers",
         in_turn(in_lines(lambda rows: [rows[0], *rows[2:]]),
                 lambda folder: (folder / "data/chunk-000/episode_000001.parquet").unlink(),
                 in_info(lambda info: info.update(total_episodes=3, total_frames=50))),
         write=write_v2, episodes=(0, 2, 3)),
    Case("renumbered in the list only", "an episode deleted, and the others numbered anew in meta/ only",
         in_turn(in_files(without_episodes(1)),
                 in_list(lambda table: put(without_episodes(1)(table), "episode_index", [0, 1, 2]))),
         (*TOTALS, "The frames' episode_index is another than in meta/, their boundaries are the same; meta/ was believed"),
         episodes=(0, 2, 3), ids=(0, 1, 2)),
    Case("file gone", "meta/ lists an episode whose file is gone",
         lambda folder: (folder / "data/chunk-000/episode_000001.parquet").unlink(),
         ("episode_000001.parquet is missing, though the data set's own lists name it",), refused=True, write=write_v2),
    Case("frames gone", "meta/ lists an episode whose frames are gone from a shared file", in_files(without_episodes(1)),
         ("has 50 frames; the episodes that meta/ lists in it have 62",), refused=True),
    Case("listed twice", "an episode listed twice, alike", in_lines(lambda rows: [*rows, rows[1]]),
         ("meta/ lists some episodes several times, each time alike; they count once",), write=write_v2),
    Case("no frames", "an episode without frames", in_lines(lambda rows: [*rows, rows[0] | {"episode_index": 4, "length": 0}]),
         ("info.json says total_episodes", "Episodes without frames were left out: 4"), write=write_v2),
    # The lists in meta/
    Case("no file_index", "v3.0 without `data/chunk_index` and `data/file_index`",
         in_list(lambda table: table.drop_columns(["data/chunk_index", "data/file_index"])),
         ("meta/ does not say in which file each episode is; all files of data/ were read",), write=files_of_two),
    Case("list in two files", "v3.0's list of episodes in several files", list_in_two_files),
    Case("several tasks", "several tasks of one episode", in_lines(lambda rows: [row | {"tasks": ["a", "b"]} for row in rows]),
         write=write_v2, tasks=("a; b",) * 4),
    Case("line separator", "a line separator (U+2028) in a task", tasks_as_they_stand, write=write_v2,
         tasks=("first\u2028then",) * 4),
    Case("half a character", "half of a surrogate pair in a task; it is read as “?”",
         in_lines(lambda rows: [row | {"tasks": ["go \ud83d"]} for row in rows]), write=write_v2, tasks=("go ?",) * 4),
    Case("terminal codes", "characters that a terminal obeys, in a task; they are taken out",
         in_lines(lambda rows: [row | {"tasks": ["go\x1b[2J\tnow\u202e"]} for row in rows]), write=write_v2,
         tasks=("go\ufffd[2J now\ufffd",) * 4),
    Case("terminal codes in a key", "the same in the name of a feature",
         in_info(lambda info: info["features"].update({"next.\x1b[2J": info["features"][ACTION]})),
         ("the name of the feature 'next.\\x1b[2J' holds control characters",), refused=True),
    Case("tasks by number", "tasks only by their number in the frames",
         in_lines(lambda rows: [{key: row[key] for key in ("episode_index", "length")} for row in rows]), write=write_v2),
    Case("no words of tasks", "tasks.parquet without the words",
         lambda folder: pq.write_table(pa.table({"task_index": [0, 1]}), folder / "meta/tasks.parquet")),
    Case("v2.0", "v2.0, which has `stats.json` and no `episodes_stats.jsonl`", lambda folder: None, write=v2_0),
    Case("no statistics", "no statistics at all", lambda folder: (folder / "meta/stats.json").unlink()),
)  # fmt: skip


@pytest.mark.parametrize("case", WILD, ids=lambda case: case.name)
def test_it_is_read_with_the_right_numbers_or_refused_in_plain_words(tmp_path: Path, case: Case):
    made = case.made()
    folder = case.write(tmp_path / "set", made)
    case.change(folder)
    if case.refused:
        with pytest.raises(DatasetError) as caught:
            read_dataset(folder, name="set")
        assert case.said[0] in str(caught.value)
        assert str(folder) in str(caught.value)
        return
    read = read_dataset(folder, name="set")
    check_numbers(case, made, read)
    assert len(read.warnings) == len(case.said), read.warnings
    for part in case.said:
        assert sum(part in warning for warning in read.warnings) == 1, read.warnings


def check_numbers(case: Case, made: Recording, read: Demonstrations) -> None:
    episodes = list(case.episodes)
    frames = np.concatenate([np.arange(where.start, where.stop) for where in np.array(made.slices())[episodes]])
    for key in (ACTION, STATE):
        np.testing.assert_array_equal(read.columns[key], made.features[key][1][frames].astype(np.float32))
    assert read.features[STATE].names == case.names
    assert read.episode_ids.tolist() == list(case.ids or episodes)
    assert read.lengths.tolist() == [made.lengths[episode] for episode in episodes]
    assert read.tasks == (case.tasks or tuple(made.tasks[episode] for episode in episodes))
    np.testing.assert_allclose(read.timestamps, read.frame_in_episode / made.fps, atol=1e-3)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.filter_too_much])
@given(st.sampled_from(WILD), st.sampled_from(WILD))
def test_two_deviations_at_once_never_end_in_a_traceback(tmp_path_factory, one: Case, other: Case):
    assume(one.write is other.write and one.made is other.made)
    folder = one.write(tmp_path_factory.mktemp("two") / "set", one.made())
    try:
        one.change(folder)
        other.change(folder)
    except (KeyError, ValueError, OSError, IndexError, pa.ArrowException):
        assume(False)  # the second finds nothing to change
    with suppress(DatasetError):
        assert read_dataset(folder, name="set").frames > 0


def test_names_are_used_once():
    assert len({case.name for case in WILD}) == len({case.what for case in WILD}) == len(WILD) >= 15


def test_the_page_holds_this_table():
    assert table() in PAGE.read_text(encoding="utf-8"), "write it again: python -m tests.lerobot_format.test_wild"


def table() -> str:
    """The cases in Markdown."""
    lines = ["| what is different | | what is said |", "|---|---|---|"]
    for case in WILD:
        said = "; ".join(f"“{part.rstrip('.')}”" for part in case.said) or "nothing"
        lines.append(f"| {case.what} | {'refused' if case.refused else 'read'} | {said} |")
    return "\n".join(lines) + "\n"


def write_table() -> None:
    """Puts the table into the page, between its marks."""
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    PAGE.write_text(before + BEGIN + table() + END + rest.partition(END)[2], encoding="utf-8")


if __name__ == "__main__":
    write_table()

"""`demobench inspect` as a user meets it: on a small data set with faults, and on real ones."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pipeline.types import ACTION, STATE
from tests.inspection.making import NAMES, Take, arm_takes
from tests.makers import Recording, tiny_recording, write_v3

ENVIRONMENT = {**os.environ, "NO_COLOR": "1"}


def inspect(*words, cwd, width: int = 160) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "demobench.cli", "inspect", *map(str, words)]
    environment = ENVIRONMENT | {"COLUMNS": str(width)}
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=120)


def said(argument, cwd) -> dict:
    done = inspect(argument, "--json", "-", cwd=cwd)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def write(folder: Path, takes: list[Take], names=NAMES) -> Path:
    action, state = (
        np.concatenate([getattr(take, which) for take in takes]).astype(np.float32) for which in ("action", "state")
    )
    features = {ACTION: (tuple(names), action, "float32"), STATE: (tuple(names), state, "float32")}
    lengths, tasks = tuple(len(take.seconds) for take in takes), tuple(take.task for take in takes)
    return write_v3(folder, Recording(20.0, features, lengths, tasks))


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """Sixteen episodes: number 3 ends after five frames, number 6 is frozen for two seconds, number 9 leaps."""
    place = tmp_path_factory.mktemp("user")
    takes = arm_takes()
    takes[3] = takes[3].frames(slice(0, 5))
    takes[6].state[20:60, 0] = takes[6].state[20, 0]
    takes[9].state[60, 2] += 25
    write(place / "tape", takes)
    return place


def test_the_page_says_what_is_wrong_where_to_look_and_what_to_leave_out(place):
    done = inspect("tape", cwd=place)
    assert done.returncode == 0, done.stderr
    assert "What looks wrong" in done.stdout
    assert "episode 6: observation.state/joint_0.pos repeats exactly for" in done.stdout
    assert "Look at these episodes first" in done.stdout
    for number in (3, 6, 9):
        assert f"demobench view tape {number}\n" in done.stdout
    assert done.stdout.index("demobench view tape 6") < done.stdout.index("demobench view tape 9")
    assert "  exclude = [3, 6]\n" in done.stdout


def test_json_has_the_same(place):
    facts = said("tape", place)
    assert facts["exclude"] == [3, 6]
    assert facts["exclude_line"] == "exclude = [3, 6]"
    assert {finding["episode"] for finding in facts["findings"]} == {3, 6, 9}
    assert {one["episode"] for one in facts["look_at"]} == {3, 6, 9}
    assert len(facts["lag_frames"]) == 4
    assert facts["episodes"] == 16, "the facts are there as before"


def test_the_exclude_line_works_where_it_says(place):
    line = said("tape", place)["exclude_line"]
    (place / "demobench.toml").write_text(f'[datasets.arm]\nsource = "tape"\n{line}\n')
    facts = said("arm", place)
    assert facts["excluded"] == [3, 6]
    assert facts["episodes"] == 14
    assert {finding["episode"] for finding in facts["findings"]} == {9}, "numbers stay as recorded"
    assert "left out by the configuration: episodes 3, 6" in inspect("arm", cwd=place).stdout


def test_a_clean_data_set_is_said_to_be_one(tmp_path):
    write(tmp_path / "tape", arm_takes())
    done = inspect("tape", cwd=tmp_path)
    assert "Nothing looks wrong." in done.stdout
    assert "clock, tracking, idle, jump" in done.stdout
    assert "exclude" not in done.stdout


def test_names_in_square_brackets_and_control_characters_are_shown_as_they_are(tmp_path):
    """What people named their joints and tasks is text: no markup, no terminal commands."""
    takes = arm_takes()
    for take in takes:
        take.task = "[bold]lift[/] [link=file:///etc/passwd]it[/link]\x1b[2J"
        take.action[:, 1] = take.state[:, 1] = 3.0
    names = ("[red]pan[/red]", "[/nonsense]", "lift\x1b]0;title\x07", "gripper.pos")
    write(tmp_path / "tape", takes, names)
    done = inspect("tape", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "[red]pan[/red]" in done.stdout
    assert "action/[/nonsense] hardly moves" in done.stdout
    assert "[bold]lift[/] [link=file:///etc/passwd]it[/link]" in done.stdout
    assert "\x1b" not in done.stdout + done.stderr
    assert "\x07" not in done.stdout + done.stderr


def test_names_are_whole_in_a_narrow_terminal_and_numbers_give_way(tmp_path):
    write(tmp_path / "tape", arm_takes())
    wide, narrow = (inspect("tape", cwd=tmp_path, width=width).stdout for width in (160, 60))
    for name in NAMES:
        assert f"   {name} " in narrow
    assert "left out for want of width: mean |a − s|" in narrow
    assert "tracking lag" in wide
    assert "left out" not in wide


def test_one_short_episode_is_inspected(tmp_path):
    write_v3(tmp_path / "tape", tiny_recording(1, 3))
    done = inspect("tape", cwd=tmp_path)
    assert done.returncode == 0, done.stderr


# Real ones ------------------------------------------------------------------------------------------------------------


def test_cr5_banana_has_a_dead_joint_and_an_uneven_clock(shared_data, tmp_path):
    facts = said(shared_data / "cr5_banana", tmp_path)
    columns = {finding["column"] for finding in facts["findings"] if finding["check"] == "dead"}
    assert columns == {"action/joint_5_vel", "observation.state/joint_5"}
    (clock,) = [finding for finding in facts["findings"] if finding["check"] == "clock"]
    assert clock["episode"] is None
    assert clock["words"].startswith("Uneven clock: a tick lasts 0.060 to 0.274 s where fps says 0.100 s")
    assert facts["exclude"] == []


@pytest.mark.parametrize("name", ["pusht", "pusht_image"])
def test_pusht_has_nothing_wrong(shared_data, tmp_path, name):
    facts = said(shared_data / name, tmp_path)
    assert facts["findings"] == []
    assert facts["look_at"] == []


def test_the_so101_waits_clips_its_wrist_and_has_no_faulty_episode(shared_data, tmp_path):
    facts = said(shared_data / "so101_pick_place_tape", tmp_path)
    assert {(finding["check"], finding["column"]) for finding in facts["findings"]} == {
        ("idle", None), ("saturated", "action/wrist_flex.pos"),
    }  # fmt: skip
    assert facts["look_at"] == []


def test_a_freeze_planted_in_a_copy_of_a_real_recording_is_found(shared_data, tmp_path):
    """The shoulder of episode 7 repeats for two seconds while its command goes furthest."""
    import pyarrow.parquet as pq

    folder = tmp_path / "tape"
    shutil.copytree(shared_data / "so101_pick_place_tape", folder)
    (path,) = folder.glob("data/*/*.parquet")
    table = pq.read_table(path)
    episode = np.flatnonzero(table["episode_index"].to_numpy() == 7)
    state, action = (np.array(table[key].to_pylist(), np.float32) for key in (STATE, ACTION))
    moves = np.abs(action[episode[60:], 1] - action[episode[:-60], 1])
    first = episode[0] + int(np.argmax(moves))
    state[first : first + 60, 1] = state[first, 1]
    place = table.schema.get_field_index(STATE)
    column = type_like(table[STATE], state)
    pq.write_table(table.set_column(place, table.schema.field(place), column), path)
    facts = said("tape", tmp_path)
    frozen = [finding for finding in facts["findings"] if finding["check"] == "frozen"]
    assert [(finding["episode"], finding["column"]) for finding in frozen] == [(7, f"{STATE}/shoulder_lift.pos")]
    assert facts["look_at"][0]["episode"] == 7
    assert facts["exclude"] == [7]


def type_like(column, values: np.ndarray):
    """[N, D] as an arrow array of the column's type."""
    import pyarrow as pa

    return pa.chunked_array([pa.array(values.tolist(), column.type)])

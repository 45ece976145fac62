"""The command line as a user meets it: real processes, their output and exit status."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tests.makers import edit_info, tiny_recording, write_v3

ENVIRONMENT = {**os.environ, "COLUMNS": "160", "NO_COLOR": "1"}
QUICK = ["--seeds", "1", "--steps", "4", "--chunks", "1", "--folds", "1"]


def demobench(*words, cwd, **more) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "demobench.cli", *map(str, words)]
    return subprocess.run(command, cwd=cwd, env=ENVIRONMENT, capture_output=True, text=True, timeout=300, **more)


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """An empty folder with one small data set in it."""
    place = tmp_path_factory.mktemp("user")
    write_v3(place / "tape", tiny_recording(episodes=6, frames=30))
    return place


@pytest.fixture(scope="module")
def first_run(place) -> subprocess.CompletedProcess:
    return demobench("run", "tape", *QUICK, "--json", "out.json", cwd=place)


def test_run_ends_in_a_table_and_paths_with_commands(place, first_run):
    assert first_run.returncode == 0, first_run.stderr
    assert "hold_still" in first_run.stdout
    assert "mlp_k01" in first_run.stdout
    assert "1 seed × 4 steps" in first_run.stdout
    (found,) = json.loads((place / "out.json").read_text())
    for kind in ("report", "mcap", "rerun"):
        assert Path(found["artifacts"][kind]).stat().st_size > 1000
        assert Path(found["artifacts"][kind]).name in first_run.stdout
    assert "demobench ui" in first_run.stdout
    assert {row["policy"] for row in found["policies"]} >= {"hold_still", "mlp_k01"}


def test_json_has_the_promised_shape(place, first_run):
    (found,) = json.loads((place / "out.json").read_text())
    assert set(found) >= {"dataset", "protocol", "split", "floor", "brackets", "policies", "artifacts"}
    assert set(found["dataset"]) >= {
        "name", "revision", "content_hash", "episodes", "frames", "fps", "action_names", "action_units", "action_kinds",
        "tracking_lag",
    }  # fmt: skip
    assert set(found["policies"][0]) >= {
        "policy", "method", "chunk", "observations", "seeds", "windows_train", "windows_test", "first_step_mae",
        "first_step_rmse", "first_step_l2", "at_one_second_mae", "whole_chunk_mae", "error_by_horizon",
        "hold_still_by_horizon", "error_by_joint", "params", "train_s", "latency_ms", "vs_hold_still", "scaled", "interval",
        "verdict", "rollouts",
    }  # fmt: skip
    assert set(found["floor"]) == {"radius", "estimates"}


def test_a_second_run_computes_nothing_and_says_so(place, first_run):
    again = demobench("run", "tape", *QUICK, "--json", "-", cwd=place)
    assert again.returncode == 0
    assert "is up to date: nothing to compute" in again.stderr
    (found,) = json.loads(again.stdout)
    assert found == json.loads((place / "out.json").read_text())[0], "JSON on standard output is clean and the same"


def test_inspect_and_floor_speak_json(place):
    facts = json.loads(demobench("inspect", "tape", "--json", "-", cwd=place).stdout)
    assert facts["episodes"] == 6
    assert facts["action_kinds"] == ["position", "position"]
    words = demobench("inspect", "tape", cwd=place).stdout
    assert "6 episodes" in words
    assert "tracking lag" in words
    floor = json.loads(demobench("floor", "tape", "--radius", "0.2", "--json", "-", cwd=place).stdout)
    assert set(floor) == {"dataset", "floor"}
    assert floor["floor"]["radius"]["probes"] > 0


def test_view_saves_an_episode(place, first_run):
    out = demobench("view", "tape", "0", "--save", "episode.rrd", cwd=place)
    assert out.returncode == 0, out.stderr
    assert (place / "episode.rrd").stat().st_size > 1000
    out = demobench("view", "tape", "99", cwd=place)
    assert out.returncode == 2
    assert "Error" not in out.stdout
    assert "has no episode 99. Its episodes are 0 to 5" in out.stderr


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["run", "tapes/none"], ["does not exist"]),
        (["run", "nosuch"], ["No data set 'nosuch'"]),
        (["run", "tape", "--policies", "mpl"], ["No policy 'mpl'", "Did you mean 'mlp'"]),
        (["run", "tape", "--observations", "stat"], ["Did you mean 'state'"]),
        (["run", "tape", "--chunks", "0"], ["whole numbers"]),
        (["run", "tape", "--chunks", "500", "--steps", "1"], ["500 actions is longer than every episode"]),
        (["run", "tape", "--store", "s3://bucket"], ["a URL"]),
        (["run", "tape", "--config", "none.toml"], ["No configuration file"]),
        (["run", "empty"], ["not a LeRobot data set"]),
        (["floor", "tape", "--observations", "x"], ["no observation set 'x'"]),
        (["inspect", "hub:nobody/nothing"], ["Hub"]),
    ],
)  # fmt: skip
def test_mistakes_are_one_message(place, words, expected):
    (place / "empty").mkdir(exist_ok=True)
    environment = {**ENVIRONMENT, "HF_ENDPOINT": "http://127.0.0.1:9", "HF_HOME": str(place / "hub")}
    command = [sys.executable, "-m", "demobench.cli", *words]
    out = subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True, timeout=300)
    assert out.returncode == 2
    assert "Traceback" not in out.stderr
    assert out.stderr.count("error:") == 1
    for word in expected:
        assert word in " ".join(out.stderr.split())


def test_an_error_that_quotes_a_file_holds_nothing_that_a_terminal_obeys(place):
    """A version that clears the screen, in a data set from a stranger."""
    write_v3(place / "strange", tiny_recording(2, 8))
    edit_info(place / "strange", lambda info: info.update(codebase_version="\x1b[2J[bold]v9\x07"))
    out = demobench("inspect", "strange", cwd=place)
    assert out.returncode == 2
    assert "codebase_version is '\ufffd[2J[bold]v9\ufffd'" in " ".join(out.stderr.split())


def test_a_folder_that_is_no_data_set_leaves_nothing_behind(place):
    (place / "plain").mkdir()
    assert demobench("run", "plain", "--store", "untouched", cwd=place).returncode == 2
    assert not (place / "untouched").exists()


def test_view_finds_a_variant_by_its_key_and_says_why_there_is_nothing(place, first_run):
    (key,) = [p.name for p in (place / "results" / "datasets").glob("tape+*") if (p / "benchmark_table").exists()]
    table = json.loads((place / "out.json").read_text())[0]
    held_out, trained = table["split"]["folds"][0]["test"][0], table["split"]["folds"][0]["train"][0]
    out = demobench("view", key, held_out, "--save", "variant.rrd", cwd=place)
    assert out.returncode == 0
    assert "trained on" not in out.stdout
    out = demobench("view", key, trained, "--save", "variant.rrd", cwd=place)
    assert f"Episode {trained} was trained on" in " ".join(out.stdout.split())
    out = demobench("view", "tape", held_out, "--save", "variant.rrd", cwd=place)
    assert f"The results of {key}, the only settings that 'tape' was benchmarked with" in " ".join(out.stdout.split())
    assert "no up-to-date predictions" not in out.stdout


def test_view_without_a_screen_is_one_message(place, first_run):
    environment = {key: value for key, value in ENVIRONMENT.items() if key not in ("DISPLAY", "WAYLAND_DISPLAY")}
    command = [sys.executable, "-m", "demobench.cli", "view", "tape", "0"]
    out = subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert out.returncode == 2
    assert "error: There is no screen here" in out.stderr
    assert "demobench view tape 0 --save FILE.rrd" in " ".join(out.stderr.split())
    assert len(out.stderr.splitlines()) <= 2


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="elsewhere a window would open")
@pytest.mark.parametrize(
    "broken", [{"DISPLAY": ":9999"}, {"DISPLAY": ":9999", "RERUN_CLI_PATH": "/no/such/rerun"}], ids=["screen", "viewer"]
)
def test_a_viewer_that_cannot_open_is_one_message_that_names_a_file(place, first_run, broken):
    environment = {key: value for key, value in ENVIRONMENT.items() if key != "WAYLAND_DISPLAY"} | broken
    command = [sys.executable, "-m", "demobench.cli", "view", "tape", "0"]
    out = subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True, timeout=300, check=False)
    said = " ".join(out.stderr.split())
    assert out.returncode == 2
    assert out.stderr.count("error: ") == 1
    assert "Traceback" not in out.stderr
    assert "error: Rerun's viewer could not be opened; what it said is above." in said
    assert said.endswith("demobench view tape 0 --save FILE.rrd")


def test_a_folder_is_viewed_where_its_name_is_another_s(place, first_run, tmp_path):
    """Its results are under a key with a hash, and with other settings than a bare `run`."""
    other = write_v3(tmp_path / "tape", tiny_recording(episodes=6, frames=30, seed=3))
    made = demobench("run", other, *QUICK, "--json", "other.json", cwd=place)
    assert made.returncode == 0, made.stderr
    table = json.loads((place / "other.json").read_text())[0]
    assert table["key"].startswith("tape-")
    out = demobench("view", other, table["split"]["folds"][0]["test"][0], "--save", "other.rrd", cwd=place)
    assert out.returncode == 0, out.stderr
    assert f"The results of {table['key']}" in " ".join(out.stdout.split())
    assert "no up-to-date predictions" not in out.stdout


def test_debug_shows_the_traceback(place):
    out = demobench("run", "nosuch", "--debug", cwd=place)
    assert "Traceback" in out.stderr
    assert "ConfigError" in out.stderr


def test_bad_data_stops_the_run_in_one_message_and_keeps_earlier_results(place, first_run):
    from dataclasses import replace

    recording = tiny_recording(episodes=6, frames=30)
    names, values, dtype = recording.features["action"]
    broken = np.array(values)
    broken[70, 1] = np.nan
    write_v3(place / "broken", replace(recording, features={**recording.features, "action": (names, broken, dtype)}))
    before = sorted(p for p in (place / "results").rglob("made.json"))
    out = demobench("run", "broken", *QUICK, cwd=place)
    assert out.returncode == 2
    assert "Traceback" not in out.stderr
    assert "action is nan in episode 2, frame 10" in out.stderr
    assert sorted(p for p in (place / "results").rglob("made.json")) == before


def test_a_store_in_the_way_is_one_message(place):
    (place / "file").write_text("x")
    out = demobench("run", "tape", "--store", "file", cwd=place)
    assert out.returncode == 2
    assert "cannot be written to" in out.stderr


def test_ctrl_c_leaves_no_debris_and_the_next_run_goes_on(place):
    words = ["run", "tape", "--seeds", "3", "--steps", "100000", "--chunks", "1", "--folds", "1", "--store", "stopped"]
    process = subprocess.Popen(
        [sys.executable, "-m", "demobench.cli", *words], cwd=place, env=ENVIRONMENT, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    deadline = time.monotonic() + 200
    while not list((place / "stopped").glob("datasets/*/mlp_k01/**/.state.*.draft")) and time.monotonic() < deadline:
        time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    try:
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130, err
    assert "Stopped. What was finished is kept" in out
    assert "Traceback" not in err
    assert not list((place / "stopped").rglob("*.draft*"))
    finished = {p.parent.parent.name for p in (place / "stopped").rglob("made.json")}
    assert "trained_policy" in finished, "the baselines before it were finished and are kept"


def test_help_has_examples(place):
    for command in (["run"], ["inspect"], ["floor"], ["curve"], ["view"], ["ui"], ["record", "pusht"]):
        out = demobench(*command, "--help", cwd=place)
        assert "Example" in out.stdout, command
        assert f"demobench {' '.join(command)}" in out.stdout.split("Example")[1], command


@pytest.fixture
def small_disk(tmp_path):
    """A file system of a chosen size, in memory."""
    mounted = []

    def mount(size: str) -> Path:
        folder = tmp_path / f"disk-{size}"
        folder.mkdir()
        command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
        if subprocess.run(command, capture_output=True, check=False).returncode:
            pytest.skip("a small file system cannot be mounted here (it takes root)")
        mounted.append(folder)
        return folder

    yield mount
    for folder in mounted:
        subprocess.run(["umount", str(folder)], check=True)


def test_no_room_is_said_before_any_work(place, small_disk):
    out = demobench("run", "tape", *QUICK, "--store", small_disk("2m") / "results", cwd=place)
    assert out.returncode == 2
    assert "There is no room for results" in out.stderr


@pytest.mark.slow
def test_a_disk_that_fills_up_in_the_middle_is_one_message(place, small_disk):
    store = small_disk("104m") / "results"
    filler = store.parent / "filler"
    command = [sys.executable, "-m", "demobench.cli", "run", "tape", "--chunks", "4", "--store", str(store)]
    process = subprocess.Popen(command, cwd=place, env=ENVIRONMENT, stderr=subprocess.PIPE, text=True)
    try:
        deadline = time.monotonic() + 120
        while not list(store.glob("datasets/*/windows/made.json")) and time.monotonic() < deadline:
            time.sleep(0.1)
        with filler.open("wb") as file, contextlib.suppress(OSError):
            while file.write(b"x" * 2**20):
                file.flush()
        _, err = process.communicate(timeout=200)
    finally:
        process.kill()
    assert process.returncode == 2
    assert "Traceback" not in err
    assert err.count("error:") == 1
    assert "space" in err
    finished = [p.parent for p in store.rglob("made.json")]
    assert any(p.name == "demonstrations" for p in finished)
    for folder in finished:
        json.loads((folder / "made.json").read_text())

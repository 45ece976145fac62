"""`demobench curve` as a user meets it."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from demobench.commands.curve import parse_sizes
from pipeline.errors import ConfigError
from tests.demobench.test_cli import ENVIRONMENT, demobench
from tests.makers import tiny_recording, write_v3

QUICK = ["--seeds", "2", "--steps", "4"]


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("user")
    write_v3(place / "tape", tiny_recording(episodes=15, frames=25))
    write_v3(place / "short", tiny_recording(episodes=8, frames=25))
    return place


@pytest.fixture(scope="module")
def first(place) -> subprocess.CompletedProcess:
    return demobench("curve", "tape", *QUICK, "--json", "out.json", cwd=place)


def test_it_ends_in_a_table_an_answer_and_a_picture(place, first):
    assert first.returncode == 0, first.stderr
    assert "training episodes" in first.stdout
    assert "50 more demonstrations (12 → 62 to train on)" in " ".join(first.stdout.split())
    assert "far beyond what was seen" in " ".join(first.stdout.split())
    found = json.loads((place / "out.json").read_text())
    assert set(found) >= {
        "dataset",
        "policy",
        "observations",
        "protocol",
        "budget",
        "sizes",
        "floor",
        "answers",
        "others",
    }
    assert (found["policy"], found["observations"], found["protocol"]) == ("mlp_k01", "state", "strict")
    assert [size["episodes"] for size in found["sizes"]] == [4, 6, 12]
    assert all(size["interval"][0] < size["error"] < size["interval"][1] for size in found["sizes"])
    (answer,) = found["answers"]
    assert set(answer) == {"metric", "more", "share", "gain", "interval", "word", "words"}
    assert answer["word"] in ("yes", "no", "cannot tell")
    assert all(Path(picture).stat().st_size > 1000 for picture in found["pictures"])


def test_another_question_of_the_same_curve_trains_nothing(place, first):
    again = demobench("curve", "tape", *QUICK, "--more", "12", "--worthwhile", "0.5", "--json", "-", cwd=place)
    assert "is up to date: nothing to compute" in again.stderr
    found, before = json.loads(again.stdout), json.loads((place / "out.json").read_text())
    assert found["sizes"] == before["sizes"]
    assert (found["answers"][0]["more"], found["answers"][0]["share"]) == (12, 0.5)
    assert found["answers"][0]["interval"] != before["answers"][0]["interval"]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["tape", "--sizes", "4,13"], ["--sizes has 13, and there are 12 training episodes in a fold"]),
        (["tape", "--sizes", "4,x"], ["--sizes takes whole numbers"]),
        (["short"], ["at least 8 training episodes, and here every fold has 6"]),
        (["tape", "--policy", "mlp_k001"], ["No policy 'mlp_k001'. Did you mean 'mlp_k01'?"]),
        (["tape", "--policy", "hold_still"], ["'hold_still' is a baseline that does not learn"]),
        (["tape", "--observations", "stat"], ["Did you mean 'state'"]),
        (["nosuch"], ["No data set 'nosuch'"]),
    ],
)
def test_a_mistake_is_one_message_before_any_work(place, words, expected):
    out = demobench("curve", *words, "--store", "untouched", cwd=place)
    assert out.returncode == 2
    assert "Traceback" not in out.stderr
    assert out.stderr.count("error:") == 1
    for word in expected:
        assert word in " ".join(out.stderr.split())
    assert not list((place / "untouched").rglob("made.json"))


def test_sizes_as_words():
    assert parse_sizes("10, 20") == (10, 20)
    assert parse_sizes(None) == ()
    with pytest.raises(ConfigError, match="--sizes takes whole numbers"):
        parse_sizes("0")


@pytest.mark.slow
def test_ctrl_c_keeps_finished_subsets_and_the_next_run_goes_on(place):
    words = ["curve", "tape", "--folds", "3", "--seeds", "2", "--steps", "400", "--store", "stopped"]
    command = [sys.executable, "-m", "demobench.cli", *words]
    process = subprocess.Popen(
        command, cwd=place, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 200
    while not list((place / "stopped").rglob("fold_0_*.safetensors")) and time.monotonic() < deadline:
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    try:
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130, err
    assert "Stopped. What was finished is kept" in out
    before = {p: p.stat().st_mtime_ns for p in (place / "stopped").rglob("fold_*_order_*.safetensors")}
    assert before
    again = demobench(*words, cwd=place)
    assert again.returncode == 0, again.stderr
    assert "1 assets to make" in again.stderr or "[1/1] learning_curve" in again.stderr
    assert all(p.stat().st_mtime_ns == stamp for p, stamp in before.items())

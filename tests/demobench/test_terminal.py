"""`demobench run` as a person sees it: on a pseudo-terminal whose screen is looked at, and where there is no terminal."""

import fcntl
import json
import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path

import pyte
import pytest

from tests.makers import tiny_recording, write_v3

CONFIG = """
[benchmark]
seeds = 1
folds = 2
steps = 6
threads = 1
[datasets.tape]
source = "tape"
[policies.mlp]
method = "mlp"
chunks = [4]
"""
COLUMNS, LINES = 120, 40
COMMAND = [sys.executable, "-m", "demobench.cli", "run"]
COLOURS = re.compile(rb"\x1b\[(?:[0-9]+;)*(?:3[0-8]|9[0-7])(?:;[0-9]+)*m")


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    here = tmp_path_factory.mktemp("user")
    write_v3(here / "tape", tiny_recording(episodes=6, frames=30))
    (here / "demobench.toml").write_text(CONFIG)
    return here


class Terminal:
    """A command on a pseudo-terminal. `seen` is every screen that it showed, `raw` what it wrote."""

    def __init__(self, place: Path, *words: str, interrupt_at: str = "", **environment: str):
        self.screen = pyte.HistoryScreen(COLUMNS, LINES, history=10_000)
        stream = pyte.ByteStream(self.screen)
        self.raw, self.seen = b"", []
        ours, theirs = pty.openpty()
        fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", LINES, COLUMNS, 0, 0))
        clean = {k: v for k, v in os.environ.items() if k not in ("NO_COLOR", "FORCE_COLOR", "COLUMNS", "LINES")}
        process = subprocess.Popen(
            [*COMMAND, *words], cwd=place, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True,
            env={**clean, "TERM": "xterm-256color", **environment},
        )  # fmt: skip
        os.close(theirs)
        end = time.monotonic() + 500
        while time.monotonic() < end:
            if not select.select([ours], [], [], 1)[0]:
                continue
            try:
                new = os.read(ours, 65536)
            except OSError:
                break
            self.raw += new
            stream.feed(new)
            self.seen.append("\n".join(self.screen.display))
            if interrupt_at and interrupt_at in self.seen[-1]:
                interrupt_at = ""
                os.kill(process.pid, signal.SIGINT)
        os.close(ours)
        self.status = process.wait(timeout=60)

    @property
    def text(self) -> str:
        """Everything that stands on the terminal at the end, what scrolled out included."""
        above = ["".join(line[x].data for x in range(COLUMNS)) for line in self.screen.history.top]
        return "\n".join([*above, *self.screen.display])


@pytest.fixture(scope="module")
def first(place) -> Terminal:
    return Terminal(place)


@pytest.mark.slow
def test_a_run_is_a_tree_that_leaves_only_the_table(first):
    assert first.status == 0, first.text
    trees = [seen for seen in first.seen if "├── data" in seen]
    assert trees
    policy = [line for seen in trees for line in seen.split("\n") if "mlp_k04 " in line]
    assert any("· trained" in line for line in policy), "it waits"
    assert any("✓ trained" in line and " s" in line for line in policy), "made, with its seconds"
    assert any("▸" in seen for seen in trees)
    assert all(seen.count("├── data") == 1 for seen in trees), "one tree, which nothing scrolls away"
    assert "├──" not in first.text
    assert first.text.index("assets made in") < first.text.index("first step")
    assert not first.screen.cursor.hidden
    assert b"\x1b[1m" in first.raw


@pytest.mark.slow
def test_no_color_is_honoured_and_a_second_run_has_nothing_to_do(first, place):
    plain = Terminal(place, NO_COLOR="1")
    assert "nothing to compute" in plain.text
    assert COLOURS.search(first.raw)
    assert not COLOURS.search(plain.raw)


@pytest.mark.slow
def test_ctrl_c_leaves_the_terminal_as_it_was(place):
    stopped = Terminal(place, "--store", "other", interrupt_at="▸ trained")
    assert stopped.status == 130
    assert "Stopped. What was finished is kept" in stopped.text
    assert "├──" not in stopped.text
    assert "Traceback" not in stopped.text
    assert not stopped.screen.cursor.hidden


@pytest.mark.slow
def test_json_on_standard_output_is_nothing_but_json(place):
    out = subprocess.run(
        [*COMMAND, "--json", "-", "--store", "other"],
        cwd=place,
        capture_output=True,
        text=True,
        timeout=500,
        check=True,
    )
    (table,) = json.loads(out.stdout)
    assert table["key"] == "tape"
    assert "\x1b" not in out.stdout + out.stderr
    lines = [line for line in out.stderr.split("\n") if line.startswith("[")]
    assert lines[-1].startswith(f"[{len(lines):>2}/{len(lines)}] ")

"""`demobench view` of a file: what was cut off is recovered, and one message says how far."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader
from typer.testing import CliRunner

from demobench.cli import app, main
from pipeline.sinks.to_mcap import write_mcap
from tests.filming import KEY, filmed_v2
from tests.makers import edit_info, tiny_recording
from tests.sinks.making import make_demos, make_semantics


@pytest.fixture
def cut(tmp_path, monkeypatch) -> Path:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    demos = make_demos(columns=6, lengths=(400, 400))
    path = tmp_path / "held_out.mcap"
    write_mcap(path, demos, make_semantics(demos), [], [0, 1], metadata={})
    path.write_bytes(path.read_bytes()[: int(0.6 * path.stat().st_size)])
    return path


def count(path: Path) -> int:
    with path.open("rb") as file:
        return make_reader(file).get_summary().statistics.message_count


def words_of(output: str) -> str:
    return " ".join(output.split())


def test_what_was_cut_off_is_recovered_beside_it_and_says_how_far(cut):
    done = CliRunner().invoke(app, ["view", str(cut)])
    assert done.exit_code == 0, done.output
    beside = cut.with_name("held_out_recovered.mcap")
    said = words_of(done.stdout)
    assert f"held_out.mcap was cut off: recovered {count(beside):,} messages, up to" in said
    assert "s of episode 7. Written to" in said
    assert 100 < count(beside) < 1602


def test_it_is_written_where_one_asks_for(cut, tmp_path):
    done = CliRunner().invoke(app, ["view", str(cut), "--save", str(tmp_path / "rest.mcap")])
    assert done.exit_code == 0
    assert count(tmp_path / "rest.mcap") > 100
    assert not cut.with_name("held_out_recovered.mcap").exists()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="elsewhere a window would open")
@pytest.mark.parametrize(("codec", "dark"), [("h264", True), ("av1", False)])
def test_a_camera_that_the_window_cannot_decode_is_said_with_a_remedy(tmp_path, codec, dark):
    folder = filmed_v2(tmp_path / "film", tiny_recording(2, 12))
    edit_info(folder, lambda info: info["features"][KEY].update(info={"video.codec": codec}))
    environment = {**os.environ, "PATH": "/no/programs", "DISPLAY": ":9999", "WAYLAND_DISPLAY": ""}
    words = [sys.executable, "-m", "demobench.cli", "view", "film", "1"]
    done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2, "there is no screen"
    said = words_of(done.stdout)
    assert ("The camera stays dark" in said) == dark
    assert ("Install ffmpeg, or look in a browser: rerun --web-viewer --bind 127.0.0.1" in said) == dark


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["whole.mcap", "--save", "b.mcap"], "is a whole recording, so there is nothing for --save to write"),
        (["whole.mcap"], "There is no screen here"),
        (["words.mcap"], "words.mcap is no MCAP file"),
        (["none.mcap"], "none.mcap cannot be read: No such file"),
        (["pusht_sim"], "Which episode of 'pusht_sim'? Say its number: demobench view pusht_sim 0"),
    ],
)
def test_what_cannot_be_viewed_is_one_message(cut, tmp_path, monkeypatch, capsys, arguments, said):
    monkeypatch.chdir(tmp_path)
    demos = make_demos()
    write_mcap(Path("whole.mcap"), demos, make_semantics(demos), [], [0], metadata={})
    Path("words.mcap").write_text("words")
    monkeypatch.setattr("sys.argv", ["demobench", "view", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code
    assert said in words_of(capsys.readouterr().err)

"""What `source` in demobench.toml may be, and the stamp that says whether it has changed."""

import json
from pathlib import Path

import pytest

from pipeline.lerobot_format.read import load_source, source_stamp
from tests.makers import Recording, edit_info, tiny_recording, write_v3


@pytest.fixture
def recording() -> Recording:
    return tiny_recording(3, 20)


# Sources and their stamps


def test_a_folder_is_relative_to_the_configuration(tmp_path: Path, recording: Recording):
    folder = write_v3(tmp_path / "sets/one", recording)
    read = load_source("sets/one", name="one", config_dir=tmp_path)
    assert read.source == "sets/one"
    assert load_source(str(folder), name="one", config_dir=Path("/nowhere")).content_hash == read.content_hash


def test_the_stamp_of_a_folder_changes_when_a_file_does(tmp_path: Path, recording: Recording):
    folder = write_v3(tmp_path / "set", recording)
    stamp = source_stamp("set", tmp_path)
    assert stamp["kind"] == "folder"
    assert json.loads(json.dumps(stamp)) == stamp == source_stamp(str(folder), Path("/nowhere"))
    (folder / "README.md").write_text("words do not matter")
    assert source_stamp("set", tmp_path) == stamp
    edit_info(folder, lambda info: info.update(robot_type="another"))
    assert source_stamp("set", tmp_path) != stamp

"""Small data sets for the tests to break, and how a refusal is looked at."""

from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.errors import DatasetError
from pipeline.lerobot_format.read import read_dataset
from tests.makers import tiny_recording, write_v2, write_v3


@pytest.fixture
def v3(tmp_path: Path) -> Path:
    """Four episodes of twenty frames, all in one file."""
    return write_v3(tmp_path / "set", tiny_recording(4, 20))


@pytest.fixture
def v2(tmp_path: Path) -> Path:
    """The same, a file an episode."""
    return write_v2(tmp_path / "set", tiny_recording(4, 20))


@pytest.fixture
def message() -> Callable[[Path], str]:
    """What reading a folder says: on one line, with the place in it."""

    def refuse(folder: Path) -> str:
        with pytest.raises(DatasetError) as caught:
            read_dataset(folder, name="set")
        text = str(caught.value)
        assert "\n" not in text
        assert str(folder) in text or "info.json" in text
        return text

    return refuse

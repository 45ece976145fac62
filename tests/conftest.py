"""Fixtures that every test may use: where the real demonstrations are, and small data sets that the tests write themselves."""

from pathlib import Path

import pytest

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real demonstrations beside the repository."""
    if not SHARED_DATA.is_dir():
        pytest.skip("the real demonstrations (../shared/data) are not on this machine")
    return SHARED_DATA

"""Fixtures for everything that writes files: a small data set with what was predicted and rolled out on it."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from pipeline.types import (
    ACTION,
    Demonstrations,
    Fold,
    Neighbourhood,
    Predictions,
    RadiusFloor,
    Rollouts,
    Semantics,
    Split,
)

from .making import make_demos, make_predictions, make_semantics, make_table


@pytest.fixture
def demos() -> Demonstrations:
    return make_demos()


@pytest.fixture
def semantics(demos) -> Semantics:
    return make_semantics(demos)


@pytest.fixture
def predictions(demos) -> list[Predictions]:
    """Held-out predictions for the last two episodes of three, of two policies with a chunk and one baseline."""
    return [
        make_predictions(demos, [1, 2], "mlp_k01", 1),
        make_predictions(demos, [1, 2], "mlp_k04", 4),
        replace(make_predictions(demos, [1, 2], "hold_still", 11, off=20.0), seeds=(0,)),
    ]


@pytest.fixture
def table(demos, semantics) -> dict:
    return make_table(demos, semantics)


@pytest.fixture
def split() -> Split:
    return Split((Fold((0,), (1, 2)),), 0, "ab12" * 16)


@pytest.fixture
def floor(demos) -> RadiusFloor:
    frames = np.array([3, 4, 33, 34, 60])
    crowded = Neighbourhood(3, frames, demos.columns[ACTION][frames])
    return RadiusFloor("state", 0, 2.0, False, 12, 5.0, 6.25, 11.5, "px", crowded, None)


@pytest.fixture
def rollouts() -> Rollouts:
    paths = np.cumsum(np.random.default_rng(0).normal(0, 9, (6, 20, 2)), axis=1) + 256
    paths[2, 12:] = np.nan
    success = np.array([True, False, True, True, False, True])
    return Rollouts(
        "pusht", "0.1.8", "mlp_k04", "state", np.arange(6), success, np.where(success, 1.0, 0.4),
        np.where(success, 0.96, 0.4), np.full(6, 20), paths,
    )  # fmt: skip


@pytest.fixture(scope="module")
def browser():
    """A real Chromium without a window. While it is open an event loop runs, in which others cannot begin one of their own: so it
    is closed after each file."""
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("no Chromium on this machine")
    from playwright.sync_api import sync_playwright

    flags = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--disable-background-networking", "--disable-sync"]
    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=program, args=flags)
        yield opened
        opened.close()

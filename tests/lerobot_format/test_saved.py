"""Demonstrations kept on disk, and the hash of what is in them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import StoreError
from pipeline.lerobot_format.read import load_demonstrations, read_dataset, save_demonstrations
from pipeline.types import ACTION, STATE
from tests.makers import Recording, demonstrations_of, tiny_demonstrations, tiny_recording, write_v2


@pytest.fixture
def recording() -> Recording:
    return tiny_recording(5, [30, 12, 25, 40, 18], names=("shoulder_rad", "elbow_rad"))


# The hash


def test_the_hash_sees_every_change(recording: Recording):
    def value(key: str) -> dict:
        names, values, dtype = recording.features[key]
        changed = values.copy()
        changed[-1, -1] = not changed[-1, -1] if dtype == "bool" else np.nextafter(changed[-1, -1], np.float32(9))
        return recording.features | {key: (names, changed, dtype)}

    renamed = recording.features | {ACTION: (("a", "b"), *recording.features[ACTION][1:])}
    changes = [
        recording,
        replace(recording, features=value(ACTION)),
        replace(recording, features=value(STATE)),
        replace(recording, features=value("next.done")),
        replace(recording, features=renamed),
        replace(recording, lengths=(30, 12, 25, 39, 19)),
        replace(recording, tasks=("push", "pull", "push", "push", "push")),
        replace(recording, fps=20.0),
        replace(recording, features={key: column for key, column in recording.features.items() if key != "next.done"}),
    ]
    hashes = [demonstrations_of(change).content_hash for change in changes]
    assert len(set(hashes)) == len(changes)
    assert demonstrations_of(recording, name="another").content_hash == hashes[0]


# Kept between runs


def test_kept_demonstrations_come_back_mapped(tmp_path: Path, recording: Recording):
    folder = write_v2(tmp_path / "set", recording)
    read = read_dataset(folder, name="set", source="hub:a/b", revision="0" * 40)
    save_demonstrations(read, tmp_path / "kept")
    back = load_demonstrations(tmp_path / "kept")
    for field in (
        "name",
        "source",
        "revision",
        "fps",
        "robot_type",
        "features",
        "tasks",
        "cameras",
        "warnings",
        "content_hash",
    ):
        assert getattr(back, field) == getattr(read, field)
    for key in read.columns:
        assert isinstance(back.columns[key], np.memmap)
        np.testing.assert_array_equal(back.columns[key], read.columns[key])
    np.testing.assert_array_equal(back.timestamps, read.timestamps)
    np.testing.assert_array_equal(back.episode_starts, read.episode_starts)
    assert back.frames == read.frames


# What was kept


@pytest.mark.parametrize("damage", ["cut", "remove", "pickle", "words"])
def test_kept_demonstrations_that_are_damaged(tmp_path: Path, damage: str):
    save_demonstrations(tiny_demonstrations(), tmp_path / "kept")
    path = tmp_path / "kept/column-000.npy"
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:200])
    elif damage == "remove":
        path.unlink()
    elif damage == "pickle":
        np.save(path, np.array([{}], dtype=object))
    else:
        (tmp_path / "kept/meta.json").write_text("{}")
    with pytest.raises(StoreError, match="Remove the folder and run again"):
        load_demonstrations(tmp_path / "kept")

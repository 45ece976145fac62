"""What there was to see, as a file: what is read is what was written, and damage is one clear message."""

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from pipeline.errors import StoreError
from pipeline.simulate.scene_files import SCENES_FILE, load_scenes, save_scenes
from pipeline.types import STATE, Scenes

RNG = np.random.default_rng(0)
SCENES = Scenes(
    {STATE: RNG.normal(size=(2, 5, 3)).astype(np.float32), "block": RNG.normal(size=(2, 5, 1)).astype(np.float32)},
    np.array([0, 4]),
    RNG.normal(size=(2, 2, 8, 3)).astype(np.float32),
)


def test_written_and_read_again(tmp_path):
    save_scenes(SCENES, tmp_path)
    read = load_scenes(tmp_path)
    assert read.shown.keys() == SCENES.shown.keys()
    for key, values in SCENES.shown.items():
        np.testing.assert_array_equal(read.shown[key], values)
    np.testing.assert_array_equal(read.asked, SCENES.asked)
    np.testing.assert_array_equal(read.chunks, SCENES.chunks)


def test_nothing_was_kept(tmp_path):
    assert load_scenes(tmp_path) is None


def cut_off(path):
    path.write_bytes(path.read_bytes()[:-40])


def emptied(path):
    path.write_bytes(b"")


def without_chunks(path):
    save_file({name: array for name, array in load_file(path).items() if name != "chunks"}, path)


def of_other_lengths(path):
    save_file(load_file(path) | {"asked": np.arange(3)}, path)


def of_fewer_start_states(path):
    save_file(load_file(path) | {"chunks": SCENES.chunks[:1]}, path)


@pytest.mark.parametrize("damage", [cut_off, emptied, without_chunks, of_other_lengths, of_fewer_start_states])
def test_a_damaged_file_says_what_where_and_what_to_do(tmp_path, damage):
    save_scenes(SCENES, tmp_path)
    damage(tmp_path / SCENES_FILE)
    with pytest.raises(StoreError, match=r"scenes\.safetensors is damaged \(.+\), so .* Delete .* and run again"):
        load_scenes(tmp_path)

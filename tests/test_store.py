"""Results are there whole or not at all."""

import os
import shutil
import subprocess
import time

import psutil
import pytest

from pipeline.errors import ConfigError, StoreError
from pipeline.store import Made, Meter, Store, drafted, drafted_folder, write_json


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path / "results").ensure()


def publish(store, folder, text, fingerprint="f1"):
    with store.publish(folder) as draft:
        (draft / "value.txt").write_text(text)
        store.write_made(draft, Made(fingerprint))


def test_what_is_published_replaces_what_was_there(store):
    folder = store.folder("tape", "mlp_k01/predictions", "state")
    publish(store, folder, "one")
    assert store.is_fresh(folder, "f1")
    publish(store, folder, "two", "f2")
    assert (folder / "value.txt").read_text() == "two"
    assert not store.is_fresh(folder, "f1")
    assert [p.name for p in folder.parent.iterdir()] == ["state"], "no drafts left behind"


def test_a_failed_block_leaves_the_earlier_result(store):
    folder = store.folder("tape", "windows")
    publish(store, folder, "one")
    with pytest.raises(ZeroDivisionError), store.publish(folder) as draft:
        (draft / "value.txt").write_text(str(1 / 0))
    assert (folder / "value.txt").read_text() == "one"
    with pytest.raises(StoreError, match=r"without made\.json"), store.publish(folder) as draft:
        (draft / "value.txt").write_text("half")
    assert (folder / "value.txt").read_text() == "one"


def test_no_room_is_one_message_and_nothing_is_lost(store):
    folder = store.folder("tape", "windows")
    publish(store, folder, "one")
    with pytest.raises(StoreError, match="No space left on device.*intact"), store.publish(folder):
        raise OSError(28, "No space left on device")
    assert (folder / "value.txt").read_text() == "one"


def test_a_process_that_died_between_the_renames_loses_nothing(store):
    folder = store.folder("tape", "windows")
    publish(store, folder, "one")
    folder.rename(folder.with_name(".windows.old"))
    assert store.made(folder) == Made("f1")
    assert (folder / "value.txt").read_text() == "one"


def test_what_a_killed_process_was_writing_is_removed_at_the_next_start(store):
    folder = store.folder("tape", "mlp_k01/predictions", "state")
    publish(store, folder, "one")
    gone, kept = subprocess.Popen(["true"]), os.getpid()
    gone.wait()
    for pid in (gone.pid, kept):
        (folder.parent / f".state.{pid}.draft").mkdir()
        (folder.parent / f".state.{pid}.draft" / "value.txt").write_text("half")
        (store.dataset("tape") / f".experiment.{pid}.draft.json").write_text("{")
    store.ensure()
    assert {p.name for p in folder.parent.iterdir()} == {"state", f".state.{kept}.draft"}
    assert {p.name for p in store.dataset("tape").glob(".*")} == {f".experiment.{kept}.draft.json"}
    assert store.is_fresh(folder, "f1")


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes anywhere; the file in the way below covers it")
def test_a_folder_without_permission_is_one_message(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(StoreError, match="cannot be written"):
        Store(tmp_path / "results").ensure()


def test_a_file_in_the_way_is_one_message(tmp_path):
    (tmp_path / "results").write_text("not a folder")
    with pytest.raises(StoreError, match="cannot be written to .* choose another folder with --store"):
        Store(tmp_path / "results").ensure()


def test_a_file_is_written_whole_or_not_at_all(tmp_path):
    path = tmp_path / "page.html"
    with drafted(path) as draft:
        assert draft.suffix == ".html", "what writes by the ending of a name still can"
        draft.write_text("one")
        assert not path.exists()
    with pytest.raises(ZeroDivisionError), drafted(path) as draft:
        draft.write_text(str(1 / 0))
    with pytest.raises(ValueError, match="Out of range float"):
        write_json(path, float("nan"))
    assert path.read_text() == "one"
    assert [p.name for p in tmp_path.iterdir()] == ["page.html"], "no drafts left behind"


def test_a_folder_is_written_whole_or_not_at_all(tmp_path):
    folder = tmp_path / "tape"
    folder.mkdir()
    with drafted_folder(folder) as draft:
        draft.mkdir()
        (draft / "value.txt").write_text("one")
    assert (folder / "value.txt").read_text() == "one"
    with pytest.raises(FileNotFoundError), drafted_folder(tmp_path / "other") as draft:
        shutil.copytree(folder, draft).joinpath("missing").rename(folder)
    with pytest.raises(OSError, match="not empty"), drafted_folder(folder) as draft:
        draft.mkdir()
    assert [p.name for p in tmp_path.iterdir()] == ["tape"], "no drafts left behind"
    assert (folder / "value.txt").read_text() == "one"


def test_keys_cannot_walk_out(store):
    for key in ("..", "a/../../b", "/etc"):
        with pytest.raises(ConfigError):
            store.folder(key, "windows")


def test_two_runs_of_one_data_set_do_not_mix(store):
    with store.lock("tape"), pytest.raises(StoreError, match="Another run is working on 'tape'"), store.lock("tape"):
        pass


def test_registered_experiments_come_back(store):
    assert store.experiments() == {}
    store.register("tape", {"name": "tape"})
    assert store.experiments() == {"tape": {"name": "tape"}}


def test_meter_sees_the_peak():
    before = psutil.Process().memory_info().rss / 1e6
    with Meter() as meter:
        block = bytearray(200_000_000)
        block[::4096] = b"x" * len(block[::4096])
        time.sleep(0.15)
        del block
    assert meter.peak_memory_mb > before + 150
    assert meter.seconds >= 0.15

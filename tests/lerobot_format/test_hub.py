"""Fetching from the Hub, against a small server on 127.0.0.1 that speaks its interface."""

import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import huggingface_hub
import pytest

from pipeline.errors import DatasetError, HubError
from pipeline.lerobot_format import hub as hub_module
from pipeline.lerobot_format.hub import current_commit, fetch, fetch_checkpoint, parse_repository
from pipeline.lerobot_format.read import load_source, read_dataset, source_stamp
from tests.makers import tiny_recording, write_v2, write_v3

from .hub_server import Fault, Hub, running_hub

NAME = "owner/tiny"


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    """An empty Hub and an empty cache, both only for this test."""
    with running_hub() as server:
        monkeypatch.setenv("HF_ENDPOINT", server.url)
        monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "cache"))
        monkeypatch.setenv("HF_TOKEN", "hf_secret_token")
        monkeypatch.setenv("HF_HUB_DISABLE_PROGRESS_BARS", "1")
        monkeypatch.delenv("HF_HUB_OFFLINE", raising=False)
        yield server


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A v3.0 data set with a video beside it."""
    folder = write_v3(tmp_path / "tiny", tiny_recording(6, 60), episodes_per_file=3)
    video = folder / "videos/observation.image/chunk-000/file-000.mp4"
    video.parent.mkdir(parents=True)
    video.write_bytes(b"not really a video" * 200)
    return folder


def unplug(monkeypatch: pytest.MonkeyPatch) -> None:
    """Point the endpoint at a port where nobody listens."""
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        port = closed.getsockname()[1]
    monkeypatch.setenv("HF_ENDPOINT", f"http://user:hunter2@127.0.0.1:{port}")


def load(source: str):
    return load_source(source, name="tiny", config_dir=Path())


def test_a_branch_is_resolved_to_its_commit_and_recorded(hub: Hub, folder: Path):
    commit = hub.push(NAME, folder)
    demonstrations = load(f"hub:{NAME}")
    assert demonstrations.revision == commit
    assert demonstrations.source == f"hub:{NAME}"
    assert demonstrations.content_hash == read_dataset(folder, name="other").content_hash
    assert demonstrations.warnings == ()


def test_only_meta_and_data_are_downloaded_unless_videos_are_asked_for(hub: Hub, folder: Path):
    hub.push(NAME, folder)
    copy = fetch(NAME)
    assert hub.files_asked_for()
    assert all(path.startswith(("meta/", "data/")) for path in hub.files_asked_for())
    assert not (copy.folder / "videos").exists()
    copy = fetch(NAME, videos=True)
    assert (copy.folder / "videos/observation.image/chunk-000/file-000.mp4").exists()


def test_a_tag_a_branch_and_a_commit_name_different_versions(hub: Hub, folder: Path, tmp_path: Path):
    old = hub.push(NAME, folder, branch="v1.0")
    newer = write_v2(tmp_path / "newer", tiny_recording(3, seed=1))
    new = hub.push(NAME, newer)
    assert load(f"hub:{NAME}@v1.0").revision == old
    assert load(f"hub:{NAME}@{old}").revision == old
    assert load(f"hub:{NAME}").revision == new
    assert load(f"hub:{NAME}").episodes == 3


def test_a_pinned_commit_that_is_in_the_cache_needs_no_network(hub: Hub, folder: Path, monkeypatch: pytest.MonkeyPatch):
    commit = hub.push(NAME, folder)
    first = load(f"hub:{NAME}@{commit}")
    unplug(monkeypatch)
    again = load(f"hub:{NAME}@{commit}")
    assert again.content_hash == first.content_hash
    assert again.warnings == ()


def test_out_of_reach_the_cached_copy_is_read_and_the_warning_says_so(
    hub: Hub, folder: Path, monkeypatch: pytest.MonkeyPatch
):
    commit = hub.push(NAME, folder)
    first = load(f"hub:{NAME}")
    unplug(monkeypatch)
    began = time.monotonic()
    again = load(f"hub:{NAME}")
    assert time.monotonic() - began < 10
    assert again.content_hash == first.content_hash
    assert again.revision == commit
    assert len(again.warnings) == 1
    assert "out of reach" in again.warnings[0]
    assert commit[:12] in again.warnings[0]


@pytest.mark.parametrize("offline", ["1", "true"])
def test_hf_hub_offline_reads_the_cache_and_asks_nobody(
    hub: Hub, folder: Path, monkeypatch: pytest.MonkeyPatch, offline: str
):
    hub.push(NAME, folder)
    load(f"hub:{NAME}")
    asked = len(hub.asked)
    monkeypatch.setenv("HF_HUB_OFFLINE", offline)
    assert "HF_HUB_OFFLINE" in load(f"hub:{NAME}").warnings[0]
    assert len(hub.asked) == asked


def test_out_of_reach_without_a_copy_is_one_message(hub: Hub, monkeypatch: pytest.MonkeyPatch):
    unplug(monkeypatch)
    began = time.monotonic()
    with pytest.raises(
        HubError, match=r"out of reach \(ConnectError\).*no whole copy of 'owner/tiny'.*[Cc]onnect"
    ) as caught:
        load(f"hub:{NAME}")
    assert time.monotonic() - began < 10
    assert "hunter2" not in str(caught.value)


def test_a_server_that_never_answers_is_given_up(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setattr(hub_module, "TIMEOUT_S", 0.3)
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path))
    with socket.create_server(("127.0.0.1", 0)) as silent:
        monkeypatch.setenv("HF_ENDPOINT", f"http://127.0.0.1:{silent.getsockname()[1]}")
        began = time.monotonic()
        with pytest.raises(HubError, match="ReadTimeout"):
            fetch(NAME)
        assert time.monotonic() - began < 5


def test_a_hub_that_is_broken_counts_as_out_of_reach(hub: Hub, folder: Path):
    hub.push(NAME, folder)
    fetch(NAME)
    hub.failure = 503
    assert "answered 503" in fetch(NAME).warnings[0]
    with pytest.raises(HubError, match="answered 503"):
        fetch("owner/another")


def test_a_download_that_breaks_off_is_not_taken_for_a_copy(hub: Hub, folder: Path, monkeypatch: pytest.MonkeyPatch):
    hub.push(NAME, folder)
    copy = fetch(NAME)
    (copy.folder / "data/chunk-000/file-001.parquet").unlink()
    unplug(monkeypatch)
    with pytest.raises(HubError, match="no whole copy"):
        fetch(NAME)
    with pytest.raises(HubError, match="no whole copy"):
        fetch(f"{NAME}@{copy.commit}")


def test_a_damaged_cache_is_completed_when_the_hub_is_there(hub: Hub, folder: Path):
    commit = hub.push(NAME, folder)
    shutil.rmtree(fetch(NAME).folder / "data")
    assert load(f"hub:{NAME}@{commit}").episodes == 6


def test_no_such_data_set(hub: Hub):
    with pytest.raises(HubError, match=r"no data set 'owner/tiny'.*hf auth login") as caught:
        fetch(NAME)
    assert hub.tokens == ["Bearer hf_secret_token"] * len(hub.tokens)
    assert hub.tokens
    assert "hf_secret" not in str(caught.value)


def test_no_such_revision(hub: Hub, folder: Path):
    hub.push(NAME, folder)
    with pytest.raises(HubError, match=r"no revision 'v9'.*branch, a tag or a commit"):
        fetch(f"{NAME}@v9")


def test_gated(hub: Hub, folder: Path):
    hub.push(NAME, folder)
    hub.repositories[NAME].gated = True
    with pytest.raises(HubError, match="accept terms"):
        fetch(NAME)


def test_no_room(hub: Hub, folder: Path, monkeypatch: pytest.MonkeyPatch):
    hub.push(NAME, folder)
    monkeypatch.setattr(hub_module.shutil, "disk_usage", lambda path: shutil._ntuple_diskusage(10, 9, 1))
    with pytest.raises(HubError, match="Make room, or set HF_HOME"):
        fetch(NAME)
    assert hub.files_asked_for() == []


def test_something_that_is_not_a_lerobot_data_set(hub: Hub, tmp_path: Path):
    (tmp_path / "text/data").mkdir(parents=True)
    (tmp_path / "text/data/words.txt").write_text("words")
    hub.push(NAME, tmp_path / "text")
    with pytest.raises(DatasetError, match="not a LeRobot data set"):
        load(f"hub:{NAME}")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "name",
        "a/b/c",
        "owner/name@",
        "owner/na me",
        "../x",
        "owner/..",
        "owner/n@a b",
        "o/n@../x",
        "o/n@-x",
        "http://x/y",
    ],
)
def test_names_that_are_not_names(text: str):
    with pytest.raises(HubError, match="owner/name@revision"):
        parse_repository(text)


def test_names():
    assert parse_repository("lerobot/pusht") == ("lerobot/pusht", None)
    assert parse_repository("a/b_c.d-e@refs/pr/3") == ("a/b_c.d-e", "refs/pr/3")


def test_the_stamp_is_the_commit_now_and_the_cached_one_out_of_reach(
    hub: Hub, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    old = hub.push(NAME, folder)
    load(f"hub:{NAME}")
    stamp = source_stamp(f"hub:{NAME}", Path())
    assert stamp == {"kind": "hub", "repository": NAME, "revision": None, "commit": old}
    assert source_stamp(f"hub:{NAME}@{old}", Path())["commit"] == old
    new = hub.push(NAME, write_v2(tmp_path / "newer", tiny_recording(3, seed=1)))
    assert source_stamp(f"hub:{NAME}", Path())["commit"] == new
    unplug(monkeypatch)
    assert source_stamp(f"hub:{NAME}", Path()) == stamp
    assert current_commit("owner/another", None) is None


def test_a_folder_inside_the_cache_can_be_given_as_a_folder(hub: Hub, folder: Path):
    hub.push(NAME, folder)
    assert load(str(fetch(NAME).folder)).episodes == 6


@pytest.mark.parametrize("address", ["nowhere", "ftp://host", "http://host:port", "http://user:hunter2@"])
def test_an_endpoint_that_is_no_address(hub: Hub, monkeypatch: pytest.MonkeyPatch, address: str):
    monkeypatch.setenv("HF_ENDPOINT", address)
    with pytest.raises(HubError, match="HF_ENDPOINT is not the address of a Hub") as caught:
        fetch(NAME)
    assert "hunter2" not in str(caught.value)


# What goes wrong on the way -------------------------------------------------------------------------------------------


@pytest.fixture
def no_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hub_module, "FIRST_WAIT_S", 0.01)


def test_a_file_that_breaks_off_is_resumed_where_it_did(hub: Hub, folder: Path, no_pause):
    hub.push(NAME, folder)
    hub.faults.append(Fault("GET /blobs", cut=700))
    expected = read_dataset(folder, name="tiny").content_hash
    assert load(f"hub:{NAME}").content_hash == expected
    assert not hub.faults
    assert sum("GET /blobs" in line for line in hub.asked) == 1 + len(
        {line for line in hub.asked if "GET /blobs" in line}
    )


@pytest.mark.parametrize("status", [500, 502, 408])
def test_a_server_that_stumbles_is_asked_again(hub: Hub, folder: Path, no_pause, status: int):
    hub.push(NAME, folder)
    hub.faults += [Fault("GET /blobs", status=status), Fault("GET /datasets", status=status)]
    assert load(f"hub:{NAME}").episodes == 6
    assert not hub.faults


def test_a_server_that_stays_broken_is_given_up_and_nothing_is_taken_for_a_copy(hub: Hub, folder: Path, no_pause):
    hub.push(NAME, folder)
    hub.faults += [Fault("GET /blobs", status=500) for _ in range(50)]
    with pytest.raises(HubError, match=r"out of reach \(it answered 500\), and there is no whole copy"):
        load(f"hub:{NAME}")
    assert len(hub.faults) > 30, "attempts are few"
    hub.faults.clear()
    assert load(f"hub:{NAME}").episodes == 6


def test_a_hub_that_asks_for_a_moment_gets_it(hub: Hub, folder: Path, no_pause):
    hub.push(NAME, folder)
    hub.faults.append(Fault("GET /blobs", status=429, headers={"Retry-After": "0"}))
    began = time.monotonic()
    assert load(f"hub:{NAME}").episodes == 6
    assert time.monotonic() - began < 10


def test_a_hub_that_asks_for_an_hour_is_out_of_reach(hub: Hub, folder: Path, no_pause):
    hub.push(NAME, folder)
    hub.faults += [Fault("GET /blobs", status=429, headers={"Retry-After": "3600"}) for _ in range(20)]
    began = time.monotonic()
    with pytest.raises(HubError, match=r"out of reach \(it asks for a pause of 3,600 s\)"):
        load(f"hub:{NAME}")
    assert time.monotonic() - began < 10


def test_a_file_that_does_not_come_is_asked_for_again_and_then_given_up(
    hub: Hub, folder: Path, no_pause, monkeypatch: pytest.MonkeyPatch
):
    hub.push(NAME, folder)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_DOWNLOAD_TIMEOUT", 0.2)
    monkeypatch.setattr(hub_module, "ATTEMPTS", 1)
    hub.faults += [Fault("GET /blobs", stall_s=0.6) for _ in range(60)]
    began = time.monotonic()
    with pytest.raises(HubError, match=r"out of reach \(ReadTimeout\)"):
        load(f"hub:{NAME}")
    assert time.monotonic() - began < 30
    del hub.faults[1:]
    assert load(f"hub:{NAME}").episodes == 6


@pytest.mark.parametrize("where", ["GET /blobs", "GET /datasets"])
def test_bytes_that_are_not_those_of_the_hash_are_fetched_again(hub: Hub, folder: Path, no_pause, where: str):
    hub.push(NAME, folder)
    hub.faults.append(Fault(where, change=lambda content: bytes(len(content))))
    expected = read_dataset(folder, name="tiny").content_hash
    assert load(f"hub:{NAME}").content_hash == expected
    assert not hub.faults


def test_bytes_that_never_are_those_of_the_hash_are_refused_and_not_kept(hub: Hub, folder: Path, no_pause):
    hub.push(NAME, folder)
    hub.faults += [Fault("GET /blobs", change=lambda content: content[::-1]) for _ in range(20)]
    with pytest.raises(HubError, match=r"sent '.*' of 'owner/tiny' 3 times with other bytes than its own hash"):
        load(f"hub:{NAME}")
    hub.faults.clear()
    assert load(f"hub:{NAME}").episodes == 6


def test_a_branch_that_moves_in_the_middle_gives_one_commit(hub: Hub, folder: Path, tmp_path: Path):
    old = hub.push(NAME, folder)
    newer = write_v3(tmp_path / "newer", tiny_recording(6, 60, seed=5), episodes_per_file=3)
    hub.faults.append(Fault("/resolve/", then=lambda: hub.push(NAME, newer)))
    first = load(f"hub:{NAME}")
    assert not hub.faults
    assert (first.revision, first.content_hash) == (old, read_dataset(folder, name="tiny").content_hash)
    second = load(f"hub:{NAME}")
    assert second.revision != old
    assert second.content_hash == read_dataset(newer, name="tiny").content_hash


def test_a_listed_file_that_is_not_there(hub: Hub, folder: Path, no_pause):
    hub.push(NAME, folder)
    hub.faults += [Fault("HEAD /datasets", status=404, headers={"X-Error-Code": "EntryNotFound"}) for _ in range(20)]
    with pytest.raises(HubError, match="lists a file of 'owner/tiny' that it does not have"):
        load(f"hub:{NAME}")


@pytest.mark.parametrize("status", [401, 403])
def test_access_refused(hub: Hub, folder: Path, no_pause, status: int):
    hub.push(NAME, folder)
    hub.faults.append(Fault("/api/datasets", status=status))
    with pytest.raises(HubError, match="hf auth login") as caught:
        load(f"hub:{NAME}")
    assert "hf_secret" not in str(caught.value)


def test_a_private_data_set_with_the_token_from_its_file(hub: Hub, folder: Path, tmp_path: Path, monkeypatch, caplog):
    hub.push(NAME, folder)
    monkeypatch.delenv("HF_TOKEN")
    home = tmp_path / "home"
    home.mkdir()
    (home / "token").write_text("hf_token_in_a_file")
    script = "from pathlib import Path; from pipeline.lerobot_format.read import load_source;"
    script += f"print(load_source('hub:{NAME}', name='tiny', config_dir=Path()).episodes)"
    environment = {**os.environ, "HF_HOME": str(home), "HF_HUB_CACHE": str(tmp_path / "cache"), "HF_DEBUG": "1"}
    ran = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True)
    assert ran.stdout.strip().endswith("6")
    assert "Bearer hf_token_in_a_file" in hub.tokens
    assert "hf_token_in_a_file" not in ran.stdout + ran.stderr


# Checkpoints -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    """The files of a policy as LeRobot pushes it, and some that nobody needs to predict with it."""
    folder = tmp_path / "policy"
    for name in ("config.json", "train_config.json", "policy_preprocessor.json", "policy_postprocessor.json"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("{}")
    for name in ("model.safetensors", "policy_preprocessor_step_3_normalizer_processor.safetensors"):
        (folder / name).write_bytes(b"weights " * 400)
    (folder / "README.md").write_text("a policy")
    (folder / "training_state").mkdir()
    (folder / "training_state/optimizer_state.safetensors").write_bytes(b"moments " * 400)
    return folder


def test_a_checkpoint_comes_with_what_it_is_asked_with_and_nothing_else(hub: Hub, checkpoint: Path, monkeypatch):
    commit = hub.push("me/act", checkpoint)
    copy = fetch_checkpoint("me/act@main")
    assert copy.commit == commit
    names = {path.name for path in checkpoint.iterdir() if path.is_file()} - {"README.md"}
    assert {path.relative_to(copy.folder).as_posix() for path in copy.folder.rglob("*") if path.is_file()} == names
    assert all((copy.folder / name).read_bytes() == (checkpoint / name).read_bytes() for name in names)
    unplug(monkeypatch)
    assert fetch_checkpoint(f"me/act@{commit}") == copy, "a commit that is whole in the cache needs no network"
    (warning,) = fetch_checkpoint("me/act").warnings
    assert "out of reach" in warning


def test_a_checkpoint_whose_bytes_are_not_those_of_its_hash_is_fetched_again(hub: Hub, checkpoint: Path, no_pause):
    hub.push("me/act", checkpoint)
    hub.faults.append(Fault("/blobs/", change=lambda content: b"x" * len(content)))
    copy = fetch_checkpoint("me/act")
    assert (copy.folder / "model.safetensors").read_bytes() == (checkpoint / "model.safetensors").read_bytes()


def test_no_such_checkpoint_and_a_repository_that_is_none(hub: Hub, folder: Path):
    with pytest.raises(HubError, match="shows no checkpoint 'me/nothing'"):
        fetch_checkpoint("me/nothing")
    with pytest.raises(HubError, match="does not name a checkpoint on the Hub"):
        fetch_checkpoint("nothing")
    hub.push("me/tape", folder)
    with pytest.raises(
        HubError, match=r"'hub:me/tape' holds no config\.json, so it is no checkpoint that LeRobot saved"
    ):
        fetch_checkpoint("me/tape")

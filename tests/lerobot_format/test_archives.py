"""Data sets in a .zip: the same demonstrations as in the folder, unpacked once; what is hostile or damaged is refused, and
nothing of it stays.
"""

import shutil
import stat
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.errors import DatasetError
from pipeline.lerobot_format import archives
from pipeline.lerobot_format.archives import cache_folder, unpacked
from pipeline.lerobot_format.read import load_source, read_dataset, source_folder, source_stamp


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of the test's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return cache_folder()


def packed(archive: Path, folder: Path, inside: str = "", method: int = zipfile.ZIP_DEFLATED) -> Path:
    """The files of a folder under the names that they have in it, behind `inside`."""
    with zipfile.ZipFile(archive, "a", method) as file:
        for path in sorted(path for path in folder.rglob("*") if path.is_file()):
            file.write(path, inside + path.relative_to(folder).as_posix())
    return archive


def with_member(archive: Path, name: str | zipfile.ZipInfo, content: bytes = b"x") -> Path:
    with zipfile.ZipFile(archive, "a") as file:
        file.writestr(name, content)
    return archive


@pytest.fixture
def archive(tmp_path: Path, v3: Path) -> Path:
    return packed(tmp_path / "set.zip", v3)


@pytest.fixture
def refusal(cache: Path, tmp_path: Path) -> Callable[[Path], str]:
    """What unpacking says: on one line, with the archive's path, and nothing is left behind anywhere."""

    def refuse(archive: Path) -> str:
        before = {path for path in tmp_path.rglob("*") if path not in (cache, *cache.parents)}
        with pytest.raises(DatasetError) as caught:
            unpacked(archive)
        text = str(caught.value)
        assert text.startswith(str(archive))
        assert "\n" not in text
        assert {path for path in tmp_path.rglob("*") if path not in (cache, *cache.parents)} == before
        return text

    return refuse


# Read


@pytest.mark.parametrize("inside", ["", "set/", "my data/"])
@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA])
def test_an_archive_is_its_folder(tmp_path: Path, v3: Path, inside: str, method: int):
    packed(tmp_path / "My Set.ZIP", v3, inside, method)
    read = load_source("My Set.ZIP", name="set", config_dir=tmp_path)
    assert read.content_hash == read_dataset(v3, name="set").content_hash
    assert read.source == "My Set.ZIP"
    assert read.warnings == ()


def test_what_others_put_beside_the_data_set_does_no_harm(archive: Path, tmp_path: Path, v3: Path):
    for name in ("__MACOSX/meta/._info.json", ".DS_Store", "README.md", "logs/2026-01-31T12:00:00.txt"):
        with_member(archive, name)
    assert load_source("set.zip", name="set", config_dir=tmp_path).episodes == 4


def test_it_is_unpacked_once_and_again_when_it_changes(archive: Path, cache: Path, v3: Path):
    first = unpacked(archive)
    made = (first / "meta/info.json").stat()
    assert unpacked(archive) == first
    assert (first / "meta/info.json").stat() == made
    moved = shutil.copy(archive, archive.parent / "copy.zip")
    assert unpacked(moved) == first  # by its content, not its name
    with_member(archive, "notes.txt")
    assert unpacked(archive) != first
    assert len(list(cache.iterdir())) == 2


def test_the_source_is_stale_when_the_archive_changes(archive: Path, tmp_path: Path, cache: Path):
    stamp = source_stamp("set.zip", tmp_path)
    assert source_stamp("set.zip", tmp_path) == stamp
    assert not cache.exists()  # asking does not unpack
    with_member(archive, "notes.txt")
    assert source_stamp("set.zip", tmp_path) != stamp


def test_a_folder_that_is_called_zip_is_a_folder(tmp_path: Path, v3: Path, cache: Path):
    v3.rename(tmp_path / "folder.zip")
    assert source_folder("folder.zip", tmp_path) == tmp_path / "folder.zip"
    assert not cache.exists()


# Names that lead elsewhere


@pytest.mark.parametrize(
    "name",
    ["../outside.txt", "data/../../outside.txt", "/tmp/outside.txt", "//host/outside.txt", "..\\outside.txt", "C:\\outside.txt",
     "C:outside.txt", "\\outside.txt", "data/.."],
)  # fmt: skip
def test_a_name_that_leads_out(refusal, archive: Path, name: str):
    entry = zipfile.ZipInfo("placeholder")
    entry.filename = name  # as it stands, also where the constructor would tidy it
    text = refusal(with_member(archive, entry))
    assert "which leads out of the archive or is no plain file, so nothing of it was unpacked" in text


@pytest.mark.parametrize("kind", [stat.S_IFLNK, stat.S_IFIFO, stat.S_IFCHR, stat.S_IFBLK, stat.S_IFSOCK])
def test_an_entry_that_is_no_plain_file(refusal, archive: Path, kind: int):
    entry = zipfile.ZipInfo("data/link")
    entry.external_attr = (kind | 0o777) << 16
    assert "holds 'data/link', which leads out of the archive or is no plain file" in refusal(
        with_member(archive, entry, b"/etc/passwd")
    )


# Sizes


def test_a_bomb(refusal, archive: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(archives, "SMALL", 1000)
    with zipfile.ZipFile(archive, "a", zipfile.ZIP_DEFLATED) as file:
        file.writestr("data/zeros", bytes(30_000_000))
    text = refusal(archive)
    assert "would unpack to 0.0 GB" in text
    assert "times its own size, so nothing of it was unpacked. Unpack it yourself if you trust it" in text


def test_a_size_that_the_directory_only_claims(refusal, archive: Path):
    """Refused by what it claims; an entry that claims too little is cut off there, and its checksum differs."""
    content = bytearray(archive.read_bytes())
    entry = content.index(b"PK\x01\x02")
    struct.pack_into("<I", content, entry + 24, 2**31)
    archive.write_bytes(content)
    assert "would unpack to 2.0 GB" in refusal(archive)
    struct.pack_into("<I", content, entry + 24, 3)
    archive.write_bytes(content)
    assert "cannot be read as a zip (Bad CRC-32" in refusal(archive)


def test_more_files_than_a_data_set_has(refusal, archive: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(archives, "MOST_FILES", 3)
    assert "in 5 files" in refusal(archive)


def test_no_room(refusal, archive: Path, monkeypatch: pytest.MonkeyPatch, cache: Path):
    full = shutil.disk_usage("/")._replace(free=100)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: full)
    text = refusal(archive)
    assert f"GB are free in {cache}. Make room, or set XDG_CACHE_HOME" in text


def test_a_cache_that_cannot_be_written(archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.raises(
        DatasetError, match="cannot be unpacked into .*: Not a directory. Make room, or set XDG_CACHE_HOME"
    ):
        unpacked(archive)


# Damage


@pytest.mark.parametrize("keep", [0, 10, -1, -30, -200])
def test_an_archive_that_is_cut_off(refusal, archive: Path, keep: int):
    archive.write_bytes(archive.read_bytes()[:keep])
    assert "cannot be read as a zip" in refusal(archive)


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_garbage_in_the_middle(refusal, tmp_path: Path, v3: Path, method: int):
    archive = packed(tmp_path / "set.zip", v3, method=method)
    content = bytearray(archive.read_bytes())
    with zipfile.ZipFile(archive) as file:
        largest = max(file.infolist(), key=lambda member: member.compress_size)
    begin = largest.header_offset + 30 + len(largest.filename)
    content[begin + 10 : begin + 60] = b"\xff" * 50
    archive.write_bytes(content)
    assert "cannot be read as a zip" in refusal(archive)


def test_an_archive_with_a_password(refusal, archive: Path):
    content = bytearray(archive.read_bytes())
    for mark, flags in ((b"PK\x01\x02", 8), (b"PK\x03\x04", 6)):
        content[content.index(mark) + flags] |= 1
    archive.write_bytes(content)
    assert "password" in refusal(archive)


def test_something_else_that_is_called_zip(refusal, tmp_path: Path):
    (tmp_path / "set.zip").write_text("not at all")
    assert "cannot be read as a zip (File is not a zip file). Copy or download it again." in refusal(
        tmp_path / "set.zip"
    )


def test_a_file_and_a_folder_of_one_name(refusal, archive: Path):
    assert "cannot be unpacked" in refusal(with_member(with_member(archive, "x"), "x/y"))


# What is in it


def test_no_data_set(refusal, tmp_path: Path, v3: Path):
    archive = packed(tmp_path / "other.zip", v3, "one/two/")
    assert "holds no meta/info.json, at its top or one folder down; expected one LeRobot data set" in refusal(archive)


def test_an_empty_archive(refusal, tmp_path: Path):
    zipfile.ZipFile(tmp_path / "empty.zip", "w").close()
    assert "holds no meta/info.json" in refusal(tmp_path / "empty.zip")


@pytest.mark.parametrize("other", ["", "another/"])
def test_two_data_sets(refusal, tmp_path: Path, v3: Path, other: str):
    archive = packed(packed(tmp_path / "two.zip", v3, "one/"), v3, other)
    assert "holds 2 folders with meta/info.json" in refusal(archive)


def test_an_interruption_leaves_nothing(archive: Path, cache: Path, monkeypatch: pytest.MonkeyPatch):
    real = zipfile.ZipFile.extract

    def interrupted(self, member, path):
        real(self, member, path)
        raise KeyboardInterrupt

    monkeypatch.setattr(zipfile.ZipFile, "extract", interrupted)
    with pytest.raises(KeyboardInterrupt):
        unpacked(archive)
    assert list(cache.iterdir()) == []

"""A data set that came as a .zip: unpacked once into a cache, by its content.

What belongs here: the distrust of an archive's names and sizes. What does not: what is in it (layout.py).
"""

import hashlib
import lzma
import os
import shutil
import stat
import tempfile
import zipfile
import zlib
from pathlib import Path, PureWindowsPath

from pipeline.errors import DatasetError

MOST_FILES, MOST_TIMES, SMALL = 500_000, 200, 2**30
"""Files in an archive; and how many times its own size it may unpack to, from a gigabyte on (JSON packs to a twentieth)."""
INFO = "meta/info.json"


def is_archive(path: Path) -> bool:
    """Whether a source is an archive rather than a folder."""
    return path.suffix.lower() == ".zip" and path.is_file()


def cache_folder() -> Path:
    """Where unpacked archives are kept: XDG_CACHE_HOME, else ~/.cache, /demobench/archives."""
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "demobench" / "archives"


def unpacked(path: Path) -> Path:
    """The data set's folder in the unpacked copy of an archive, made where it is not there yet.

    Raises:
        DatasetError: it is no zip or damaged, holds no data set or a name that leads out of it, or unpacks to too much.
    """
    kept = cache_folder() / _digest(path)[:32]
    if not kept.exists():
        try:
            _unpack(path, kept)
        except (zipfile.BadZipFile, EOFError, RuntimeError, ValueError, zlib.error, lzma.LZMAError) as error:
            raise _damaged(path, error) from None
        except OSError as error:
            if error.errno is None:  # what bz2 says of a damaged stream
                raise _damaged(path, error) from None
            raise DatasetError(
                f"{path} cannot be unpacked into {kept.parent}: {error.strerror or error}. Make room, or set XDG_CACHE_HOME to "
                "another folder."
            ) from None
    return _home(path, kept)


def _damaged(path: Path, error: Exception) -> DatasetError:
    return DatasetError(f"{path} cannot be read as a zip ({error}). Copy or download it again.")


def _digest(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error.strerror or error}.") from None


def _home(path: Path, folder: Path) -> Path:
    """Where the one data set is in the unpacked archive."""
    inner = [folder, *(child for child in sorted(folder.iterdir()) if child.is_dir())]
    found = [place for place in inner if (place / INFO).exists()]
    if len(found) != 1:
        what = "no" if not found else f"{len(found)} folders with"
        raise DatasetError(
            f"{path} holds {what} {INFO}, at its top or one folder down; expected one LeRobot data set. Pack the folder that holds "
            "meta/, data/ and videos/."
        )
    return found[0]


def _unpack(path: Path, kept: Path) -> None:
    """Into a folder beside `kept`, which is renamed once it is seen to hold a data set."""
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        _check(path, members)
        kept.parent.mkdir(parents=True, exist_ok=True)
        _check_room(path, sum(member.file_size for member in members), kept.parent)
        draft = Path(tempfile.mkdtemp(prefix=".unpacking-", dir=kept.parent))
        try:
            for member in members:
                archive.extract(member, draft)  # reads no more than the size that was checked, and compares the CRC
            _home(path, draft)
            if not kept.exists():
                draft.rename(kept)
        finally:
            shutil.rmtree(draft, ignore_errors=True)


def _check(path: Path, members: list[zipfile.ZipInfo]) -> None:
    """Names stay inside, are files or folders, and do not unpack to more than an honest archive does."""
    for member in members:
        name = PureWindowsPath(member.filename)  # both kinds of slash divide it
        kind = stat.S_IFMT(member.external_attr >> 16)
        if name.anchor or ".." in name.parts or kind not in (0, stat.S_IFREG, stat.S_IFDIR):
            raise DatasetError(
                f"{path} holds '{member.filename}', which leads out of the archive or is no plain file, so nothing of it was "
                "unpacked. Pack the data set's folder again, without links."
            )
    size, packed = sum(member.file_size for member in members), max(1, path.stat().st_size)
    if len(members) > MOST_FILES or size > max(SMALL, MOST_TIMES * packed):
        raise DatasetError(
            f"{path} would unpack to {size / 2**30:.1f} GB in {len(members):,} files, {size // packed:,} times its own size, so "
            "nothing of it was unpacked. Unpack it yourself if you trust it, and give the folder."
        )


def _check_room(path: Path, size: int, folder: Path) -> None:
    free = shutil.disk_usage(folder).free
    if size > 0.9 * free:
        raise DatasetError(
            f"{path} unpacks to {size / 2**30:.1f} GB, and {free / 2**30:.1f} GB are free in {folder}. Make room, or set "
            "XDG_CACHE_HOME to a folder on a larger disk."
        )

"""Files of a folder that somebody else wrote: paths that stay inside it, JSON and parquet opened with clear errors.

What belongs here: the distrust. What does not: what the files mean (layout.py, frames.py).
"""

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from string import Formatter
from typing import TYPE_CHECKING, Any

from pipeline.errors import DatasetError

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

MAX_TEXT_BYTES = 256 * 2**20
"""The largest JSON file that is read: a million episodes take about half of it."""

READ_BYTES = 2**20
"""Bytes of a parquet column that are read at once; else a whole row group's would be in memory beside the numbers."""

_HALF_PAIR = re.compile(r"\\u[dD][89a-fA-F]")
_SPEC = re.compile(r"(0?\d{1,2}d?)?")


def fill(template: str, values: Mapping[str, int | str]) -> str:
    """`template` with its `{field}`s replaced. Only plain fields that `values` has, with specs such as `03d`.

    `str.format` would follow attributes and take any width, so a template from a file never reaches it.
    """
    parts = []
    try:
        pieces = list(Formatter().parse(template))
    except ValueError as error:
        raise DatasetError(f"meta/info.json: the path '{template}' is not a template: {error}.") from None
    for text, field, spec, conversion in pieces:
        parts.append(text)
        if field is None:
            continue
        if field not in values or conversion or not _SPEC.fullmatch(spec or ""):
            known = ", ".join(values)
            raise DatasetError(
                f"meta/info.json: the path '{template}' uses '{{{field}}}' in a way that is not known. Known: {known}."
            )
        parts.append(format(values[field], spec or ""))
    return "".join(parts)


def inside(folder: Path, relative: str) -> Path:
    """The path of a file of the data set.

    Raises:
        DatasetError: the path, or what it links to, lies outside the folder.
    """
    path = folder / relative
    pure = Path(relative)
    outside = pure.is_absolute() or ".." in pure.parts or "\0" in relative
    if outside or not _resolves_into(path, _home(folder)):
        raise DatasetError(
            f"{folder}: '{relative}' leads out of the data set's folder, so it is not read. "
            "Put the files inside the folder (links that leave it do not count) and correct meta/info.json."
        )
    return path


def _resolves_into(path: Path, home: Path) -> bool:
    try:
        return path.resolve().is_relative_to(home)
    except (OSError, RuntimeError):  # links that go round in a circle
        return False


def _home(folder: Path) -> Path:
    """Where the folder's files may really lie: in it, or, for a snapshot in the Hub's cache, among its blobs."""
    real = folder.resolve()
    repository = real.parent.parent
    if real.parent.name == "snapshots" and (repository / "blobs").is_dir():
        return repository
    return real


def read_json(folder: Path, relative: str) -> Any:
    """One JSON document of the data set."""
    text = _read_text(folder, relative)
    try:
        return _parse(text)
    except (ValueError, RecursionError) as error:
        raise DatasetError(
            f"{folder / relative} is not JSON ({error}). The file is damaged: copy the data set again."
        ) from None


def read_json_lines(folder: Path, relative: str) -> list[dict[str, Any]]:
    """The objects of a .jsonl file of the data set."""
    rows = []
    for number, line in enumerate(_read_text(folder, relative).split("\n"), start=1):
        if not line.strip():
            continue
        try:
            row = _parse(line)
        except (ValueError, RecursionError):
            row = None
        if not isinstance(row, dict):
            raise DatasetError(
                f"{folder / relative}, line {number}: expected a JSON object, got {line[:60]!r}. "
                "The file is damaged: copy the data set again."
            )
        rows.append(row)
    return rows


def _parse(text: str) -> Any:
    """JSON; half of a surrogate pair, which it can escape and nothing can write, becomes a question mark."""
    value = json.loads(text)
    if _HALF_PAIR.search(text):
        value = json.loads(json.dumps(value, ensure_ascii=False).encode(errors="replace"))
    return value


def _read_text(folder: Path, relative: str) -> str:
    path = inside(folder, relative)
    try:
        size = path.stat().st_size
        if size > MAX_TEXT_BYTES:
            raise DatasetError(f"{path} holds {size:,} bytes; at most {MAX_TEXT_BYTES:,} are read.")
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise DatasetError(f"{path} is missing, so {folder} is not a whole LeRobot data set.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path} cannot be read: {error}.") from None


def stamp_of_file(path: Path) -> dict[str, Any]:
    """What changes when a file that the user named does, found without reading it (JSON-able).

    Raises:
        OSError: it is not there.
    """
    stat = path.stat()
    return {"path": str(path.resolve()), "bytes": stat.st_size, "modified_ns": stat.st_mtime_ns}


def open_parquet(folder: Path, relative: str) -> "pq.ParquetFile":
    """A parquet file of the data set, its footer read and nothing else."""
    path = inside(folder, relative)
    if not path.exists():
        raise DatasetError(
            f"{path} is missing, though the data set's own lists name it. Copy or download the data set again."
        )
    return open_outside(path)


def open_outside(path: Path) -> "pq.ParquetFile":
    """A parquet file that the user named, its footer read and nothing else."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return pq.ParquetFile(path, buffer_size=READ_BYTES, pre_buffer=False)
    except FileNotFoundError:
        raise DatasetError(f"There is no file {path}. Correct its path, or write the file.") from None
    except (pa.ArrowException, OSError) as error:
        raise DatasetError(f"{path} {damage(error)}") from None


def read_table(folder: Path, relative: str, keep: Callable[[str], bool] = lambda name: True) -> "pa.Table":
    """A small parquet file (metadata): the columns whose name `keep` approves."""
    import pyarrow as pa

    with open_parquet(folder, relative) as file:
        wanted = [name for name in file.schema_arrow.names if keep(name)]
        try:
            return file.read(columns=wanted, use_threads=False)
        except (pa.ArrowException, OSError) as error:
            raise DatasetError(f"{folder / relative} {damage(error)}") from None


def damage(error: Exception) -> str:
    """What is wrong with a parquet file, after its path."""
    reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
    return (
        f"cannot be read as parquet: it is cut off or damaged. Copy the data set again. (parquet says: {reason[:160]})"
    )

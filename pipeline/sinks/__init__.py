"""Files that people open: recordings, charts and the page. Sinks write what they are given; they compute no numbers.

`replacing` is the one way a sink puts a file in its place: written whole beside it, then renamed.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pipeline.errors import StoreError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside `path`; when the block ends well it takes the place of `path`, else it is removed.

    Raises:
        StoreError: the folder cannot be created or the file cannot be written.
    """
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise StoreError(
            f"{path} cannot be written: {error.strerror or error}. Free some space or choose another folder with "
            "--store."
        ) from error
    finally:
        with suppress(OSError):
            temporary.unlink()

"""Files that people open: recordings, charts and the page. Sinks write what they are given; they compute no numbers.

`replacing` is the one way a sink puts a file in its place: written whole beside it, then renamed.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pipeline.errors import StoreError
from pipeline.store import drafted


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside `path`; when the block ends well it takes the place of `path`, else it is removed.

    Raises:
        StoreError: the folder cannot be created or the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with drafted(path) as temporary:
            yield temporary
    except OSError as error:
        raise StoreError(
            f"{path} cannot be written: {error.strerror or error}. Free some space or choose another folder with "
            "--store."
        ) from error

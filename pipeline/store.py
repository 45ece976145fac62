"""Results on disk: one folder a result, written whole or not at all, each with a `made.json` that says what it was made from.

    results/
      dagster/                      the Dagster instance (DAGSTER_HOME)
      mlflow.db  mlartifacts/       the MLflow store, when it is a file
      mlflow_unsent/                what MLflow has not been told yet
      datasets/<key>/               one folder for each data set × settings ("partition")
        experiment.json             source and settings, as registered
        demonstrations/ episode_split/ windows/ multimodality_floor/ benchmark_table/ …
        <policy>/trained_policy/<observations>/ …

What belongs here: paths, fingerprints, atomic replacement, locks. What does not: what the files inside mean.
"""

import json
import os
import re
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from pipeline.config import check_slug
from pipeline.errors import StoreError

MADE = "made.json"
EXPERIMENT = "experiment.json"
DRAFT = re.compile(r"\..+\.([0-9]+)\.draft(\.\w+)?")
"""What is being written is called `.<name>.<process>.draft`, and of a file how it ends."""
LEAST_FREE_MB = 100
"""Below this much free space no run is started: the databases of Dagster and MLflow alone take tens of MB."""


@dataclass(frozen=True)
class Made:
    """What `made.json` holds: the fingerprint of a result, what it cost, and a summary small enough to read often."""

    fingerprint: str
    seconds: float = 0.0
    peak_memory_mb: float = 0.0
    summary: Mapping[str, Any] = field(default_factory=dict)


class Store:
    """A folder of results. Readers see a result complete or not at all.

    Raises:
        StoreError: the folder cannot be created or written to.
    """

    def __init__(self, root: Path):
        self.root = Path(root).expanduser().absolute()

    def ensure(self) -> "Store":
        """Create the folder, check that it can be written to before any work is done, and remove what killed processes left."""
        try:
            self.root.mkdir(parents=True, exist_ok=True)
            probe = self.root / f".probe-{os.getpid()}"
            probe.write_bytes(b"x")
            probe.unlink()
            free_mb = shutil.disk_usage(self.root).free / 1e6
        except OSError as error:
            raise StoreError(
                f"Results cannot be written to {self.root}: {error.strerror or error}. "
                "Free some space or choose another folder with --store."
            ) from None
        if free_mb < LEAST_FREE_MB:
            raise StoreError(
                f"There is no room for results at {self.root}: {free_mb:.0f} MB are free, and a benchmark needs at least "
                f"{LEAST_FREE_MB}. Free some space or choose another folder with --store."
            )
        self._sweep()
        return self

    def _sweep(self) -> None:
        """Remove the drafts of processes that are gone: one that is killed cannot clean up behind itself."""
        import psutil

        for place in (self.root / "datasets", self.root / "mlflow_unsent"):
            for folder, folders, files in os.walk(place):
                for name in (*folders, *files):
                    found = DRAFT.fullmatch(name)
                    if found and not psutil.pid_exists(int(found[1])):
                        left = Path(folder) / name
                        with suppress(OSError):
                            shutil.rmtree(left) if left.is_dir() else left.unlink()

    def dataset(self, key: str) -> Path:
        """The folder of one partition. The key is checked, so that no name can walk out of the store."""
        return self.root / "datasets" / check_slug(key, "data set key")

    def folder(self, key: str, asset: str, entry: str = "") -> Path:
        """The folder of one result: `asset` may have a policy before a slash; `entry` is an observation set, or empty."""
        return self.dataset(key).joinpath(*asset.split("/"), *([entry] if entry else []))

    def made(self, folder: Path) -> Made | None:
        """What made a result, or None where there is none (or none that can be read)."""
        self._mend(folder)
        try:
            return Made(**json.loads((folder / MADE).read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            return None

    def is_fresh(self, folder: Path, fingerprint: str) -> bool:
        made = self.made(folder)
        return made is not None and made.fingerprint == fingerprint

    @contextmanager
    def publish(self, folder: Path) -> Iterator[Path]:
        """A new folder to write into; it takes the place of `folder` when the block ends without an error.

        The block must leave a `made.json` (`write_made`) as its last act. A failed or interrupted block leaves what was
        there before.
        """
        draft = folder.with_name(f".{folder.name}.{os.getpid()}.draft")
        shutil.rmtree(draft, ignore_errors=True)
        try:
            draft.mkdir(parents=True)
            yield draft
            if not (draft / MADE).exists():
                raise StoreError(f"{folder} was written without {MADE}; the earlier result is kept.")
            self._replace(draft, folder)
        except OSError as error:
            raise StoreError(
                f"{folder} cannot be written: {error.strerror or error}. Earlier results are intact; "
                "free some space or choose another folder with --store."
            ) from error
        finally:
            shutil.rmtree(draft, ignore_errors=True)

    @staticmethod
    def write_made(draft: Path, made: Made) -> None:
        (draft / MADE).write_text(json.dumps(asdict(made), indent=1, sort_keys=True), encoding="utf-8")

    def amend(self, folder: Path, fingerprint: str, **summary: Any) -> None:
        """Add to what a result says about itself, if it is still the one of that fingerprint."""
        made = self.made(folder)
        if made is not None and made.fingerprint == fingerprint:
            with drafted(folder / MADE) as draft:
                added = replace(made, summary={**made.summary, **summary})
                draft.write_text(json.dumps(asdict(added), indent=1, sort_keys=True), encoding="utf-8")

    @staticmethod
    def _replace(draft: Path, folder: Path) -> None:
        # A folder cannot be renamed onto one that is not empty: the old one steps aside first. If the process dies
        # between the two renames, `_mend` brings the old one back.
        old = folder.with_name(f".{folder.name}.old")
        shutil.rmtree(old, ignore_errors=True)
        if folder.exists():
            folder.rename(old)
        draft.rename(folder)
        shutil.rmtree(old, ignore_errors=True)

    @staticmethod
    def _mend(folder: Path) -> None:
        old = folder.with_name(f".{folder.name}.old")
        if not folder.exists() and old.exists():
            old.rename(folder)

    # Registered experiments -------------------------------------------------------------------------------------------

    def experiments(self) -> dict[str, dict[str, Any]]:
        """Every registered partition: key → its `experiment.json`."""
        found = {}
        for path in sorted((self.root / "datasets").glob(f"*/{EXPERIMENT}")):
            found[path.parent.name] = json.loads(path.read_text(encoding="utf-8"))
        return found

    def register(self, key: str, experiment: Mapping[str, Any]) -> None:
        write_json(self.dataset(key) / EXPERIMENT, experiment)

    @contextmanager
    def lock(self, key: str, timeout_s: float = 0.0) -> Iterator[None]:
        """One writer a partition.

        Raises:
            StoreError: somebody else holds it.
        """
        from filelock import FileLock, Timeout

        folder = self.dataset(key)
        folder.mkdir(parents=True, exist_ok=True)
        try:
            with FileLock(folder / ".lock", timeout=timeout_s):
                yield
        except Timeout:
            raise StoreError(
                f"Another run is working on '{key}' in {self.root}. Wait for it to finish, or choose another --store."
            ) from None


@contextmanager
def drafted(path: Path) -> Iterator[Path]:
    """A temporary path beside `path`; when the block ends well it takes the place of `path`, else it is removed.

    The one way to write a file whole or not at all.
    """
    draft = path.parent / f".{path.stem}.{os.getpid()}.draft{path.suffix}"
    try:
        yield draft
        draft.replace(path)
    finally:
        with suppress(OSError):
            draft.unlink()


@contextmanager
def drafted_folder(folder: Path) -> Iterator[Path]:
    """The same for a folder, which must not be there, or be empty; the block makes the temporary one."""
    draft = folder.parent / f".{folder.name}.{os.getpid()}.draft"
    shutil.rmtree(draft, ignore_errors=True)
    try:
        yield draft
        if folder.exists():
            folder.rmdir()
        draft.rename(folder)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def write_json(path: Path, value: Any) -> None:
    """Write JSON whole or not at all; keys keep their order, which means something (observation sets, joints)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with drafted(path) as draft:
        draft.write_text(json.dumps(value, indent=1, allow_nan=False), encoding="utf-8")


class Meter:
    """Seconds and the peak of resident memory (sampled every 50 ms) while a block runs.

    Memory is that of the whole process, so it includes what was loaded before.
    """

    def __enter__(self) -> "Meter":
        import threading

        import psutil

        process = psutil.Process()
        self.peak_memory_mb = process.memory_info().rss / 1e6
        self._done = threading.Event()

        def sample() -> None:
            while not self._done.wait(0.05):
                self.peak_memory_mb = max(self.peak_memory_mb, process.memory_info().rss / 1e6)

        self._thread = threading.Thread(target=sample, daemon=True)
        self._thread.start()
        self._start = time.perf_counter()
        return self

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._start

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._thread.join()

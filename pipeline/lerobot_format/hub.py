"""Data sets and checkpoints on the Hugging Face Hub: a revision becomes a commit, and a commit a folder on this machine.

What belongs here: names, the cache, the network and its failures. What does not: what is in the folder (read.py).
Tokens stay inside `huggingface_hub`; no message here repeats what a server or a header said.
"""

import hashlib
import os
import re
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from pipeline.errors import HubError

if TYPE_CHECKING:
    from huggingface_hub import HfApi

TIMEOUT_S = 15.0
"""Longest wait for one answer of the Hub."""
ATTEMPTS, FIRST_WAIT_S = 3, 1.0
"""How often a download is begun (each goes on from what is there), and the pause after the first, which doubles."""
PATIENCE_S = 30
"""A Hub that asks for a longer pause (429, Retry-After) counts as out of reach."""

_REPOSITORY = re.compile(r"[A-Za-z0-9_][\w.-]{0,95}/[A-Za-z0-9_][\w.-]{0,95}", re.ASCII)
_REVISION = re.compile(r"[\w][\w./+-]{0,199}", re.ASCII)
_ADDRESS = re.compile(r"https?://([^/@\s]*@)?[\w.-]+(:\d{1,5})?(/\S*)?", re.ASCII)
_COMMIT = re.compile(r"[0-9a-f]{40}")


@dataclass(frozen=True)
class _Kind:
    """What a repository holds.

    name     as the library calls it, and in the names of the cache's folders
    words    for people          address  before its name in the Hub's addresses
    proof    a file without which it is not one
    """

    name: str
    words: str
    address: str
    proof: str


DATA_SET = _Kind("dataset", "data set", "datasets/", "meta/info.json")
CHECKPOINT = _Kind("model", "checkpoint", "", "config.json")
CHECKPOINT_FILES = (
    "config.json", "train_config.json", "model.safetensors", "policy_preprocessor*", "policy_postprocessor*",
)  # fmt: skip
"""What LeRobot puts there when it pushes a policy; nothing else is downloaded."""


@dataclass(frozen=True)
class HubCopy:
    """A copy on this machine: its folder, the commit it is of, and what the user should know about it."""

    folder: Path
    commit: str
    warnings: tuple[str, ...] = ()


class _OutOfReach(Exception):
    """The Hub gave no answer, or none but that it is broken. Never leaves this module.

    `passing`: asking again soon may help.
    """

    def __init__(self, reason: str, *, passing: bool = False):
        super().__init__(reason)
        self.passing = passing


def parse_repository(text: str, kind: _Kind = DATA_SET) -> tuple[str, str | None]:
    """`owner/name[@revision]` → the repository and the revision, None for the newest.

    Raises:
        HubError: it is not of that form.
    """
    repository, at, revision = text.partition("@")
    if not _REPOSITORY.fullmatch(repository) or ".." in repository or (at and not _is_revision(revision)):
        raise HubError(
            f"'hub:{text}' does not name a {kind.words} on the Hub. Write hub:owner/name, or hub:owner/name@revision with "
            "a branch, a tag or a commit."
        )
    return repository, revision or None


def _is_revision(text: str) -> bool:
    return bool(_REVISION.fullmatch(text)) and ".." not in text


def fetch(text: str, *, videos: bool = False) -> HubCopy:
    """The data set `owner/name[@revision]` on this machine: meta/ and data/, and videos/ where asked for.

    A pinned commit that is whole in the cache needs no network. Otherwise the Hub is asked; where it is out of reach
    the newest copy in the cache stands in, and the warnings say so.

    Raises:
        HubError: there is no such data set or revision, access is refused, no room, or the Hub is out of reach and
            there is no whole copy in the cache.
    """
    return _fetch(text, DATA_SET, ["meta/*", "data/*", *(["videos/*"] if videos else [])])


def fetch_checkpoint(text: str) -> HubCopy:
    """The policy that LeRobot pushed to `owner/name[@revision]`, likewise.

    Raises:
        HubError: as `fetch`.
    """
    copy = _fetch(text, CHECKPOINT, list(CHECKPOINT_FILES))
    if not (copy.folder / CHECKPOINT.proof).is_file():
        raise HubError(
            f"'hub:{text}' holds no {CHECKPOINT.proof}, so it is no checkpoint that LeRobot saved. Name the repository that "
            "`lerobot-train` pushed its policy to."
        )
    return copy


def _fetch(text: str, kind: _Kind, patterns: list[str]) -> HubCopy:
    repository, revision = parse_repository(text, kind)
    pinned = revision is not None and _COMMIT.fullmatch(revision)
    if pinned and (copy := _cached(kind, repository, revision, patterns, listed=True)):
        return copy
    try:
        commit = _ask(kind, repository, revision, patterns, TIMEOUT_S)
        return _download(kind, repository, revision, commit, patterns)
    except _OutOfReach as reason:
        problem = f"The Hub ({_host()}) is out of reach ({reason})"
    copy = _cached(kind, repository, revision, patterns, listed=False)
    if copy is None:
        raise HubError(
            f"{problem}, and there is no whole copy of '{text}' on this machine. "
            "Connect to the network and run again, or give a folder."
        )
    newest = "" if pinned else " The Hub may hold a newer one."
    note = f"{problem}; the copy of commit {copy.commit[:12]} in the cache was read.{newest}"
    return HubCopy(copy.folder, copy.commit, (note,))


def current_commit(repository: str, revision: str | None) -> str | None:
    """The commit that a revision stands for now: by the Hub, else as the cache last saw it, else None. Never raises."""
    return commit_by_hub(repository, revision) or _cached_commit(repository, revision)


def commit_by_hub(repository: str, revision: str | None) -> str | None:
    """The commit that a revision stands for now; None where the Hub does not say. A commit stands for itself. Never raises."""
    if revision and _COMMIT.fullmatch(revision):
        return revision
    try:
        return _ask(DATA_SET, repository, revision, None, TIMEOUT_S / 3)
    except (_OutOfReach, HubError):
        return None


def _ask(kind: _Kind, repository: str, revision: str | None, patterns: list[str] | None, timeout: float) -> str:
    """The commit of a revision by the Hub; with `patterns`, after a look at whether its files fit on the disk."""
    with _failures_of(kind, repository, revision):
        listed = {"timeout": timeout, "files_metadata": patterns is not None}
        info = _api().repo_info(repository, repo_type=kind.name, revision=revision, **listed)
    if not isinstance(info.sha, str) or not _COMMIT.fullmatch(info.sha):
        raise HubError(f"The Hub ({_host()}) gave no commit for '{repository}'. Is HF_ENDPOINT a Hub?")
    if patterns is not None:
        wanted = tuple(pattern.rstrip("*") for pattern in patterns)
        here = _cache_folder() / f"{kind.name}s--{repository.replace('/', '--')}" / "snapshots" / info.sha
        files = [file for file in info.siblings or [] if file.rfilename.startswith(wanted)]
        _check_room(repository, sum(file.size or 0 for file in files if not (here / file.rfilename).exists()))
    return info.sha


def _check_room(repository: str, size: int) -> None:
    folder = next(parent for parent in (_cache_folder(), *_cache_folder().parents) if parent.exists())
    free = shutil.disk_usage(folder).free
    if size > free:
        raise HubError(
            f"'{repository}' needs {size / 2**30:.1f} GB more, and {free / 2**30:.1f} GB are free in {folder}. "
            "Make room, or set HF_HOME to a folder on a larger disk."
        )


def _download(kind: _Kind, repository: str, revision: str | None, commit: str, patterns: list[str]) -> HubCopy:
    """Download what is not in the cache yet, in a few attempts, each going on from what is there; check what came.

    The commit is the one whose files came, should a branch move meanwhile: all of them are of one commit.
    """
    began, damaged = time.time(), []
    for attempt in range(ATTEMPTS):
        try:
            copy = _download_once(kind, repository, revision, commit, patterns)
        except _OutOfReach as reason:
            if not reason.passing or attempt == ATTEMPTS - 1:
                raise
            time.sleep(FIRST_WAIT_S * 2**attempt)
            continue
        damaged = [file for file in copy.folder.rglob("*") if file.is_file() and not _is_as_named(file, began)]
        if not damaged:
            return copy
        for file in damaged:
            file.resolve().unlink(missing_ok=True)  # equal files share their bytes
            file.unlink()
    name = damaged[0].relative_to(copy.folder).as_posix()
    raise HubError(
        f"The Hub ({_host()}) sent '{name}' of '{repository}' {ATTEMPTS} times with other bytes than its own hash of the file "
        "says. Nothing of it was kept. Something between here and the Hub changes files; try another network, or later."
    )


def _download_once(kind: _Kind, repository: str, revision: str | None, commit: str, patterns: list[str]) -> HubCopy:
    from huggingface_hub import snapshot_download

    with _failures_of(kind, repository, revision):
        _api()  # bounds the session's waits
        folder = snapshot_download(
            repository,
            repo_type=kind.name,
            revision=revision or "main",
            cache_dir=_cache_folder(),
            allow_patterns=patterns,
            endpoint=_endpoint(),
        )
    return HubCopy(Path(folder), Path(folder).name if _COMMIT.fullmatch(Path(folder).name) else commit)


def _is_as_named(file: Path, began: float) -> bool:
    """Whether a file that came since `began` has the hash that the Hub gave for it, by which the cache names its bytes.

    Large files go by sha256, small ones by git's own hash of a blob. `huggingface_hub` compares sizes only.
    """
    bytes_ = file.resolve()
    if bytes_.stat().st_mtime < began - 1 or not re.fullmatch(r"[0-9a-f]{40}|[0-9a-f]{64}", bytes_.name):
        return True
    digest = hashlib.sha256() if len(bytes_.name) == 64 else hashlib.sha1(b"blob %d\0" % bytes_.stat().st_size)
    with bytes_.open("rb") as stream:
        while block := stream.read(2**20):
            digest.update(block)
    return digest.hexdigest() == bytes_.name


def _cached(kind: _Kind, repository: str, revision: str | None, patterns: list[str], *, listed: bool) -> HubCopy | None:
    """The copy in the cache, if it is whole. `listed` asks for proof: a list of the commit's files to compare with.

    Without a list (a cache filled by other means) a copy counts as whole when it has the file that proves what it is;
    reading it will show what is missing.
    """
    from huggingface_hub import get_cached_repo_tree, snapshot_download
    from huggingface_hub.errors import CachedRepoTreeNotFoundError, IncompleteSnapshotError, LocalEntryNotFoundError

    place = {"repo_type": kind.name, "revision": revision or "main", "cache_dir": _cache_folder()}
    try:
        if listed:
            get_cached_repo_tree(repository, **place)
        folder = Path(snapshot_download(repository, local_files_only=True, allow_patterns=patterns, **place))
    except (CachedRepoTreeNotFoundError, IncompleteSnapshotError, LocalEntryNotFoundError, OSError):
        return None
    return HubCopy(folder, folder.name) if (folder / kind.proof).exists() else None


def _cached_commit(repository: str, revision: str | None) -> str | None:
    from huggingface_hub.errors import RevisionResolutionError

    try:
        return (
            _api()
            .resolve_revision(
                repository, repo_type=DATA_SET.name, revision=revision, cache_dir=_cache_folder(), local_files_only=True
            )
            .resolved
        )
    except (RevisionResolutionError, OSError):
        return None


def _api() -> "HfApi":
    """The client, with an end to every wait: the library's own session would wait for ever."""
    from huggingface_hub import HfApi, get_session

    session = get_session()
    session.timeout = TIMEOUT_S
    if _give_up_on_long_pauses not in session.event_hooks["response"]:
        hooks = session.event_hooks
        session.event_hooks = {**hooks, "response": [*hooks["response"], _give_up_on_long_pauses]}
    return HfApi(endpoint=_endpoint())


def _give_up_on_long_pauses(response: Any) -> None:
    """The library waits as long as Retry-After says, be it an hour, and asks five times."""
    asked = response.headers.get("retry-after", "")
    if response.status_code == 429 and asked.isdigit() and int(asked) > PATIENCE_S:
        raise _OutOfReach(f"it asks for a pause of {int(asked):,} s")


@contextmanager
def _failures_of(kind: _Kind, repository: str, revision: str | None) -> Iterator[None]:
    """Failures of a request → `HubError` with what to do, or `_OutOfReach` where a copy in the cache may help."""
    from huggingface_hub import errors

    if os.environ.get("HF_HUB_OFFLINE", "").upper() in {"1", "ON", "YES", "TRUE"}:
        raise _OutOfReach("HF_HUB_OFFLINE is set")
    try:
        yield
    except errors.GatedRepoError:
        raise HubError(
            f"'{repository}' asks its readers to accept terms. Do so at {_host()}/{kind.address}{repository}, then run "
            "`hf auth login`."
        ) from None
    except errors.RepositoryNotFoundError:
        raise HubError(
            f"The Hub ({_host()}) shows no {kind.words} '{repository}'. "
            "Check the name; if it is private, run `hf auth login`."
        ) from None
    except errors.RevisionNotFoundError:
        raise HubError(
            f"'{repository}' has no revision '{revision or 'main'}' on the Hub ({_host()}). Give a branch, a tag or a "
            f"commit that it has, or leave @revision out."
        ) from None
    except errors.RemoteEntryNotFoundError:
        raise HubError(
            f"The Hub ({_host()}) lists a file of '{repository}' that it does not have. Give another revision, or ask whoever "
            f"keeps the {kind.words} to upload it again."
        ) from None
    except errors.HfHubHTTPError as error:
        status = error.response.status_code
        if status >= 500 or status in (408, 429):
            raise _OutOfReach(f"it answered {status}", passing=True) from None
        raise HubError(
            f"The Hub ({_host()}) refused '{repository}' with status {status}. Run `hf auth login`."
        ) from None
    except (errors.OfflineModeIsEnabled, errors.IncompleteSnapshotError, errors.LocalEntryNotFoundError) as error:
        raise _OutOfReach(type(error).__name__) from None
    except (errors.HTTPError, errors.FileMetadataError, errors.XetDownloadError) as error:
        raise _OutOfReach(type(error).__name__, passing="Timeout" in type(error).__name__) from None
    except OSError as error:
        if error.errno is None:  # the library's own check of sizes
            raise _OutOfReach("it sent a part of a file", passing=True) from None
        raise HubError(
            f"'{repository}' cannot be kept in {_cache_folder()}: {error.strerror or type(error).__name__}. "
            "Make room, or set HF_HOME to another folder."
        ) from None


def _endpoint() -> str:
    """The Hub's address, read when it is needed."""
    address = (os.environ.get("HF_ENDPOINT") or "https://huggingface.co").rstrip("/")
    if not _ADDRESS.fullmatch(address):
        raise HubError("HF_ENDPOINT is not the address of a Hub. Unset it, or write it as https://host.")
    return address


def _host() -> str:
    """The address as it may be shown: without a user's name or password."""
    parts = urlsplit(_endpoint())
    return f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}"


def _cache_folder() -> Path:
    """Where `huggingface_hub` keeps its copies, by the environment as it is now."""
    if named := os.environ.get("HF_HUB_CACHE"):
        return Path(named).expanduser()
    home = os.environ.get("HF_HOME") or Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache") / "huggingface"
    return Path(home).expanduser() / "hub"

"""A small Hub on 127.0.0.1: the part of its HTTP interface that `huggingface_hub` needs to fetch data sets and models.

Branches and tags point at commits, large files answer with a redirect and X-Linked headers as on the real Hub, the tree
comes in pages, refusals carry X-Error-Code. It counts what it was asked.
"""

import hashlib
import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

LARGE = 2000
"""Bytes from which a file is stored apart, as LFS does."""

PAGE = 5
"""Files on a page of the tree."""


@dataclass
class Repository:
    """Commits (hash → path → bytes) and the branches and tags that point at them."""

    commits: dict[str, dict[str, bytes]]
    refs: dict[str, str]
    gated: bool = False


@dataclass
class Fault:
    """Something that goes wrong, once, with the next request whose path contains `where`.

    status and headers  answered instead of what was asked for
    cut                 the body ends after so many bytes, and the connection with it
    change              the body is what this makes of it, its length unchanged
    stall_s             seconds before anything is sent
    then                called before the answer is made
    """

    where: str
    status: int | None = None
    headers: dict[str, str] = field(default_factory=dict)
    cut: int | None = None
    change: Callable[[bytes], bytes] | None = None
    stall_s: float = 0.0
    then: Callable[[], Any] | None = None


@dataclass
class Hub:
    """What the server holds, and what it has seen: `asked` lists "METHOD path", `tokens` the authorisation headers."""

    repositories: dict[str, Repository] = field(default_factory=dict)
    asked: list[str] = field(default_factory=list)
    tokens: list[str] = field(default_factory=list)
    failure: int | None = None
    faults: list["Fault"] = field(default_factory=list)
    url: str = ""
    storage_url: str = ""

    def push(self, name: str, folder: Path, *, branch: str = "main") -> str:
        """A new commit with the files of a folder, at the head of a branch; returns its hash."""
        files = {
            path.relative_to(folder).as_posix(): path.read_bytes()
            for path in sorted(folder.rglob("*"))
            if path.is_file()
        }
        files[".gitattributes"] = b"*.parquet filter=lfs\n"
        digest = hashlib.sha1(name.encode())
        for path, content in files.items():
            digest.update(path.encode() + content)
        repository = self.repositories.setdefault(name, Repository({}, {}))
        repository.commits[digest.hexdigest()] = files
        repository.refs[branch] = digest.hexdigest()
        return digest.hexdigest()

    def files_asked_for(self) -> list[str]:
        """Paths inside repositories that were asked for; large files are then fetched from elsewhere."""
        return [line.split("/resolve/")[1].split("/", 1)[1] for line in self.asked if "/resolve/" in line]


@contextmanager
def running_hub() -> Iterator[Hub]:
    """A Hub that listens until the block ends."""
    hub = Hub()

    class Handler(_Handler):
        pass

    Handler.hub = hub
    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    hub.url = f"http://127.0.0.1:{server.server_address[1]}"
    hub.storage_url = hub.url.replace("127.0.0.1", "localhost")  # another host, as the real Hub stores large files
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield hub
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


class _Handler(BaseHTTPRequestHandler):
    hub: Hub
    fault: Fault | None = None
    protocol_version = "HTTP/1.1"

    def log_message(self, *_: Any) -> None:
        pass

    def do_HEAD(self) -> None:
        self._answer()

    def do_GET(self) -> None:
        self._answer()

    def _answer(self) -> None:
        url = urlsplit(self.path)
        self.hub.asked.append(f"{self.command} {url.path}")
        if token := self.headers.get("authorization"):
            self.hub.tokens.append(token)
        if self.hub.failure:
            self._refuse(self.hub.failure, None)
            return
        self.fault = next((f for f in self.hub.faults if f.where in f"{self.command} {url.path}"), None)
        if self.fault is not None:
            self.hub.faults.remove(self.fault)
            time.sleep(self.fault.stall_s)
            if self.fault.then:
                self.fault.then()
            if self.fault.status:
                self._refuse(self.fault.status, None, self.fault.headers)
                return
        parts = [unquote(part) for part in url.path.strip("/").split("/")]
        if parts[0] == "blobs":
            self._blob(parts[1])
        elif parts[0] == "api" and parts[1] in ("datasets", "models"):
            self._api(parts[2:], parse_qs(url.query))
        elif parts[0] == "datasets" and "resolve" in parts:
            self._file("/".join(parts[1:3]), parts[4], "/".join(parts[5:]))
        elif parts[2:3] == ["resolve"]:  # a model's address has no word before its name
            self._file("/".join(parts[:2]), parts[3], "/".join(parts[4:]))
        else:
            self._refuse(404, None)

    def _find(self, name: str, revision: str) -> tuple[Repository, str] | None:
        """The repository and the commit of a revision, or None after a refusal has been sent."""
        repository = self.hub.repositories.get(name)
        if repository is None:
            self._refuse(401, "RepoNotFound")
            return None
        commit = repository.refs.get(revision, revision)
        if commit not in repository.commits:
            self._refuse(404, "RevisionNotFound")
            return None
        return repository, commit

    def _api(self, parts: list[str], query: dict[str, list[str]]) -> None:
        name, rest = "/".join(parts[:2]), parts[2:]
        found = self._find(name, rest[1] if len(rest) > 1 else "main")
        if found is None:
            return
        repository, commit = found
        files = repository.commits[commit]
        if rest[:1] == ["tree"]:
            self._tree(files, int(query.get("cursor", ["0"])[0]))
            return
        siblings = [
            {"rfilename": path} | (_sizes(content) if "blobs" in query else {}) for path, content in files.items()
        ]
        info = {"_id": "0", "id": name, "sha": commit, "private": False, "gated": "auto" if repository.gated else False}
        self._json(info | {"disabled": False, "tags": [], "downloads": 0, "likes": 0, "siblings": siblings})

    def _tree(self, files: dict[str, bytes], start: int) -> None:
        entries = [
            {"type": "file", "path": path, "oid": (sizes := _sizes(content))["blobId"], **sizes}
            for path, content in files.items()
        ]
        more = start + PAGE < len(entries)
        link = f'<{self.hub.url}{urlsplit(self.path).path}?recursive=True&cursor={start + PAGE}>; rel="next"'
        self._json(entries[start : start + PAGE], {"Link": link} if more else {})

    def _file(self, name: str, revision: str, path: str) -> None:
        found = self._find(name, revision)
        if found is None:
            return
        repository, commit = found
        if repository.gated:
            self._refuse(403, "GatedRepo")
            return
        content = repository.commits[commit].get(path)
        if content is None:
            self._refuse(404, "EntryNotFound", {"X-Repo-Commit": commit})
            return
        sizes = _sizes(content)
        if "lfs" not in sizes:
            self._send(200, content, {"ETag": f'"{sizes["blobId"]}"', "X-Repo-Commit": commit})
            return
        etag = sizes["lfs"]["sha256"]
        linked = {"X-Linked-Etag": f'"{etag}"', "X-Linked-Size": str(len(content)), "X-Repo-Commit": commit}
        self._send(302, b"", linked | {"Location": f"{self.hub.storage_url}/blobs/{etag}"})

    def _blob(self, sha256: str) -> None:
        for repository in self.hub.repositories.values():
            for files in repository.commits.values():
                for content in files.values():
                    if hashlib.sha256(content).hexdigest() == sha256:
                        self._part(content, {"ETag": f'"{sha256}"'})
                        return
        self._refuse(404, "EntryNotFound")

    def _part(self, content: bytes, headers: dict[str, str]) -> None:
        """The whole, or what lies after the first byte that is asked for."""
        asked = self.headers.get("range", "")
        if not asked.startswith("bytes="):
            self._send(200, content, headers)
            return
        start = int(asked.removeprefix("bytes=").split("-")[0])
        place = {"Content-Range": f"bytes {start}-{len(content) - 1}/{len(content)}"}
        self._send(206, content[start:], headers | place)

    def _refuse(self, status: int, code: str | None, headers: dict[str, str] | None = None) -> None:
        self._send(status, b'{"error":"no"}', (headers or {}) | ({"X-Error-Code": code} if code else {}))

    def _json(self, content: Any, headers: dict[str, str] | None = None) -> None:
        self._send(200, json.dumps(content).encode(), {"Content-Type": "application/json"} | (headers or {}))

    def _send(self, status: int, content: bytes, headers: dict[str, str]) -> None:
        self.send_response(status)
        for key, value in headers.items():
            self.send_header(key, value)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        if self.command != "GET":
            return
        fault = self.fault
        if fault and fault.change:
            content = fault.change(content)
        if fault and fault.cut is not None:
            content = content[: fault.cut]
            self.close_connection = True
        self.wfile.write(content)


def _sizes(content: bytes) -> dict[str, Any]:
    """Size and hashes of a file as the Hub's listings have them."""
    sizes: dict[str, Any] = {
        "size": len(content),
        "blobId": hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest(),
    }
    if len(content) >= LARGE:
        digest = hashlib.sha256(content).hexdigest()
        sizes["lfs"] = {"oid": digest, "sha256": digest, "size": len(content), "pointerSize": 130}
    return sizes

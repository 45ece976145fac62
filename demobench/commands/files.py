"""The files of a store over http on 127.0.0.1: reports, histories, recordings and videos to look at, and nothing else.

What belongs here: which files, and who may ask. What does not: starting and stopping (`ui`). It reads; nothing can be changed
through it. Like Dagster and MLflow it knows no users, so it answers only this machine, and only under this machine's names:
a page from elsewhere whose host name was pointed at 127.0.0.1 is refused.
"""

import shutil
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from urllib.parse import quote, unquote, urlsplit

from assets_defs.links import HOST
from pipeline.config import check_slug
from pipeline.errors import ConfigError
from pipeline.history import FOLDER as HISTORY
from pipeline.sinks.markup import Html, element
from pipeline.store import Store

SHOWN = {
    "benchmark_report": ("report", {".html": "text/html; charset=utf-8"}),
    HISTORY: ("history", {".html": "text/html; charset=utf-8"}),
    "rollout_video": ("video", {".mp4": "video/mp4"}),
    "rerun_recording": ("Rerun recording", {".rrd": "application/octet-stream"}),
    "mcap_log": ("MCAP", {".mcap": "application/octet-stream"}),
}
"""Folder of a data set (an asset's, or the history) → what people call it, and its files by how they end."""

STYLE = """:root { color-scheme: light dark }
body { max-width: 60rem; margin: 3rem auto; padding: 0 1rem; font: 16px/1.5 system-ui, sans-serif }
li { margin: .4rem 0 } li a { margin-right: 1rem }"""


class FileServer(ThreadingHTTPServer):
    """Serves one store while it is entered; `port` 0 takes a free one."""

    daemon_threads = True

    def __init__(self, store: Store, port: int):
        super().__init__((HOST, port), _Handler)
        self.store = store

    def __enter__(self) -> "FileServer":
        Thread(target=self.serve_forever, name="files", daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self.shutdown()
        self.server_close()

    @property
    def names(self) -> set[str]:
        """What this server may be called in a request."""
        return {f"{name}:{self.server_port}" for name in (HOST, "localhost")}

    def find(self, address: str) -> tuple[Path, str] | None:
        """The file behind `/key/asset/name` and its type; None where nothing is shown under that address."""
        parts = [unquote(part) for part in urlsplit(address).path.split("/")[1:]]
        if len(parts) != 3 or parts[1] not in SHOWN:
            return None
        key, asset, name = parts
        with suppress(ConfigError):
            check_slug(name, "file name")
            path, kinds = self.store.folder(key, asset) / name, SHOWN[asset][1]
            inside = path.resolve().is_relative_to(self.store.root.resolve())
            if inside and path.suffix in kinds and path.is_file():
                return path, kinds[path.suffix]
        return None

    def index(self) -> str:
        """One line a data set, with what can be looked at."""
        lines = [
            element("li", element("b", key), " ", links)
            for key in self.store.experiments()
            if (links := self._links(key))
        ]
        body = element("ul", lines) if lines else element("p", "Nothing was benchmarked yet.")
        head = [element("meta", charset="utf-8"), element("title", "demobench"), element("style", Html(STYLE))]
        page = element("html", element("head", head), element("body", element("h1", "Results"), body), lang="en")
        return f"<!doctype html>\n{page}\n"

    def _links(self, key: str) -> list[Html]:
        found = []
        for asset, (words, kinds) in SHOWN.items():
            folder = self.store.folder(key, asset)
            for path in sorted(p for p in folder.glob("[!.]*") if p.suffix in kinds):
                many = f" {path.stem}" if asset == "rollout_video" else ""
                found.append(element("a", f"{words}{many}", href=f"/{quote(key)}/{asset}/{quote(path.name)}"))
        return found


class _Handler(BaseHTTPRequestHandler):
    server: FileServer

    def do_GET(self) -> None:
        self._answer(with_body=True)

    def do_HEAD(self) -> None:
        self._answer(with_body=False)

    def _answer(self, *, with_body: bool) -> None:
        if self.headers.get("Host") not in self.server.names:
            self.send_error(HTTPStatus.FORBIDDEN)
        elif urlsplit(self.path).path == "/":
            page = self.server.index().encode()
            self._begin("text/html; charset=utf-8", len(page))
            self.wfile.write(page if with_body else b"")
        elif found := self.server.find(self.path):
            self._send(*found, with_body=with_body)
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def _send(self, path: Path, kind: str, *, with_body: bool) -> None:
        # A reader that leaves early is no fault; a result that is made again while it is read stays whole in the open file.
        with suppress(BrokenPipeError, ConnectionResetError), path.open("rb") as file:
            self._begin(kind, path.stat().st_size)
            if with_body:
                shutil.copyfileobj(file, self.wfile)

    def _begin(self, kind: str, size: int) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(size))
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cache-Control", "no-cache")
        self.end_headers()

    def log_message(self, *_: object) -> None:
        """Say nothing: the terminal belongs to whoever started the servers."""

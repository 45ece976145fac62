"""Messages reach a real command and a real server, or one line in a log; secrets reach neither."""

import json
import threading
import time
from contextlib import contextmanager
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from pipeline import notify
from pipeline.config import Config, NotifyConfig, parse_config
from pipeline.errors import ConfigError
from pipeline.notify import LOG, TRIES, log_line, message, send, without_secrets

WHEN = datetime(2026, 3, 2, 3, 0, 5, tzinfo=UTC)
TOLD = message("regression", "tape", "mlp_k01 got worse", numbers={"difference": 0.25}, run_id="1a2b", when=WHEN)


@contextmanager
def listening(*, status: int = 200, stall_s: float = 0.0, drip: bool = False, location: str | None = None):
    """A server on this machine; yields its address and what it was sent, as (path, headers, body)."""
    got, done = [], threading.Event()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["content-length"]))
            got.append((self.path, dict(self.headers), body))
            if drip:  # a byte now and then: no single read takes long
                for byte in b"HTTP/1.1 200 OK\r\nX-Endless: " + b"x" * 1000:
                    if done.wait(0.05):
                        return
                    self.wfile.write(bytes([byte]))
                    self.wfile.flush()
            done.wait(stall_s)
            try:
                self.send_response(status)
                if location:
                    self.send_header("Location", location)
                self.send_header("Content-Length", "0")
                self.end_headers()
            except OSError:
                pass  # whoever asked is gone

        def log_message(self, *_) -> None:
            pass

    class Server(ThreadingHTTPServer):
        def handle_error(self, *_) -> None:
            pass

    server = Server(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/hook/5ecret", got
    finally:
        done.set()
        server.shutdown()
        server.server_close()
        thread.join()


def log_of(folder) -> list[str]:
    path = folder / LOG
    return path.read_text(encoding="utf-8").splitlines() if path.exists() else []


def test_it_is_off_by_default(tmp_path):
    assert Config().notify == NotifyConfig(command=None, webhook=None)
    assert send(NotifyConfig(), TOLD, tmp_path)
    assert log_of(tmp_path) == []


def test_a_webhook_is_sent_words_and_numbers_and_no_environment(tmp_path, monkeypatch):
    monkeypatch.setenv("HF_TOKEN", "hf_abcdefghijkl")
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")  # nothing on this machine goes through a proxy
    with listening() as (url, got):
        assert send(NotifyConfig(webhook=url), TOLD, tmp_path)
    ((path, headers, body),) = got
    assert path == "/hook/5ecret"
    assert json.loads(body) == {
        "event": "regression", "dataset": "tape", "words": "mlp_k01 got worse", "numbers": {"difference": 0.25},
        "run_id": "1a2b", "code": None, "when": "2026-03-02T03:00:05Z",
    }  # fmt: skip
    assert {name.lower() for name in headers} == {
        "accept-encoding", "connection", "content-length", "content-type", "host", "user-agent",
    }  # fmt: skip
    assert log_of(tmp_path) == []


def test_a_webhook_that_times_out_is_tried_thrice_and_then_one_line(tmp_path):
    start = time.monotonic()
    with listening(stall_s=30) as (url, got):
        assert not send(NotifyConfig(webhook=url), TOLD, tmp_path, timeout_s=0.2, pause_s=0.01)
        assert len(got) == TRIES == 3
    assert time.monotonic() - start < 20
    (line,) = log_of(tmp_path)
    assert line.endswith(
        "tape notify: the webhook at 127.0.0.1 was not told of the regression of tape: no answer within 0.2 s, 3 tries"
    )
    assert "5ecret" not in line


def test_an_answer_that_never_ends_is_given_up(tmp_path):
    start = time.monotonic()
    with listening(drip=True) as (url, _):
        assert not send(NotifyConfig(webhook=url), TOLD, tmp_path, timeout_s=0.3, pause_s=0.0)
    assert time.monotonic() - start < 20
    assert "no answer within 0.3 s" in log_of(tmp_path)[0]


@pytest.mark.parametrize("status", [500, 404, 302])
def test_a_refusal_or_redirect_is_no_success(tmp_path, status):
    with listening() as (elsewhere, followed), listening(status=status, location=elsewhere) as (url, got):
        assert not send(NotifyConfig(webhook=url), TOLD, tmp_path, pause_s=0.0)
        assert (len(got), followed) == (3, [])
    assert f"status {status}, 3 tries" in log_of(tmp_path)[0]


def test_nobody_listens(tmp_path):
    with listening() as (url, _):
        pass
    assert not send(NotifyConfig(webhook=url), TOLD, tmp_path, pause_s=0.0)
    assert "Connection refused, 3 tries" in log_of(tmp_path)[0]


def test_a_second_try_that_succeeds_is_enough(tmp_path):
    script = 'test -e "$0"; before=$?; cat > "$0"; exit $before'  # 1 the first time
    command = ("/bin/sh", "-c", script, str(tmp_path / "got"))
    assert send(NotifyConfig(command=command), TOLD, tmp_path, pause_s=0.0)
    assert json.loads((tmp_path / "got").read_text()) == TOLD
    assert log_of(tmp_path) == []


@pytest.mark.parametrize(
    ("command", "timeout_s", "words"),
    [
        (("/nowhere/tell",), 30, "the command tell was not told of the regression of tape: it cannot be started"),
        (("/bin/sh", "-c", "echo 5ecret; exit 3"), 30, "exit status 3"),
        (("/bin/sh", "-c", "sleep 60 & wait"), 0.3, "no end within 0.3 s"),
    ],
)
def test_a_command_that_does_not_do_it_is_one_line(tmp_path, command, timeout_s, words):
    start = time.monotonic()
    assert not send(NotifyConfig(command=command), TOLD, tmp_path, timeout_s=timeout_s, pause_s=0.0)
    assert time.monotonic() - start < 30
    (line,) = log_of(tmp_path)
    assert words in line
    assert "5ecret" not in line


def test_a_log_that_cannot_be_written_stops_nothing(tmp_path):
    (tmp_path / LOG).mkdir()
    assert not send(NotifyConfig(command=("/nowhere/tell",)), TOLD, tmp_path, pause_s=0.0)


@pytest.mark.parametrize(
    "url",
    [
        "http://example.org/5ecret",
        "ftp://example.org/5ecret",
        "https://",
        "5ecret",
        "http://[5ecret",
        "https://h:5ecret/",
    ],
)
def test_a_webhook_that_others_could_read_is_refused_without_repeating_it(url):
    with pytest.raises(ConfigError, match=r"\[notify\] webhook must be an https:// address") as refused:
        parse_config({"notify": {"webhook": url}}, "here")
    assert "5ecret" not in str(refused.value)


def test_what_may_be_configured():
    for url in ("https://example.org/hook", "http://localhost:8080/x", "http://[::1]/x", "http://127.0.0.1/x"):
        assert parse_config({"notify": {"webhook": url}}, "here").notify.webhook == url
    assert parse_config({"notify": {"command": ["tell", "me"]}}, "here").notify.command == ("tell", "me")
    with pytest.raises(ConfigError, match="Did you mean 'webhook'"):
        parse_config({"notify": {"webook": "https://example.org"}}, "here")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("GET https://user:pa55word@host/x failed", "GET https://***@host/x failed"),
        ("no access with hf_AbCdEfGhIjKl", "no access with ***"),
        ("Authorization: Bearer abc.def", "Authorization: Bearer ***"),
        ("https://h/x?token=abc&rev=1", "https://h/x?token=***&rev=1"),
        ("the value 0pensesame99 of the environment", "the value *** of the environment"),
        ("two\nlines \x1b[31m", "two lines �[31m"),
        ("x" * 600, "x" * 499 + "…"),
        ("12 of 40 episodes: a broken token", "12 of 40 episodes: a broken token"),
    ],
)
def test_secrets_and_line_ends_are_taken_out(monkeypatch, words, said):
    monkeypatch.setenv("MY_API_KEY", "0pensesame99")
    assert without_secrets(words) == said


def test_lines_are_appended_with_their_time(tmp_path):
    log_line(tmp_path, "first", WHEN)
    log_line(tmp_path, "second\nstill", WHEN)
    assert log_of(tmp_path) == ["2026-03-02 03:00:05 UTC first", "2026-03-02 03:00:05 UTC second still"]


def test_limits_are_those_that_are_written_down():
    assert (notify.TIMEOUT_S, notify.TRIES) == (10.0, 3)

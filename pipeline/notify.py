"""Telling people what came of runs that nobody watches: one log file in the store, and a command or webhook of theirs.

What belongs here: one line, one message, sent with a limit on time and tries, and never a secret in either. What does not:
deciding what is worth telling. A message that cannot be sent is a line in the log and stops nothing.
"""

import json
import os
import re
import signal
import subprocess
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlsplit

from pipeline.config import NotifyConfig, is_loopback
from pipeline.errors import printable

LOG = "automation.log"
TIMEOUT_S, TRIES, PAUSE_S = 10.0, 3, 1.0
"""Of one try; how often a message is tried; between two tries."""
LONGEST = 500

Event = Literal["regression", "failure", "new champion"]

_SECRETS = (
    re.compile(r"(?<=://)[^/@\s]+(?=@)"),  # user:password@ of an address
    re.compile(r"\bhf_[A-Za-z0-9]{8,}"),
    re.compile(r"(?i)(?<=bearer )\S+"),
    re.compile(r"(?i)(?<=authorization: )(?!bearer)[^\n]+"),
    re.compile(r"(?i)(?<=token=)[^&\s'\"]+|(?<=password=)[^&\s'\"]+|(?<=secret=)[^&\s'\"]+|(?<=signature=)[^&\s'\"]+"),
    re.compile(r"(?i)(?<=api_key=)[^&\s'\"]+|(?<=apikey=)[^&\s'\"]+"),
)
_SECRET_NAMES = re.compile(r"TOKEN|PASSWORD|SECRET|API_?KEY|CREDENTIAL", re.IGNORECASE)


def without_secrets(words: str) -> str:
    """Words on one line, without what looks like a token or password, or is the value of an environment variable that is named
    like one; at most LONGEST characters."""
    for name, value in os.environ.items():
        if _SECRET_NAMES.search(name) and len(value) >= 8:
            words = words.replace(value, "***")
    for pattern in _SECRETS:
        words = pattern.sub("***", words)
    words = " ".join(printable(words).split())
    return words if len(words) <= LONGEST else words[: LONGEST - 1] + "…"


def log_line(store_root: Path, words: str, when: datetime | None = None) -> None:
    """Add one line to the log of the store, in one write, so that lines of several processes do not mix."""
    stamp = (when or datetime.now(UTC)).strftime("%Y-%m-%d %H:%M:%S UTC")
    line = f"{stamp} {without_secrets(words)}\n".encode()
    descriptor = os.open(store_root / LOG, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    try:
        os.write(descriptor, line)
    finally:
        os.close(descriptor)


def message(
    event: Event,
    dataset: str,
    words: str,
    *,
    numbers: Mapping[str, Any] | None = None,
    run_id: str | None = None,
    code: str | None = None,
    when: datetime | None = None,
) -> dict[str, Any]:
    """What is sent: JSON with words and numbers."""
    return {
        "event": event,
        "dataset": dataset,
        "words": without_secrets(words),
        "numbers": dict(numbers or {}),
        "run_id": run_id,
        "code": code,
        "when": (when or datetime.now(UTC)).strftime("%Y-%m-%dT%H:%M:%SZ"),
    }


def send(
    config: NotifyConfig,
    what: Mapping[str, Any],
    store_root: Path,
    *,
    timeout_s: float = TIMEOUT_S,
    pause_s: float = PAUSE_S,
) -> bool:
    """Send a message by all the ways that are configured; returns whether each of them took it. Never raises.

    A way that does not take it in TRIES tries is one line in the log of the store. The line names the program, or the host of
    the webhook: the rest of an address may be a secret, and so may whatever is answered.
    """
    ways: list[tuple[str, Callable[[], None]]] = []
    body = json.dumps(what, ensure_ascii=False).encode()
    if config.command:
        name = f"the command {Path(config.command[0]).name}"
        ways.append((name, lambda: _run(config.command, body, timeout_s)))
    if config.webhook:
        name = f"the webhook at {urlsplit(config.webhook).hostname}"
        ways.append((name, lambda: _post(config.webhook, body, timeout_s)))
    sent = True
    for name, way in ways:
        problem = _tried(way, pause_s)
        if problem is not None:
            sent = False
            with suppress(OSError):
                about = f"{what['event']} of {what['dataset']}"
                log_line(
                    store_root,
                    f"{what['dataset']} notify: {name} was not told of the {about}: {problem}, {TRIES} tries",
                )
    return sent


class _NotTaken(Exception):
    """Why a message was not taken, in words that may stand in a log."""


def _tried(way: Callable[[], None], pause_s: float) -> str | None:
    """Why none of the tries succeeded, or None where one did."""
    problem = None
    for attempt in range(TRIES):
        if attempt:
            time.sleep(pause_s)
        try:
            way()
            return None
        except _NotTaken as error:
            problem = str(error)
        except Exception as error:  # whatever else happens must not reach the run, and its words might hold an address
            problem = type(error).__name__
    return problem


def _run(command: tuple[str, ...], body: bytes, timeout_s: float) -> None:
    """Start the user's own command with the message on its standard input; what it prints is dropped."""
    try:
        started = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
    except OSError as error:
        raise _NotTaken(f"it cannot be started ({error.strerror})") from None
    try:
        started.communicate(body, timeout=timeout_s)
    except subprocess.TimeoutExpired:
        with suppress(ProcessLookupError):
            os.killpg(started.pid, signal.SIGKILL)
        started.wait()
        raise _NotTaken(f"no end within {timeout_s:g} s") from None
    except BrokenPipeError:
        started.wait()  # it did not read; its exit status decides
    if started.returncode:
        raise _NotTaken(f"exit status {started.returncode}")


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    """A redirect could lead to an address that was not allowed."""

    def redirect_request(self, *_: Any) -> None:
        return None


def _post(url: str, body: bytes, timeout_s: float) -> None:
    """POST the message; any status of the 200s will do, and nothing of the answer is read.

    A thread bounds the whole: the timeout of a socket begins anew with each byte.
    """
    answer: list[str | None] = []

    def ask() -> None:
        handlers: list[Any] = [_NoRedirect()]
        if is_loopback(urlsplit(url).hostname):
            handlers.append(urllib.request.ProxyHandler({}))
        request = urllib.request.Request(url, body, {"Content-Type": "application/json", "User-Agent": "demobench"})
        try:
            with urllib.request.build_opener(*handlers).open(request, timeout=timeout_s):
                answer.append(None)
        except urllib.error.HTTPError as error:
            answer.append(f"status {error.code}")
            error.close()
        except TimeoutError:
            answer.append(f"no answer within {timeout_s:g} s")
        except urllib.error.URLError as error:
            late = isinstance(error.reason, TimeoutError)
            answer.append(f"no answer within {timeout_s:g} s" if late else _reason(error.reason))
        except Exception as error:
            answer.append(type(error).__name__)

    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    thread.join(timeout_s + 0.5)
    problem = answer[0] if answer else f"no answer within {timeout_s:g} s"
    if problem is not None:
        raise _NotTaken(problem)


def _reason(reason: Any) -> str:
    return getattr(reason, "strerror", None) or type(reason).__name__

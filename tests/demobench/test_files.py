"""The store's files over http: what is shown is shown whole, everything else is refused."""

import http.client

import pytest

from demobench.commands.files import FileServer
from pipeline.store import Store

PAGE = "<!doctype html><title>a page</title>"


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    store = Store(tmp_path_factory.mktemp("results"))
    store.register("tape+1", {})
    report = store.folder("tape+1", "benchmark_report")
    report.mkdir()
    (report / "report.html").write_text(PAGE)
    (report / "made.json").write_text("{}")
    entry = store.folder("tape+1", "benchmark_history", "000001")
    entry.mkdir(parents=True)
    (entry / "made.json").write_text("secret")
    (entry.parent / "history.html").write_text(PAGE)
    (entry.parent / "history.png").write_text("secret")
    (store.root / "secret.html").write_text("secret")
    (report / "away.html").symlink_to(store.root.parent / "away.html")
    (store.root.parent / "away.html").write_text("secret")
    weights = store.folder("tape+1", "mlp_k01/trained_policy", "state")
    weights.mkdir(parents=True)
    (weights / "page.html").write_text("secret")
    with FileServer(store, 0) as running:
        yield running


def ask(server: FileServer, address: str, method: str = "GET", **headers: str) -> tuple[int, str, dict[str, str]]:
    """Status, body and headers; the address goes out as it is written."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=30)
    connection.putrequest(method, address, skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    found = answer.status, answer.read().decode(), dict(answer.headers)
    connection.close()
    return found


def test_a_report_is_shown_whole(server):
    status, body, headers = ask(server, "/tape%2B1/benchmark_report/report.html?x=1")
    assert (status, body) == (200, PAGE)
    assert headers["Content-Type"] == "text/html; charset=utf-8"
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert ask(server, "/tape+1/benchmark_report/report.html", "HEAD")[:2] == (200, "")


def test_a_history_is_shown_whole(server):
    status, body, headers = ask(server, "/tape%2B1/benchmark_history/history.html")
    assert (status, body) == (200, PAGE)
    assert headers["Content-Type"] == "text/html; charset=utf-8"


def test_the_first_page_lists_what_there_is(server):
    status, body, _ = ask(server, "/")
    assert status == 200
    assert '<a href="/tape%2B1/benchmark_report/report.html">report</a>' in body
    assert '<a href="/tape%2B1/benchmark_history/history.html">history</a>' in body
    assert "secret" not in body


@pytest.mark.parametrize(
    "address",
    [
        "/secret.html",
        "/tape+1/benchmark_report/made.json",
        "/tape+1/benchmark_report/away.html",
        "/tape+1/benchmark_report/",
        "/tape+1/benchmark_report/../../../secret.html",
        "/tape+1/benchmark_report/..%2f..%2f..%2fsecret.html",
        "/..%2f../benchmark_report/report.html",
        "/%2e%2e/benchmark_report/report.html",
        "/tape+1/mlp_k01/trained_policy/state/page.html",
        "/tape+1/mlp_k01%2ftrained_policy%2fstate/page.html",
        "/tape+1/benchmark_report/report.html%00",
        "/nothing/benchmark_report/report.html",
        "/tape+1/benchmark_history/history.png",
        "/tape+1/benchmark_history/000001/made.json",
        "/tape+1/benchmark_history/000001",
    ],
)
def test_nothing_else_is_shown(server, address):
    status, body, _ = ask(server, address)
    assert status == 404
    assert "secret" not in body.replace("secret.html", "")


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1", "evil.example:80"])
def test_a_page_from_elsewhere_gets_nothing(server, host):
    assert ask(server, "/tape+1/benchmark_report/report.html", Host=host)[0] == 403


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE"])
def test_nothing_can_be_changed(server, method):
    assert ask(server, "/tape+1/benchmark_report/report.html", method)[0] == 501


def test_it_listens_on_this_machine_alone(server):
    assert server.server_address[0] == "127.0.0.1"


def test_a_reader_that_leaves_does_no_harm(server, capfd):
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=30)
    connection.request("GET", "/tape+1/benchmark_report/report.html")
    connection.sock.shutdown(2)
    connection.close()
    assert ask(server, "/")[0] == 200
    assert capfd.readouterr().err == ""


def test_it_is_gone_afterwards(tmp_path):
    with FileServer(Store(tmp_path), 0) as running:
        port = running.server_port
    gone = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
    with pytest.raises(ConnectionRefusedError):
        gone.connect()

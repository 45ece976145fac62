"""The page of a history: every table with its data and code, the chart, nothing from outside, nothing that runs."""

import json
import re
from dataclasses import replace

import pytest

from pipeline.history import Line
from pipeline.sinks.history_page import history_chart, picture_history, write_history_page
from pipeline.sinks.markup import outside_references
from tests.sinks.making import NASTY


def row(policy: str, error: float | None, **more) -> dict:
    interval = None if error is None else [0.9 * error, 1.1 * error]
    return {
        "policy": policy, "observations": "state", "method": "mlp", "seeds": 2, "first_step_mae": error, "vs_hold_still": 2.0,
        "interval": interval, "rollouts": None,
    } | more  # fmt: skip


ROLLED = {"n": 50, "success": 0.82, "success_interval": [0.69, 0.91]}
FIRST = Line(
    when="2026-03-02T03:00:05Z", table="f1", code="0.1.0 (abc1234)", revision="9" * 40, content_hash="c" * 64, named="mlp_k01",
    champion="mlp_k01/state", conditions={},
    rows=[row("mlp_k01", 4.0, rollouts=ROLLED), row("mlp_k04", None), row("mean_action", 90.0), row(NASTY, 5.0)],
)  # fmt: skip
WORSE = {
    "word": "worse", "words": "error 25 % higher", "since": FIRST.when, "code_then": FIRST.code, "difference": 1.0,
}  # fmt: skip
SECOND = replace(
    FIRST,
    when="2026-03-09T03:00:07Z",
    code="0.1.0 (def5678-dirty)",
    revision=None,
    regression=WORSE,
    rows=[row("mlp_k01", 5.0)],
)


def test_the_chart_has_a_point_a_table_with_interval_data_and_commit():
    chart = history_chart([FIRST, SECOND], unit="px").to_dict()
    points = next(iter(chart["datasets"].values()))
    shown = {(p["run"], p["policy"], p["error"], p["low"], p["high"], p["data"], p["champion"]) for p in points}
    assert shown == {
        ("1: 2026-03-02 abc1234", "mlp_k01", 4.0, 3.6, 4.4, "999999999999 (content cccccccccccc)", True),
        ("1: 2026-03-02 abc1234", NASTY, 5.0, 4.5, 5.5, "999999999999 (content cccccccccccc)", False),
        ("2: 2026-03-09 def5678-dirty", "mlp_k01", 5.0, 4.5, 5.5, "content cccccccccccc", True),
    }, "what is twenty times as bad would flatten the rest"
    assert "first-step MAE (px)" in json.dumps(chart)


@pytest.fixture
def page_of_two(tmp_path):
    page = tmp_path / "history.html"
    write_history_page([FIRST, SECOND], page, name=f"tape {NASTY}", unit="px")
    return page


def test_the_page_tells_every_table_and_asks_for_nothing(page_of_two):
    assert picture_history([FIRST, SECOND], unit="px").startswith(b"\x89PNG")
    text = page_of_two.read_text(encoding="utf-8")
    assert outside_references(page_of_two) == []
    assert "<script" not in text
    said = "It got worse than the result of 2026-03-02 (0.1.0 (abc1234)): error 25 % higher."
    told = re.sub(r"<[^>]+>", " ", text)
    for words in (
        "4.00 [3.60, 4.40]",
        "0.82 [0.69, 0.91] of 50",
        "0.1.0 (def5678-dirty)",
        "2: 2026-03-09 03:00 UTC",
        "✗ worse",
        said,
    ):
        assert words in " ".join(told.split()), words
    assert text.index("0.1.0 (def5678-dirty)</small>") < text.index("0.1.0 (abc1234)</small>"), (
        "the latest table comes first"
    )
    assert 'aria-label="First-step errors of 2 tables' in text
    assert 'href="../benchmark_report/report.html"' in text


def test_observation_sets_of_a_policy_are_told_apart():
    both = replace(FIRST, rows=[row("mlp_k01", 4.0), row("mlp_k01", 5.0, observations="pose")])
    shapes = [
        layer["encoding"]["shape"]
        for layer in history_chart([both], unit="px").to_dict()["layer"]
        if "shape" in layer["encoding"]
    ]
    assert [shape["scale"]["domain"] for shape in shapes] == [["pose", "state"]]
    (alone,) = (
        layer["encoding"]["shape"]
        for layer in history_chart([FIRST], unit="px").to_dict()["layer"]
        if "shape" in layer["encoding"]
    )
    assert alone["legend"] is None


def visit(browser, page, **context):
    """The open page, what it asked for and what it complained about."""
    shown = browser.new_page(**context)
    asked, said = [], []
    shown.on("request", lambda request: asked.append(request.url))
    shown.on("console", lambda message: said.append(message.text))
    shown.goto(page.as_uri())
    return shown, asked, said


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_chart_is_in_the_readers_colours_and_a_phone_sees_the_latest_table_first(browser, tmp_path, scheme):
    page = tmp_path / "history.html"
    many = [replace(FIRST, when=f"{year}-03-02T03:00:05Z", rows=[row("mlp_k01", 4.0)]) for year in range(2026, 2046)]
    write_history_page(many, page, name="tape", unit="px")
    shown, asked, said = visit(browser, page, viewport={"width": 390, "height": 844}, color_scheme=scheme)
    assert (asked, said) == ([page.as_uri()], [])
    ground = shown.evaluate("getComputedStyle(document.body).backgroundColor")
    assert ground == {"light": "rgb(255, 255, 255)", "dark": "rgb(20, 23, 27)"}[scheme]
    white = (
        "[...document.querySelectorAll('svg *')].filter(e => getComputedStyle(e).fill == 'rgb(255, 255, 255)').length"
    )
    assert shown.evaluate(white) == 0
    label = shown.get_by_text("2045-03-02").first
    assert (
        label.evaluate("e => getComputedStyle(e).fill")
        == {"light": "rgb(89, 98, 108)", "dark": "rgb(163, 171, 181)"}[scheme]
    )
    assert shown.evaluate("document.documentElement.scrollWidth") == 390
    assert 0 < label.bounding_box()["x"] < 390
    assert shown.get_by_text("2026-03-02").first.bounding_box()["x"] < 0
    shown.close()


def test_names_do_nothing_in_a_browser(browser, page_of_two):
    shown, asked, said = visit(browser, page_of_two)
    assert (asked, said) == ([page_of_two.as_uri()], [])
    assert shown.evaluate("window.pwned") is None
    assert shown.locator("h1").inner_text() == f"tape {NASTY}: history"
    assert shown.locator("img").count() == 0
    shown.close()


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1300, 390])
def test_axe_finds_nothing_serious(browser, page_of_two, width, scheme):
    from axe_playwright_python.sync_playwright import Axe

    shown, _, _ = visit(browser, page_of_two, viewport={"width": width, "height": 900}, color_scheme=scheme)
    found = Axe().run(shown).response["violations"]
    shown.close()
    serious = [one for one in found if one["impact"] in ("serious", "critical")]
    assert not serious, [(one["id"], [node["html"][:200] for node in one["nodes"]]) for one in serious]


def test_only_the_latest_tables_are_drawn():
    many = [replace(FIRST, when=f"{year}-03-02T03:00:05Z") for year in range(2026, 2066)]
    points = next(iter(history_chart(many, unit="px").to_dict()["datasets"].values()))
    assert {p["run"][:2] for p in points} == {str(n) for n in range(11, 41)}
    width = int.from_bytes(picture_history(many, unit="px")[16:20])  # of the PNG
    assert width < 2 * 1300, "a picture cannot be scrolled"


def test_a_table_without_a_number_is_told_and_not_drawn(tmp_path):
    empty = replace(FIRST, champion=None, named=None, rows=[row("mlp_k01", None)])
    assert picture_history([empty], unit=None) is None
    write_history_page([empty], tmp_path / "history.html", name="tape", unit=None)
    text = (tmp_path / "history.html").read_text(encoding="utf-8")
    assert "No champion is named" in text
    assert "<svg" not in text

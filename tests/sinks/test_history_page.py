"""The page of a history: every table with its data and code, the chart, nothing from outside, nothing that runs."""

import json
from dataclasses import replace

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


def test_the_page_tells_every_table_and_asks_for_nothing(tmp_path):
    page = tmp_path / "history.html"
    picture = picture_history([FIRST, SECOND], unit="px")
    assert picture.startswith(b"\x89PNG")
    write_history_page([FIRST, SECOND], picture, page, name=f"tape {NASTY}", unit="px")
    text = page.read_text(encoding="utf-8")
    assert outside_references(page) == []
    assert "<script" not in text
    said = "It got worse than the result of 2026-03-02 (0.1.0 (abc1234)): error 25 % higher."
    for words in (
        "4.00 [3.60, 4.40]",
        "0.82 [0.69, 0.91] of 50",
        "0.1.0 (def5678-dirty)",
        "2026-03-09 03:00 UTC",
        said,
    ):
        assert words in text, words
    assert text.index("def5678") < text.rindex("abc1234)</td>"), "the latest table comes first"
    assert 'alt="First-step errors of 2 tables' in text


def test_only_the_latest_tables_are_drawn():
    many = [replace(FIRST, when=f"{year}-03-02T03:00:05Z") for year in range(2026, 2066)]
    points = next(iter(history_chart(many, unit="px").to_dict()["datasets"].values()))
    assert {p["run"][:2] for p in points} == {str(n) for n in range(11, 41)}


def test_a_table_without_a_number_is_told_and_not_drawn(tmp_path):
    empty = replace(FIRST, champion=None, named=None, rows=[row("mlp_k01", None)])
    picture = picture_history([empty], unit=None)
    assert picture is None
    write_history_page([empty], picture, tmp_path / "history.html", name="tape", unit=None)
    text = (tmp_path / "history.html").read_text(encoding="utf-8")
    assert "No champion is named" in text
    assert "<img" not in text

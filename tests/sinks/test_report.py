"""The page: complete, safe whatever a data set is called, and silent on the network."""

import base64
import hashlib
import html
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline.errors import StoreError
from pipeline.sinks import report
from pipeline.sinks.figures import benchmark_figures
from pipeline.sinks.markup import outside_references
from pipeline.sinks.report import Provenance, render_report, write_report
from pipeline.sinks.report_video import Clip, video_section
from pipeline.sinks.rollout_video import write_video
from pipeline.types import ACTION

from .driving import make_driven
from .making import (
    NASTY,
    make_bracket,
    make_comparison,
    make_demos,
    make_gap,
    make_refusal,
    make_row,
    make_semantics,
    make_sensor,
    make_table,
    make_verdict,
)

PROVENANCE = Provenance("demobench run small --protocol strict", 3, "0.1.0 (1a2b3c4)", "2026-11-23", ("dead column",))


@pytest.fixture
def figures(table, demos, semantics, predictions, floor, rollouts):
    return benchmark_figures(table, demos, semantics, predictions, [floor], [rollouts])


def text_of(page: str) -> str:
    """The words of the body, scripts and pictures left out."""
    body = re.sub(r"<(script|style|svg)\b.*?</\1>", " ", page.partition("<body>")[2], flags=re.S)
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", body)).split())


def scripts_of(page: str) -> list[tuple[str, str]]:
    return re.findall(r"<script([^>]*)>(.*?)</script>", page, flags=re.S)


def test_the_table_comes_first_and_holds_the_numbers(table, figures):
    page = text_of(render_report(table, figures, PROVENANCE))
    assert "mlp_k01 state 4.50 [4.05, 4.95] 4.44 ✓ better 5.62 1.62 [1.25, 2.00] – – 0.0450 – – 275,462 12 s" in page
    assert "mlp_k04 state 5.50 [4.95, 6.05] 3.64 ✓ better 6.88 – – – 0.0550 41/50 69–91 % 0.934" in page
    assert page.index("275,462") < page.index("How fast does the error grow")
    heads = "First-step MAE px, 95 % interval × hold-still ratio, tested RMSE px Above floor RMSE, px At 1 s MAE, px"
    assert heads in page


def test_budget_protocol_seeds_folds_and_hashes_are_said(table, figures):
    page = text_of(render_report(table, figures, PROVENANCE))
    assert "protocol strict · budget quick (2 seeds × 600 steps) · 1 fold · 2 episodes held out" in page
    assert "3 episodes · 90 frames · 10 fps · 2 action columns (position; px) · revision 0123456789ab" in page
    for said in (table["dataset"]["content_hash"], table["split"]["hash"], PROVENANCE.command, PROVENANCE.version):
        assert said in page
    assert "rerun --bind 127.0.0.1 out/held_out.rrd" in page
    assert "12 probes, median group 5 frames" in page
    assert "dead column" in page


def test_the_answer_is_in_a_sentence(table, figures):
    page = text_of(render_report(table, figures, PROVENANCE))
    said = "its next action is off by 4.50 px on average [4.05, 4.95] (first-step MAE). It is better than hold-still ,"
    assert "Closest to the demonstrations is mlp_k01 seeing state: in 2 episodes that it never saw" in page
    assert f"{said} whose error is 4.44 times as large." in page
    assert page.index(said) < page.index("× hold-still")
    assert "It is 1.62 px RMSE above the floor [1.25, 2.00]" in page
    assert "mlp_k04 seeing state succeeds most often: 41 of 50 (69–91 %)." in page


def test_what_was_not_asked_is_said_with_the_command_that_asks(table, figures):
    page = render_report(table, figures, PROVENANCE)
    assert "Would more demonstrations help? Not asked yet: demobench curve small trains on ever fewer" in text_of(page)
    assert "<code>demobench curve small</code>" in page
    answered = replace(figures[0], answer="50 more would help.")
    assert "Would more demonstrations help? 50 more would help." in text_of(
        render_report(table, [answered, *figures], PROVENANCE)
    )


def test_many_budgets_are_counted_above_and_listed_below(table, figures):
    table["budget"]["own"] = {f"base_k{k:02d}": "60 CPU-seconds" for k in range(12)} | {"act_k16": "900 steps"}
    page = text_of(render_report(table, figures, PROVENANCE))
    assert (
        "quick (2 seeds × 600 steps), 13 policies have budgets of their own: 60 CPU-seconds, 900 steps · 1 fold" in page
    )
    assert "Budgets 60 CPU-seconds: base_k00, base_k01," in page
    assert "; 900 steps: act_k16. All others: quick (2 seeds × 600 steps)." in page
    table["budget"]["own"] = {"act_k16": "900 steps"}
    page = text_of(render_report(table, figures, PROVENANCE))
    assert "act_k16 has a budget of its own: 900 steps · 1 fold" in page


def test_the_sentence_names_no_observations_where_they_do_not_matter(table, figures):
    table["policies"][-1]["first_step_mae"] = 1.0
    page = text_of(render_report(table, figures, PROVENANCE))
    assert "Closest to the demonstrations is hold_still : in 2 episodes that it never saw its next action" in page
    assert "So no policy is better than holding still." in page


def test_what_does_not_apply_is_said_once(demos, semantics, table):
    for row in table["policies"]:
        row |= {"rollouts": None, "interval": {"first_step_mae": None}, "verdict": make_verdict(), "above_floor": []}
    table["dataset"] |= {"revision": None, "action_units": [None, None]}
    table["floor"] = {"radius": None, "estimates": []}
    table |= {"brackets": [], "comparisons": []}
    page = text_of(
        render_report(table, benchmark_figures(table, demos, semantics, []), replace(PROVENANCE, warnings=()))
    )
    assert "Closed loop: no simulator for this data set." in page
    assert "No intervals: they need at least five held-out episodes." in page
    assert "The data set does not state the unit of its actions." in page
    assert "no revision" in page
    assert "No difference between policies is tested here" in page
    for absent in ("Success", "warning", "Radius floor", "None", "nan", "How good can it get", "Which differences"):
        assert absent not in page, absent


def test_what_is_behind_closed_loop_numbers_is_said(table, figures):
    for row, why in zip(table["policies"], ("it does not fit", None, None), strict=True):
        row["no_rollouts"] = why
    table["policies"][1]["rollouts"] |= {
        "interventions": 9, "intervened": 0.0123, "mean_intervention": 0.25, "stopped": 0, "stopped_not_finite": 0,
    }  # fmt: skip
    table["policies"][1] |= {
        "latency_p99_ms": 250.0, "deadline_ms": 100.0, "misses_deadline": True,
        "execution": {"execute": 1, "ensemble": False, "delay": 0},
    }  # fmt: skip
    page = text_of(render_report(table, figures, PROVENANCE))
    assert "stepped in, % of frames" in page
    assert "1.23 by 25 %" in page
    assert "99 %: 250 misses its deadline" in page
    assert "One call in a hundred of mlp_k04 takes 250 ms or more on this machine, and it is asked every 100 ms" in page
    assert "No roll-outs of mlp_k01: it does not fit." in page
    table["policies"][1]["rollouts"] = None
    assert "no simulator for this data set" not in text_of(render_report(table, figures, PROVENANCE))


def test_mixed_units_are_warned_of(table, figures):
    table["dataset"]["action_units"] = ["rad", "m"]
    assert "Action columns have different units" in text_of(render_report(table, figures, PROVENANCE))


def test_the_notebook_protocol_is_explained_as_what_it_is(table, figures):
    table |= {"protocol": "notebook", "brackets": []}
    page = text_of(render_report(table, figures, PROVENANCE))
    assert "normalisation has seen the held-out episodes" in page
    assert "Means and deviations come from training episodes only." not in page
    assert "No policy is held against a floor under protocol notebook" in page


def test_an_empty_distance_to_the_floor_is_explained(demos, table, figures):
    table["policies"].append(make_row("act", "act", demos, observations="pose"))
    table["floor"]["estimates"].append(make_refusal(observations="pose"))
    page = text_of(render_report(table, figures, PROVENANCE))
    assert "“Above floor” is empty where no floor could be given (seeing pose): the reasons are below." in page
    assert "“Above floor” is empty for hold_still, which sees more than the set beside the name." in page


def test_errors_of_each_action_column_are_there(table, figures):
    page = text_of(render_report(table, figures, PROVENANCE))
    assert "First-step MAE of each action column In each column's own unit. This table scrolls sideways." in page
    assert "Policy and what it sees x px y px mlp_k01 state 4.50 5.50" in page


def test_missing_numbers_are_dashes_and_the_page_is_still_json(table, figures):
    table["policies"][0] |= {"first_step_mae": None, "error_by_horizon": [None], "scaled": None, "latency_ms": None}
    page = render_report(table, figures, PROVENANCE)
    assert "mlp_k01 state – 4.44 ✓ better 5.62 1.62 [1.25, 2.00] – – – – – 275,462 12 s –" in text_of(page)
    json.loads(scripts_of(page)[0][1])


def hostile_page() -> str:
    """A page on which every name that a data set chooses is an attack."""
    demos = make_demos()
    names = (f"{NASTY}a", '"></style><img src=x onerror="window.pwned=1">')
    features = {key: replace(f, names=names, units=(NASTY, NASTY)) for key, f in demos.features.items()}
    demos = replace(demos, name=f"</title>{NASTY}", features=features)
    semantics = make_semantics(demos)
    table = make_table(demos, semantics)
    for named in (*table["policies"], *table["floor"]["estimates"], *table["brackets"]):
        named["observations"] = f"set'{NASTY}"
    table["brackets"][0]["upper_policy"] = f"p/{NASTY}"
    table["floor"]["estimates"] += [make_refusal(horizon=10, observations=NASTY, refused=NASTY)]
    table["brackets"] += [make_bracket(horizon=10, observations=NASTY, lower=None)]
    table["sensors"] = [make_sensor(smaller=NASTY, larger=f"{NASTY}&")]
    table["comparisons"] += [make_comparison(f"x]{NASTY}/a", f"hold_still/{NASTY}", "not comparable", words=NASTY)]
    table["policies"].append(make_row(f"x]{NASTY}", "act", demos, chunk=2, observations=f"set'{NASTY}"))
    provenance = Provenance(f"demobench run '{NASTY}'", 3, NASTY, warnings=(f"<b>{NASTY}",))
    return render_report(table, benchmark_figures(table, demos, semantics, []), provenance)


def test_the_settings_that_give_the_numbers_again_are_there(table, figures):
    page = render_report(table, figures, replace(PROVENANCE, settings='[benchmark]\nprotocol = "strict"\n'))
    assert 'All settings, as a demobench.toml [benchmark] protocol = "strict" Data set small' in text_of(page)
    assert f"In a folder without a demobench.toml: {PROVENANCE.command} All settings" in text_of(page)
    page = text_of(render_report(table, figures, replace(PROVENANCE, settings="[benchmark]", needs=True)))
    assert f"In a folder that holds the settings below as demobench.toml: {PROVENANCE.command} All settings" in page
    assert "All settings" not in text_of(render_report(table, figures, PROVENANCE))


def test_names_from_a_data_set_stay_text():
    page = hostile_page()
    assert NASTY not in page
    assert "<img" not in re.sub(r"<script\b.*?</script>", "", page, flags=re.S)
    assert NASTY in text_of(page)
    assert [attributes for attributes, _ in scripts_of(page)] == [' type="application/json" id="charts"', "", ""]
    assert "</title>" not in page.partition("<title>")[2].partition("</title>")[2]
    style = page.partition("<style>")[2].partition("</style>")[0]
    assert "<" not in style


def test_only_the_two_scripts_that_the_policy_names_may_run(table, figures):
    page = render_report(table, figures, PROVENANCE)
    policy = html.unescape(re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', page)[1])
    hashes = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for _, text in scripts_of(page)[1:]]
    assert re.findall(r"'sha256-([^']*)'", policy) == hashes
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert "unsafe-eval" not in policy


def test_the_file_asks_for_nothing_and_is_small(tmp_path, table, figures):
    write_report(tmp_path / "report.html", table, figures, PROVENANCE)
    assert outside_references(tmp_path / "report.html") == []
    assert (tmp_path / "report.html").stat().st_size < 3e6
    assert list(tmp_path.iterdir()) == [tmp_path / "report.html"]


def content_policy(page: str) -> str:
    return html.unescape(re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', page)[1])


@pytest.fixture
def clip(tmp_path) -> Clip:
    rollouts = make_driven((5, 3))
    mp4, poster = tmp_path / "state.mp4", tmp_path / "state.png"
    return Clip(write_video(mp4, poster, rollouts, rollouts.scenes), mp4, poster)


def test_videos_are_in_the_page_and_the_policy_lets_them_and_nothing_else_in(tmp_path, table, figures, clip):
    path = tmp_path / "report.html"
    write_report(path, table, figures, PROVENANCE, [clip])
    page = path.read_text()
    [video] = re.findall(r"<video [^>]*>", page)
    inside = re.search(r'src="data:video/mp4;base64,([^"]*)"', video)[1]
    assert base64.b64decode(inside) == clip.mp4.read_bytes()
    assert " controls muted playsinline loop " in video
    assert 'poster="data:image/png;base64,' in video
    assert clip.video.caption in text_of(page)
    rules = [rule.split() for rule in content_policy(page).split(";")]
    assert ["media-src", "data:"] in rules
    assert {rule[0] for rule in rules} == {
        "default-src", "script-src", "style-src", "img-src", "media-src", "base-uri", "form-action",
    }  # fmt: skip
    assert outside_references(path) == []


def test_the_video_with_the_most_successes_comes_first(clip):
    worse, better = (replace(clip, video=replace(clip.video, succeeded=n, policy=f"p{n}")) for n in (0, 1))
    page = str(video_section([worse, better], {}))
    assert page.index("p1 (seeing") < page.index("p0 (seeing")


def test_a_page_without_videos_has_no_section_and_lets_none_in(table, figures):
    page = render_report(table, figures, PROVENANCE)
    assert "<video" not in page
    assert "drives by itself?" not in text_of(page).replace("when it drives by itself?", "")
    assert "media-src" not in content_policy(page)


def test_why_a_video_is_missing_is_said_and_escaped(tmp_path, table, figures):
    write_report(tmp_path / "a.html", table, figures, PROVENANCE, [], {"pose": f"damaged {NASTY}"})
    page = (tmp_path / "a.html").read_text()
    assert f"No video of pose: damaged {NASTY}" in text_of(page)
    assert NASTY not in page.partition("<body>")[2]


def test_a_place_that_cannot_be_written_is_one_clear_message(tmp_path, table):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StoreError, match=r"report\.html cannot be written: .*choose another folder"):
        write_report(tmp_path / "file" / "report.html", table, [], PROVENANCE)


# In a browser ---------------------------------------------------------------------------------------------------------


def visit(browser, path: Path, **context):
    """The page once every chart is drawn, with what it asked for and what it complained about."""
    page = browser.new_page(**context)
    asked, said = [], []
    page.on("request", lambda request: asked.append(request.url))
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.goto(path.as_uri())
    places = page.locator("[data-chart]").count()  # no function to wait for: the page's own policy forbids `eval`
    page.locator("[data-chart] svg").nth(places - 1).wait_for(state="attached", timeout=60_000)
    return page, asked, said


def test_a_browser_draws_every_chart_and_asks_for_nothing(browser, tmp_path, table, figures):
    path = tmp_path / "report.html"
    write_report(path, table, figures, PROVENANCE)
    page, asked, said = visit(browser, path)
    assert asked == [path.as_uri()]
    assert said == []
    assert page.locator("[data-chart] svg").count() == sum(len(figure.panels) for figure in figures)
    page.close()


def test_hostile_names_do_nothing_in_a_browser(browser, tmp_path):
    (tmp_path / "page.html").write_text(hostile_page(), encoding="utf-8")
    page, asked, said = visit(browser, tmp_path / "page.html")
    assert page.evaluate("window.pwned") is None
    assert len(asked) == 1
    assert said == []
    assert page.locator("img").count() == 0
    assert page.locator("h1").inner_text() == f"</title>{NASTY}"
    page.close()


def test_a_reader_chooses_what_is_drawn(browser, tmp_path, table, figures):
    write_report(tmp_path / "report.html", table, figures, PROVENANCE)
    page, asked, said = visit(browser, tmp_path / "report.html")
    place = page.locator("figure:has(.menus) .chart")
    lines = "[...document.querySelectorAll('figure:has(.menus) .mark-line path')].map(line => line.getAttribute('d'))"
    menus = {name: page.locator(f".menus select[name={name}]") for name in ("episode", "column", "ahead")}
    assert page.locator(".menus .vega-bind-name").all_inner_texts() == ["Episode", "Action", "How far ahead"]
    assert {name: menu.input_value() for name, menu in menus.items()} == {
        "episode": "8 (largest error)", "column": "x (px)", "ahead": "0.2 s ahead",
    }  # fmt: skip
    assert "mlp_k04: 5" in place.inner_text()  # the predictions are the recorded actions, and 5 px beside them
    assert "mlp_k01: " not in place.inner_text()  # its chunk ends before
    seen = [page.evaluate(lines)]
    for name, value in (("episode", "9 (smallest error)"), ("column", "y (px)"), ("ahead", "first action")):
        menus[name].select_option(value)
        page.wait_for_timeout(200)
        seen.append(page.evaluate(lines))
    assert len({tuple(paths) for paths in seen}) == 4
    assert "episode 9 (smallest error), first action" in place.inner_text()
    assert "mlp_k01: 5" in place.inner_text()
    assert said == []
    assert len(asked) == 1
    page.emulate_media(media="print")
    assert not page.locator(".menus").is_visible()
    page.close()


def test_without_javascript_every_picture_stands_still(browser, tmp_path, table, figures):
    write_report(tmp_path / "report.html", table, figures, PROVENANCE)
    context = browser.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto((tmp_path / "report.html").as_uri())
    places = page.locator("[data-chart]")
    assert places.count() == sum(len(figure.panels) for figure in figures)
    for place in places.all():
        assert place.locator("svg").bounding_box()["height"] > 50
    assert "episode 8 (largest error), 0.2 s ahead" in page.locator("figure:has(.menus)").inner_text()
    assert "Without JavaScript the pictures below stand still" in page.locator("main").inner_text()
    context.close()


def test_a_picture_of_too_many_points_is_left_out_for_want_of_javascript(monkeypatch, table, figures):
    monkeypatch.setattr("pipeline.sinks.report.MOST_STILL", 20_000)
    report._still.cache_clear()
    page = render_report(table, figures, PROVENANCE)
    report._still.cache_clear()
    assert "This picture has too many points to stand here without JavaScript." in page
    assert "<noscript><svg" in page


@pytest.mark.parametrize("paper", [(1123, 794), (794, 1123)], ids=["landscape", "portrait"])
def test_on_paper_nothing_is_cut(browser, tmp_path, table, figures, clip, paper):
    """A4 less margins of 12 mm, with every column that the table can have, and a dark screen."""
    full_of_columns(table)
    write_report(tmp_path / "report.html", table, figures, PROVENANCE, [clip])
    page, _, _ = visit(browser, tmp_path / "report.html", viewport={"width": 1300, "height": 900}, color_scheme="dark")
    page.emulate_media(media="print")
    inside = paper[0] - 91
    page.set_viewport_size({"width": inside, "height": paper[1] - 91})
    right = "[...document.querySelectorAll('td, th, svg, pre, video, dd, p')].map(e => e.getBoundingClientRect().right)"
    assert max(page.evaluate(right)) <= inside + 1
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    page.close()


def test_a_desk_shows_every_column(browser, tmp_path, table, figures):
    full_of_columns(table)
    write_report(tmp_path / "report.html", table, figures, PROVENANCE)
    page, _, _ = visit(browser, tmp_path / "report.html", viewport={"width": 1300, "height": 900})
    beyond = "[...document.querySelectorAll('.scroll')].map(one => one.scrollWidth - one.clientWidth)"
    assert set(page.evaluate(beyond)) == {0}
    assert not page.locator(".sideways").first.is_visible()
    page.set_viewport_size({"width": 390, "height": 844})
    assert page.evaluate(beyond)[0] > 0
    assert page.locator(".sideways").first.is_visible()
    page.close()


def full_of_columns(table) -> None:
    """A champion, a safety layer that stepped in, long names and numbers: the widest that a table of one unit gets."""
    safety = {
        "interventions": 9,
        "intervened": 0.1234,
        "mean_intervention": 0.25,
        "stopped": 0,
        "stopped_not_finite": 0,
    }
    rolled = table["policies"][1]["rollouts"] | safety
    rolled |= {"episodes": 1500, "score_interval": [0.912, 0.987], "success_interval": [0.55, 0.68]}
    for row in table["policies"]:
        words = dict.fromkeys(("vs_hold_still", "vs_champion", "vs_hold_still_at_one_second"), "cannot tell")
        row |= {
            "rollouts": rolled, "verdict": make_verdict(**words), "at_one_second_mae": 41.25, "whole_chunk_mae": 31.25,
            "above_floor": [make_gap()], "latency_p99_ms": 12.345, "misses_deadline": False, "params": 2150944,
        }  # fmt: skip
    table["comparisons"].append(make_comparison("mlp_k04/state", "mlp_k01/state", "cannot tell"))


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_charts_follow_the_readers_setting(browser, tmp_path, table, figures, scheme):
    write_report(tmp_path / "report.html", table, figures, PROVENANCE)
    page, _, _ = visit(browser, tmp_path / "report.html", color_scheme=scheme)
    ground = page.evaluate("getComputedStyle(document.body).backgroundColor")
    line = page.evaluate("getComputedStyle(document.querySelector('[data-chart] svg path[stroke^=var]')).stroke")
    assert ground == {"light": "rgb(255, 255, 255)", "dark": "rgb(20, 23, 27)"}[scheme]
    assert line.startswith("rgb(")
    assert line != ground
    page.emulate_media(media="print")
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    page.close()


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize(
    "viewport", [{"width": 1300, "height": 900}, {"width": 390, "height": 844}], ids=["desk", "phone"]
)
def test_axe_finds_nothing_serious(browser, tmp_path, table, figures, clip, viewport, scheme):
    from axe_playwright_python.sync_playwright import Axe

    table["sensors"] = [make_sensor()]
    table["comparisons"] += [make_comparison("mlp_k04/state", "mlp_k01/state", "cannot tell", words="needs " * 20)]
    write_report(tmp_path / "report.html", table, figures, PROVENANCE, [clip])
    page, _, _ = visit(browser, tmp_path / "report.html", viewport=viewport, color_scheme=scheme)
    for folded in page.locator("details").all():
        folded.evaluate("element => element.open = true")
    found = Axe().run(page).response["violations"]
    page.close()
    serious = [one for one in found if one["impact"] in ("serious", "critical")]
    assert not serious, [(one["id"], [node["html"][:200] for node in one["nodes"]]) for one in serious]


def test_a_phone_scrolls_the_table_and_nothing_else(browser, tmp_path, table, figures):
    table["sensors"] = [make_sensor()]
    table["comparisons"] += [make_comparison("mlp_k04/state", "mlp_k01/state", "cannot tell", words="needs " * 20)]
    write_report(tmp_path / "report.html", table, figures, PROVENANCE)
    page, _, _ = visit(browser, tmp_path / "report.html", viewport={"width": 390, "height": 844})
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    assert page.evaluate("Math.max(...[...document.querySelectorAll('.chart svg')].map(s => s.clientWidth))") <= 358
    tables = "[...document.querySelectorAll('.words')].map(t => t.scrollWidth - t.clientWidth)"
    assert page.evaluate(tables) == [0, 0, 0]
    page.close()


def test_the_units_of_the_data_reach_the_page(tmp_path, demos, semantics, table, predictions):
    assert demos.features[ACTION].units == ("px", "px")
    page = render_report(table, benchmark_figures(table, demos, semantics, predictions), PROVENANCE)
    assert "mean error (px)" in page


def test_a_browser_plays_the_video_that_the_page_holds(browser, tmp_path, table, figures, clip):
    path = tmp_path / "report.html"
    write_report(path, table, figures, PROVENANCE, [clip])
    page, asked, said = visit(browser, path)
    video = page.locator("video")
    video.scroll_into_view_if_needed()
    page.wait_for_timeout(1500)
    size = [video.evaluate(f"one => one.{name}") for name in ("videoWidth", "videoHeight", "duration")]
    assert size[:2] == [clip.video.width, clip.video.height]
    assert size[2] == pytest.approx(clip.video.frames / clip.video.fps, abs=0.02)
    assert [url for url in asked if not url.startswith(("file:", "data:"))] == []
    assert said == []
    page.close()

"""Charts are valid Vega-Lite, drawable without a network, and hold what they were given."""

import json

import numpy as np
import pytest
from PIL import Image

from pipeline.sinks import bracket_chart, charts, planes
from pipeline.sinks.drawing import chart_png, equal_domains, number, with_unit
from pipeline.sinks.palette import policy_colours

from .making import NASTY, make_row

NAN = float("nan")
NAMES = ["a.b[0]", NASTY]
"""Names that would be paths or markup if they were used as anything but text."""


def all_charts(demos) -> dict:
    rng = np.random.default_rng(0)
    points, wave = rng.normal(size=(20, 2)), np.sin(np.arange(30))
    paths = np.cumsum(rng.normal(size=(3, 12, 2)), axis=1)
    paths[1, 5:] = np.nan
    rows = [make_row("mlp_k01", "mlp", demos, chunk=1), make_row("mlp_k16", "mlp", demos, chunk=16, interval={})]
    curves = {"mlp_k16": [1.0, NAN, 3.0], "hold_still": [2.0, 4.0, 8.0], "mean_action": [90.0, None]}
    series = {"state": wave, "recorded": wave + 1, "mlp_k16": np.where(wave > 0, wave, np.nan)}
    known = {"floor": 4.0, "upper": None, "low": 3.0, "high": 5.0, "limit": None, "error": 6.0, "policy": "mlp_k16"}
    span, refused = known | {"upper": 7.0}, known | {"floor": None, "low": None, "high": None, "limit": 5.0}
    lines = [line | {"label": f"{NAMES[1]} {i}", "name": NAMES[0]} for i, line in enumerate((known, span, refused))]
    return {
        "brackets": bracket_chart.brackets(lines, unit="px"),
        "horizon": charts.error_over_horizon(curves, fps=10, unit="px"),
        "bars": charts.chunk_bars(rows, unit=None, hold_still=9.0),
        "time": charts.columns_over_time(np.arange(30) / 10, series, unit="rad", name=NAMES[0]),
        "lag": charts.tracking_lag_bars([*NAMES, "gripper"], [1.0, 2.0, None], unit="px"),
        "loss": charts.loss_curves(np.arange(5), np.array([[1, 0.5, NAN, 0.1, 0.0]] * 2), policy="mlp_k16"),
        "floor": planes.floor_scatter(points, points[0], names=NAMES, unit="px", down=True),
        "scatter": planes.predicted_against_recorded(wave, series["mlp_k16"], what="move", unit=None, policy="mlp_k16"),
        "paths": planes.path_with_chunks(points, [points[:4], points[4:8]], names=NAMES, unit="px", policy="mlp_k16"),
        "rollouts": planes.rollout_paths(paths, np.array([True, False, True]), names=NAMES, unit="px"),
    }


CHARTS = ("brackets", "horizon", "bars", "time", "lag", "loss", "floor", "scatter", "paths", "rollouts")


def rows_of(chart) -> list[dict]:
    return [row for data in chart.to_dict()["datasets"].values() for row in data]


@pytest.mark.parametrize("name", CHARTS)
def test_definitions_are_strict_json_with_null_for_what_is_not_a_number(demos, name):
    text = json.dumps(all_charts(demos)[name].to_dict(), allow_nan=False)
    assert "http" not in text.replace("https://vega.github.io/schema/vega-lite/", "")


@pytest.mark.parametrize("name", CHARTS)
def test_pictures_are_drawn_without_a_browser(demos, name, tmp_path):
    (tmp_path / "chart.png").write_bytes(chart_png(all_charts(demos)[name], scale=1))
    picture = np.asarray(Image.open(tmp_path / "chart.png").convert("RGB"))
    colours = np.unique(picture.reshape(-1, 3), axis=0)
    assert min(picture.shape[:2]) > 80
    assert len(colours) > 20
    assert (picture[0, 0] == 255).all()


def test_a_policy_has_one_colour_in_every_chart(demos):
    colour = policy_colours(["mlp_k16"])["mlp_k16"].light
    for name in ("time", "loss", "scatter", "paths"):
        assert colour in json.dumps(all_charts(demos)[name].to_dict()), name
    everyone = ["mlp_k01", "mlp_k16", "hold_still"]
    colour = policy_colours(everyone)["mlp_k16"].light
    one = charts.loss_curves(np.arange(2), np.ones((1, 2)), policy="mlp_k16", everyone=everyone)
    assert colour in json.dumps(one.to_dict())


def test_curves_keep_seconds_steps_and_errors(demos):
    rows = [row for row in rows_of(all_charts(demos)["horizon"]) if row["policy"] == "mlp_k16"]
    assert rows == [
        {"policy": "mlp_k16", "seconds": 0.0, "step": 0, "error": 1.0},
        {"policy": "mlp_k16", "seconds": 0.2, "step": 2, "error": 3.0},
    ]


def test_a_constant_baseline_does_not_flatten_the_other_curves():
    curves = {"mlp_k16": [1.0, 3.0], "hold_still": [2.0, 8.0], "mean_action": [90.0, 90.0]}
    assert charts.axis_top(curves) == pytest.approx(8.64)
    assert charts.axis_top({"mean_action": [90.0]}) == pytest.approx(97.2)
    assert charts.axis_top({}) > 0
    assert charts.axis_top({"hold_still": [0.0]}) > 0


def test_bars_keep_their_order_and_name_the_observation_set_only_where_a_policy_comes_twice(demos):
    rows = [
        make_row("mlp_k16", "mlp", demos, observations="pose"),
        make_row("mlp_k16", "mlp", demos, observations="state", interval={"first_step_mae": None}),
        make_row("hold_still", "hold_still", demos),
    ]
    bars = [row for row in rows_of(charts.chunk_bars(rows, unit="px", hold_still=9.0)) if "policy" in row]
    assert [row["label"] for row in bars] == ["mlp_k16 (pose)", "mlp_k16 (state)", "hold_still"]
    assert bars[0]["low"] == 4.5
    assert bars[1]["low"] is None


def test_a_bracket_is_a_tick_a_span_or_an_open_line(demos):
    by_mark = {}
    for layer in all_charts(demos)["brackets"].to_dict()["layer"]:
        by_mark.setdefault(layer["mark"]["type"], []).append(layer)
    assert {"bar", "tick", "rule", "point", "text"} == set(by_mark)
    assert by_mark["bar"][0]["encoding"]["x2"]["field"] == "upper"
    domain = by_mark["tick"][0]["encoding"]["x"]["scale"]["domain"]
    assert domain == [0, pytest.approx(7.42)]
    dashed = next(rule for rule in by_mark["rule"] if "strokeDash" in rule["mark"])
    assert (dashed["encoding"]["x"]["field"], dashed["encoding"]["x2"]["field"]) == ("start", "limit")


def test_lag_leaves_out_columns_that_have_none(demos):
    assert [row["column"] for row in rows_of(all_charts(demos)["lag"])] == NAMES


def test_the_floor_scatter_marks_the_mean_and_the_state():
    actions = np.array([[0.0, 0.0], [4.0, 2.0]])
    rows = {
        row["what"]: (row["x"], row["y"])
        for row in rows_of(planes.floor_scatter(actions, np.ones(2), names="xy", unit="px"))
    }
    assert rows[planes.MEAN] == (2.0, 1.0)
    assert rows[planes.STATE_HERE] == (1.0, 1.0)
    without = rows_of(planes.floor_scatter(actions, None, names="xy", unit="px"))
    assert planes.STATE_HERE not in {row["what"] for row in without}


def test_pixels_count_downwards_only_where_asked():
    actions = np.eye(2)
    for down in (False, True):
        chart = planes.floor_scatter(actions, None, names="xy", unit="px", down=down).to_dict()
        scale = chart["layer"][0]["encoding"]["y"]["scale"]
        assert scale.get("reverse", False) is down


def test_equal_axes_and_numbers():
    (left, right), (bottom, top) = equal_domains(np.array([[0.0, 5.0], [10.0, 6.0], [NAN, NAN]]))
    assert right - left == pytest.approx(top - bottom)
    assert left < 0 < 10 < right
    assert [number(v) for v in (1 / 3, None, NAN, np.float32(2))] == [0.33333, None, None, 2.0]
    assert with_unit("error", None) == "error (unit unknown)"

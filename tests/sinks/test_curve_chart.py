"""The chart of a learning curve holds what it was given, and can be drawn without a network."""

import json

import numpy as np
from PIL import Image

from pipeline.sinks.curve_chart import learning_curve, picture_curve
from pipeline.statistics.curve import Floor
from pipeline.statistics.curve_errors import Point

POINTS = [
    Point(5, 3.2, (2.8, 3.7), (3.0, 3.5, 3.1)),
    Point(10, 2.4, (2.1, 2.8), (2.3, 2.6, 2.3)),
    Point(20, 2.0, (1.7, 2.3), (1.9, 2.1, 2.0)),
    Point(40, 1.8, None, (1.8,)),
]
FLOOR = Floor(1.2, 1.1, "the floor (1.2 deg or more)")


def test_it_holds_every_size_order_and_the_floor():
    chart = learning_curve(POINTS, what="first-step error", unit="deg", policy="mlp_k01", floor=FLOOR).to_dict()
    text = json.dumps(chart, allow_nan=False)
    rows = [row for data in chart["datasets"].values() for row in data]
    assert [row["episodes"] for row in rows if "low" in row] == [5, 10, 20, 40]
    assert sum("order" in row for row in rows) == 12, "three orders at every size; at the full one they meet"
    assert {"error": 1.2, "label": FLOOR.words} in rows
    assert '"base": 2' in text
    assert "[5, 10, 20, 40]" in text
    assert FLOOR.words not in json.dumps(
        learning_curve(POINTS, what="first-step error", unit=None, policy="mlp_k01").to_dict()
    )


def test_its_picture_is_drawn(tmp_path):
    picture_curve(POINTS, tmp_path / "c.png", what="first-step error", unit="deg", policy="mlp_k01", floor=FLOOR)
    picture = np.asarray(Image.open(tmp_path / "c.png").convert("RGB"))
    assert min(picture.shape[:2]) > 200
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 20

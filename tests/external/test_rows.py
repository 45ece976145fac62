"""Rows from elsewhere in a table: what they may claim, and what readers are told."""

from io import StringIO

import pytest
from rich.console import Console

from pipeline.experiment import Variant
from pipeline.external.pairing import on_episodes
from pipeline.methods import EXTERNAL
from pipeline.sinks.report_table import benchmark_table
from pipeline.sinks.text_table import render_table
from pipeline.statistics.floors import measure_floors
from pipeline.table import build_table
from tests.hand_made import STATE_ONLY, random_walks, semantics
from tests.statistics.test_metrics import scored, task_of
from tests.test_table import facts_of

SAMPLES = {
    "count": 8, "in_deviations": False, "energy": {"value": 1.25, "interval": None},
    "of_mean": {"value": 2.0, "interval": None}, "of_one": {"value": 3.5, "interval": None},
    "at_one_second": {"energy": {"value": 5.0}, "of_mean": {"value": 6.0}, "of_one": {"value": 9.0}},
    "by_horizon": {},
}  # fmt: skip


def from_elsewhere(entry, name, *, seen, stated=True, **more):
    """The same errors, as if they had been predicted elsewhere."""
    said = {
        "seen_in_training": seen,
        "training": f"{name}'s training",
        "episodes": [0, 1],
        "samples": None,
        "warnings": [],
    }
    return entry | {
        "variant": Variant(name, name, EXTERNAL, 1), "seeds": 3, "windows_train": None, "latency_ms": None, "parameters": None,
        "train_s": 0.0, "rollouts": None, "elsewhere": said | {"sight_stated": stated} | more,
        **({} if stated else {"observations": "elsewhere"}),
    }  # fmt: skip


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    demos = random_walks((40,) * 14, units={"action": ("px", "px")})
    entries = []
    for variant in ("hold_still", "nearest_neighbour"):
        task = task_of(demos, variant)
        score, predictions = scored(task, tmp_path_factory.mktemp(variant))
        entries.append({
            "variant": task.variant, "observations": "state", "metrics": score.metrics, "windows_train": 240,
            "windows_test": len(predictions.anchors), "errors": score.errors, "latency_ms": 0.1, "parameters": 0,
            "train_s": 0.0, "rollouts": None,
        })  # fmt: skip
    good = {**entries[1], "metrics": {**entries[1]["metrics"], "first_step_mae": 1e-3}}
    good["errors"] = on_episodes(entries[1]["errors"], entries[1]["errors"].episodes)
    for name in ("absolute", "squared", "l2"):
        getattr(good["errors"], name)[:] *= 1e-3
    entries += [
        from_elsewhere(good, "held", seen=False, warnings=["off by a constant: a0 by +3"], samples=SAMPLES),
        from_elsewhere(good, "seen", seen=True),
        from_elsewhere(good, "unknown", seen=None),
        from_elsewhere(good, "blind", seen=False, stated=False),
    ]
    estimates = measure_floors(demos, semantics(demos), STATE_ONLY, task.split, history=3, horizons=(0, 10))
    return build_table(facts_of(demos, semantics(demos)), task.experiment, task.split, [], estimates, entries)


def test_only_a_row_known_to_be_held_out_with_a_stated_sight_is_in_brackets(table):
    assert {b["upper_policy"] for b in table["brackets"] if b["horizon"] == 0} == {"held/state"}
    rows = {row["policy"]: row for row in table["policies"]}
    assert (rows["held"]["seeds"], rows["held"]["params"], rows["held"]["method"]) == (3, None, "external")
    assert rows["held"]["verdict"]["vs_hold_still"] == rows["blind"]["verdict"]["vs_hold_still"] == "better"
    assert set(rows["seen"]["verdict"].values()) == {None}
    words = {c["a"]: c["words"] for c in table["comparisons"]}
    assert words["unknown/state"].endswith("nothing is known about the episodes it was trained on")
    assert "seen in training" in words["seen/state"]


def drawn(table, width=200, **more):
    out = StringIO()
    render_table(table, Console(file=out, width=width, color_system=None), **more)
    return " ".join(out.getvalue().split())


def test_a_reader_is_told_where_a_row_comes_from(table):
    text = drawn(table, marked="held/state")
    for words in (
        "→ held", "seen (seen in training)", "held: held's training", "held: off by a constant: a0 by +3",
        "held: errors are of the mean of 8 samples; at the first action one sample is 3.50 px off (L2), fair energy score 1.25 px; "
        "one second ahead one sample is 9.00 px off (L2), fair energy score 5.00 px",
        "held, predicted elsewhere, has a first-step error of 0.00100 px on 2 episodes; it is better than hold-still on those",
        "on 2 episodes that it was trained on, which says nothing about others: no verdict",
    ):  # fmt: skip
        assert words in text


def test_what_is_best_is_said_of_rows_that_share_their_episodes(table):
    held_out = len({episode for fold in table["split"]["folds"] for episode in fold["test"]})
    words = " ".join(drawn(table).split())
    first = words.split(f"Of the rows on all {held_out} episodes held out, closest to the demonstrations is ")[1]
    assert first.startswith(("nearest_neighbour", "hold_still"))
    page = str(benchmark_table(table))
    assert "seen (seen in training)" in page
    assert page.index("held") < page.index("hold_still"), "the order is by error all the same"

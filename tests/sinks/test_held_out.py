"""What a reader may choose to look at, what it costs in size, and what is said of the rest."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pipeline.sinks import held_out
from pipeline.sinks.held_out import FEWEST_EPISODES, MOST_EPISODES, MOST_LINES, held_out_lines
from pipeline.sinks.held_out_chart import held_out_chart
from pipeline.types import ACTION, STATE

from .colour_vision import confused
from .making import NASTY, make_demos, make_predictions, make_row, make_semantics, make_table


def lines_of(rows, **chosen) -> list[dict]:
    return [row for row in rows if all(row.get(key) == value for key, value in chosen.items())]


def menus_of(chart: dict) -> dict[str, dict]:
    binds = {param["name"]: param.get("bind") for param in chart["params"]}
    return {name: bind for name, bind in binds.items() if isinstance(bind, dict)}


def test_a_prediction_stands_at_the_moment_that_it_is_about(demos, semantics, table, predictions):
    lines = held_out_lines(table, demos, semantics, predictions)
    assert lines.horizons == ("first action", "0.2 s ahead")  # the longest trained chunk has four actions at 10 fps
    assert lines.begin == "0.2 s ahead"  # one of the two trained policies reaches it
    frames = demos.episode(1)
    of = {"episode": lines.episodes[0], "column": "x (px)"}
    (recorded,) = lines_of(lines.rows, what="recorded", **of)
    np.testing.assert_allclose(recorded["y"], demos.columns[ACTION][frames, 0], atol=0.1)
    (state,) = lines_of(lines.rows, what="state", **of)
    np.testing.assert_allclose(state["y"], demos.columns[STATE][frames, 0], atol=0.1)
    (later,) = lines_of(lines.rows, what="mlp_k04", ahead="0.2 s ahead", **of)
    assert later["y"][:4] == [None] * 4  # two frames of history before the first anchor, and two steps ahead
    np.testing.assert_allclose(later["y"][4:], demos.columns[ACTION][frames, 0][4:] + 5, atol=0.1)
    assert not lines_of(lines.rows, what="mlp_k01", ahead="0.2 s ahead")
    assert lines_of(lines.rows, what="hold_still", ahead="0.2 s ahead")[0]["sees"] is None
    assert (recorded["first"], recorded["every"]) == (0, 0.1)


def test_the_ends_of_the_spread_are_named(demos, semantics, table):
    worse = make_predictions(demos, [1, 2], "mlp_k01", 1)
    worse.actions[:, demos.episode_of_frame[worse.anchors] == 1] += 50
    lines = held_out_lines(table, demos, semantics, [worse])
    assert lines.episodes == ("8 (largest error)", "9 (smallest error)")
    assert lines.left_out == ""


def test_sets_can_be_chosen_only_where_there_are_several(demos, semantics, table, predictions):
    assert held_out_lines(table, demos, semantics, predictions).sets == ()
    table["policies"].append(make_row("mlp_k01", "mlp", demos, observations="pose"))
    more = make_predictions(demos, [1, 2], "mlp_k01", 1, observations="pose")
    lines = held_out_lines(table, demos, semantics, [*predictions, more])
    assert lines.sets == ("state", "pose")
    assert lines.policies == ("mlp_k01", "mlp_k04", "hold_still")
    menus = [bind["name"] for bind in menus_of(held_out_chart(lines).to_dict()).values()]
    assert menus == ["Episode", "Action", "How far ahead", "Seeing"]


def test_what_was_seen_in_training_is_no_choice_and_baselines_alone_are(demos, semantics, table, predictions):
    for row in table["policies"]:
        row["seen_in_training"] = row["policy"] == "mlp_k01"
    assert held_out_lines(table, demos, semantics, predictions).policies == ("mlp_k04", "hold_still")
    alone = held_out_lines(table, demos, semantics, predictions[2:])
    assert alone.policies == ("hold_still",)
    assert alone.begin == "one second ahead"


def test_nothing_predicted_nothing_to_choose(demos, semantics, table):
    assert held_out_lines(table, demos, semantics, []) is None


@pytest.fixture(scope="module")
def large():
    """Forty episodes of a thousand frames, fourteen joints, twelve policies that look two seconds ahead."""
    demos = make_demos(columns=14, lengths=(1000,) * 40, fps=30.0, units="deg")
    semantics = make_semantics(demos)
    table = make_table(demos, semantics)
    names = [f"act_k{k}" for k in range(70, 82)]
    table["policies"] = [make_row(name, "act", demos, error=5.0 + i, chunk=70) for i, name in enumerate(names)]
    one = make_predictions(demos, list(range(20, 40)), names[0], 70)
    return table, demos, semantics, [replace(one, policy=name) for name in names]


def test_a_page_gains_less_than_a_megabyte_and_says_what_was_cut(large):
    lines = held_out_lines(*large)
    numbers = sum(len(row["y"]) for row in lines.rows)
    assert numbers <= 1.1 * held_out.MOST_NUMBERS
    assert numbers > 0.5 * held_out.MOST_NUMBERS  # not cut more than it takes
    assert len(json.dumps(lines.rows, separators=(",", ":"))) < 1e6
    assert len(lines.policies) == MOST_LINES
    assert len(lines.episodes) == 5 >= FEWEST_EPISODES
    assert lines.left_out.startswith(
        "To keep the file small: 5 episodes of 20 held out, spread from the smallest to the"
    )
    assert "of long episodes one frame in 25;" in lines.left_out
    assert lines.left_out.endswith("not act_k77, act_k78, act_k79, act_k80, act_k81.")


@pytest.mark.parametrize(("episodes", "per_frame"), [(1, 4), (500, 4), (500, 60), (12, 10**4), (2, 10**6)])
def test_fewer_points_come_before_fewer_episodes(episodes, per_frame):
    count, points = held_out._that_fits(episodes, per_frame)
    assert 1 <= count <= min(episodes, MOST_EPISODES)
    assert points >= 2
    assert points == 2 or count * points * per_frame <= held_out.MOST_NUMBERS
    if count < min(episodes, MOST_EPISODES):
        assert points <= held_out.FEWEST_POINTS


def test_names_are_values_and_never_expressions(semantics):
    demos = make_demos(lengths=(30, 24))
    features = {key: replace(f, names=(NASTY, "b' + alert(1) + '")) for key, f in demos.features.items()}
    demos = replace(demos, features=features)
    table = make_table(demos, make_semantics(demos))
    chart = held_out_chart(held_out_lines(table, demos, semantics, [make_predictions(demos, [1])])).to_dict()
    assert menus_of(chart)["column"]["options"] == [f"{NASTY} (px)", "b' + alert(1) + ' (px)"]
    text = json.dumps({key: value for key, value in chart.items() if key not in ("datasets", "params")})
    assert "script" not in text
    assert "alert" not in text


@pytest.mark.parametrize("ground", ["light", "dark"])
def test_lines_that_could_be_confused_by_colour_differ_in_dash(large, ground):
    from pipeline.sinks.palette import all_colours

    encoding = held_out_chart(held_out_lines(*large)).to_dict()["vconcat"][0]["layer"][1]["encoding"]
    colours, dashes = (encoding[channel]["scale"]["range"] for channel in ("color", "strokeDash"))
    shown = {colour.light: getattr(colour, ground) for colour in all_colours()}
    looks = [(shown[colour], dash) for colour, dash in zip(colours, dashes, strict=True)]
    recorded, *others = looks
    for place, (colour, dash) in enumerate(others):
        assert not confused(colour, recorded[0]) or dash != recorded[1]
        for other, another in others[:place]:
            assert dash != another or not confused(colour, other), (colour, other)

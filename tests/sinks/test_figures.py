"""Which pictures a page gets, and what they say about themselves."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.sinks.figures import (
    COLUMNS,
    benchmark_figures,
    best_predictions,
    bracket_figure,
    by_observation_set,
    chunk_figure,
    floor_figure,
    horizon_figure,
    lag_figure,
    rollout_figure,
)

from .making import (
    make_bracket,
    make_demos,
    make_floor,
    make_predictions,
    make_refusal,
    make_row,
    make_semantics,
    make_table,
)


def questions(figures) -> list[str]:
    return [figure.question for figure in figures]


def values(chart, field: str) -> list:
    return [row[field] for data in chart.to_dict()["datasets"].values() for row in data if field in row]


def test_a_benchmark_in_the_plane_has_one_figure_a_question(demos, semantics, table, predictions, floor, rollouts):
    figures = benchmark_figures(table, demos, semantics, predictions, [floor], [rollouts])
    assert questions(figures) == [
        "Between the floor and the best policy",
        "How fast does the error grow, the further ahead a policy predicts?",
        "What does a longer chunk cost on the very next action?",
        "Look for yourself: what would each policy have done?",
        "What would the policy have done in demonstrations that it never saw?",
        "Does it predict the right move?",
        "Where does the best policy go when it drives by itself?",
        "How much do demonstrators disagree in one and the same spot?",
        "How far does the robot lag behind its commands?",
    ]
    assert [panel.caption for panel in figures[4].panels] == ["Episode 8", "Episode 9"]


def test_every_joint_can_be_chosen_where_actions_are_no_plane():
    demos = make_demos(columns=8, units="deg")
    semantics = make_semantics(demos)
    figures = benchmark_figures(make_table(demos, semantics), demos, semantics, [make_predictions(demos, [1])])
    [panel] = figures[3].panels
    assert set(values(panel.chart, "column")) == {f"joint_{i} (deg)" for i in range(8)}
    assert {"state", "recorded", "mlp_k04"} == set(values(panel.chart, "what"))
    assert "What would the policy have done in demonstrations that it never saw?" not in questions(figures)
    assert len(figures[4].panels) == COLUMNS
    assert figures[4].reading.endswith("Not shown: joint_6, joint_7.")


def test_velocities_show_no_state_and_no_lag():
    demos = make_demos(columns=3)
    semantics = replace(make_semantics(demos, "velocity"), tracking_lag=(None,) * 3)
    figures = benchmark_figures(make_table(demos, semantics), demos, semantics, [make_predictions(demos, [1])])
    assert "How far does the robot lag behind its commands?" not in questions(figures)
    assert set(values(figures[3].panels[0].chart, "what")) == {"recorded", "mlp_k04"}


def test_without_predictions_only_figures_from_the_table_are_left(demos, semantics, table):
    assert len(benchmark_figures(table, demos, semantics, [])) == 4


def test_brackets_have_a_panel_a_horizon_and_a_line_a_set_and_loss(table):
    table["floor"]["estimates"] += [make_floor("l2"), make_refusal(horizon=10)]
    table["brackets"] += [make_bracket("l2"), make_bracket(horizon=10, lower=None)]
    figure = bracket_figure(table)
    assert figure.about == "floors"
    assert [panel.caption for panel in figure.panels] == ["First action", "One second ahead"]
    assert set(values(figure.panels[0].chart, "label")) == {"state · RMSE", "state · MAE"}
    (floor,) = {row for row in zip(values(figure.panels[0].chart, "floor"), values(figure.panels[0].chart, "upper"), strict=True)
                if row[1] is None}  # fmt: skip
    assert floor == (4.0, None)
    assert (
        values(figure.panels[1].chart, "limit")[0] == 5.625
    )  # what the policy reaches, as it is below the estimator's 30


def test_a_bracket_names_the_best_policys_set_only_where_it_is_another(demos, table):
    table["policies"].append(make_row("mlp_k01", "mlp", demos, observations="pose"))
    table["floor"]["estimates"].append(make_floor(observations="pose"))
    table["brackets"].append(make_bracket(observations="pose"))
    names = values(bracket_figure(table).panels[0].chart, "name")
    assert set(names) == {"mlp_k01", "mlp_k01 (state)"}


def test_without_brackets_there_is_no_picture_of_them(table):
    assert bracket_figure(table | {"brackets": []}) is None


def test_rows_that_no_observation_set_changes_come_with_every_set(demos, table):
    table["policies"] += [make_row("mlp_k01", "mlp", demos, chunk=1, observations="pose")]
    sets = by_observation_set(table)
    assert list(sets) == ["state", "pose"]
    assert [row["policy"] for row in sets["pose"]] == ["hold_still", "mlp_k01"]
    horizon, bars = horizon_figure(table), chunk_figure(table)
    assert [panel.caption for panel in horizon.panels] == ["Observation set state", "Observation set pose"]
    assert set(values(horizon.panels[1].chart, "policy")) == {"hold_still", "mlp_k01"}
    tops = {panel.chart.to_dict()["layer"][0]["encoding"]["x"]["scale"]["domain"][1] for panel in bars.panels}
    assert len(tops) == 1  # panels can be compared


def test_the_horizon_figure_names_what_lies_above_its_frame(demos, table):
    table["policies"].append(make_row("mean_action", "mean_action", demos, error=300.0))
    assert "Above the frame, so not to be seen: mean_action (300 at the first step)." in horizon_figure(table).reading


def test_hold_still_is_drawn_even_where_it_is_no_row(table):
    table["policies"] = [row for row in table["policies"] if row["policy"] != "hold_still"]
    assert "hold_still" in values(horizon_figure(table).panels[0].chart, "policy")


def test_baselines_alone_still_have_bars(table):
    table["policies"] = [row for row in table["policies"] if row["policy"] == "hold_still"]
    assert values(chunk_figure(table).panels[0].chart, "policy") == ["hold_still"]


def test_the_best_policy_is_a_trained_one_with_predictions(table, predictions):
    assert best_predictions(table, predictions).policy == "mlp_k01"
    assert best_predictions(table, predictions[1:]).policy == "mlp_k04"
    assert best_predictions(table, predictions[2:]).policy == "hold_still"
    assert best_predictions(table, []) is None
    table["policies"][0]["first_step_mae"] = None
    assert best_predictions(table, predictions).policy == "mlp_k04"


def test_moves_are_actions_less_the_state(demos, semantics, table, predictions):
    figure = benchmark_figures(table, demos, semantics, predictions[:1])[5]
    rows = [row for data in figure.panels[0].chart.to_dict()["datasets"].values() for row in data if len(data) > 2]
    np.testing.assert_allclose([row["y"] - row["x"] for row in rows], 5.0, atol=1e-2)
    assert max(abs(row["x"]) for row in rows) < 40
    assert "A move is the action less the state" in figure.reading


def test_the_floor_figure_draws_the_columns_that_vary_most(floor):
    demos = make_demos(columns=4)
    actions = np.array([[0, 0, 0, 0], [1, 9, 0, 5], [2, 0, 0, 9]], np.float32)
    crowded = replace(floor.crowded, frames=np.arange(3), actions=actions)
    figure = floor_figure(demos, make_semantics(demos), [replace(floor, crowded=crowded, scaled=True, radius=0.1)])
    axes = figure.panels[0].chart.to_dict()["layer"][0]["encoding"]
    assert (axes["x"]["title"], axes["y"]["title"]) == ("y (px)", "u (px)")
    assert figure.panels[0].caption == "state: 3 frames within 0.1 training deviations"


def test_no_crowded_neighbourhood_no_figure(demos, semantics, floor):
    assert floor_figure(demos, semantics, [replace(floor, crowded=None)]) is None
    assert floor_figure(demos, semantics, []) is None


def test_rollouts_show_the_policy_that_succeeds_most(demos, rollouts):
    worse = replace(rollouts, policy="mlp_k01", success=np.zeros(6, bool))
    figure = rollout_figure([worse, rollouts], demos)
    assert figure.reading.startswith("mlp_k04 (state, seed 0) drives by itself in the simulator pusht 0.1.8 from 6")
    assert figure.reading.endswith("Task done in 4.")
    assert rollout_figure([replace(rollouts, paths=None)], demos) is None


def test_lag_has_a_panel_for_each_unit(table):
    table["dataset"]["action_units"] = ["deg", "mm"]
    assert len(lag_figure(table).panels) == 2


@pytest.mark.parametrize("share", [[1], [2], [1, 2]])
def test_any_share_of_episodes_will_do(demos, semantics, table, share):
    figures = benchmark_figures(table, demos, semantics, [make_predictions(demos, share, "mlp_k01", 1)])
    assert [panel.caption for panel in figures[4].panels] == [f"Episode {e + 7}" for e in share]

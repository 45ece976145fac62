"""Charts in a plane with equal axes: crowded neighbourhoods, predicted against recorded, paths.

What belongs here: marks and axes, one chart a function. What does not: charts over time or horizon (`charts`), looks
(`drawing`). Importing this module imports Altair.
"""

from collections.abc import Iterable, Sequence

import altair as alt
import numpy as np

from pipeline.sinks.drawing import colour_of, equal_domains, inline, number, padded, plane, square
from pipeline.sinks.palette import FAILURE, INK, MUTED, SUCCESS, TRAINED

NEIGHBOUR, MEAN, STATE_HERE = "an action of a neighbour", "the mean of them", "the state"


def floor_scatter(
    actions: np.ndarray, state: np.ndarray | None, *, names: Sequence[str], unit: str | None, down: bool = False
) -> alt.LayerChart:
    """What demonstrators did in one crowded spot: their actions [n, 2], the mean of them, and the state [2] itself.

    Parameters:
        state: None where actions and states are not the same quantity.
        down: the second column counts downwards, as pixels do.
    """
    rows = [{"x": number(x), "y": number(y), "what": NEIGHBOUR} for x, y in actions]
    special = {MEAN: actions.mean(axis=0)} | ({} if state is None else {STATE_HERE: state})
    rows += [{"x": number(x), "y": number(y), "what": what} for what, (x, y) in special.items()]
    domain = [NEIGHBOUR, *special]
    shapes = alt.Scale(domain=domain, range=["circle", "cross", "diamond"][: len(domain)])
    colours = alt.Scale(domain=domain, range=[TRAINED[0].light, FAILURE.light, INK.light][: len(domain)])
    domains = equal_domains(np.concatenate([actions, *(at[None] for at in special.values())]))
    base = alt.Chart(inline(rows)).encode(
        **plane(names, unit, domains, down=down),
        shape=alt.Shape("what:N", scale=shapes, legend=alt.Legend(columns=1)),
        color=alt.Color("what:N", scale=colours),
        tooltip=[alt.Tooltip("what:N", title="this is"), alt.Tooltip("x:Q"), alt.Tooltip("y:Q")],
    )
    is_neighbour = alt.datum.what == NEIGHBOUR
    crowd = base.mark_point(filled=True, size=70, opacity=0.6).transform_filter(is_neighbour)
    named = base.mark_point(filled=True, size=200, opacity=1).transform_filter(~is_neighbour)
    return square(alt.layer(crowd, named))


def predicted_against_recorded(
    recorded: np.ndarray,
    predicted: np.ndarray,
    *,
    what: str,
    unit: str | None,
    policy: str,
    everyone: Iterable[str] = (),
) -> alt.LayerChart:
    """One action column at held-out frames: predicted [n] over recorded [n]; on the diagonal they agree.

    Parameters:
        what: the word for what was recorded and predicted: `action`, or `move` for an action less the state.
    """
    rows = [{"x": number(x), "y": number(y)} for x, y in zip(recorded, predicted, strict=True)]
    low, high = padded(np.concatenate([recorded, predicted]))
    diagonal = alt.Chart(inline([{"x": low, "y": low}, {"x": high, "y": high}]))
    diagonal = diagonal.mark_line(color=MUTED.light, strokeDash=[4, 3], strokeWidth=1.5).encode(x="x:Q", y="y:Q")
    points = alt.Chart(inline(rows)).mark_point(filled=True, size=22, opacity=0.4, color=colour_of(policy, everyone))
    points = points.encode(
        **plane((f"recorded {what}", f"predicted {what}"), unit, [(low, high)] * 2, down=False),
        tooltip=[alt.Tooltip("x:Q", title="recorded"), alt.Tooltip("y:Q", title="predicted")],
    )
    return square(alt.layer(diagonal, points), side=240)


def path_with_chunks(
    recorded: np.ndarray, chunks: Sequence[np.ndarray], *, names: Sequence[str], unit: str | None, policy: str,
    everyone: Iterable[str] = (), down: bool = False,
) -> alt.LayerChart:  # fmt: skip
    """One episode in the plane: the recorded actions [n, 2], and chunks [K, 2] predicted along the way."""
    rows = [
        {"what": what, "line": line, "step": step, "x": number(x), "y": number(y), "width": 1.75 if line else 5}
        for line, (what, points) in enumerate([("recorded", recorded), *((policy, chunk) for chunk in chunks)])
        for step, (x, y) in enumerate(points)
    ]
    domain = ["recorded", policy]
    colours = alt.Scale(domain=domain, range=[MUTED.light, colour_of(policy, everyone)])
    axes = plane(names, unit, equal_domains(np.concatenate([recorded, *chunks])), down=down)
    base = alt.Chart(inline(rows)).encode(**axes, color=alt.Color("what:N", scale=colours, legend=None))
    lines = base.mark_line(strokeCap="round", strokeJoin="round").encode(
        strokeWidth=alt.StrokeWidth("width:Q", scale=None), order="step:Q", detail="line:N"
    )
    starts = base.mark_point(filled=True, size=34, opacity=1).transform_filter("datum.step === 0")
    return square(alt.layer(lines, starts))


def rollout_paths(
    paths: np.ndarray, success: np.ndarray, *, names: Sequence[str], unit: str | None, down: bool = False
) -> alt.LayerChart:
    """Where the policy went when it drove: paths [R, L, 2], NaN after the end, by whether the task was done."""
    words = {True: "task done", False: "not done"}
    rows = [
        {"what": words[bool(done)], "line": line, "step": step, "x": number(x), "y": number(y)}
        for line, (path, done) in enumerate(zip(paths, success, strict=True))
        for step, (x, y) in enumerate(path)
        if np.isfinite(x) and np.isfinite(y) and step % 2 == 0
    ]
    domain = list(words.values())
    colours = alt.Scale(domain=domain, range=[SUCCESS.light, FAILURE.light])
    dashes = alt.Scale(domain=domain, range=[[1, 0], [5, 3]])
    legend = alt.Legend(symbolType="stroke", symbolSize=500)
    axes = plane(names, unit, equal_domains(paths.reshape(-1, 2)), down=down)
    base = alt.Chart(inline(rows)).encode(**axes, color=alt.Color("what:N", scale=colours, legend=legend))
    lines = base.mark_line(strokeWidth=1.25, opacity=0.7).encode(
        strokeDash=alt.StrokeDash("what:N", scale=dashes, legend=legend), order="step:Q", detail="line:N"
    )
    starts = base.mark_point(filled=True, size=26, opacity=0.9).transform_filter("datum.step === 0")
    return square(alt.layer(lines, starts))

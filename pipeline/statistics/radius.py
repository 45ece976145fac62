"""The multimodality floor: the error that no deterministic policy of an observation set can go below.

What belongs here: estimators, each a function of demonstrations and an observation set. What does not: policies'
errors.

So far there is one, the notebook's, kept to reproduce published numbers. It is biased: a group's mean is made of the
group itself, neighbours may be copies in time, only crowded states count, and a wide radius adds how the mean varies.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.lerobot_format.quality import dead_columns
from pipeline.normalize import circular_columns, fit_scaler
from pipeline.types import ACTION, Demonstrations, Neighbourhood, ObservationSet, RadiusFloor, Semantics

NOTEBOOK_RADIUS = 2.0
CLOSE, WIDE = 0.1, 0.5
"""Shares of the distance of frames to their mean: the largest radius chosen here, and the largest taken from anyone."""


def radius_floor(
    demos: Demonstrations,
    semantics: Semantics,
    observation_set: ObservationSet,
    *,
    radius: float | None = None,
    probes: int = 2000,
    min_neighbours: int = 5,
    horizon: int = 0,
) -> RadiusFloor:
    """Group the frames within `radius` of evenly spaced probes; how far are their actions from the group's own mean?

    Parameters
    ----------
    radius : in the unit of the observation set's columns where they share one (columns without units count as sharing),
        else in deviations (`scaled`). None: the notebook's 2 where that is close, else a tenth of a deviation a column.
    min_neighbours : the frames that a group needs, the probe included.
    horizon : actions are taken this many steps later; frames without such an action in their episode are left out.

    Returns
    -------
    RadiusFloor : `refused` says why there is no number: no probe counted, or the radius spans the data set.
    """
    points, radius, scaled = _space(demos, semantics, observation_set, radius)
    described = {
        "observations": observation_set.name, "horizon": horizon, "radius": radius, "scaled": scaled,
        "unit": _common(demos.features[ACTION].units),
    }  # fmt: skip
    widest = WIDE * _spread(points)
    if radius > widest:
        words = f"a radius of {radius:g} spans the data set: its frames lie {_spread(points):.3g} from their mean. "
        return _refuse(described, words + f"Ask for at most {widest:.2g}")
    kept = np.flatnonzero(demos.frame_in_episode + horizon < np.repeat(demos.lengths, demos.lengths))
    asked = kept[evenly_spaced(len(kept), probes)]
    groups = _groups(points[kept], points[asked], radius, kept)
    counted = [(probe, group) for probe, group in zip(asked, groups, strict=True) if len(group) >= min_neighbours]
    if not counted:
        return _refuse(described, f"none of {len(asked)} probes has {min_neighbours} frames within {radius:g}")
    return RadiusFloor(**described, **_measure(counted, demos.columns[ACTION], horizon), refused=None)


def _measure(counted: list[tuple[int, np.ndarray]], actions: np.ndarray, horizon: int) -> dict[str, Any]:
    """What the groups of the probes that count amount to."""
    spreads = [_distance_to_mean(actions[group + horizon]) for _, group in counted]
    probe, group = max(counted, key=lambda pair: len(pair[1]))
    return {
        "probes": len(counted),
        "median_neighbours": float(np.median([len(group) for _, group in counted])),
        "mean": float(np.mean(spreads)),
        "p90": float(np.percentile(spreads, 90)),
        "crowded": Neighbourhood(int(probe), group, actions[group + horizon]),
    }


def _refuse(described: dict[str, Any], why: str) -> RadiusFloor:
    nothing = {"median_neighbours": np.nan, "mean": np.nan, "p90": np.nan}
    return RadiusFloor(**described, **nothing, probes=0, crowded=None, refused=why)


def save_floors(floors: Sequence[RadiusFloor], path: Path) -> None:
    """Write floors as JSON; frames and actions of the crowded neighbourhood as lists."""
    path.write_text(json.dumps([asdict(floor) for floor in floors], default=np.ndarray.tolist))


def load_floors(path: Path) -> list[RadiusFloor]:
    """The inverse of `save_floors`."""
    floors = []
    for stored in json.loads(path.read_text()):
        if (crowded := stored.pop("crowded")) is not None:
            frames, actions = np.array(crowded["frames"], np.int64), np.array(crowded["actions"], np.float32)
            crowded = Neighbourhood(crowded["probe"], frames, actions)
        floors.append(RadiusFloor(**stored, crowded=crowded))
    return floors


def evenly_spaced(frames: int, probes: int) -> np.ndarray:
    """At most `probes` positions in 0 … frames − 1, evenly spaced, both ends included."""
    return np.unique(np.linspace(0, frames - 1, min(probes, frames)).astype(np.int64))


def _space(
    demos: Demonstrations, semantics: Semantics, observation_set: ObservationSet, radius: float | None
) -> tuple[np.ndarray, float, bool]:
    """[N, O'] where each frame lies, the radius there, and whether columns had to be scaled to be comparable."""
    features = observation_set.features
    values = np.concatenate([demos.columns[key] for key in features], axis=1).astype(np.float64)
    circular = circular_columns(demos, semantics, features)
    units = {unit for key in features for unit in demos.features[key].units}
    comparable = len(units) == 1 and not circular.any()
    if comparable and (radius is not None or CLOSE * _spread(values) >= NOTEBOOK_RADIUS):
        return values, float(NOTEBOOK_RADIUS if radius is None else radius), False
    dead = np.concatenate([dead_columns(demos, key) for key in features])
    points = fit_scaler(values, circular, dead).encode(values).astype(np.float64)
    return points, float(CLOSE * np.sqrt(points.shape[1]) if radius is None else radius), True


def _spread(points: np.ndarray) -> float:
    """The root mean squared distance of points to their mean: a deviation times the square root of the columns."""
    return float(np.sqrt(points.var(axis=0).sum()))


def _groups(points: np.ndarray, probes: np.ndarray, radius: float, frames: np.ndarray) -> list[np.ndarray]:
    """The global frames within the radius of each probe, in order."""
    from scipy.spatial import cKDTree

    return [frames[np.sort(group)] for group in cKDTree(points).query_ball_point(probes, radius)]


def _common(units: Sequence[str | None]) -> str | None:
    """The unit that all columns share."""
    return units[0] if len(set(units)) == 1 else None


def _distance_to_mean(actions: np.ndarray) -> float:
    """The mean distance of a group's actions [n, A] to their own mean."""
    actions = actions.astype(np.float64)
    return float(np.linalg.norm(actions - actions.mean(axis=0), axis=1).mean())

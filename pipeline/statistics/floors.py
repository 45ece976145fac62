"""The multimodality floor: the error that no deterministic policy of an observation set can go below.

What belongs here: estimators, each a function of demonstrations and an observation set. What does not: policies' errors.

So far there is one, the notebook's, kept to reproduce published numbers. It is biased: a group's mean is made of the group
itself, neighbours may be copies in time, only crowded states count, and a wide radius adds how the mean varies.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from pipeline.normalize import fit_scaler
from pipeline.types import ACTION, Demonstrations, Neighbourhood, ObservationSet, RadiusFloor, Semantics

SCALED_RADIUS = 0.1
"""Default radius where columns are scaled to unit deviation, per square root of the number of columns."""


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
    radius : in the unit of the observation set's columns where they share one, else in training deviations (`scaled`).
    min_neighbours : the frames that a group needs, the probe included.
    horizon : actions are taken this many steps later; frames without such an action in their episode are left out.

    Returns
    -------
    RadiusFloor : `refused` says why where no probe counted.
    """
    points, scaled = _points(demos, semantics, observation_set)
    radius = _default_radius(points) if radius is None else radius
    kept = np.flatnonzero(demos.frame_in_episode + horizon < np.repeat(demos.lengths, demos.lengths))
    asked = kept[evenly_spaced(len(kept), probes)]
    groups = _groups(points[kept], points[asked], radius, kept)
    counted = [(probe, group) for probe, group in zip(asked, groups, strict=True) if len(group) >= min_neighbours]
    actions = demos.columns[ACTION].astype(np.float64)
    described = {
        "observations": observation_set.name, "horizon": horizon, "radius": float(radius), "scaled": scaled,
        "unit": _common(demos.features[ACTION].units),
    }  # fmt: skip
    if not counted:
        refused = f"none of {len(asked)} probes has {min_neighbours} frames within {radius:g}"
        nothing = {"median_neighbours": np.nan, "mean": np.nan, "p90": np.nan}
        return RadiusFloor(**described, **nothing, probes=0, crowded=None, refused=refused)
    spreads = [_spread(actions[group + horizon]) for _, group in counted]
    probe, group = max(counted, key=lambda pair: len(pair[1]))
    return RadiusFloor(
        **described,
        probes=len(counted),
        median_neighbours=float(np.median([len(group) for _, group in counted])),
        mean=float(np.mean(spreads)),
        p90=float(np.percentile(spreads, 90)),
        crowded=Neighbourhood(int(probe), group, demos.columns[ACTION][group + horizon]),
        refused=None,
    )


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


def _points(demos: Demonstrations, semantics: Semantics, observation_set: ObservationSet) -> tuple[np.ndarray, bool]:
    """[N, O'] where each frame lies, and whether columns had to be scaled to be comparable."""
    parts = [demos.columns[key] for key in observation_set.features]
    values = np.concatenate(parts, axis=1)
    units = [unit for key in observation_set.features for unit in demos.features[key].units]
    circular = np.concatenate(
        [np.asarray(semantics.circular.get(key, (False,) * demos.columns[key].shape[1]), bool) for key in observation_set.features]
    )
    if len(set(units)) == 1 and not circular.any():
        return values.astype(np.float64), False
    return fit_scaler(values, circular, units, "strict").encode(values).astype(np.float64), True


def _groups(points: np.ndarray, probes: np.ndarray, radius: float, frames: np.ndarray) -> list[np.ndarray]:
    """The global frames within the radius of each probe, in order."""
    from scipy.spatial import cKDTree

    return [frames[np.sort(group)] for group in cKDTree(points).query_ball_point(probes, radius)]


def _default_radius(points: np.ndarray) -> float:
    """For points of unit deviation: as large as a step of `SCALED_RADIUS` deviations in every column at once."""
    return SCALED_RADIUS * float(np.sqrt(points.shape[1]))


def _common(units: Sequence[str | None]) -> str | None:
    """The unit that all columns share."""
    return units[0] if len(set(units)) == 1 else None


def _spread(actions: np.ndarray) -> float:
    """The mean distance of a group's actions [n, A] to their own mean."""
    return float(np.linalg.norm(actions - actions.mean(axis=0), axis=1).mean())

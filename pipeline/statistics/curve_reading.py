"""From the errors kept at each size to what is said of a learning curve: points, floors, answers, JSON.

What belongs here: files and records around `statistics.curve`. What does not: how an answer is found (there), or pictures.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.folds import PolicyTask
from pipeline.statistics.curve import MORE, WORTHWHILE, Answer, Floor, answer
from pipeline.statistics.curve_errors import CurveErrors, Point, points
from pipeline.statistics.metrics import episode_errors, load_errors, save_errors, span_means
from pipeline.types import EpisodeErrors, FloorEstimate, Predictions, Protocol

METRICS = ("first_step_mae", "at_one_second_mae")


@dataclass(frozen=True)
class Reading:
    """What a learning curve says, by metric; a metric that the policy's chunk does not reach is absent."""

    points: Mapping[str, list[Point]]
    floors: Mapping[str, Floor]
    answers: tuple[Answer, ...]

    def as_json(self) -> dict[str, Any]:
        """`sizes` are of the first step; `at_one_second` beside them is None where the chunk is shorter."""
        later = self.points.get("at_one_second_mae")
        return {
            "sizes": [
                _point_json(point) | {"at_one_second": _point_json(later[i]) if later else None}
                for i, point in enumerate(self.points["first_step_mae"])
            ],
            "floor": self.floors["first_step_mae"].value if "first_step_mae" in self.floors else None,
            "floors": {metric: asdict(floor) for metric, floor in self.floors.items()},
            "answers": [_answer_json(said) for said in self.answers],
        }


def _point_json(point: Point) -> dict[str, Any]:
    return {
        "episodes": point.episodes,
        "error": point.error,
        "interval": list(point.interval) if point.interval else None,
        "orders": list(point.orders),
    }


def _answer_json(said: Answer) -> dict[str, Any]:
    return asdict(said) | {"interval": list(said.interval) if said.interval else None}


def keep_errors(task: PolicyTask, predictions: Predictions, path: Path) -> None:
    """Write the errors of one subset's predictions."""
    split, protocol = task.split, task.experiment.protocol
    save_errors(episode_errors(predictions, task.demos, task.semantics, split, protocol=protocol), path)


def join_errors(parts: Sequence[EpisodeErrors]) -> EpisodeErrors:
    """The errors of one size: those of all folds, in the order of the episodes."""
    order = np.argsort(np.concatenate([part.episodes for part in parts]))
    joined = {}
    for name in vars(parts[0]):
        axis = 1 if name in ("absolute", "squared", "l2") else 0
        joined[name] = np.concatenate([getattr(part, name) for part in parts], axis=axis).take(order, axis=axis)
    return EpisodeErrors(**joined)


def errors_file(size: int, order: int) -> str:
    return f"errors_{size:05d}_{order}.safetensors"


def load_by_size(folder: Path) -> dict[int, list[EpisodeErrors]]:
    """The errors in a curve's folder: training episodes → an entry an order."""
    found: dict[int, list[EpisodeErrors]] = {}
    for path in sorted(folder.glob("errors_*_*.safetensors")):
        found.setdefault(int(path.stem.split("_")[1]), []).append(load_errors(path))
    return found


def curve_errors(
    by_size: Mapping[int, Sequence[EpisodeErrors]], metric: str, *, fps: float, protocol: Protocol, trained: bool = True
) -> CurveErrors | None:
    """One metric of errors kept by size; None where the policy's chunk, or every episode, ends before.

    Only episodes that reach the horizon count: the same ones at every size.
    """
    step = 0 if metric == "first_step_mae" else round(fps)
    sizes = sorted(by_size)
    reference = by_size[sizes[-1]][0]
    if step >= reference.anchors.shape[1] or not reference.anchors[:, step].any():
        return None
    use = reference.anchors[:, step] > 0
    values = []
    for size in sizes:
        orders = [span_means(errors, errors.absolute, slice(step, step + 1))[0] for errors in by_size[size]]
        values.append(np.stack([order.mean(axis=2)[:, use] for order in orders]))
    counts = reference.anchors[use, step].astype(float) if protocol == "notebook" else None
    return CurveErrors(tuple(sizes), tuple(values), reference.fold[use], counts, trained)


def read_curve(
    folder: Path,
    *,
    fps: float,
    protocol: Protocol,
    trained: bool,
    unit: str | None,
    floors: Sequence[FloorEstimate] = (),
    more: int = MORE,
    share: float = WORTHWHILE,
) -> Reading:
    """What the errors in a curve's folder say.

    Parameters
    ----------
    trained : whether the policy has seeds that matter.
    floors : estimates for the curve's observation set; those of the mean absolute error at the two horizons count.
    more, share : see `statistics.curve.answer`.
    """
    by_size = load_by_size(folder)
    curves = {m: curve_errors(by_size, m, fps=fps, protocol=protocol, trained=trained) for m in METRICS}
    there = {metric: curve for metric, curve in curves.items() if curve is not None}
    horizons = {"first_step_mae": 0, "at_one_second_mae": round(fps)}
    found = {metric: _floor_at(floors, horizons[metric], unit) for metric in there}
    known = {metric: floor for metric, floor in found.items() if floor is not None}
    return Reading(
        {metric: points(curve) for metric, curve in there.items()},
        known,
        tuple(answer(c, m, more=more, share=share, floor=known.get(m), unit=unit) for m, c in there.items()),
    )


def _floor_at(floors: Sequence[FloorEstimate], horizon: int, unit: str | None) -> Floor | None:
    """The floor of the mean absolute error at a horizon; None where it was refused or not measured."""
    for floor in floors:
        if floor.loss == "mae" and floor.horizon == horizon and floor.value is not None:
            words = f"the floor ({floor.value:.3g}{f' {unit}' if unit else ''} or more)"
            return Floor(floor.value, floor.interval[0] if floor.interval else floor.value, words)
    return None

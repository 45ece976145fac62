"""An episode of demonstrations as things to see, where its columns are those of a table or an arm that we know.

What belongs here: which demonstrations those are, and their things. What does not: where the things are (`pusht_scene`,
`so101_scene`, `so101_meshes`), colours (`sinks`). Nothing is simulated: it is what was recorded.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import NotApplicableError
from pipeline.simulate import pusht, so101
from pipeline.simulate.scene import Camera, Shape
from pipeline.simulate.so101_arm import UNITS
from pipeline.types import ACTION, STATE, Demonstrations

if TYPE_CHECKING:
    from pipeline.simulate.so101_meshes import Link


@dataclass(frozen=True)
class Arm:
    """An arm of rigid links in space.

    view        from where it is looked at
    links       its parts; `poses` of columns [n, 6] says where they are [links, n, 3], and how turned [links, n, 4]
    fingertips  columns [.., 6] → the middle between them [.., 3]
    """

    view: Camera
    links: "tuple[Link, ...]"
    poses: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    fingertips: Callable[[np.ndarray], np.ndarray]


def arm_of(demos: Demonstrations) -> Arm | None:
    """The SO-101, where state and action are its joints in units that say its angles, and its model is installed."""
    wanted = (so101.COLUMNS[STATE], UNITS)
    if any((f.names, f.units) != wanted for key in (STATE, ACTION) if (f := demos.features.get(key))):
        return None
    if STATE not in demos.features:
        return None
    try:
        from pipeline.simulate.so101_meshes import links, poses
        from pipeline.simulate.so101_scene import DRAWING, fingertips

        return Arm(DRAWING.view, links(), poses, fingertips)
    except NotApplicableError:
        return None


def things_of(demos: Demonstrations, episode: int) -> list[Shape]:
    """What stands or moves beside the effector: PushT's goal and block, or the SO-101's table, target and cube; none elsewhere."""
    frames = demos.episode(episode)
    if _has(demos, pusht.COLUMNS):
        from pipeline.simulate.pusht_scene import things

        return things(demos.columns[pusht.BLOCK][frames].astype(np.float64))
    if _has(demos, so101.COLUMNS):
        from pipeline.simulate.so101_scene import TABLE, things

        return [TABLE, *things(demos.columns[so101.POSE][frames].astype(np.float64))]
    return []


def _has(demos: Demonstrations, columns: dict[str, tuple[str, ...]]) -> bool:
    return all(key in demos.features and demos.features[key].names == names for key, names in columns.items())

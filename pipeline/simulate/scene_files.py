"""What there was to see of roll-outs, as a file beside their numbers: read on its own, by what draws them.

What belongs here: writing, reading, checking. What does not: the numbers (`trial`), drawing (`scene`).
"""

from pathlib import Path

import numpy as np

from pipeline.errors import StoreError
from pipeline.types import Scenes

SCENES_FILE = "scenes.safetensors"
SHOWN, ASKED, CHUNKS = "shown/", "asked", "chunks"


def save_scenes(scenes: Scenes, folder: Path) -> None:
    """One file, beside the numbers of the same roll-outs."""
    from safetensors.numpy import save_file

    arrays = {f"{SHOWN}{key}": values for key, values in scenes.shown.items()}
    arrays |= {ASKED: scenes.asked, CHUNKS: scenes.chunks}
    save_file({name: np.ascontiguousarray(array) for name, array in arrays.items()}, folder / SCENES_FILE)


def load_scenes(folder: Path) -> Scenes | None:
    """What there was to see of the first roll-outs; None where it was not kept.

    Raises:
        StoreError: the file is damaged.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    path = folder / SCENES_FILE
    if not path.is_file():
        return None
    try:
        arrays = load_file(path)
        shown = {name.removeprefix(SHOWN): array for name, array in arrays.items() if name.startswith(SHOWN)}
        scenes = Scenes(shown, arrays[ASKED], arrays[CHUNKS])
        _require_whole(scenes)
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        raise StoreError(
            f"{path} is damaged ({str(error).splitlines()[0]}), so these roll-outs cannot be drawn; their numbers stand in another "
            f"file. Delete {folder.parent} and the data set's rollout_video, benchmark_report and recordings, and run again: "
            "policies are rolled out again, none is trained."
        ) from None
    return scenes


def _require_whole(scenes: Scenes) -> None:
    """Arrays that belong together. Raises ValueError."""
    sizes = {values.shape[:2] for values in scenes.shown.values() if values.ndim == 3}
    if len(sizes) != 1 or scenes.chunks.ndim != 4 or scenes.asked.shape != scenes.chunks.shape[1:2]:
        raise ValueError("its arrays do not belong together")
    if sizes.pop()[0] != len(scenes.chunks):
        raise ValueError("its arrays are of different numbers of start states")

"""The data sets that ship with the project: recorded in simulation by its own scripted demonstrators, each with a card.

What belongs here: finding them. What does not: recording them (`simulate`), reading them (`lerobot_format`).
"""

from importlib.resources import files
from pathlib import Path

from pipeline.errors import DatasetError, did_you_mean

EMBEDDED = ("pusht_sim", "so101_sim")
"""Names, as in `embedded:pusht_sim`."""


def embedded_folder(name: str) -> Path:
    """The LeRobot folder of an embedded data set.

    Raises:
        DatasetError: there is none of that name, or the installation lacks its files.
    """
    if name not in EMBEDDED:
        raise DatasetError(f"No data set '{name}' ships with demobench. {did_you_mean(name, EMBEDDED)}")
    folder = Path(str(files(__name__) / name))
    if not (folder / "meta" / "info.json").is_file():
        raise DatasetError(f"The embedded data set '{name}' is missing at {folder}. Install demobench again.")
    return folder

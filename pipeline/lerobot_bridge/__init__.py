"""A LeRobot checkpoint's predictions, by the Python that has LeRobot.

LeRobot's pins exclude ours, so it lives in an environment of its own. What belongs in this file: starting
`predict_checkpoint.py` with that Python, and reading what it says. What does not: LeRobot, torch, or what the predictions
are worth. In the room besides: `read_folder` (the script's other half) and `environment_state` (a copy for ACT).
"""

import json
import os
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

from pipeline.errors import PolicyError, printable

SCRIPT = Path(__file__).with_name("predict_checkpoint.py")
INSTALL = "python3.12 -m venv lerobot-env && lerobot-env/bin/pip install 'lerobot[training,diffusion,smolvla]==0.6.1'"
_PROBE = "import importlib.metadata as m, sys; print('python', *sys.version_info[:2], m.version('lerobot'))"
_OURS = ("PYTHONPATH", "PYTHONHOME", "PYTHONSTARTUP", "VIRTUAL_ENV", "__PYVENV_LAUNCHER__")
"""Variables that would lead another Python into this environment."""

_STOP_S = 10.0
"""How long a script that is told to stop may take before it is killed."""


@dataclass(frozen=True)
class CheckpointFacts:
    """What a checkpoint says of itself.

    policy_type      act, diffusion or smolvla
    chunk            K, the actions of one prediction
    observations     the data set's columns it was shown
    steps_seen       frames of them, the anchor's own included
    trained_on       the episodes it was trained on as recorded; None for all; "unknown" without a train_config.json
    trained_dataset  {repo_id, root} of the data set those numbers belong to; None where it is not said
    started_from     the checkpoint its training went on from, whose own episodes may be others; None for none
    parameters       weights, counted
    lerobot_version  of the environment that predicted
    """

    policy_type: str
    chunk: int
    observations: tuple[str, ...]
    steps_seen: int
    trained_on: tuple[int, ...] | Literal["unknown"] | None
    trained_dataset: Mapping[str, str | None] | None
    started_from: str | None
    parameters: int
    lerobot_version: str


def predict_with_lerobot(
    checkpoint: Path,
    python: Path,
    dataset: Path,
    anchors: Path,
    out: Path,
    *,
    device: str = "cpu",
    seed: int = 0,
    features: Mapping[str, str] | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> CheckpointFacts:
    """Write the checkpoint's action chunk at every anchor to `out` (parquet: episode_index, frame_index, action).

    Parameters
    ----------
    checkpoint : a `pretrained_model` folder, or the folder of a run, whose last checkpoint is taken.
    python : the Python (or the folder of the virtual environment) that has LeRobot.
    dataset : a LeRobot folder; its `action` columns and the checkpoint's must be equally many.
    anchors : a parquet with episode_index as recorded and frame_index from 0 in each episode.
    features : feature of the checkpoint → the column of the data set it is shown, where the names differ.
    on_progress : called with (done, total) anchors.

    Raises
    ------
    PolicyError : `python` has no LeRobot, or the checkpoint cannot be loaded, or does not fit the data set. Nothing is
        written then, nor on Ctrl-C.
    """
    python = _checked_python(python)
    out.parent.mkdir(parents=True, exist_ok=True)
    command = [str(python), str(SCRIPT), "--device", device, "--seed", str(seed)]
    for option, path in (("checkpoint", checkpoint), ("dataset", dataset), ("anchors", anchors), ("out", out)):
        command += [f"--{option}", str(path.absolute())]
    command += [word for name, column in (features or {}).items() for word in ("--feature", f"{name}={column}")]
    # LeRobot leaves files behind in the folder for temporary ones.
    with tempfile.TemporaryDirectory(prefix="demobench-lerobot-") as folder:
        log = Path(folder) / "stderr"
        last = ""
        with _running(command, log, _environment() | {"TMPDIR": folder}) as process:
            for line in process.stdout or ():
                last = _progress(line, on_progress) or last
        return _facts(process.returncode, last, log)


def sees_pictures(checkpoint: Path) -> bool:
    """Whether a checkpoint's config.json names a camera among its inputs; False where there is none to read."""
    for inside in ("", "pretrained_model", "checkpoints/last/pretrained_model"):
        try:
            config = json.loads((checkpoint / inside / "config.json").read_text(encoding="utf-8"))
            return any(feature.get("type") == "VISUAL" for feature in config["input_features"].values())
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            continue
    return False


@contextmanager
def _running(command: list[str], log: Path, environment: dict[str, str]) -> Iterator[subprocess.Popen[str]]:
    """A process that is stopped when the block is left early, by Ctrl-C for one."""
    with log.open("w", encoding="utf-8") as stderr:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=stderr, text=True, env=environment)
    try:
        yield process
        process.wait()
    finally:
        if process.poll() is None:
            process.terminate()
            try:
                process.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        if process.stdout is not None:
            process.stdout.close()


def _environment() -> dict[str, str]:
    kept = {name: value for name, value in os.environ.items() if name not in _OURS}
    return kept | {"PYTHONUNBUFFERED": "1", "PYTHONDONTWRITEBYTECODE": "1"}


def _checked_python(python: Path) -> Path:
    """The interpreter, once it has said that it is a Python with LeRobot."""
    if python.is_dir():
        python = python / "bin/python"
    advice = f"Give the Python of an environment that has it, made for example by: {INSTALL}"
    try:
        answer = subprocess.run(
            [str(python), "-c", _PROBE], capture_output=True, text=True, timeout=120, env=_environment(), check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        reason = getattr(error, "strerror", None) or "it does not answer"
        raise PolicyError(f"{python} cannot be run as a Python with LeRobot: {reason}. {advice}") from None
    if answer.stdout.startswith("python "):
        return python
    if "PackageNotFoundError" in answer.stderr:
        raise PolicyError(f"{python} has no LeRobot. {advice}")
    raise PolicyError(f"{python} is no Python that can be asked for LeRobot. {advice}")


def _progress(line: str, on_progress: Callable[[int, int], None] | None) -> str:
    """Report a line of progress; anything else is given back."""
    words = line.split()
    if len(words) == 3 and words[0] == "progress" and words[1].isdigit() and words[2].isdigit():
        if on_progress is not None:
            on_progress(int(words[1]), int(words[2]))
        return ""
    return line


def _facts(code: int, last: str, log: Path) -> CheckpointFacts:
    """The facts of the script's last line, or what it said was wrong."""
    if code != 0:
        lines = [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
        said = lines[-1].strip() if lines else "it said nothing"
        raise PolicyError(said if code == 2 else f"LeRobot stopped with exit code {code}: {said}")
    try:
        said = json.loads(last)
        values = {field.name: said[field.name] for field in fields(CheckpointFacts)}
    except (ValueError, KeyError, TypeError):
        raise PolicyError(
            f"The LeRobot environment did not say what it predicted; its last line was: {last!r}"
        ) from None
    values["observations"] = tuple(map(printable, values["observations"]))
    values["started_from"] = printable(str(values["started_from"])) if values["started_from"] else None
    if isinstance(values["trained_on"], list):
        values["trained_on"] = tuple(values["trained_on"])
    return CheckpointFacts(**values)

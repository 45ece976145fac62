"""What the runner and its script refuse, in one line, before LeRobot is needed. The script runs in this very Python."""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.errors import PolicyError
from pipeline.lerobot_bridge import SCRIPT, predict_with_lerobot
from tests.makers import tiny_recording, write_v3

STEP = {"registry_name": "normalizer_processor", "config": {}, "state_file": "n.safetensors"}


def write_checkpoint(folder: Path, kind: str = "act", step: object = None, **config: object) -> Path:
    """The files of a checkpoint; its weights are none."""
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps({"type": kind} | config))
    (folder / "model.safetensors").write_bytes(b"")
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        (folder / name).write_text(json.dumps({"name": name, "steps": [STEP if step is None else step]}))
    return folder


@pytest.fixture
def refusal(tmp_path: Path) -> Callable[..., str]:
    """What the script says of a checkpoint and a data set: one line, exit code 2, and nothing is written."""
    folder = write_v3(tmp_path / "set", tiny_recording(2, 5))
    (tmp_path / "out").mkdir()

    def ask(checkpoint: Path, dataset: Path = folder) -> str:
        paths = {
            "checkpoint": checkpoint,
            "dataset": dataset,
            "anchors": tmp_path / "none",
            "out": tmp_path / "out/p.parquet",
        }
        command = [
            sys.executable,
            str(SCRIPT),
            *(word for name, path in paths.items() for word in (f"--{name}", str(path))),
        ]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
        assert list((tmp_path / "out").iterdir()) == []
        return done.stderr.strip()

    return ask


def ask_python(python: Path, tmp_path: Path) -> str:
    with pytest.raises(PolicyError) as caught:
        predict_with_lerobot(tmp_path, python, tmp_path, tmp_path / "a", tmp_path / "out/p.parquet")
    assert not (tmp_path / "out").exists()
    return str(caught.value)


def test_a_python_without_lerobot(tmp_path: Path) -> None:
    said = ask_python(Path(sys.executable), tmp_path)
    assert said.startswith(f"{sys.executable} has no LeRobot. Give the Python of an environment that has it")
    assert "python3.12 -m venv" in said
    assert "lerobot[training,diffusion,smolvla]==0.6.1" in said


def test_the_folder_of_an_environment_will_do(tmp_path: Path) -> None:
    assert f"{Path(sys.prefix) / 'bin/python'} has no LeRobot" in ask_python(Path(sys.prefix), tmp_path)


def test_no_such_python(tmp_path: Path) -> None:
    assert "/nowhere/python cannot be run as a Python with LeRobot: No such file" in ask_python(
        Path("/nowhere/python"), tmp_path
    )


def test_a_file_that_is_no_program(tmp_path: Path) -> None:
    (tmp_path / "notes").write_text("hello")
    assert "notes cannot be run as a Python with LeRobot: Permission denied" in ask_python(tmp_path / "notes", tmp_path)


def test_another_program(tmp_path: Path) -> None:
    assert "is no Python that can be asked for LeRobot" in ask_python(Path(shutil.which("true") or ""), tmp_path)


def test_no_checkpoint(refusal: Callable[..., str], tmp_path: Path) -> None:
    assert refusal(tmp_path / "set").startswith(
        f"{tmp_path / 'set'} holds no LeRobot checkpoint: there is no config.json"
    )


def test_the_last_checkpoint_of_a_run_is_taken(refusal: Callable[..., str], tmp_path: Path) -> None:
    for step in ("000900", "001000", "000020"):
        write_checkpoint(tmp_path / f"run/checkpoints/{step}/pretrained_model", f"of_{step}")
    assert "'of_001000'" in refusal(tmp_path / "run")
    assert "'of_000020'" in refusal(tmp_path / "run/checkpoints/000020")
    (tmp_path / "run/checkpoints/last").symlink_to("000900")
    assert "'of_000900'" in refusal(tmp_path / "run")


def test_an_unknown_policy(refusal: Callable[..., str], tmp_path: Path) -> None:
    said = refusal(write_checkpoint(tmp_path / "c", "tdmpc"))
    assert "the policy type is 'tdmpc', and known here are act, diffusion, smolvla" in said


def test_a_config_that_is_no_json(refusal: Callable[..., str], tmp_path: Path) -> None:
    checkpoint = write_checkpoint(tmp_path / "c")
    (checkpoint / "config.json").write_text("{")
    assert "config.json cannot be read as JSON" in refusal(checkpoint)
    (checkpoint / "config.json").write_text("[]")
    assert "config.json should hold a JSON object, and holds a list" in refusal(checkpoint)


def test_an_adapter(refusal: Callable[..., str], tmp_path: Path) -> None:
    assert "is a PEFT adapter. Merge it" in refusal(write_checkpoint(tmp_path / "c", use_peft=True))


def test_weights_that_could_run_code(refusal: Callable[..., str], tmp_path: Path) -> None:
    checkpoint = write_checkpoint(tmp_path / "c")
    (checkpoint / "model.safetensors").rename(checkpoint / "pytorch_model.bin")
    assert "has no model.safetensors. Weights in other formats can run code" in refusal(checkpoint)


def test_a_checkpoint_older_than_processors(refusal: Callable[..., str], tmp_path: Path) -> None:
    checkpoint = write_checkpoint(tmp_path / "c")
    (checkpoint / "policy_preprocessor.json").unlink()
    assert "lerobot.processor.migrate_policy_normalization" in refusal(checkpoint)


@pytest.mark.parametrize(
    "step", [{"class": "subprocess.Popen", "config": {"args": ["true"]}}, {"registry_name": "other"}, 3]
)
def test_a_processor_that_would_import_other_code(refusal: Callable[..., str], tmp_path: Path, step: object) -> None:
    assert "asks for the processor step" in refusal(write_checkpoint(tmp_path / "c", step=step))


def test_a_state_file_elsewhere(refusal: Callable[..., str], tmp_path: Path) -> None:
    step = STEP | {"state_file": "../../n.safetensors"}
    assert "should be a safetensors file beside it" in refusal(write_checkpoint(tmp_path / "c", step=step))


@pytest.mark.parametrize("episodes", ["all", [1, "2"], [True]])
def test_a_train_config_with_other_episodes(refusal: Callable[..., str], tmp_path: Path, episodes: object) -> None:
    checkpoint = write_checkpoint(tmp_path / "c")
    (checkpoint / "train_config.json").write_text(json.dumps({"dataset": {"episodes": episodes}}))
    assert "dataset.episodes should be a list of numbers, or null for all" in refusal(checkpoint)


def test_no_data_set(refusal: Callable[..., str], tmp_path: Path) -> None:
    assert "info.json cannot be read as JSON: FileNotFoundError" in refusal(write_checkpoint(tmp_path / "c"), tmp_path)


def test_no_lerobot_in_the_end(refusal: Callable[..., str], tmp_path: Path) -> None:
    """All the same, the script names what is missing."""
    assert "No module named 'lerobot'. Install it: pip install" in refusal(write_checkpoint(tmp_path / "c"))

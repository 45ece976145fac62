"""Where LeRobot is, small data sets for it, and a policy that LeRobot itself trained on one."""

import json
import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pipeline.lerobot_bridge.environment_state import copy_with_environment_state
from tests.makers import tiny_recording, write_v3

IN_REPOSITORY = Path(__file__).resolve().parents[2] / ".lerobot"
LENGTHS = (30, 24, 36, 30, 28, 32)
TRAINED_ON = (0, 1, 3, 5)

Run = Callable[..., str]


@pytest.fixture(scope="session")
def lerobot_python() -> Path:
    """The Python that has LeRobot."""
    ready = (IN_REPOSITORY / ".ready").is_file()
    python = Path(os.environ.get("DEMOBENCH_LEROBOT_PYTHON", IN_REPOSITORY / "bin/python" if ready else ""))
    if not python.is_file():
        pytest.skip("no environment with LeRobot: run `make lerobot-env`, or set DEMOBENCH_LEROBOT_PYTHON")
    return python


@pytest.fixture(scope="session")
def run_lerobot(lerobot_python: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Runs `python …` there, offline, in a folder of its own; gives stdout."""
    home = tmp_path_factory.mktemp("home")
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment |= {"HF_HOME": str(home), "HF_HUB_OFFLINE": "1", "TMPDIR": str(home), "OMP_NUM_THREADS": "1"}

    def run(*words: Any) -> str:
        command = [str(lerobot_python), *map(str, words)]
        done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=home, timeout=300)
        assert done.returncode == 0, done.stderr[-3000:]
        return done.stdout

    return run


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six episodes of three joints, in three files; the state is what LeRobot would call both of its states."""
    folder = tmp_path_factory.mktemp("small")
    recording = tiny_recording(len(LENGTHS), LENGTHS, joints=3)
    write_v3(folder / "recorded", recording, episodes_per_file=2)
    copy_with_environment_state(folder / "recorded", folder / "copy")
    return folder


@pytest.fixture(scope="session")
def train(run_lerobot: Run, small: Path) -> Callable[..., Path]:
    """LeRobot's own trainer on `small` less two episodes, on the state alone; gives the run's folder."""

    def run(policy: str, *options: str) -> Path:
        out = small / policy
        fixed = {
            "dataset.repo_id": "made/small", "dataset.root": small / "copy", "dataset.episodes": json.dumps(TRAINED_ON),
            "policy.type": policy, "policy.device": "cpu", "policy.push_to_hub": "false", "num_workers": 0,
            "persistent_workers": "false", "batch_size": 8, "steps": 6, "env_eval_freq": 0, "seed": 0, "output_dir": out,
        }  # fmt: skip
        words = [f"--{name}={value}" for name, value in fixed.items()]
        run_lerobot("-m", "lerobot.scripts.lerobot_train", *words, *(f"--policy.{option}" for option in options))
        return out

    return run


@pytest.fixture(scope="session")
def act(train: Callable[..., Path]) -> Path:
    """A small ACT with a chunk of 5."""
    return train(
        "act", "chunk_size=5", "n_action_steps=5", "dim_model=16", "n_heads=2", "dim_feedforward=32", "latent_dim=4",
        "n_encoder_layers=1", "n_vae_encoder_layers=1",
        'normalization_mapping={"STATE": "MEAN_STD", "ENV": "MEAN_STD", "ACTION": "MEAN_STD"}',
    )  # fmt: skip


@pytest.fixture(scope="session")
def diffusion(train: Callable[..., Path]) -> Path:
    """A small Diffusion Policy: two frames seen, a horizon of 8, of which it carries out 4."""
    return train(
        "diffusion", "n_obs_steps=2", "horizon=8", "n_action_steps=4", "down_dims=[8, 16]", "n_groups=4", "kernel_size=3",
        "diffusion_step_embed_dim=8", "num_train_timesteps=5", "drop_n_last_frames=5",
    )  # fmt: skip

"""Training on a GPU: that no step mixes devices is tested everywhere, what comes of it where there is a GPU."""

import subprocess
import sys

import numpy as np
import pytest
import torch

from pipeline.methods import METHODS
from pipeline.policies import Plan
from pipeline.train import load_trained, save_trained
from tests.hand_made import random_walks
from tests.policies.test_methods import ALL, GIVEN, NETWORKS, Killed, lay, train

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device here")
PLAIN = {"blocks": 0, "dropout": 0.0, "warmup": 0, "cosine": False, "clip": 0.0, "ema": False}


def test_no_step_of_any_training_mixes_devices():
    """On a device that holds no numbers, in a process of its own (`pretended_device` says how)."""
    command = [sys.executable, "-W", "error", "-m", "tests.policies.pretended_device"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "mixes devices, and one that does is found" in done.stdout


@needs_gpu
@pytest.mark.parametrize(
    ("method", "settings"), [*((method, {}) for method in NETWORKS), ("mlp", PLAIN), ("mlp", {"bf16": True})]
)
def test_a_gpu_learns_what_a_processor_learns_and_its_files_are_read_without_one(method, settings, tmp_path):
    seen = lay(random_walks(seed=5)).observations()
    steps = {"steps": 60, "settings": settings}
    trained, here = train(method, device="cuda", **steps), train(method, **steps)
    assert trained.vram_mb > 0
    assert here.vram_mb == 0
    assert trained.losses[:, -1] == pytest.approx(here.losses[:, -1], rel=0.5)
    save_trained(trained, tmp_path)
    answer = load_trained(tmp_path).policy.predict(seen)
    np.testing.assert_array_equal(answer, trained.policy.predict(seen))
    assert np.isfinite(answer).all()


@needs_gpu
@pytest.mark.parametrize("method", NETWORKS)
def test_a_training_that_was_killed_on_a_gpu_goes_on_there(method, tmp_path):
    def stop(done, steps, loss):
        if done == 5:
            raise Killed

    plan = {"seeds": (0, 3), "steps": 12, "device": "cuda", "checkpoint": tmp_path / "checkpoint.safetensors"}
    every = {"checkpoint_every_s": 0.0, "settings": ALL[method] | {"batch": 16}, "given": GIVEN}
    cls, windows, steps = METHODS[method].load_class(), lay(random_walks()), []
    with pytest.raises(Killed):
        cls.fit(windows, Plan(**plan, **every, on_step=stop))
    _, curve = cls.fit(windows, Plan(**plan, **every, on_step=lambda done, *_: steps.append(done)))
    assert steps == list(range(6, 13))
    assert np.isfinite(curve.losses).all()


@needs_gpu
def test_seconds_of_a_gpu_come_to_steps():
    assert train("mlp", steps=None, cpu_seconds=0.5, seeds=(0,), device="cuda").steps > 3

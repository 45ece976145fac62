"""Train any method on windows, and keep what came of it in a folder.

What belongs here: one call for every method, and its files: safetensors and JSON, never pickles. What does not: how a
method learns (`policies`), or where folders lie (`store`).

    weights.safetensors   all arrays of the policy; two policies are the same when these bytes are
    policy.json           method and settings
    training.json         losses, seconds, parameters
"""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import PolicyError, did_you_mean
from pipeline.methods import METHODS
from pipeline.policies import Plan
from pipeline.windows import Windows

WEIGHTS, POLICY, TRAINING = "weights.safetensors", "policy.json", "training.json"


@dataclass(frozen=True)
class Trained:
    """A fitted policy and how it got there.

    policy        answers `predict`, has `seeds`, `chunk`, `parameters` (see `pipeline.policies`)
    steps_logged  [L]     losses [S, L], each the mean since the entry before; both empty for policies that do not train
    train_s       seconds of training, all seeds together; cpu_s of all processor cores
    vram_mb       the most memory of a GPU that was in use, 0 without one
    trained_on    what its data were, where that was kept
    """

    method: str
    policy: Any
    steps_logged: np.ndarray
    losses: np.ndarray
    train_s: float
    parameters: int
    cpu_s: float = 0.0
    vram_mb: float = 0.0
    trained_on: Mapping[str, Any] = field(default_factory=dict)

    @property
    def steps(self) -> int:
        """How many steps each seed was trained for; 0 for policies that do not train, or do not say."""
        return int(self.steps_logged[-1]) if len(self.steps_logged) else 0


def train_policy(
    method: str,
    windows: Windows,
    *,
    seeds: Sequence[int],
    steps: int | None,
    cpu_seconds: float | None = None,
    threads: int = 1,
    device: str = "cpu",
    checkpoint: Path | None = None,
    recorded: Path | None = None,
    on_step: Callable[[int, int, float], None] | None = None,
    settings: Mapping[str, Any] | None = None,
    given: Mapping[str, Any] | None = None,
) -> Trained:
    """Fit a method on the windows of training episodes, all seeds together.

    Parameters
    ----------
    cpu_seconds : of each seed, in place of `steps`; `recorded` is a file that remembers how many steps they came to.
    checkpoint : a file. Training goes on from it where it belongs to the same windows and settings, and keeps it up to
        date; it stays there afterwards. The weights are the same bytes as without a break.
    on_step : called with (step, steps, mean loss of the seeds) about 200 times.
    settings : what the method is made with (`pipeline.settings`; of a class of the user's own, what its `__init__` takes).
    given : what policies of any method can be given (`config.PolicyConfig.view`).

    Raises
    ------
    PolicyError : no such method, or the loss is not finite any more.
    ConfigError : a setting that the method does not have.
    """
    if method not in METHODS:
        raise PolicyError(f"No method '{method}'. {did_you_mean(method, METHODS)}")
    plan = Plan(
        tuple(seeds), steps or 0, threads, device, cpu_seconds, recorded, checkpoint,
        on_step=on_step, settings=settings or {}, given=given or {},
    )  # fmt: skip
    policy, curve = METHODS[method].load_class().fit(windows, plan)
    if curve is None:
        return Trained(method, policy, np.empty(0, np.int64), np.empty((1, 0), np.float32), 0.0, policy.parameters)
    costs = (curve.train_s, policy.parameters, curve.cpu_s, curve.vram_mb)
    return Trained(method, policy, curve.steps, curve.losses, *costs)


def save_trained(trained: Trained, folder: Path, trained_on: Mapping[str, Any] | None = None) -> None:
    """Write a trained policy into a folder, which is made if it is not there; `trained_on` says what its data were."""
    from safetensors.numpy import save_file

    folder.mkdir(parents=True, exist_ok=True)
    arrays = {name: np.ascontiguousarray(array) for name, array in trained.policy.arrays().items()}
    save_file(arrays, folder / WEIGHTS)
    settings = {"method": trained.method, "settings": trained.policy.settings(), "trained_on": dict(trained_on or {})}
    (folder / POLICY).write_text(json.dumps(settings, indent=1))
    training = {
        "steps": trained.steps_logged.tolist(),
        "losses": trained.losses.tolist(),
        "train_s": trained.train_s,
        "parameters": trained.parameters,
        "cpu_s": trained.cpu_s,
        "vram_mb": trained.vram_mb,
    }
    (folder / TRAINING).write_text(json.dumps(training))


def load_trained(folder: Path) -> Trained:
    """Read what `save_trained` wrote.

    Raises:
        PolicyError: something is missing, damaged, or of a method that this version does not know.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    try:
        described = json.loads((folder / POLICY).read_text())
        training = json.loads((folder / TRAINING).read_text())
        policy_class = METHODS[described["method"]].load_class()
        policy = policy_class.restore(load_file(folder / WEIGHTS), described["settings"])
        losses = np.array(training["losses"], np.float32)
        steps = np.array(training["steps"], np.int64)
        costs = (training["train_s"], training["parameters"], training.get("cpu_s", 0.0), training.get("vram_mb", 0.0))
        return Trained(described["method"], policy, steps, losses, *costs, described.get("trained_on", {}))
    except RuntimeError as error:
        # PyTorch's words for weights that do not fit a network; the first line says of which class.
        raise PolicyError(
            f"The weights in {folder} are of another architecture than {POLICY} beside them says "
            f"({str(error).splitlines()[0].rstrip(':')}). Train it again."
        ) from None
    except (OSError, SafetensorError, ValueError, KeyError) as error:
        raise PolicyError(
            f"The trained policy in {folder} cannot be read ({type(error).__name__}: {error}). Train it again."
        ) from None


def weights_hash(folder: Path) -> str:
    """sha256 over the bytes of the weights that `save_trained` wrote."""
    return hashlib.sha256((folder / WEIGHTS).read_bytes()).hexdigest()

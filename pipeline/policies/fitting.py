"""Training a stack of networks on windows: batches, steps, checkpoints.

What belongs here: the loop, which goes on from a checkpoint to the same bytes as without a break. What does not: the
choice of loss, sizes and rates (each policy's own file), or files of finished policies (`pipeline.train`).
"""

import hashlib
import json
import math
import os
import time
from collections.abc import Callable
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from pipeline.errors import PolicyError, StoreError
from pipeline.policies import Curve, Plan
from pipeline.policies.batched import Stack
from pipeline.types import ACTION
from pipeline.windows import Windows

LOSSES: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {"l1": torch.abs, "squared": torch.square}
LOGGED = 200
"""At most about this many points of a loss curve are kept."""


@dataclass(frozen=True)
class Recipe:
    """Everything about a network and its training that is not in the plan."""

    hidden: tuple[int, ...]
    loss: str
    batch: int
    learning_rate: float
    weight_decay: float


class Batches:
    """Which windows each seed sees at each step, from (seed, step) alone: shuffled passes over all windows.

    The last windows of a pass that do not fill a batch are left for the next shuffle.
    """

    def __init__(self, windows: int, batch: int, seeds: tuple[int, ...]):
        self._windows, self._batch, self._seeds = windows, min(batch, windows), seeds
        self._per_pass = windows // self._batch
        self._pass, self._shuffled = -1, np.empty(0)

    def at(self, step: int) -> np.ndarray:
        """[S, B] window numbers."""
        number, position = divmod(step, self._per_pass)
        if number != self._pass:
            self._pass, self._shuffled = number, np.stack([self._shuffle(seed, number) for seed in self._seeds])
        return self._shuffled[:, position * self._batch : (position + 1) * self._batch]

    def _shuffle(self, seed: int, number: int) -> np.ndarray:
        generator = np.random.Generator(np.random.Philox(key=[seed, number]))
        return generator.permutation(self._windows)


class Gather:
    """Encoded frames on the device, and the windows cut out of them when they are needed."""

    def __init__(self, windows: Windows, dtype: torch.dtype, device: str):
        scaling, demos = windows.normalizer, windows.demos
        first, end = int(windows.first_frame.min()), int(windows.end_frame.max())
        actions = scaling.actions.encode(demos.columns[ACTION][first:end])
        self.inputs = torch.from_numpy(scaling.observations.encode(windows.values[first:end])).to(device, dtype)
        self.actions = torch.from_numpy(actions).to(device, dtype)
        self._anchors = torch.from_numpy(windows.anchors - first).to(device)
        self._first = torch.from_numpy(windows.first_frame - first).to(device)
        self._last = torch.from_numpy(windows.end_frame - 1 - first).to(device)
        self._back = torch.arange(1 - windows.history, 1, device=device)
        self._ahead = torch.arange(windows.chunk, device=device)
        self._ragged = bool((windows.anchors + windows.chunk > windows.end_frame).any())

    def __call__(self, index: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
        """[S, B] window numbers → inputs [S, B, T · O'], actions [S, B, K · A'] and their mask (None: all count)."""
        anchors = self._anchors[index]
        seen = torch.maximum(anchors[..., None] + self._back, self._first[index][..., None])
        ahead, last = anchors[..., None] + self._ahead, self._last[index][..., None]
        actions = self.actions[torch.minimum(ahead, last)].flatten(2)
        inputs = self.inputs[seen].flatten(2)
        if not self._ragged:
            return inputs, actions, None
        mask = (ahead <= last).to(actions.dtype).repeat_interleave(self.actions.shape[1], dim=2)
        return inputs, actions, mask


def seed_losses(error: torch.Tensor, mask: torch.Tensor | None, loss: str) -> torch.Tensor:
    """[S] each seed's mean loss over targets inside their episode; `error` [S, B, K · A'] is prediction − target."""
    size = LOSSES[loss](error)
    if mask is None:
        return size.mean(dim=(1, 2))
    return (size * mask).sum(dim=(1, 2)) / mask.sum(dim=(1, 2)).clamp(min=1)


def fit_stack(windows: Windows, recipe: Recipe, plan: Plan, dtype: torch.dtype = torch.float32) -> tuple[Stack, Curve]:
    """Train one network a seed, all seeds in each step together; the sum of their losses keeps them independent.

    Raises
    ------
    PolicyError : the loss is not finite any more, or there is no such device.
    StoreError : a checkpoint cannot be written.
    """
    device = _device(plan.device)
    with _threads(plan.threads):
        gather = Gather(windows, dtype, device)
        sizes = (windows.history * gather.inputs.shape[1], *recipe.hidden, windows.chunk * gather.actions.shape[1])
        stack = Stack.fresh(sizes, plan.seeds, dtype, device)
        training = _Training(stack, recipe, _fingerprint(windows, recipe, plan, dtype, device))
        if plan.checkpoint is not None:
            training.resume(plan.checkpoint)
        training.run(gather, Batches(len(windows), recipe.batch, plan.seeds), plan)
    trained = Stack.restore(stack.arrays())
    return trained, Curve(np.array(training.steps, np.int64), _by_seed(training.losses, plan.seeds), training.seconds)


class _Training:
    """The state of one training: parameters, the optimiser's moments, the losses so far, the steps and seconds done."""

    def __init__(self, stack: Stack, recipe: Recipe, fingerprint: str):
        self.stack, self.loss, self.fingerprint = stack, recipe.loss, fingerprint
        self.optimizer = torch.optim.AdamW(
            list(stack.tensors.values()), lr=recipe.learning_rate, weight_decay=recipe.weight_decay, fused=True
        )
        self.done, self.seconds = 0, 0.0
        self.steps: list[int] = []
        self.losses: list[list[float]] = []

    def run(self, gather: Gather, batches: Batches, plan: Plan) -> None:
        every = max(1, math.ceil(plan.steps / LOGGED))
        device = gather.inputs.device
        total = torch.zeros(len(plan.seeds), dtype=gather.inputs.dtype, device=device)
        began, saved, counted = time.perf_counter() - self.seconds, time.perf_counter(), self.done
        while self.done < plan.steps:
            total += self._step(gather, torch.from_numpy(batches.at(self.done)).to(device))
            self.done += 1
            if self.done % every and self.done < plan.steps:
                continue
            self._log(total / (self.done - counted), plan)
            total.zero_()
            counted, self.seconds = self.done, time.perf_counter() - began
            if plan.checkpoint is not None and time.perf_counter() - saved >= plan.checkpoint_every_s:
                self.save(plan.checkpoint)
                saved = time.perf_counter()
            if plan.on_step is not None:
                plan.on_step(self.done, plan.steps, float(np.mean(self.losses[-1])))

    def _step(self, gather: Gather, index: torch.Tensor) -> torch.Tensor:
        inputs, actions, mask = gather(index)
        losses = seed_losses(self.stack(inputs) - actions, mask, self.loss)
        self.optimizer.zero_grad(set_to_none=True)
        losses.sum().backward()
        self.optimizer.step()
        return losses.detach()

    def _log(self, mean: torch.Tensor, plan: Plan) -> None:
        losses = mean.tolist()
        if not all(math.isfinite(loss) for loss in losses):
            raise PolicyError(
                f"Training stopped at step {self.done} of {plan.steps}: the losses of the seeds are {losses}. Look for "
                "values that are not finite or far out of range with `demobench inspect`."
            )
        self.steps.append(self.done)
        self.losses.append(losses)

    def save(self, path: Path) -> None:
        """Write all of it to one file, which is replaced whole."""
        tensors = {f"weights.{name}": tensor.detach() for name, tensor in self.stack.tensors.items()}
        for name, tensor in self.stack.tensors.items():
            moments = self.optimizer.state[tensor]
            tensors |= {f"{moment}.{name}": moments[moment] for moment in ("exp_avg", "exp_avg_sq")}
        progress = {
            "fingerprint": self.fingerprint, "done": self.done, "seconds": self.seconds, "steps": self.steps,
            "losses": self.losses,
        }  # fmt: skip
        temporary = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            save_file(tensors, temporary, metadata={"progress": json.dumps(progress)})
            temporary.replace(path)
        except (OSError, SafetensorError) as error:
            with suppress(OSError):
                temporary.unlink()
            raise StoreError(f"The checkpoint {path} cannot be written ({error}). Make room, then run again.") from None

    def resume(self, path: Path) -> None:
        """Go on from a checkpoint, if there is one of this very training; otherwise start anew."""
        try:
            with safe_open(path, framework="pt", device=str(next(iter(self.stack.tensors.values())).device)) as stored:
                progress = json.loads((stored.metadata() or {}).get("progress", "{}"))
                if progress.get("fingerprint") != self.fingerprint:
                    return
                tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118
        except (OSError, SafetensorError, json.JSONDecodeError):
            return
        self.done, self.seconds = progress["done"], progress["seconds"]
        self.steps, self.losses = progress["steps"], progress["losses"]
        for name, tensor in self.stack.tensors.items():
            with torch.no_grad():
                tensor.copy_(tensors[f"weights.{name}"])
            self.optimizer.state[tensor] = {
                "step": torch.tensor(float(self.done), device=tensor.device if tensor.is_cuda else "cpu"),
                "exp_avg": tensors[f"exp_avg.{name}"],
                "exp_avg_sq": tensors[f"exp_avg_sq.{name}"],
            }


def _fingerprint(windows: Windows, recipe: Recipe, plan: Plan, dtype: torch.dtype, device: str) -> str:
    settings = {
        "windows": windows.hash(), "recipe": asdict(recipe), "seeds": plan.seeds, "steps": plan.steps,
        "threads": plan.threads, "device": device, "dtype": str(dtype), "torch": torch.__version__,
    }  # fmt: skip
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()


def _device(asked: str) -> str:
    if asked == "cuda" and not torch.cuda.is_available():
        raise PolicyError('device = "cuda", but PyTorch finds no CUDA device here. Use device = "auto" or "cpu".')
    return "cuda" if asked == "auto" and torch.cuda.is_available() else asked.replace("auto", "cpu")


def _by_seed(losses: list[list[float]], seeds: tuple[int, ...]) -> np.ndarray:
    return np.array(losses, np.float32).reshape(-1, len(seeds)).T


@contextmanager
def _threads(count: int):
    """Sums depend on how many threads share them, so training runs with a number of its own."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)

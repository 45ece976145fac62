"""Training networks on windows: batches, steps, budgets, checkpoints; and the batched stack's training.

What belongs here: the loop, which goes on from a checkpoint to the same bytes as without a break. What does not: the
choice of loss, sizes and rates (each policy's own file), training of torch modules (`networks`), or files of finished
policies (`pipeline.train`).
"""

import hashlib
import json
import math
import time
from collections.abc import Callable, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from pipeline.errors import PolicyError, StoreError
from pipeline.policies import Curve, Plan
from pipeline.policies.batched import Stack
from pipeline.store import drafted, write_json
from pipeline.types import ACTION
from pipeline.windows import Windows


def _huber(error: torch.Tensor) -> torch.Tensor:
    """Squared up to one deviation, straight beyond (Huber 1964)."""
    size = error.abs()
    return torch.where(size < 1, 0.5 * size * size, size - 0.5)


LOSSES: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {"l1": torch.abs, "squared": torch.square, "huber": _huber}
LOGGED = 200
"""At most about this many points of a loss curve are kept."""
FIRST, TRIAL = 5, 0.03
"""A trial of speed: steps that are not timed (at least as many are), and its share of the CPU-seconds."""


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
    device = device_named(plan.device)
    with threads(plan.threads):
        gather = Gather(windows, dtype, device)
        settled = settle_steps(plan, lambda: _StackTraining(gather, windows, recipe, plan, dtype, device))
        training = _StackTraining(gather, windows, recipe, settled, dtype, device)
        curve = training.run(settled)
    return Stack.restore(training.stack.arrays()), curve


class Training:
    """The state of one training, and its loop: parameters, the optimiser's moments, losses so far, steps and seconds done.

    A subclass says what the losses of a step are, and what else an update does. Step n depends on its number and on the
    state alone, never on what was done before a checkpoint was read.

    tensors  the parameters of all seeds by name       kept  what else changes in place from step to step, by name
    """

    def __init__(self, tensors: dict[str, torch.Tensor], optimizer: torch.optim.Optimizer, fingerprint: str):
        self.tensors, self.optimizer, self.fingerprint = tensors, optimizer, fingerprint
        self.kept: dict[str, torch.Tensor] = {}
        self.done, self.seconds, self.cpu_seconds = 0, 0.0, 0.0
        self.steps: list[int] = []
        self.logged: list[list[float]] = []

    def losses(self) -> torch.Tensor:
        """[S] each seed's loss at step `done`, with gradients."""
        raise NotImplementedError

    def update(self) -> None:
        """Change the parameters, whose gradients are there."""
        self.optimizer.step()

    def run(self, plan: Plan) -> Curve:
        """Train to the plan's last step, from its checkpoint if there is one of this training.

        Raises
        ------
        PolicyError : the loss is not finite any more.
        StoreError : a checkpoint cannot be written.
        """
        if plan.checkpoint is not None:
            self._resume(plan.checkpoint)
        every = max(1, math.ceil(plan.steps / LOGGED))
        total: torch.Tensor | float = 0.0
        began, saved, counted = time.perf_counter() - self.seconds, time.perf_counter(), self.done
        cpu_began = time.process_time() - self.cpu_seconds
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.device)
        while self.done < plan.steps:
            total = total + self.step()
            if self.done % every and self.done < plan.steps:
                continue
            self._log(total / (self.done - counted), plan)
            total, counted = 0.0, self.done
            self.seconds, self.cpu_seconds = time.perf_counter() - began, time.process_time() - cpu_began
            if plan.checkpoint is not None and time.perf_counter() - saved >= plan.checkpoint_every_s:
                self._save(plan.checkpoint)
                saved = time.perf_counter()
            if plan.on_step is not None:
                plan.on_step(self.done, plan.steps, float(np.mean(self.logged[-1])))
        losses = np.array(self.logged, np.float32).reshape(-1, len(plan.seeds)).T
        return Curve(np.array(self.steps, np.int64), losses, self.seconds, self.cpu_seconds, self._vram_mb())

    def _vram_mb(self) -> float:
        return torch.cuda.max_memory_allocated(self.device) / 2**20 if self.device.type == "cuda" else 0.0

    @property
    def device(self) -> torch.device:
        return next(iter(self.tensors.values())).device

    def step(self) -> torch.Tensor:
        """One step; the losses [S] before it."""
        losses = self.losses()
        self.optimizer.zero_grad(set_to_none=True)
        losses.sum().backward()
        self.update()
        self.done += 1
        return losses.detach()

    def _log(self, mean: torch.Tensor, plan: Plan) -> None:
        losses = mean.tolist()
        if not all(math.isfinite(loss) for loss in losses):
            raise PolicyError(
                f"Training stopped at step {self.done} of {plan.steps}: the losses of the seeds are {losses}. Look for "
                "values that are not finite or far out of range with `demobench inspect`."
            )
        self.steps.append(self.done)
        self.logged.append(losses)

    def _save(self, path: Path) -> None:
        """Write all of it to one file, which is replaced whole."""
        tensors = {f"weights.{name}": tensor.detach() for name, tensor in self.tensors.items()}
        tensors |= {f"kept.{name}": tensor for name, tensor in self.kept.items()}
        for name, tensor in self.tensors.items():
            moments = self.optimizer.state[tensor]
            tensors |= {f"{moment}.{name}": moments[moment] for moment in ("exp_avg", "exp_avg_sq")}
        progress = {
            "fingerprint": self.fingerprint, "done": self.done, "seconds": self.seconds, "cpu_seconds": self.cpu_seconds,
            "steps": self.steps, "losses": self.logged,
        }  # fmt: skip
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with drafted(path) as draft:
                save_file(tensors, draft, metadata={"progress": json.dumps(progress)})
        except (OSError, SafetensorError) as error:
            raise StoreError(f"The checkpoint {path} cannot be written ({error}). Make room, then run again.") from None

    def _resume(self, path: Path) -> None:
        """Go on from a checkpoint, if there is one of this very training; otherwise start anew."""
        try:
            with safe_open(path, framework="pt", device=str(self.device)) as stored:
                progress = json.loads((stored.metadata() or {}).get("progress", "{}"))
                if progress.get("fingerprint") != self.fingerprint:
                    return
                tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118
        except (OSError, SafetensorError, json.JSONDecodeError):
            return
        self.done, self.seconds, self.cpu_seconds = (progress[name] for name in ("done", "seconds", "cpu_seconds"))
        self.steps, self.logged = progress["steps"], progress["losses"]
        with torch.no_grad():
            for name, tensor in self.kept.items():
                tensor.copy_(tensors[f"kept.{name}"])
            for name, tensor in self.tensors.items():
                tensor.copy_(tensors[f"weights.{name}"])
        for name, tensor in self.tensors.items():
            self.optimizer.state[tensor] = {
                "step": torch.tensor(float(self.done), device=tensor.device if tensor.is_cuda else "cpu"),
                "exp_avg": tensors[f"exp_avg.{name}"],
                "exp_avg_sq": tensors[f"exp_avg_sq.{name}"],
            }


class _StackTraining(Training):
    """A stack's training: weight decay on all of it, a constant rate."""

    def __init__(
        self, gather: Gather, windows: Windows, recipe: Recipe, plan: Plan, dtype: torch.dtype, device: str
    ):  # fmt: skip
        sizes = (windows.history * gather.inputs.shape[1], *recipe.hidden, windows.chunk * gather.actions.shape[1])
        self.stack, self.loss, self.gather = Stack.fresh(sizes, plan.seeds, dtype, device), recipe.loss, gather
        self.batches = Batches(len(windows), recipe.batch, plan.seeds)
        tensors = self.stack.tensors
        optimizer = torch.optim.AdamW(
            list(tensors.values()), lr=recipe.learning_rate, weight_decay=recipe.weight_decay, fused=True
        )
        super().__init__(tensors, optimizer, fingerprint(windows, asdict(recipe), plan, device, str(dtype)))

    def losses(self) -> torch.Tensor:
        index = torch.from_numpy(self.batches.at(self.done)).to(self.gather.inputs.device)
        inputs, actions, mask = self.gather(index)
        return seed_losses(self.stack(inputs) - actions, mask, self.loss)


def fingerprint(windows: Windows, recipe: Mapping[str, Any], plan: Plan, device: str, dtype: str) -> str:
    """What a checkpoint must agree on to be gone on from."""
    settings = {
        "windows": windows.hash(), "recipe": recipe, "seeds": plan.seeds, "steps": plan.steps,
        "threads": plan.threads, "device": device, "dtype": dtype, "torch": torch.__version__,
    }  # fmt: skip
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()


# Budgets --------------------------------------------------------------------------------------------------------------


def settle_steps(plan: Plan, make: Callable[[], Training]) -> Plan:
    """The plan with its steps known: where it gives CPU-seconds, a trial says how many steps they are.

    Rates, shuffles and noise then depend on steps alone, so that training for the recorded number again gives the same
    bytes, however fast the machine is. The trial is thrown away, its time counts. Seconds are of all the processor's cores,
    for each seed; on a GPU they are seconds of the clock.
    """
    if plan.cpu_seconds is None:
        return plan
    steps = _recorded(plan.recorded)
    if steps is None:
        steps = _try_out(make(), plan)
        if plan.recorded is not None:
            write_json(plan.recorded, {"cpu_seconds": plan.cpu_seconds, "steps": steps})
    return replace(plan, steps=steps, cpu_seconds=None)


def _recorded(path: Path | None) -> int | None:
    try:
        return int(json.loads(path.read_text())["steps"]) if path is not None else None
    except (OSError, ValueError, KeyError):
        return None


def _try_out(training: Training, plan: Plan) -> int:
    """Steps that fit into the plan's CPU-seconds: a few at first, which are slow, then at least as many as take TRIAL of them."""
    on_gpu = training.device.type == "cuda"

    def now() -> float:
        if not on_gpu:
            return time.process_time()
        torch.cuda.synchronize()
        return time.perf_counter()

    began = now()
    for _ in range(FIRST):
        training.step()
    warm, counted = now(), 0
    while counted < FIRST or now() - warm < TRIAL * plan.cpu_seconds * len(plan.seeds):
        training.step()
        counted += 1
    ended = now()
    left = plan.cpu_seconds * len(plan.seeds) - (ended - began)
    return max(1, int(left / ((ended - warm) / counted)))


def device_named(asked: str) -> str:
    """`auto` is a GPU where there is one.

    Raises:
        PolicyError: "cuda", and there is none.
    """
    if asked == "cuda" and not torch.cuda.is_available():
        raise PolicyError('device = "cuda", but PyTorch finds no CUDA device here. Use device = "auto" or "cpu".')
    return "cuda" if asked == "auto" and torch.cuda.is_available() else asked.replace("auto", "cpu")


@contextmanager
def threads(count: int):
    """Sums depend on how many threads share them, so training runs with a number of its own."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)

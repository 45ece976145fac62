"""Policies that are torch modules: what they have in common, and how they are trained, one network a seed.

What belongs here: from windows to a module's inputs and back, rates, averages, samples' random numbers. What does not: any
method's network or loss (each in its own file), the loop and its checkpoints (`fitting`), the view of the data (`transform`).

A method is a subclass of `NetworkPolicy` that names its `Net`. All seeds go on in step, each with batches, noise and dropout
that depend on (seed, step) alone, so that a network does not depend on which others are trained beside it.
"""

import hashlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import nn

from pipeline.policies import Curve, Plan
from pipeline.policies.augmentation import Augment, fit_augment, in_hindsight
from pipeline.policies.fitting import Batches, Training, device_named, fingerprint, settle_steps, threads
from pipeline.policies.transform import Transform, fit_transform
from pipeline.settings import SETTINGS, MethodSettings, TrainingSettings, settings_of
from pipeline.types import Observations
from pipeline.windows import Windows

SAMPLES_AT_ONCE = 4096
"""At most so many (observation, sample) pairs go through a network together."""


@dataclass(frozen=True)
class Shape:
    """What goes into a network and comes out: F inputs from T frames, K × A' outputs; `limit` [K · A'] is the largest training
    target."""

    inputs: int
    history: int
    chunk: int
    width: int
    limit: np.ndarray

    @property
    def outputs(self) -> int:
        return self.chunk * self.width


class Net(nn.Module):
    """One network of a method. Inputs are [B, F], targets and answers [B, K · A'], masks [B, K · A'] or None."""

    draws: bool = False
    """Whether `answer` depends on the noise that it is given (`draw` always does)."""

    def loss(self, inputs: torch.Tensor, targets: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        """The mean loss of a batch; random numbers come from torch's own generator, which is set for each step."""
        raise NotImplementedError

    def answer(self, inputs: torch.Tensor, noise: torch.Tensor | None) -> torch.Tensor:
        """What the policy does; `noise` [B, `noise_width`] is standard normal."""
        raise NotImplementedError

    def draw(self, inputs: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """One sample of what could be done."""
        return self.answer(inputs, noise)

    @property
    def noise_width(self) -> int:
        """How many random numbers a draw needs."""
        return 0


def masked_mean(values: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """The mean over targets inside their episode."""
    return (values * mask).sum() / mask.sum().clamp(min=1)


class NetworkPolicy:
    """Fitted networks of one method, one a seed; answers as every policy does.

    method  its name in `methods.METHODS`, under which its settings' type is found
    net     the class of its networks, each made with settings and a shape, weights from torch's own generator
    """

    method: ClassVar[str]
    net: ClassVar[type[Net]]

    def __init__(
        self,
        nets: tuple[Net, ...],
        transform: Transform,
        shape: Shape,
        seeds: tuple[int, ...],
        made_with: MethodSettings,
    ):
        self.nets, self.transform, self.shape = nets, transform, shape
        self.seeds, self.made_with = seeds, made_with
        for net in nets:
            net.eval().requires_grad_(False)

    @classmethod
    def build(cls, settings: Any, shape: Shape) -> Net:
        """A fresh network."""
        return cls.net(settings, shape)

    @classmethod
    def see(cls, settings: Any, transform: Transform, observations: Observations) -> np.ndarray:
        """[B, F] float32, what enters the network."""
        return transform.encode(observations.values)

    @property
    def chunk(self) -> int:
        return self.shape.chunk

    @property
    def history(self) -> int:
        return self.transform.history

    @property
    def parameters(self) -> int:
        """Of one network."""
        return sum(parameter.numel() for parameter in self.nets[0].parameters())

    @classmethod
    def fit(cls, windows: Windows, plan: Plan) -> tuple[Self, Curve]:
        """Train one network a seed.

        Raises
        ------
        PolicyError : the loss is not finite any more, or what was asked for does not fit the data.
        ConfigError : a setting that there is not.
        StoreError : a checkpoint cannot be written.
        """
        settings = settings_of(cls.method, plan.settings)
        windows = in_hindsight(windows, plan.given.get("hindsight"))
        transform = fit_transform(windows, **_of(plan.given, "actions", "features"))
        augment = fit_augment(windows, **_of(plan.given, "noise", "offset", "symmetry"))
        sampler = Sampler(windows, transform, augment, partial(cls.see, settings, transform))
        shape = Shape(sampler.inputs, windows.history, windows.chunk, transform.width, sampler.limit())

        def make(settled: Plan) -> NetworkTraining:
            return NetworkTraining(cls, settings, shape, sampler, settled)

        with threads(plan.threads), torch.random.fork_rng():
            settled = settle_steps(plan, lambda: make(plan))
            training = make(settled)
            curve = training.run(settled)
        return cls(training.finished(), transform, shape, plan.seeds, settings), curve

    # Answers ------------------------------------------------------------------------------------------------------------

    def predict(self, observations: Observations, horizons: int = 1) -> np.ndarray:
        """[S, B, K, A] float32, raw units; K is the policy's own chunk, whatever `horizons` says.

        A method that draws draws from its seed and the observation alone: the same observation has the same answer, whatever
        else is asked together with it.
        """
        return self._ask(observations, 1, "answer")[:, 0]

    def _ask(self, observations: Observations, count: int, how: str) -> np.ndarray:
        """[S, n, B, K, A]."""
        values = observations.values
        inputs = torch.from_numpy(self.see(self.made_with, self.transform, observations))
        now = self.transform.now(values)
        batch, block = len(values), max(1, SAMPLES_AT_ONCE // count)
        encoded = np.empty((len(self.seeds), count, batch, self.shape.chunk, self.shape.width), np.float32)
        for number, (seed, net) in enumerate(zip(self.seeds, self.nets, strict=True)):
            for start in range(0, batch, block):
                part = slice(start, min(start + block, batch))
                repeated = inputs[part].repeat(count, 1)
                noise = self._noise(seed, values[part], count, net) if net.draws or how == "draw" else None
                with torch.inference_mode():
                    answer = getattr(net, how)(repeated, noise).float().numpy()
                encoded[number, :, part] = answer.reshape(count, -1, self.shape.chunk, self.shape.width)
        return self.transform.decode_actions(encoded, now)

    @staticmethod
    def _noise(seed: int, values: np.ndarray, count: int, net: Net) -> torch.Tensor:
        """[n · B, width] standard normal numbers, of each observation from its own bytes."""
        drawn = np.empty((count, len(values), net.noise_width), np.float32)
        for row, seen in enumerate(np.ascontiguousarray(values)):
            key = hashlib.blake2b(seen.tobytes(), digest_size=8).digest()
            generator = np.random.Generator(np.random.Philox(key=[seed, int.from_bytes(key, "little")]))
            drawn[:, row] = generator.standard_normal((count, net.noise_width), np.float32)
        return torch.from_numpy(drawn.reshape(count * len(values), -1))

    def one_seed(self, position: int = 0) -> Self:
        """The same policy with one of its networks only: what roll-outs ask."""
        cut = slice(position, position + 1)
        return type(self)(self.nets[cut], self.transform, self.shape, self.seeds[cut], self.made_with)

    # Files --------------------------------------------------------------------------------------------------------------

    def arrays(self) -> dict[str, np.ndarray]:
        found = self.transform.arrays() | {"shape.limit": self.shape.limit}
        for seed, net in zip(self.seeds, self.nets, strict=True):
            found |= {f"seed_{seed}.{name}": tensor.numpy() for name, tensor in net.state_dict().items()}
        return found

    def settings(self) -> dict[str, Any]:
        return {
            "seeds": list(self.seeds),
            "made_with": self.made_with.model_dump(mode="json"),
            "transform": self.transform.settings(),
            "inputs": self.shape.inputs,
        }

    @classmethod
    def restore(cls, arrays: Mapping[str, np.ndarray], settings: Mapping[str, Any]) -> Self:
        """The inverse of `arrays` and `settings`."""
        transform = Transform.restore(arrays, settings["transform"])
        shape = Shape(settings["inputs"], transform.history, transform.chunk, transform.width, arrays["shape.limit"])
        made_with, seeds = SETTINGS[cls.method].model_validate(settings["made_with"]), tuple(settings["seeds"])
        nets = []
        for seed in seeds:
            net, mine = cls.build(made_with, shape), f"seed_{seed}."
            net.load_state_dict(
                {n.removeprefix(mine): torch.tensor(a) for n, a in arrays.items() if n.startswith(mine)}
            )
            nets.append(net)
        return cls(tuple(nets), transform, shape, seeds, made_with)


class Samples:
    """Mixed into policies that model a distribution."""

    def sample(self: Any, observations: Observations, count: int) -> np.ndarray:
        """[S, n, B, K, A] float32, raw units: n draws for each observation, the same ones whenever it is asked."""
        return self._ask(observations, count, "draw")


# Training -----------------------------------------------------------------------------------------------------------------


class Sampler:
    """Training windows as a network sees them, varied anew in each step, gathered when they are needed."""

    def __init__(
        self,
        windows: Windows,
        transform: Transform,
        augment: Augment | None,
        see: Callable[[Observations], np.ndarray],
    ):
        self.windows, self.transform, self.augment, self.see = windows, transform, augment, see
        self.inputs = see(windows.observations(slice(0, 1))).shape[1]

    def batch(self, index: np.ndarray, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """[B] window numbers → inputs [B, F], targets and mask [B, K · A'], float32."""
        seen, (actions, inside) = self.windows.observations(index), self.windows.targets(index)
        if self.augment is not None:
            values, actions = self.augment(seen.values, actions, generator)
            seen = replace(seen, values=values)
        values = seen.values
        targets = self.transform.encode_actions(actions, self.transform.now(values))
        mask = np.broadcast_to(inside[..., None], targets.shape).astype(np.float32)
        return self.see(seen), targets.reshape(len(index), -1), mask.reshape(len(index), -1)

    def limit(self) -> np.ndarray:
        """[K · A'] the largest size of each target."""
        largest = np.zeros(self.transform.chunk * self.transform.width, np.float32)
        for start in range(0, len(self.windows), 4096):
            index = np.arange(start, min(start + 4096, len(self.windows)))
            values, (actions, inside) = self.windows.observations(index).values, self.windows.targets(index)
            targets = np.abs(self.transform.encode_actions(actions, self.transform.now(values))) * inside[..., None]
            largest = np.maximum(largest, targets.reshape(len(index), -1).max(axis=0))
        return np.where(largest > 0, largest, 1.0)


class NetworkTraining(Training):
    """Networks of all seeds in step: AdamW with weight decay on matrices, rates by step, clipped gradients, an average."""

    def __init__(
        self, policy: type[NetworkPolicy], settings: TrainingSettings, shape: Shape, sampler: Sampler, plan: Plan
    ):
        self.settings, self.sampler, self.seeds, self.plan_steps = settings, sampler, plan.seeds, plan.steps
        device = device_named(plan.device)
        self.nets = [_seeded(seed, policy, settings, shape).to(device) for seed in plan.seeds]
        self.batches = Batches(len(sampler.windows), settings.batch, plan.seeds)
        named = {
            f"{seed}.{name}": parameter
            for seed, net in zip(plan.seeds, self.nets, strict=True)
            for name, parameter in net.named_parameters()
        }
        groups = [
            {"params": [p for p in named.values() if p.ndim >= 2], "weight_decay": settings.weight_decay},
            {"params": [p for p in named.values() if p.ndim < 2], "weight_decay": 0.0},
        ]
        optimizer = torch.optim.AdamW(groups, lr=settings.learning_rate, betas=BETAS, fused=True)
        recipe = {"method": policy.method, "settings": settings.model_dump(mode="json"), "given": dict(plan.given)}
        super().__init__(named, optimizer, fingerprint(sampler.windows, recipe, plan, device, "float32"))
        if settings.ema:
            self.kept = {name: parameter.detach().clone() for name, parameter in named.items()}

    def losses(self) -> torch.Tensor:
        chosen = self.batches.at(self.done)
        return torch.stack([self._loss(number, chosen[number]) for number in range(len(self.seeds))])

    def _loss(self, number: int, index: np.ndarray) -> torch.Tensor:
        seed, net = self.seeds[number], self.nets[number]
        # Shuffles have the keys (seed, number of the pass): far from these.
        generator = np.random.Generator(np.random.Philox(key=[seed, 2**40 + self.done]))
        tensors = (torch.from_numpy(a).to(self.device) for a in self.sampler.batch(index, generator))
        torch.manual_seed(int(generator.integers(2**62)))
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.settings.bf16):
            return net.loss(*tensors).float()

    def update(self) -> None:
        clip, rate = self.settings.clip, self.settings.learning_rate * self._rate()
        if clip:
            for net in self.nets:
                nn.utils.clip_grad_norm_(net.parameters(), clip)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.step()
        if self.kept:
            share = 1 - min(LONGEST_MEMORY, (1 + self.done) / (10 + self.done))
            with torch.no_grad():
                torch._foreach_lerp_(list(self.kept.values()), [p.detach() for p in self.tensors.values()], share)

    def _rate(self) -> float:
        """1 at most: rising at first, then, where it falls, half a cosine down to zero at the last step."""
        warmup = min(self.settings.warmup, self.plan_steps // 2)
        if self.done < warmup:
            return (self.done + 1) / warmup
        if not self.settings.cosine:
            return 1.0
        return 0.5 * (1 + math.cos(math.pi * (self.done - warmup) / max(1, self.plan_steps - warmup)))

    def finished(self) -> tuple[Net, ...]:
        """The networks on the CPU, with the average of their weights where one is kept."""
        with torch.no_grad():
            for name, average in self.kept.items():
                self.tensors[name].copy_(average)
        return tuple(net.cpu() for net in self.nets)


BETAS = (0.9, 0.99)
"""AdamW's: gradients' squares are forgotten sooner than by default, since trainings here are short."""
LONGEST_MEMORY = 0.999


def _of(given: Mapping[str, Any], *keys: str) -> dict[str, Any]:
    return {key: given[key] for key in keys if key in given}


def _seeded(seed: int, policy: type[NetworkPolicy], settings: MethodSettings, shape: Shape) -> Net:
    torch.manual_seed(seed)
    return policy.build(settings, shape).train()

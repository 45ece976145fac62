"""Locally weighted regression over neighbours (Atkeson, Moore & Schaal 1997): the strong classical baseline.

What belongs here: remembering, weighting, regressing, and choosing how far neighbours reach. What does not: how columns are
scaled and what answers are relative to (`transform`).

At each question the k nearest training windows, weighted by the tricube of their distance over that of the farthest, give a
linear fit of the whole chunk, whose slopes are held back by a ridge (a share of the neighbours' mean variance). k and ridge are
chosen on training episodes alone: windows of some are answered from the others. Departures: distances are plain ones between
scaled inputs, and an answer stays within what its neighbours did, since straight lines lead anywhere once a policy is off the
beaten track.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, ClassVar, Self

import numpy as np

from pipeline.policies import Curve, Plan
from pipeline.policies.augmentation import apply_symmetry, in_hindsight
from pipeline.policies.transform import Transform, fit_transform
from pipeline.settings import settings_of
from pipeline.types import ACTION, Observations
from pipeline.windows import Windows, rows

NEIGHBOURS = (8, 16, 32, 64, 128, 256, 512, 1024)
RIDGES = (0.01, 0.1, 1.0, 10.0)
"""What is chosen among; a large ridge is an average without slopes."""
PROBES = 256
"""Training windows that the choice is made on, at the first, the middle and the last action of the chunk."""
QUERIES = 64
"""Questions answered at a time."""


@dataclass(frozen=True)
class Lwr:
    """The encoded training windows, and where their actions are.

    inputs [M, F] float32     now [M, R] what relative actions are relative to     actions [N', A] raw
    anchors [M] rows of `actions`, `remaining` [M] the largest horizon at which a window still has its own action
    """

    transform: Transform
    inputs: np.ndarray
    now: np.ndarray
    actions: np.ndarray
    anchors: np.ndarray
    remaining: np.ndarray
    neighbours: int
    ridge: float
    seeds: tuple[int, ...]

    parameters: ClassVar[int] = 0

    @classmethod
    def fit(cls, windows: Windows, plan: Plan) -> tuple[Self, Curve]:
        """Remember, then choose what is not set. Seeds change nothing: their answers are the same.

        Raises
        ------
        PolicyError : what was asked for does not fit the data.
        ConfigError : a setting that there is not.
        """
        began = time.perf_counter()
        settings = settings_of("lwr", plan.settings)
        windows = in_hindsight(windows, plan.given.get("hindsight"))
        given = {key: plan.given[key] for key in ("actions", "features") if key in plan.given}
        policy, episode = _remember(cls, windows, fit_transform(windows, **given), plan)
        policy = replace(policy, neighbours=settings.neighbours, ridge=settings.ridge)
        if not (settings.neighbours and settings.ridge):
            policy = _chosen(policy, episode, len(windows))
        no_losses = np.empty((len(plan.seeds), 0), np.float32)
        return policy, Curve(np.empty(0, np.int64), no_losses, time.perf_counter() - began)

    @property
    def chunk(self) -> int:
        return self.transform.chunk

    def predict(self, observations: Observations, horizons: int = 1) -> np.ndarray:
        """[S, B, K, A] float32, raw units."""
        values = observations.values
        inputs, now = self.transform.encode(values), self.transform.now(values)
        parts = []
        for start in range(0, len(inputs), QUERIES):
            some = inputs[start : start + QUERIES]
            parts.append(
                self.answer(some, self.nearest(some, self.neighbours), (self.ridge,), np.arange(self.chunk))[0]
            )
        answer = self.transform.decode_actions(np.concatenate(parts), now)
        return np.repeat(answer[None], len(self.seeds), axis=0)

    def nearest(self, queries: np.ndarray, count: int, usable: np.ndarray | None = None) -> np.ndarray:
        """[B, k] the windows nearest to each question, nearest first; `usable` [B, M] says which there are for it."""
        squared = (self.inputs**2).sum(1) - 2 * queries @ self.inputs.T
        if usable is not None:
            squared = np.where(usable, squared, np.inf)
        count = min(count, int(np.isfinite(squared).sum(axis=1).min()))
        near = np.argpartition(squared, count - 1, axis=1)[:, :count]
        order = np.take_along_axis(squared, near, axis=1).argsort(axis=1, kind="stable")
        return np.take_along_axis(near, order, axis=1)

    def answer(
        self, queries: np.ndarray, near: np.ndarray, ridges: tuple[float, ...], horizons: np.ndarray
    ) -> np.ndarray:
        """[ridges, B, horizons, A'] encoded, from the neighbours [B, k]."""
        apart = self.inputs[near].astype(np.float64) - queries[:, None]
        distance = np.sqrt((apart**2).sum(axis=2))
        # The farthest of them would have no weight at all, and where all are equally far, none would.
        reach = distance.max(axis=1, keepdims=True) * 1.001 + 1e-9
        weight = (1 - (distance / reach) ** 3) ** 3
        targets, inside = self._targets(near, horizons)
        found = _regress(weight, apart, targets, ridges)
        for position in range(len(horizons)):
            # Windows that end before this horizon have nothing to say about it.
            some = ~inside[..., position].all(axis=1) & inside[..., position].any(axis=1)
            if some.any():
                own = weight[some] * inside[some, :, position]
                one = slice(position, position + 1)
                found[:, some, one] = _regress(own, apart[some], targets[some][:, :, one], ridges)
        return np.clip(found, targets.min(axis=1), targets.max(axis=1)).astype(np.float32)

    def _targets(self, near: np.ndarray, horizons: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """[B, k, horizons, A'] what neighbours did, encoded, and [B, k, horizons] whether they did."""
        ahead, flat = np.arange(self.chunk), near.ravel()
        frames = self.anchors[flat, None] + np.minimum(ahead, self.remaining[flat, None])
        encoded = self.transform.encode_actions(rows(self.actions, frames), self.now[flat])
        chosen = encoded.reshape(*near.shape, *encoded.shape[1:])[:, :, horizons]
        return chosen, self.remaining[near][..., None] >= horizons

    def one_seed(self, position: int = 0) -> Self:
        """The policy of one seed alone."""
        return replace(self, seeds=self.seeds[position : position + 1])

    def arrays(self) -> dict[str, np.ndarray]:
        remembered = ("inputs", "now", "actions", "anchors", "remaining")
        return self.transform.arrays() | {f"memory.{name}": getattr(self, name) for name in remembered}

    def settings(self) -> dict[str, Any]:
        own = {"neighbours": self.neighbours, "ridge": self.ridge, "seeds": list(self.seeds)}
        return own | {"transform": self.transform.settings()}

    @classmethod
    def restore(cls, arrays: Mapping[str, np.ndarray], settings: Mapping[str, Any]) -> Self:
        """The inverse of `arrays` and `settings`."""
        remembered = ("inputs", "now", "actions", "anchors", "remaining")
        return cls(
            Transform.restore(arrays, settings["transform"]),
            **{name: arrays[f"memory.{name}"] for name in remembered},
            neighbours=settings["neighbours"],
            ridge=settings["ridge"],
            seeds=tuple(settings["seeds"]),
        )


def _regress(weight: np.ndarray, apart: np.ndarray, targets: np.ndarray, ridges: tuple[float, ...]) -> np.ndarray:
    """[B, k], [B, k, F] inputs less the question, [B, k, H, A'] → [ridges, B, H, A'] the weighted fits at the question."""
    batch, count, *chunk = targets.shape
    share = weight / weight.sum(axis=1, keepdims=True)
    mean = (share[:, None] @ apart)[:, 0]
    flat = targets.reshape(batch, count, -1).astype(np.float64)
    middle = share[:, None] @ flat
    off = apart - mean[:, None]
    weighted = (share[..., None] * off).transpose(0, 2, 1)
    covariance, together = weighted @ off, weighted @ (flat - middle)
    size = off.shape[2]
    held = np.trace(covariance, axis1=1, axis2=2)[:, None, None] / size * np.eye(size)
    slopes = [np.linalg.solve(covariance + ridge * held + 1e-12 * np.eye(size), together) for ridge in ridges]
    return np.stack([(middle - mean[:, None] @ slope).reshape(batch, *chunk) for slope in slopes])


def _remember(cls: type[Lwr], windows: Windows, transform: Transform, plan: Plan) -> tuple[Lwr, np.ndarray]:
    """The policy with nothing chosen, and the episode of each window; windows in the mirror, if asked for, come after."""
    demos, symmetry = windows.demos, plan.given.get("symmetry")
    actions = np.asarray(demos.columns[ACTION])
    parts = [(windows.observations().values, actions)]
    if symmetry is not None:
        widths = transform.widths
        # An episode is turned as a whole, so that the actions of its frames belong together.
        amount = np.random.default_rng(0).random(demos.episodes)[demos.episode_of_frame]
        turned = apply_symmetry(symmetry, widths, parts[0][0], windows.targets()[0], amount[windows.anchors])[0]
        every = apply_symmetry(symmetry, widths, windows.values[:, None], actions[:, None], amount)
        parts.append((turned, every[1][:, 0]))
    kept = np.concatenate([np.arange(demos.frames)[demos.episode(e)] for e in windows.episodes])
    row = np.full(demos.frames, -1, np.int64)
    row[kept] = np.arange(len(kept))
    policy = cls(
        transform=transform,
        inputs=np.concatenate([transform.encode(values) for values, _ in parts]),
        now=np.concatenate([transform.now(values) for values, _ in parts]),
        actions=np.concatenate([acted[kept] for _, acted in parts]),
        anchors=np.concatenate([row[windows.anchors] + number * len(kept) for number in range(len(parts))]),
        remaining=np.tile(windows.end_frame - 1 - windows.anchors, len(parts)),
        neighbours=0,
        ridge=0.0,
        seeds=plan.seeds,
    )
    return policy, np.tile(windows.first_frame, len(parts))


def _chosen(policy: Lwr, episode: np.ndarray, unturned: int) -> Lwr:
    """The neighbours and ridge with the smallest error on windows answered from other training episodes."""
    neighbours = (policy.neighbours,) if policy.neighbours else NEIGHBOURS
    ridges = (policy.ridge,) if policy.ridge else RIDGES
    if len(np.unique(episode)) == 1:
        return replace(policy, neighbours=neighbours[0], ridge=ridges[0])
    probes = np.random.default_rng(0).permutation(unturned)[:PROBES]
    errors = dict.fromkeys(product(neighbours, ridges), 0.0)
    horizons = np.unique([0, (policy.chunk - 1) // 2, policy.chunk - 1])
    for start in range(0, len(probes), QUERIES):
        some = probes[start : start + QUERIES]
        targets, inside = policy._targets(some[:, None], horizons)
        near = policy.nearest(policy.inputs[some], max(neighbours), episode[some][:, None] != episode)
        for count in neighbours:
            answers = policy.answer(policy.inputs[some], near[:, :count], ridges, horizons)
            for ridge, answer in zip(ridges, answers, strict=True):
                errors[count, ridge] += float((np.abs(answer - targets[:, 0]) * inside[:, 0, :, None]).sum())
    count, ridge = min(errors, key=lambda pair: errors[pair])
    return replace(policy, neighbours=count, ridge=ridge)

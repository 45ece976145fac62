"""A trained network as one ONNX file that a robot can run without this project: raw observations in, raw actions out.

What belongs here: a network with its scaling as one graph, what is written beside it, and the proof that it answers as PyTorch
does. What does not: finding policies (`demobench.commands.trained`), running one on a robot.

    observations [1, T, O] float32  raw columns, oldest frame first      actions [1, K, A] float32  raw, from the frame asked at on
    derived [1, F] float32          what the policy's function makes of them, where it has derived features
    noise [1, W] float32            standard normal numbers, where the policy draws

The batch is one: a robot asks for itself.
"""

import json
import logging
import os
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from pipeline.errors import NotApplicableError, PolicyError, StoreError
from pipeline.folds import PolicyTask
from pipeline.lerobot_format.kinds import wrap
from pipeline.methods import METHODS
from pipeline.normalize import Scaler, circular_columns
from pipeline.policies.mlp import PlainMlp
from pipeline.policies.networks import NetworkPolicy
from pipeline.policies.transform import derive
from pipeline.types import ACTION
from pipeline.windows import Windows

OPSET = 20
"""PyTorch's own default; runtimes on robots lag behind."""
MOST_OFF = 1e-3
"""The most that an exported network may be off, in deviations of an action column."""
COMPARED = 100
"""Held-out windows that the comparison is made on."""


@dataclass(frozen=True)
class Exported:
    """What was written: inputs by name with their shapes, the file's metadata, and the most that it is off PyTorch's answers,
    in the actions' own units, over `compared` held-out windows.
    """

    inputs: Mapping[str, tuple[int, ...]]
    output: tuple[int, ...]
    metadata: Mapping[str, Any]
    bytes: int
    most_off: float
    compared: int


def export_policy(task: PolicyTask, policy: Any, out: Path, said: Mapping[str, Any]) -> Exported:
    """Write the first network of a policy to an ONNX file, after it was found to answer as PyTorch does.

    Parameters
    ----------
    said : what the file is to say of itself, beside what the task knows.

    Raises
    ------
    NotApplicableError : a policy of this kind is no network, or one of the packages is missing.
    PolicyError : the exported network answers otherwise.
    StoreError : the file cannot be written.
    """
    name, method = task.variant.name, task.variant.method
    if METHODS[method].camera:
        raise NotApplicableError(
            f"'{name}' sees a camera, and how pictures become its input is not part of the network. It is not exported."
        )
    if not isinstance(policy, PlainMlp | NetworkPolicy):
        raise NotApplicableError(
            f"'{name}' cannot be exported: the method '{method}' is no network of this project's. Those that are: mlp, gmm, flow, "
            "diffusion, act, notebook_pusht."
        )
    fold = task.split.folds[0]
    windows, metadata = task.windows(fold.test, fold), _metadata(task, policy, said)
    content, inputs = onnx_of(policy, windows, metadata)
    off, relative = most_off(content, policy, windows)
    if not relative <= MOST_OFF:
        raise PolicyError(
            f"The exported {name} answers otherwise than PyTorch: up to {off:.3g} off, {relative:.3g} deviations of an action "
            "column. Nothing was written; try other versions of onnxscript and onnxruntime."
        )
    _write(out, content)
    output = (1, policy.chunk, len(task.demos.features[ACTION].names))
    return Exported(inputs, output, metadata, len(content), off, min(COMPARED, len(windows)))


def onnx_of(
    policy: PlainMlp | NetworkPolicy, windows: Windows, metadata: Mapping[str, Any]
) -> tuple[bytes, dict[str, tuple[int, ...]]]:
    """The file's content, and its inputs by name with their shapes.

    Raises:
        NotApplicableError: one of the packages is missing.
    """
    onnx, _ = _packages()
    graph = _PlainGraph(policy) if isinstance(policy, PlainMlp) else _NetworkGraph(policy)
    example = _inputs(policy, windows, 0)
    model = _traced(graph, example)
    onnx.helper.set_model_props(model, {key: _text(value) for key, value in metadata.items()})
    return model.SerializeToString(), {name: array.shape for name, array in example.items()}


def most_off(content: bytes, policy: PlainMlp | NetworkPolicy, windows: Windows) -> tuple[float, float]:
    """The most that onnxruntime's answers differ from the policy's on held-out windows, in raw units and in deviations."""
    _, onnxruntime = _packages()
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    numbers = np.unique(np.linspace(0, len(windows) - 1, COMPARED).astype(int))
    found = np.concatenate([session.run(["actions"], _inputs(policy, windows, n))[0] for n in numbers])
    off = found.astype(np.float64) - policy.predict(windows.observations(numbers))[0]
    angles = circular_columns(windows.demos, windows.semantics, [ACTION])
    off[..., angles] = wrap(off[..., angles])
    off = np.abs(off)
    return float(off.max()), float((off / windows.normalizer.actions.scale[: off.shape[-1]]).max())


def _packages() -> tuple[Any, Any]:
    try:
        import onnx
        import onnxruntime
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise NotApplicableError(
            f"What exports to ONNX is not installed ({error}). Install it with: pip install 'demobench[onnx]'"
        ) from None
    return onnx, onnxruntime


# Graphs -------------------------------------------------------------------------------------------------------------------


class _Scaling(nn.Module):
    """A `Scaler` in torch, float32."""

    def __init__(self, scaler: Scaler):
        super().__init__()
        self.columns, self.angles = len(scaler.circular), np.flatnonzero(scaler.circular).tolist()
        for name, array in (("mean", scaler.mean), ("scale", scaler.scale), ("centre", scaler.centre)):
            self.register_buffer(name, torch.tensor(array, dtype=torch.float32))

    def encode(self, values: torch.Tensor) -> torch.Tensor:
        parts = [
            values[..., k : k + 1].sin() if k in self.angles else values[..., k : k + 1] for k in range(self.columns)
        ]
        parts += [values[..., k : k + 1].cos() for k in self.angles]
        return (torch.cat(parts, dim=-1) - self.mean) / self.scale

    def decode(self, encoded: torch.Tensor) -> torch.Tensor:
        plain = encoded * self.scale + self.mean
        parts = [plain[..., k : k + 1] for k in range(self.columns)]
        for number, k in enumerate(self.angles):
            cosine = plain[..., self.columns + number : self.columns + number + 1]
            parts[k] = _near(torch.atan2(parts[k], cosine), self.centre[k])
        return torch.cat(parts, dim=-1)


def _near(angle: torch.Tensor, centre: torch.Tensor) -> torch.Tensor:
    """The angle within π of a centre."""
    away = torch.remainder(torch.pi - (angle - centre), 2 * torch.pi) - torch.pi
    return centre - away


class _PlainGraph(nn.Module):
    def __init__(self, policy: PlainMlp):
        super().__init__()
        self.stack, self.chunk = policy.stack.of_seed(0), policy.chunk
        self.seen, self.done = _Scaling(policy.normalizer.observations), _Scaling(policy.normalizer.actions)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        answer = self.stack(self.seen.encode(observations).reshape(1, 1, -1))
        return self.done.decode(answer.reshape(1, self.chunk, -1))


class _NetworkGraph(nn.Module):
    """A network with its transform: as `NetworkPolicy.predict`, for one observation."""

    def __init__(self, policy: NetworkPolicy):
        super().__init__()
        transform, self.net = policy.transform, policy.nets[0]
        self.chunk = policy.chunk
        self.seen, self.absolute = _Scaling(transform.observations), _Scaling(transform.absolute)
        self.derived = None if transform.derived is None else _Scaling(transform.derived[1])
        self.relative, self.circular = transform.relative.tolist(), transform.circular.tolist()
        offsets = dict(zip(transform.widths, np.cumsum([0, *transform.widths.values()])[:-1].tolist(), strict=True))
        at = offsets.get("observation.state", 0)
        self.now = [at + int(column) for column in transform.state_column[transform.relative]]
        self.register_buffer("rms", torch.tensor(transform.rms, dtype=torch.float32))
        self.register_buffer("centre", torch.tensor(transform.centre, dtype=torch.float32))

    def forward(
        self, observations: torch.Tensor, derived: torch.Tensor | None = None, noise: torch.Tensor | None = None
    ) -> torch.Tensor:
        inputs = self.seen.encode(observations).reshape(1, -1)
        if self.derived is not None:
            inputs = torch.cat([inputs, self.derived.encode(derived)], dim=1)
        encoded = self.net.answer(inputs, noise).float().reshape(1, self.chunk, -1)
        return self._decoded(encoded, observations)

    def _decoded(self, encoded: torch.Tensor, observations: torch.Tensor) -> torch.Tensor:
        split = encoded.shape[-1] - len(self.now)
        absolute, columns = self.absolute.decode(encoded[..., :split]) if split else None, []
        plain, moved = 0, 0
        for column, is_relative in enumerate(self.relative):
            if not is_relative:
                columns.append(absolute[..., plain : plain + 1])
                plain += 1
                continue
            now = observations[:, -1, self.now[moved]].reshape(1, 1, 1)
            value = now + encoded[..., split + moved : split + moved + 1] * self.rms[:, moved : moved + 1]
            columns.append(_near(value, self.centre[column]) if self.circular[column] else value)
            moved += 1
        return torch.cat(columns, dim=-1)


def _inputs(policy: Any, windows: Windows, number: int) -> dict[str, np.ndarray]:
    """What the graph is asked for one held-out window."""
    values = windows.observations(slice(number, number + 1)).values
    inputs = {"observations": np.ascontiguousarray(values, np.float32)}
    if isinstance(policy, NetworkPolicy):
        transform = policy.transform
        if transform.derived is not None:
            inputs["derived"] = derive(transform.derived[0], transform.widths, values).astype(np.float32)
        if policy.nets[0].draws:
            inputs["noise"] = policy._noise(policy.seeds[0], values, 1, policy.nets[0]).numpy()
    return inputs


def _traced(graph: nn.Module, example: Mapping[str, np.ndarray]) -> Any:
    """The graph as an ONNX model."""
    fast = torch.backends.mha.get_fastpath_enabled()
    torch.backends.mha.set_fastpath_enabled(False)  # fused attention has no name in ONNX
    silenced = logging.root.manager.disable
    logging.disable(logging.WARNING)  # what the exporter says of its own code
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            program = torch.onnx.export(
                graph.eval(),
                kwargs={name: torch.from_numpy(array) for name, array in example.items()},
                input_names=list(example),
                output_names=["actions"],
                opset_version=OPSET,
                dynamo=True,
                verbose=False,
            )
    finally:
        torch.backends.mha.set_fastpath_enabled(fast)
        logging.disable(silenced)
    return program.model_proto


# The file --------------------------------------------------------------------------------------------------


def _metadata(task: PolicyTask, policy: Any, said: Mapping[str, Any]) -> dict[str, Any]:
    """Everything that somebody needs who has nothing but the file."""
    features = [task.demos.features[key] for key in task.observation_set.features]
    action = task.demos.features[ACTION]
    known = {
        "data_set": task.demos.name,
        "content_hash": task.demos.content_hash,
        "fps": task.demos.fps,
        "policy": task.variant.name,
        "method": task.variant.method,
        "seed": policy.seeds[0],
        "observation_set": task.observation_set.name,
        "observation_names": [name for feature in features for name in feature.names],
        "observation_units": [unit for feature in features for unit in feature.units],
        "observation_features": {feature.key: len(feature.names) for feature in features},
        "action_names": list(action.names),
        "action_units": list(action.units),
        "action_kinds": list(task.semantics.kinds),
        "history": policy.history,
        "chunk": policy.chunk,
    }
    if isinstance(policy, NetworkPolicy) and policy.transform.derived is not None:
        known["derived_features"] = policy.transform.derived[0]
    return known | {"opset": OPSET} | dict(said)


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _write(out: Path, content: bytes) -> None:
    draft = out.with_name(f".{out.name}.{os.getpid()}")
    try:
        draft.write_bytes(content)
        draft.replace(out)
    except OSError as error:
        draft.unlink(missing_ok=True)
        raise StoreError(f"{out} cannot be written: {error.strerror}.") from None

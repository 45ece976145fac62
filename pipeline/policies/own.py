"""A policy of the user's own: a class with two methods, named in the configuration by file or module.

    class MyPolicy:
        def fit(self, observations, actions, mask, seed): ...    learns from windows
        def predict(self, observations): ...                     answers [B, K, A]

    observations  [M, T, O] float32  the observation set's columns in raw units, T frames, oldest first
    actions       [M, K, A] float32  what was done there and after, raw units
    mask          [M, K] bool        False past the end of an episode, where the last action is repeated

What belongs here: finding the class, one object a seed, and keeping what it learned without pickling anything. What does
not: anything about one policy.

What is kept are the object's attributes, where they are arrays, numbers, text, or lists and dictionaries of those. A
class that holds anything else (a network) has two more methods, `save(folder)` and `load(folder)`.
"""

import hashlib
import importlib.util
import inspect
import sys
import tempfile
import time
import traceback
from collections.abc import Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import PolicyError
from pipeline.policies import Curve, Plan
from pipeline.types import Observations
from pipeline.windows import Windows

NEEDED = {"fit": ("observations", "actions", "mask", "seed"), "predict": ("observations",)}
_KEPT, _FILE = "kept", "file"


@dataclass(frozen=True)
class OwnMethod:
    """Stands where a method's class stands: `fit` and `restore` make fitted policies of the class at `address`."""

    address: str

    def check(self) -> None:
        """Import the class, so that what is wrong with it is said before any work is done."""
        load_own_class(self.address)

    def fit(self, windows: Windows, plan: Plan) -> tuple["OwnPolicy", Curve]:
        """One object a seed, each fitted on all windows. Losses are not known."""
        observations, (actions, mask) = windows.observations().values, windows.targets()
        objects, start = [], time.perf_counter()
        for position, seed in enumerate(plan.seeds):
            one = self._make(plan.settings)
            with _blaming(self.address, "fit"):
                one.fit(observations.copy(), actions.copy(), mask.copy(), seed)
            objects.append(one)
            if plan.on_step is not None:
                plan.on_step((position + 1) * plan.steps // len(plan.seeds), plan.steps, np.nan)
        shape = (windows.chunk, actions.shape[2])
        policy = OwnPolicy(self.address, dict(plan.settings), plan.seeds, shape, tuple(objects))
        policy.arrays()  # says now, not after hours of other work, what of it cannot be kept
        no_losses = np.empty((len(plan.seeds), 0), np.float32)
        return policy, Curve(np.empty(0, np.int64), no_losses, time.perf_counter() - start)

    def restore(self, arrays: Mapping[str, np.ndarray], settings: Mapping[str, Any]) -> "OwnPolicy":
        objects = []
        for seed in settings["seeds"]:
            one = self._make(settings["settings"])
            mine = {n.removeprefix(f"{seed}/"): a for n, a in arrays.items() if n.startswith(f"{seed}/")}
            with _blaming(self.address, "load"):
                _give_back(one, mine, settings["attributes"].get(str(seed), {}))
            objects.append(one)
        shape = tuple(settings["shape"])
        return OwnPolicy(self.address, settings["settings"], tuple(settings["seeds"]), shape, tuple(objects))

    def _make(self, settings: Mapping[str, Any]) -> Any:
        own = load_own_class(self.address)
        with _blaming(self.address, "__init__"):
            return own(**settings)


@dataclass(frozen=True)
class OwnPolicy:
    """Fitted objects of a user's class, one a seed; answers as every policy does. `shape` is (K, A)."""

    address: str
    made_with: dict[str, Any]
    seeds: tuple[int, ...]
    shape: tuple[int, int]
    objects: tuple[Any, ...]

    @property
    def chunk(self) -> int:
        return self.shape[0]

    @property
    def parameters(self) -> int:
        """Numbers that one object holds, as far as they are kept as arrays."""
        return int(sum(a.size for name, a in self.one_seed(0).arrays().items() if f"/{_FILE}/" not in name))

    def predict(self, observations: Observations, horizons: int = 1) -> np.ndarray:
        """[S, B, K, A] float32, raw units; `horizons` is not used."""
        return np.stack([self._ask(one, observations.values) for one in self.objects])

    def _ask(self, one: Any, values: np.ndarray) -> np.ndarray:
        with _blaming(self.address, "predict"):
            answer = np.asarray(one.predict(values.copy()), np.float32)
        expected = (len(values), *self.shape)
        if answer.shape != expected:
            raise PolicyError(
                f"{self.address}: predict returned an array of shape {answer.shape}; expected {expected}: observations, "
                "actions of the chunk, action columns."
            )
        return answer

    def one_seed(self, position: int = 0) -> "OwnPolicy":
        """The policy of one seed alone."""
        seeds, objects = self.seeds[position : position + 1], self.objects[position : position + 1]
        return OwnPolicy(self.address, self.made_with, seeds, self.shape, objects)

    def arrays(self) -> dict[str, np.ndarray]:
        """What every object keeps as arrays, or the bytes of the files that its `save` wrote."""
        found = {}
        for seed, one in zip(self.seeds, self.objects, strict=True):
            kept = _saved_files(self.address, one) if hasattr(one, "save") else _attributes(self.address, one)[0]
            found |= {f"{seed}/{name}": array for name, array in kept.items()}
        return found or {"nothing": np.zeros(1, np.uint8)}  # a file of weights holds at least one array

    def settings(self) -> dict[str, Any]:
        return {
            "settings": self.made_with,
            "seeds": list(self.seeds),
            "shape": list(self.shape),
            "attributes": {
                str(seed): _attributes(self.address, one)[1]
                for seed, one in zip(self.seeds, self.objects, strict=True)
                if not hasattr(one, "save")
            },
        }


# What is kept ---------------------------------------------------------------------------------------------------------


def _attributes(address: str, one: Any) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """An object's attributes as arrays by name, and the rest as plain values."""
    arrays, plain = {}, {}
    for name, value in vars(one).items():
        if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
            arrays[f"{_KEPT}/{name}"] = value
        elif _is_plain(value):
            plain[name] = value
        elif isinstance(value, np.generic):
            plain[name] = value.item()
        else:
            raise PolicyError(
                f"{address}: the attribute '{name}' is a {type(value).__name__}, which cannot be kept without pickling it. "
                "Keep arrays, numbers, text, and lists or dictionaries of those; or give the class save(folder) and "
                "load(folder)."
            )
    return arrays, plain


def _is_plain(value: Any) -> bool:
    """Whether JSON gives the same value back."""
    if value is None or isinstance(value, bool | int | float | str):
        return True
    if isinstance(value, list):
        return all(map(_is_plain, value))
    return isinstance(value, dict) and all(isinstance(key, str) and _is_plain(item) for key, item in value.items())


def _saved_files(address: str, one: Any) -> dict[str, np.ndarray]:
    with tempfile.TemporaryDirectory() as folder:
        with _blaming(address, "save"):
            one.save(Path(folder))
        files = [path for path in sorted(Path(folder).rglob("*")) if path.is_file()]
        return {
            f"{_FILE}/{path.relative_to(folder).as_posix()}": np.frombuffer(path.read_bytes(), np.uint8)
            for path in files
        }


def _give_back(one: Any, arrays: Mapping[str, np.ndarray], plain: Mapping[str, Any]) -> None:
    if hasattr(one, "save"):
        with tempfile.TemporaryDirectory() as folder:
            for name, content in arrays.items():
                path = Path(folder) / name.removeprefix(f"{_FILE}/")
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(content.tobytes())
            one.load(Path(folder))
        return
    for name, value in plain.items():
        setattr(one, name, value)
    for name, array in arrays.items():
        setattr(one, name.removeprefix(f"{_KEPT}/"), array)


# Finding the class ----------------------------------------------------------------------------------------------------


def source_file(address: str, key: str = "method") -> Path:
    """The file that the class at `address` is written in; `key` is where the configuration names it.

    Raises:
        PolicyError: no such file or module.
    """
    where = address.rpartition(":")[0]
    if where.endswith(".py"):
        if not Path(where).is_file():
            raise PolicyError(
                f'{key} = "{address}": there is no file {where}. Paths are relative to the configuration\'s folder.'
            )
        return Path(where)
    try:
        found = importlib.util.find_spec(where)
    except (ImportError, ValueError):
        found = None
    if found is None or not found.origin or not found.origin.endswith(".py"):
        raise PolicyError(
            f"{key} = \"{address}\": no module '{where}' can be imported here. Install its package into this environment, "
            f'or name a file: {key} = "my_file.py:{address.rpartition(":")[2]}".'
        )
    return Path(found.origin)


def source_hash(address: str, key: str = "method") -> str:
    """sha256 of the bytes of that file: what makes results of the class stale. What it imports is not looked at."""
    return hashlib.sha256(source_file(address, key).read_bytes()).hexdigest()


def load_own_class(address: str) -> type:
    """Import the class at `path/to/file.py:Class` or `package.module:Class`.

    Raises:
        PolicyError: it cannot be imported, or lacks one of the two methods.
    """
    own = _import(address, source_hash(address))
    for name, parameters in NEEDED.items():
        method = getattr(own, name, None)
        if not callable(method):
            raise PolicyError(f"{address} has no method '{name}({', '.join(parameters)})'.")
        taken = len(inspect.signature(method).parameters) - 1
        if taken != len(parameters):
            raise PolicyError(
                f"{address}: '{name}' takes {taken} arguments beside self; it is called as {name}({', '.join(parameters)})."
            )
    if hasattr(own, "save") != hasattr(own, "load"):
        raise PolicyError(f"{address} has only one of save(folder) and load(folder); it needs both, or none.")
    return own


@cache
def _import(address: str, content: str) -> type:
    where, _, name = address.rpartition(":")
    with _blaming(address, "importing it"):
        if where.endswith(".py"):
            module_name = f"demobench_own_{content[:16]}"
            found = importlib.util.spec_from_file_location(module_name, where)
            module = importlib.util.module_from_spec(found)
            sys.modules[module_name] = module  # dataclasses look their own module up
            found.loader.exec_module(module)
        else:
            module = importlib.import_module(where)
    own = getattr(module, name, None)
    if not isinstance(own, type):
        raise PolicyError(f"method = \"{address}\": {where} has no class '{name}'.")
    return own


@contextmanager
def _blaming(address: str, doing: str):
    """What goes wrong in a user's code becomes one message that says in which line of it."""
    try:
        yield
    except PolicyError:
        raise
    except Exception as error:
        file = str(source_file(address))
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
        where = f" ({Path(file).name}, line {lines[-1]})" if lines else ""
        raise PolicyError(f"{address}: {doing} raised {type(error).__name__}: {error}{where}") from error

"""How training episodes and windows are varied: told in hindsight, turned by a symmetry of the task, seen with noise.

What belongs here: changes to what a policy is trained on, observations and actions together. What does not: its own view of a
window (`transform`), what any one task's symmetries are (`pusht_views`, `so101_views`).

None of it touches what a policy is scored on.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib import import_module

import numpy as np

from pipeline.errors import ConfigError, PolicyError, did_you_mean
from pipeline.methods import HINDSIGHT, SYMMETRIES
from pipeline.policies.transform import Seen, split_columns
from pipeline.types import ACTION
from pipeline.windows import Windows

# Episodes ---------------------------------------------------------------------------------------------------------------


def in_hindsight(windows: Windows, name: str | None) -> Windows:
    """The windows over episodes that are told as if where they ended had been what they aimed at.

    Hindsight relabelling (Andrychowicz et al. 2017) of demonstrations: where the goal is fixed and the task does not care where
    on the table it takes place, the whole episode is moved until it ends at the goal. Nothing for `name` None.

    Raises:
        ConfigError: there is nothing of that name.
        PolicyError: it is of other data than these.
    """
    if name is None:
        return windows
    if name not in HINDSIGHT:
        raise ConfigError(f"augment.hindsight '{name}' does not exist. {did_you_mean(name, HINDSIGHT)}")
    module, function = HINDSIGHT[name]
    keys = [*windows.observation_set.features, ACTION]
    columns = {key: np.array(windows.demos.columns[key]) for key in keys}
    for episode in windows.episodes:
        frames = windows.demos.episode(episode)
        recorded = Seen({key: columns[key][frames] for key in keys}, f"Episodes in hindsight ('{name}')")
        try:
            told = getattr(import_module(module), function)(recorded)
            for key in keys:
                columns[key][frames] = told[key]
        except (KeyError, IndexError, ValueError) as error:
            raise PolicyError(f"augment.hindsight '{name}' does not fit this data: {error}") from error
    return replace(windows, demos=replace(windows.demos, columns=dict(windows.demos.columns) | columns))


Noise = float | Mapping[str, float]
"""A share of each column's deviation, or in raw units by unit or column."""


# Windows ----------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Augment:
    """How training windows are varied: noise in raw units, and a symmetry applied or not, by chance.

    A noisy window keeps its recorded actions: a policy that is a little off, or sees a little wrong, is to do what was right.

    noise   [O] deviation of what is added to every frame anew          offset  [O] of what is added to all frames of a window
    """

    widths: Mapping[str, int]
    noise: np.ndarray
    offset: np.ndarray
    symmetry: str | None

    def __call__(
        self, values: np.ndarray, actions: np.ndarray, generator: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """[B, T, O], [B, K, A] → the same, varied."""
        if self.symmetry is not None:
            turned = generator.random(len(values)) < 0.5
            amount = generator.random(len(values))[turned]
            values, actions = values.copy(), actions.copy()
            values[turned], actions[turned] = apply_symmetry(
                self.symmetry, self.widths, values[turned], actions[turned], amount
            )
        for deviation, frames in ((self.noise, values.shape[1]), (self.offset, 1)):
            if deviation.any():
                drawn = generator.standard_normal((len(values), frames, values.shape[2]), np.float32)
                values = values + drawn * deviation.astype(np.float32)
        return values, actions


def fit_augment(
    windows: Windows, *, noise: Noise | None = None, offset: Noise | None = None, symmetry: str | None = None
) -> Augment | None:
    """None where nothing is varied.

    Raises:
        PolicyError: noise is named for a unit or column that the set lacks, or the symmetry is of other data.
    """
    if not noise and not offset and symmetry is None:
        return None
    widths = {key: windows.demos.columns[key].shape[1] for key in windows.observation_set.features}
    if symmetry is not None:
        few = slice(0, min(8, len(windows)))
        values, actions = windows.observations(few).values, windows.targets(few)[0]
        apply_symmetry(symmetry, widths, values, actions, np.zeros(len(values)))
    return Augment(widths, _deviations(windows, "noise", noise), _deviations(windows, "offset", offset), symmetry)


def _deviations(windows: Windows, key: str, given: Noise | None) -> np.ndarray:
    """[O] in raw units."""
    features = [windows.demos.features[key] for key in windows.observation_set.features]
    names, units = ([x for f in features for x in getattr(f, part)] for part in ("names", "units"))
    if not isinstance(given, Mapping):
        return (given or 0.0) * windows.normalizer.observations.scale[: len(names)]
    for word in given:
        if word not in (*names, *units):
            known = did_you_mean(word, {*names, *(unit for unit in units if unit)})
            raise PolicyError(
                f"augment.{key} is given for '{word}', which is neither a column nor a unit of the observation set "
                f"'{windows.observation_set.name}'. {known}"
            )
    return np.array([given.get(name, given.get(unit, 0.0)) for name, unit in zip(names, units, strict=True)])


def apply_symmetry(
    name: str, widths: Mapping[str, int], values: np.ndarray, actions: np.ndarray, amount: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Windows turned by a symmetry of their task, observations and actions together.

    `amount` [B] in 0 … 1 says how far, where a symmetry is more than a mirror.

    Raises:
        ConfigError: there is no symmetry of that name.
        PolicyError: it is of other data than these.
    """
    if name not in SYMMETRIES:
        raise ConfigError(f"augment.symmetry '{name}' does not exist. {did_you_mean(name, SYMMETRIES)}")
    module, function = SYMMETRIES[name]
    seen = Seen(split_columns(widths, values), f"What the symmetry '{name}' turns")
    try:
        turned, answered = getattr(import_module(module), function)(seen, actions, amount)
    except (IndexError, ValueError) as error:
        raise PolicyError(f"The symmetry '{name}' does not fit this data: {error}") from error
    missing = [key for key in widths if key not in turned]
    if missing:
        raise PolicyError(
            f"The symmetry '{name}' does not say what becomes of '{missing[0]}'. Leave it out of the set."
        )
    parts = [turned[key] for key in widths]
    if answered.shape != actions.shape or any(
        part.shape[-1] != widths[key] for key, part in zip(widths, parts, strict=True)
    ):
        raise PolicyError(f"The symmetry '{name}' does not fit this data: it is of other columns than these.")
    return np.concatenate(parts, axis=-1).astype(values.dtype), answered

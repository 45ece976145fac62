"""Demonstrations whose every number is known, in memory. What does not belong here: data sets on disk (`makers`)."""

from dataclasses import replace

import numpy as np

from pipeline.types import ACTION, STATE, Demonstrations, Feature, ObservationSet, Semantics

STATE_ONLY = ObservationSet("state", (STATE,))
POSE = "observation.environment_state"


def demonstrations(columns: dict[str, np.ndarray], lengths, *, fps: float = 10.0, units=None) -> Demonstrations:
    """Demonstrations from arrays [N, D] by feature; `units` gives a unit for every column of a feature."""
    units = units or {}
    arrays = {key: np.asarray(values, np.float32) for key, values in columns.items()}
    features = {
        key: Feature(key, tuple(f"{key[0]}{i}" for i in range(v.shape[1])), units.get(key, (None,) * v.shape[1]))
        for key, v in arrays.items()
    }
    lengths = np.asarray(lengths)
    return Demonstrations(
        name="hand_made", source="memory", revision=None, fps=fps, robot_type=None, columns=arrays, features=features,
        episode_starts=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        episode_ids=np.arange(len(lengths)) + 10, timestamps=np.concatenate([np.arange(n) / fps for n in lengths]),
        tasks=("",) * len(lengths), cameras=(), warnings=(), content_hash="0" * 64,
    )  # fmt: skip


def random_walks(lengths=(9, 7, 12, 8, 10), *, columns: int = 2, seed: int = 0, **more) -> Demonstrations:
    """States that wander, actions that are near the next state."""
    generator = np.random.default_rng(seed)
    state = np.concatenate([generator.normal(size=(n, columns)).cumsum(axis=0) for n in lengths]) + 3.0
    action = state + 0.3 * generator.normal(size=state.shape)
    return demonstrations({STATE: state, ACTION: action}, lengths, **more)


def semantics(demos: Demonstrations, kinds=None, state_column=None, circular=None) -> Semantics:
    """Positions of the state columns in order, no angles, unless told otherwise."""
    columns = demos.columns[ACTION].shape[1]
    states = demos.columns[STATE].shape[1] if STATE in demos.columns else 0
    flat = {key: (False,) * len(feature.names) for key, feature in demos.features.items()}
    return Semantics(
        kinds=kinds or ("position",) * columns,
        state_column=state_column or tuple(i if i < states else None for i in range(columns)),
        circular=flat | (circular or {}),
        tracking_lag=(None,) * columns,
        warnings=(),
    )


def changed(demos: Demonstrations, episodes, seed: int = 1) -> Demonstrations:
    """The same demonstrations with every value of some episodes replaced."""
    generator = np.random.default_rng(seed)
    columns = {key: values.copy() for key, values in demos.columns.items()}
    for values in columns.values():
        for episode in episodes:
            part = values[demos.episode(episode)]
            part[:] = 50 + 20 * generator.normal(size=part.shape)
    return replace(demos, columns=columns)

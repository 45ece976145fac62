"""Small demonstrations made by hand, and what a benchmark says about them, for everything that writes files."""

import numpy as np

from pipeline.types import ACTION, STATE, Demonstrations, Feature, Predictions, Semantics

NASTY = "<script>window.pwned = true</script>"


def make_demos(
    columns: int = 2,
    lengths: tuple[int, ...] = (30, 24, 36),
    fps: float = 10.0,
    units: str | None = "px",
    seed: int = 0,
) -> Demonstrations:
    """Smooth curves: the action is where the state will be two frames later."""
    rng = np.random.default_rng(seed)
    starts = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    curves = []
    for length in lengths:
        phase, speed = rng.uniform(0, 6, columns), rng.uniform(0.02, 0.06, columns)
        curves.append(256 + 180 * np.sin(phase + np.arange(length + 2)[:, None] * speed))
    names = tuple("xyzuvw"[i] if columns <= 6 else f"joint_{i}" for i in range(columns))
    return Demonstrations(
        name="small",
        source="memory",
        revision="0123456789abcdef0123456789abcdef01234567",
        fps=fps,
        robot_type=None,
        columns={
            STATE: np.concatenate([c[:-2] for c in curves]).astype(np.float32),
            ACTION: np.concatenate([c[2:] for c in curves]).astype(np.float32),
        },
        features={key: Feature(key, names, (units,) * columns) for key in (STATE, ACTION)},
        episode_starts=starts,
        episode_ids=np.arange(len(lengths)) + 7,
        timestamps=np.concatenate([np.arange(n) / fps for n in lengths]),
        tasks=tuple(f"push {NASTY}" if i == 0 else "" for i in range(len(lengths))),
        cameras=(),
        warnings=(),
        content_hash="c0ffee" + "0" * 58,
    )


def make_semantics(demos: Demonstrations, kind: str = "position") -> Semantics:
    width = demos.columns[ACTION].shape[1]
    return Semantics(
        kinds=(kind,) * width,
        state_column=tuple(range(width)),
        circular={key: (False,) * len(f.names) for key, f in demos.features.items()},
        tracking_lag=tuple(float(i + 1) for i in range(width)),
        warnings=(f"dead column {NASTY}",),
    )


def make_predictions(
    demos: Demonstrations, episodes: list[int], policy: str = "mlp_k04", chunk: int = 4, observations: str = "state",
    history: int = 3, off: float = 5.0,
) -> Predictions:  # fmt: skip
    """Recorded actions plus a constant: predicted from every frame with enough history, two seeds."""
    frames = [np.arange(demos.episode(e).start + history - 1, demos.episode(e).stop) for e in episodes]
    anchors = np.concatenate(frames).astype(np.int64)
    last = demos.episode_starts[1:][demos.episode_of_frame[anchors]] - 1
    targets = np.minimum(anchors[:, None] + np.arange(chunk), last[:, None])
    actions = demos.columns[ACTION][targets] + off
    return Predictions(
        policy,
        observations,
        (0, 1),
        anchors,
        np.zeros(len(anchors), int),
        np.stack([actions, actions + 1]).astype("f4"),
    )

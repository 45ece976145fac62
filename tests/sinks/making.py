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


def make_row(policy: str, method: str, demos: Demonstrations, *, error: float = 5.0, **more) -> dict:
    """A row of `run --json`; its numbers are made up."""
    horizons = list(error + 2.0 * np.arange(more.get("chunk") or 11))
    names = demos.features[ACTION].names
    return {
        "policy": policy, "method": method, "chunk": None, "observations": "state", "seeds": 2, "windows_train": 30,
        "windows_test": 56, "first_step_mae": error, "first_step_rmse": 1.25 * error, "first_step_l2": 1.4 * error,
        "at_one_second_mae": None, "at_one_second_rmse": None, "whole_chunk_mae": None, "whole_chunk_rmse": None,
        "error_by_horizon": horizons, "rmse_by_horizon": horizons,
        "hold_still_by_horizon": list(20 + 3.0 * np.arange(11)),
        "error_by_joint": {name: error + i for i, name in enumerate(names)}, "vs_hold_still": 20 / error,
        "scaled": error / 100, "scaled_by_joint": dict.fromkeys(names, error / 100),
        "ensembled_first_step_mae": None, "interval": {"first_step_mae": [0.9 * error, 1.1 * error]},
        "interval_method": "bootstrap-t", "by_task": {}, "params": 0, "train_s": 0.0, "latency_ms": 0.12, "verdict": make_verdict(),
        "above_floor": [], "rollouts": None,
    } | more  # fmt: skip


def make_verdict(**words: str) -> dict:
    keys = ("vs_hold_still", "vs_champion", "vs_hold_still_at_one_second", "vs_champion_at_one_second")
    return dict.fromkeys(keys) | words


def make_comparison(a: str, b: str, word: str = "better", **more) -> dict:
    """A comparison of `run --json`; its numbers are made up."""
    tested = word != "not comparable"
    numbers = {"difference": -15.5, "interval": [-17.0, -14.0], "p": 0.001, "p_holm": 0.002, "smallest_seen": 1.5}
    numbers = numbers if tested else dict.fromkeys(numbers)
    named = {"a": a, "b": b, "metric": "first_step_mae", "word": word}
    return named | numbers | {"needs_episodes": None, "words": "error 78 % lower"} | more


def make_closed_loop(*comparisons: dict, chosen: str = "best", family: int = 6) -> dict:
    """`closed_loop` of `run --json`: against the row that the comparisons are with."""
    return {"reference": comparisons[0]["b"], "chosen": chosen, "family": family, "comparisons": list(comparisons)}


def make_driven(a: str, b: str, success: str, score: str, **more) -> list[dict]:
    """Two comparisons in closed loop; their numbers are made up."""
    words = {"better": "0.3 higher", "worse": "0.3 lower", "cannot tell": "about 120 start states would show it"}
    return [
        make_comparison(a, b, word, metric=metric, words=words[word], difference=-0.3, interval=[-0.45, -0.15], **more)
        for metric, word in (("success", success), ("score", score))
    ]


def make_floor(loss: str = "rmse", **more) -> dict:
    """A floor of `run --json`: one number in squared error, a span in absolute error."""
    numbers = {"value": 4.0, "upper": None, "interval": [3.6, 4.4]}
    if loss != "rmse":
        numbers = {"value": 2.5, "upper": 5.0, "interval": [2.25, 5.5]}
    said = {"observations": "state", "history": 3, "horizon": 0, "loss": loss, "below": None, "refused": None}
    return said | {"estimator": "gamma" if loss == "rmse" else "pair_distance", "nearest": 0.1} | numbers | more


def make_refusal(loss: str = "rmse", **more) -> dict:
    """A floor that could not be given."""
    nothing = {"value": None, "upper": None, "interval": None, "below": 30.0, "refused": "the states differ: too much"}
    return make_floor(loss, **(nothing | more))


def make_bracket(loss: str = "rmse", **more) -> dict:
    named = {"observations": "state", "horizon": 0, "loss": loss, "upper_policy": "mlp_k01/state"}
    found = {"lower": 4.0, "upper": 5.625, "gap": 1.625, "interval": [1.25, 2.0], "words": "not shown"}
    return named | (found if loss == "rmse" else found | {"lower": 2.5, "upper": 4.5}) | more


def make_sensor(**more) -> dict:
    """What seeing `pose` beside `state` is worth."""
    named = {"smaller": "state", "larger": "pose", "horizon": 0, "loss": "rmse"}
    found = {"value": 1.5, "interval": [1.0, 2.0], "at_least": None, "words": "1.5 [1, 2], 38 % of the floor"}
    return named | found | more


def make_gap(**more) -> dict:
    """How far a row is above its floor."""
    found = {"error": 5.625, "gap": 1.625, "interval": [1.25, 2.0], "words": "not shown"}
    return {"horizon": 0, "loss": "rmse", "floor": 4.0} | found | more


def make_table(demos: Demonstrations, semantics: Semantics) -> dict:
    """One object of `run --json`: two chunk sizes, better than hold-still and above a floor."""
    action = demos.features[ACTION]
    rolled = {
        "n": 50, "seeds": 1, "episodes": 50, "success": 0.82, "success_interval": [0.69, 0.91], "score": 0.934,
    }  # fmt: skip
    better = {"verdict": make_verdict(vs_hold_still="better")}
    trained = {"params": 275462, "train_s": 12.3}
    return {
        "dataset": {
            "name": demos.name, "revision": demos.revision, "content_hash": demos.content_hash,
            "episodes": demos.episodes, "frames": demos.frames, "fps": demos.fps, "action_names": list(action.names),
            "action_units": list(action.units), "action_kinds": list(semantics.kinds),
            "tracking_lag": list(semantics.tracking_lag),
        },
        "protocol": "strict",
        "budget": {"name": "quick", "steps": 600, "seeds": 2},
        "split": {"hash": "ab12" * 16, "folds": [{"train": [0], "test": [1, 2]}]},
        "floor": {
            "radius": {
                "probes": 12, "median_neighbours": 5.0, "mean": 6.25, "p90": 11.5, "observations": "state",
                "radius": 2.0, "scaled": False, "unit": "px",
            },
            "estimates": [make_floor("rmse"), make_floor("mae")],
        },
        "brackets": [make_bracket("rmse"), make_bracket("mae")],
        "sensors": [],
        "comparisons": [make_comparison(f"{name}/state", "hold_still/state") for name in ("mlp_k01", "mlp_k04")],
        "policies": [
            make_row("mlp_k01", "mlp", demos, error=4.5, chunk=1, above_floor=[make_gap()], **better, **trained),
            make_row("mlp_k04", "mlp", demos, error=5.5, chunk=4, rollouts=rolled, **better, **trained),
            make_row("hold_still", "hold_still", demos, error=20.0),
        ],
        "artifacts": {"report": None, "mcap": "out/held out.mcap", "rerun": "out/held_out.rrd", "mlflow": None},
    }  # fmt: skip

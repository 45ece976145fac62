"""Recordings of ten episodes with eight policies: how large, how long, and against logging every value when it comes."""

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.lerobot_format.quality import resolve_semantics
from pipeline.lerobot_format.read import load_source
from pipeline.simulate.so101_arm import NAMES, UNITS
from pipeline.sinks.to_mcap import write_mcap
from pipeline.sinks.to_rerun import write_rerun
from pipeline.types import ACTION, STATE, ColumnChoice, Demonstrations, Predictions, Semantics
from speed.timing import compare, seconds

EPISODES, POLICIES, CHUNK = 10, 8, 16


def made_up(demos: Demonstrations) -> list[Predictions]:
    """What was recorded, with noise: what it costs to show does not depend on how good it is."""
    generator, last = np.random.default_rng(0), demos.episode_starts[1:] - 1
    anchors = np.arange(demos.episode_starts[EPISODES])
    ahead = np.minimum(anchors[:, None] + np.arange(CHUNK), last[demos.episode_of_frame[anchors]][:, None])
    recorded, scale = demos.columns[ACTION][ahead], 0.05 * demos.columns[ACTION].std(axis=0)
    noise = generator.normal(size=(POLICIES, *recorded.shape))
    actions = (recorded + scale * noise).astype(np.float32)
    fold = np.zeros(len(anchors), int)
    return [Predictions(f"mlp_{p}", "state", (0,), anchors, fold, actions[p : p + 1]) for p in range(POLICIES)]


def logged(path: Path, demos: Demonstrations, predictions: Sequence[Predictions]) -> None:
    """The obvious way: at every frame log the joints, the errors, where it is and what each policy says. PushT's columns."""
    import rerun as rr

    recording = rr.RecordingStream("plain")
    recording.save(path)
    for episode in range(EPISODES):
        root, frames = f"episode_{episode}", demos.episode(episode)
        for frame in range(frames.start, frames.stop):
            recording.set_time("time", duration=float(demos.timestamps[frame]))
            action, state = demos.columns[ACTION][frame], demos.columns[STATE][frame]
            said = [one.actions[0, frame] for one in predictions]
            for column in range(len(action)):
                values = [state[column], action[column], *(chunk[0, column] for chunk in said)]
                recording.log(f"{root}/joints/{column}", rr.Scalars(values))
            recording.log(f"{root}/error", rr.Scalars([np.abs(chunk[0] - action).mean() for chunk in said]))
            recording.log(f"{root}/path/state", rr.Points2D([state]))
            for one, chunk in zip(predictions, said, strict=True):
                recording.log(f"{root}/path/{one.policy}", rr.LineStrips2D([np.concatenate([state[None], chunk])]))
    recording.flush()
    recording.disconnect()


def measure(demos: Demonstrations, semantics: Semantics) -> list[str]:
    """`demos` are those of PushT, for the ratio; the SO-101 has more joints, three times the frames a second, and its arm."""
    units = ColumnChoice(units=dict(zip(NAMES, UNITS, strict=True)))
    so101 = load_source("embedded:so101_sim", name="so101_sim", config_dir=Path.cwd(), choice=units)
    with tempfile.TemporaryDirectory() as folder:
        rrd, mcap, plain = (Path(folder) / name for name in ("a.rrd", "a.mcap", "plain.rrd"))

        def rerun(shown: Demonstrations, meaning: Semantics, predictions: Sequence[Predictions]) -> None:
            write_rerun(rrd, shown, meaning, predictions, range(EPISODES), name=shown.name)

        predictions = made_up(demos)
        ratio = compare(
            lambda: rerun(demos, semantics, predictions), lambda: logged(plain, demos, predictions), pairs=3
        )
        lines = [
            f"Rerun, {EPISODES} episodes, {POLICIES} policies, {demos.name}: {ratio.median:.1f} times as fast as a log call a "
            f"value ({ratio.low:.1f} to {ratio.high:.1f}); {ratio.ours_s:.2f} s, {_mb(rrd):.1f} MB"
        ]
        meaning, predictions = resolve_semantics(so101), made_up(so101)
        rerun_s = seconds(lambda: rerun(so101, meaning, predictions))
        mcap_s = seconds(lambda: write_mcap(mcap, so101, meaning, predictions, range(EPISODES), metadata={}))
        lines.append(
            f"{EPISODES} episodes, {POLICIES} policies, {so101.name} with its arm, {so101.episode_starts[EPISODES]:,} frames: "
            f"Rerun {rerun_s:.1f} s, {_mb(rrd):.1f} MB (wanted: 10 s, 20 MB); MCAP {mcap_s:.1f} s, {_mb(mcap):.1f} MB"
        )
    return lines


def _mb(path: Path) -> float:
    return path.stat().st_size / 1e6

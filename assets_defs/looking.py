"""Recordings: held-out episodes beside what every policy predicted, for MCAP readers and for Rerun."""

from collections.abc import Sequence

import dagster as dg

from assets_defs.data import PARTITIONS, demonstrations, episode_split
from assets_defs.plan import Unit
from assets_defs.resources import Bench, Budget, Outcome, Workbench, check_spec, code_version, result

MCAP = dg.AssetKey(["mcap_log"])
RERUN = dg.AssetKey(["rerun_recording"])
EPISODES = 10
"""How many held-out episodes a recording shows."""


def looking_assets(deps: Sequence[dg.AssetKey]) -> list[dg.AssetsDefinition]:
    """Both recordings; `deps` are the predictions of every policy."""
    return [_mcap_log(deps), _rerun_recording(deps)]


def _held_out(bench: Bench) -> list[int]:
    return bench.split.held_out[:EPISODES]


def _predictions(bench: Bench) -> list:
    from pipeline.predict import load_predictions

    return [load_predictions(bench.plan.folder(u)) for u in bench.plan.fresh_predictions()]


def _mcap_log(deps: Sequence[dg.AssetKey]) -> dg.AssetsDefinition:
    @dg.asset(
        key=MCAP,
        partitions_def=PARTITIONS,
        group_name="looking",
        kinds={"mcap", "ros2"},
        deps=[demonstrations, episode_split, *deps],
        code_version=code_version("mcap_log"),
        check_specs=[check_spec(MCAP, "readable", "The file's own reader finds every message that was written.")],
    )
    def mcap_log(
        context: dg.AssetExecutionContext, workbench: dg.ResourceParam[Workbench], budget: Budget
    ) -> dg.MaterializeResult:
        """Held-out episodes as ROS 2 `sensor_msgs/JointState`: the archive that any MCAP reader opens.

        `/joint_states` is what the robot did, `/joint_commands` what the person commanded, `/policy/<policy>/<observations>`
        the first action each policy would have taken. Times are the demonstration's own clock.
        """
        bench = workbench.open(context, budget)
        unit = Unit("mcap_log")
        made = bench.make(unit, lambda draft: _write_mcap(bench, draft))
        path = bench.plan.folder(unit) / "held_out.mcap"
        metadata = {
            "file": dg.MetadataValue.path(str(path)),
            "open_with": f"demobench view {bench.plan.key} {made.summary['episodes'][0]}",
            "messages": made.summary["messages"],
        }
        return result(bench, MCAP, {"": made}, metadata, ["readable"])

    return mcap_log


def _write_mcap(bench: Bench, draft) -> Outcome:
    from pipeline.sinks.to_mcap import count_messages, expected_messages, write_mcap

    path = draft / "held_out.mcap"
    episodes = _held_out(bench)
    predictions = _predictions(bench)
    write_mcap(
        path,
        bench.demonstrations,
        bench.semantics,
        predictions,
        episodes,
        metadata={
            "data_set": bench.experiment.name,
            "content_hash": bench.demonstrations.content_hash,
            "split": bench.split.hash,
            "protocol": bench.experiment.protocol,
        },
    )
    found, written = count_messages(path), expected_messages(bench.demonstrations, predictions, episodes)
    return Outcome(
        {"messages": found, "episodes": _recorded_ids(bench, episodes)},
        {"readable": (found == written, f"{found:,} of {written:,} messages")},
    )


def _recorded_ids(bench: Bench, episodes: list[int]) -> list[int]:
    return [int(bench.demonstrations.episode_ids[e]) for e in episodes]


def _rerun_recording(deps: Sequence[dg.AssetKey]) -> dg.AssetsDefinition:
    @dg.asset(
        key=RERUN,
        partitions_def=PARTITIONS,
        group_name="looking",
        kinds={"rerun"},
        deps=[demonstrations, episode_split, *deps],
        code_version=code_version("rerun_recording"),
        check_specs=[check_spec(RERUN, "holds_every_episode", "Every episode asked for is in the recording.")],
    )
    def rerun_recording(
        context: dg.AssetExecutionContext, workbench: dg.ResourceParam[Workbench], budget: Budget
    ) -> dg.MaterializeResult:
        """Held-out episodes in Rerun: joints recorded against predicted, and the error over time."""
        bench = workbench.open(context, budget)
        unit = Unit("rerun_recording")
        made = bench.make(unit, lambda draft: _write_rerun(bench, draft))
        path = bench.plan.folder(unit) / "held_out.rrd"
        metadata = {
            "file": dg.MetadataValue.path(str(path)),
            "open_with": f"rerun --bind 127.0.0.1 {path}",
            "episodes": dg.MetadataValue.json(made.summary["episodes"]),
            "size_mb": made.summary["size_mb"],
        }
        return result(bench, RERUN, {"": made}, metadata, ["holds_every_episode"])

    return rerun_recording


def _write_rerun(bench: Bench, draft) -> Outcome:
    from pipeline.sinks.to_rerun import episodes_in, write_rerun

    path = draft / "held_out.rrd"
    episodes = _held_out(bench)
    write_rerun(path, bench.demonstrations, bench.semantics, _predictions(bench), episodes, name=bench.plan.key)
    ids = _recorded_ids(bench, episodes)
    found = episodes_in(path)
    return Outcome(
        {"episodes": ids, "size_mb": round(path.stat().st_size / 1e6, 2)},
        {"holds_every_episode": (found == set(ids), f"{len(found)} of {len(ids)} episodes")},
    )

"""What is looked at: held-out episodes with what every policy predicted, and roll-outs, for MCAP readers and for Rerun; a video."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import dagster as dg

from assets_defs.data import PARTITIONS, demonstrations, episode_split
from assets_defs.floor import ESTIMATES
from assets_defs.floor import KEY as FLOOR_KEY
from assets_defs.links import file_link
from assets_defs.plan import Plan, Unit
from assets_defs.resources import Bench, Budget, Outcome, Workbench, check_spec, code_version, result
from assets_defs.show import table

if TYPE_CHECKING:
    from pipeline.sinks.rerun_rollouts import Driven
    from pipeline.sinks.rollout_video import Video
    from pipeline.types import Rollouts

MCAP = dg.AssetKey(["mcap_log"])
RERUN = dg.AssetKey(["rerun_recording"])
VIDEO = dg.AssetKey(["rollout_video"])
EPISODES = 10
"""How many held-out episodes a recording shows."""
START_STATES = 4
"""How many start states a recording shows of every policy that was rolled out."""
MOST_BYTES = 20_000_000
"""How large a Rerun recording may be with cameras in it."""


def looking_assets(deps: Sequence[dg.AssetKey], rollouts: Sequence[dg.AssetKey]) -> list[dg.AssetsDefinition]:
    """Both recordings and the videos; `deps` are the predictions of every policy, `rollouts` its roll-outs."""
    return [_rollout_video(rollouts), _mcap_log([*deps, *rollouts]), _rerun_recording([*deps, *rollouts, FLOOR_KEY])]


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
        the first action each policy would have taken, `/camera/<name>` the picture of each frame, `/rollout/…` what policies did
        in closed loop from the first start states. Times are the demonstration's own clock. Attached are the settings, the split
        and the data's hash. Of a file that was cut off, `demobench view FILE.mcap` recovers what is there, and says how far.
        """
        bench = workbench.open(context, budget)
        unit = Unit("mcap_log")
        made = bench.make(unit, lambda draft: _write_mcap(bench, draft))
        path = bench.plan.folder(unit) / "held_out.mcap"
        metadata = {
            "file": dg.MetadataValue.path(str(path)),
            "download": dg.MetadataValue.url(file_link(bench, unit, path.name)),
            "open_with": f"demobench view {bench.plan.key} {made.summary['episodes'][0]}",
            "messages": made.summary["messages"],
            "size_mb": made.summary["size_mb"],
            "left out": table(["why"], [(why,) for why in made.summary["left_out"]]),
        }
        return result(bench, MCAP, {"": made}, metadata, ["readable"])

    return mcap_log


def _write_mcap(bench: Bench, draft) -> Outcome:
    from pipeline.sinks.to_mcap import count_messages, write_mcap

    path = draft / "held_out.mcap"
    episodes = _held_out(bench)
    driven, not_driven = _driven(bench)
    written = write_mcap(
        path,
        bench.demonstrations,
        bench.semantics,
        _predictions(bench),
        episodes,
        metadata={
            "data_set": bench.experiment.name,
            "content_hash": bench.demonstrations.content_hash,
            "split": bench.split.hash,
            "protocol": bench.experiment.protocol,
        },
        attachments={
            "benchmark.json": bench.experiment.model_dump(mode="json"),
            "split.json": asdict(bench.split),
            "data.json": _data(bench),
        },
        driven=driven,
    )
    found = count_messages(path)
    return Outcome(
        {
            "messages": found,
            "episodes": _recorded_ids(bench, episodes),
            "size_mb": round(path.stat().st_size / 1e6, 2),
            "left_out": [*written.left_out, *not_driven],
        },
        {"readable": (found == written.messages, f"{found:,} of {written.messages:,} messages")},
    )


def _data(bench: Bench) -> dict[str, Any]:
    """What the demonstrations are, for a file that leaves the store."""
    demos = bench.demonstrations
    return {
        "name": demos.name,
        "source": bench.experiment.dataset.source,
        "revision": demos.revision,
        "content_hash": demos.content_hash,
        "excluded": list(demos.excluded),
    }


def _recorded_ids(bench: Bench, episodes: list[int]) -> list[int]:
    return [int(bench.demonstrations.episode_ids[e]) for e in episodes]


def _rollout_video(deps: Sequence[dg.AssetKey]) -> dg.AssetsDefinition:
    @dg.asset(
        key=VIDEO,
        partitions_def=PARTITIONS,
        group_name="looking",
        kinds={"h264"},
        deps=[demonstrations, *deps],
        code_version=code_version("rollout_video"),
        check_specs=[check_spec(VIDEO, "whole", "Every frame that was written is in the file.")],
    )
    def rollout_video(
        context: dg.AssetExecutionContext, workbench: dg.ResourceParam[Workbench], budget: Budget
    ) -> dg.MaterializeResult:
        """The policy that does best in closed loop, from the first few start states side by side: H.264, one an observation set.

        There is none where the data set has no simulator, or nobody said how what it shows is drawn.
        """
        bench = workbench.open(context, budget)
        unit = Unit("rollout_video")
        made = bench.make(unit, lambda draft: _write_videos(bench, draft))
        rows = [
            (v["observations"], v["policy"], v["succeeded"], len(v["start_states"]), v["kb"])
            for v in made.summary["videos"]
        ]
        rows += [(observations, why, None, None, None) for observations, why in made.summary["left_out"].items()]
        header = ["observations", "policy", "succeeded", "start states", "kB"]
        files = {v["observations"]: str(bench.plan.folder(unit) / v["file"]) for v in made.summary["videos"]}
        metadata = {
            "videos": table(header, rows),
            **{f"file_{k}": dg.MetadataValue.path(f) for k, f in files.items()},
            **{f"watch_{k}": dg.MetadataValue.url(file_link(bench, unit, Path(f).name)) for k, f in files.items()},
        }
        return result(bench, VIDEO, {"": made}, metadata, ["whole"])

    return rollout_video


def _write_videos(bench: Bench, draft: Path) -> Outcome:
    from pipeline.errors import NotApplicableError, StoreError
    from pipeline.simulate.scene_files import load_scenes
    from pipeline.sinks.rollout_video import count_frames, write_video
    from pipeline.sinks.to_mlflow import Message

    videos, told, left_out, found = [], [], {}, 0
    for place, (unit, rollouts) in enumerate(_best_driven(bench)):
        bench.progress(f"video {unit.entry}", place, place + 1, "")
        path = draft / f"{unit.entry}.mp4"
        try:
            scenes = load_scenes(bench.plan.folder(unit) / f"seed_{rollouts.seed}")
            video = scenes and write_video(path, path.with_suffix(".png"), rollouts, scenes)
        except (NotApplicableError, StoreError) as why:
            # Numbers do not depend on pictures: the page says why there is none.
            left_out[unit.entry] = str(why)
            continue
        if video:
            found += count_frames(path)
            size = {"file": path.name, "kb": round(path.stat().st_size / 1e3)}
            videos.append(video.summary() | size)
            variant = next(v for v in bench.plan.variants if v.name == unit.policy)
            told.append(Message(bench.run_card(variant, unit.entry), files=[path.name]))
    written = sum(video["frames"] for video in videos)
    return Outcome(
        {"videos": videos, "left_out": left_out},
        {"whole": (found == written, f"{found:,} of {written:,} frames in {len(videos)} videos")},
        told,
    )


def _best_driven(bench: Bench) -> Iterator[tuple[Unit, "Rollouts"]]:
    """For each observation set the trained policy that does best in closed loop over all its seeds, and the first of them."""
    from pipeline.simulate.trial import load_rollouts

    trained = {v.name for v in bench.plan.variants if v.is_trained}
    units = [
        u for u in bench.plan.fresh_policy_units("rollouts") if bench.summary(u)["rollouts"] and u.policy in trained
    ]
    for observations in dict.fromkeys(u.entry for u in units):
        said = {u: bench.summary(u)["rollouts"] for u in units if u.entry == observations}
        best = max(said, key=lambda u: (said[u]["success"], said[u]["score"]))
        yield best, load_rollouts(bench.plan.folder(best))[0]


def driven_videos(bench: Bench) -> list[tuple["Video", Path]]:
    """The videos that were made, and where each is."""
    from pipeline.sinks.rollout_video import Video

    folder = bench.plan.folder(Unit("rollout_video"))
    return [(Video.of(said), folder / said["file"]) for said in bench.summary(Unit("rollout_video"))["videos"]]


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
        """Held-out episodes in Rerun: joints recorded against predicted, and the error over time above its floor, if known.

        Beside them what there is to see: the cameras, the SO-101 by its own meshes, PushT's table, the chunk predicted just now;
        a tab for each of the first start states, with what every policy did from it. Diamonds mark where a policy disagrees most
        with the recording. Cameras take the data set's own bytes, of as many episodes as keep the file small; `demobench view`
        shows the others.
        """
        bench = workbench.open(context, budget)
        unit = Unit("rerun_recording")
        made = bench.make(unit, lambda draft: _write_rerun(bench, draft))
        path = bench.plan.folder(unit) / "held_out.rrd"
        metadata = {
            "file": dg.MetadataValue.path(str(path)),
            "download": dg.MetadataValue.url(file_link(bench, unit, path.name)),
            "open_with": f"rerun --bind 127.0.0.1 {path}",
            "episodes": dg.MetadataValue.json(made.summary["episodes"]),
            "size_mb": made.summary["size_mb"],
            "left out": table(["why"], [(why,) for why in made.summary["left_out"]]),
        }
        return result(bench, RERUN, {"": made}, metadata, ["holds_every_episode"])

    return rerun_recording


def _write_rerun(bench: Bench, draft) -> Outcome:
    from pipeline.sinks.to_rerun import episodes_in, write_rerun

    path = draft / "held_out.rrd"
    episodes = _held_out(bench)
    driven, not_driven = _driven(bench)
    left_out = write_rerun(
        path,
        bench.demonstrations,
        bench.semantics,
        _predictions(bench),
        episodes,
        name=bench.plan.key,
        driven=driven,
        floors=mean_error_floors(bench.plan),
        most_bytes=MOST_BYTES,
    )
    ids = _recorded_ids(bench, episodes)
    found = episodes_in(path)
    return Outcome(
        {"episodes": ids, "size_mb": round(path.stat().st_size / 1e6, 2), "left_out": [*left_out, *not_driven]},
        {"holds_every_episode": (found == set(ids), f"{len(found)} of {len(ids)} episodes")},
    )


def mean_error_floors(plan: Plan) -> dict[str, float]:
    """Observation set → where the floor of the first action's mean error lies, at the least; those that are known."""
    from pipeline.statistics.floors import load_estimates

    path = plan.folder(Unit("multimodality_floor")) / ESTIMATES
    found = load_estimates(path) if path.is_file() else []
    return {e.observations: e.value for e in found if e.loss == "mae" and e.horizon == 0 and e.value is not None}


def _driven(bench: Bench) -> tuple[list["Driven"], list[str]]:
    """The first start states of every policy that was rolled out, by its first training seed; and why some are left out."""
    from pipeline.errors import NotApplicableError, StoreError
    from pipeline.simulate.scene import drawing_of
    from pipeline.simulate.scene_files import load_scenes
    from pipeline.simulate.trial import load_rollouts
    from pipeline.sinks.rerun_rollouts import Driven

    found, left_out = [], []
    for unit in bench.plan.fresh_policy_units("rollouts"):
        if not bench.summary(unit)["rollouts"]:
            continue
        folder = bench.plan.folder(unit)
        first = load_rollouts(folder)[0]
        try:
            scenes = load_scenes(folder / f"seed_{first.seed}")
            if scenes and drawing_of(first.simulator):
                found.append(Driven(first, scenes.first(START_STATES)))
        except (NotApplicableError, StoreError) as why:
            # The held-out episodes are worth writing without them.
            left_out.append(f"roll-outs of {unit.policy} ({unit.entry}): {why}")
    return found, left_out

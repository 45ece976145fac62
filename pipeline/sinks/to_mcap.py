"""Held-out episodes as MCAP: recorded states and actions beside what every policy predicted, for any ROS 2 tool.

    /joint_states                        sensor_msgs/JointState   `observation.state`
    /joint_commands                      sensor_msgs/JointState   the recorded action
    /policy/<policy>/<observations>      sensor_msgs/JointState   the policy's first action at each anchor (first seed)
    /episode                             std_msgs/String          at each episode's first frame: its number and task

What belongs here: message layout, topics and times. What does not: choosing episodes, errors.

Times are the demonstrations' own clock. Episodes follow one another with `GAP_S` between them, the first one starting
at `GAP_S`, because a stamp of zero means "not set" in ROS.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.sinks import replacing
from pipeline.types import ACTION, STATE, ActionKind, Demonstrations, Predictions, Semantics

GAP_S = 1.0
METADATA = "demobench"

_RULE = "=" * 80  # readers split a definition at lines of exactly 80
_TIME = f"{_RULE}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
_HEADER = f"{_RULE}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n{_TIME}"
JOINT_STATE = (
    f"std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n{_HEADER}"
)
STRING = "string data\n"


@dataclass(frozen=True)
class Stream:
    """One topic of joint messages: the global frames [n] that have one, and their values [n, D]."""

    topic: str
    names: tuple[str, ...]
    kinds: tuple[ActionKind, ...]
    frames: np.ndarray
    values: np.ndarray

    def inside(self, frames: slice) -> dict[int, np.ndarray]:
        """The values [D] at each of its frames within an episode."""
        here = np.flatnonzero((self.frames >= frames.start) & (self.frames < frames.stop))
        return dict(zip(self.frames[here].tolist(), self.values[here], strict=True))


def write_mcap(
    path: Path,
    demos: Demonstrations,
    semantics: Semantics,
    predictions: Sequence[Predictions],
    episodes: Sequence[int],
    *,
    metadata: Mapping[str, str],
) -> None:
    """Write one MCAP file (profile `ros2`, chunks compressed with zstd).

    Parameters:
        predictions: of any policies; a policy has messages at those frames of `episodes` at which it was asked.
        episodes: positions of the episodes to write, in this order.
        metadata: more entries for the file's metadata record, beside names, units, kinds and episodes.

    Raises:
        StoreError: the file cannot be written.
    """
    from mcap_ros2.writer import Writer

    streams = _streams(demos, semantics, predictions)
    with replacing(path) as temporary, temporary.open("wb") as file, Writer(file) as writer:
        writer.add_metadata(METADATA, _describe(demos, semantics, predictions, episodes) | dict(metadata))
        joints = writer.register_msgdef("sensor_msgs/msg/JointState", JOINT_STATE)
        text = writer.register_msgdef("std_msgs/msg/String", STRING)
        for episode, times_ns in _clock(demos, episodes):
            frames = demos.episode(episode)
            rows = [stream.inside(frames) for stream in streams]
            words = f"episode {demos.episode_ids[episode]}: {demos.tasks[episode]}".removesuffix(": ")
            writer.write_message("/episode", text, {"data": words}, times_ns[0])
            for frame, time_ns in zip(range(frames.start, frames.stop), times_ns, strict=True):
                for stream, values in zip(streams, rows, strict=True):
                    if frame in values:
                        writer.write_message(stream.topic, joints, _message(stream, values[frame], time_ns), time_ns)


def policy_topics(predictions: Sequence[Predictions]) -> list[str]:
    """The topic of each policy × observation set. ROS 2 names hold letters, digits and `_`; the rest becomes `_`."""
    topics: list[str] = []
    for one in predictions:
        topic = f"/policy/{_token(one.policy)}/{_token(one.observations)}"
        while topic in topics:
            topic += "_"
        topics.append(topic)
    return topics


def _token(name: str) -> str:
    token = re.sub(r"[^A-Za-z0-9_]", "_", name) or "_"
    return f"_{token}" if token[0].isdigit() else token


def _streams(demos: Demonstrations, semantics: Semantics, predictions: Sequence[Predictions]) -> list[Stream]:
    """Everything that becomes joint messages; a data set without `observation.state` has no /joint_states."""
    frames = np.arange(demos.frames)
    streams = []
    if STATE in demos.columns:
        names = demos.features[STATE].names
        streams.append(Stream("/joint_states", names, ("position",) * len(names), frames, demos.columns[STATE]))
    names = demos.features[ACTION].names
    streams.append(Stream("/joint_commands", names, semantics.kinds, frames, demos.columns[ACTION]))
    for topic, one in zip(policy_topics(predictions), predictions, strict=True):
        streams.append(Stream(topic, names, semantics.kinds, one.anchors, one.actions[0, :, 0, :]))
    return streams


def _clock(demos: Demonstrations, episodes: Sequence[int]) -> Iterator[tuple[int, list[int]]]:
    """Each episode with the time of each of its frames, in nanoseconds."""
    start_s = GAP_S
    for episode in episodes:
        seconds = demos.timestamps[demos.episode(episode)]
        yield episode, [round((start_s + float(second - seconds.min())) * 1e9) for second in seconds]
        start_s += float(np.ptp(seconds)) + GAP_S


def _message(stream: Stream, values: np.ndarray, time_ns: int) -> dict:
    """A JointState as the encoder wants it. A velocity goes into `velocity`, every other kind into `position`.

    Both arrays have one entry a name where the kinds are mixed; the entries that a column has no value for are NaN.
    """
    seconds, nanoseconds = divmod(time_ns, 1_000_000_000)
    return {
        "header": {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": ""},
        "name": list(stream.names),
        "position": _where(stream.kinds, values, lambda kind: kind != "velocity"),
        "velocity": _where(stream.kinds, values, lambda kind: kind == "velocity"),
        "effort": [],
    }


def _where(kinds: Sequence[ActionKind], values: np.ndarray, wanted: Callable[[ActionKind], bool]) -> list[float]:
    if not any(map(wanted, kinds)):
        return []
    return [float(v) if wanted(kind) else float("nan") for kind, v in zip(kinds, values, strict=True)]


def _describe(
    demos: Demonstrations, semantics: Semantics, predictions: Sequence[Predictions], episodes: Sequence[int]
) -> dict[str, str]:
    """The file's metadata record: what the numbers are, and where they come from."""
    action = demos.features[ACTION]
    described = {
        "dataset": demos.name,
        "revision": demos.revision or "",
        "content_hash": demos.content_hash,
        "fps": f"{demos.fps:g}",
        "episodes": ", ".join(str(demos.episode_ids[e]) for e in episodes),
        "excluded": ", ".join(map(str, demos.excluded)),
        "action_names": ", ".join(action.names),
        "action_units": ", ".join(unit or "unknown" for unit in action.units),
        "action_kinds": ", ".join(semantics.kinds),
    }
    if STATE in demos.features:
        described["state_names"] = ", ".join(demos.features[STATE].names)
        described["state_units"] = ", ".join(unit or "unknown" for unit in demos.features[STATE].units)
    for topic, one in zip(policy_topics(predictions), predictions, strict=True):
        described[topic] = (
            f"policy {one.policy}, observations {one.observations}, seed {one.seeds[0] if one.seeds else 0}"
        )
    return described


def expected_messages(demos: Demonstrations, predictions: Sequence[Predictions], episodes: Sequence[int]) -> int:
    """How many messages a file of these episodes holds, counted from the data alone."""
    frames = [demos.episode(episode) for episode in episodes]
    recorded = (2 if STATE in demos.columns else 1) * sum(span.stop - span.start for span in frames)
    return len(episodes) + recorded + sum(len(one.in_frames(span)) for one in predictions for span in frames)


def count_messages(path: Path) -> int:
    """How many messages the file's own reader finds, reading every one of them."""
    from mcap.reader import make_reader

    with path.open("rb") as file:
        return sum(1 for _ in make_reader(file).iter_messages())

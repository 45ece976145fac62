"""Held-out episodes as MCAP: recorded states and actions beside what every policy predicted, for any ROS 2 tool.

    /joint_states                        sensor_msgs/JointState   `observation.state`
    /joint_commands                      sensor_msgs/JointState   the recorded action
    /policy/<policy>/<observations>      sensor_msgs/JointState   the policy's first action at each anchor (first seed)
    /camera/<name>                       `mcap_cameras`           the picture of each frame
    /episode                             std_msgs/String          at each episode's first frame: its number and task
    /rollout/<policy>/<observations>/…   sensor_msgs/JointState   what there was to see of its roll-outs, and String `start_state`

What belongs here: message layout, topics and times. What does not: choosing episodes, errors, reading it again (`mcap_recovery`).

Times are the demonstrations' own clock. Episodes follow one another with `GAP_S` between them, the first one starting
at `GAP_S`, because a stamp of zero means "not set" in ROS. Roll-outs come after them, those from one start state side by side.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.simulate.scene import frames_of
from pipeline.sinks import replacing
from pipeline.sinks.mcap_cameras import DEFINITIONS, HEADER, feeds_of, left_out, stamped, token
from pipeline.types import ACTION, STATE, ActionKind, Demonstrations, Predictions, Semantics

if TYPE_CHECKING:
    from pipeline.sinks.rerun_rollouts import Driven

GAP_S = 1.0
CHUNK_BYTES = 2**17
"""What is lost at most where a file is cut off, before compression."""
METADATA, CAMERAS = "demobench", "cameras"
EPISODE, START_STATE = "/episode", "start_state"

JOINTS, TEXT = "sensor_msgs/msg/JointState", "std_msgs/msg/String"
JOINT_STATE = (
    f"std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n{HEADER}"
)
_DEFINITIONS = {JOINTS: JOINT_STATE, TEXT: "string data\n", **DEFINITIONS}


@dataclass(frozen=True)
class Written:
    """How many messages a file holds, and why pictures are missing from it, if they are."""

    messages: int
    left_out: list[str]


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


@dataclass
class _Log:
    """A file that is being written: schemas as they are needed, and a count."""

    writer: Any
    schemas: dict[str, Any] = field(default_factory=dict)
    messages: int = 0

    def put(self, topic: str, schema: str, message: dict, time_ns: int) -> None:
        if schema not in self.schemas:
            self.schemas[schema] = self.writer.register_msgdef(schema, _DEFINITIONS[schema])
        self.writer.write_message(topic, self.schemas[schema], message, time_ns)
        self.messages += 1

    def say(self, topic: str, words: str, time_ns: int) -> None:
        self.put(topic, TEXT, {"data": words}, time_ns)


@dataclass
class _Clock:
    """What comes next begins `GAP_S` after the end of what came before."""

    start_s: float = GAP_S

    def take(self, seconds: np.ndarray) -> list[int]:
        """The time of each frame, in nanoseconds, from the seconds [n] of its recording's own clock."""
        times = [round((self.start_s + float(second - seconds.min())) * 1e9) for second in seconds]
        self.start_s += float(np.ptp(seconds)) + GAP_S
        return times


def write_mcap(
    path: Path,
    demos: Demonstrations,
    semantics: Semantics,
    predictions: Sequence[Predictions],
    episodes: Sequence[int],
    *,
    metadata: Mapping[str, str],
    attachments: Mapping[str, Any] | None = None,
    driven: Sequence["Driven"] = (),
) -> Written:
    """Write one MCAP file (profile `ros2`, chunks compressed with zstd, an index at its end).

    Parameters:
        predictions: of any policies; a policy has messages at those frames of `episodes` at which it was asked.
        episodes: positions of the episodes to write, in this order.
        metadata: more entries for the file's metadata record, beside names, units, kinds and episodes.
        attachments: file name → what it holds, as JSON.
        driven: roll-outs to write after them.

    Raises:
        StoreError: the file cannot be written.
    """
    from mcap_ros2.writer import Writer

    clock, feeds = _Clock(), feeds_of(demos)
    with replacing(path) as temporary, temporary.open("wb") as file, Writer(file, CHUNK_BYTES) as writer:
        log = _Log(writer)
        writer.add_metadata(METADATA, _describe(demos, semantics, predictions, episodes) | dict(metadata))
        for name, held in (attachments or {}).items():
            writer.add_attachment(0, 0, name, "application/json", json.dumps(held, indent=1).encode())
        streams = _streams(demos, semantics, predictions)
        for episode in episodes:
            _write_episode(log, demos, episode, streams, feeds, clock.take(demos.timestamps[demos.episode(episode)]))
        _write_rollouts(log, demos, driven, clock)
        if feeds:
            writer.add_metadata(CAMERAS, {feed.topic: feed.described() for feed in feeds})
    return Written(log.messages, left_out(feeds))


def _write_episode(log: _Log, demos: Demonstrations, episode: int, streams, feeds, times_ns: list[int]) -> None:
    frames = demos.episode(episode)
    rows = [stream.inside(frames) for stream in streams]
    seen = [feed.messages(feed.episode(episode)) for feed in feeds]
    words = f"episode {demos.episode_ids[episode]}: {demos.tasks[episode]}".removesuffix(": ")
    log.say(EPISODE, words, times_ns[0])
    for frame, time_ns in zip(range(frames.start, frames.stop), times_ns, strict=True):
        for stream, values in zip(streams, rows, strict=True):
            if frame in values:
                log.put(stream.topic, JOINTS, _message(stream, values[frame], time_ns), time_ns)
        for feed, messages in zip(feeds, seen, strict=True):
            for schema, message in islice(messages, 1):
                log.put(feed.topic, schema, stamped(schema, message, _stamp(time_ns)), time_ns)


def _write_rollouts(log: _Log, demos: Demonstrations, driven: Sequence["Driven"], clock: _Clock) -> None:
    """From each start state, all policies at once."""
    rows = [(number, one, row) for one in driven for row, number in enumerate(one.start_states)]
    for number in sorted({number for number, _, _ in rows}):
        together = [(one, row) for found, one, row in rows if found == number]
        streams = [stream for one, row in together for stream in _rollout_streams(demos, one, row)]
        longest = max(len(stream.values) for stream in streams)
        times_ns = clock.take(np.arange(longest) / together[0][0].drawing.fps)
        for one, row in together:
            log.say(f"{_rollout_topic(one)}/{START_STATE}", one.words(row), times_ns[0])
        for frame, time_ns in enumerate(times_ns):
            for stream in streams:
                if frame < len(stream.values):
                    log.put(stream.topic, JOINTS, _message(stream, stream.values[frame], time_ns), time_ns)


def _rollout_streams(demos: Demonstrations, one: "Driven", row: int) -> list[Stream]:
    """Each feature that the simulator showed, from the start state to the end."""
    found = []
    for key in one.scenes.shown:
        names, values = demos.features[key].names, frames_of(one.scenes, row, key)
        leaf = "joint_states" if key == STATE else token(key.removeprefix("observation."))
        kinds: tuple[ActionKind, ...] = ("position",) * len(names)
        found.append(Stream(f"{_rollout_topic(one)}/{leaf}", names, kinds, np.arange(len(values)), values))
    return found


def _rollout_topic(one: "Driven") -> str:
    return f"/rollout/{token(one.rollouts.policy)}/{token(one.rollouts.observations)}"


def policy_topics(predictions: Sequence[Predictions]) -> list[str]:
    """The topic of each policy × observation set. ROS 2 names hold letters, digits and `_`; the rest becomes `_`."""
    topics: list[str] = []
    for one in predictions:
        topic = f"/policy/{token(one.policy)}/{token(one.observations)}"
        while topic in topics:
            topic += "_"
        topics.append(topic)
    return topics


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


def _stamp(time_ns: int) -> dict[str, int]:
    seconds, nanoseconds = divmod(time_ns, 1_000_000_000)
    return {"sec": seconds, "nanosec": nanoseconds}


def _message(stream: Stream, values: np.ndarray, time_ns: int) -> dict:
    """A JointState as the encoder wants it. A velocity goes into `velocity`, every other kind into `position`.

    Both arrays have one entry a name where the kinds are mixed; the entries that a column has no value for are NaN.
    """
    return {
        "header": {"stamp": _stamp(time_ns), "frame_id": ""},
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


def count_messages(path: Path) -> int:
    """How many messages the file's own reader finds, reading every one of them."""
    from mcap.reader import make_reader

    with path.open("rb") as file:
        return sum(1 for _ in make_reader(file).iter_messages())

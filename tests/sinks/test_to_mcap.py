"""MCAP files are read back by the tools that people have: the `mcap` reader with ROS 2 decoding, rosbags, and Rerun."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rerun.chunk import RrdReader
from rosbags.highlevel import AnyReader

from pipeline.errors import StoreError
from pipeline.lerobot_format.quality import resolve_semantics
from pipeline.lerobot_format.read import read_dataset
from pipeline.sinks.rerun_rollouts import Driven
from pipeline.sinks.to_mcap import GAP_S, count_messages, policy_topics, write_mcap
from pipeline.sinks.to_rerun import START
from pipeline.types import ACTION, STATE, Feature
from tests.filming import (
    KEY,
    PATH_V2,
    WITH_B_FRAMES,
    WITHOUT,
    as_png,
    filmed_v2,
    filmed_v3,
    numbers_in_packets,
    with_pictures,
    write_mp4,
)
from tests.makers import tiny_recording

from .driving import BLOCK, make_driven
from .making import make_demos, make_predictions, make_semantics

POLICY = "/policy/mlp_k04/state"


def read(path: Path) -> dict[str, list]:
    """Topic → [(log time in ns, message)] by the `mcap` reader."""
    found: dict[str, list] = {}
    with path.open("rb") as file:
        for _, channel, record, message in make_reader(
            file, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            found.setdefault(channel.topic, []).append((record.log_time, message))
    return found


def test_holds_states_commands_and_first_actions(tmp_path, demos, semantics, predictions):
    write_mcap(tmp_path / "a.mcap", demos, semantics, predictions, [1, 2], metadata={})
    found = read(tmp_path / "a.mcap")

    frames = np.arange(demos.episode_starts[1], demos.frames)
    for topic, feature in (("/joint_states", STATE), ("/joint_commands", ACTION)):
        np.testing.assert_array_equal([m.position for _, m in found[topic]], demos.columns[feature][frames])
        assert all(m.name == ["x", "y"] for _, m in found[topic])
    one = predictions[1]
    np.testing.assert_array_equal([m.position for _, m in found[POLICY]], one.actions[0, :, 0, :])
    assert len(found[POLICY]) == len(frames) - 2 * 2  # two frames of each episode have no history


def test_times_are_the_demonstrations_own_clock(tmp_path, semantics):
    demos = make_demos(lengths=(4, 3))
    uneven = np.array([0.0, 0.05, 0.4, 0.5, 0.0, 0.11, 0.2])
    demos = replace(demos, timestamps=uneven)
    write_mcap(tmp_path / "a.mcap", demos, semantics, [], [1, 0], metadata={})

    times = np.array([time for time, _ in read(tmp_path / "a.mcap")["/joint_states"]]) / 1e9
    expected = np.concatenate([GAP_S + uneven[4:], GAP_S + 0.2 + GAP_S + uneven[:4]])
    np.testing.assert_allclose(times, expected, atol=1e-9)


def test_stamps_equal_log_times_and_predictions_sit_at_their_anchor(tmp_path, demos, semantics, predictions):
    write_mcap(tmp_path / "a.mcap", demos, semantics, predictions, [2], metadata={})
    found = read(tmp_path / "a.mcap")
    for time, message in found[POLICY]:
        assert message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec == time
    times = [time for time, _ in found["/joint_states"]]
    assert [time for time, _ in found[POLICY]] == times[2:]


def test_metadata_names_data_units_kinds_and_what_the_caller_adds(tmp_path, demos, semantics, predictions):
    demos = replace(demos, excluded=(40, 41))
    write_mcap(tmp_path / "a.mcap", demos, semantics, predictions, [1], metadata={"protocol": "strict"})
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        described = next(record for record in reader.iter_metadata() if record.name == "demobench").metadata
    assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
    assert described["protocol"] == "strict"
    assert described["dataset"] == "small"
    assert described["content_hash"] == demos.content_hash
    assert described["excluded"] == "40, 41"
    assert described["action_units"] == "px, px"
    assert described["action_kinds"] == "position, position"
    assert described["episodes"] == "8"
    assert described[POLICY] == "policy mlp_k04, observations state, seed 0"


def test_velocities_and_a_gripper_go_where_ros_expects_them(tmp_path):
    demos = make_demos(columns=3)
    semantics = replace(make_semantics(demos), kinds=("velocity", "velocity", "other"))
    write_mcap(tmp_path / "a.mcap", demos, semantics, [], [0], metadata={})
    message = read(tmp_path / "a.mcap")["/joint_commands"][0][1]
    action = demos.columns[ACTION][0]
    np.testing.assert_array_equal(message.velocity, [action[0], action[1], np.nan])
    np.testing.assert_array_equal(message.position, [np.nan, np.nan, action[2]])


def test_rosbags_reads_the_same(tmp_path, demos, semantics, predictions):
    write_mcap(tmp_path / "a.mcap", demos, semantics, predictions, [1, 2], metadata={})
    with AnyReader([tmp_path / "a.mcap"]) as reader:
        counts = {c.topic: (c.msgtype, c.msgcount) for c in reader.connections}
        connections = [c for c in reader.connections if c.topic == POLICY]
        read_back = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(connections)]
        texts = [
            reader.deserialize(raw, c.msgtype).data
            for c, _, raw in reader.messages([c for c in reader.connections if c.topic == "/episode"])
        ]
    assert counts["/joint_states"] == ("sensor_msgs/msg/JointState", 60)
    np.testing.assert_array_equal([m.position for m in read_back], predictions[1].actions[0, :, 0, :])
    assert texts == ["episode 8", "episode 9"]


def test_reruns_own_loader_finds_no_fault_and_names_the_joints(tmp_path, demos, semantics, predictions):
    rollouts = make_driven((10, 6))
    driven = [Driven(rollouts, rollouts.scenes)]
    block = Feature(BLOCK, ("block_x", "block_y", "block_angle"), ("px", "px", "rad"))
    demos = replace(demos, features=dict(demos.features) | {BLOCK: block})
    path, loaded = tmp_path / "a.mcap", tmp_path / "a.rrd"
    write_mcap(path, demos, semantics, predictions, [1, 2], metadata={}, driven=driven)
    for words in (["check", str(path)], ["convert", str(path), "-o", str(loaded)]):
        done = subprocess.run([sys.executable, "-c", START, "mcap", *words], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    names, values = {}, {}
    for chunk in RrdReader(loaded).stream():
        table = chunk.to_record_batch()
        if "SeriesLines:names" in table.schema.names:
            names[chunk.entity_path] = table["SeriesLines:names"].to_pylist()[0]
            values.setdefault(chunk.entity_path, []).extend(table["Scalars:scalars"].to_pylist())
    for topic in ("/joint_states", "/joint_commands", POLICY, "/rollout/mlp_k04/state/joint_states"):
        assert names[f"{topic}/position"] == ["x", "y"]
    assert names["/rollout/mlp_k04/state/environment_state/position"] == list(block.names)
    np.testing.assert_allclose(
        sorted(values[f"{POLICY}/position"]), sorted(predictions[1].actions[0, :, 0, :].tolist())
    )


def test_predictions_for_some_episodes_only_leave_the_others_without(tmp_path, demos, semantics):
    write_mcap(tmp_path / "a.mcap", demos, semantics, [make_predictions(demos, [2])], [0, 1, 2], metadata={})
    found = read(tmp_path / "a.mcap")
    assert len(found["/joint_states"]) == demos.frames
    assert len(found[POLICY]) == 36 - 2


def test_a_data_set_without_a_state_has_commands_only(tmp_path, demos, semantics):
    blind = replace(demos, columns={ACTION: demos.columns[ACTION]}, features={ACTION: demos.features[ACTION]})
    write_mcap(tmp_path / "a.mcap", blind, semantics, [], [0], metadata={})
    assert set(read(tmp_path / "a.mcap")) == {"/episode", "/joint_commands"}


def test_topics_are_ros_names_and_never_shared(demos):
    names = [("act-v1.2", "pose+image"), ("act_v1_2", "pose_image"), ("1nn", "state")]
    predictions = [replace(make_predictions(demos, [0]), policy=p, observations=o) for p, o in names]
    assert policy_topics(predictions) == [
        "/policy/act_v1_2/pose_image",
        "/policy/act_v1_2/pose_image_",
        "/policy/_1nn/state",
    ]


def test_a_failure_leaves_the_earlier_file_and_nothing_half_written(tmp_path, demos, semantics, predictions):
    path = tmp_path / "a.mcap"
    write_mcap(path, demos, semantics, predictions, [1], metadata={})
    before = path.read_bytes()
    with pytest.raises(IndexError):
        write_mcap(path, demos, semantics, predictions, [1, 99], metadata={})
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_cannot_be_written_is_one_clear_message(tmp_path, demos, semantics):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StoreError, match=r"a\.mcap cannot be written: .*choose another folder"):
        write_mcap(tmp_path / "file" / "a.mcap", demos, semantics, [], [0], metadata={})


def test_settings_split_and_data_are_attached(tmp_path, demos, semantics):
    held = {"split.json": {"folds": [[0], [1]]}, "data.json": {"content_hash": demos.content_hash}}
    write_mcap(tmp_path / "a.mcap", demos, semantics, [], [0], metadata={}, attachments=held)
    with (tmp_path / "a.mcap").open("rb") as file:
        found = {one.name: (one.media_type, json.loads(one.data)) for one in make_reader(file).iter_attachments()}
    assert found == {name: ("application/json", value) for name, value in held.items()}


@pytest.mark.parametrize(
    ("film", "options", "codec"),
    [(filmed_v2, WITHOUT, "h264"), (filmed_v3, WITH_B_FRAMES, "h264"), (with_pictures, None, "png")],
)
def test_the_picture_at_time_t_is_that_of_the_frame_at_time_t(tmp_path, film, options, codec):
    recording = tiny_recording(3, (13, 20, 9))
    folder = film(tmp_path / "set", recording, *([] if options is None else ["libx264", options]))
    demos = read_dataset(folder, name="set")
    uneven = demos.timestamps + np.random.default_rng(0).uniform(0, 0.04, demos.frames)
    demos = replace(demos, timestamps=uneven)
    written = write_mcap(tmp_path / "a.mcap", demos, resolve_semantics(demos), [], [2, 1], metadata={})
    found = read(tmp_path / "a.mcap")
    pictures = found["/camera/top"]
    assert written.left_out == []
    assert written.messages == count_messages(tmp_path / "a.mcap") == 2 + 3 * (9 + 20)
    assert [time for time, _ in pictures] == [time for time, _ in found["/joint_states"]]
    frames = [*range(33, 42), *range(13, 33)]
    data = [bytes(message.data) for _, message in pictures]
    assert {message.format for _, message in pictures} == {codec}
    if codec == "png":
        assert data == [as_png(number) for number in frames]
        stamps = [message.header.stamp for _, message in pictures]
    else:
        shown = numbers_in_packets(codec, data[:9]) + numbers_in_packets(codec, data[9:])
        assert shown == frames
        stamps = [message.timestamp for _, message in pictures]
    assert [stamp.sec * 10**9 + stamp.nanosec for stamp in stamps] == [time for time, _ in pictures]


def test_rosbags_reads_the_camera_too(tmp_path):
    demos = read_dataset(filmed_v2(tmp_path / "set", tiny_recording(1, 12)), name="set")
    write_mcap(tmp_path / "a.mcap", demos, resolve_semantics(demos), [], [0], metadata={})
    with AnyReader([tmp_path / "a.mcap"]) as reader:
        (camera,) = [c for c in reader.connections if c.topic == "/camera/top"]
        packets = [bytes(reader.deserialize(raw, camera.msgtype).data) for _, _, raw in reader.messages([camera])]
        joints = next(c for c in reader.connections if c.topic == "/joint_states")
        names = [reader.deserialize(raw, joints.msgtype).name for _, _, raw in reader.messages([joints])]
    assert camera.msgtype == "foxglove_msgs/msg/CompressedVideo"
    assert numbers_in_packets("h264", packets) == list(range(12))
    assert names == [["joint_0", "joint_1"]] * 12


def test_a_video_of_another_length_is_left_out_and_said_so(tmp_path):
    folder = filmed_v2(tmp_path / "set", tiny_recording(2, 12))
    write_mp4(folder / PATH_V2.format(episode_chunk=0, video_key=KEY, episode_index=1), range(5))
    demos = read_dataset(folder, name="set")
    written = write_mcap(tmp_path / "a.mcap", demos, resolve_semantics(demos), [], [0, 1], metadata={})
    (why,) = written.left_out
    assert why.startswith(f"camera '{KEY}': ")
    assert "holds 5 pictures of episode 1, which has 12 frames" in why
    found = read(tmp_path / "a.mcap")
    assert (len(found["/camera/top"]), len(found["/joint_states"])) == (12, 24)
    with (tmp_path / "a.mcap").open("rb") as file:
        said = next(one.metadata for one in make_reader(file).iter_metadata() if one.name == "cameras")
    assert said["/camera/top"].startswith(f"{KEY}, 64×48; h264, as in the data set; left out: ")


def test_a_video_that_is_declared_and_missing_is_left_out_and_said_so(tmp_path):
    folder = filmed_v2(tmp_path / "set", tiny_recording(2, 12))
    shutil.rmtree(folder / "videos")
    demos = read_dataset(folder, name="set")
    written = write_mcap(tmp_path / "a.mcap", demos, resolve_semantics(demos), [], [0, 1], metadata={})
    assert written.left_out == [
        f"camera '{KEY}': The videos of '{KEY}' that meta/ declares are not in {folder}. Copy the folder videos/ too."
    ]
    assert "/camera/top" not in read(tmp_path / "a.mcap")


def test_roll_outs_follow_the_episodes_each_start_state_by_itself(tmp_path, demos, semantics):
    block = Feature(BLOCK, ("block_x", "block_y", "block_angle"), ("px", "px", "rad"))
    demos = replace(demos, features=dict(demos.features) | {BLOCK: block})
    rollouts = make_driven((10, 6))
    driven = Driven(rollouts, rollouts.scenes)
    written = write_mcap(tmp_path / "a.mcap", demos, semantics, [], [0], metadata={}, driven=[driven])
    found, root = read(tmp_path / "a.mcap"), "/rollout/mlp_k04/state"
    said = found[f"{root}/start_state"]
    assert [message.data for _, message in said] == ["start state 7: on target, 1.0 s", "start state 8: failed, 0.6 s"]
    states = found[f"{root}/joint_states"]
    np.testing.assert_allclose([m.position for _, m in states][:11], rollouts.scenes.shown[STATE][0, :11])
    np.testing.assert_allclose([m.position for _, m in states][11:], rollouts.scenes.shown[STATE][1, :7])
    assert states[0][1].name == ["x", "y"]
    assert found[f"{root}/environment_state"][0][1].name == list(block.names)
    assert states[11][0] == said[1][0]
    assert states[0][0] > found["/joint_states"][-1][0]
    assert written.messages == 1 + 2 * 30 + 2 + 2 * (11 + 7)

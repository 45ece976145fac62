"""Recordings are read back by Rerun's own reader and checked by its own command line."""

import io
import re
import shutil
import socket
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image
from rerun.chunk import RrdReader

from pipeline.errors import StoreError
from pipeline.lerobot_format.quality import resolve_semantics
from pipeline.lerobot_format.read import read_dataset
from pipeline.simulate.so101 import POSE
from pipeline.simulate.so101_arm import NAMES, PAN_AXIS_X_M, UNITS
from pipeline.sinks import to_rerun
from pipeline.sinks.palette import TRAINED
from pipeline.sinks.rerun_rollouts import Driven
from pipeline.sinks.to_rerun import episodes_in, has_paths, view, write_rerun
from pipeline.types import ACTION, STATE, Feature, Scenes
from tests.filming import (
    KEY,
    PATH_V2,
    WITH_B_FRAMES,
    WITHOUT,
    as_png,
    filmed_v2,
    filmed_v3,
    number_of,
    with_pictures,
    write_mp4,
)
from tests.makers import tiny_recording

from .driving import BLOCK, make_driven
from .making import NASTY, make_demos, make_predictions, make_semantics

RERUNS_PORT = 9876


def read(path: Path) -> dict[str, list]:
    """Entity → its chunks."""
    found: dict[str, list] = {}
    for chunk in RrdReader(path).stream():
        found.setdefault(chunk.entity_path, []).append(chunk)
    return found


def column(chunks: list, ending: str) -> list:
    """All values of the one column whose name ends so, over chunks in order of time."""
    tables = [chunk.to_record_batch() for chunk in chunks]
    tables = [t for t in tables if any(name.endswith(ending) for name in t.schema.names)]
    tables.sort(key=lambda t: t["frame"][0].as_py() if "frame" in t.schema.names else -1)
    return [value for t in tables for name in t.schema.names if name.endswith(ending) for value in t[name].to_pylist()]


def names_in_blueprint(path: Path) -> list[str]:
    """What its layout calls tabs and views."""
    reader = RrdReader(path)
    found = []
    for chunk in reader.stream(store=reader.blueprints()[0]):
        table = chunk.to_record_batch()
        found += [v for n in table.schema.names if n.endswith("display_name") for v in table[n].to_pylist()]
    return sorted(name for names in found for name in names)


@pytest.fixture
def recording(tmp_path, demos, semantics, predictions) -> Path:
    path = tmp_path / "held_out.rrd"
    write_rerun(path, demos, semantics, predictions, [1, 2], name="small")
    return path


def test_rerun_itself_finds_no_fault(recording):
    checked = subprocess.run(
        [sys.executable, "-m", "rerun_cli", "rrd", "verify", str(recording)], capture_output=True, text=True
    )
    assert checked.returncode == 0, checked.stderr
    assert "verified without error" in checked.stdout + checked.stderr


def test_joints_hold_state_recorded_action_and_every_policy(recording, demos, predictions):
    frames = demos.episode(1)
    values = np.array(column(read(recording)["/episode_008/joints/x"], "Scalars:scalars"))
    np.testing.assert_allclose(values[:, 0], demos.columns[STATE][frames, 0])
    np.testing.assert_allclose(values[:, 1], demos.columns[ACTION][frames, 0])
    for place, one in enumerate(predictions):
        assert np.isnan(values[:2, 2 + place]).all()  # no history yet, so not asked
        np.testing.assert_allclose(values[2:, 2 + place], one.actions[0, one.in_frames(frames), 0, 0])


def test_names_and_colours_are_static(recording):
    chunks = [chunk for chunk in read(recording)["/episode_008/joints/x"] if chunk.is_static]
    assert column(chunks, "SeriesLines:names") == [["state", "recorded action", "mlp_k01", "mlp_k04", "hold_still"]]
    assert len(set(column(chunks, "SeriesLines:colors")[0])) == 5


def test_time_lines_are_seconds_from_the_start_of_each_episode(recording, demos):
    for episode in (1, 2):
        chunks = read(recording)[f"/episode_{demos.episode_ids[episode]:03d}/error"]
        seconds = [t.total_seconds() for t in column(chunks, "time")]
        np.testing.assert_allclose(seconds, demos.timestamps[demos.episode(episode)], atol=1e-6)
        assert column(chunks, "frame") == list(range(len(seconds)))


def test_the_error_is_the_mean_over_columns_of_the_first_action(recording):
    values = np.array(column(read(recording)["/episode_008/error"], "Scalars:scalars"))
    np.testing.assert_allclose(values[2:], np.tile([5.0, 5.0, 20.0], (len(values) - 2, 1)), atol=1e-3)


def test_errors_of_angles_go_the_short_way_round(tmp_path):
    demos = make_demos(columns=1, lengths=(6,))
    actions = np.full((6, 1), 3.1, np.float32)
    demos = replace(demos, columns={STATE: actions, ACTION: actions})
    semantics = replace(make_semantics(demos), circular={ACTION: (True,), STATE: (True,)})
    write_rerun(tmp_path / "a.rrd", demos, semantics, [make_predictions(demos, [0], off=0.1)], [0], name="a")
    wrapped = replace(make_predictions(demos, [0]), actions=np.full((2, 4, 1, 1), -3.1, np.float32))
    write_rerun(tmp_path / "b.rrd", demos, semantics, [wrapped], [0], name="b")
    values = np.array(column(read(tmp_path / "b.rrd")["/episode_007/error"], "Scalars:scalars"))
    np.testing.assert_allclose(values[2:], 2 * np.pi - 6.2, atol=1e-5)


def test_positions_in_a_plane_have_paths_with_the_chunk_predicted_now(recording, demos, predictions):
    frames = demos.episode(1)
    entities = read(recording)
    strips = column(entities["/episode_008/path/mlp_k04/state"], "LineStrips2D:strips")
    one = predictions[1]
    first = one.in_frames(frames)[0]
    expected = [demos.columns[STATE][one.anchors[first]], *one.actions[0, first]]
    np.testing.assert_allclose(strips[0][0], expected)
    assert len(strips) == len(one.in_frames(frames))
    assert len(column(entities["/episode_008/path/recorded"], "LineStrips2D:strips")[0][0]) == 24


def test_joints_that_are_no_plane_have_no_paths(tmp_path):
    demos = make_demos(columns=3)
    semantics = make_semantics(demos, "velocity")
    assert not has_paths(demos, semantics)
    write_rerun(tmp_path / "a.rrd", demos, semantics, [make_predictions(demos, [0])], [0], name="a")
    entities = read(tmp_path / "a.rrd")
    assert not [entity for entity in entities if "/path" in entity]
    static = [chunk for chunk in entities["/episode_007/joints/x"] if chunk.is_static]
    assert column(static, "SeriesLines:names") == [["recorded action", "mlp_k04"]]


def test_it_opens_with_its_own_layout_and_says_what_it_is(recording, demos):
    reader = RrdReader(recording)
    assert len(reader.blueprints()) == 1
    assert [entry.application_id for entry in reader.recordings()] == ["demobench"]
    said = [
        str(chunk.to_record_batch().to_pydict())
        for entity, chunks in read(recording).items()
        for chunk in chunks
        if "propert" in entity
    ]
    assert any(demos.content_hash in text for text in said)


def test_policies_asked_about_some_episodes_only(tmp_path, demos, semantics):
    write_rerun(tmp_path / "a.rrd", demos, semantics, [make_predictions(demos, [2])], [0, 2], name="a")
    values = np.array(column(read(tmp_path / "a.rrd")["/episode_007/joints/x"], "Scalars:scalars"))
    assert np.isnan(values[:, 2]).all()
    assert "/episode_007/path/mlp_k04/state" not in read(tmp_path / "a.rrd")
    assert episodes_in(tmp_path / "a.rrd") == {7, 9}


def test_no_predictions_at_all(tmp_path, demos, semantics):
    write_rerun(tmp_path / "a.rrd", demos, semantics, [], [0], name="a")
    assert "/episode_007/error" not in read(tmp_path / "a.rrd")
    assert episodes_in(tmp_path / "a.rrd") == {7}


@pytest.fixture
def driven() -> Driven:
    rollouts = make_driven()
    return Driven(rollouts, rollouts.scenes)


def test_roll_outs_stand_under_the_numbers_of_their_start_states(tmp_path, demos, semantics, driven):
    path = tmp_path / "a.rrd"
    write_rerun(path, demos, semantics, [], [0], name="a", driven=[driven])
    entities = read(path)
    root = "/rollouts/mlp_k04/state"
    for number in (7, 8, 9):
        assert {
            f"{root}/start_{number:03d}/{thing}" for thing in ("goal", "block", "finger", "way", "predicted_chunk")
        } <= set(entities)
    block = entities[f"{root}/start_008/block"]
    assert len(column([chunk for chunk in block if not chunk.is_static], "LineStrips2D:strips")) == 6 + 1
    plan = column([c for c in entities[f"{root}/start_008/predicted_chunk"] if not c.is_static], "LineStrips2D:strips")
    np.testing.assert_allclose(plan[1][0], [[72, 400], [84, 400], [96, 400], [108, 400]])
    assert plan[-1] == [], "nothing lies ahead at the end"
    seconds = [t.total_seconds() for t in column([c for c in block if not c.is_static], "time")]
    np.testing.assert_allclose(seconds, np.arange(7) / 10, atol=1e-6)
    assert episodes_in(path) == {7}, "roll-outs are no held-out episodes"


def test_policies_stand_side_by_side_under_the_number_of_the_start_state(tmp_path, demos, semantics, driven):
    still = replace(driven.rollouts, policy="hold_still", success=np.array([False, False, True]))
    fewer = Driven(still, driven.scenes.first(2))
    path = tmp_path / "a.rrd"
    write_rerun(path, demos, semantics, [], [0], name="a", driven=[driven, fewer])
    names = names_in_blueprint(path)
    assert [name for name in names if name.startswith("start state")] == [f"start state {n}" for n in (7, 8, 9)]
    ended = [name for name in names if name.startswith("hold_still")]
    assert ended == ["hold_still (state): failed, 0.6 s", "hold_still (state): failed, 1.0 s"]
    assert "mlp_k04 (state): on target, 1.2 s" in names
    entities = read(path)
    assert "/rollouts/hold_still/state/start_008/block" in entities
    assert "/rollouts/hold_still/state/start_009/block" not in entities, "of that one there is nothing to see"


def test_rerun_finds_no_fault_in_an_arm_either(tmp_path, demos, semantics):
    pytest.importorskip("mujoco")
    state = np.zeros((1, 5, 6), np.float32)
    state[0, :, 0] = np.arange(5)
    pose = np.tile(np.array([0.2, 0, 0.015, 1, 0, 0.2, 0.1], np.float32), (1, 5, 1))
    scenes = Scenes({STATE: state, POSE: pose}, np.array([0]), np.zeros((1, 1, 8, 6), np.float32))
    rollouts = replace(make_driven((4,), "so101"), scenes=scenes)
    path = tmp_path / "a.rrd"
    write_rerun(path, demos, semantics, [], [0], name="a", driven=[Driven(rollouts, scenes)])
    test_rerun_itself_finds_no_fault(path)
    cube = [chunk for chunk in read(path)["/rollouts/mlp_k04/state/start_007/cube"] if not chunk.is_static]
    corners = np.array(column(cube, "Mesh3D:vertex_positions"))
    assert corners.shape == (5, 24, 3)
    np.testing.assert_allclose(corners.mean(axis=(0, 1)), [0.2, 0, 0.015], atol=1e-6)


def test_two_observation_sets_are_told_apart(tmp_path, demos, semantics):
    predictions = [make_predictions(demos, [0], observations=name) for name in ("position", "pose")]
    write_rerun(tmp_path / "a.rrd", demos, semantics, predictions, [0], name="a")
    static = [chunk for chunk in read(tmp_path / "a.rrd")["/episode_007/error"] if chunk.is_static]
    assert column(static, "SeriesLines:names") == [["mlp_k04 (position)", "mlp_k04 (pose)"]]
    assert len(set(column(static, "SeriesLines:colors")[0])) == 2


def test_a_policy_keeps_its_colour_where_others_are_not_shown(tmp_path, demos, semantics):
    one = make_predictions(demos, [0], "mlp_k16", 16)
    write_rerun(tmp_path / "a.rrd", demos, semantics, [one], [0], name="a", everyone=["mlp_k01", "mlp_k04", "mlp_k16"])
    static = [chunk for chunk in read(tmp_path / "a.rrd")["/episode_007/error"] if chunk.is_static]
    red, green, blue = TRAINED[2].rgb_on_dark
    assert column(static, "SeriesLines:colors") == [[(red << 24) + (green << 16) + (blue << 8) + 255]]


def test_the_end_of_the_legend_is_what_is_hidden_at_first(tmp_path, demos, semantics):
    names = ["mean_action", "hold_still", "mlp_k04", "constant_velocity", "mlp_k01"]
    predictions = [make_predictions(demos, [0], name) for name in names]
    write_rerun(tmp_path / "a.rrd", demos, semantics, predictions, [0], name="a")
    static = [chunk for chunk in read(tmp_path / "a.rrd")["/episode_007/error"] if chunk.is_static]
    assert column(static, "SeriesLines:names") == [
        ["mlp_k04", "mlp_k01", "hold_still", "mean_action", "constant_velocity"]
    ]
    assert column(static, "SeriesLines:visible_series") == [[True, True, True, False, False]]


def test_any_name_of_a_column_becomes_one_entity(tmp_path, demos, semantics):
    names = ("left/arm joint.pos", NASTY)
    demos = replace(demos, features={key: replace(f, names=names) for key, f in demos.features.items()})
    write_rerun(tmp_path / "a.rrd", demos, semantics, [], [0], name=NASTY)
    assert len([entity for entity in read(tmp_path / "a.rrd") if entity.startswith("/episode_007/joints/")]) == 2
    same = replace(demos, features={key: replace(f, names=("m", "m")) for key, f in demos.features.items()})
    write_rerun(tmp_path / "b.rrd", same, semantics, [], [0], name="b")
    assert {"/episode_007/joints/m_0", "/episode_007/joints/m_1"} <= set(read(tmp_path / "b.rrd"))


def test_ten_episodes_and_eight_policies_are_quick_and_small(tmp_path):
    demos = make_demos(columns=6, lengths=(300,) * 10, fps=30.0)
    predictions = [make_predictions(demos, list(range(10)), f"mlp_k{k:02d}", k) for k in (1, 2, 4, 8, 16, 20, 24, 32)]
    started = time.perf_counter()
    write_rerun(tmp_path / "a.rrd", demos, make_semantics(demos), predictions, list(range(10)), name="a")
    assert time.perf_counter() - started < 10
    assert (tmp_path / "a.rrd").stat().st_size < 20e6


def test_a_failure_leaves_the_earlier_recording(recording, demos, semantics, predictions):
    before = recording.read_bytes()
    with pytest.raises(IndexError):
        write_rerun(recording, demos, semantics, predictions, [1, 99], name="small")
    assert recording.read_bytes() == before
    assert list(recording.parent.iterdir()) == [recording]


def test_a_folder_that_cannot_be_written_is_one_clear_message(tmp_path, demos, semantics):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StoreError, match=r"a\.rrd cannot be written: .*choose another folder"):
        write_rerun(tmp_path / "file" / "a.rrd", demos, semantics, [], [0], name="a")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="elsewhere a window would open")
def test_the_viewer_listens_on_this_machine_only_and_beside_what_has_its_port(recording, monkeypatch, capfd):
    """The real one, which listens before it looks for a screen and ends where there is none."""
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    for name, value in {"DISPLAY": ":9999", "RUST_LOG": "info", "NO_COLOR": "1"}.items():
        monkeypatch.setenv(name, value)
    with socket.socket() as taken:
        with suppress(OSError):  # where somebody else has it, it is taken too
            taken.bind(("127.0.0.1", RERUNS_PORT))
            taken.listen()
        ended = view(recording)
    said = capfd.readouterr().err
    host, port = re.search(r"Listening for gRPC connections on ([\d.]+):(\d+)", said).groups()
    assert host == "127.0.0.1"
    assert int(port) != RERUNS_PORT
    assert ended.returncode, "a viewer that could not open says so"


def test_viewing_what_is_not_there_says_what_to_do(tmp_path):
    with pytest.raises(StoreError, match=r"no recording at .*none\.rrd.*demobench run"):
        view(tmp_path / "none.rrd")


def test_a_viewer_that_is_not_installed_is_one_clear_message(recording, monkeypatch):
    monkeypatch.setattr(to_rerun, "VIEWER", "a_viewer_that_nobody_installed")
    with pytest.raises(StoreError, match=r"viewer is not installed here.*pip install rerun-sdk.*held_out\.rrd.*--save"):
        view(recording)


@pytest.mark.parametrize(("film", "options"), [(filmed_v2, WITHOUT), (filmed_v3, WITH_B_FRAMES), (with_pictures, None)])
def test_the_camera_at_time_t_shows_the_picture_of_the_frame_at_time_t(tmp_path, film, options):
    recording = tiny_recording(3, (13, 20, 9))
    folder = film(tmp_path / "set", recording, *([] if options is None else ["libx264", options]))
    demos = read_dataset(folder, name="set")
    demos = replace(demos, timestamps=demos.timestamps * 1.07)  # the data's clock is not the camera's
    left_out = write_rerun(tmp_path / "a.rrd", demos, resolve_semantics(demos), [], [1, 2], name="a")
    assert left_out == []
    entities = read(tmp_path / "a.rrd")
    for episode, frames in ((1, range(13, 33)), (2, range(33, 42))):
        chunks = entities[f"/episode_{episode:03d}/camera/{KEY}"]
        seconds = [t.total_seconds() for t in column(chunks, "time")]
        np.testing.assert_allclose(seconds, demos.timestamps[demos.episode(episode)], atol=1e-6)
        if options is None:
            assert [bytes(blob[0]) for blob in column(chunks, "EncodedImage:blob")] == [as_png(k) for k in frames]
            continue
        [mp4] = column([chunk for chunk in chunks if chunk.is_static], "AssetVideo:blob")
        due = [nanos[0] * 1e-9 for nanos in column(chunks, "VideoFrameReference:timestamp")]
        with av.open(io.BytesIO(bytes(mp4[0]))) as container:
            shown = {round(f.time, 3): number_of(f.to_ndarray(format="rgb24")) for f in container.decode(video=0)}
        assert [shown[round(second, 3)] for second in due] == list(frames)


def test_cameras_that_cannot_be_read_are_left_out_and_said_so(tmp_path):
    folder = filmed_v2(tmp_path / "set", tiny_recording(3, 12))
    write_mp4(folder / PATH_V2.format(episode_chunk=0, video_key=KEY, episode_index=1), range(5))
    demos, path = read_dataset(folder, name="set"), tmp_path / "a.rrd"
    semantics = resolve_semantics(demos)
    (why,) = write_rerun(path, demos, semantics, [], [0, 1, 2], name="a", most_bytes=1_000_000)
    assert "holds 5 pictures of episode 1, which has 12 frames" in why
    assert {e for e in read(path) if "/camera/" in e} == {f"/episode_{e:03d}/camera/{KEY}" for e in (0, 2)}
    assert episodes_in(path) == {0, 1, 2}
    shutil.rmtree(folder / "videos")
    absent = read_dataset(folder, name="set")
    (why,) = write_rerun(path, absent, semantics, [], [0, 2], name="a")
    assert "that meta/ declares are not in" in why


def test_a_recording_holds_as_many_cameras_as_it_may_be_large(tmp_path):
    folder = with_pictures(tmp_path / "set", tiny_recording(3, 40), noise)
    demos, path = read_dataset(folder, name="set"), tmp_path / "a.rrd"
    semantics = resolve_semantics(demos)
    one = sum(len(noise(number)) for number in range(40))
    most = round(1.5 * one) + 500_000
    left_out = write_rerun(path, demos, semantics, [], [0, 1, 2], name="a", most_bytes=most)
    words = "would make the recording too large; `demobench view` shows it"
    assert left_out == [f"camera '{KEY}': episode {number} {words}" for number in (1, 2)]
    assert {entity for entity in read(path) if "/camera/" in entity} == {f"/episode_000/camera/{KEY}"}
    assert one < path.stat().st_size < most
    assert write_rerun(path, demos, semantics, [], [0, 1, 2], name="a") == []
    assert path.stat().st_size > 3 * one


def noise(number: int) -> bytes:
    file = io.BytesIO()
    Image.fromarray(np.random.default_rng(number).integers(0, 256, (48, 64, 3), np.uint8)).save(file, "png")
    return file.getvalue()


def test_the_floor_lies_in_the_error_of_the_whole_episode(tmp_path, demos, semantics, predictions):
    write_rerun(tmp_path / "a.rrd", demos, semantics, predictions, [1], name="a", floors={"state": 3.25})
    chunks = read(tmp_path / "a.rrd")["/episode_008/error/floor"]
    assert column([chunk for chunk in chunks if chunk.is_static], "SeriesLines:names") == [["floor (state)"]]
    assert column(chunks, "Scalars:scalars") == [[3.25], [3.25]]
    seconds = [t.total_seconds() for t in column(chunks, "time")]
    np.testing.assert_allclose(seconds, demos.timestamps[demos.episode(1)][[0, -1]], atol=1e-6)


def test_diamonds_mark_the_largest_errors_of_trained_policies_over_all_they_were_asked(tmp_path, demos, semantics):
    one = make_predictions(demos, [1, 2])
    actions = one.actions.copy()
    actions[0, 10:13] += 100.0  # three of 56 answers
    far = [replace(one, actions=actions), make_predictions(demos, [1, 2], "hold_still", 11, off=20.0)]
    write_rerun(tmp_path / "a.rrd", demos, semantics, far, [1, 2], name="a")
    entities = read(tmp_path / "a.rrd")
    marked = np.array(column(entities["/episode_008/error/disagrees"], "Scalars:scalars"))
    assert marked.shape == (24, 1)
    assert np.flatnonzero(np.isfinite(marked[:, 0])).tolist() == [12, 13, 14]
    np.testing.assert_allclose(marked[12:15, 0], 105, atol=1e-3)
    assert "/episode_009/error/disagrees" not in entities
    static = [chunk for chunk in entities["/episode_008/error/disagrees"] if chunk.is_static]
    assert column(static, "SeriesPoints:names") == [["◆ a policy's largest 5%"]]


def test_an_so101_in_degrees_is_its_own_arm_and_one_in_other_units_is_not(tmp_path):
    pytest.importorskip("mujoco")
    demos = make_demos(columns=6, lengths=(20,), fps=30.0)
    state = np.zeros((20, 6), np.float32)
    state[:, 0] = np.arange(20)
    feature = {key: Feature(key, NAMES, UNITS) for key in (STATE, ACTION)}
    arm = replace(demos, columns={STATE: state, ACTION: state}, features=feature)
    semantics = make_semantics(arm)
    chunk = make_predictions(arm, [0], "mlp_k16", 16)
    write_rerun(tmp_path / "a.rrd", arm, semantics, [chunk], [0], name="a")
    test_rerun_itself_finds_no_fault(tmp_path / "a.rrd")
    entities = read(tmp_path / "a.rrd")
    jaw = entities["/episode_007/scene/arm/gripper"]
    places = np.array(column([c for c in jaw if not c.is_static], "Transform3D:translation"))[:, 0]
    radius = np.hypot(places[:, 0] - PAN_AXIS_X_M, places[:, 1])
    turned = np.degrees(np.arctan2(places[:, 1], places[:, 0] - PAN_AXIS_X_M))
    np.testing.assert_allclose(radius, radius[0], atol=1e-6)
    np.testing.assert_allclose(turned - turned[0], -np.arange(20), atol=0.01)
    strips = column(entities["/episode_007/scene/mlp_k16/state"], "LineStrips3D:strips")
    assert (len(strips), len(strips[0][0])) == (6, 9)  # ten times a second; from the fingertips through eight actions
    unknown = {key: Feature(key, NAMES, (None,) * 6) for key in (STATE, ACTION)}
    write_rerun(tmp_path / "b.rrd", replace(arm, features=unknown), semantics, [], [0], name="b")
    assert not [entity for entity in read(tmp_path / "b.rrd") if "/scene" in entity]


def test_pushts_block_lies_beside_the_path(tmp_path, demos, semantics):
    names = ("x_px", "y_px")
    features = {key: replace(f, names=names) for key, f in demos.features.items()}
    block = np.tile(np.array([100, 200, 0], np.float32), (demos.frames, 1))
    features[BLOCK] = Feature(BLOCK, ("block_x_px", "block_y_px", "block_angle_rad"), ("px", "px", "rad"))
    demos = replace(demos, features=features, columns=dict(demos.columns) | {BLOCK: block})
    write_rerun(tmp_path / "a.rrd", demos, semantics, [], [0], name="a")
    entities = read(tmp_path / "a.rrd")
    moved = [chunk for chunk in entities["/episode_007/path/block"] if not chunk.is_static]
    corners = np.array(column(moved, "LineStrips2D:strips"))
    assert len(corners) == 30
    assert [corners[0, 0, :, axis].min() for axis in (0, 1)] == [40, 200]
    assert "/episode_007/path/goal" in entities


@pytest.mark.parametrize("name", ["pusht_image", "cr5_banana"])
def test_real_recordings_with_their_cameras(tmp_path, shared_data, name):
    demos = read_dataset(shared_data / name, name=name)
    assert write_rerun(tmp_path / "a.rrd", demos, resolve_semantics(demos), [], [0, 1], name=name) == []
    test_rerun_itself_finds_no_fault(tmp_path / "a.rrd")
    entities = read(tmp_path / "a.rrd")
    for episode in (0, 1):
        (chunks,) = [entities[e] for e in entities if e.startswith(f"/episode_{episode:03d}/camera/")]
        seconds = [t.total_seconds() for t in column(chunks, "time")]
        np.testing.assert_allclose(seconds, demos.timestamps[demos.episode(episode)], atol=1e-6)
        due = [nanos[0] for nanos in column(chunks, "VideoFrameReference:timestamp")]
        assert due == [due[0] + 100_000_000 * k for k in range(len(seconds))], "the camera's clock is even"


def test_joints_have_the_chunk_ahead_of_the_cursor_beside_what_came(tmp_path):
    demos = make_demos(columns=3, lengths=(30,))
    one = make_predictions(demos, [0], chunk=4, off=0.0)
    write_rerun(tmp_path / "a.rrd", demos, make_semantics(demos, "velocity"), [one], [0], name="a")
    entities = read(tmp_path / "a.rrd")
    recorded = column([c for c in entities["/episode_007/ahead/recorded"] if not c.is_static], "LineStrips2D:strips")
    chunks = column([c for c in entities["/episode_007/ahead/mlp_k04/state"] if not c.is_static], "LineStrips2D:strips")
    assert (len(recorded), len(chunks), len(recorded[0]), len(recorded[0][0])) == (30, 28, 3, 4)
    np.testing.assert_allclose(chunks[:-3], recorded[2:-3], atol=1e-5)  # it predicts what then came, in every lane
    action = demos.columns[ACTION]
    lane = np.array([[line[0][1] for line in frame] for frame in recorded])
    expected = np.arange(3) + 0.8 * (1 - (action - action.min(axis=0)) / np.ptp(action, axis=0))
    np.testing.assert_allclose(lane, expected, atol=1e-5)
    assert [len(line) for line in recorded[-1]] == [1, 1, 1]
    names = column([c for c in entities["/episode_007/ahead/names"] if c.is_static], "Points2D:labels")
    assert names == [["x (px)", "y (px)", "z (px)"]]
    seconds = column([c for c in entities["/episode_007/ahead/seconds"] if c.is_static], "Points2D:labels")
    assert seconds == [["now", "+0.15 s", "+0.30 s"]]
    assert not [entity for entity in entities if "/path" in entity]

"""Videos of roll-outs are decoded again and looked at."""

from dataclasses import replace
from itertools import pairwise

import av
import numpy as np
import pytest
from PIL import Image

from pipeline.errors import NotApplicableError
from pipeline.sinks import rollout_video
from pipeline.sinks.palette import FAILURE, SUCCESS
from pipeline.sinks.rollout_video import HOLD_S, SPEED, Video, count_frames, write_video

from .driving import make_driven, make_scenes


def write(folder, rollouts=None, name="a") -> Video:
    rollouts = rollouts or make_driven()
    return write_video(folder / f"{name}.mp4", folder / f"{name}.png", rollouts, rollouts.scenes)


def decoded(path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def has_colour(picture: np.ndarray, colour: str, least: int = 30) -> bool:
    wanted = np.array(list(bytes.fromhex(colour[1:])))
    return int((np.abs(picture.astype(int) - wanted).max(axis=-1) < 30).sum()) >= least


def test_it_is_h264_for_every_browser_with_every_frame_at_its_time(tmp_path):
    video = write(tmp_path)
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert stream.average_rate == 10 * SPEED == video.fps
        assert (stream.width, stream.height) == (video.width, video.height)
        times = [frame.time for frame in container.decode(stream)]
    assert video.frames == len(times) == count_frames(tmp_path / "a.mp4") == 13 + HOLD_S * video.fps
    np.testing.assert_allclose(np.diff(times), 1 / video.fps, atol=1e-4)
    assert video.width % 2 == video.height % 2 == 0
    content = (tmp_path / "a.mp4").read_bytes()
    assert content.index(b"moov") < content.index(b"mdat"), "it plays before all of it is there"


def test_frames_differ_until_the_end_is_held(tmp_path):
    write(tmp_path)
    frames = decoded(tmp_path / "a.mp4")
    moving = [np.abs(a.astype(int) - b).max() for a, b in pairwise(frames[:13])]
    assert min(moving) > 60
    assert np.abs(frames[13].astype(int) - frames[-1]).mean() < 0.5
    poster = np.asarray(Image.open(tmp_path / "a.png").convert("RGB")).astype(int)
    assert np.abs(poster - frames[-1]).mean() < 4


def test_an_episode_that_is_over_stands_still_and_says_how_it_ended(tmp_path):
    video = write(tmp_path)
    frames = decoded(tmp_path / "a.mp4")
    half = video.width // 2
    second = [frame[: video.height // 2, half:] for frame in frames]  # the panel that fails at frame 6
    assert not has_colour(second[5], FAILURE.light)
    assert has_colour(second[6], FAILURE.light)
    assert np.abs(second[7].astype(int) - second[11]).mean() < 0.5
    first = [frame[: video.height // 2, :half] for frame in frames]
    assert not has_colour(first[9], SUCCESS.light, 300)
    assert has_colour(first[10], SUCCESS.light, 300)


def test_the_plan_is_drawn_ahead_of_the_finger_and_gone_at_the_end(tmp_path):
    write(tmp_path, make_driven((8,)))
    frames = decoded(tmp_path / "a.mp4")
    # Below the block, where nothing else is orange; the codec washes colours of thin lines out.
    orange = [frame[frame.shape[0] * 2 // 3 :].astype(int) for frame in frames]
    orange = [int((part[..., 0] - part[..., 2] > 60).sum()) for part in orange]
    assert min(orange[:7]) > 8
    assert orange[-1] == 0


def test_the_number_of_the_start_state_is_in_the_picture_and_in_the_caption(tmp_path):
    rollouts = make_driven((8,))
    video = write(tmp_path, rollouts)
    write(tmp_path, replace(rollouts, start_states=np.array([8])), "b")
    first, other = decoded(tmp_path / "a.mp4")[0].astype(int), decoded(tmp_path / "b.mp4")[0].astype(int)
    changed = np.argwhere(np.abs(first - other).max(axis=-1) > 60)
    assert len(changed)
    assert changed[:, 0].max() < 45, "nothing but the words differs"
    assert "from start states 7 of pusht: 1 of 1 end on target" in video.caption
    assert f"{SPEED} times as fast" in video.caption


def test_the_same_roll_outs_give_the_same_bytes(tmp_path):
    write(tmp_path)
    write(tmp_path, name="b")
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_a_simulator_that_nobody_drew_has_no_video(tmp_path):
    assert write(tmp_path, make_driven(simulator="line")) is None
    assert list(tmp_path.iterdir()) == []


def test_what_is_known_of_a_video_survives_json(tmp_path):
    video = write(tmp_path, make_driven((3,)))
    assert Video.of(video.summary() | {"file": "a.mp4"}) == video


def test_without_an_encoder_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(rollout_video, "ENCODER", "libx264_that_is_not_there")
    with pytest.raises(NotApplicableError, match=r"has no encoder libx264_that.*pip install"):
        write(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("count", [1, 2, 4, 8])
def test_panels_lie_side_by_side_in_whole_blocks(tmp_path, count):
    scenes = make_scenes((2,) * count)
    video = write(tmp_path, replace(make_driven((2,) * count), scenes=scenes))
    assert (video.width % 64, video.height % 16) == (0, 0)
    assert video.width <= 1024
    assert len(video.start_states) == count

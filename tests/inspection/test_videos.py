"""Frames of small real video files against what meta/ lists."""

from pathlib import Path

import av
import numpy as np
import pytest

from pipeline.inspection.look import inspect
from pipeline.inspection.videos import check_videos, local_folder
from pipeline.lerobot_format.quality import resolve_semantics
from pipeline.lerobot_format.read import read_dataset
from tests.makers import edit_info, tiny_recording, write_v2

KEY = "observation.images.top"
FRAMES, FPS = 30, 10


def write_video(path: Path, frames: int, *, size: tuple[int, int] = (48, 64), rate: int = FPS) -> None:
    """Grey pictures, height × width."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=rate)
        stream.height, stream.width, stream.pix_fmt = *size, "yuv420p"
        for number in range(frames):
            picture = np.full((*size, 3), (8 * number) % 256, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


def video(folder: Path, episode: int) -> Path:
    return folder / f"videos/chunk-000/{KEY}/episode_{episode:06d}.mp4"


@pytest.fixture
def folder(tmp_path) -> Path:
    """Four episodes of thirty frames, each with its video."""
    folder = write_v2(tmp_path / "set", tiny_recording(4, FRAMES, fps=float(FPS)))
    declared = {"dtype": "video", "shape": [48, 64, 3], "names": ["height", "width", "channels"]}
    edit_info(folder, lambda info: info["features"].update({KEY: declared}))
    path = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
    edit_info(folder, lambda info: info.update(video_path=path))
    for episode in range(4):
        write_video(video(folder, episode), FRAMES)
    return folder


def said(folder: Path) -> list:
    return list(check_videos(read_dataset(folder, name="set"), folder))


def test_videos_that_hold_their_frames_are_fine(folder):
    assert said(folder) == []


@pytest.mark.parametrize("frames", [29, 31])
def test_one_frame_more_or_less_is_the_encoders(folder, frames):
    write_video(video(folder, 2), frames)
    assert said(folder) == []


@pytest.mark.parametrize("frames", [20, 40])
def test_a_video_with_other_frames_than_its_episode_is_found(folder, frames):
    write_video(video(folder, 2), frames)
    (finding,) = said(folder)
    assert (finding.episode, finding.column, finding.value, finding.limit) == (2, KEY, frames, FRAMES)
    assert f"holds {frames} frames, its episode in meta/ 30" in finding.words


def test_another_size_and_another_rate_are_found(folder):
    write_video(video(folder, 1), FRAMES, size=(32, 32))
    write_video(video(folder, 3), FRAMES, rate=30)
    words = " ".join(finding.words for finding in said(folder))
    assert "32×32, meta/info.json says 64×48" in words
    assert "runs at 30 frames a second, the data at 10" in words


def test_what_is_no_video_is_one_finding(folder):
    video(folder, 0).write_bytes(b"no video at all")
    (finding,) = said(folder)
    assert finding.episode == 0
    assert "cannot be opened as a video" in finding.words


def test_the_inspection_has_them_too_and_without_a_folder_says_that_it_did_not_look(folder):
    write_video(video(folder, 2), 20)
    demos = read_dataset(folder, name="set")
    meaning = resolve_semantics(demos)
    inspection = inspect(demos, meaning, folder)
    assert [finding.episode for finding in inspection.findings if finding.check == "video"] == [2]
    assert not inspection.verdict("video")[0]
    without = inspect(demos, meaning)
    assert not [finding for finding in without.findings if finding.check == "video"]
    assert "not looked at" in without.verdict("video")[1]


def test_where_the_files_lie(tmp_path):
    (tmp_path / "tape").mkdir()
    assert local_folder("tape", tmp_path) == tmp_path / "tape"
    assert local_folder("hub:somebody/tape", tmp_path) is None
    assert local_folder("tape.tar.gz", tmp_path) is None
    assert (local_folder("embedded:pusht_sim", tmp_path) / "meta/info.json").is_file()

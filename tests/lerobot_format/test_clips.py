"""Every picture says its own number, so that what a decoder shows is held against the frame it should belong to."""

import io
from itertools import islice
from pathlib import Path

import av
import numpy as np
import pytest

from pipeline.errors import DatasetError
from pipeline.lerobot_format.clips import Clip, Footage, Stills, Stream
from pipeline.lerobot_format.read import read_dataset
from pipeline.types import STATE
from tests.filming import (
    AS_LEROBOT,
    KEY,
    PATH_V2,
    WITH_B_FRAMES,
    WITHOUT,
    as_png,
    decoded,
    filmed_v2,
    filmed_v3,
    numbers_in_mp4,
    numbers_in_packets,
    pusher,
    with_pictures,
    write_mp4,
)
from tests.makers import edit_table, tiny_recording

RECORDING = tiny_recording(3, (13, 20, 9))


def footage(folder: Path) -> Footage:
    demos = read_dataset(folder, name="set")
    return Footage(demos, demos.cameras[0])


def frames_of(position: int) -> list[int]:
    frames = RECORDING.slices()[position]
    return list(range(frames.start, frames.stop))


def video(folder: Path, episode: int) -> Path:
    return folder / PATH_V2.format(episode_chunk=0, video_key=KEY, episode_index=episode)


@pytest.mark.parametrize("film", [filmed_v2, filmed_v3])
@pytest.mark.parametrize(
    ("encoder", "options", "codec"),
    [
        ("libx264", WITHOUT, "h264"),
        ("libx264", WITH_B_FRAMES, "h264"),
        ("libsvtav1", AS_LEROBOT, "av1"),
        ("libx265", {"x265-params": "bframes=0:keyint=5:log-level=none"}, "h265"),
        ("libvpx-vp9", {"lag-in-frames": "0", "g": "5"}, "vp9"),
        ("mpeg4", {"g": "5"}, "h264"),
    ],
)
def test_the_picture_of_frame_i_is_picture_i(tmp_path, film, encoder, options, codec):
    pictures = footage(film(tmp_path / "set", RECORDING, encoder, options))
    for position in (0, 1, 2):
        stream = pictures.stream(position)
        assert isinstance(stream, Stream)
        assert stream.codec == ("h264" if stream.encoded_anew else codec)
        assert numbers_in_packets(stream.codec, stream.packets) == frames_of(position)
        clip = pictures.clip(position)
        assert isinstance(clip, Clip)
        shown = numbers_in_mp4(clip.mp4)
        assert [shown[place] for place in clip.frames] == frames_of(position)


def test_packets_are_the_data_sets_own_where_nothing_refers_to_later_pictures(tmp_path):
    own = footage(filmed_v2(tmp_path / "a", RECORDING, "libsvtav1", AS_LEROBOT)).stream(0)
    assert own.encoded_anew == ""
    assert own.packets[3].removeprefix(b"\x12\x00") in video(tmp_path / "a", 0).read_bytes()
    later = footage(filmed_v2(tmp_path / "b", RECORDING, "libx264", WITH_B_FRAMES)).stream(0)
    assert later.encoded_anew == "its pictures refer to later ones"
    middle = footage(filmed_v3(tmp_path / "c", RECORDING, "libx264", WITHOUT))
    assert [middle.stream(position).encoded_anew for position in (0, 1)] == [
        "",
        "the episode begins between key frames",
    ]
    other = footage(filmed_v2(tmp_path / "d", RECORDING, "mpeg4", {"g": "5"})).stream(0)
    assert other.encoded_anew == "messages do not carry mpeg4"


def test_pictures_in_the_data_files_are_taken_as_they_are(tmp_path):
    kept = footage(with_pictures(tmp_path / "set", RECORDING)).stream(1)
    assert kept == Stills("png", tuple(as_png(number) for number in frames_of(1)))


def test_pictures_lie_in_the_order_of_the_frames_whatever_that_of_the_rows(tmp_path):
    folder = with_pictures(tmp_path / "set", RECORDING)
    rows = np.random.default_rng(0).permutation(20)
    edit_table(folder / "data/chunk-000/episode_000001.parquet", lambda table: table.take(rows))
    assert footage(folder).clip(1).pictures == tuple(as_png(number) for number in frames_of(1))


@pytest.mark.parametrize("count", [19, 21])
def test_one_picture_more_or_less_is_the_encoders(tmp_path, count):
    folder = filmed_v2(tmp_path / "set", RECORDING)
    write_mp4(video(folder, 1), range(13, 13 + count))
    pictures = footage(folder)
    assert numbers_in_packets("h264", pictures.stream(1).packets) == frames_of(1)[:count]
    assert len(pictures.clip(1).frames) == min(count, 20)


@pytest.mark.parametrize("count", [12, 25])
def test_a_video_of_another_length_is_refused_with_both_numbers(tmp_path, count):
    folder = filmed_v2(tmp_path / "set", RECORDING)
    write_mp4(video(folder, 1), range(count))
    with pytest.raises(
        DatasetError, match=rf"holds {count} pictures of episode 1, which has 20 frames.*exclude = \[1\]"
    ):
        footage(folder).stream(1)
    assert footage(folder).clip(0)


def test_a_video_that_is_missing_damaged_or_not_a_folders_is_one_clear_message(tmp_path):
    folder = filmed_v2(tmp_path / "set", RECORDING)
    pictures = footage(folder)
    video(folder, 2).write_bytes(b"no video at all")
    with pytest.raises(DatasetError, match=r"episode_000002\.mp4 cannot be read as a video .*Copy the data set again"):
        pictures.clip(2)
    video(folder, 0).unlink()
    with pytest.raises(DatasetError, match=r"that meta/ declares are not in .*Copy the folder videos/ too"):
        footage(folder).clip(1)


def test_fewer_pictures_in_the_data_files_than_frames(tmp_path):
    folder = with_pictures(tmp_path / "set", RECORDING)
    path = folder / "data/chunk-000/episode_000001.parquet"

    def lose(table):
        kept = table[KEY].to_pylist()
        return table.set_column(table.column_names.index(KEY), KEY, [[*kept[:-2], None, None]])

    edit_table(path, lose)
    with pytest.raises(DatasetError, match=f"episode 1 has 20 frames, and 18 pictures of '{KEY}'"):
        footage(folder).clip(1)


@pytest.mark.parametrize("position", [0, 150])
def test_real_pushers_stand_in_picture_t_where_the_state_of_frame_t_says(shared_data, position):
    demos = read_dataset(shared_data / "pusht_image", name="pusht_image")
    pictures, state = Footage(demos, demos.cameras[0]), demos.columns[STATE][demos.episode(position)]
    stream, clip = pictures.stream(position), pictures.clip(position)
    assert stream.encoded_anew == "its pictures refer to later ones"
    with av.open(io.BytesIO(clip.mp4)) as container:
        whole = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    for shown in (decoded("h264", stream.packets), [whole[place] for place in clip.frames]):
        assert len(shown) == len(state)
        seen = np.array([pusher(picture) for picture in shown]) * 512 / 96
        away = [np.nanmedian(np.linalg.norm(np.roll(seen, lag, axis=0) - state, axis=1)) for lag in (-1, 0, 1)]
        assert away[1] == min(away) < 4, f"px away, a frame late, in step, a frame early: {away}"


def test_real_av1_is_streamed_and_cut_bit_for_bit(shared_data):
    demos = read_dataset(shared_data / "cr5_banana", name="cr5_banana")
    stream = Footage(demos, demos.cameras[0]).stream(3)
    assert (stream.codec, stream.encoded_anew, len(stream.packets)) == ("av1", "", demos.lengths[3])
    path = shared_data / "cr5_banana" / PATH_V2.format(episode_chunk=0, video_key=KEY, episode_index=3)
    with av.open(str(path)) as container:
        own = [frame.to_ndarray(format="rgb24") for frame in islice(container.decode(video=0), 12)]
    np.testing.assert_array_equal(decoded("av1", stream.packets[:12]), own)

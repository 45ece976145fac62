"""Real recordings as files: what a decoder shows at time t is the picture of the frame that is at t, in Rerun and in MCAP."""

import io
from pathlib import Path

import av
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rerun.chunk import RrdReader

from pipeline.lerobot_format.quality import resolve_semantics
from pipeline.lerobot_format.read import read_dataset
from pipeline.sinks.to_mcap import write_mcap
from pipeline.sinks.to_rerun import write_rerun
from tests.filming import KEY, PATH_V2, decoded, pusher

EPISODE = 1


def in_rerun(path: Path) -> tuple[list[float], list[np.ndarray], np.ndarray]:
    """Seconds from the first and picture of each frame, and the recorded actions [n, A] of the same file."""
    pictures, actions = [], []
    for chunk in RrdReader(path).stream():
        table = chunk.to_record_batch()
        names = {name.split(":")[-1]: table[name].to_pylist() for name in table.schema.names}
        if "/camera/" in chunk.entity_path and "blob" in names:
            with av.open(io.BytesIO(bytes(names["blob"][0][0]))) as container:
                at = {round(1e9 * f.time): f.to_ndarray(format="rgb24") for f in container.decode(video=0)}
        elif "/camera/" in chunk.entity_path and "time" in names:
            pictures += zip([t.total_seconds() for t in names["time"]], names["timestamp"], strict=True)
        elif "/joints/" in chunk.entity_path and "scalars" in names:
            actions.append((chunk.entity_path, [row[-1] for row in names["scalars"]]))
    nearest = np.array(sorted(at))
    shown = [at[int(nearest[np.abs(nearest - due[0]).argmin()])] for _, due in sorted(pictures)]
    seconds = [second for second, _ in sorted(pictures)]
    return [second - seconds[0] for second in seconds], shown, np.array([values for _, values in sorted(actions)]).T


def in_mcap(path: Path, codec: str) -> tuple[list[float], list[np.ndarray], np.ndarray]:
    """The same of an MCAP file; actions are those with the stamp of the picture."""
    found: dict[str, list] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, record, message in reader.iter_decoded_messages():
            found.setdefault(channel.topic.split("/")[1], []).append((record.log_time, message))
    times, packets = zip(*[(time, bytes(message.data)) for time, message in found["camera"]], strict=True)
    commands = {time: list(m.position) or list(m.velocity) for time, m in found["joint_commands"]}
    seconds = [1e-9 * (time - times[0]) for time in times]
    return seconds, decoded(codec, packets), np.array([commands[time] for time in times])


@pytest.fixture(params=["rerun", "mcap"])
def written(request, shared_data, tmp_path):
    """A function: the name and codec of a data set → its demonstrations, and what one file of an episode shows."""

    def write(name: str, codec: str):
        demos = read_dataset(shared_data / name, name=name)
        path, semantics = tmp_path / f"a.{request.param}", resolve_semantics(demos)
        if request.param == "rerun":
            assert write_rerun(path, demos, semantics, [], [EPISODE], name=name) == []
            return demos, in_rerun(path)
        assert write_mcap(path, demos, semantics, [], [EPISODE], metadata={}).left_out == []
        return demos, in_mcap(path, codec)

    return write


def test_a_real_pusher_stands_in_the_picture_at_time_t_where_the_state_of_frame_t_says(written):
    demos, (seconds, shown, actions) = written("pusht_image", "h264")
    state = demos.columns["observation.state"][demos.episode(EPISODE)]
    clock = demos.timestamps[demos.episode(EPISODE)]
    np.testing.assert_allclose(seconds, clock - clock[0], atol=1e-6)
    assert len(shown) == len(actions) == len(state)
    np.testing.assert_allclose(actions, demos.columns["action"][demos.episode(EPISODE)], atol=1e-3)
    seen = np.array([pusher(picture) for picture in shown]) * 512 / 96
    away = [np.nanmedian(np.linalg.norm(np.roll(seen, lag, axis=0) - state, axis=1)) for lag in (-1, 0, 1)]
    assert away[1] == min(away) < 4, f"px away, a frame late, in step, a frame early: {away}"


def test_a_real_arms_pictures_are_those_of_its_own_file_on_its_uneven_clock(written, shared_data):
    demos, (seconds, shown, _) = written("cr5_banana", "av1")
    own = shared_data / "cr5_banana" / PATH_V2.format(episode_chunk=0, video_key=KEY, episode_index=EPISODE)
    clock = demos.timestamps[demos.episode(EPISODE)]
    np.testing.assert_allclose(seconds, clock - clock[0], atol=1e-6)
    assert np.ptp(np.diff(seconds)) > 0.05, "it is uneven"
    with av.open(str(own)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(shown) == demos.lengths[EPISODE]
    assert [bool(np.array_equal(a, b)) for a, b in zip(shown, frames, strict=True)] == [True] * len(shown)

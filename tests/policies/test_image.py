"""The policy that looks at a camera: it learns what only pictures show, and owes what every method owes."""

import av
import numpy as np
import pytest

from pipeline.errors import DatasetError, NotApplicableError, PolicyError
from pipeline.lerobot_format.pictures import pictures_of
from pipeline.lerobot_format.read import read_dataset
from pipeline.policies import Plan
from pipeline.policies.image import Image
from pipeline.train import load_trained, save_trained, train_policy
from pipeline.types import ACTION, STATE, Observations
from pipeline.windows import make_windows
from tests.hand_made import STATE_ONLY, random_walks, semantics
from tests.makers import Recording, edit_info, write_v2

KEY, PIXELS, FRAMES, EPISODES = "observation.image", 32, 30, 4
SMALL = {"pixels": 16, "width": 32, "blocks": 1, "batch": 16, "warmup": 5}


def write_square(path, centres) -> None:
    """A bright square whose middle is at (across, down), 0 … 1, on a dark picture."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=10, options={"qscale": "2"})
        stream.height, stream.width, stream.pix_fmt = PIXELS, PIXELS, "yuv420p"
        for across, down in centres:
            picture = np.zeros((PIXELS, PIXELS, 3), np.uint8)
            x, y = (int(4 + place * (PIXELS - 8)) for place in (across, down))
            picture[y - 4 : y + 4, x - 4 : x + 4] = (200, 60, 20)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


def film(place):
    """A data set in which the action is where the square is, and the state says nothing."""
    generator = np.random.default_rng(0)
    centres = generator.uniform(size=(EPISODES, FRAMES, 2))
    flat = centres.reshape(-1, 2).astype(np.float32)
    features = {
        STATE: (("a", "b"), generator.normal(size=flat.shape).astype(np.float32), "float32"),
        ACTION: (("x", "y"), flat, "float32"),
    }
    recording = Recording(10.0, features, (FRAMES,) * EPISODES, ("push",) * EPISODES)
    folder = write_v2(place / "set", recording)
    declared = {"dtype": "video", "shape": [PIXELS, PIXELS, 3], "names": ["height", "width", "channels"]}
    edit_info(folder, lambda info: info["features"].update({KEY: declared}))
    path = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
    edit_info(folder, lambda info: info.update(video_path=path))
    for episode in range(EPISODES):
        write_square(folder / f"videos/chunk-000/{KEY}/episode_{episode:06d}.mp4", centres[episode])
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return film(tmp_path_factory.mktemp("filmed"))


def lay(demos, episodes=range(EPISODES), chunk=1):
    settings = {"statistics_episodes": episodes, "protocol": "strict", "history": 1, "chunk": chunk}
    meaning = semantics(demos, kinds=("other", "other"), state_column=(None, None))
    return make_windows(demos, meaning, STATE_ONLY, episodes, **settings)


@pytest.fixture
def windows(folder):
    return lay(read_dataset(folder, name="filmed"))


def train(windows, steps=8, seeds=(0, 3), **more):
    return train_policy("image", windows, seeds=seeds, steps=steps, settings=SMALL | more.pop("settings", {}), **more)


def test_pictures_are_those_of_the_frames_whatever_is_asked_first(windows):
    pictures = pictures_of(windows.demos, None, PIXELS)
    asked = np.array([[95, 3], [31, 30]])
    found = pictures(asked)
    assert found.shape == (2, 2, PIXELS, PIXELS, 3)
    for frame, picture in zip(asked.ravel(), found.reshape(-1, PIXELS, PIXELS, 3), strict=True):
        bright = np.argwhere(picture[..., 0] > 120)
        middle = (bright.mean(axis=0)[::-1] - 3.5) / (PIXELS - 8)
        np.testing.assert_allclose(middle, windows.demos.columns[ACTION][frame], atol=0.05)
        assert picture[..., 0].max() > picture[..., 2].max() + 60


def test_it_learns_what_only_the_pictures_show(windows):
    policy = train(windows, 300, (0,), settings={"learning_rate": 3e-3}).policy
    error = np.abs(policy.predict(windows.observations())[0] - windows.targets()[0]).mean()
    assert error < 0.08 < 0.2 < np.abs(windows.targets()[0] - 0.5).mean()


def test_it_loads_to_the_same_predictions_and_does_not_depend_on_its_batch(windows, tmp_path):
    trained, seen = train(windows), windows.observations()
    save_trained(trained, tmp_path)
    together = trained.policy.predict(seen)
    np.testing.assert_array_equal(load_trained(tmp_path).policy.predict(seen), together)
    order = np.random.default_rng(0).permutation(len(together[0]))
    np.testing.assert_allclose(
        trained.policy.predict(windows.observations(order)), together[:, order], rtol=1e-4, atol=1e-5
    )
    alone = trained.policy.predict(windows.observations(slice(40, 41)))
    np.testing.assert_allclose(alone[:, 0], together[:, 40], rtol=1e-4, atol=1e-5)


def test_a_killed_training_goes_on_to_the_same_bytes(windows, tmp_path):
    def stop(done, steps, loss):
        if done == 3:
            raise KeyboardInterrupt

    more = {"checkpoint": tmp_path / "checkpoint.safetensors", "checkpoint_every_s": 0.0, "settings": SMALL}
    with pytest.raises(KeyboardInterrupt):
        Image.fit(windows, Plan((0,), 8, **more, on_step=stop))
    resumed, _ = Image.fit(windows, Plan((0,), 8, **more))
    for name, array in train(windows, 8, (0,)).policy.arrays().items():
        np.testing.assert_array_equal(resumed.arrays()[name], array)


def test_where_nothing_can_be_looked_at_it_is_not_applicable(windows):
    seen = windows.observations(slice(0, 2))
    with pytest.raises(NotApplicableError, match="it sees a camera"):
        train(windows).policy.predict(Observations(seen.values, seen.state, seen.previous_action))


def test_a_camera_that_is_absent_is_one_message(folder, windows):
    with pytest.raises(PolicyError, match="the data set 'hand_made' has none"):
        train(lay(random_walks((30,) * 4)))
    with pytest.raises(PolicyError, match=r"no camera 'observation.imag'\. Did you mean 'observation.image'"):
        train(windows, settings={"camera": "observation.imag"})
    away = folder / "videos"
    away.rename(folder / "elsewhere")
    try:
        with pytest.raises(PolicyError, match="videos of the camera 'observation.image' are not in"):
            train(lay(read_dataset(folder, name="filmed")), settings={"pixels": 17})
    finally:
        (folder / "elsewhere").rename(away)


def test_a_video_that_is_too_short_is_one_message(folder, tmp_path):
    import shutil

    copy = shutil.copytree(folder, tmp_path / "short")
    write_square(copy / f"videos/chunk-000/{KEY}/episode_000002.mp4", np.full((5, 2), 0.5))
    with pytest.raises(DatasetError, match="holds 5 frames from 0.0 s on, and episode 2 has 30"):
        train(lay(read_dataset(copy, name="short")))
    (copy / f"videos/chunk-000/{KEY}/episode_000001.mp4").write_bytes(b"not a video")
    with pytest.raises(DatasetError, match="episode_000001.mp4 cannot be decoded"):
        train(lay(read_dataset(copy, name="short"), (1,)), settings={"pixels": 18})


def test_pictures_of_many_episodes_in_one_file(shared_data):
    """The last frame of one episode and the first of the next, found by time: the agent's blue dot is where the state says."""
    demos = read_dataset(shared_data / "pusht_image", name="pusht")
    pictures = pictures_of(demos, None, 96)
    frames = np.array(
        [demos.episode_starts[7], demos.episode_starts[8] - 1, demos.episode_starts[8], demos.episode_starts[150]]
    )
    for frame, picture in zip(frames, pictures(frames).astype(int), strict=True):
        blue = np.argwhere((picture[..., 2] - picture[..., 0] > 80) & (picture[..., 2] > 150))
        middle = (blue.mean(axis=0)[::-1] + 0.5) / 96 * 512
        np.testing.assert_allclose(middle, demos.columns[STATE][frame], atol=8)

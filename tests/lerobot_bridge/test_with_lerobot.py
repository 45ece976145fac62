"""LeRobot reads what is written here, and its checkpoints are asked as LeRobot would ask them. Slow: LeRobot is started."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from pipeline.errors import PolicyError
from pipeline.lerobot_bridge import CheckpointFacts, predict_with_lerobot
from pipeline.types import ACTION, STATE
from tests.lerobot_bridge.conftest import LENGTHS, TRAINED_ON, Run
from tests.lerobot_format.hub_server import running_hub
from tests.makers import tiny_recording, write_v2, write_v3

pytestmark = pytest.mark.slow
BESIDE = Path(__file__).with_name("beside_lerobot.py")
Anchors = Sequence[tuple[int, int]]


def write_anchors(path: Path, anchors: Anchors) -> Path:
    episodes, frames = zip(*anchors, strict=True)
    pq.write_table(
        pa.table({"episode_index": pa.array(episodes, pa.int64()), "frame_index": pa.array(frames, pa.int64())}), path
    )
    return path


EVERY: Anchors = [(episode, frame) for episode, length in enumerate(LENGTHS) for frame in range(length)]


@pytest.fixture
def predict(lerobot_python: Path, tmp_path: Path) -> Callable[..., tuple[CheckpointFacts, np.ndarray]]:
    """Facts, and actions [anchors, K, A] in the order of the anchors."""

    def ask(checkpoint: Path, dataset: Path, anchors: Anchors, **options) -> tuple[CheckpointFacts, np.ndarray]:
        asked = write_anchors(tmp_path / "anchors.parquet", anchors)
        facts = predict_with_lerobot(checkpoint, lerobot_python, dataset, asked, tmp_path / "out/p.parquet", **options)
        table = pq.read_table(tmp_path / "out/p.parquet")
        assert [p.name for p in (tmp_path / "out").iterdir()] == ["p.parquet"]
        rows = table.to_pydict()
        assert list(zip(rows["episode_index"], rows["frame_index"], strict=True)) == list(anchors)
        return facts, np.array(rows["action"])

    return ask


def test_lerobot_reads_what_the_writer_writes(run_lerobot: Run, tmp_path: Path) -> None:
    recording = tiny_recording(5, (20, 13, 31, 8, 25), joints=3)
    folder = write_v3(tmp_path / "set", recording, episodes_per_file=2)
    run_lerobot(BESIDE, "read", folder, tmp_path / "read.npz")
    with np.load(tmp_path / "read.npz") as read:
        facts = json.loads(str(read["facts"]))
        assert (facts["fps"], facts["episodes"], facts["frames"]) == (10, 5, 97)
        for key in (ACTION, STATE, "next.done"):
            values = recording.features[key][1]
            np.testing.assert_array_equal(read[key].reshape(values.shape), values)
            np.testing.assert_allclose(np.ravel(facts["stats"][key]["mean"]), values.mean(0), atol=1e-6)
        ends = np.cumsum(recording.lengths)
        np.testing.assert_array_equal(read["bounds"], np.stack([ends - recording.lengths, ends], 1))
        np.testing.assert_array_equal(read["episode_index"], np.repeat(np.arange(5), recording.lengths))
        seconds = np.concatenate([np.arange(n) / 10 for n in recording.lengths])
        np.testing.assert_allclose(read["timestamp"], seconds, atol=1e-6)
        assert read["task"].tolist() == np.repeat(recording.tasks, recording.lengths).tolist()
        assert read["of_two"].tolist() == [[1, f] for f in range(13)] + [[3, f] for f in range(8)]


def test_act_predicts_as_lerobot_does(
    act: Path, small: Path, predict: Callable, run_lerobot: Run, tmp_path: Path
) -> None:
    seen: list[tuple[int, int]] = []
    facts, actions = predict(act, small / "copy", EVERY, seed=3, on_progress=lambda *counts: seen.append(counts))
    assert actions.shape == (sum(LENGTHS), 5, 3)
    assert np.isfinite(actions).all()
    assert seen[-1] == (len(EVERY), len(EVERY))
    assert (facts.policy_type, facts.chunk, facts.trained_on) == ("act", 5, TRAINED_ON)
    assert facts.trained_dataset == {"repo_id": "made/small", "root": str(small / "copy")}
    some = [(2, 0), (4, 27)]
    model = act / "checkpoints/last/pretrained_model"
    run_lerobot(BESIDE, "online", model, small / "copy", "2:0,4:27", tmp_path / "own.npz")
    with np.load(tmp_path / "own.npz") as own:
        np.testing.assert_allclose(actions[[EVERY.index(anchor) for anchor in some]], own["actions"], atol=2e-5)


def test_a_copied_feature_is_read_from_its_column(act: Path, small: Path, predict: Callable, tmp_path: Path) -> None:
    """On the data set as recorded, in v2.1 as well, the checkpoint answers as on the copy it was trained on."""
    some = [(4, 3), (0, 0)]
    _, on_copy = predict(act, small / "copy", some)
    facts, as_recorded = predict(act, small / "recorded", some)
    assert facts.observations == (STATE, STATE)
    np.testing.assert_array_equal(on_copy, as_recorded)
    older = write_v2(tmp_path / "v2", tiny_recording(len(LENGTHS), LENGTHS, joints=3))
    np.testing.assert_array_equal(predict(act, older, some)[1], on_copy)


def test_diffusion_sees_two_frames(
    diffusion: Path, small: Path, predict: Callable, run_lerobot: Run, tmp_path: Path
) -> None:
    """The first anchor is an episode's first frame, where the past is padded."""
    some = [(2, 0), (4, 17)]
    facts, actions = predict(diffusion, small / "copy", some, seed=0)
    assert (facts.policy_type, facts.chunk, facts.steps_seen) == ("diffusion", 4, 2)
    model = diffusion / "checkpoints/last/pretrained_model"
    run_lerobot(BESIDE, "loader", model, small / "copy", "2:0,4:17", tmp_path / "own.npz")
    with np.load(tmp_path / "own.npz") as own:
        np.testing.assert_allclose(actions, own["actions"], atol=2e-5)


def train_on_pusht(run_lerobot: Run, folder: Path, run: Path, policy: str, *options: str) -> Path:
    """One step of LeRobot's trainer on two episodes with pictures; gives the run's folder."""
    fixed = {
        "dataset.repo_id": "made/pusht", "dataset.root": folder, "dataset.episodes": "[0, 2]",
        "dataset.use_imagenet_stats": "false", "policy.type": policy, "policy.device": "cpu", "policy.push_to_hub": "false",
        "policy.chunk_size": 4, "policy.n_action_steps": 4, "num_workers": 0, "persistent_workers": "false",
        "batch_size": 2, "steps": 1, "env_eval_freq": 0, "output_dir": run,
    }  # fmt: skip
    words = [f"--{name}={value}" for name, value in fixed.items()] + [f"--policy.{option}" for option in options]
    run_lerobot("-m", "lerobot.scripts.lerobot_train", *words)
    return run


def test_act_with_a_camera(shared_data: Path, run_lerobot: Run, predict: Callable, tmp_path: Path) -> None:
    folder = shared_data / "pusht_image"
    small = ("dim_model=16", "n_heads=2", "dim_feedforward=32", "pretrained_backbone_weights=null")
    run = train_on_pusht(run_lerobot, folder, tmp_path / "run", "act", *small)
    facts, actions = predict(run, folder, [(1, 0), (7, 40)])
    assert set(facts.observations) == {STATE, "observation.environment_state", "observation.image"}
    run_lerobot(BESIDE, "loader", run / "checkpoints/last/pretrained_model", folder, "1:0,7:40", tmp_path / "own.npz")
    with np.load(tmp_path / "own.npz") as own:
        np.testing.assert_allclose(actions, own["actions"], rtol=1e-5, atol=1e-3)
    with pytest.raises(PolicyError, match=r"needs the camera observation.image, and its video .* is not there"):
        predict(run, _without_videos(folder, tmp_path / "blind"), [(1, 0)])


def test_smolvla_reads_the_task(shared_data: Path, run_lerobot: Run, predict: Callable, tmp_path: Path) -> None:
    """With a language model of eleven words in the place of its own."""
    folder, language = shared_data / "pusht_image", tmp_path / "language"
    if "yes" not in run_lerobot(
        "-c", "import importlib.util as i; print('yes' if i.find_spec('transformers') else 'no')"
    ):
        pytest.skip("this LeRobot environment has no transformers: pip install 'lerobot[smolvla]==0.6.1'")
    run_lerobot(Path(__file__).with_name("tiny_vlm.py"), language)
    small = (
        f"vlm_model_name={language}",
        "num_vlm_layers=2",
        "resize_imgs_with_padding=[64,64]",
        "tokenizer_max_length=8",
    )
    run = train_on_pusht(
        run_lerobot, folder, tmp_path / "run", "smolvla", *small, "num_steps=2", "expert_width_multiplier=0.5"
    )
    facts, actions = predict(run, folder, [(1, 0), (7, 40)])
    assert (facts.policy_type, facts.observations) == ("smolvla", (STATE, "observation.image"))
    run_lerobot(BESIDE, "loader", run / "checkpoints/last/pretrained_model", folder, "1:0,7:40", tmp_path / "own.npz")
    with np.load(tmp_path / "own.npz") as own:
        np.testing.assert_allclose(actions, own["actions"], rtol=1e-5, atol=1e-3)


def _without_videos(folder: Path, copy: Path) -> Path:
    shutil.copytree(folder, copy, ignore=shutil.ignore_patterns("videos"))
    return copy


def test_interrupted_it_leaves_nothing(act: Path, small: Path, lerobot_python: Path, tmp_path: Path) -> None:
    def interrupt(done: int, total: int) -> None:
        raise KeyboardInterrupt

    anchors, out = write_anchors(tmp_path / "a.parquet", EVERY), tmp_path / "out/p.parquet"
    with pytest.raises(KeyboardInterrupt):
        predict_with_lerobot(act, lerobot_python, small / "copy", anchors, out, on_progress=interrupt)
    assert list(out.parent.iterdir()) == []


def test_no_train_config_is_unknown_and_weights_must_be_whole(
    act: Path, small: Path, predict: Callable, tmp_path: Path
) -> None:
    checkpoint = tmp_path / "checkpoint"
    shutil.copytree(act / "checkpoints/last/pretrained_model", checkpoint)
    (checkpoint / "train_config.json").unlink()
    assert predict(checkpoint, small / "copy", [(0, 0)])[0].trained_on == "unknown"
    shutil.copy(
        checkpoint / "policy_postprocessor_step_0_unnormalizer_processor.safetensors", checkpoint / "model.safetensors"
    )
    with pytest.raises(PolicyError, match=r"lacks \d+ of the policy's weights"):
        predict(checkpoint, small / "copy", [(0, 0)])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"joints": 2}, r"trained with observation.state of shape \(3,\), and here it has \(2,\)"),
        (
            {"features": {"observation.state": "observation.stat"}},
            r"needs observation.stat, .* Did you mean observation.state\?",
        ),
        ({"features": {"nonsense": "action"}}, r"has no feature nonsense; it sees observation.state"),
        ({"anchor": (0, 1000)}, r"episode 0, frame 1000 is not in .*: 30 frames there"),
        ({"anchor": (99, 0)}, r"holds none of the 1 episodes"),
    ],
)
def test_what_does_not_fit(act: Path, predict: Callable, tmp_path: Path, change: dict, words: str) -> None:
    """Needs LeRobot only to know what the checkpoint asks for."""
    recording = tiny_recording(len(LENGTHS), LENGTHS, joints=change.get("joints", 3))
    folder = write_v3(tmp_path / "set", recording)
    with pytest.raises(PolicyError, match=words):
        predict(act, folder, [change.get("anchor", (0, 0))], features=change.get("features"))


def test_scored_in_one_command_with_the_checkpoint_and_the_data_set_on_the_hub(
    act: Path, small: Path, lerobot_python: Path, tmp_path: Path
) -> None:
    """As a user meets it; then from a .zip of the data set and the run's folder: the same row."""
    with running_hub() as hub:
        commit = hub.push("me/act_small", act / "checkpoints/last/pretrained_model")
        hub.push("me/small", small / "recorded")
        environment = {name: value for name, value in os.environ.items() if name != "HF_HUB_OFFLINE"}
        environment |= {
            "HF_ENDPOINT": hub.url,
            "HF_HOME": str(tmp_path / "hub"),
            "XDG_CACHE_HOME": str(tmp_path / "cache"),
        }

        def score(dataset: str, checkpoint: str, *options: str) -> dict:
            words = ["score", dataset, "--lerobot", checkpoint, "--lerobot-python", str(lerobot_python), "--json", "-"]
            command = [sys.executable, "-m", "demobench.cli", *words, *options]
            done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
            assert done.returncode == 0, done.stderr[-3000:]
            assert "Traceback" not in done.stderr
            (row,) = [row for row in json.loads(done.stdout)[0]["policies"] if row["method"] == "external"]
            return row | {"said": " ".join(done.stderr.split())}

        (tmp_path / "demobench.toml").write_text("[benchmark]\nfolds = 3\n")
        copied = ("--lerobot-feature", "observation.environment_state=observation.state")
        row = score("hub:me/small@main", "hub:me/act_small@main", *copied)
    assert row["policy"] == "act_small"
    assert f"hub:me/act_small@main: commit {commit}" in row["said"]
    assert row["episodes"] == sorted(set(range(len(LENGTHS))) - set(TRAINED_ON))
    assert row["chunk"] == 5
    shutil.make_archive(str(tmp_path / "small"), "zip", small, "recorded")
    again = score("small.zip", str(act), "--name", "act_small", *copied)
    assert again["error_by_horizon"] == row["error_by_horizon"]

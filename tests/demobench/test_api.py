"""demobench from Python: the documentation's example, and the same numbers as from the command line."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import demobench
from pipeline.errors import ConfigError
from tests.demobench.test_cli import QUICK
from tests.demobench.test_cli import demobench as command
from tests.makers import tiny_recording, write_v3

DOCS = Path(__file__).parents[2] / "docs/python.md"


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("api")
    write_v3(place / "so101_pick_place_tape", tiny_recording(episodes=8, frames=50))
    return place


@pytest.fixture
def data(place, monkeypatch):
    monkeypatch.chdir(place)
    return demobench.read("so101_pick_place_tape", seeds=1, steps=4, folds=1)


def test_the_documented_example_runs(place):
    code = re.search(r"```python\n(.*?)```", DOCS.read_text(), re.DOTALL)[1]
    quick = code.replace("seeds=5, steps=3000", "seeds=1, steps=3").replace("path/to/", "")
    assert quick != code
    ran = subprocess.run(
        [sys.executable, "-W", "error", "-c", quick], cwd=place, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr
    assert "8 episodes, 5 folds" in ran.stdout
    assert len(re.findall(r"^mlp_k\d\d  ", ran.stdout, re.MULTILINE)) == 4
    assert ran.stdout.count(" against ") == 6


def test_numbers_are_those_of_the_command_line(data, place):
    ran = command("run", "so101_pick_place_tape", *QUICK, "--json", "out.json", cwd=place)
    assert ran.returncode == 0, ran.stderr
    (found,) = json.loads((place / "out.json").read_text())
    rows = {row["policy"]: row for row in found["policies"]}
    mlp, still = demobench.predict(data, "mlp", chunk=1), demobench.predict(data, "hold_still")
    for name, predictions in (("mlp_k01", mlp), ("hold_still", still)):
        metrics = demobench.score(data, predictions).metrics
        for metric in ("first_step_mae", "vs_hold_still", "error_by_horizon"):
            np.testing.assert_allclose(metrics[metric], rows[name][metric], rtol=1e-6)
    assert found["split"]["hash"] == demobench.split(data).hash


def test_a_policy_is_given_what_the_configuration_gives(data):
    plain = demobench.predict(data, "mlp", chunk=2, settings={"width": 8})
    relative = demobench.predict(data, "mlp", chunk=2, settings={"width": 8}, actions="relative", steps=9, history=1)
    assert plain.actions.shape == relative.actions.shape
    assert not np.array_equal(plain.actions, relative.actions)
    with pytest.raises(ConfigError, match="unknown key 'action' in .*Did you mean 'actions'"):
        demobench.predict(data, "mlp", chunk=2, action="relative")


def test_compare_says_the_words(data):
    still, mean = demobench.predict(data, "hold_still"), demobench.predict(data, "mean_action")
    (found,) = demobench.compare(data, still, mean)
    assert (found.a, found.b, found.metric) == ("hold_still/state", "mean_action/state", "first_step_mae")
    assert found.word == "cannot tell"  # two held-out episodes
    assert "needs at least 5" in found.words


def test_windows_are_those_that_train(data):
    fold = demobench.split(data).folds[0]
    windows = demobench.windows(data, fold.train, chunk=3)
    actions, mask = windows.targets()
    assert windows.observations().values.shape == (6 * 48, 3, 2)
    assert actions.shape == (6 * 48, 3, 2)
    assert mask.sum() == 6 * (48 * 3 - 3)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"sedes": 3}, "knows no setting 'sedes'. Did you mean 'seeds'"),
        ({"protocol": "lenient"}, "protocol: Input should be 'strict' or 'notebook'"),
    ],
)
def test_settings_are_checked(place, monkeypatch, settings, words):
    monkeypatch.chdir(place)
    with pytest.raises(ConfigError, match=words):
        demobench.read("so101_pick_place_tape", **settings)


def test_names_are_checked(data):
    with pytest.raises(ConfigError, match="No method 'mpl'. Did you mean 'mlp'"):
        demobench.predict(data, "mpl")
    with pytest.raises(ConfigError, match="has no observation set 'pose'"):
        demobench.floor(data, observations="pose")


def test_settings_of_the_data_set_count(place, monkeypatch):
    monkeypatch.chdir(place)
    sets = {"still": ("observation.state",), "moving": {"features": ("observation.state",), "history": 2}}
    data = demobench.read("so101_pick_place_tape", observations=sets, kind="other", budget="quick")
    assert (data.experiment.steps, data.semantics.kinds) == (600, ("other", "other"))
    assert demobench.windows(data, [0], observations="moving").observations().values.shape[1] == 2


def test_a_file_of_predictions_is_scored_and_compared_like_our_own(data, tmp_path):
    """Hold-still's answers, sent as a file, are hold-still."""
    still = demobench.predict(data, "hold_still")
    episodes = data.demos.episode_of_frame[still.anchors]
    rows = {
        "episode_index": data.demos.episode_ids[episodes],
        "frame_index": data.demos.frame_in_episode[still.anchors],
        "action": still.actions[0, :, :4].tolist(),
    }
    pq.write_table(pa.table(rows), tmp_path / "mine.parquet")
    (tmp_path / "trained.json").write_text(json.dumps([int(e) for e in demobench.split(data).folds[0].train]))
    mine = demobench.score(data, tmp_path / "mine.parquet", trained_on=tmp_path / "trained.json")
    assert (mine.address, mine.seen) == ("mine/elsewhere", False)
    assert mine.metrics["first_step_mae"] == pytest.approx(demobench.score(data, still).metrics["first_step_mae"])
    (found,) = demobench.compare(data, mine, still)
    assert (found.word, found.words) == ("cannot tell", "the two predict the same")

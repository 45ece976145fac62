"""`demobench split` and `demobench score` as a user meets them."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from demobench.cli import app
from pipeline.errors import DemobenchError
from pipeline.external.reading import read_answers
from pipeline.predict import load_predictions
from tests.demobench.test_cli import demobench
from tests.makers import tiny_demonstrations, tiny_recording, write_v3

DOCS = Path(__file__).resolve().parents[2] / "docs" / "scoring.md"
CONFIG = """
[benchmark]
seeds = 2
folds = 4
steps = 4
threads = 1
[datasets.tape]
source = "tape"
champion = "mlp_k04"
[policies.mlp]
method = "mlp"
chunks = [4]
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """A benchmark that was run, and its policy's predictions as a file."""
    place = tmp_path_factory.mktemp("user")
    write_v3(place / "tape", tiny_recording(episodes=12, frames=30))
    (place / "demobench.toml").write_text(CONFIG)
    out = demobench("run", "tape", "--json", "run.json", cwd=place)
    assert out.returncode == 0, out.stderr
    export(place, "ours.parquet")
    return place


def export(place: Path, name: str, *, episodes=None, change=lambda values: values) -> Path:
    """Our own policy's predictions, as anybody would send them."""
    p = load_predictions(place / "results/datasets/tape/mlp_k04/predictions/state")
    episode, frame = np.divmod(p.anchors, 30)
    rows = {
        "episode_index": np.tile(episode, 2),
        "frame_index": np.tile(frame, 2),
        "seed": np.repeat([0, 1], len(episode)),
    }
    actions = change(np.asarray(p.actions)).reshape(-1, *p.actions.shape[2:])
    table = pa.table({**rows, "action": actions.tolist()})
    if episodes is not None:
        table = table.filter(pa.array(np.isin(rows["episode_index"], episodes)))
    pq.write_table(table, place / name)
    return place / name


def rows_of(place: Path, file: str) -> dict:
    (table,) = json.loads((place / file).read_text())
    return {row["policy"]: row for row in table["policies"]}


@pytest.fixture(scope="module")
def unused(tmp_path_factory) -> Path:
    """A data set that was never benchmarked, a good file of predictions and one with its columns swapped."""
    place = tmp_path_factory.mktemp("unused")
    write_v3(place / "tape", tiny_recording(episodes=12, frames=30))
    (place / "demobench.toml").write_text(CONFIG)
    recorded = tiny_demonstrations(12, 30).columns["action"]
    noisy = recorded + 0.1 * np.random.default_rng(0).normal(size=recorded.shape)
    frames = {"episode_index": np.arange(360) // 30, "frame_index": np.arange(360) % 30}
    for name, actions in (("ours", noisy), ("swapped", noisy[:, ::-1])):
        pq.write_table(pa.table({**frames, "action": actions[:, None].tolist()}), place / f"{name}.parquet")
    return place


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["absent.parquet"], ["cannot be read: No such file"]),
        (["ours.parquet", "--remove", "x"], ["PREDICTIONS and --remove are different things"]),
        (["ours.parquet", "--name", "hold_still"], ["'hold_still' is a policy of 'tape'"]),
        (["ours.parquet", "--name", "../x"], ["../x"]),
        (["ours.parquet", "--observations", "stat"], ["no observation set 'stat'", "Did you mean 'state'"]),
        (["ours.parquet", "--trained-on", "none.json"], ["none.json, named by --trained-on, cannot be read"]),
        (["--remove", "our"], ["Nothing was scored under the name 'our'"]),
        (["--lerobot", "tape"], ["--lerobot-python PATH", "go together"]),
        (["--lerobot", "runs/act", "--lerobot-python", "python"], ["runs/act is no folder", "on the Hub write hub:runs/act."]),
        (["--lerobot", "hub:act", "--lerobot-python", "python"], ["'hub:act' does not name a checkpoint on the Hub"]),
        (["--lerobot", "tape", "--lerobot-python", sys.executable], ["has no LeRobot", "python3.12 -m venv"]),
        (["--lerobot", "tape", "--lerobot-python", "x", "--lerobot-feature", "state"], ["takes CHECKPOINTS_NAME=DATA_SETS_NAME"]),
        (["--lerobot", "tape", "--lerobot-python", "x", "--lerobot-feature", "a=actoin"], ["Did you mean 'action'"]),
        (["--write-anchors", "a.parquet", "--fold", "4"], ["There is no fold 4", "4 folds, 0 to 3"]),
        (["--write-anchors", "none/a.parquet"], ["cannot be written to none/a.parquet: No such file or directory. Name a"]),
        (["ours.parquet", "--fold", "1"], ["--fold says which anchors"]),
        (["swapped.parquet"], ["swapped.parquet: action columns are permuted: joint_0 holds joint_1"]),
    ],
)  # fmt: skip
def test_a_mistake_is_one_message_before_any_work(unused, monkeypatch, words, expected):
    monkeypatch.chdir(unused)
    found = CliRunner().invoke(app, ["score", "tape", *words])
    assert isinstance(found.exception, DemobenchError), found.output
    for expectation in expected:
        assert expectation in str(found.exception)
    assert not list(unused.rglob("made.json"))
    assert not list(unused.rglob("*.draft*"))


def test_anchors_are_written_for_all_episodes_or_a_fold(unused, monkeypatch):
    monkeypatch.chdir(unused)
    out = CliRunner().invoke(app, ["score", "tape", "--write-anchors", "all.parquet"]).output
    assert "336 anchors of 12 episodes" in " ".join(out.split())
    out = CliRunner().invoke(app, ["score", "tape", "--write-anchors", "one.parquet", "--fold", "1"]).output
    assert "84 anchors of 3 episodes" in " ".join(out.split())
    assert set(pq.read_table("one.parquet")["fold"].to_pylist()) == {1}
    assert "Nothing was scored yet" in CliRunner().invoke(app, ["score", "tape"]).output


def test_the_documented_example_fills_the_anchors(unused, monkeypatch):
    """The page's own code, in the page's own words: what it writes can be read."""
    monkeypatch.chdir(unused)
    CliRunner().invoke(app, ["score", "tape", "--write-anchors", "anchors.parquet"])
    (code,) = re.findall(r"```python\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.DOTALL)
    assert sum(bool(line.strip()) for line in code.splitlines()) <= 10, "an example that is read at a glance"
    exec(code.replace("path/to/", ""), {})
    answers = read_answers(unused / "my_act.parquet", tiny_demonstrations(12, 30), 3)
    assert len(answers.covered) == 3
    assert answers.actions.shape[3:] == (16, 2)


@pytest.fixture(scope="module")
def split(place) -> dict:
    for words in (["--out", "split.json"], ["--fold", "1", "--out", "fold1.json"]):
        out = demobench("split", "tape", "--format", "json", *words, cwd=place)
        assert out.returncode == 0, out.stderr
    return json.loads((place / "split.json").read_text())


@pytest.fixture(scope="module")
def scored(place, split) -> subprocess.CompletedProcess:
    words = ["ours.parquet", "--trained-on", "split.json", "--observations", "state", "--json", "out.json"]
    return demobench("score", "tape", *words, cwd=place)


@pytest.mark.slow
def test_our_own_predictions_sent_as_a_file_are_our_own_row(place, scored):
    assert scored.returncode == 0, scored.stderr
    assert "→ ours" in scored.stdout
    rows = rows_of(place, "out.json")
    ours, sent = rows["mlp_k04"], rows["ours"]
    for key in ("first_step_mae", "first_step_rmse", "at_one_second_mae", "whole_chunk_mae", "error_by_horizon",
                "hold_still_by_horizon", "error_by_joint", "vs_hold_still", "scaled", "interval", "above_floor",
                "ensembled_first_step_mae", "windows_test", "seeds"):  # fmt: skip
        assert sent[key] == ours[key], key
    assert sent["verdict"] == ours["verdict"] | {
        "vs_champion": "cannot tell", "vs_champion_at_one_second": sent["verdict"]["vs_champion_at_one_second"]
    }  # fmt: skip
    assert (sent["method"], sent["params"], sent["latency_ms"], sent["train_s"]) == ("external", None, None, 0)
    assert (sent["observations"], sent["seen_in_training"]) == ("state", False)
    (table,) = json.loads((place / "out.json").read_text())
    (pair,) = [c for c in table["comparisons"] if c["a"] == "ours/state" and c["b"] == "mlp_k04/state"]
    assert (pair["difference"], pair["words"]) == (0.0, "the two predict the same")


@pytest.mark.slow
def test_it_makes_what_was_missing_and_nothing_again(place, scored):
    made = {
        line.split()[-3] for line in scored.stderr.splitlines() + scored.stdout.splitlines() if line.startswith("[")
    }
    assert made == {"scored_predictions", "benchmark_table", "benchmark_report", "mcap_log", "rerun_recording"}
    words = ["ours.parquet", "--trained-on", "split.json", "--observations", "state"]
    again = demobench("score", "tape", *words, cwd=place)
    assert "is up to date: nothing to compute" in again.stdout
    assert "is up to date: nothing to compute" in demobench("run", "tape", cwd=place).stdout


@pytest.mark.slow
def test_it_is_compared_viewed_and_listed_like_any_policy(place, scored):
    out = demobench("compare", "tape/ours", "tape/hold_still", "--json", "-", cwd=place)
    assert out.returncode == 0, out.stderr
    found = json.loads(out.stdout)["comparisons"][0]
    assert found["a"] == "tape/ours/state"
    assert found["word"] in ("better", "worse", "cannot tell")
    out = demobench("view", "tape", "0", "--policy", "ours", "--save", "episode.rrd", cwd=place)
    assert out.returncode == 0, out.stderr
    assert "ours: 12 episodes that it was not trained on" in demobench("score", "tape", cwd=place).stdout
    page = (place / "results/datasets/tape/benchmark_report/report.html").read_text()
    assert "ours" in page
    assert "predicted elsewhere" in page


@pytest.mark.slow
def test_only_what_was_not_trained_on_counts(place, scored, split):
    train, test = split["folds"][1]["train"], split["folds"][1]["test"]
    export(place, "some.parquet", episodes=[*test, train[0]])
    out = demobench("score", "tape", "some.parquet", "--trained-on", "fold1.json", "--json", "some.json", cwd=place)
    row = rows_of(place, "some.json")["some"]
    assert row["episodes"] == test
    assert row["seen_in_training"] is False
    assert row["verdict"]["vs_hold_still"] == "cannot tell"
    assert "needs at least 5 episodes that both hold out; there are 3" in " ".join(out.stdout.split())
    assert "1 more were predicted but trained on, and are left out" in " ".join(out.stdout.split())


@pytest.mark.slow
def test_seen_in_training_has_no_verdict_and_can_be_taken_out_again(place, scored):
    (place / "all.json").write_text(json.dumps({"dataset": {"repo_id": "me/tape", "episodes": None}}))
    words = ["--name", "seen", "--trained-on", "all.json", "--observations", "state", "--json", "seen.json"]
    out = demobench("score", "tape", "ours.parquet", *words, cwd=place)
    assert "seen (seen in training)" in out.stdout
    row = rows_of(place, "seen.json")["seen"]
    assert row["seen_in_training"] is True
    assert set(row["verdict"].values()) == {None}
    assert row["above_floor"] == []
    (table,) = json.loads((place / "seen.json").read_text())
    assert "seen/state" not in {b["upper_policy"] for b in table["brackets"]}
    out = demobench("compare", "tape/seen", "tape/hold_still", cwd=place)
    assert "not comparable" in out.stdout
    out = demobench("score", "tape", "--remove", "seen", "--json", "-", cwd=place)
    assert "seen" not in {row["policy"] for row in json.loads(out.stdout)[0]["policies"]}
    assert not (place / "results/datasets/tape/scored_predictions/seen").exists()
    assert demobench("score", "tape", "--remove", "seen", cwd=place).returncode == 2


@pytest.mark.slow
def test_the_documented_example_runs(place, scored):
    """The page's own code fills the anchors that the command writes; without --trained-on nothing is known."""
    folder = place / "doc"
    folder.mkdir()
    out = demobench("score", "tape", "--write-anchors", folder / "anchors.parquet", cwd=place)
    assert "336 anchors of 12 episodes" in out.stdout
    (code,) = re.findall(r"```python\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.DOTALL)
    assert sum(bool(line.strip()) for line in code.splitlines()) <= 10, "an example that is read at a glance"
    code = code.replace("path/to/tape", str(place / "tape"))
    subprocess.run([sys.executable, "-c", code], cwd=folder, check=True, timeout=60)
    out = demobench("score", "tape", folder / "my_act.parquet", "--json", "act.json", cwd=place)
    assert out.returncode == 0, out.stderr
    row = rows_of(place, "act.json")["my_act"]
    assert row["seen_in_training"] is None
    assert row["observations"] == "elsewhere"
    assert row["error_by_horizon"] == pytest.approx(row["hold_still_by_horizon"]), "it reached the observations"
    assert "nothing is known about the episodes it was trained on" in " ".join(out.stdout.split())
    (table,) = json.loads((place / "act.json").read_text())
    words = [c["words"] for c in table["comparisons"] if c["a"] == "my_act/elsewhere"]
    assert all("nothing is known about the episodes it was trained on" in w for w in words)


@pytest.mark.slow
def test_a_row_of_other_data_leaves_the_table_with_a_word(place, scored):
    """The data set changes: what was scored on it before no longer counts, and the run says so."""
    other = place / "other"
    other.mkdir()
    shutil.copytree(place / "tape", other / "tape")
    (other / "demobench.toml").write_text(
        CONFIG.replace('champion = "mlp_k04"\n', "").replace("chunks = [4]", "chunks = [1]\nonly_when_named = true")
    )
    shutil.copy(place / "ours.parquet", other)
    assert demobench("score", "tape", "ours.parquet", cwd=other).returncode == 0
    shutil.rmtree(other / "tape")
    write_v3(other / "tape", tiny_recording(episodes=12, frames=30, seed=9))
    out = demobench("run", "tape", "--json", "run.json", cwd=other)
    assert out.returncode == 0, out.stderr
    assert "'ours', predicted elsewhere, is not in the table" in " ".join(out.stdout.split())
    assert "ours" not in rows_of(other, "run.json")

"""`demobench split`: the folds that a benchmark uses, for people, for trainers and for `score --trained-on`."""

import json
import re

import pytest
from typer.testing import CliRunner

from demobench.cli import app
from pipeline.config import load_config
from pipeline.errors import ConfigError, StoreError
from pipeline.experiment import Choices, resolve_target
from pipeline.folds import split_of
from pipeline.lerobot_format.read import read_dataset
from tests.makers import tiny_recording, write_v3


@pytest.fixture
def tape(tmp_path, monkeypatch):
    """A data set in the working directory, and the folds that `run` gives it."""
    monkeypatch.chdir(tmp_path)
    write_v3(tmp_path / "tape", tiny_recording(episodes=12, frames=30))
    target = resolve_target("./tape", load_config(None), tmp_path, Choices(), {})
    return split_of(target.experiment, read_dataset(tmp_path / "tape", name="tape"))


def ask(*words: str) -> str:
    found = CliRunner().invoke(app, ["split", "./tape", *words], env={"COLUMNS": "160"})
    if found.exception:
        raise found.exception
    return found.output


def test_the_folds_are_those_of_a_benchmark(tape):
    found = json.loads(ask("--json", "-"))
    assert [fold["test"] for fold in found["folds"]] == [list(fold.test) for fold in tape.folds]
    assert [fold["train"] for fold in found["folds"]] == [list(fold.train) for fold in tape.folds]
    assert (found["dataset"], found["split_hash"], found["fold"]) == ("tape", tape.hash, None)
    assert json.loads(ask("--format", "json")) == found
    assert json.loads(ask("--json", "-", "--fold", "2"))["fold"] == 2
    assert len(json.loads(ask("--json", "-", "--folds", "1"))["folds"]) == 1


def test_people_see_what_is_held_out(tape):
    text = ask()
    assert "tape  5 folds" in text
    for fold in tape.folds:
        assert f"{len(fold.test)}: {', '.join(map(str, fold.test))}" in text
    one = ask("--fold", "3")
    assert ", ".join(map(str, tape.folds[3].test)) in one
    assert ", ".join(map(str, tape.folds[2].test)) not in one


def test_lerobots_trainer_takes_the_training_episodes(tape):
    out = ask("--format", "lerobot", "--fold", "1")
    (line,) = [line for line in out.splitlines() if not line.startswith("#")]
    found = re.fullmatch(r'--dataset\.episodes="(\[[\d,]+\])"', line)
    assert json.loads(found[1]) == list(tape.folds[1].train)
    assert f"({len(tape.folds[1].test)}): {list(tape.folds[1].test)}" in out
    assert "The other folds: --fold 1 to 4" in ask("--format", "lerobot")


def test_it_is_written_whole_or_not_at_all(tape, tmp_path):
    assert "Written to fold1.json" in ask("--format", "json", "--fold", "1", "--out", "fold1.json")
    assert json.loads((tmp_path / "fold1.json").read_text())["fold"] == 1
    ask("--out", "folds.txt")
    assert "5 folds" in (tmp_path / "folds.txt").read_text()
    with pytest.raises(StoreError, match="cannot be written to none/x"):
        ask("--out", "none/x")
    assert not list(tmp_path.glob(".*draft*"))


def test_a_fold_that_is_not_there(tape):
    with pytest.raises(ConfigError, match="There is no fold 5: 'tape' is split into 5 folds, 0 to 4"):
        ask("--fold", "5")

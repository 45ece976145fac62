"""`demobench success` as a user meets it."""

import json
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from demobench.cli import app
from pipeline.errors import ConfigError, DatasetError

PAIRED = "policy,start,success,stage\n" + "".join(
    f"{p},{s},{int((p == 'new') != (s == 'c'))},{2 if p == 'new' else 1}\n"
    for p in ("new", "old")
    for s in "abcdefghij"
)


def run(*words: str, width: str = "160"):
    return CliRunner(env={"COLUMNS": width, "NO_COLOR": "1"}).invoke(app, ["success", *words])


def test_two_counts():
    out = run("18/20", "16/20")
    assert out.exit_code == 0, out.output
    for words in (
        "68.3 – 98.8 %",
        "69.9 – 97.2 %",
        "Boschloo",
        "conservative",
        "cannot tell",
        "about 200 trials of each",
    ):
        assert words in " ".join(out.stdout.split())


def test_one_count_says_what_it_pins_down():
    out = run("18/20")
    assert "20 trials, so the rate is known to about ± 15 points: it lies between 68 and 99 %" in " ".join(
        out.stdout.split()
    )
    assert "give two to compare them" in out.stdout
    assert "Comparisons" not in out.stdout


def test_equal_counts_keep_their_own_names():
    out = run("5/5", "5/5", "--json", "-")
    found = json.loads(out.stdout)
    assert [row["policy"] for row in found["policies"]] == ["5/5 (1)", "5/5 (2)"]


def test_json_holds_what_is_printed(tmp_path):
    target = tmp_path / "out.json"
    out = run("18/20", "9/20", "--json", str(target))
    found = json.loads(target.read_text())
    assert set(found) == {"policies", "comparisons", "stages"}
    assert set(found["policies"][0]) == {
        "policy", "successes", "trials", "rate", "clopper_pearson", "wilson", "words",
    }  # fmt: skip
    (pair,) = found["comparisons"]
    assert (pair["word"], pair["test"], pair["units"], pair["n"]) == ("better", "Boschloo", "trials", [20, 20])
    assert pair["words"] in " ".join(out.stdout.split())


def test_a_file_of_trials(tmp_path):
    path = tmp_path / "trials.csv"
    path.write_text(PAIRED)
    out = run(str(path))
    assert out.exit_code == 0, out.output
    for words in ("McNemar", "10 start states", "mean stage", "new against old"):
        assert words in " ".join(out.stdout.split())
    found = json.loads(run(str(path), "--json", "-").stdout)
    assert found["comparisons"][0]["p"] == pytest.approx(2 * 11 / 2**10)
    assert found["comparisons"][0]["word"] == "better"
    assert found["stages"][1]["reached"] == {"1": 10, "2": 0}


def test_names_are_printed_as_they_are(tmp_path):
    path = tmp_path / "trials.csv"
    path.write_text(PAIRED.replace("old", "[red]old[/]"))
    assert "[red]old[/]" in run(str(path)).stdout


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["18-20"], ["'18-20' is not a count", "Did you mean 18/20?"]),
        (["18", "of", "20"], ["'18' is neither a count nor a file"]),
        (["18 of 20"], ["Did you mean 18/20?"]),
        (["-3/20"], ["'-3/20' has a negative number"]),
        (["3/-20"], ["negative number"]),
        (["20/18"], ["20 successes in 18 trials", "Did you mean 18/20?"]),
        (["0/0"], ["no trials"]),
        (["18/20", "none.csv"], ["'none.csv' is neither a count nor a file that exists"]),
        (["18/20", __file__], ["is a file among counts"]),
        (["1.5/20"], ["neither a count"]),
        (["18/20", "--jsn"], ["There is no option '--jsn'"]),
        (["99999999999999999999/99999999999999999999"], ["neither a count"]),
    ],
)  # fmt: skip
def test_mistakes_are_one_message(words, expected):
    out = run(*words)
    assert isinstance(out.exception, ConfigError), out.output
    for word in expected:
        assert word in str(out.exception)


def test_a_broken_file_is_one_message(tmp_path):
    path = tmp_path / "trials.csv"
    path.write_text("policy,success\na,1\n")
    out = run(str(path))
    assert isinstance(out.exception, DatasetError)
    assert "line 1: no column for start state" in str(out.exception)


def test_the_example_of_the_docs_is_what_the_command_prints(tmp_path):
    page = (Path(__file__).resolve().parents[2] / "docs" / "success.md").read_text(encoding="utf-8")
    (table,) = re.findall(r"```csv\n(.*?)```", page, re.DOTALL)
    (shown,) = re.findall(r"```console\n\$ demobench success trials.csv\n(.*?)```", page, re.DOTALL)
    path = tmp_path / "trials.csv"
    path.write_text(table)
    printed = run(str(path), width="100").stdout
    assert [line.rstrip() for line in printed.splitlines()] == shown.splitlines()


def test_help_has_examples():
    out = run("--help")
    assert "demobench success 18/20 16/20" in out.stdout.split("Example")[1]

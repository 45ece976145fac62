"""The command: the table, the misses, the JSON, the page and the exit status, on a handful of shards."""

import json
import re

import pytest
from typer.testing import CliRunner

from demobench.cli import app
from demobench.commands.selftest import run_selftest
from pipeline.statistics.known_truth.shards import Shard, code_hash

TINY = [
    *(Shard("floors", (("generator", name), ("episodes", 50)), 0, 4) for name in ("plane", "exact")),
    Shard("means", (("shape", "gaussian"), ("episodes", 8), ("seeds", 1), ("folds", 1)), 0, 40),
    Shard("differences", (("shape", "gaussian"), ("episodes", 8), ("seeds", 1), ("folds", 1)), 0, 40),
    Shard("success", (("trials", 10),), 0, 1),
]


def run(tmp_path, shards=TINY, **more) -> bool:
    options = {"full": False, "workers": 1, "page": None, "config_path": None, "store_path": str(tmp_path / "store")}
    return run_selftest(**options | {"json_to": None, "shards": shards} | more)


def test_it_prints_judges_and_writes_a_page(tmp_path, capsys):
    page, numbers = tmp_path / "docs" / "known_truth.md", tmp_path / "numbers.json"
    page.parent.mkdir()
    assert run(tmp_path, page=page, json_to=str(numbers))
    printed = " ".join(capsys.readouterr().out.split())
    assert "success rates" in printed
    assert "errors risen by a fifth" not in printed, "what was not missed is not listed"
    results = {result["goal"]: result for result in json.loads(numbers.read_text())}
    assert results["success rates"]["outcome"] == "met"
    assert results["power"]["outcome"] is None
    assert results["intervals"]["places"][0]["settings"]["episodes"] == 8
    text = page.read_text()
    assert code_hash()[:12] in text
    assert "plane, 50 episodes" in text
    images = re.findall(r"!\[[^]]*\]\(([^)]+)\)", text)
    assert images
    assert all((page.parent / image).read_bytes().startswith(b"\x89PNG") for image in images)


def test_a_missed_goal_is_named_and_fails(tmp_path, capsys):
    record = {"truth": {}, "columns": {"rate": [0.5], "clopper_pearson": [0.9], "wilson": [0.9]}, "seconds": 1.0}
    shard = TINY[-1]
    kept = tmp_path / "store" / "selftest" / shard.file_name
    kept.parent.mkdir(parents=True)
    kept.write_text(json.dumps(record))
    assert not run(tmp_path, [shard])
    assert "missed success rates" in " ".join(capsys.readouterr().out.split())


def test_json_to_standard_output_is_json_alone(tmp_path, capsys):
    run(tmp_path, TINY[-1:], json_to="-")
    captured = capsys.readouterr()
    assert json.loads(captured.out)[-1]["goal"] == "success rates"
    assert "self-test" in captured.err


@pytest.mark.slow
def test_the_quick_run_measures_and_resumes(tmp_path):
    arguments = ["selftest", "--quick", "--store", str(tmp_path), "--json", str(tmp_path / "numbers.json")]
    first = CliRunner().invoke(app, arguments)
    assert first.exit_code in (0, 1), first.output
    results = json.loads((tmp_path / "numbers.json").read_text())
    assert first.exit_code == any(result["outcome"] == "missed" for result in results)
    stamps = {path: path.stat().st_mtime_ns for path in (tmp_path / "selftest").iterdir()}
    assert CliRunner().invoke(app, arguments).exit_code == first.exit_code
    assert stamps == {path: path.stat().st_mtime_ns for path in (tmp_path / "selftest").iterdir()}

"""Shards: each a pure function of its seeds, kept, joined, and not done twice."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from pipeline.statistics.known_truth import shards as module
from pipeline.statistics.known_truth.shards import Shard, code_hash, collect, plan, run_shards
from pipeline.statistics.known_truth.studies import STUDIES

DRAWN = (("shape", "gaussian"), ("episodes", 8), ("seeds", 1), ("folds", 1))
TINY = [Shard("means", DRAWN, 0, 5), Shard("means", DRAWN, 5, 3), Shard("success", (("trials", 5),), 0, 1)]


def test_repeats_do_not_depend_on_the_block_they_are_in():
    whole = Shard("means", DRAWN, 0, 8).run()["columns"]
    parts = [shard.run()["columns"] for shard in TINY[:2]]
    assert whole == {name: parts[0][name] + parts[1][name] for name in whole}


def test_they_are_run_in_processes_kept_and_joined(tmp_path):
    seen = []
    seconds = run_shards(TINY, tmp_path, workers=2, on_done=lambda *counts: seen.append(counts))
    assert seconds > 0
    assert seen == [(0, 3), (1, 3), (2, 3), (3, 3)]
    assert {path.name for path in tmp_path.iterdir()} == {shard.file_name for shard in TINY}
    means, success = collect(TINY, tmp_path)
    assert means.settings == dict(DRAWN)
    assert means.columns["value"].shape == (8,)
    assert success.columns["rate"].shape == (199,)


def test_what_is_there_is_not_done_again(tmp_path):
    for shard in TINY:
        record = {"truth": {}, "columns": {"value": [float(shard.first), None]}, "seconds": 2.0}
        (tmp_path / shard.file_name).write_text(json.dumps(record))
    assert run_shards(TINY, tmp_path) == 6.0
    means, _ = collect(TINY, tmp_path)
    np.testing.assert_array_equal(means.columns["value"], [0, np.nan, 5, np.nan])


def test_a_change_of_the_code_makes_new_files(monkeypatch):
    before = TINY[0].file_name
    assert code_hash()[:12] in before
    monkeypatch.setattr(module, "code_hash", lambda: "0" * 64)
    assert TINY[0].file_name != before


@pytest.mark.parametrize("size", ["quick", "full"])
def test_a_plan_holds_every_study_once(size):
    shards = plan(size)
    assert len({shard.file_name for shard in shards}) == len(shards)
    assert {shard.study for shard in shards} == set(STUDIES)
    assert all(shard.count > 0 for shard in shards)
    assert all("/" not in shard.file_name and len(shard.file_name) < 200 for shard in shards)


def test_the_hash_covers_every_estimator_that_a_study_reaches():
    folder = Path(module.__file__).parents[1]
    reached, waiting = set(), [folder / "known_truth" / f"{name}.py" for name in ("studies", "generators")]
    while waiting:
        found = set(re.findall(r"from pipeline\.statistics\.(\w+) import", waiting.pop().read_text())) - {"known_truth"}
        waiting += [folder / f"{name}.py" for name in found - reached]
        reached |= found
    # Trials read files, which no study has; refusals are words.
    assert reached - {"trials", "refusals"} == set(module.ESTIMATORS)


def test_words_do_not_make_shards_again():
    code = "def f(x):\n    return x + 1\n"
    same = '"""A page."""\n\ndef f(x):\n    """Adds."""\n    return x + 1  # one\n\nX = 3\n"""About X."""\n'
    assert module.without_words(same) == module.without_words(code + "X = 3\n")
    assert module.without_words(code) != module.without_words(code.replace("1", "2"))

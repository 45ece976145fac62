"""Tasks in words, and units."""

import numpy as np
import pytest

from tests.inspection.making import arm_takes, found


def test_a_task_that_is_written_in_two_ways_is_found():
    takes = arm_takes()
    takes[3].task = "Put it there."
    (finding,) = found(takes, "label")
    assert "“Put it there.” and “put it there”" in finding.words


def test_two_tasks_are_two_tasks():
    takes = arm_takes()
    for take in takes[::2]:
        take.task = "take it away"
    assert not found(takes, "label")


def test_missing_words_are_found_where_others_have_some():
    takes = arm_takes()
    takes[3].task = takes[4].task = ""
    (finding,) = found(takes, "label")
    assert "2 of 16 episodes have no task in words (episodes 13, 14)" in finding.words


def test_no_words_at_all_are_fine():
    takes = arm_takes()
    for take in takes:
        take.task = ""
    assert not found(takes, "label")


@pytest.mark.parametrize(
    ("factor", "words"), [(np.pi / 180, "degrees against radians"), (1000.0, "millimetres"), (0.01, "hundredths")]
)
def test_states_in_another_unit_are_found(factor, words):
    takes = arm_takes()
    for take in takes:
        take.state = take.state * factor
    findings = found(takes, "label")
    assert len(findings) >= 3
    assert all(words in finding.words for finding in findings)

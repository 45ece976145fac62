"""All detectors together: clean data, the ranking, what is worth leaving out, JSON."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.inspection.alike import IN_A_TREE
from pipeline.inspection.finding import CHECKS, Finding, gather
from pipeline.inspection.look import LOOK_AT, _look_at, inspect, view_command
from pipeline.lerobot_format.quality import resolve_semantics
from pipeline.lerobot_format.read import load_source
from pipeline.types import STATE
from speed.inspect import many
from speed.planted import made_arm
from speed.timing import peak_mb
from tests.inspection.making import arm_takes, joined, look


@pytest.mark.parametrize("seed", range(8))
def test_a_clean_arm_has_no_findings(seed):
    inspection = look(arm_takes(seed=seed))
    assert inspection.findings == ()
    assert inspection.look_at == ()
    assert inspection.exclude == ()
    assert inspection.exclude_line == ""
    assert all(inspection.verdict(check)[0] for check in CHECKS)


def test_the_embedded_demonstrations_have_none():
    demos = load_source("embedded:pusht_sim", name="pusht_sim", config_dir=Path.cwd())
    assert inspect(demos, resolve_semantics(demos)).findings == ()


@pytest.mark.parametrize("episodes", [1, 2, 3])
def test_few_episodes_are_looked_at_all_the_same(episodes):
    assert look(arm_takes(episodes)).findings == ()


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_episodes_of_a_few_frames_are_looked_at_without_a_stumble(frames):
    assert isinstance(look([take.frames(slice(0, frames)) for take in arm_takes(6)]).findings, tuple)


def test_nothing_is_changed():
    demos = joined(arm_takes())
    before = {key: values.copy() for key, values in demos.columns.items()}
    inspect(demos, resolve_semantics(demos))
    assert all(np.array_equal(demos.columns[key], values) for key, values in before.items())


def test_several_faults_are_ranked_with_grave_ones_first():
    takes = arm_takes(30)
    takes[2].state[20:60, 0] = takes[2].state[20, 0]
    takes[9] = takes[9].frames(slice(0, 5))
    last = len(takes[20].seconds) - 1
    takes[20] = takes[20].frames(np.r_[0 : last + 1, [last] * 120], new_clock=True)
    takes[25].state[60, 2] += 25
    inspection = look(takes)
    ranked = [episode for episode, _ in inspection.look_at]
    assert set(ranked[:2]) == {12, 19}
    assert set(ranked) == {12, 19, 30, 35}
    assert inspection.exclude == (12, 19)
    assert inspection.exclude_line == "exclude = [12, 19]"
    assert all(reasons for _, reasons in inspection.look_at)


def test_at_most_five_episodes_are_shown_by_what_speaks_for_them():
    findings = [Finding("jump", episode, None, float(episode), 1.0, f"says {episode}") for episode in range(1, 9)]
    findings.append(Finding("idle", 1, None, 1.0, 1.0, "waits"))
    findings.append(Finding("clock", 7, None, 1.0, 1.0, "broken", grave=True))
    ranked = _look_at(findings)
    assert len(ranked) == LOOK_AT
    assert ranked[0] == (7, ("broken", "says 7"))
    assert [episode for episode, _ in ranked[1:]] == [4, 5, 6, 8], "from four times the limit on all weigh the same"


def test_one_check_counts_once_for_an_episode():
    many = [Finding("idle", 1, str(column), 1.0, 1.0, "waits") for column in range(10)]
    one = Finding("jump", 2, None, 1.0, 1.0, "leaps")
    assert [episode for episode, _ in _look_at([*many, one])] == [2, 1]


def test_what_is_said_of_many_episodes_is_said_once():
    findings = [Finding("tracking", episode, "action/a", episode + 1.0, 1.0, f"late {episode}") for episode in range(6)]
    (one,) = gather(findings, episodes=10)
    assert one.episode is None
    assert one.words.startswith("In 6 of 10 episodes; the clearest is episode")
    assert gather(findings[:4], episodes=10)[0].episode is not None


def test_grave_findings_are_never_gathered():
    findings = [Finding("duplicate", episode, None, 1.0, 0.6, "twice", grave=True) for episode in range(6)]
    assert {finding.episode for finding in gather(findings, episodes=10)} == set(range(6))


def test_findings_come_in_the_order_of_the_checks():
    findings = [Finding(check, None, None, None, None, check) for check in reversed(CHECKS)]
    assert [finding.check for finding in gather(findings, 10)] == list(CHECKS)


def test_leaving_out_most_episodes_is_no_remedy():
    takes = arm_takes(10)
    for place in range(8):
        takes[place].seconds[50:60] = takes[place].seconds[50]
    inspection = look(takes)
    assert len([f for f in inspection.findings if f.grave]) == 8
    assert inspection.exclude == ()


def test_json_has_the_promised_keys_and_is_json():
    takes = arm_takes()
    takes[2] = takes[2].frames(slice(0, 5))
    takes[3].state[60, 0] += 30
    said = look(takes).as_json("my tape")
    assert set(said) >= {"lag_frames", "findings", "look_at", "exclude", "exclude_line"}
    assert set(said["findings"][0]) == {"check", "episode", "column", "value", "limit", "words"}
    assert set(said["look_at"][0]) == {"episode", "reasons", "command"}
    assert said["look_at"][0]["command"] == "demobench view 'my tape' 12"
    assert said["exclude"] == [12]
    assert json.loads(json.dumps(said, allow_nan=False)) == said


def test_the_command_to_look_is_safe_to_paste():
    assert view_command("tape; rm -r x", 3) == "demobench view 'tape; rm -r x' 3"


def test_values_that_are_not_finite_do_not_reach_json():
    said = replace(look(arm_takes()), lag_frames=(None, 1.23456)).as_json("x")
    assert said["lag_frames"] == [None, 1.23]


def test_progress_is_told_of_every_check():
    told = []
    demos = joined(arm_takes(5))
    inspect(demos, resolve_semantics(demos), say=lambda what, done, total: told.append((what, done, total)))
    assert [what for what, _, _ in told] == list(CHECKS)
    assert told[-1][1:] == (len(CHECKS) - 1, len(CHECKS))


def test_the_verdict_of_a_check_says_what_was_found():
    takes = arm_takes()
    takes[2] = takes[2].frames(slice(0, 5))
    inspection = look(takes)
    fine, words = inspection.verdict("short")
    assert not fine
    assert words.startswith("Episode 12: It has 5 frames")
    assert inspection.verdict("jump")[0]


def test_many_frames_are_looked_at_in_parts_and_take_less_memory_than_their_columns():
    """More than one tree for duplicates, and several parts for everything else; the copy is in another tree."""
    demos = many(made_arm(50, 0), 15)
    assert demos.frames > IN_A_TREE
    first, last = demos.episode(3), demos.episode(demos.episodes - 1)
    length = min(first.stop - first.start, last.stop - last.start)
    for values in demos.columns.values():
        values[last.start : last.start + length] = values[first.start : first.start + length]
    demos.columns[STATE][demos.episode_starts[400] + 60, 1] += 40
    found = []
    semantics = resolve_semantics(demos)
    peak = peak_mb(lambda: found.append(inspect(demos, semantics)))
    assert peak * 1e6 < sum(values.nbytes for values in demos.columns.values()) + 5e6
    copied = [f for f in found[0].findings if f.check == "duplicate"]
    assert {f.episode for f in copied} <= {3, demos.episodes - 1}
    assert len(copied) == 1
    assert 400 in {f.episode for f in found[0].findings if f.check == "jump"}

"""The gate's false alarms and power, measured; and that a broken gate would be noticed."""

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.statistics.known_truth.gate import SETTINGS, Setting, rate, study_gate
from pipeline.statistics.regression import FALSE_ALARMS_AT_MOST, POWER

FEW = Setting("neighbours", "arm", 20, 3, True)


def test_nothing_changed_is_let_pass_and_a_fifth_is_seen():
    found = study_gate(FEW, range(12))
    assert sum(found["alarm"]) <= 2, "12 pairs at 5 % hold three or more alarms once in fifty"
    assert sum(found["seen"]) >= 10


def test_two_results_of_one_method_do_differ():
    seen = []

    def look(now, before, protocol, *, is_trained):
        seen.append(now.absolute.mean() / before.absolute.mean() - 1)
        return SimpleNamespace(word="worse")

    found = study_gate(FEW, range(3), look)
    assert found == {"alarm": [True] * 3, "seen": [True] * 3}, "a gate that always alarms is seen to"
    same, risen = np.abs(seen[0::2]), np.array(seen[1::2])
    assert ((same > 1e-4) & (same < 0.1)).all()
    assert ((risen > 0.1) & (risen < 0.35)).all()


def test_rates_have_exact_intervals():
    assert rate([False] * 400) == (0.0, 0.0, pytest.approx(1 - 0.025 ** (1 / 400)))


def test_the_page_shows_every_setting_and_the_constants_are_within_what_it_shows():
    text = (Path(__file__).resolve().parents[3] / "docs" / "automation.md").read_text(encoding="utf-8")
    limits = r"\d+\.\d \((\d+\.\d) … (\d+\.\d)\)"
    rows = re.findall(rf"^\| ([^|]+) \| {limits} \| {limits} \| [^|]+ \| 400 \|$", text, re.MULTILINE)
    assert [row[0] for row in rows] == [setting.words for setting in SETTINGS]
    for setting, (_, _, alarm_high, power_low, _) in zip(SETTINGS, rows, strict=True):
        if setting.episodes == 50:
            assert float(alarm_high) <= 100 * FALSE_ALARMS_AT_MOST
            assert float(power_low) >= 100 * POWER
    assert f"{100 * FALSE_ALARMS_AT_MOST:.1f} % is the upper limit of the" in text
    assert f"to see a fifth in {100 * POWER:.0f} %, the lower limit above" in text
    assert f"that is at most {52 * FALSE_ALARMS_AT_MOST:.1f} false alarms a year" in text


@pytest.mark.slow
@pytest.mark.parametrize("setting", SETTINGS, ids=lambda s: s.words)
def test_over_400_pairs_false_alarms_are_few_and_a_fifth_is_seen(setting):
    found = study_gate(setting, range(400))
    alarm, _, alarm_high = rate(found["alarm"])
    power, power_low, _ = rate(found["seen"])
    assert alarm <= 0.05
    assert alarm_high <= 0.08
    assert power >= 0.80
    if setting.episodes == 50:
        assert alarm_high <= FALSE_ALARMS_AT_MOST + 5e-4, "what the check's description says"
        assert power_low >= POWER

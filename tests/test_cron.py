"""Cron lines: those that pass are those that Dagster takes, and those that do not say what is wrong."""

import random

import pytest
from dagster._utils.schedules import is_valid_cron_string

from assets_defs.benchmark import runs_a_year
from pipeline.config import parse_config
from pipeline.cron import FIELDS, WORDS, problem_of
from pipeline.errors import ConfigError

GOOD = (
    "0 3 * * 1", "30 1 * * *", "*/15 * * * *", "0 3 * * mon", "0 3 * * Mon-Fri", "0 3 * jan,jul sun", "5/20 * * * *", "0 3 * * 7",
    "10-50/10 0-23 1-31 1-12 0-7", "0 3 * * fri,6-7", "00 03 01 01 *", "0 3 29 2 *", "0 3 31 4,5 *", "  0 3\t* * 1 ", *WORDS,
)  # fmt: skip
BAD = {
    "": "it has 0 fields and not 5",
    "0 3 * *": "it has 4 fields and not 5",
    "0 0 3 * * 1": "it has 6 fields and not 5",
    "@reboot": "it has 1 fields and not 5",
    "weekly": "it has 1 fields and not 5",
    "61 3 * * *": "the minute '61' is not *, nor numbers from 0 to 59 in rising order",
    "0 24 * * *": "the hour '24'",
    "0 3 0 * *": "the day of the month '0'",
    "0 3 * 13 *": "the month '13' is not *, nor numbers from 1 to 12 (or jan to dec) in rising order",
    "0 3 * * 8": "the day of the week '8'",
    "0 3 * * monday": "the day of the week 'monday' is not *, nor numbers from 0 to 7 (or sun to sat) in rising order",
    "0 3 * mon *": "the month 'mon'",
    "*/0 * * * *": "the minute '*/0'",
    "*/90 * * * *": "the minute '*/90'",
    "50-10 * * * *": "the minute '50-10'",
    "0 3 * * fri-mon": "the day of the week 'fri-mon'",
    "0 3 * * 1#1": "the day of the week '1#1'",
    "1,,2 * * * *": "the minute '1,,2'",
    "*-5 * * * *": "the minute '*-5'",
    "-1 * * * *": "the minute '-1'",
    "1.5 * * * *": "the minute '1.5'",
    "٣ * * * *": "the minute '٣'",
    "0 3 30 2 *": "no month of it has a day 30",
    "0 3 31 4,jun *": "no month of it has a day 31",
}  # fmt: skip


@pytest.mark.parametrize("cron", GOOD)
def test_what_passes_dagster_takes(cron):
    assert problem_of(cron) is None
    assert is_valid_cron_string(cron)
    assert runs_a_year(cron) > 0


@pytest.mark.parametrize(("cron", "why"), BAD.items())
def test_what_is_wrong_is_one_message(cron, why):
    with pytest.raises(ConfigError) as caught:
        parse_config({"schedule": {"cron": cron}}, "demobench.toml")
    said = str(caught.value)
    assert said.startswith(f"demobench.toml: [schedule] cron is '{cron}', and {why}")
    assert 'for example "0 3 * * 1" (Mondays at 03:00 UTC)' in said


def test_dagster_takes_all_that_passes_of_many_that_are_made_up():
    draw = random.Random(0)

    def part(low: int, high: int, names: tuple[str, ...]) -> str:
        def one() -> str:
            return draw.choice([*names, *(str(n) for n in range(max(low - 1, 0), high + 2))])

        body = draw.choice(["*", one(), f"{one()}-{one()}"])
        return body + draw.choice(["", "", f"/{draw.randrange(0, high + 2)}"])

    passed = 0
    for _ in range(2000):
        fields = [",".join(part(*field[1:]) for _ in range(draw.choice([1, 1, 2]))) for field in FIELDS]
        cron = " ".join(fields)
        if problem_of(cron) is None:
            passed += 1
            assert is_valid_cron_string(cron), cron
    assert passed > 200

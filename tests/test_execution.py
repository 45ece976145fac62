"""What goes together in carrying chunks out, and what is refused."""

import tomllib

import pytest

from pipeline.config import check_policy, parse_config
from pipeline.errors import ConfigError
from pipeline.execution import settled, words
from pipeline.experiment import Choices, from_config, with_choices
from pipeline.types import Execution


@pytest.mark.parametrize(
    ("chunk", "asked", "execute"),
    [
        (16, Execution(), 8), (4, Execution(), 4), (1, Execution(), 1), (16, Execution(16), 16), (16, Execution(ensemble=True), 1),
        (10, Execution(delay=3), 7), (16, Execution(delay=3), 8), (8, Execution(4, delay=4), 4),
        (2, Execution(1, ensemble=True, delay=1), 1),
    ],
)  # fmt: skip
def test_what_is_not_said_is_as_usual_or_what_the_chunk_has(chunk, asked, execute):
    found = settled(asked, chunk)
    assert found.execute == execute
    assert (found.ensemble, found.delay) == (asked.ensemble, asked.delay)
    assert settled(found, chunk) == found


@pytest.mark.parametrize(
    ("chunk", "asked", "message"),
    [
        (4, Execution(8), "execute = 8 needs a chunk of at least 8 actions, and this one has 4"),
        (16, Execution(4, ensemble=True), "execute = 4 and ensemble contradict each other"),
        (16, Execution(ensemble=True, carry_on=True), "ensemble and carry_on contradict each other"),
        (4, Execution(delay=4), "delay = 4, and a chunk of 4 actions is over before its first action can begin"),
        (8, Execution(7, delay=2), "execute = 7 after a delay of 2 needs a chunk of at least 9 actions"),
        (16, Execution(2, delay=3), "delay = 3 is longer than the 2 frames between two questions"),
        (6, Execution(delay=4), "delay = 4 is longer than the 2 frames"),
        (8, Execution(ensemble=True, delay=2), "delay = 2 is longer than the 1 frame between"),
    ],
)
def test_what_contradicts_is_refused(chunk, asked, message):
    with pytest.raises(ConfigError, match=message):
        settled(asked, chunk)


def test_words():
    assert words(Execution(1)) == "1 action of each chunk"
    assert words(Execution(8, delay=2)) == "8 actions of each chunk, 2 frames late"
    assert words(Execution(1, ensemble=True, delay=1)) == "a temporal ensemble, 1 frame late"
    assert words(Execution(4, carry_on=True)) == "4 actions of each chunk, carried on where the robot stands still"


FILE = """
[datasets.tape]
source = "somewhere"
[policies.mlp]
method = "mlp"
chunks = [4, 16]
execute = {execute}
"""


def test_the_configuration_is_refused_for_the_chunk_that_is_too_short():
    policy = parse_config(tomllib.loads(FILE.format(execute=4)), "file").policies["mlp"]
    assert policy.execution == Execution(4)
    check_policy(policy)
    with pytest.raises(ConfigError, match=r"file: \[policies.mlp\] execute = 8 needs a chunk of at least 8"):
        parse_config(tomllib.loads(FILE.format(execute=8)), "file")
    with pytest.raises(ConfigError, match="baselines are not"):
        parse_config({"policies": {"still": {"method": "hold_still", "delay": 1}}}, "file")


def test_a_chunk_from_the_command_line_is_checked_too(tmp_path):
    config = parse_config(tomllib.loads(FILE.format(execute=4)), "file")
    base = from_config(config, "tape", tmp_path)
    assert with_choices(base, Choices(chunks=(8,))).policies["mlp"].chunks == (4, 8, 16)
    with pytest.raises(ConfigError, match=r"\[policies.mlp\] execute = 4 needs a chunk of at least 4"):
        with_choices(base, Choices(chunks=(1,)))

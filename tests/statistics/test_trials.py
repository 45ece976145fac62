"""Files of trials: every dialect that is read, and one message for every file that is not."""

import codecs

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import DatasetError
from pipeline.statistics.trials import read_trials

GOOD = "policy,start_state,success\nmlp,left,1\nmlp,right,0\nact,left,1\nact,right,1\n"


@pytest.fixture
def write(tmp_path):
    def write(content: str | bytes):
        path = tmp_path / "trials.csv"
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return write


@pytest.mark.parametrize(
    "content",
    [
        GOOD,
        GOOD.replace(",", ";"),
        GOOD.replace(",", "\t"),
        GOOD.replace("\n", "\r\n"),
        codecs.BOM_UTF8 + GOOD.encode(),
        "\n\n" + GOOD.replace("\nact,left", "\n\n , ,\nact,left") + "\n\n",
        GOOD.replace("policy,start_state,success", "Policy, Start State ,OK"),
        GOOD.replace("policy,start_state,success", '"METHOD","start-state","Succeeded"'),
        GOOD.replace("mlp", '"mlp"'),
        GOOD.replace(",1\n", ",TRUE\n").replace(",0\n", ",False\n"),
        GOOD.replace(",1\n", ",yes\n").replace(",0\n", ",No\n"),
        GOOD.replace(",1\n", ",1.0\n").replace(",0\n", ",0.0\n"),
        "\n".join(f"note{i},{line}" for i, line in enumerate(GOOD.splitlines())),
    ],
)
def test_dialects(write, content):
    trials = read_trials(write(content))
    assert trials.policies == ("mlp", "act")
    assert trials.policy.tolist() == ["mlp", "mlp", "act", "act"]
    assert trials.start.tolist() == ["left", "right", "left", "right"]
    assert trials.success.tolist() == [True, False, True, True]
    assert trials.stage is None


def test_quoted_fields_hold_separators_quotes_and_new_lines(write):
    content = 'policy;start;success\n"a;""b""";"red, left\nshelf";1\n"a;""b""";x;0\n'
    trials = read_trials(write(content))
    assert trials.policy.tolist() == ['a;"b"'] * 2
    assert trials.start.tolist() == ["red, left\nshelf", "x"]


def test_stages_are_numbers_where_all_are(write):
    head = "policy,start,success,Progress Stage\n"
    numbered = read_trials(write(head + "a,1,0,2\na,2,1,3.5\n")).stage
    assert numbered.dtype == np.float64
    assert numbered.tolist() == [2.0, 3.5]
    assert read_trials(write(head + "a,1,0,2\na,2,1,lifted\n")).stage.tolist() == ["2", "lifted"]
    assert read_trials(write(head + "a,1,0,2\na,2,1,inf\n")).stage.tolist() == ["2", "inf"]


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("", ["is empty", "policy,start_state,success"]),
        ("\n \n", ["is empty"]),
        ("policy,start,success\n", ["line 1", "no trials below"]),
        ("policy|start|success\na|1|1\n", ["line 1", "'policy|start|success'", "comma, semicolon or tab"]),
        (
            "policy,success\na,1\n",
            ["line 1", "no column for start state", "'policy | success'", "demobench success 18/20"],
        ),
        ("mlp,left,1\nmlp,right,0\n", ["line 1", "policy and start state and success"]),
        (GOOD.replace("right,0", "right,maybe"), ["line 3", "success is 'maybe'", "1, true, yes, 0, false, no"]),
        (GOOD.replace("right,0", "right,2"), ["line 3", "success is '2'"]),
        (GOOD.replace("right,0", "right,-1"), ["line 3", "success is '-1'"]),
        (GOOD.replace("right,0", "right,"), ["line 3", "nothing under 'success'"]),
        (GOOD.replace("mlp,right", ",right"), ["line 3", "nothing under 'policy'"]),
        (GOOD.replace("right,0", "right,0,extra"), ["line 3", "4 fields, expected 3", "double quotes"]),
        (GOOD.replace("mlp,right,0", "mlp"), ["line 3", "1 fields, expected 3"]),
        (GOOD + "mpl,left,1\n", ["line 6", "'mpl' was tried once", "at least 2", "Did you mean 'mlp'?"]),
        ('policy,start,success\na,"1,1\n', ["line 2", "quoting is broken"]),
        ("policy,start,success,stage\na,1,1,\na,2,1,3\n", ["line 2", "nothing under 'stage'", "leave the column out"]),
        (GOOD.encode("utf-16"), ["not UTF-8", "CSV UTF-8"]),
        (b"PK\x03\x04\xff\xfe\x00\x00", ["not UTF-8"]),
    ],
)
def test_mistakes_have_one_message(write, content, expected):
    with pytest.raises(DatasetError) as caught:
        read_trials(write(content))
    for word in expected:
        assert word in str(caught.value)


def test_no_file(tmp_path):
    with pytest.raises(DatasetError, match="cannot be read: Is a directory"):
        read_trials(tmp_path)
    with pytest.raises(DatasetError, match="cannot be read: No such file"):
        read_trials(tmp_path / "none.csv")


@given(st.binary(max_size=200) | st.text(alphabet='policy,start;success\n"01\t ', max_size=200).map(str.encode))
@settings(max_examples=150, deadline=None)
def test_anything_else_is_refused_in_words(tmp_path_factory, content):
    path = tmp_path_factory.mktemp("any") / "any.csv"
    path.write_bytes(content)
    try:
        trials = read_trials(path)
    except DatasetError:
        return
    assert len(trials.policy) == len(trials.start) == len(trials.success) >= 2

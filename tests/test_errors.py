"""Messages: nothing in them is obeyed by a terminal, and a typo gets help."""

import pytest

from pipeline.errors import did_you_mean, printable


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("shoulder_pan.pos", "shoulder_pan.pos"),
        ("Banane auf den Teller – 放到盘子上 👩‍🔧", "Banane auf den Teller – 放到盘子上 👩‍🔧"),
        ("\x1b[2Jgone", "\ufffd[2Jgone"),
        ("\x1b]0;title\x07", "\ufffd]0;title\ufffd"),
        ("two\nlines\tand\ra return", "two lines and a return"),
        ("\x9b31m", "\ufffd31m"),
        ("evil\u202etxt.exe", "evil\ufffdtxt.exe"),
    ],
)
def test_what_others_wrote_is_shown_and_never_obeyed(words, expected):
    assert printable(words) == expected
    assert printable(expected) == expected


def test_help_with_a_typo():
    assert did_you_mean("stat", ["state", "action"]) == "Did you mean 'state'?"
    assert did_you_mean("x", ["state", "action"]) == "Known: action, state."
    assert did_you_mean("x", []) == ""

"""Nothing that comes from a data set can become markup or a script."""

import json
from html.parser import HTMLParser

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.sinks.markup import Html, element, join, json_for_script, outside_references, script_text

HOSTILE = st.one_of(
    st.text(),
    st.sampled_from(["</script>", "<script>alert(1)</script>", "<!--", "]]>", '" onload="x', "&lt;", "\u2028"]),
)
POLICY = """<meta http-equiv="Content-Security-Policy" content="default-src 'none'">"""


class Seen(HTMLParser):
    """The tags, attributes and text that a parser finds."""

    def __init__(self):
        super().__init__(convert_charrefs=True)
        self.tags, self.text = [], ""

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.text += data


@given(HOSTILE, HOSTILE)
def test_text_and_attributes_come_back_as_they_were(text, title):
    seen = Seen()
    seen.feed(element("p", text, title=title))
    seen.close()
    assert seen.tags == [("p", {"title": title})]
    assert seen.text == text


@given(st.recursive(HOSTILE, lambda inner: st.lists(inner) | st.dictionaries(HOSTILE, inner), max_leaves=8))
def test_json_in_a_script_element_is_the_same_value_and_holds_no_markup(value):
    text = json_for_script(value)
    assert json.loads(text) == value
    assert not set("<>&") & set(text)


def test_json_refuses_numbers_that_are_not_finite():
    with pytest.raises(ValueError, match="not JSON compliant"):
        json_for_script({"error": float("nan")})


def test_children_attributes_and_void_elements():
    assert element("td", [None, "a", Html("<b>c</b>")], class_="best", data_chart=3, hidden=True, id=None) == (
        '<td class="best" data-chart="3" hidden>a<b>c</b></td>'
    )
    assert element("meta", charset="utf-8") == '<meta charset="utf-8">'
    assert join("<", None, 4) == "&lt;4"


def test_a_script_cannot_end_early_and_has_the_line_ends_that_a_browser_hashes():
    assert script_text('a = "</script>";\r\nb\r') == 'a = "<\\/script>";\nb\n'


@pytest.mark.parametrize(
    ("markup", "found"),
    [
        ("<p>text</p><a href='https://example.org'>read</a>", 0),
        ("<img src='data:image/png;base64,AA'><link rel=icon href='data:,'><use href='#a'></use>", 0),
        ("<script src='https://example.org/x.js'></script>", 1),
        ("<link rel=stylesheet href='//example.org/x.css'>", 1),
        ("<style>@import 'x.css'; p { background: url(https://example.org/x.png) }</style>", 2),
        ("<p style='background: url(x.png)'>", 1),
        ("<video poster='x.jpg' src='x.mp4'></video>", 2),
    ],
)
def test_what_a_page_would_ask_for_is_found(tmp_path, markup, found):
    page = tmp_path / "page.html"
    page.write_text(f"<head>{POLICY}</head>{markup}", encoding="utf-8")
    assert len(outside_references(page)) == found


def test_a_page_without_a_policy_may_ask_for_anything(tmp_path):
    page = tmp_path / "page.html"
    page.write_text("<head></head>", encoding="utf-8")
    assert outside_references(page) == ["no content security policy with default-src 'none'"]

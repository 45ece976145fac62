"""HTML that cannot be broken out of: text is escaped unless it was made here.

What belongs here: elements, scripts' contents, and the check that a page asks for nothing. What does not: the page.
Everything from a data set passes through `element` or `json_for_script`.
"""

import html
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any


class Html(str):
    """Text that is HTML already; only this module makes it from anything but a constant."""

    __slots__ = ()


def element(tag: str, *children: Any, **attributes: Any) -> Html:
    """One element. Children are escaped unless `Html`; an attribute of None or False is left out, of True bare.

    A trailing underscore keeps Python's words free (`class_`), and other underscores become hyphens (`data_chart`).
    """
    head = [tag]
    for name, value in attributes.items():
        if value is None or value is False:
            continue
        name = name.rstrip("_").replace("_", "-")
        head.append(name if value is True else f'{name}="{html.escape(str(value))}"')
    opening = f"<{' '.join(head)}>"
    return Html(opening) if tag in ("br", "img", "meta", "link") else Html(f"{opening}{join(*children)}</{tag}>")


def join(*children: Any) -> Html:
    """Children one after another; None is left out, lists are flattened."""
    parts = []
    for child in children:
        if isinstance(child, list | tuple):
            parts.append(join(*child))
        elif child is not None:
            parts.append(child if isinstance(child, Html) else html.escape(str(child)))
    return Html("".join(parts))


def json_for_script(value: Any) -> Html:
    """JSON that may stand inside a script element: no `<`, `>` or `&` is left to end it or to start another.

    Raises:
        ValueError: a number is not finite, which JSON has no word for.
    """
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return Html(text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e"))


def script_text(source: str) -> Html:
    """JavaScript that cannot end its script element early; line ends are those that a browser hashes."""
    return Html(source.replace("\r\n", "\n").replace("\r", "\n").replace("</script", "<\\/script"))


LOADING = ("action", "background", "data", "formaction", "manifest", "ping", "poster", "src", "srcset")
"""Attributes whose address a browser asks for, besides the `href` of anything but a link to click."""


def outside_references(page: Path) -> list[str]:
    """Everything in a page that would make a browser ask for something outside the file; none is the aim.

    What a script asks for cannot be read off a page; a content security policy has to forbid it, so a missing one
    counts.
    """
    text = page.read_text(encoding="utf-8")
    references = _References()
    references.feed(text)
    if "default-src 'none'" not in html.unescape(text.partition("</head>")[0]):
        references.found.append("no content security policy with default-src 'none'")
    return references.found


class _References(HTMLParser):
    """Collects addresses from markup and style; `data:` and `#fragment` stay on the page."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self._in_style = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._in_style = tag == "style"
        for name, value in attrs:
            loads = name in LOADING or (name == "href" and tag != "a")
            if loads and value and not value.startswith(("data:", "#")):
                self.found.append(f"<{tag} {name}={value[:60]}>")
            if name == "style":
                self._in_css(value or "")

    def handle_endtag(self, tag: str) -> None:
        self._in_style = False

    def handle_data(self, data: str) -> None:
        if self._in_style:
            self._in_css(data)

    def _in_css(self, text: str) -> None:
        found = re.findall(r"""@import[^;]*|url\(\s*['"]?(?!data:|#)[^)]*\)""", text)
        self.found += [reference[:60] for reference in found]

"""When something happens again and again: what may be written as a cron line, and what is wrong with one that may not.

What belongs here: checking, so that a slip in the configuration is one message wherever it is read. What does not: working out
when it is time (Dagster does). Every line that passes is one that Dagster takes; a few that it takes, too, do not (`L`, `1#2`).
"""

import re

WORDS = ("@hourly", "@daily", "@weekly", "@monthly", "@yearly")
MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
DAYS = ("sun", "mon", "tue", "wed", "thu", "fri", "sat")
FIELDS = (
    ("minute", 0, 59, ()),
    ("hour", 0, 23, ()),
    ("day of the month", 1, 31, ()),
    ("month", 1, 12, MONTHS),
    ("day of the week", 0, 7, DAYS),
)
"""Each field's lowest and highest value, and the names that stand for its values from the lowest on."""
LONGEST = dict(zip(range(1, 13), (31, 29, 31, 30, 31, 30, 31, 31, 30, 31, 30, 31), strict=True))
"""Days that each month has at most."""

_PART = re.compile(r"(?P<span>\*|(?:[0-9]{1,2}|[a-z]{3})(?:-(?:[0-9]{1,2}|[a-z]{3}))?)(?:/(?P<step>[0-9]{1,2}))?")


def problem_of(cron: str) -> str | None:
    """What is wrong with a cron line, in words; None where nothing is."""
    if cron in WORDS:
        return None
    fields = cron.lower().split()
    if len(fields) != len(FIELDS):
        return f"it has {len(fields)} fields and not 5"
    values: list[set[int]] = []
    for written, (name, low, high, names) in zip(fields, FIELDS, strict=True):
        found = _values(written, low, high, names)
        if found is None:
            also = f" (or {names[0]} to {names[-1]})" if names else ""
            return f"the {name} '{written}' is not *, nor numbers from {low} to {high}{also} in rising order"
        values.append(found)
    days, months = values[2], values[3]
    if min(days) > max(LONGEST[month] for month in months):
        return f"no month of it has a day {min(days)}"
    return None


def _values(written: str, low: int, high: int, names: tuple[str, ...]) -> set[int] | None:
    """The values of one field: `*`, `5`, `1-5`, `mon-fri`, `*/10`, `10-50/10`, and several of these with commas between."""
    number = {name: low + place for place, name in enumerate(names)}
    number |= {text: n for n in range(low, high + 1) for text in (f"{n}", f"{n:02d}")}
    found: set[int] = set()
    for part in written.split(","):
        match = _PART.fullmatch(part)
        if match is None:
            return None
        span, step = match["span"], int(match["step"] or 1)
        first, _, last = (span if span != "*" else f"{low}-{high}").partition("-")
        if first not in number or (last and last not in number) or not 1 <= step <= high:
            return None
        start = number[first]
        end = number[last] if last else high if match["step"] else start
        if last and end <= start:
            return None
        found.update(range(start, end + 1, step))
    return found

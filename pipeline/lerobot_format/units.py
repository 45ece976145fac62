"""Names and units of columns, as far as a data set tells them.

A unit is never guessed from values: degrees, radians and a normalised −100 … 100 look alike.
"""

import math
import re
from typing import Any

from pipeline.errors import printable

_UNITS = {
    "px": "px", "pixel": "px", "pixels": "px",
    "rad": "rad", "radian": "rad", "radians": "rad",
    "deg": "deg", "degree": "deg", "degrees": "deg",
    "m": "m", "meters": "m", "metres": "m", "mm": "mm", "cm": "cm",
    "s": "s", "ms": "ms", "n": "N", "nm": "N·m",
    "rps": "rad/s", "dps": "deg/s", "mps": "m/s",
}  # fmt: skip
_PER_SECOND = {"rad", "deg", "m", "mm", "cm", "px"}
_SHORT = {"m", "s", "n", "nm", "ms"}
"""Too short to be taken for a unit after anything but an underscore."""

_USUAL_RANGE = {
    "px": 512.0, "rad": 2 * math.pi, "deg": 360.0, "m": 1.0, "cm": 100.0, "mm": 1000.0,
    "rad/s": 2 * math.pi, "deg/s": 360.0, "m/s": 1.0, "cm/s": 100.0, "mm/s": 1000.0, "px/s": 512.0,
}  # fmt: skip


def usual_range(unit: str | None) -> float | None:
    """How far a value in this unit usually ranges on a robot; None where the unit is not known."""
    return _USUAL_RANGE.get(unit) if unit else None


def canonical_unit(unit: str) -> str:
    """A unit as it is written here: `degrees` → deg; a word that is not known stays as it is."""
    word = unit.strip()
    return _UNITS.get(word.lower(), word)


def unit_of(name: str) -> str | None:
    """The unit that a column's name ends in: `block_x_px` → px, `wrist.vel_deg_s` → deg/s, `elbow_flex.pos` → None."""
    words = [word for word in re.split(r"[^a-z0-9]+", name.lower()) if word]
    if len(words) < 2:
        return None
    last, before = words[-1], words[-2]
    if last in {"s", "sec"} and before in _UNITS and _UNITS[before] in _PER_SECOND:
        return f"{_UNITS[before]}/s"
    if last in _SHORT and not name.lower().endswith(f"_{last}"):
        return None
    return _UNITS.get(last)


def column_names(key: str, declared: Any, width: int) -> tuple[str, ...] | None:
    """Names for the `width` columns of a feature, or None where `names` is there but does not fit.

    `declared` is `names` in info.json: a flat list, one nested in a mapping (`{"motors": [...]}`), several such lists
    one after another, a mapping name → position, or nothing. Characters that a terminal obeys are taken out.
    """
    names = [printable(name) for name in _flat(declared)]
    if not names:
        return (key.rsplit(".", 1)[-1],) if width == 1 else tuple(str(i) for i in range(width))
    if len(names) == width and len(set(names)) == width:
        return tuple(names)
    return None


def _flat(declared: Any):
    if isinstance(declared, str):
        yield declared
    elif isinstance(declared, dict):
        if declared and all(isinstance(value, int) for value in declared.values()):
            yield from sorted(declared, key=declared.__getitem__)
            return
        for value in declared.values():
            yield from _flat(value)
    elif isinstance(declared, list | tuple):
        for value in declared:
            yield from _flat(value)

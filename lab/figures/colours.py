"""One look for one system in every figure, told apart without colour vision too (colours of Okabe and Ito)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterable

    from lab.findings import Series

_SYSTEMS: Final = {"classic": "#D55E00", "rmpa": "#0072B2", "direct": "#009E73", "mixed": "#CC79A7"}
_OTHERS: Final = ("#009E73", "#CC79A7", "#56B4E9", "#E69F00")
_LINES: Final = ("solid", "dashed", "dotted", "dashdot")
_MARKERS: Final = {"classic": "o^vD", "rmpa": "sPXd", "direct": "*<>h", "mixed": "p8H+"}
_OTHER_MARKERS: Final = "*<>h"
# How far a further series of one system goes towards white, or (below 0) black.
_SHADES: Final = (0.0, 0.4, -0.35, 0.6)


@dataclass(frozen=True, slots=True)
class Look:
    """How a series is drawn.

    Args:
        colour: As ``#rrggbb``.
        line: matplotlib's name of the line style.
        marker: matplotlib's marker.
    """

    colour: str
    line: str
    marker: str


def looks(series: Iterable[Series]) -> dict[str, Look]:
    """Give each label of a figure its look; the first of a system has the system's own colour."""
    found: dict[str, Look] = {}
    taken: dict[str, int] = {}
    for one in series:
        if one.label in found:
            continue
        turn = taken.get(one.system, 0)
        taken[one.system] = turn + 1
        if one.system in _SYSTEMS:
            colour = shade(_SYSTEMS[one.system], _SHADES[turn % len(_SHADES)])
        else:
            colour = _OTHERS[turn % len(_OTHERS)]
        markers = _MARKERS.get(one.system, _OTHER_MARKERS)
        found[one.label] = Look(colour, _LINES[(turn + turn // 4) % len(_LINES)], markers[turn % len(markers)])
    return found


def shade(colour: str, towards: float) -> str:
    """Mix ``#rrggbb`` with white (0 to 1), or with black (-1 to 0)."""
    end = 255 if towards > 0 else 0
    parts = (int(colour[at : at + 2], 16) for at in (1, 3, 5))
    return "#" + "".join(f"{round(part + (end - part) * abs(towards)):02X}" for part in parts)

"""Figures and verdicts as words, the same in every table."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from lab.findings import Claim

_VERDICTS: Final = {True: "✓ reached", False: "✗ **not reached**", None: "? too few samples to say"}
_OUTSIDE_SLUGS: Final = re.compile(r"[^\w\- ]")


def number(value: float | None, digits: int = 3) -> str:
    """A number for people: so many significant digits, without an exponent where one can do without."""
    if value is None:
        return "-"
    if value == 0 or 1e-4 <= abs(value) < 10 ** (digits - 1):
        return f"{value:.{digits}g}"
    return f"{value:,.0f}" if 1 <= abs(value) < 1e9 else f"{value:.{digits - 1}e}"


def counted(value: float | None, digits: int = 3, factor: float = 1.0) -> str:
    """A figure for a table, in another unit if a factor is given; a dash for what is not known."""
    return number(None if value is None else value * factor, digits)


def quantity(value: float | None, unit: str = "", digits: int = 3) -> str:
    """A number with its unit."""
    return f"{number(value, digits)} {unit}" if unit and value is not None else number(value, digits)


def wanted(claim: Claim) -> str:
    """What a claim's value has to be."""
    return f"{'≥' if claim.at_least else '≤'} {quantity(claim.limit, claim.unit)}"


def measured(claim: Claim) -> str:
    """A claim's value, with enough digits to differ visibly from its limit unless both are equal."""
    for digits in (3, 4, 5):
        shown = quantity(claim.value, claim.unit, digits)
        if claim.value == claim.limit or shown != quantity(claim.limit, claim.unit, digits):
            return shown
    return quantity(claim.value, claim.unit, 6)


def verdict(claim: Claim) -> str:
    """Whether a claim holds, in Markdown."""
    return _VERDICTS[claim.reached]


def value(found: object) -> str:
    """A value of a plan or a manifest."""
    if isinstance(found, list | tuple):
        return ", ".join(map(value, found))
    if isinstance(found, dict):
        return ", ".join(f"{name} {value(one)}" for name, one in found.items())
    if found is None or isinstance(found, bool):
        return {None: "none", True: "yes", False: "no"}[found]
    return f"{found:.4g}" if isinstance(found, float) else str(found)


def link(carries: str) -> str:
    """What a cable carries, as ``tc`` has it (``100mbit``), for people."""
    found = re.fullmatch(r"(\d+)([kmg])bit", carries)
    return f"{found[1]} {found[2].upper().replace('K', 'k')}bit/s" if found else carries or "not shaped"


def count(amount: int, one: str, many: str = "") -> str:
    """An amount of something: ``1 cell``, ``3 cells``."""
    return f"{amount:,} {one if amount == 1 else many or one + 's'}"


def plain(text: object) -> str:
    """Text from elsewhere (a kernel's name, an error) for Markdown: one line that means nothing but itself."""
    line = " ".join(str(text).split())
    return re.sub(r"([\\`*_\[\]<>|#])", r"\\\1", line)


def table_row(cells: Sequence[str]) -> str:
    """A row of a Markdown table."""
    kept = [re.sub(r"(?<!\\)\|", r"\\|", " ".join(cell.split())) for cell in cells]
    return f"| {' | '.join(kept)} |"


def table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table; the first column is to the left, others too if they hold anything but figures."""
    rows = list(rows)
    figures = [at > 0 and all(_is_figure(row[at]) for row in rows) for at in range(len(columns))]
    rule = "|" + "|".join("---:" if right else "---" for right in figures) + "|"
    return "\n".join([table_row(columns), rule, *map(table_row, rows)])


def _is_figure(cell: str) -> bool:
    return not cell or cell[0] in "0123456789-\N{EN DASH}≤≥<>±"


def slug(heading: str) -> str:
    """The anchor that code hosts give a heading."""
    return _OUTSIDE_SLUGS.sub("", heading.lower()).replace(" ", "-")

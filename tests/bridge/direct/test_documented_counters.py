"""docs/design/introspection.md lists every counter of direct transport."""

from __future__ import annotations

import re
from pathlib import Path

import rmpa

DOCUMENT = Path(__file__).parents[3] / "docs" / "design" / "introspection.md"
COUNTED = re.compile(r'(?:counters\.add|_on_warning|\.warn)\("(direct\.\w+)"')
"""A counter where it counts; a warning is counted by its kind."""


def test_every_counter_is_documented() -> None:
    counted = {
        name
        for file in Path(rmpa.__path__[0], "bridge").rglob("*.py")
        for name in COUNTED.findall(file.read_text(encoding="utf-8"))
    }
    rows = re.findall(r"(?m)^\| (`direct\.[^|]*) \|", DOCUMENT.read_text(encoding="utf-8"))
    documented = [name for row in rows for name in re.findall(r"`(direct\.\w+)`", row)]
    assert sorted(documented) == sorted(counted)

"""docs/guides/web.md#rosbridge: its figures are the code's."""

from __future__ import annotations

import re
from pathlib import Path

from rmpa.core.limits import MIB
from rmpa.web import limits

PAGE = Path(__file__).parents[3] / "docs" / "guides" / "web.md"


def test_the_page_says_the_bounds_of_the_code() -> None:
    rows = re.findall(r"\| ([\d,]+)( MiB| s)? \| `([A-Z_]+)` \|", PAGE.read_text())
    assert len(rows) > 15
    for figure, unit, name in rows:
        assert getattr(limits, name) == int(figure.replace(",", "")) * (MIB if unit == " MiB" else 1), name

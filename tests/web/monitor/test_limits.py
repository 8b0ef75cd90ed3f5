"""docs/design/monitor-protocol.md: its figures are the code's."""

from __future__ import annotations

import re
from pathlib import Path

from rmpa.core.limits import KIB
from rmpa.web import limits
from rmpa.web.monitor import messages, questions, session

PAGE = (Path(__file__).parents[3] / "docs" / "design" / "monitor-protocol.md").read_text(encoding="utf-8")


def test_the_page_says_the_bounds_of_the_code() -> None:
    rows = re.findall(r"\| ([\d,.]+)( KiB| s)? \| `([A-Z_]+)` \|", PAGE)
    assert len(rows) > 10
    for figure, unit, name in rows:
        assert getattr(limits, name) == float(figure.replace(",", "")) * (KIB if unit == " KiB" else 1), name


def test_each_state_is_of_a_new_snapshot() -> None:
    assert limits.WEB_SNAPSHOT_AGE < limits.STATE_PERIOD


def test_the_page_has_each_question_and_message() -> None:
    for what in questions.QUESTIONS:
        assert f"`{what}`" in PAGE
    for right in session.RIGHTS:
        assert f"`{right}`" in PAGE
    for op in session.OPS:
        assert f"`{op}`" in PAGE
    assert f"`{messages.SUBPROTOCOL}`" in PAGE

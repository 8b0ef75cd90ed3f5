"""docs/contracts.md lists every condition of direct transport, by the word that the commands show."""

from __future__ import annotations

import re
from pathlib import Path

from rmpa.bridge.direct.conditions import Condition
from rmpa.core.contract import Transport

DOCUMENT = Path(__file__).parents[3] / "docs" / "contracts.md"


def _first_column(section: str) -> list[str]:
    text = DOCUMENT.read_text("utf-8").partition(section)[2].partition("\n#")[0]
    return re.findall(r"(?m)^\| `(\w+)` \|", text)


def test_every_condition_is_documented() -> None:
    assert sorted(_first_column("### When it is relayed all the same")) == sorted(Condition)


def test_every_transport_is_documented() -> None:
    assert sorted(_first_column("## Which transport when")) == sorted(Transport)

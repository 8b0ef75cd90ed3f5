"""docs/reference/security.md: each attack in its table has a test, and the test is there."""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "reference" / "security.md").read_text(encoding="utf-8")
ATTACKS = ROOT / "tests" / "interop" / "test_trust_attacks.py"
HEADER = "| attack | what happens | test |"


def rows() -> list[list[str]]:
    """The cells of the table of attacks."""
    table = PAGE.partition(HEADER)[2].partition("\n\n")[0]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in table.strip().split("\n")[1:]]


def test_each_attack_names_a_test_that_is_there() -> None:
    tree = ast.parse(ATTACKS.read_text(encoding="utf-8"))
    known = {item.name for item in tree.body if isinstance(item, ast.FunctionDef)}
    named = set()
    assert len(rows()) > 15
    for attack, _, tests in rows():
        found = re.findall(r"`(test_\w+)`", tests)
        files = re.findall(r"`(tests/[\w/.]+)`", tests)
        assert found or files, attack
        assert set(found) <= known, attack
        assert all((ROOT / file).exists() for file in files), attack
        named |= set(found)
    assert {name for name in known if name.startswith("test_")} <= named, "an attack that the page does not tell"

"""What the pages about installing and security say."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Final

_ROOT: Final = Path(__file__).parents[2]
_PAGE: Final = _ROOT / "docs/start/install.md"
_FROM_A_FILE: Final = '"$(ls $PWD/rmpa-*.whl)[record,web,zenoh,trust]"'
_INSTALLS: Final = re.compile(r"(?:pip3?|pipx|uv tool) install [^`\n]*")


def test_no_other_page_installs_rmpa_from_an_index() -> None:
    for page in (_ROOT / "README.md", *_ROOT.glob("docs/**/*.md"), *_ROOT.glob("packaging/**/*.md")):
        found = _INSTALLS.findall(page.read_text(encoding="utf-8"))
        found = [words for words in found if re.search(r"\brmpa\b", words)]
        assert all(words.endswith(_FROM_A_FILE) for words in found), page
        assert not found or page.name in {"README.md", "two-robots.md"}, page


def test_it_says_once_where_the_wheel_is() -> None:
    text = _PAGE.read_text(encoding="utf-8")
    assert len(re.findall(r"^\$ RMPA=", text, re.MULTILINE)) == 1
    commands = [words for words in _INSTALLS.findall(text) if "-c constraints" not in words]
    assert len(commands) == 3
    assert all('"$RMPA[record,web,zenoh,trust]"' in words for words in commands)


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

"""Every trap of docs/design/ros-traps.md is proved by a test that names it, or is listed here with a reason."""

from __future__ import annotations

import ast
import functools
import re
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[2]
NUMBERS: Final = tuple(sorted([*map(str, range(1, 44)), "16a"], key=lambda n: (int(n.rstrip("a")), n)))
# Traps without a test, and why.
NOT_YET: Final[dict[str, str]] = {}


@functools.cache
def _marked() -> dict[str, set[str]]:
    """The tests of each trap, as ``file::name``, by the marks in the sources."""
    found: dict[str, set[str]] = {}
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        for item in ast.walk(ast.parse(path.read_text("utf-8"))):
            if not isinstance(item, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            for mark in item.decorator_list:
                if isinstance(mark, ast.Call) and ast.unparse(mark.func) == "pytest.mark.trap":
                    for number in mark.args:
                        assert isinstance(number, ast.Constant), f"{path}: {item.name}"
                        name = f"{path.relative_to(ROOT / 'tests')}::{item.name}"
                        found.setdefault(str(number.value), set()).add(name)
    return found


def _documented() -> dict[str, str]:
    """The rows of the document, by trap."""
    text = (ROOT / "docs" / "design" / "ros-traps.md").read_text("utf-8")
    rows = re.findall(r"(?m)^\| (\d+a?) \|(.*)$", text)
    assert len(rows) == len({number for number, _ in rows})
    return dict(rows)


def test_every_trap_has_a_test_or_a_reason() -> None:
    marked = _marked()
    assert marked.keys() <= set(NUMBERS), "a mark names a trap that does not exist"
    assert [n for n in NUMBERS if n not in marked and n not in NOT_YET] == []
    assert [n for n in NOT_YET if n in marked] == [], "proved by now: take it out of the table"


def test_the_document_has_every_trap_and_names_tests_that_prove_it() -> None:
    marked, rows = _marked(), _documented()
    assert tuple(rows) == NUMBERS
    for number, row in rows.items():
        named = set(re.findall(r"`([\w/]+\.py::test_\w+)`", row))
        assert named <= marked.get(number, set()), f"trap {number}: {named} is not marked so"
        assert named or number in NOT_YET, f"trap {number} names no test"

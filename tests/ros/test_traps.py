"""Every row of docs/design/ros-traps.md and complaints.md names tests that exist, and all tests that name it."""

from __future__ import annotations

import functools
import re
from pathlib import Path
from typing import Final

import pytest

ROOT: Final = Path(__file__).parents[2]
ROWS: Final = {
    "trap": ("ros-traps.md", [*map(str, range(1, 17)), "16a", *map(str, range(17, 44))]),
    "complaint": ("complaints.md", [*map(str, range(1, 29))]),
}
"""Of each mark of tests: the document, and its rows."""
_TEST: Final = re.compile(r"(?m)^(?:@pytest\.mark\.(trap|complaint)\((.*)\)|(?:async )?def (test_\w+))")


@functools.cache
def _tests() -> tuple[set[str], set[tuple[str, str, str]]]:
    """All tests as ``file::name``; and those that are marked, each behind its mark and a row."""
    every, marked = set[str](), set[tuple[str, str, str]]()
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        rows = list[tuple[str, str]]()
        for mark, numbers, test in _TEST.findall(path.read_text("utf-8")):
            rows += [(mark, number) for number in re.findall(r"\d+a?", numbers)]
            if test:
                name = f"{path.relative_to(ROOT / 'tests')}::{test}"
                every.add(name)
                marked.update((*row, name) for row in rows)
                rows = []
    return every, marked


@pytest.mark.parametrize("mark", ROWS)
def test_every_row_names_tests_that_exist_and_all_that_name_it(mark: str) -> None:
    (document, numbers), (every, marked) = ROWS[mark], _tests()
    text = (ROOT / "docs" / "design" / document).read_text("utf-8")
    rows: list[tuple[str, str]] = re.findall(r"(?m)^\| (\d+a?) \|(.*)$", text)
    assert [number for number, _ in rows] == numbers
    assert {number for kind, number, _ in marked if kind == mark} <= set(numbers), "a mark names no row"
    for number, row in rows:
        named = set(re.findall(r"`([\w/]+\.py::test_\w+)`", row))
        proofs = {name for kind, of, name in marked if (kind, of) == (mark, number)}
        assert named, f"row {number} names no test"
        assert named <= (proofs if mark == "trap" else every), f"row {number}: {named - proofs} is no proof of it"
        assert mark == "trap" or proofs <= named, f"row {number} leaves out {proofs - named}"
        assert proofs or mark == "complaint", f"no test proves trap {number}"

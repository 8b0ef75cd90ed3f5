"""Every row of docs/design/complaints.md names tests that exist, and every test that names a row is in it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[2]
ROWS: Final = tuple(map(str, range(1, 29)))


def _tests() -> tuple[set[str], dict[str, set[str]]]:
    """All tests as ``file::name``, and those that are marked with a row."""
    every: set[str] = set()
    marked: dict[str, set[str]] = {}
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        text, numbers = path.read_text("utf-8"), list[str]()
        for mark, test in re.findall(r"(?m)^(?:@pytest\.mark\.complaint\((.*)\)|(?:async )?def (test_\w+))", text):
            numbers += re.findall(r"\d+", mark)
            if test:
                name = f"{path.relative_to(ROOT / 'tests')}::{test}"
                every.add(name)
                for number in numbers:
                    marked.setdefault(number, set()).add(name)
                numbers = []
    return every, marked


def _documented() -> dict[str, str]:
    """The rows of the document, by number."""
    text = (ROOT / "docs" / "design" / "complaints.md").read_text("utf-8")
    rows = re.findall(r"(?m)^\| (\d+) \|(.*)$", text)
    assert len(rows) == len({number for number, _ in rows})
    return dict(rows)


def test_every_row_names_tests_that_exist_and_all_that_name_it() -> None:
    every, marked = _tests()
    rows = _documented()
    assert tuple(rows) == ROWS
    assert marked.keys() <= set(ROWS), "a mark names a row that does not exist"
    for number, row in rows.items():
        named = set(re.findall(r"`([\w/]+\.py::test_\w+)`", row))
        assert named, f"row {number} names no test"
        assert named <= every, f"row {number}: {named - every} does not exist"
        assert marked.get(number, set()) <= named, f"row {number} leaves out {marked[number] - named}"

"""Tables come back from CSV as they were."""

from __future__ import annotations

import io
import math
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.experiments.model import Table
from lab.experiments.table_file import kinds, read, write

if TYPE_CHECKING:
    from lab.experiments.model import Value


def there_and_back(table: Table) -> Table:
    file = io.StringIO(newline="")
    write(file, table)
    file.seek(0)
    return read(file, kinds(table))


def test_the_file_is_plain_csv() -> None:
    file = io.StringIO()
    write(file, Table(("topic", "due_ns", "late", "first"), [("/cmd", 12, 0.5, True), ('/a "b"', 13, 1e-9, False)]))
    assert file.getvalue() == 'topic,due_ns,late,first\n/cmd,12,0.5,true\n"/a ""b""",13,1e-09,false\n'


def test_what_columns_hold() -> None:
    table = Table(tuple("abcdefg"), [(1, 1.0, 1, "x", True, None, None), (2, 2.0, 2.5, "", False, None, 7)])
    assert list(kinds(table).values()) == ["int", "float", "number", "str", "bool", "none", "int?"]


COLUMNS = st.one_of(
    st.lists(st.none() | st.integers(), min_size=3, max_size=3),
    st.lists(st.none() | st.booleans(), min_size=3, max_size=3),
    st.lists(st.none() | st.integers() | st.floats(allow_nan=False), min_size=3, max_size=3),
    st.lists(st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\r\n\0")), min_size=3, max_size=3),
    st.lists(st.none() | st.sampled_from(["1", "true", "a,b", '"', " "]), min_size=3, max_size=3),
)


@given(st.lists(COLUMNS, min_size=1, max_size=5))
def test_each_value_comes_back_as_it_was(columns: list[list[Value]]) -> None:
    table = Table(tuple(f"c{number}" for number in range(len(columns))), list(zip(*columns, strict=True)))
    back = there_and_back(table)
    assert back == table
    assert [[type(value) for value in row] for row in back.rows] == [
        [type(value) for value in row] for row in table.rows
    ]


def test_figures_that_are_not_numbers() -> None:
    rows = there_and_back(Table(("x",), [(math.inf,), (-math.inf,), (math.nan,)])).rows
    assert rows[0] == (math.inf,)
    assert rows[1] == (-math.inf,)
    assert math.isnan(float(rows[2][0] or 0))


def test_a_table_without_rows_keeps_its_columns() -> None:
    assert there_and_back(Table(("a", "b"), [])) == Table(("a", "b"), [])


@pytest.mark.parametrize(
    ("table", "why"),
    [
        (Table(("a",), [("x",), (1,)]), "column a holds int, str"),
        (Table(("a",), [("",), (None,)]), "look alike"),
        (Table(("a", "b"), [(1,)]), "row 0 has 1 values"),
        (Table(("a", "a"), []), "one name"),
        (Table(("a",), [("x\ny",)]), "several lines"),
    ],
)
def test_what_would_come_back_as_something_else_is_refused(table: Table, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        kinds(table)


@pytest.mark.parametrize(
    "text", ["a\n1\n", "a,b\n1\n", "a,b\n1,x\n", "a,b\n1,2,true\n", "", "a,b\n,true\n", "b,a\n1,true\n"]
)
def test_a_file_that_holds_something_else_is_refused(text: str) -> None:
    with pytest.raises(ValueError):
        read(io.StringIO(text), {"a": "int", "b": "bool"})

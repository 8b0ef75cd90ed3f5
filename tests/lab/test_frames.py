"""Tables come back from CSV as they were, and say when messages came."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pandas.testing import assert_frame_equal

from lab.frames import frame, kinds, lost, read, write

if TYPE_CHECKING:
    from lab.experiments.model import Value


def there_and_back(table: pd.DataFrame) -> pd.DataFrame:
    file = io.StringIO(newline="")
    write(file, table)
    file.seek(0)
    return read(file, kinds(table))


def test_the_file_is_plain_csv() -> None:
    file = io.StringIO()
    write(file, frame(("topic", "due_ns", "late", "first"), [("/cmd", 12, 0.5, True), ('/a "b"', 13, 1e-9, False)]))
    assert file.getvalue() == 'topic,due_ns,late,first\n/cmd,12,0.5,True\n"/a ""b""",13,1e-09,False\n'


COLUMNS = st.one_of(
    st.lists(st.integers(-(2**63), 2**63 - 1), min_size=3, max_size=3),
    st.lists(st.booleans(), min_size=3, max_size=3),
    st.lists(st.none() | st.floats(allow_nan=False), min_size=3, max_size=3),
    st.lists(
        st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\r\n\0"), min_size=1).filter(
            lambda text: text != "nan"
        ),
        min_size=3,
        max_size=3,
    ),
    st.lists(st.none() | st.sampled_from(["1", "true", "a,b", '"', " "]), min_size=3, max_size=3),
)


@given(st.lists(COLUMNS, min_size=1, max_size=5))
def test_each_value_comes_back_as_it_was(columns: list[list[Value]]) -> None:
    table = frame([f"c{number}" for number in range(len(columns))], list(zip(*columns, strict=True)))
    assert_frame_equal(there_and_back(table), table, check_dtype=False, check_exact=True)


def test_tables_of_older_runs_are_read() -> None:
    text = "first,n,late\ntrue,1,\nfalse,2.5,7\n"
    table = read(io.StringIO(text), {"first": "bool", "n": "number", "late": "int?"})
    assert table["first"].tolist() == [True, False]
    assert table["n"].tolist() == [1.0, 2.5]
    assert table["late"].dropna().tolist() == [7]


@pytest.mark.parametrize(
    ("table", "why"),
    [
        (frame(("a",), [("x",), (1,)]), "column a holds int, str"),
        (frame(("a",), [("",), (None,)]), "look alike"),
        (pd.DataFrame([[1, 2]], columns=["a", "a"]), "one name"),
        (frame(("a",), [("x\ny",)]), "several lines"),
    ],
)
def test_what_would_come_back_as_something_else_is_refused(table: pd.DataFrame, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        kinds(table)


@pytest.mark.parametrize(
    "text", ["a\n1\n", "a,b\n1\n", "a,b\n1,x\n", "a,b\n1,2,true\n", "", "a,b\n,true\n", "b,a\n1,true\n"]
)
def test_a_file_that_holds_something_else_is_refused(text: str) -> None:
    with pytest.raises(ValueError):
        read(io.StringIO(text), {"a": "int", "b": "bool"})


CAME = frame(
    ("rate", "sequence", "due_ns", "came_ns"),
    [(10, 0, 1_000_000, 1_500_000), (10, 2, 3_000_000, 3_250_000), (20, 0, 7_000_000, 9_000_000)],
)
SENT = frame(("rate", "sequence", "late_ns"), [(10, 1, 500), (10, 0, 100), (10, 2, 0), (20, 0, 5)])


def test_what_was_sent_and_never_came_is_lost_whatever_came_twice() -> None:
    assert lost(CAME, SENT, rate=10) == 1
    assert lost(pd.concat([CAME, CAME[2:]]), SENT, rate=20) == 0

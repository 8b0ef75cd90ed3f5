"""ROS names and globs."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core import identity as names

NAMES = st.from_regex(r"/[A-Za-z]\w{0,5}(/\w{1,5}){0,3}", fullmatch=True).filter(str.isascii)


@pytest.mark.parametrize("name", ["", "/", "a", "/a/b", "~a", "a_1/b2", "A"])
def test_legal_names(name: str) -> None:
    assert names.is_legal_name(name)


@pytest.mark.parametrize("name", ["1a", "a b", "a-b", "a//b", "é", "_a", "a.b", "a\n"])
def test_illegal_names(name: str) -> None:
    assert not names.is_legal_name(name)


@pytest.mark.parametrize(
    ("name", "is_global"), [("/", True), ("/a", True), ("/a/", False), ("a", False), ("~a", False)]
)
def test_global_names(name: str, is_global: bool) -> None:
    assert names.is_global_name(name) is is_global


@pytest.mark.parametrize(
    ("name", "is_type"), [("a/B", True), ("a_1/B2", True), ("a", False), ("a/b/c", False), ("*", False)]
)
def test_type_names(name: str, is_type: bool) -> None:
    assert names.is_type_name(name) is is_type


@pytest.mark.parametrize(
    ("name", "namespace", "node", "resolved"),
    [
        ("/a", "/ns", "/n", "/a"),
        ("a", "/ns", "/n", "/ns/a"),
        ("a", "/", "", "/a"),
        ("~a", "/ns", "/ns/n", "/ns/n/a"),
        ("~/a", "/ns", "/ns/n", "/ns/n/a"),
        ("", "/ns", "", "/ns"),
        ("a/", "/ns/", "", "/ns/a"),
    ],
)
def test_resolving(name: str, namespace: str, node: str, resolved: str) -> None:
    assert names.resolve_name(name, namespace, node) == resolved


@given(NAMES)
def test_resolved_names_are_global_and_stay(name: str) -> None:
    assert names.is_global_name(names.resolve_name(name))
    assert names.resolve_name(names.resolve_name(name)) == names.resolve_name(name)


def test_an_illegal_name_is_not_resolved() -> None:
    with pytest.raises(ValueError, match="not a ROS name"):
        names.resolve_name("a b")


@pytest.mark.parametrize(
    ("pattern", "name", "fits"),
    [
        ("/**", "/a/b", True),
        ("/a", "/a", True),
        ("/a", "/a/b", False),
        ("/*", "/a", True),
        ("/*", "/a/b", False),
        ("/a/**", "/a", True),
        ("/a/**", "/a/b/c", True),
        ("/a/**", "/ab", False),
        ("/**/b", "/a/x/b", True),
        ("/**/b", "/b", True),
        ("/**/b", "/ab", False),
        ("/**/b/**", "/b", True),
        ("/a/**/b", "/a/b", True),
        ("/a/**/b", "/a/x/y/b", True),
        ("/a/**/b", "/ab", False),
        ("/*/**/**", "/a", True),
        ("/**/**/b", "/b", True),
        ("/a/**/**/b", "/a/b", True),
        ("/a/**/**", "/ab", False),
        ("/?", "/a", True),
        ("/?", "/ab", False),
        ("/a.b", "/axb", False),
        ("sensor_msgs/*", "sensor_msgs/Joy", True),
        ("**", "sensor_msgs/Joy", True),
    ],
)
def test_globs(pattern: str, name: str, fits: bool) -> None:
    assert names.matches(pattern, name) is fits


@given(NAMES)
def test_every_name_matches_itself_and_all(name: str) -> None:
    assert names.matches(name, name)
    assert names.matches("/**", name)

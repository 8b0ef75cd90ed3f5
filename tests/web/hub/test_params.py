from __future__ import annotations

from typing import Any

import pytest

from rmpa.web.hub.node_link import NodeLink
from rmpa.web.hub.params import ParamMirror


@pytest.fixture
def mirror() -> ParamMirror:
    made = ParamMirror(NodeLink(None, None))  # type: ignore[arg-type]
    made.updated("/", {"a": {"x": 1, "y": [1, 2]}, "b": "text"})
    return made


def followed(mirror: ParamMirror, *names: str) -> list[Any]:
    told: list[Any] = []
    mirror.follow(names, lambda values: told.append(dict(values)))
    return told


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("/a/x/", 2, {"/a/x": 2}),
        ("/a/x", 1.0, {"/a/x": 1.0}),
        ("/c", {"d": 1}, {"/c/d": 1}),
        ("/a", {"x": 1}, {"/a/y": None}),
        ("/a", 5, {"/a/x": None, "/a/y": None, "/a": 5}),
        ("/b", {"c": 1}, {"/b/c": 1, "/b": None}),
        ("/a", {}, {"/a/x": None, "/a/y": None}),
        ("/none", {}, None),
        ("/a/x", 1, None),
    ],
)
def test_a_follower_of_all_is_told_the_leaves_that_changed(
    mirror: ParamMirror, key: str, value: Any, told: Any
) -> None:
    everything = followed(mirror)
    mirror.updated(key, value)
    assert everything == ([told] if told is not None else [])


def test_a_follower_of_a_name_is_told_what_is_there_now(mirror: ParamMirror) -> None:
    namespace, leaf = followed(mirror, "/a"), followed(mirror, "/a/x", "/z")
    mirror.updated("/a/x", 3)
    assert namespace == [{"/a": {"x": 3, "y": [1, 2]}}]
    assert leaf == [{"/a/x": 3}]
    mirror.updated("/b", "other")
    assert (len(namespace), len(leaf)) == (1, 1)
    mirror.updated("/a", {})
    assert (namespace[-1], leaf[-1]) == ({"/a": None}, {"/a/x": None})


def test_values_by_name_and_by_prefix(mirror: ParamMirror) -> None:
    assert mirror.values(("/a/x", "/none"), "/") == {"/a/x": 1}
    assert mirror.values((), "/") == {"/a/x": 1, "/a/y": [1, 2], "/b": "text"}
    assert mirror.values((), "/a") == {"/a/x": 1, "/a/y": [1, 2]}
    assert mirror.values((), "/none") == {}

"""Parts of the hub alone: the copy of the parameters, buffers for payloads, files of packages."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from rmpa.core.errors import LimitExceeded, RmpaError
from rmpa.web import limits
from rmpa.web.hub.node_link import NodeLink
from rmpa.web.hub.params import ParamMirror
from rmpa.web.hub.services import read_asset
from rmpa.web.hub.topics import PayloadBuffers


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


def test_values_by_name_and_of_all(mirror: ParamMirror) -> None:
    assert mirror.values(("/a/x", "/none")) == {"/a/x": 1}
    assert mirror.values() == {"/a/x": 1, "/a/y": [1, 2], "/b": "text"}


SIZE = 100_000


def data(byte: bytes, size: int = SIZE) -> memoryview:
    return memoryview(byte * size)


def test_a_copy_stays_as_it_is_while_there_is_a_view_of_it() -> None:
    buffers = PayloadBuffers()
    first = buffers.copy(data(b"a"))
    part = buffers.copy(data(b"b"))[10:20]
    for byte in (b"c", b"d", b"e"):
        assert buffers.copy(data(byte)) == byte * SIZE
    assert (bytes(first), bytes(part), buffers.bytes) == (b"a" * SIZE, b"b" * 10, 3 * SIZE)
    for size in (10, SIZE):
        with pytest.raises(TypeError):
            buffers.copy(data(b"a", size))[0] = 1


def test_the_bytes_that_are_kept_are_bounded() -> None:
    buffers = PayloadBuffers(10 * SIZE)
    used = [buffers.copy(data(b"a")) for _ in range(30)]
    assert buffers.bytes == 10 * SIZE
    assert all(view == b"a" * SIZE for view in used)
    assert buffers.copy(data(b"b", 11 * SIZE)) == b"b" * 11 * SIZE
    assert buffers.bytes == 0
    small = [buffers.copy(data(b"c", limits.PAYLOAD_BUFFER_MIN)) for _ in range(2 * limits.PAYLOAD_BUFFERS_MAX)]
    assert buffers.bytes <= limits.PAYLOAD_BUFFERS_MAX * limits.PAYLOAD_BUFFER_MIN
    assert all(view[-1] == ord("c") for view in small)
    buffers.clear()
    assert buffers.bytes == 0


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    """A workspace with the package ``arm`` in a folder of its own."""
    package = tmp_path / "src" / "robot" / "arm"
    (package / "meshes").mkdir(parents=True)
    (package / "package.xml").write_text("<package><name>arm</name></package>")
    (package / "meshes" / "link.stl").write_bytes(b"solid")
    (tmp_path / "src" / "secret").write_text("secret")
    (package / "out").symlink_to(tmp_path / "src" / "secret")
    return tmp_path / "src"


def read(workspace: Path, uri: str, most: int = 100) -> bytes:
    return read_asset(uri, most, {"ROS_PACKAGE_PATH": str(workspace)})


def test_a_file_is_found_wherever_its_package_is_and_a_large_one_is_not_read(
    workspace: Path,
) -> None:
    for place in (workspace, workspace / "robot"):
        assert read(place, "package://arm/meshes/link.stl") == b"solid"
    with pytest.raises(LimitExceeded):
        read(workspace, "package://arm/meshes/link.stl", most=4)


@pytest.mark.parametrize("path", ["../../secret", "out", "meshes/../../../secret", "/etc/passwd"])
def test_nothing_outside_of_the_package_is_read(workspace: Path, path: str) -> None:
    with pytest.raises(RmpaError, match="outside of its package"):
        read(workspace, f"package://arm/{path}")


@pytest.mark.parametrize(
    ("uri", "text"),
    [
        ("package://arm/meshes/none.stl", "has no file meshes/none.stl"),
        ("package://arm/meshes", "has no file meshes"),
        ("package://leg/link.stl", "package leg is not found; source its workspace"),
        ("package://../secret", "is not found"),
        ("package://arm/%2e%2e/%2e%2e/secret", "has no file"),
        ("package:///etc/passwd", "write package://NAME/PATH"),
        ("/etc/passwd", "write package://NAME/PATH"),
        ("package://arm/a\0b", "write package://NAME/PATH"),
        ("file:///etc/passwd", "write package://NAME/PATH"),
        ("package://arm", "write package://NAME/PATH"),
        (f"package://{'a' * 300}/link.stl", "cannot be read: File name too long"),
        (f"package://arm/{'a' * 300}", "cannot be read: File name too long"),
    ],
)
def test_what_cannot_be_had_is_told(workspace: Path, uri: str, text: str) -> None:
    with pytest.raises(RmpaError) as error:
        read(workspace, uri)
    assert text in str(error.value)

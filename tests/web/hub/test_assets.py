from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from rmpa.core.errors import LimitExceeded
from rmpa.web.hub.services import AssetError, read_asset

if TYPE_CHECKING:
    from pathlib import Path


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


def test_a_file_is_found_wherever_its_package_is_in_the_workspace(workspace: Path) -> None:
    assert read(workspace, "package://arm/meshes/link.stl") == b"solid"
    assert read(workspace / "robot", "package://arm/meshes/link.stl") == b"solid"


@pytest.mark.parametrize("path", ["../../secret", "out", "meshes/../../../secret", "/etc/passwd"])
def test_nothing_outside_of_the_package_is_read(workspace: Path, path: str) -> None:
    with pytest.raises(AssetError, match="outside of its package"):
        read(workspace, f"package://arm/{path}")


@pytest.mark.parametrize(
    ("uri", "text"),
    [
        ("package://arm/meshes/none.stl", "has no file meshes/none.stl"),
        ("package://arm/meshes", "has no file meshes"),
        ("package://leg/link.stl", "package leg is not found; source its workspace"),
        ("package://../secret", "is not found"),
        ("file:///etc/passwd", "write package://NAME/PATH"),
        ("package://arm", "write package://NAME/PATH"),
        (f"package://{'a' * 300}/link.stl", "cannot be read: File name too long"),
        (f"package://arm/{'a' * 300}", "cannot be read: File name too long"),
    ],
)
def test_what_cannot_be_had_is_told(workspace: Path, uri: str, text: str) -> None:
    with pytest.raises(AssetError) as error:
        read(workspace, uri)
    assert text in str(error.value)


def test_a_large_file_is_not_read(workspace: Path) -> None:
    with pytest.raises(LimitExceeded):
        read(workspace, "package://arm/meshes/link.stl", most=4)

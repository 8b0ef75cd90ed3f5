from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

import pytest

from rmpa.ros import limits
from rmpa.ros.types.installed import package_folders, packages_below, read_text
from tests.ros.types.workspaces import package

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@pytest.fixture(autouse=True)
def fresh() -> Iterator[None]:
    packages_below.cache_clear()
    yield
    packages_below.cache_clear()


def names(root: Path) -> dict[str, list[str]]:
    found, whole = packages_below(str(root))
    assert whole
    return {name: [str(folder.relative_to(root)) for folder in found[name]] for name in sorted(found)}


def test_packages_in_nested_folders(tmp_path: Path) -> None:
    package(tmp_path / "a_msgs", msg_A="int8 a")
    package(tmp_path / "stack" / "deep" / "er" / "b_folder", "b_msgs", srv_B="---")
    package(tmp_path / "c_msgs", action_C="---\n---")
    package(tmp_path / "only_code")
    rosbuild = package(tmp_path / "old_msgs", msg_O="int8 o")
    (rosbuild / "package.xml").rename(rosbuild / "manifest.xml")
    (tmp_path / "loose" / "msg").mkdir(parents=True)
    assert names(tmp_path) == {
        "a_msgs": ["a_msgs"],
        "b_msgs": ["stack/deep/er/b_folder"],
        "c_msgs": ["c_msgs"],
        "loose": ["loose"],
        "old_msgs": ["old_msgs"],
    }


def test_what_is_hidden(tmp_path: Path) -> None:
    hidden = package(tmp_path / "hidden" / "h_msgs", msg_H="int8 h")
    (tmp_path / "hidden" / "CATKIN_IGNORE").touch()
    outer = package(tmp_path / "outer", msg_O="int8 o")
    package(outer / "inner", msg_I="int8 i")
    package(tmp_path / ".git" / "g_msgs", msg_G="int8 g")
    package(tmp_path / "bare" / "n_msgs", msg_N="int8 n")
    (tmp_path / "bare" / "rospack_nosubdirs").touch()
    assert names(tmp_path) == {"outer": ["outer"]}
    (tmp_path / "ignored").symlink_to(hidden)
    (hidden / "CATKIN_IGNORE").touch()
    assert list(package_folders("h_msgs", str(hidden.parent))) == []


def test_the_root_itself_may_be_a_package(tmp_path: Path) -> None:
    root = package(tmp_path / "my_msgs", msg_M="int8 m")
    assert list(package_folders("my_msgs", str(root))) == [root]
    assert packages_below(str(tmp_path / "nothing"))[0] == {}
    assert packages_below(str(root / "package.xml"))[0] == {}


def test_a_package_right_below_needs_no_search(tmp_path: Path) -> None:
    made = package(tmp_path / "my_msgs", msg_M="int8 m")
    twin = package(tmp_path / "x" / "my_msgs", msg_M="int8 m")
    package(tmp_path / "your_msgs", "their_msgs", msg_T="int8 t")
    found = package_folders("my_msgs", str(tmp_path))
    assert next(found) == made
    assert packages_below.cache_info().currsize == 0
    assert list(found) == [twin]
    assert list(package_folders("your_msgs", str(tmp_path))) == []
    (tmp_path / "loose" / "msg").mkdir(parents=True)
    packages_below.cache_clear()
    assert list(package_folders("loose", str(tmp_path))) == [tmp_path / "loose"]
    assert list(package_folders("their_msgs", str(tmp_path))) == [tmp_path / "your_msgs"]


def test_loops_and_what_cannot_be_read_are_passed_over(tmp_path: Path) -> None:
    made = package(tmp_path / "src" / "my_msgs", msg_M="int8 m")
    (tmp_path / "src" / "again").symlink_to(tmp_path)
    (tmp_path / "src" / "self").symlink_to("self")
    (tmp_path / "src" / "gone").symlink_to("nowhere")
    os.mkfifo(tmp_path / "src" / "pipe")
    (tmp_path / "src" / os.fsdecode(b"\xff\xfe")).mkdir()
    locked = tmp_path / "src" / "locked"
    locked.mkdir(mode=0)
    (tmp_path / "linked").symlink_to(made)
    found, whole = packages_below(str(tmp_path))
    assert whole
    assert list(found) == ["my_msgs"]
    assert len(found["my_msgs"]) == 1  # each folder once, by whichever name comes first
    locked.chmod(0o700)


def test_a_huge_tree_is_searched_as_far_as_the_limits_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package(tmp_path / "near_msgs", msg_N="int8 n")
    for number in range(20):
        (tmp_path / "many" / str(number)).mkdir(parents=True)
    package(tmp_path / "many" / "9" / "x" / "far_msgs", msg_F="int8 f")
    monkeypatch.setattr(limits, "PACKAGE_FOLDERS_MAX", 10)
    found, whole = packages_below(str(tmp_path))
    assert not whole
    assert list(found) == ["near_msgs"]
    packages_below.cache_clear()
    monkeypatch.setattr(limits, "PACKAGE_FOLDERS_MAX", 1000)
    monkeypatch.setattr(limits, "PACKAGE_DEPTH_MAX", 2)
    assert not packages_below(str(tmp_path))[1]
    packages_below.cache_clear()
    monkeypatch.setattr(limits, "PACKAGE_DEPTH_MAX", 9)
    monkeypatch.setattr(limits, "PACKAGE_ENTRIES_MAX", 15)
    assert not packages_below(str(tmp_path))[1]


def test_only_regular_files_of_some_size_are_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "large").write_text("x" * 11)
    (tmp_path / "binary").write_bytes(b"# caf\xe9\n")
    assert read_text(tmp_path / "pipe", 10) is None
    assert read_text(tmp_path / "large", 10) is None
    assert read_text(tmp_path, 10_000) is None
    assert read_text(tmp_path / "a\0b", 10) is None
    assert read_text(tmp_path / "binary", 10) == "# caf\udce9\n"
    assert sys.getfilesystemencoding() == "utf-8"

"""Definitions that are found: packages of workspaces, and what is missing."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from rmpa.ros import limits
from rmpa.ros.types import find as header_types
from rmpa.ros.types import installed
from rmpa.ros.types.definitions import SEPARATOR, DefinitionError, UnknownTypeError
from rmpa.ros.types.find import TYPE_MISSING, find_message_type, find_service_type, type_of_header
from rmpa.ros.types.installed import ServiceType, package_folders, packages_below, read_text
from rmpa.ros.types.messages import MessageType
from tests.ros.types.workspaces import nothing_installed, package

STRING: Final = "992ce8a1687cec8c8bd883ec73ca41d1"


@pytest.fixture(autouse=True)
def no_system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Nothing is installed but what a test puts to ``opt``."""
    nothing_installed(tmp_path, monkeypatch)
    header_types._searched.cache_clear()
    yield
    packages_below.cache_clear()
    header_types._searched.cache_clear()


def sums(name: str, **environ: Path | str) -> str:
    return find_message_type(name, environ={key: str(value) for key, value in environ.items()}).md5sum


def genpy(folder: Path, full_text: str) -> None:
    """What genpy makes of a message; it must not be run."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    base = folder.stem[1:]
    folder.write_text(
        f'raise SystemExit\nclass {base}(genpy.Message):\n  _md5sum = "0"\n  _full_text = """{full_text}"""\n'
    )


def test_a_message_of_a_workspace_with_all_that_it_embeds(tmp_path: Path) -> None:
    package(
        tmp_path / "src" / "stack" / "my_msgs",
        msg_Path="# a path\nHeader header\nPose[] poses\nother_msgs/Kind kind\nuint8 MAX = 7\nstring NAME= a # b\n",
        msg_Pose="geometry_msgs/Point at\nNothing nothing\n",
        msg_Nothing="",
    )
    package(tmp_path / "src" / "other_msgs", msg_Kind="uint8 value\n")
    kind = find_message_type("my_msgs/Path", environ={"ROS_PACKAGE_PATH": str(tmp_path / "src")})
    message = kind.make({"poses": [{"at": {"x": 1.5}}], "kind": {"value": 3}})
    assert kind.to_plain(kind.deserialize(kind.serialize(message)))["kind"] == {"value": 3}
    # To the byte what genmsg makes: a subscriber learns the same type from it.
    assert MessageType.learn(kind.name, kind.definition).md5sum == kind.md5sum
    assert kind.definition.startswith("# a path\nHeader header\nPose[] poses\n")
    assert kind.definition.count(f"{SEPARATOR}\nMSG: ") == 5
    assert kind.source == str(tmp_path / "src" / "stack" / "my_msgs" / "msg" / "Path.msg")


def test_the_earlier_root_wins(tmp_path: Path) -> None:
    package(tmp_path / "a" / "deep" / "my_msgs", msg_M="int8 a")
    package(tmp_path / "b" / "my_msgs", msg_M="int8 b")
    first, second = tmp_path / "a", tmp_path / "b"
    one = sums("my_msgs/M", ROS_PACKAGE_PATH=f"{first}:{second}")
    other = sums("my_msgs/M", ROS_PACKAGE_PATH=f"/nowhere::{second}:{first}")
    assert one == sums("my_msgs/M", ROS_PACKAGE_PATH=first) != other == sums("my_msgs/M", ROS_PACKAGE_PATH=second)
    environ = {"ROS_PACKAGE_PATH": f"{first}:{second}"}
    assert find_message_type("my_msgs/M", other, environ).md5sum == other  # the version that is meant, wherever it is
    with pytest.raises(
        DefinitionError, match=f"has the md5 sum {one} here .*a/deep/my_msgs/msg/M.msg.*, and 0 there"
    ):
        find_message_type("my_msgs/M", "0", environ)


def test_devel_and_install_spaces(tmp_path: Path) -> None:
    package(tmp_path / "src" / "my_msgs", msg_M="int8 m")
    devel = tmp_path / "devel"
    package(devel / "share" / "my_msgs", msg_DoGoal="int8 goal")
    (devel / ".catkin").write_text(f"{tmp_path / 'src'};{tmp_path / 'gone'}")
    assert sums("my_msgs/M", CMAKE_PREFIX_PATH=devel) == sums("my_msgs/M", ROS_PACKAGE_PATH=tmp_path / "src")
    assert sums("my_msgs/DoGoal", CMAKE_PREFIX_PATH=f"/nowhere:{devel}")
    install = tmp_path / "install"
    package(install / "share" / "my_msgs", msg_M="int8 installed")
    (install / ".catkin").touch()
    assert sums("my_msgs/M", CMAKE_PREFIX_PATH=f"{install}:{devel}") != sums("my_msgs/M", CMAKE_PREFIX_PATH=devel)


def test_what_genpy_made_is_read_and_not_run(tmp_path: Path) -> None:
    inner = f"{SEPARATOR}\nMSG: my_msgs/Thing\nint8 x\n{SEPARATOR}\nMSG: b/C\nint8 c # "
    text = '# says \\"\\"\\"x\\"\\"\\", and \\d\nThing a\n' + inner + '\\"'
    genpy(tmp_path / "python" / "my_msgs" / "msg" / "_M.py", text)
    (tmp_path / "python" / "my_msgs" / "msg" / "_Bad.py").write_text('class Bad(\n  _full_text = """int8 cut off')
    package(tmp_path / "src" / "my_msgs", msg_M="int8 other", msg_Bad="int8 good")
    environ = {"PYTHONPATH": str(tmp_path / "python"), "ROS_PACKAGE_PATH": str(tmp_path / "src")}
    kind = find_message_type("my_msgs/M", environ=environ)
    assert [str(field) for field in kind.fields] == ["my_msgs/Thing"]
    assert find_message_type("my_msgs/Bad", environ=environ).fields[0].name == "good"
    assert kind.definition.startswith('# says """x""", and \\d\nThing a\n')
    (tmp_path / "install" / "lib" / "python3").mkdir(parents=True)
    (tmp_path / "install" / "lib" / "python3" / "dist-packages").symlink_to(tmp_path / "python")
    assert sums("my_msgs/M", CMAKE_PREFIX_PATH=tmp_path / "install") == kind.md5sum


def test_services(tmp_path: Path) -> None:
    package(
        tmp_path / "src" / "my_pkg",
        srv_Do="Thing thing\nstd_msgs/Header header\n---\nmy_pkg/Thing[] things\n",
        msg_Thing="int32 a\n",
    )
    environ = {"ROS_PACKAGE_PATH": str(tmp_path)}
    kind = find_service_type("my_pkg/Do", environ=environ)
    assert kind.request.serialize(kind.request.make([[7], {}])) == b"\x07" + bytes(3) + bytes(16)
    module = tmp_path / "python" / "my_pkg" / "srv" / "_Do.py"
    module.parent.mkdir(parents=True)
    module.write_text(
        "raise SystemExit\n"
        "class DoRequest(genpy.Message):\n"
        f'  _full_text = """Thing a\n{SEPARATOR}\nMSG: my_pkg/Thing\nint8 x\n"""\n'
        "class DoResponse(genpy.Message):\n"
        '  _md5sum = "x"\n'
        '  _full_text = """string s\n"""\n'
    )
    both = environ | {"PYTHONPATH": str(tmp_path / "python")}
    assert find_service_type("my_pkg/Do", environ=both).response.fields[0].name == "s"
    assert find_service_type("my_pkg/Do", kind.md5sum, both).md5sum == kind.md5sum
    assert find_service_type("std_srvs/Empty", environ=environ).source == ""
    with pytest.raises(UnknownTypeError) as caught:
        find_service_type("my_pkg/Don", environ=environ)
    assert str(caught.value) == (
        f"service type my_pkg/Don: is not in package my_pkg ({tmp_path}/src/my_pkg); looked in ROS_PACKAGE_PATH "
        f"({tmp_path}), CMAKE_PREFIX_PATH (not set), PYTHONPATH (not set), and at what comes with rmpa; did you mean "
        "my_pkg/Do? Else source the workspace that has it; no server sends its definition"
    )


def test_a_workspace_goes_before_what_comes_with_us(tmp_path: Path) -> None:
    package(tmp_path / "src" / "std_msgs", msg_String="string data\nint8 more\n", msg_Bool="bool data")
    package(tmp_path / "opt" / "noetic" / "share" / "std_msgs", msg_String="int8 system", msg_Own="int8 own")
    package(tmp_path / "opt" / "melodic" / "share" / "std_msgs", msg_Own="int8 older")
    assert sums("std_msgs/String") == STRING
    assert sums("std_msgs/String", ROS_PACKAGE_PATH=tmp_path / "src") != STRING
    # The same version: ours, which is ready sooner.
    same = find_message_type("std_msgs/Bool", environ={"ROS_PACKAGE_PATH": str(tmp_path / "src")})
    assert same.source == ""
    assert find_message_type("std_msgs/Own", environ={}).fields[0].name == "own"
    assert find_message_type("std_msgs/Own", environ={"ROS_DISTRO": "melodic"}).fields[0].name == "older"
    assert find_message_type("std_msgs/String", STRING, {"ROS_PACKAGE_PATH": str(tmp_path / "src")}).md5sum == STRING


def test_unknown_type_names_the_searched_places(tmp_path: Path) -> None:
    environ = {"ROS_PACKAGE_PATH": ":".join(f"/r{n}" for n in range(7)), "PYTHONPATH": str(tmp_path)}
    with pytest.raises(UnknownTypeError) as caught:
        find_message_type("my_msgs/Foo", environ=environ)
    assert caught.value.fetchable
    assert str(caught.value) == (
        "message type my_msgs/Foo: is not known here; looked in ROS_PACKAGE_PATH (/r0, /r1, /r2, /r3 and 3 more), "
        f"CMAKE_PREFIX_PATH (not set), PYTHONPATH ({tmp_path}), and at what comes with rmpa; source the workspace "
        "that has it, or let a node that publishes it run, here or at a peer"
    )
    with pytest.raises(UnknownTypeError, match=r"did you mean sensor_msgs/Image\?") as caught:
        find_message_type("sensor_msgs/Imagge", environ={})
    assert not caught.value.fetchable
    for name in ("../x", "String", "std_msgs/msg/String", "a/b\0", "x" * 1000):
        with pytest.raises(DefinitionError, match=r"is not a type's name; write it like std_msgs/String"):
            find_message_type(name, environ=environ)


def test_what_is_missing_or_malformed_within_is_named(tmp_path: Path) -> None:
    made = package(tmp_path / "my_msgs", msg_A="gone_msgs/B b", msg_C="int8", msg_D="D d", msg_E="")
    environ = {"ROS_PACKAGE_PATH": str(tmp_path)}
    with pytest.raises(UnknownTypeError, match=r"my_msgs/A: embeds gone_msgs/B, which is not known here; looked in"):
        find_message_type("my_msgs/A", environ=environ)
    with pytest.raises(DefinitionError, match="'int8' is neither a field nor a constant"):
        find_message_type("my_msgs/C", environ=environ)
    with pytest.raises(DefinitionError, match="contains itself"):
        find_message_type("my_msgs/D", environ=environ)
    (made / "msg" / "E.msg").write_bytes(b"# caf\xe9\nint8 e\r\n")
    assert find_message_type("my_msgs/E", environ=environ).fields[0].name == "e"
    os.mkfifo(made / "msg" / "F.msg")
    with pytest.raises(UnknownTypeError):
        find_message_type("my_msgs/F", environ=environ)


def test_types_from_headers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    known = MessageType("std_msgs/Empty")
    fields = {"type": known.name, "md5sum": known.md5sum, "message_definition": ""}
    assert type_of_header(fields).serialize(type_of_header(fields).make()) == b""
    assert type_of_header({"type": "std_msgs/String", "md5sum": STRING}).md5sum == STRING
    with pytest.raises(DefinitionError, match=f"has the md5 sum {STRING} here .it comes with rmpa., and 0000"):
        type_of_header({"type": "std_msgs/String", "md5sum": "0" * 32})
    with pytest.raises(DefinitionError, match="its publisher says 0000"):
        type_of_header({"type": "a/B", "md5sum": "0" * 32, "message_definition": "int32 x"})
    package(tmp_path / "std_msgs", msg_String="int8 mine")
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path))
    assert type_of_header({"type": "std_msgs/String", "md5sum": STRING}).md5sum == STRING


class Looks:
    """Counts the walks through the folders; its time is made up."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.walks = 0
        self.now = 1000.0
        walk = os.walk

        def counted(folder: Path) -> Iterator[tuple[str, list[str], list[str]]]:
            self.walks += 1
            return walk(str(folder))

        monkeypatch.setattr(os, "walk", counted)
        monkeypatch.setattr(header_types, "monotonic", lambda: self.now)


def test_a_missing_type_is_not_looked_for_at_each_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = tmp_path / "deep" / "new_msgs"
    package(made, msg_Other="int8 a")
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path))
    looks = Looks(monkeypatch)
    sum_there = MessageType.learn("new_msgs/B", "int8 b").md5sum
    header = {"type": "new_msgs/B", "md5sum": sum_there}
    for _ in range(100):
        with pytest.raises(UnknownTypeError, match="new_msgs/B: is not in package new_msgs"):
            type_of_header(header)
    assert looks.walks <= 6, "two walks through three folders"
    with pytest.raises(UnknownTypeError):
        type_of_header({"type": "new_msgs/C", "md5sum": sum_there})
    package(made, msg_B="int8 b")
    walks = looks.walks
    looks.now += 0.99 * TYPE_MISSING
    with pytest.raises(UnknownTypeError):
        type_of_header(header)
    assert looks.walks == walks
    looks.now += 0.02 * TYPE_MISSING
    assert type_of_header(header).md5sum == sum_there


def test_a_version_that_is_missing_is_remembered_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package(tmp_path / "my_msgs", msg_A="int8 a")
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path))
    looks = Looks(monkeypatch)
    header = {"type": "my_msgs/A", "md5sum": MessageType.learn("my_msgs/A", "int8 b").md5sum}
    for _ in range(2):
        with pytest.raises(DefinitionError, match="has the md5 sum"):
            type_of_header(header)
        package(tmp_path / "my_msgs", msg_A="int8 b")
    looks.now += 1.01 * TYPE_MISSING
    assert type_of_header(header).md5sum == header["md5sum"]


@pytest.mark.skipif(not Path("/usr/share/actionlib/msg").is_dir(), reason="ROS 1 is not installed (no actionlib)")
def test_debians_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    path = installed.SearchPath.read({})
    for name in ("actionlib/TestGoal", "actionlib/TestActionGoal"):
        found = list(installed.find_definitions("msg", name, path, sourced=False))
        assert {where.suffix for _, _, where in found} == {".py", ".msg"}
        for text, _, _ in found:
            assert text.rstrip() == MessageType(name).definition.partition(f"\n{SEPARATOR}")[0].rstrip()
    found = list(installed.find_definitions("srv", "std_srvs/SetBool", path, sourced=False))
    assert {ServiceType("std_srvs/SetBool", text).md5sum for text, _, _ in found} == {
        "09fb03525b03e7ea1fd3992bafd87e16"
    }


@pytest.fixture(autouse=True)
def fresh() -> Iterator[None]:
    packages_below.cache_clear()
    yield
    packages_below.cache_clear()


def names(root: Path) -> dict[str, list[str]]:
    found, whole = packages_below(str(root))
    assert whole
    return {name: [str(folder.relative_to(root)) for folder in found[name]] for name in sorted(found)}


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

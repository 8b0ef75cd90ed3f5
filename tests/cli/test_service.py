"""``rmpa service`` against our own core and node."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from rmpa.core.errors import RmpaError
from rmpa.ros.aio.node import Node
from rmpa.ros.environment import RosEnvironment
from rmpa.ros.service_types import ServiceType

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.ros.aio.core import RosCore
    from tests.cli.conftest import Background, Place


def add(request: Any) -> dict[str, int]:
    return {"sum": request.a + request.b}


def enable(request: Any) -> dict[str, object]:
    if request.data:
        raise RmpaError("the arm is jammed\x1b[2J")
    return {"success": True, "message": "off"}


@pytest.fixture
def served(place: Place, core: RosCore, background: Background) -> Iterator[RosCore]:
    """A node with services, and one that a bridge would have registered for peer base."""
    place.environ["ROS_MASTER_URI"] = core.uri
    nodes: list[Node] = []

    async def start() -> None:
        for name in ("/server", "/rmpa/base/arm"):
            node = Node(name, master_uri=core.uri, environment=RosEnvironment())
            await node.__aenter__()
            nodes.append(node)
        await nodes[0].advertise_service("/add", "rospy_tutorials/AddTwoInts", add)
        await nodes[0].advertise_service("/my/do", ServiceType("my_pkg/Do", "int32 a\n---\nint32 b\n"), lambda _: 7)
        await nodes[1].advertise_service("/arm/enable", "std_srvs/SetBool", enable)
        await nodes[1].advertise_service("/arm/nothing", "std_srvs/Empty", lambda _: None)

    async def stop() -> None:
        for node in nodes:
            await node.close()

    background.do(start())
    yield core
    background.do(stop())


def test_list(place: Place, served: RosCore) -> None:
    own = ["/add", "/arm/enable  [base]", "/arm/nothing  [base]", "/my/do"]
    assert place.run("service", "list")[1].splitlines() == [*own, "/rosout/get_loggers", "/rosout/set_logger_level"]
    assert place.run("service", "list", "base:/")[1].splitlines() == own[1:3]
    assert place.run("service", "list", "/my")[1] == "/my/do\n"
    code, out, _ = place.run("service", "list", "-v", "/arm")
    assert code == 0
    assert out.splitlines()[1].split(maxsplit=2) == [
        "/arm/enable",
        "std_srvs/SetBool",
        "/arm of peer base, by its proxy /rmpa/base/arm",
    ]
    listed = json.loads(place.run("service", "list", "base:/arm/enable", "--json")[1])
    assert listed == [
        {"name": "/arm/enable", "node": "/rmpa/base/arm", "peer": "base", "remote_node": "/arm"},
    ]


def test_info_type_and_find(place: Place, served: RosCore) -> None:
    uri = served.call("lookupService", "/x", "/add").value
    code, out, err = place.run("service", "info", "/add")
    assert (code, err) == (0, "")
    assert out.splitlines() == [
        "Node: /server",
        f"URI: {uri}",
        "Type: rospy_tutorials/AddTwoInts",
        "MD5: 6a2e34150c00229791cc89ff309fff21",
        "Args: a b",
        "Request:",
        "  int64 a",
        "  int64 b",
        "Response:",
        "  int64 sum",
    ]
    (info,) = place.json("service", "info", "base:/arm/enable", "--json")
    assert (info["peer"], info["type"], info["request"]) == ("base", "std_srvs/SetBool", ["data"])
    assert place.run("service", "type", "/add")[1] == "rospy_tutorials/AddTwoInts\n"
    assert place.run("service", "find", "std_srvs/SetBool")[1] == "/arm/enable  [base]\n"
    assert place.run("service", "info", "/ad") == (1, "", "rmpa: no service /ad; did you mean /add?\n")
    code, _, err = place.run("service", "info", "joystick:/arm/enable")
    assert (code, "is served by /rmpa/base/arm, not by peer joystick" in err) == (1, True)
    code, out, err = place.run("service", "info", "/my/do")
    assert code == 0
    assert "Type: my_pkg/Do\n" in out
    assert "is not a service that comes with rmpa" in err
    assert place.run("service", "info", "a b")[0] == 2


def test_a_server_that_is_gone_is_said(place: Place, served: RosCore) -> None:
    served.call("registerService", "/dead", "/dead/do", "rosrpc://127.0.0.1:9", "http://127.0.0.1:9/")
    code, out, err = place.run("service", "find", "std_srvs/Empty")
    assert (code, out) == (0, "/arm/nothing  [base]\n")
    assert "/dead/do: no server of service /dead/do answers at rosrpc://127.0.0.1:9" in err
    code, _, err = place.run("service", "call", "/dead/do")
    assert (code, "no server of service /dead/do answers" in err) == (1, True)
    assert "does not answer" in place.run("service", "list", "-v", "/dead")[1]
    served.call("unregisterService", "/dead", "/dead/do", "rosrpc://127.0.0.1:9")


def test_call(place: Place, served: RosCore) -> None:
    assert place.run("service", "call", "/add", "20", "22") == (0, "sum: 42\n", "")
    assert place.run("service", "call", "/add", "{a: 1, b: -2}")[1] == "sum: -1\n"
    assert place.run("service", "call", "/add", "--", "-1", "-2")[1] == "sum: -3\n"
    assert place.run("service", "call", "base:/arm/enable", "data: false") == (
        0,
        'success: True\nmessage: "off"\n',
        "",
    )
    assert place.run("service", "call", "/arm/nothing") == (0, "", "")
    (answer,) = place.json("service", "call", "/add", "[20, 22]", "--json")
    assert answer["response"] == {"sum": 42}
    assert place.run("service", "call", "/arm/enable", "true") == (
        1,
        "",
        "rmpa: service /arm/enable refused: the arm is jammed\\x1b[2J\n",
    )


def test_what_cannot_be_called(place: Place, served: RosCore) -> None:
    code, _, err = place.run("service", "call", "/add", "{c: 1}")
    assert (code, err) == (1, "rmpa: rospy_tutorials/AddTwoIntsRequest has no field 'c'; it has a, b\n")
    assert place.run("service", "call", "/add", "{a")[0] == 2
    code, _, err = place.run("service", "call", "/none")
    assert (code, err) == (1, "rmpa: no service /none; `rmpa service list` shows all\n")
    code, _, err = place.run("service", "call", "/none", "--wait", "-t", "0.3")
    assert code == 1
    assert "no service /none answers at http" in err
    assert "within 0.3 s" in err


def test_a_type_of_this_machines_packages(place: Place, served: RosCore) -> None:
    folder = Path(place.environ["HOME"]) / "ws" / "my_pkg" / "srv"
    folder.mkdir(parents=True)
    (folder / "Do.srv").write_text("int32 a\n---\nint32 b\n")
    place.environ["ROS_PACKAGE_PATH"] = str(folder.parents[1])
    assert place.run("service", "call", "/my/do", "1") == (0, "b: 7\n", "")
    (folder / "Do.srv").write_text("int32 a\n---\nint64 b\n")
    code, _, err = place.run("service", "call", "/my/do", "1")
    assert code == 1
    assert "my_pkg/Do has another definition at the server" in err
    with contextlib.suppress(KeyError):
        del place.environ["ROS_PACKAGE_PATH"]

"""``rmpa service`` against our own core and node."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from rmpa.core.errors import RmpaError
from rmpa.observe.snapshot import SampleSpread, ServiceInfo
from rmpa.ros.environment import RosEnvironment
from rmpa.ros.node.node import Node
from rmpa.ros.types.installed import ServiceType
from tests.cli.conftest import with_core

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from rmpa.ros.core.embedded import RosCore
    from tests.cli.conftest import Background, Rmpa

GROUP = ("service",)


def add(request: Any) -> dict[str, int]:
    return {"sum": request.a + request.b}


def enable(request: Any) -> dict[str, object]:
    if request.data:
        raise RmpaError("the arm is jammed\x1b[2J")
    return {"success": True, "message": "off"}


def as_json(rmpa: Rmpa, *words: str) -> dict[str, Any]:
    code, out, _ = rmpa(*words)
    assert code == 0
    value: dict[str, Any] = json.loads(out)
    return value


@pytest.fixture
def served(core: RosCore, background: Background) -> Iterator[RosCore]:
    """A node with services, and one that a bridge would have registered for peer base."""
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


def test_list(rmpa: Rmpa, served: RosCore) -> None:
    own = ["/add", "/arm/enable  [base]", "/arm/nothing  [base]", "/my/do"]
    assert rmpa("list")[1].splitlines() == [*own, "/rosout/get_loggers", "/rosout/set_logger_level"]
    assert rmpa("list", "base:/")[1].splitlines() == own[1:3]
    assert rmpa("list", "/my")[1] == "/my/do\n"
    listed = json.loads(rmpa("list", "base:/arm/enable", "--json")[1])
    assert listed == [
        {"name": "/arm/enable", "node": "/rmpa/base/arm", "peer": "base", "remote_node": "/arm"},
    ]


def test_info_type_and_find(rmpa: Rmpa, served: RosCore) -> None:
    uri = served.call("lookupService", "/x", "/add").value
    code, out, err = rmpa("info", "/add")
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
    info = as_json(rmpa, "info", "base:/arm/enable", "--json")
    assert (info["peer"], info["type"], info["request"]) == ("base", "std_srvs/SetBool", ["data"])
    assert rmpa("type", "/add")[1] == "rospy_tutorials/AddTwoInts\n"
    assert rmpa("find", "std_srvs/SetBool")[1] == "/arm/enable  [base]\n"
    assert rmpa("info", "/ad") == (1, "", "rmpa: no service /ad; did you mean /add? [unknown-name]\n")
    code, _, err = rmpa("info", "joystick:/arm/enable")
    assert (code, "is served by /rmpa/base/arm, not by peer joystick" in err) == (1, True)
    code, out, err = rmpa("info", "/my/do")
    assert code == 0
    assert "Type: my_pkg/Do\n" in out
    assert "service type my_pkg/Do: is not known here; looked in ROS_PACKAGE_PATH (not set)" in err
    assert rmpa("info", "a b")[0] == 2


def test_a_server_that_is_gone_is_said(rmpa: Rmpa, served: RosCore) -> None:
    served.call("registerService", "/dead", "/dead/do", "rosrpc://127.0.0.1:9", "http://127.0.0.1:9/")
    code, out, err = rmpa("find", "std_srvs/Empty")
    assert (code, out) == (0, "/arm/nothing  [base]\n")
    assert "/dead/do: no server of service /dead/do answers at rosrpc://127.0.0.1:9" in err
    code, _, err = rmpa("call", "/dead/do")
    assert (code, "no server of service /dead/do answers" in err) == (1, True)
    assert "does not answer" in rmpa("list", "-v", "/dead")[1]
    served.call("unregisterService", "/dead", "/dead/do", "rosrpc://127.0.0.1:9")


def test_call(rmpa: Rmpa, served: RosCore) -> None:
    assert rmpa("call", "/add", "20", "22") == (0, "sum: 42\n", "")
    assert rmpa("call", "/add", "{a: 1, b: -2}")[1] == "sum: -1\n"
    assert rmpa("call", "/add", "--", "-1", "-2")[1] == "sum: -3\n"
    assert rmpa("call", "base:/arm/enable", "data: false") == (
        0,
        'success: True\nmessage: "off"\n',
        "",
    )
    assert rmpa("call", "/arm/nothing") == (0, "", "")
    answer = as_json(rmpa, "call", "/add", "[20, 22]", "--json")
    assert answer["response"] == {"sum": 42}
    assert rmpa("call", "/arm/enable", "true") == (
        1,
        "",
        "rmpa: service /arm/enable refused: the arm is jammed\\x1b[2J [service-failed]\n",
    )


def test_what_cannot_be_called(rmpa: Rmpa, served: RosCore) -> None:
    code, _, err = rmpa("call", "/add", "{c: 1}")
    assert (code, err) == (
        1,
        "rmpa: rospy_tutorials/AddTwoIntsRequest has no field 'c'; it has a, b [invalid-message]\n",
    )
    assert rmpa("call", "/add", "{a")[0] == 2
    code, _, err = rmpa("call", "/none")
    assert (code, err) == (1, "rmpa: no service /none; `rmpa service list` shows all [unknown-name]\n")
    code, _, err = rmpa("call", "/none", "--wait", "-t", "0.3")
    assert code == 1
    assert "no service /none answers at http" in err
    assert "within 0.3 s" in err


def test_a_type_of_this_machines_packages(
    rmpa: Rmpa, served: RosCore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "my_pkg" / "srv"
    folder.mkdir(parents=True)
    (folder / "Do.srv").write_text("int32 a\n---\nint32 b\n")
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path))
    assert rmpa("call", "/my/do", "1") == (0, "b: 7\n", "")
    (folder / "Do.srv").write_text("int32 a\n---\nint64 b\n")
    code, _, err = rmpa("call", "/my/do", "1")
    assert code == 1
    assert "my_pkg/Do: has the md5 sum " in err
    assert f"here ({folder}/Do.srv), and " in err
    assert err.endswith(" there; source the workspace that the node there was built in [unknown-type]\n")


def test_info_tells_what_crosses(
    rmpa: Rmpa,
    served: RosCore,
    agent: Callable[..., None],
) -> None:
    spread = SampleSpread(count=9, mean=0.002, sd=0, min=0.001, max=0.004, p50=0.002, p99=0.003)
    services = (
        ServiceInfo(name="/add", node="/server", direction="out", policy="[services] allow", callers=("base",)),
        ServiceInfo(
            name="/arm/enable",
            node="/arm",
            direction="in",
            peer="base",
            state="open",
            calls=9,
            failed=1,
            latency=spread,
            problem="its server died\x1b in the middle of the call",
        ),
        ServiceInfo(name="/add", node="/adder", direction="in", peer="base", hidden="/server serves it here"),
    )
    agent("here", msgspec.structs.replace(with_core(served.uri), services=services))
    code, out, err = rmpa("info", "/arm/enable")
    assert code == 0
    assert out.endswith(
        "\nMesh:\n"
        " * from base: /arm, open\n"
        "     calls      9, 1 failed\n"
        "     latency    p50 2.00 ms, p99 3.00 ms, max 4.00 ms\n"
    )
    assert err == "! base: its server died\\x1b in the middle of the call [service-failed]\n"
    out = rmpa("info", "/add")[1]
    assert (
        " * may cross: [services] allow, open at base\n * from base: /adder, not here: /server serves it here\n"
        in out
    )
    assert rmpa("info", "base:/add") == (0, " * from base: /adder, not here: /server serves it here\n", "")
    assert as_json(rmpa, "info", "base:/arm/enable", "--json")["mesh"][0]["calls"] == 9


@pytest.mark.parametrize(
    ("info", "listed", "told"),
    [
        ({"transport": "relay"}, "relayed", ""),
        (
            {"transport": "direct", "wanted": "auto", "address": "rosrpc://10.0.0.7:43817", "lookups": 12},
            "direct",
            "direct, at rosrpc://10.0.0.7:43817, 12 lookups answered so",
        ),
        (
            {"transport": "relay", "wanted": "auto", "condition": "listening", "relayed_because": "on loopback only"},
            "relayed (listening)",
            "relayed (listening): on loopback only",
        ),
        ({"transport": "relay", "wanted": "auto"}, "relayed", "relayed; its module is being asked"),
    ],
    ids=["by rule", "direct", "a condition", "asked"],
)
def test_the_transport_of_a_peers_service(
    rmpa: Rmpa,
    served: RosCore,
    agent: Callable[..., None],
    info: dict[str, Any],
    listed: str,
    told: str,
) -> None:
    found = ServiceInfo(name="/arm/enable", node="/arm", direction="in", peer="base", **info)
    mine = ServiceInfo(name="/add", node="/server", direction="out", direct_callers=("base",))
    agent("here", msgspec.structs.replace(with_core(served.uri), services=(mine, found)))
    out = rmpa("info", "/arm/enable")[1]
    assert (f"     transport  {told}\n" in out) if told else ("transport" not in out)
    assert "     transport  direct for base\n" in rmpa("info", "/add")[1]
    row = rmpa("list", "-v", "/arm")[1].splitlines()[1]
    assert row.endswith(f"  {listed}")
    as_listed = json.loads(rmpa("list", "/arm", "--json")[1])[0]
    assert (as_listed["transport"], as_listed.get("condition", "")) == (info["transport"], info.get("condition", ""))

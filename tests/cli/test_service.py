"""``rmpa service`` against our own core and node."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from rmpa.core.errors import RmpaError
from rmpa.core.facts import ServiceInfo
from rmpa.core.statistics import SampleSpread
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node
from rmpa.ros.types.installed import ServiceType
from tests.cli.conftest import Background, Place, Rmpa, compare, settled, with_core

GROUP = ("service",)


def add(request: Any) -> dict[str, int]:
    return {"sum": request.a + request.b}


def enable(request: Any) -> dict[str, object]:
    if request.data:
        raise RmpaError("the arm is jammed\x1b[2J")
    return {"success": True, "message": "off"}


@pytest.fixture
def served(core: RosCore, node: Callable[..., Node], background: Background) -> RosCore:
    """A node with services, and one that a bridge would have registered for peer base."""
    server, proxy, do = node("/server"), node("/rmpa/base/arm"), ServiceType("my_pkg/Do", "int32 a\n---\nint32 b\n")
    background.do(server.advertise_service("/add", "rospy_tutorials/AddTwoInts", add))
    background.do(server.advertise_service("/my/do", do, lambda _: 7))
    background.do(proxy.advertise_service("/arm/enable", "std_srvs/SetBool", enable))
    background.do(proxy.advertise_service("/arm/nothing", "std_srvs/Empty", lambda _: None))
    return core


def test_what_is_served_here_and_by_a_peer(rmpa: Rmpa, served: RosCore, place: Place) -> None:
    said = place.transcript(
        "list", "list base:/", "list /my", "list base:/arm/enable --json",
        "info /add", "info base:/arm/enable --json", "info /ad", "info joystick:/arm/enable",
        "info 'a b'", "type /add", "find std_srvs/SetBool",
        "call /add 20 22", "call /add '{a: 1, b: -2}'", "call /add -- -1 -2", "call base:/arm/enable 'data: false'",
        "call /arm/nothing", "call /arm/enable true",
        "call /add '{c: 1}'", "call /add '{a'", "call /none",
        group="service",
    )  # fmt: skip
    compare("service", settled(said))
    code, out, err = rmpa("info", "/my/do")
    assert (code, "Type: my_pkg/Do\n" in out) == (0, True)
    assert "service type my_pkg/Do: is not known here; looked in ROS_PACKAGE_PATH (not set)" in err
    assert '"response":{"sum":42}' in rmpa("call", "/add", "[20, 22]", "--json")[1]
    code, _, err = rmpa("call", "/none", "--wait", "-t", "0.3")
    assert (code, "no service /none answers at http" in err, "within 0.3 s" in err) == (1, True, True)


def test_a_server_that_is_gone_is_said(rmpa: Rmpa, served: RosCore, place: Place) -> None:
    served.call("registerService", "/dead", "/dead/do", "rosrpc://127.0.0.1:9", "http://127.0.0.1:9/")
    said = place.transcript("find std_srvs/Empty", "call /dead/do", "list -v /dead", group="service")
    compare("service_gone", settled(said))
    served.call("unregisterService", "/dead", "/dead/do", "rosrpc://127.0.0.1:9")


def test_a_type_of_this_machines_packages(rmpa: Rmpa, served: RosCore, place: Place, tmp_path: Path) -> None:
    folder = tmp_path / "my_pkg" / "srv"
    folder.mkdir(parents=True)
    (folder / "Do.srv").write_text("int32 a\n---\nint32 b\n")
    place.environ["ROS_PACKAGE_PATH"] = str(tmp_path)
    assert rmpa("call", "/my/do", "1") == (0, "b: 7\n", "")
    (folder / "Do.srv").write_text("int32 a\n---\nint64 b\n")
    code, _, err = rmpa("call", "/my/do", "1")
    assert (code, "my_pkg/Do: has the md5 sum " in err, f"here ({folder}/Do.srv), and " in err) == (1, True, True)
    assert err.endswith(" there; source the workspace that the node there was built in [unknown-type]\n")


def test_info_tells_what_crosses(served: RosCore, agent: Callable[..., None], place: Place) -> None:
    spread = SampleSpread(count=9, mean=0.002, sd=0, min=0.001, max=0.004, p50=0.002, p99=0.003)
    enabled = ServiceInfo(
        name="/arm/enable", node="/arm", direction="in", peer="base", state="open", calls=9, failed=1,
        latency=spread, problem="its server died\x1b in the middle of the call",
    )  # fmt: skip
    services = (
        ServiceInfo(name="/add", node="/server", direction="out", policy="[services] allow", callers=("base",)),
        enabled,
        ServiceInfo(name="/add", node="/adder", direction="in", peer="base", hidden="/server serves it here"),
    )
    agent("here", msgspec.structs.replace(with_core(served.uri), services=services))
    lines = ("info /arm/enable", "info /add", "info base:/add", "info base:/arm/enable --json")
    compare("service_crosses", settled(place.transcript(*lines, group="service")))


TRANSPORTS: dict[str, dict[str, Any]] = {
    "by rule": {"transport": "relay"},
    "direct": {"transport": "direct", "wanted": "auto", "address": "rosrpc://10.0.0.7:1", "lookups": 12},
    "a condition": {
        "transport": "relay", "wanted": "auto", "condition": "listening", "relayed_because": "on loopback only"
    },
    "asked": {"transport": "relay", "wanted": "auto"},
}  # fmt: skip


@pytest.mark.parametrize("name", TRANSPORTS)
def test_the_transport_of_a_peers_service(
    served: RosCore, agent: Callable[..., None], place: Place, name: str
) -> None:
    found = ServiceInfo(name="/arm/enable", node="/arm", direction="in", peer="base", **TRANSPORTS[name])
    mine = ServiceInfo(name="/add", node="/server", direction="out", direct_callers=("base",))
    agent("here", msgspec.structs.replace(with_core(served.uri), services=(mine, found)))
    lines = ("info /arm/enable", "info /add", "list -v /arm", "list /arm --json")
    said = settled(place.transcript(*lines, group="service"))
    compare(f"service_{name.replace(' ', '_')}", said)

"""How proxies listen: together where nodes of this machine alone reach them, and apart where that cannot be."""

from __future__ import annotations

import errno
import re
import socket
from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

import psutil

from rmpa.bridge.proxies import ProxyNodes
from rmpa.ros.http.rpc import call_api
from rmpa.ros.node import listeners as shared_listener

if TYPE_CHECKING:
    import pytest

    from rmpa.ros.core.external import Core


def core(host: str = "127.0.0.1", address: str = "127.0.0.1") -> Core:
    """As much of a core as proxies ask for."""
    return cast("Core", SimpleNamespace(uri="http://127.0.0.1:11311/", node_host=host, node_address=address))


def listening() -> int:
    """How many sockets of this process listen."""
    return sum(found.status == psutil.CONN_LISTEN for found in psutil.Process().net_connections("tcp"))


async def proxies(nodes: ProxyNodes, count: int = 3) -> list[str]:
    """Make some proxies, see that each answers, and close them; their hosts."""
    made = [nodes.make(f"/rmpa/base/n{number}") for number in range(count)]
    for proxy in made:
        await proxy.start()
        uri = f"http://127.0.0.1:{proxy.uri.rsplit(':')[-1]}" if "robot" in proxy.uri else proxy.uri
        assert (await call_api(uri, "getName", "/c")).value == proxy.name
    hosts = [proxy.uri.split("/")[2].split(":")[0] for proxy in made]
    for proxy in made:
        await proxy.close()
    return hosts


async def test_on_loopback_they_share_two_sockets() -> None:
    before = listening()
    nodes = ProxyNodes(core())
    await nodes.start()
    assert nodes.sockets(1000) == 2
    assert re.fullmatch(r"two for all, ports \d+ and \d+, and an address 127.a.b.c for each", nodes.listening)
    hosts = await proxies(nodes)
    assert len(set(hosts)) == 3
    assert "127.0.0.1" not in hosts
    assert listening() == before + 2
    await nodes.close()
    assert listening() == before


async def test_where_other_machines_reach_them_each_listens_by_itself() -> None:
    nodes = ProxyNodes(core("0.0.0.0", "robot"))  # as an external core over several machines has it
    await nodes.start()
    assert nodes.sockets(1000) == 2000
    assert nodes.listening == "two for each: nodes of other machines reach them, at robot"
    assert await proxies(nodes) == ["robot"] * 3
    await nodes.close()


async def test_without_the_device_each_listens_by_itself_and_the_log_says_why(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    class Forbidden(socket.socket):
        def setsockopt(self, level: int, option: int, value: int | bytes) -> None:  # type: ignore[override]
            if option == socket.SO_BINDTODEVICE:
                raise PermissionError(errno.EPERM, "Operation not permitted")
            super().setsockopt(level, option, value)

    before = listening()
    nodes = ProxyNodes(core())
    with monkeypatch.context() as context, caplog.at_level("INFO"):
        context.setattr(socket, "socket", Forbidden)
        await nodes.start()
    why = "two for each, at 127.0.0.1: all cannot share two (Operation not permitted)"
    assert nodes.listening == why
    assert [r.message for r in caplog.records] == [f"= proxies listen by sockets of their own, {why}"]
    assert await proxies(nodes) == ["127.0.0.1"] * 3
    assert listening() == before
    await nodes.close()


async def test_a_failed_trial_leaves_nothing_open(monkeypatch: pytest.MonkeyPatch) -> None:
    before = listening()

    async def refuse(*_: object) -> None:
        raise ConnectionRefusedError(errno.ECONNREFUSED, "Connection refused")

    monkeypatch.setattr(shared_listener.SharedListener, "_test_address", refuse)
    nodes = ProxyNodes(core())
    await nodes.start()
    assert "Connection refused" in nodes.listening
    assert listening() == before
    await nodes.close()

"""Proxies are there while something holds them."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

from rmpa.bridge.proxies import PeerProxies

if TYPE_CHECKING:
    from rmpa.ros.node.slave_node import SlaveNode


class Nodes:
    """Makes nodes without sockets, or fails."""

    def __init__(self) -> None:
        self.problem: Exception | None = None
        self.open: list[str] = []

    def make(self, name: str, _on_kill: object) -> SlaveNode:
        async def start() -> None:
            await asyncio.sleep(0)
            if self.problem is not None:
                raise self.problem
            self.open.append(name)

        async def close() -> None:
            self.open.remove(name)

        return cast("SlaveNode", SimpleNamespace(name=name, start=start, close=close))


class World:
    """The proxies of one peer, and what happened at them."""

    def __init__(self) -> None:
        self.nodes = Nodes()
        self.proxies = PeerProxies("/rmpa/far", cast("Any", self.nodes))
        self.happened: list[str] = []

    def hold(self, node: str, key: str) -> None:
        self.proxies.hold(
            node,
            key,
            lambda proxy: self.happened.append(f"{key} at {proxy.name}"),
            lambda proxy: self.happened.append(f"{key} left"),
        )

    async def settled(self) -> list[str]:
        for _ in range(10):
            await asyncio.sleep(0)
        happened, self.happened = self.happened, []
        return happened


async def test_a_proxy_is_there_while_something_holds_it() -> None:
    world = World()
    world.hold("/n", "topic /a")
    world.hold("/n", "service /b")
    assert await world.settled() == ["topic /a at /rmpa/far/n", "service /b at /rmpa/far/n"]
    assert (len(world.proxies), world.nodes.open) == (1, ["/rmpa/far/n"])
    world.proxies.release("/n", "topic /a")
    assert await world.settled() == ["topic /a left"]
    assert world.proxies.get("/n") is not None
    world.proxies.release("/n", "service /b")
    assert await world.settled() == ["service /b left"]
    assert (world.proxies.get("/n"), world.nodes.open) == (None, [])
    await world.proxies.close()


async def test_what_is_released_at_once_never_appears() -> None:
    world = World()
    world.hold("/n", "topic /a")
    world.proxies.release("/n", "topic /a")
    assert await world.settled() == []
    world.hold("/n", "topic /a")
    await asyncio.sleep(0)  # the proxy is being made
    world.proxies.release("/n", "topic /a")
    assert await world.settled() == []
    assert world.nodes.open == []
    await world.proxies.close()


async def test_a_proxy_that_cannot_be_made_is_tried_again() -> None:
    world = World()
    world.nodes.problem = OSError("no address is left")
    world.hold("/n", "topic /a")
    assert await world.settled() == []
    assert world.proxies.problems == {"/n": "no address is left"}
    world.nodes.problem = None
    world.proxies.reconcile()
    assert await world.settled() == ["topic /a at /rmpa/far/n"]
    assert world.proxies.problems == {}
    world.proxies.reconcile()
    assert await world.settled() == []
    await world.proxies.close()
    assert world.happened == ["topic /a left"]
    assert world.nodes.open == []


async def test_a_relayed_node_has_the_name_of_its_own_module() -> None:
    world = World()
    world.proxies.names["/rmpa/other/n"] = "/rmpa/other/n"
    world.hold("/rmpa/other/n", "topic /a")
    assert await world.settled() == ["topic /a at /rmpa/other/n"]
    await world.proxies.close()

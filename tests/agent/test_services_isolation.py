"""Services give way to data: a thousand of them, and calls of 16 MB, beside the look at the data path's sockets.

As ``test_isolation``, which has the watch; that large bodies hold nobody up is a promise of its own.
"""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import pytest

from rmpa.config.peer_rules import PeerRule
from rmpa.config.settings import ServiceSettings
from tests.agent.test_isolation import (
    NODES,
    World,
    assert_yields_to_data,
    call,
    calls,
    watched,
)
from tests.agent.test_services import connect, serving

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

__all__ = ["watched"]

pytestmark = [pytest.mark.alone, pytest.mark.timeout(240)]

SERVICES: Final = 1000
LARGE: Final = 16_000_000
"""To give memory back takes the kernel a millisecond for 10 MB, and nobody can look meanwhile."""


def shown(world: World, namespace: str = "/fleet/") -> int:
    return sum(name.startswith(namespace) for name in world.near.core.state().services)


def fleet(method: str, node: int, *further: str) -> Iterator[bytes]:
    """The (un)registrations of one node's services."""
    for service in range(node, SERVICES, NODES):
        yield call(method, f"/fleet/node_{node}", f"/fleet/some/namespace/service_{service}", *further)


async def a_fleet_registers(world: World) -> None:
    uri = world.api.replace("http", "rosrpc").rstrip("/")
    nodes = [fleet("registerService", node, uri, world.api) for node in range(NODES)]
    await world.beside(*(calls(world.far, bodies) for bodies in nodes))
    await world.until(lambda: shown(world) == SERVICES)


async def plans_are_reconciled(world: World) -> None:
    for _ in range(4):
        for agent in (world.near, world.far):
            agent.services.reconcile()
        await world.until(lambda: not (world.near.services._changed or world.far.services._changed))


async def somebody_looks_at_everything(world: World) -> None:
    for _ in range(4):
        assert len(world.near.operations.snapshot({}).services) > SERVICES
        await asyncio.sleep(0)


async def other_rules_hold(world: World) -> None:
    for rules in ((PeerRule("far", "/moved"),), ()) * 2:
        world.near.apply_settings(replace(world.near.settings, peers=rules))
        await world.until(lambda rules=rules: shown(world) == (0 if rules else SERVICES))  # type: ignore[misc]
    for services in (ServiceSettings(deny=("/fleet/**",)), ServiceSettings()) * 2:
        world.far.apply_settings(replace(world.far.settings, services=services))
        await world.until(lambda services=services: shown(world) == (0 if services.deny else SERVICES))  # type: ignore[misc]


async def large_calls_are_made(world: World) -> None:
    async with serving(world.far) as server:
        await world.until(lambda: shown(world, "/add"))
        connection = await connect(world.near)
        body = bytes(LARGE)
        sizes: list[int] = []
        for number in range(3):
            # No future with the response in it: the watch shows what runs, and that would be shown too.
            connection.request(body, lambda answer: sizes.append(len(answer[1])), 60.0)  # type: ignore[index]
            await world.until(lambda number=number: len(sizes) > number)  # type: ignore[misc]
        assert sizes == [LARGE] * 3
        connection.close()
        assert len(server.calls) == 3
        server.calls.clear()
    await world.until(lambda: not shown(world, "/add"))


async def the_link_falls_and_comes_back(world: World) -> None:
    for _ in range(3):
        attached = next(iter(world.near.bridge.sessions.linked()))
        attached.link.abort("pulled")
        await world.until(lambda attached=attached: attached.linked and world.linked())  # type: ignore[misc]
        await world.until(lambda: shown(world) == SERVICES)


async def the_fleet_leaves(world: World) -> None:
    uri = world.api.replace("http", "rosrpc").rstrip("/")
    nodes = [fleet("unregisterService", node, uri) for node in range(NODES)]
    await world.beside(*(calls(world.far, bodies) for bodies in nodes))
    await world.until(lambda: shown(world) == 0)


def test_work_on_a_thousand_services_yields_to_data(tmp_path: Path) -> None:
    assert_yields_to_data(
        tmp_path,
        a_fleet_registers,
        plans_are_reconciled,
        somebody_looks_at_everything,
        other_rules_hold,
        large_calls_are_made,
        the_link_falls_and_comes_back,
        the_fleet_leaves,
    )

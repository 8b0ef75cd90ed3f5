"""When an agent must take another place in the network."""

from __future__ import annotations

import asyncio
import errno
from ipaddress import IPv4Address
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest

from rmpa.agent import agent
from rmpa.agent.agent import JOIN_RETRY, Network, is_displaced
from rmpa.config.settings import Settings
from rmpa.core.errors import StartError
from rmpa.discovery.network import Interface
from tests.bridge.io.virtual import VirtualLoop, run

if TYPE_CHECKING:
    from collections.abc import Callable

LO = Interface("lo", 1, (IPv4Address("127.0.0.1"),), up=True, multicast=False, loopback=True)


def card(name: str, *addresses: str, up: bool = True) -> Interface:
    found = tuple(map(IPv4Address, addresses))
    return Interface(name, int(name[-1]) + 2, found, up=up, multicast=True, loopback=False)


@pytest.mark.parametrize(
    ("ours", "there", "displaced"),
    [
        ("127.0.0.1", [LO], False),
        ("127.0.0.1", [LO, card("eth0", "10.0.0.1", up=False)], False),
        ("127.0.0.1", [LO, card("eth0", "10.0.0.1")], True),
        ("10.0.0.1", [LO, card("eth0", "10.0.0.1")], False),
        ("10.0.0.1", [LO, card("eth0", "10.0.0.1", up=False)], False),
        ("10.0.0.1", [LO, card("eth0")], False),
        ("10.0.0.1", [LO, card("eth0", "10.0.0.2")], True),
        ("10.0.0.1", [LO, card("eth0", "10.0.0.2", "10.0.0.1")], False),
        ("10.0.0.1", [LO, card("eth0", "10.0.0.1", up=False), card("eth1", "10.1.0.1")], False),
        ("10.0.0.1", [LO, card("eth0"), card("eth1", "10.1.0.1")], True),
    ],
)
def test_only_an_address_that_was_replaced_displaces_us(ours: str, there: list[Interface], displaced: bool) -> None:
    assert is_displaced(IPv4Address(ours), tuple(there), ()) is displaced


def test_interfaces_that_the_user_did_not_choose_do_not_count() -> None:
    there = (LO, card("eth0", "10.0.0.1"), card("eth1", "10.1.0.1"))
    assert not is_displaced(IPv4Address("127.0.0.1"), there, ("lo",))
    assert is_displaced(IPv4Address("10.0.0.1"), there, ("eth1",))


class Endpoint:
    """A place in the network; those that fail cannot be started, or not even be made."""

    failing = 0
    unlisted = 0

    def __init__(self, network: Network, port: int) -> None:
        if Endpoint.unlisted:
            Endpoint.unlisted -= 1
            raise OSError(errno.EMFILE, "the interfaces cannot be listed")
        self.port = port
        self.displaced = network.move
        self.started = self.closed = self.moves = False
        made.append(self)

    async def start(self) -> None:
        if Endpoint.failing:
            Endpoint.failing -= 1
            raise (
                OSError(errno.EMFILE, "too many open files") if Endpoint.failing else StartError("mesh port", "taken")
            )
        await asyncio.sleep(1.0)
        self.started = True

    async def close(self, *, moves: bool = False) -> None:
        self.moves = moves
        await asyncio.sleep(1.0)
        self.closed = True


made: list[Endpoint] = []


@pytest.fixture
def joined(monkeypatch: pytest.MonkeyPatch) -> Callable[[], Network]:
    made.clear()
    monkeypatch.setattr(agent, "NetworkEndpoint", Endpoint)
    monkeypatch.setattr(Endpoint, "failing", 0)
    monkeypatch.setattr(Endpoint, "unlisted", 0)
    return lambda: Network(Settings(), cast("Any", None), trust=cast("Any", SimpleNamespace()))


def test_a_move_goes_on_until_the_agent_is_in_the_network_again(joined: Callable[[], Network]) -> None:
    async def main() -> None:
        sut = joined()
        await sut.start()
        Endpoint.failing, Endpoint.unlisted = 2, 1
        made[0].displaced()
        await asyncio.sleep(3 * JOIN_RETRY + 10.0)
        assert [one.closed for one in made] == [True, True, True, False]
        assert made[0].moves
        assert sut.endpoint is not None
        assert made[-1].started
        await sut.close()

    run(main(), VirtualLoop())


@pytest.mark.parametrize("after", [0.5, 1.5])
def test_an_agent_that_ends_while_it_moves_leaves_nothing_behind(joined: Callable[[], Network], after: float) -> None:
    async def main() -> None:
        sut = joined()
        await sut.start()
        made[0].displaced()
        await asyncio.sleep(after)  # while it leaves, or while it joins
        await sut.close()
        assert all(one.closed for one in made)
        assert sut.endpoint is None

    run(main(), VirtualLoop())

"""When an agent must take another place in the network."""

from __future__ import annotations

from ipaddress import IPv4Address

import pytest

from rmpa.agent.network import is_displaced
from rmpa.discovery.io.interfaces import Interface

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

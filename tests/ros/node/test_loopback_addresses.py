from __future__ import annotations

from ipaddress import IPv4Address, IPv4Network
from typing import TYPE_CHECKING

from hypothesis import given
from hypothesis import strategies as st

from rmpa.ros import limits
from rmpa.ros.node.listeners import LoopbackAddresses

if TYPE_CHECKING:
    import pytest

SALT = "http://127.0.0.1:11311/"
RESERVED = [IPv4Network("127.0.0.0/16"), IPv4Network("127.255.0.0/16")]


def test_an_address_follows_from_the_name_and_the_graph() -> None:
    address = LoopbackAddresses(SALT).take("/rmpa/base/driver", 0.0)
    assert LoopbackAddresses(SALT).take("/rmpa/base/driver", 7.0) == address
    assert LoopbackAddresses(SALT).take("/rmpa/base/camera", 0.0) != address
    assert LoopbackAddresses("http://127.0.0.1:11312/").take("/rmpa/base/driver", 0.0) != address


def test_ten_thousand_nodes_have_addresses_of_their_own() -> None:
    addresses = LoopbackAddresses(SALT)
    given_out = {addresses.take(f"/rmpa/base/node_{n}", 0.0) for n in range(10_000)}
    assert len(given_out) == len(addresses) == 10_000


@given(st.text())
def test_no_address_is_special(name: str) -> None:
    address = IPv4Address(LoopbackAddresses(SALT).take(name, 0.0))
    assert address in IPv4Network("127.0.0.0/8")
    assert not any(address in network for network in RESERVED)
    assert address.packed[3] not in {0, 255}


def test_two_nodes_of_one_name_share_no_address() -> None:
    addresses = LoopbackAddresses(SALT)
    assert addresses.take("/rmpa/base/driver", 0.0) != addresses.take("/rmpa/base/driver", 0.0)


def test_a_freed_address_rests_even_for_the_same_node() -> None:
    addresses = LoopbackAddresses(SALT)
    first = addresses.take("/n", 0.0)
    addresses.free(first, 10.0)
    second = addresses.take("/n", 10.0)
    assert second != first
    addresses.free(second, 11.0)
    assert addresses.take("/n", 10.0 + limits.LOOPBACK_REST) == first


def test_freeing_what_is_not_in_use_changes_nothing() -> None:
    addresses = LoopbackAddresses(SALT)
    addresses.free("127.1.2.3", 0.0)
    first = addresses.take("/n", 0.0)
    addresses.free(first, 1.0)
    addresses.free(first, 50.0)
    assert addresses.take("/n", 1.0 + limits.LOOPBACK_REST) == first


def test_of_too_many_resting_addresses_the_oldest_may_be_used_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "LOOPBACK_RESTING_MAX", 2)
    addresses = LoopbackAddresses(SALT)
    taken = [addresses.take(f"/n{n}", 0.0) for n in range(3)]
    for address in taken:
        addresses.free(address, 1.0)
    assert addresses.take("/n0", 2.0) == taken[0]
    assert addresses.take("/n1", 2.0) != taken[1]

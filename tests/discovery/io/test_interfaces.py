"""Which interfaces are used, and which address becomes the GUID's."""

from __future__ import annotations

from ipaddress import IPv4Address, IPv4Interface

import pytest

from rmpa.discovery import network as interfaces
from rmpa.discovery.network import Interface, choose, further_addresses, pick_address, unknown_names


def interface(name: str, *addresses: str, up: bool = True, multicast: bool = True) -> Interface:
    loopback = name == "lo"
    carries = multicast and not loopback
    ipv4 = tuple(map(IPv4Interface, addresses))
    return Interface(name, ipv4, len(name), up=up, multicast=carries, loopback=loopback)


LO = interface("lo", "127.0.0.1")
ETH = interface("eth0", "10.0.0.1", "10.0.0.2")
DOWN = interface("wlan0", "192.168.0.9", up=False)
TUN = interface("tun0", "10.8.0.1", multicast=False)
BARE = interface("eth1")
ODD = interface("usb0", "169.254.3.4")


def test_usable_interface_is_up_has_an_address_and_multicast() -> None:
    assert choose((LO, ETH, DOWN, TUN, BARE, ODD)) == (LO, ETH, ODD)


def test_the_user_may_choose() -> None:
    assert choose((LO, ETH, ODD), ("eth0", "wlan0")) == (ETH,)


def test_an_unknown_name_is_told_with_what_there_is() -> None:
    assert unknown_names((LO, ETH), ("eth0",)) is None
    assert unknown_names((LO, ETH), ("eth0", "eth9")) == (
        "--interface eth9: not here; there are eth0, lo; it will be used if it comes"
    )


@pytest.mark.parametrize(
    ("there", "address"),
    [
        ((LO, ETH), "10.0.0.1"),
        ((LO, ODD, ETH), "10.0.0.1"),
        ((LO, ODD), "169.254.3.4"),
        ((LO, DOWN), "127.0.0.1"),
        ((), "127.0.0.1"),
    ],
)
def test_the_guids_address(there: tuple[Interface, ...], address: str) -> None:
    assert pick_address(there) == IPv4Address(address)


def test_the_other_addresses_are_for_dialling_only() -> None:
    assert further_addresses((LO, ODD, ETH, TUN), IPv4Address("10.0.0.1")) == tuple(
        map(IPv4Address, ("10.0.0.2", "10.8.0.1", "169.254.3.4"))
    )


def test_this_machine_has_a_loopback() -> None:
    (loopback,) = (i for i in interfaces.list_interfaces() if i.loopback)
    assert loopback.usable
    assert str(loopback) == "lo (127.0.0.1)"

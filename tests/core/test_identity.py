"""Peers' names and identities."""

from __future__ import annotations

from ipaddress import IPv4Address

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core import limits
from rmpa.core.identity import Guid, Identity, peer_name_from, peer_name_problem

GUID = Guid.of("10.0.0.1", 40001)


@pytest.mark.parametrize(
    ("host", "name"),
    [
        ("base", "base"),
        ("my-robot.local", "my_robot"),
        ("7up", "m_7up"),
        ("", "module"),
        ("_x", "m__x"),
        ("é", "m__"),
    ],
)
def test_names_from_host_names(host: str, name: str) -> None:
    assert peer_name_from(host) == name


@given(st.text())
def test_every_host_name_gives_a_valid_name(host: str) -> None:
    assert peer_name_problem(peer_name_from(host)) is None


@given(st.from_regex(r"[A-Za-z][A-Za-z0-9_]{0,61}", fullmatch=True))
def test_a_valid_name_is_its_own(name: str) -> None:
    assert peer_name_from(name) == name


@pytest.mark.parametrize("name", ["", "7up", "a-b", "a b", "_a", "a/b", "é", "a\n", "x" * (limits.PEER_NAME_MAX + 1)])
def test_invalid_names(name: str) -> None:
    assert peer_name_problem(name)


def test_endpoints_are_best_first_and_each_once() -> None:
    others = (IPv4Address("192.168.0.1"), IPv4Address("10.0.0.1"))
    identity = Identity(GUID, bytes(16), "base", 0, others)
    assert identity.endpoints == (("10.0.0.1", 40001), ("192.168.0.1", 40001))
    assert str(identity) == "base (10.0.0.1:40001#0)"


@pytest.mark.parametrize(
    ("instance", "name", "domain"), [(b"", "a", 0), (bytes(17), "a", 0), (bytes(16), "-", 0), (bytes(16), "a", 233)]
)
def test_parts_out_of_range(instance: bytes, name: str, domain: int) -> None:
    with pytest.raises(ValueError):
        Identity(GUID, instance, name, domain)

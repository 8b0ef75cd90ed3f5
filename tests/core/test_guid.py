"""GUIDs: their parts, order and text."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.identity import Guid

PORTS = st.integers(0, 0xFFFF)


def test_golden_value() -> None:
    guid = Guid.of("10.0.0.1", 40001, 7)
    assert guid.value == 0x0A000001_9C41_0007
    assert str(guid) == "10.0.0.1:40001#7"
    assert guid.endpoint == ("10.0.0.1", 40001)


@given(st.ip_addresses(v=4), PORTS, PORTS)
def test_parts_and_text_survive(address: object, port: int, incarnation: int) -> None:
    guid = Guid.of(str(address), port, incarnation)
    assert (str(guid.address), guid.port, guid.incarnation) == (str(address), port, incarnation)
    assert Guid.parse(str(guid)) == guid


@given(st.integers(0, 2**64 - 1), st.integers(0, 2**64 - 1))
def test_ordered_as_unsigned_integers(a: int, b: int) -> None:
    assert (Guid(a) < Guid(b)) is (a < b)


def test_order_is_address_then_port_then_incarnation() -> None:
    ordered = [Guid.of("9.9.9.9", 1), Guid.of("10.0.0.1", 1), Guid.of("10.0.0.1", 1, 1), Guid.of("200.0.0.1", 0)]
    shuffled = [ordered[i] for i in (2, 0, 3, 1)]
    assert sorted(shuffled) == ordered


def test_incarnation_may_be_left_out() -> None:
    assert Guid.parse("1.2.3.4:5") == Guid.of("1.2.3.4", 5)


@pytest.mark.parametrize(
    "text", ["", "1.2.3.4", "1.2.3:4", "1.2.3.4:65536", "1.2.3.4:1#65536", "1.2.3.4:1#", "a:1", " 1.2.3.4:5"]
)
def test_malformed_text(text: str) -> None:
    with pytest.raises(ValueError):
        Guid.parse(text)


@pytest.mark.parametrize("value", [-1, 1 << 64])
def test_more_than_64_bits(value: int) -> None:
    with pytest.raises(ValueError, match="64 bits"):
        Guid(value)


@pytest.mark.parametrize(("port", "incarnation"), [(-1, 0), (65536, 0), (0, -1), (0, 65536)])
def test_parts_out_of_range(port: int, incarnation: int) -> None:
    with pytest.raises(ValueError, match="16 bits"):
        Guid.of("1.2.3.4", port, incarnation)

"""Names, GUIDs, serial numbers and identities."""

from __future__ import annotations

from ipaddress import IPv4Address

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core import identity as names
from rmpa.core import limits
from rmpa.core.identity import (
    SERIAL_HALF,
    SERIAL_MASK,
    Guid,
    Identity,
    is_earlier,
    is_later,
    peer_name_from,
    peer_name_problem,
    serial_add,
    serial_distance,
)
from rmpa.core.limits import INT32_MAX, INT32_MIN, UINT32_MAX

PARTS = st.lists(st.text("aZ_09", min_size=1, max_size=5), max_size=4)
NAMES = PARTS.map(lambda parts: "/".join(("/a", *parts)))


@pytest.mark.parametrize("name", ["", "/", "a", "/a/b", "~a", "a_1/b2", "A"])
def test_legal_names(name: str) -> None:
    assert names.is_legal_name(name)


@pytest.mark.parametrize("name", ["1a", "a b", "a-b", "a//b", "é", "_a", "a.b", "a\n"])
def test_illegal_names(name: str) -> None:
    assert not names.is_legal_name(name)


@pytest.mark.parametrize(
    ("name", "is_global"), [("/", True), ("/a", True), ("/a/", False), ("a", False), ("~a", False)]
)
def test_global_names(name: str, is_global: bool) -> None:
    assert names.is_global_name(name) is is_global


@pytest.mark.parametrize(
    ("name", "is_type"), [("a/B", True), ("a_1/B2", True), ("a", False), ("a/b/c", False), ("*", False)]
)
def test_type_names(name: str, is_type: bool) -> None:
    assert names.is_type_name(name) is is_type


@pytest.mark.parametrize(
    ("name", "namespace", "node", "resolved"),
    [
        ("/a", "/ns", "/n", "/a"),
        ("a", "/ns", "/n", "/ns/a"),
        ("a", "/", "", "/a"),
        ("~a", "/ns", "/ns/n", "/ns/n/a"),
        ("~/a", "/ns", "/ns/n", "/ns/n/a"),
        ("", "/ns", "", "/ns"),
        ("a/", "/ns/", "", "/ns/a"),
    ],
)
def test_resolving(name: str, namespace: str, node: str, resolved: str) -> None:
    assert names.resolve_name(name, namespace, node) == resolved


@given(NAMES)
def test_resolved_names_are_global_and_stay(name: str) -> None:
    assert names.is_global_name(names.resolve_name(name))
    assert names.resolve_name(names.resolve_name(name)) == names.resolve_name(name)


def test_an_illegal_name_is_not_resolved() -> None:
    with pytest.raises(ValueError, match="not a ROS name"):
        names.resolve_name("a b")


@pytest.mark.parametrize(
    ("pattern", "name", "fits"),
    [
        ("/**", "/a/b", True),
        ("/a", "/a", True),
        ("/a", "/a/b", False),
        ("/*", "/a", True),
        ("/*", "/a/b", False),
        ("/a/**", "/a", True),
        ("/a/**", "/a/b/c", True),
        ("/a/**", "/ab", False),
        ("/**/b", "/a/x/b", True),
        ("/**/b", "/b", True),
        ("/**/b", "/ab", False),
        ("/**/b/**", "/b", True),
        ("/a/**/b", "/a/b", True),
        ("/a/**/b", "/a/x/y/b", True),
        ("/a/**/b", "/ab", False),
        ("/*/**/**", "/a", True),
        ("/**/**/b", "/b", True),
        ("/a/**/**/b", "/a/b", True),
        ("/a/**/**", "/ab", False),
        ("/?", "/a", True),
        ("/?", "/ab", False),
        ("/a.b", "/axb", False),
        ("sensor_msgs/*", "sensor_msgs/Joy", True),
        ("**", "sensor_msgs/Joy", True),
    ],
)
def test_globs(pattern: str, name: str, fits: bool) -> None:
    assert names.matches(pattern, name) is fits


@given(NAMES)
def test_every_name_matches_itself_and_all(name: str) -> None:
    assert names.matches(name, name)
    assert names.matches("/**", name)


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


NUMBERS = st.integers(0, UINT32_MAX)
STEPS = st.integers(1, SERIAL_HALF - 1)


def test_bounds_are_those_of_32_bits() -> None:
    assert (INT32_MIN, INT32_MAX, UINT32_MAX) == (-2147483648, 2147483647, 4294967295)
    assert (SERIAL_MASK, SERIAL_HALF) == (4294967295, 2147483648)


@pytest.mark.parametrize(
    ("number", "count", "expected"),
    [(0, 1, 1), (UINT32_MAX, 1, 0), (UINT32_MAX, 3, 2), (0, -1, UINT32_MAX), (5, 0, 5), (7, UINT32_MAX + 1, 7)],
)
def test_addition_wraps(number: int, count: int, expected: int) -> None:
    assert serial_add(number, count) == expected


@pytest.mark.parametrize(
    ("start", "end", "distance"),
    [(3, 3, 0), (3, 10, 7), (UINT32_MAX, 0, 1), (UINT32_MAX - 1, 4, 6), (0, UINT32_MAX, UINT32_MAX)],
)
def test_distance_is_counted_forwards_across_the_wrap(start: int, end: int, distance: int) -> None:
    assert serial_distance(start, end) == distance


@given(NUMBERS)
def test_number_is_neither_later_nor_earlier_than_itself(number: int) -> None:
    assert not is_later(number, number)
    assert not is_earlier(number, number)


@given(NUMBERS, STEPS)
def test_order_holds_across_the_wrap(number: int, step: int) -> None:
    later = serial_add(number, step)
    assert is_later(later, number)
    assert is_earlier(number, later)
    assert not is_later(number, later)
    assert not is_earlier(later, number)
    assert serial_distance(number, later) == step


@given(NUMBERS)
def test_half_the_range_ahead_counts_as_earlier(number: int) -> None:
    """RFC 1982 leaves the order of such two open; both sides must drop rather than accept."""
    opposite = serial_add(number, SERIAL_HALF)
    assert not is_later(opposite, number)
    assert is_earlier(opposite, number)


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
def test_an_identity_of_parts_out_of_range(instance: bytes, name: str, domain: int) -> None:
    with pytest.raises(ValueError):
        Identity(GUID, instance, name, domain)

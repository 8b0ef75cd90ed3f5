from __future__ import annotations

from dataclasses import dataclass, field

from rmpa.bridge.aio.flows import ExportFlow, ImportFlow


@dataclass
class Link:
    sent: list[tuple[int, int, int, bytes]] = field(default_factory=list)
    drops: int = 0

    def send_data(self, route: int, sequence: int, stamp_ns: int, payload: bytes | bytearray | memoryview) -> int:
        self.sent.append((route, sequence, stamp_ns, bytes(payload)))
        return self.drops


@dataclass
class Outlet:
    got: list[bytes] = field(default_factory=list)

    def publish_framed(self, framed: bytes | bytearray | memoryview) -> object:
        self.got.append(bytes(framed))
        return None


def test_each_peer_gets_one_copy_numbered_for_itself() -> None:
    flow, one, two = ExportFlow(), Link(), Link()
    flow.add(one, 7)
    flow.message(memoryview(b"a"))
    flow.add(two, 9)
    flow.message(memoryview(b"b"))
    assert [(r, s, p) for r, s, _, p in one.sent] == [(7, 1, b"a"), (7, 2, b"b")]
    assert [(r, s, p) for r, s, _, p in two.sent] == [(9, 1, b"b")]
    assert one.sent[1][2] == two.sent[0][2] > 0
    assert (flow.messages, flow.bytes) == (2, 2)


def test_two_routes_of_one_link_are_two() -> None:
    flow, link = ExportFlow(), Link()
    flow.add(link, 7)
    flow.add(link, 8)
    flow.remove(link, 7)
    flow.message(memoryview(b"a"))
    assert [(r, s) for r, s, _, _ in link.sent] == [(8, 1)]


def test_a_late_peer_gets_the_latched_message_once_and_before_later_ones() -> None:
    flow, one, two = ExportFlow(), Link(), Link()
    flow.latching = True
    flow.add(one, 7)
    buffer = bytearray(b"map")
    flow.message(memoryview(buffer))
    buffer[:] = b"xxx"  # the stream's buffer is used again
    flow.add(two, 9)
    flow.message(memoryview(b"new"))
    assert [(s, p) for _, s, _, p in two.sent] == [(1, b"map"), (2, b"new")]
    assert [(s, p) for _, s, _, p in one.sent] == [(1, b"map"), (2, b"new")]


def test_what_is_not_latched_is_not_replayed() -> None:
    flow, link = ExportFlow(), Link()
    flow.message(memoryview(b"old"))
    flow.add(link, 7)
    assert link.sent == []


def test_drops_are_counted() -> None:
    flow, link = ExportFlow(), Link(drops=3)
    flow.add(link, 7)
    flow.message(memoryview(b"a"))
    assert flow.dropped == 3


def test_an_import_counts_what_came_and_what_is_missing() -> None:
    outlet = Outlet()
    flow = ImportFlow(outlet)
    for sequence, payload in [(1, b"a"), (2, b"b"), (5, b"e"), (6, b"f")]:
        flow.message(sequence, 1000 + sequence, memoryview(payload))
    assert outlet.got == [b"a", b"b", b"e", b"f"]
    assert (flow.messages, flow.bytes, flow.lost, flow.last_stamp_ns) == (4, 4, 2, 1006)


def test_a_sequence_that_wraps_loses_nothing() -> None:
    flow = ImportFlow(Outlet())
    flow._expected = (1 << 32) - 1
    flow.message((1 << 32) - 1, 0, memoryview(b"a"))
    flow.message(0, 0, memoryview(b"b"))
    flow.message(1, 0, memoryview(b"c"))
    assert flow.lost == 0

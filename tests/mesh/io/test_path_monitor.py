"""Links on a path that drops large packets: the kernel's statistics are made up, all else is real."""

from __future__ import annotations

import asyncio
import socket
from typing import TYPE_CHECKING

import pytest

from rmpa.core.counters import Counters
from rmpa.mesh import limits
from rmpa.mesh.io import path_monitor
from rmpa.mesh.io.sockets import limit_segments, packet_bytes, reset_at_close, sample
from rmpa.mesh.path_mtu import TcpSample
from tests.mesh.io.meshes import Peer, linked_pair, until

if TYPE_CHECKING:
    from rmpa.mesh.io.connection import Connection
    from rmpa.mesh.io.link import PeerLink

FIRST, LEAST = limits.SEGMENT_BYTES


class Hole:
    """Stalls connections that send segments larger than ``passes`` bytes."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *peers: Peer) -> None:
        self.passes = 0
        self.lanes = {"bulk"}
        self.both = False
        self._peers = peers
        self._looks: dict[int, int] = {}
        monkeypatch.setattr(path_monitor, "sample", self.sample)
        monkeypatch.setattr("rmpa.mesh.io.connection.Connection.has_sent", lambda _: True)

    def _stuck(self, sock: socket.socket) -> bool:
        for peer in self._peers:
            for connection in peer.mesh.connections():
                name = "bulk" if connection.lane == 2 else "express"
                if connection.sock is sock and name in self.lanes:
                    return (connection.stalls.segment or 1448) > self.passes
        return False

    def sample(self, sock: socket.socket) -> TcpSample | None:
        if not self._stuck(sock):
            return sample(sock)
        looks = self._looks[id(sock)] = self._looks.get(id(sock), 0) + 1
        return TcpSample(queued=50_000, retransmits=looks, acked=0, delivered=0, rtt=0.001)


def bulk(one: Peer, other: Peer) -> Connection | None:
    link = one.mesh.link(other.identity.guid)
    return link.bulk_connection if link is not None else None


def segment(one: Peer, other: Peer) -> int | None:
    lane = bulk(one, other)
    return lane.stalls.segment if lane is not None else None


@pytest.mark.parametrize("dialler", [True, False])
async def test_stalled_bulk_lane_is_redialled_with_small_packets(
    dialler: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async with linked_pair() as made:
        one, other = made if dialler else made[::-1]
        hole = Hole(monkeypatch, one)
        hole.passes = FIRST
        await until(lambda: segment(one, other) == FIRST, "small packets")
        assert not one.downs, "commands go on"
        assert one.link(other).connection.stalls.segment == FIRST, "those of the express lane too, from now on"
        await until(lambda: other.both_lanes(one), "the other side has the new lane")
        for number in range(3):
            one.link(other).bulk.send(7, number, 0, bytes([number]) * 300_000)
        await until(lambda: len(other.messages(7)) == 3, "images")
        assert [payload for _, payload in other.messages(7)] == [bytes([n]) * 300_000 for n in range(3)]
        await until(lambda: one.mesh.counters["path.black_hole"] == 1, "it is known")
        assert one.mesh.counters["link.black_hole"] == 1
        problem = one.mesh.paths.problem(one.link(other))
        assert problem is not None
        assert "a path-MTU black hole" in problem.text
        lines = [r.getMessage() for r in caplog.records if "path-MTU black hole" in r.getMessage()]
        assert len(lines) == 1
        assert "ip link set dev NAME mtu" in lines[0]
        assert one.mesh.paths.packet_bytes(one.link(other)) == FIRST + limits.TCP_HEADERS
        assert other.mesh.paths.problem(other.link(one)) is None


async def test_useless_small_packets_are_reported(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async with linked_pair() as (one, other):
        hole = Hole(monkeypatch, one)
        hole.passes = LEAST - 1
        await until(lambda: "do not help" in caplog.text, "it is said")
        assert one.mesh.counters["link.black_hole"] == 2
        assert segment(one, other) == LEAST
        assert not one.downs
        problem = one.mesh.paths.problem(one.link(other))
        assert problem is not None
        assert "ping -M do" in problem.remedy
        assert one.mesh.paths.segment("127.0.0.1") is None, "the next lane takes large ones again"


async def test_an_express_lane_that_stands_still_begins_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    async with linked_pair() as (one, other):
        hole = Hole(monkeypatch, one)
        hole.passes, hole.lanes = FIRST, {"express"}
        await until(lambda: bool(one.downs), "the link is given up")
        assert one.downs[0][0].silent, "its peer keeps its place"
        await until(lambda: one.both_lanes(other) and other.both_lanes(one), "the next one")
        assert one.link(other).connection.stalls.segment == segment(one, other) == FIRST


@pytest.mark.parametrize("dialler", [True, False])
async def test_new_connection_probes_when_both_lanes_stall(dialler: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    async with linked_pair() as made:
        one, other = made if dialler else made[::-1]
        hole = Hole(monkeypatch, one)
        hole.passes, hole.lanes = FIRST, {"express", "bulk"}
        await until(lambda: one.mesh.counters["link.black_hole"] > 0, "found")
        await until(lambda: one.both_lanes(other) and other.both_lanes(one), "the next link")
        await until(lambda: segment(one, other) == FIRST, "small packets")


async def test_a_peer_that_answers_nothing_is_no_black_hole(monkeypatch: pytest.MonkeyPatch) -> None:
    async with linked_pair() as (one, other):

        async def refuses(_: PeerLink) -> bool:
            return False

        monkeypatch.setattr("rmpa.mesh.io.connection.Connection.take_probe", lambda _: False)
        monkeypatch.setattr(one.mesh.paths, "_reachable", refuses)
        hole = Hole(monkeypatch, one)
        hole.lanes = {"express", "bulk"}
        link = one.link(other)
        looks = 0

        def counted(link: PeerLink) -> None:
            nonlocal looks
            looks += 1
            type(one.mesh.paths).look(one.mesh.paths, link)

        monkeypatch.setattr(one.mesh.paths, "look", counted)
        await until(lambda: looks > 8, "looked at for a while")
        assert one.link(other) is link
        assert not one.mesh.counters["link.black_hole"]


def test_kernel_statistics_of_a_connection() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server, socket.socket() as sock:
        limit_segments(sock, FIRST, Counters())
        sock.connect(server.getsockname())
        with server.accept()[0] as accepted:
            assert packet_bytes(sock) == packet_bytes(accepted) == FIRST + limits.TCP_HEADERS
            sock.sendall(bytes(10 * FIRST))
            got = 0
            while got < 10 * FIRST:
                got += len(accepted.recv(1 << 16))
            told = sample(sock)
            assert told is not None
            assert told.acked >= 10 * FIRST
            assert 10 <= told.delivered <= 12
            assert (told.queued, told.retransmits) == (0, 0)
            assert 0 < told.rtt < 5.0
            reset_at_close(sock)
            sock.close()
            with pytest.raises(ConnectionResetError):
                accepted.recv(1)
        assert sample(sock) is None
        assert packet_bytes(sock) is None


async def test_the_end_of_a_mesh_ends_its_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    async with linked_pair() as (one, _):

        async def hangs(_: PeerLink) -> bool:
            await asyncio.Event().wait()
            return True

        monkeypatch.setattr(one.mesh.paths, "_reachable", hangs)
        hole = Hole(monkeypatch, one)
        hole.lanes = {"express", "bulk"}
        await until(lambda: bool(one.mesh.paths._trials), "a knock")
    assert not one.mesh.paths._timers

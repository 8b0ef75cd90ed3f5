"""Peers with meshes on loopback, for the tests of this room; every wait is for an event, with a generous deadline."""

from __future__ import annotations

import asyncio
import socket
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

from rmpa.core.identity import Guid, Identity
from rmpa.core.outbox import ABORT, FIRST, LAST
from rmpa.mesh.frames import Frame, FrameKind, Hello, Lane
from rmpa.mesh.io.link import LinkHandlers, PeerLink
from rmpa.mesh.io.mesh import Mesh
from tests.mesh.worlds import AnyRoute

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from rmpa.config.settings import LaneSettings
    from rmpa.mesh.io.securing import OnJoin
    from rmpa.trust.membership import Membership

DEADLINE = 20.0


async def until(condition: Callable[[], bool], what: str) -> None:
    """Wait for a condition that the loop's own events bring about."""
    try:
        async with asyncio.timeout(DEADLINE):
            while not condition():
                await asyncio.sleep(0.002)
    except TimeoutError:
        raise AssertionError(f"not within {DEADLINE} s: {what}") from None


class Peer:
    """A mesh, and what it passed to its callbacks."""

    def __init__(
        self,
        number: int,
        instance: int = 0,
        port: int = 0,
        lanes: LaneSettings | None = None,
        host: str = "127.0.0.1",
        name: str | None = None,
        security: Membership | None = None,
        on_join: OnJoin | None = None,
    ) -> None:
        sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind((host, port))
        sock.listen(32)
        self.number = number
        self.port = sock.getsockname()[1]
        instance_id = bytes([number, instance]) + bytes(14)
        guid = Guid.of("127.0.0.1", self.port, instance)
        self.identity = Identity(guid, instance_id, name or f"peer{number}")
        self.ups: list[PeerLink] = []
        self.downs: list[tuple[PeerLink, str]] = []
        """Links that went down, and the reasons."""
        self.controls: list[bytes] = []
        self.data: list[tuple[int, int, int, bytes]] = []
        self.marks: list[tuple[FrameKind, int, int]] = []
        self.clocks: list[PeerLink] = []
        self.lanes_lost: list[PeerLink] = []
        self.hand_made: list[socket.socket] = []
        """Sockets of ``raw``, closed at the end whatever becomes of the test."""
        self._begun: dict[int, tuple[int, int, bytearray]] = {}
        self.mesh = Mesh(
            self.identity,
            sock,
            LinkHandlers(
                self.on_link_up,
                lambda link, reason: self.downs.append((link, reason)),
                lambda _link, payload: self.controls.append(payload),
                self.on_mark,
                self.clocks.append,
                self.on_lane_lost,
            ),
            lanes=lanes,
            security=security,
            on_join=on_join,
        )

    def on_link_up(self, link: PeerLink) -> None:
        self.ups.append(link)
        link.routes = AnyRoute(self.on_data, self.on_part)
        link.use(used=True)

    def on_data(self, route: int, sequence: int, stamp_ns: int, payload: memoryview) -> None:
        self.data.append((route, sequence, stamp_ns, bytes(payload)))

    def on_part(self, route: int, sequence: int, stamp_ns: int, flags: int, part: memoryview) -> None:
        """Put fragments together; a message is there when its last one is."""
        if flags & FIRST:
            assert route not in self._begun
            self._begun[route] = (sequence, stamp_ns, bytearray())
        assert self._begun[route][:2] == (sequence, stamp_ns)
        whole = self._begun[route][2]
        whole += part
        if flags & LAST:
            del self._begun[route]
            if not flags & ABORT:
                self.data.append((route, sequence, stamp_ns, bytes(whole)))

    def on_mark(self, link: PeerLink, kind: FrameKind, route: int, sequence: int) -> None:
        assert link.used
        self.marks.append((kind, route, sequence))

    def on_lane_lost(self, link: PeerLink) -> None:
        self.lanes_lost.append(link)
        self._begun.clear()

    def messages(self, route: int) -> list[tuple[int, bytes]]:
        """Numbers and payloads of what came on one route."""
        return [(sequence, payload) for r, sequence, _, payload in self.data if r == route]

    def linked(self, *others: Peer) -> bool:
        return all((link := self.mesh.link(o.identity.guid)) is not None and link.connection.up for o in others)

    def link(self, other: Peer) -> PeerLink:
        link = self.mesh.link(other.identity.guid)
        assert link is not None
        return link

    def both_lanes(self, *others: Peer) -> bool:
        """Want bulk lanes with these; return whether all links and lanes are up."""
        if not self.linked(*others):
            return False
        for other in others:
            self.link(other).bulk._on_wanted()
        return all(self.link(other).bulk_connection is not None for other in others)

    def kill(self) -> None:
        """As kill -9: the kernel closes the sockets, and no bye is sent."""
        self.mesh._running = False
        self.mesh.acceptor.close()
        self.mesh._timer.close()
        for connection in self.mesh.connections():
            connection.lost("killed")


@asynccontextmanager
async def peers(count: int, *, found: bool = True, lanes: LaneSettings | None = None) -> AsyncIterator[list[Peer]]:
    made = [Peer(n, lanes=lanes) for n in range(count)]
    try:
        for peer in made:
            await peer.mesh.start()
        if found:
            introduce(made)
        yield made
    finally:
        for peer in made:
            for sock in peer.hand_made:
                sock.close()
        await asyncio.gather(*(p.mesh.close() for p in made))


def introduce(made: list[Peer]) -> None:
    for one in made:
        for other in made:
            if one is not other:
                one.mesh.peer_found(other.identity)


@asynccontextmanager
async def linked_pair(*, lanes: bool = True) -> AsyncIterator[tuple[Peer, Peer]]:
    """Two peers with a link, and with both lanes if ``lanes``; the first one dialled."""
    async with peers(2) as made:
        one, other = sorted(made, key=lambda peer: peer.identity.guid)
        up = Peer.both_lanes if lanes else Peer.linked
        await until(lambda: up(one, other) and up(other, one), "a link")
        yield one, other


async def raw(
    peer: Peer, identity: Identity, *, lease: float = 1.0, lane: int = Lane.EXPRESS
) -> tuple[socket.socket, Frame]:
    """A hand-made dialler: its socket, and the first frame of the answer."""
    loop = asyncio.get_running_loop()
    sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
    peer.hand_made.append(sock)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
    await loop.sock_connect(sock, ("127.0.0.1", peer.port))
    hello = Hello.of(identity, lease=lease, expected=peer.identity.guid, lane=lane)
    await loop.sock_sendall(sock, Frame(FrameKind.HELLO, hello.serialize()).serialize())
    answer = b""
    while (parsed := Frame.parse(answer)) is None:
        # Not a byte more than the answer: the rest is the test's.
        wanted = 24 if len(answer) < 24 else 24 + int.from_bytes(answer[:4], "big")
        chunk = await asyncio.wait_for(loop.sock_recv(sock, wanted - len(answer)), DEADLINE)
        assert chunk
        answer += chunk
    return sock, parsed[0]

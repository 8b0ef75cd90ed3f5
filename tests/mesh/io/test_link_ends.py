"""How a link ended: by its agent's death, by silence, or in order; direct connections go on after the first."""

from __future__ import annotations

import asyncio
import errno
import socket
import struct

import pytest

from rmpa.core.identity import Guid, Identity
from rmpa.mesh import limits
from rmpa.mesh.frames import FrameKind
from tests.mesh.io.meshes import Peer, linked_pair, peers, raw, until

STRANGER = Identity(Guid.of("127.0.0.1", 9), b"s" * 16, "stranger")


def how(peer: Peer) -> tuple[bool, bool]:
    """Of the only link that went down: whether its agent crashed, and whether the peer may soon be back."""
    ((link, _),) = peer.downs
    return link.crashed, link.silent


async def test_a_killed_agent_is_a_crash() -> None:
    async with linked_pair() as (one, other):
        other.kill()
        await until(lambda: bool(one.downs), "it is seen")
        assert how(one)[0]
        await until(lambda: bool(other.downs), "its own side")
        assert how(other)[0] is False, "it gave up the link itself"


async def test_a_bye_is_none() -> None:
    async with linked_pair() as (one, other):
        one.mesh.peer_gone(other.identity.guid)
        other.mesh.peer_gone(one.identity.guid)
        one.link(other).close("maintenance")
        await until(lambda: bool(one.downs) and bool(other.downs), "both down")
        assert (how(one), how(other)) == ((False, False), (False, False))


async def test_a_reset_is_a_crash_with_bytes_unread() -> None:
    async with peers(1) as (one,):
        sock, _ = await raw(one, STRANGER, lease=60.0)
        await until(lambda: bool(one.ups), "a link")
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        sock.close()
        await until(lambda: bool(one.downs), "reset")
        assert how(one) == (True, True)


async def test_a_lease_that_ends_is_silence_and_no_crash() -> None:
    async with peers(1) as (one,):
        await raw(one, STRANGER, lease=0.3)
        await until(lambda: bool(one.downs), "the lease is over")
        assert how(one) == (False, True)


async def test_a_peer_that_breaks_the_protocol_has_not_crashed() -> None:
    async with peers(1) as (one,):
        sock, _ = await raw(one, STRANGER, lease=60.0)
        await until(lambda: bool(one.ups), "a link")
        await asyncio.get_running_loop().sock_sendall(sock, b"\xff" * 64)
        await until(lambda: bool(one.downs), "closed")
        assert how(one) == (False, False)


async def test_the_end_of_the_bulk_lane_is_not_that_of_the_link() -> None:
    async with linked_pair() as (one, other):
        bulk = one.link(other).bulk_connection
        assert bulk is not None
        bulk.lost("a test")
        await until(lambda: bool(other.lanes_lost), "lost")
        await until(lambda: one.both_lanes(other) and other.both_lanes(one), "a new one")
        assert (one.downs, other.downs) == ([], [])
        assert not one.link(other).crashed


@pytest.mark.parametrize(
    ("number", "crashed"),
    [
        (errno.ECONNRESET, True),
        (errno.EPIPE, True),
        (errno.ETIMEDOUT, False),
        (errno.EHOSTUNREACH, False),
        (errno.ENETUNREACH, False),
        (errno.ENETDOWN, False),
        (errno.ECONNABORTED, False),
    ],
)
async def test_each_error_of_a_socket_says_whether_the_host_is_still_there(number: int, *, crashed: bool) -> None:
    async with linked_pair() as (one, other):
        connection = one.link(other).connection
        connection._lost(OSError(number, "made up"))
        await until(lambda: bool(one.downs), "down")
        assert how(one)[0] is crashed


@pytest.mark.parametrize(("instance", "silent"), [(b"s", True), (b"t", False)])
async def test_a_link_that_another_one_replaces_leaves_direct_connections_alone(
    instance: bytes, monkeypatch: pytest.MonkeyPatch, *, silent: bool
) -> None:
    monkeypatch.setattr(limits, "GHOST_QUIET", 0.0)  # the first one counts as quiet at once
    async with peers(1) as (one,):
        await raw(one, STRANGER, lease=60.0)
        await until(lambda: bool(one.ups), "a link")
        _, answer = await raw(one, Identity(STRANGER.guid, instance * 16, "stranger"), lease=60.0)
        assert answer.kind is FrameKind.WELCOME
        await until(lambda: len(one.ups) == 2, "the same run of it by another path, or another run")
        assert how(one) == (True, silent)

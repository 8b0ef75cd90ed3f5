"""The kernel holds little unsent of Zenoh's connections, and other sockets stay as they are."""

from __future__ import annotations

import socket
from typing import TYPE_CHECKING

import pytest

from rmpa.gateway.zenoh.config import SocketTuning
from tests.gateway.memory_zenoh import eventually

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.gateway.zenoh_bed import ZenohBed

UNSENT = 20_000


def unsent(sock: socket.socket) -> int:
    return sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT)


@pytest.fixture
def ends() -> Iterator[tuple[socket.socket, socket.socket, str]]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with socket.create_connection(("127.0.0.1", port)) as ours, server.accept()[0] as theirs:
            yield ours, theirs, f"tcp/127.0.0.1:{port}"


def test_the_connection_to_an_endpoint_is_bounded(ends: tuple[socket.socket, socket.socket, str]) -> None:
    ours, theirs, endpoint = ends
    before = unsent(theirs)
    tuning = SocketTuning(UNSENT)
    assert tuning.look([endpoint]) == 1
    assert (unsent(ours), unsent(theirs)) == (UNSENT, before)
    assert tuning.look([endpoint]) == 0, "each once"


@pytest.mark.parametrize("odd", ["udp/127.0.0.1:{}", "tcp/127.0.0.1", "", "tcp/[::1]:{}", "tcp/127.0.0.2:{}"])
def test_other_endpoints_leave_it_alone(ends: tuple[socket.socket, socket.socket, str], odd: str) -> None:
    ours, _, endpoint = ends
    before = unsent(ours)
    assert SocketTuning(UNSENT).look([odd.format(endpoint.rpartition(":")[2])]) == 0
    assert unsent(ours) == before


async def test_each_connection_of_a_session_is_found(net: ZenohBed) -> None:
    session = await net.session()
    await eventually(lambda: session.endpoints)
    assert SocketTuning(UNSENT).look(session.endpoints) == 1

"""A request and a response of many megabytes give way to data: measured as in ``test_isolation``."""

from __future__ import annotations

import asyncio
import socket
import struct
from typing import Final

import pytest

from rmpa.ros.node.service_client import ServiceConnection, ServiceFailed
from rmpa.ros.node.service_server import ServiceEndpoint
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.ros.wire.tcpros import ServiceDescription, client_header, encode_header
from rmpa.runtime.loop import AgentLoop
from tests.agent.test_isolation import BOUND, DEADLINE, STRAYS, Watched, watched

__all__ = ["watched"]  # a fixture, used by its name

SIZE: Final = 16_000_000
"""To give memory back takes the kernel a millisecond for 10 MB, and nobody can look meanwhile."""
ROUNDS: Final = 6
ECHO: Final = ServiceDescription("rmpa_test/Echo", "6a2e34150c00229791cc89ff309fff21")

pytestmark = [pytest.mark.alone, pytest.mark.timeout(120)]


def _ask(address: tuple[str, int]) -> None:
    """What a node does, in a thread of its own: large requests over one connection."""
    body = bytes(SIZE)
    with socket.create_connection(address, DEADLINE) as sock:
        sock.sendall(encode_header(client_header("/echo", "/node", persistent=True)))
        (size,) = struct.unpack("<I", _read(sock, 4))
        _read(sock, size)
        for _ in range(ROUNDS):
            sock.sendall(struct.pack("<I", SIZE))
            sock.sendall(body)
            assert _read(sock, 5) == b"\x01" + struct.pack("<I", SIZE)
            assert len(_read(sock, SIZE)) == SIZE


def _read(sock: socket.socket, size: int) -> bytearray:
    data = bytearray()
    while len(data) < size:
        chunk = sock.recv(min(1 << 18, size - len(data)))
        assert chunk
        data += chunk
    return data


def _holds() -> list[tuple[float, str]]:
    holds, Watched.holds = Watched.holds, []
    return holds


def test_large_requests_and_responses_are_taken_and_given_in_parts() -> None:
    async def main() -> None:
        node = SlaveNode("/server", "127.0.0.1", "")
        await node.start()
        node.add_service(
            ServiceEndpoint("/echo", "/server", lambda call: call.reply(True, call.request), description=ECHO)
        )
        host, port = node.service_uri.removeprefix("rosrpc://").split(":")
        _holds()
        looks = Watched.looks
        async with asyncio.timeout(DEADLINE):
            await asyncio.to_thread(_ask, (host, int(port)))
        served = _holds()
        assert len(served) <= STRAYS, f"no look for more than {BOUND} s: {served}"
        assert Watched.looks - looks > 1000, "nothing was measured"
        connection = await ServiceConnection.open(node.service_uri, "/echo", "/client")
        body = bytes(SIZE)
        for _ in range(ROUNDS):
            answered = asyncio.Event()
            sizes: list[int] = []

            def done(result: tuple[bool, bytes | bytearray] | ServiceFailed) -> None:
                # Not by a future: the watch shows what ran last, and the answer would be shown with it.
                assert isinstance(result, tuple)
                sizes.append(len(result[1]))  # noqa: B023 - called in this turn
                answered.set()  # noqa: B023 - the same

            connection.request(body, done, DEADLINE)
            await answered.wait()
            assert sizes == [SIZE]
        both = _holds()
        assert len(both) <= STRAYS, f"no look for more than {BOUND} s: {both}"
        connection.close()
        await node.close()

    with asyncio.Runner(loop_factory=AgentLoop) as runner:
        runner.run(main())

"""Accepting connections while descriptors last, and refusing them without noise when they do not."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
from collections.abc import Iterator
from typing import Any

import pytest

from rmpa.runtime import accept as acceptor
from rmpa.runtime import limits
from rmpa.runtime.accept import Acceptor, Descriptors, Use
from tests.runtime.descriptors_left import descriptors_left
from tests.waiting import until


class Listening(socket.socket):
    """A listening socket that counts the attempts to accept, and may fail in them."""

    attempts = 0
    failures: tuple[int, ...] = ()

    def accept(self) -> tuple[socket.socket, Any]:
        self.attempts += 1
        if self.failures:
            number, *rest = self.failures
            self.failures = tuple(rest)
            raise OSError(number, "told so by the test")
        return super().accept()


class Server:
    """An acceptor with its socket and what it accepted."""

    def __init__(self, use: Use = Use.DATA, at_once: int = limits.ACCEPTS) -> None:
        self.sock = Listening()
        self.sock.bind(("127.0.0.1", 0))
        self.sock.listen(64)
        self.address = self.sock.getsockname()
        self.accepted: list[socket.socket] = []
        self.rounds: list[int] = []
        self._clients: list[socket.socket] = []
        self.came = asyncio.Event()
        self.acceptor = Acceptor(self.sock, self._take, name="the test's server", use=use, at_once=at_once)

    def _take(self, sock: socket.socket, _address: tuple[str, int]) -> None:
        self.accepted.append(sock)
        self.came.set()

    def dial(self, count: int = 1) -> None:
        for _ in range(count):
            self._clients.append(socket.create_connection(self.address))

    async def until(self, count: int) -> None:
        async with asyncio.timeout(10):
            while len(self.accepted) < count:
                self.came.clear()
                await self.came.wait()

    def close(self) -> None:
        self.acceptor.close()
        for sock in [*self.accepted, *self._clients]:
            sock.close()


@pytest.fixture(autouse=True)
def descriptors(monkeypatch: pytest.MonkeyPatch) -> Descriptors:
    made = Descriptors()
    monkeypatch.setattr(acceptor, "DESCRIPTORS", made)
    return made


@contextlib.contextmanager
def serving(use: Use = Use.DATA, **options: int) -> Iterator[Server]:
    server = Server(use, **options)
    try:
        yield server
    finally:
        server.close()


async def rounds(count: int) -> None:
    """Let the loop go round."""
    for _ in range(count):
        await asyncio.sleep(0)


async def test_it_hands_over_what_it_accepts_non_blocking(descriptors: Descriptors) -> None:
    with serving() as server:
        server.acceptor.start()
        server.dial(3)
        await server.until(3)
        assert not any(sock.getblocking() for sock in server.accepted)
        assert descriptors.counters.as_dict() == {}


async def test_many_connections_are_accepted_a_few_at_a_time() -> None:
    with serving(at_once=4) as server:
        server.dial(10)
        server.acceptor._acceptable()
        assert len(server.accepted) == 4
        server.acceptor.start()
        await server.until(10)


async def test_data_leaves_the_last_descriptors_and_the_rest_is_closed_and_told_once(
    descriptors: Descriptors, caplog: pytest.LogCaptureFixture
) -> None:
    with serving() as data, serving(Use.CORE) as core, serving(Use.LINK) as link:
        for server in (data, core, link):
            server.dial(40)  # of the 80 that are left data gets 16, the core 32, the links 32
        with descriptors_left(80):
            reserve = descriptors.reserve
            assert reserve == 64
            data.acceptor.start()
            await until(lambda: len(data.accepted) + descriptors.counters["descriptors.refused.data"] == 40)
            assert len(data.accepted) == 80 - reserve
            core.acceptor.start()
            await until(lambda: len(core.accepted) + descriptors.counters["descriptors.refused.core"] == 40)
            assert len(core.accepted) == reserve // 2
            link.acceptor.start()
            await until(lambda: link.acceptor.paused)
            assert len(link.accepted) == 32
            data._clients[-1].settimeout(10)
            assert data._clients[-1].recv(1) == b""
            assert "LimitNOFILE=" in descriptors.problem
        await link.until(40)
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == 3  # for data, the core, the links
    assert "a connection to the test's server is refused: no file descriptors left" in lines[0]
    assert "ulimit -n" in lines[0]


async def test_what_is_refused_is_told_for_a_while(descriptors: Descriptors, monkeypatch: pytest.MonkeyPatch) -> None:
    descriptors.refuse(Use.DATA, "a connection")
    assert descriptors.problem
    monkeypatch.setattr(limits, "DESCRIPTORS_TOLD", 0.0)
    assert not descriptors.problem


async def test_an_error_is_one_look(monkeypatch: pytest.MonkeyPatch) -> None:
    """A socket that stays readable must not be looked at in each round of the loop."""
    monkeypatch.setattr(limits, "ACCEPT_PAUSE", 3600.0)
    with serving() as server:
        server.sock.failures = (errno.ENFILE,) * 500
        server.dial()
        server.acceptor.start()
        await until(lambda: server.acceptor.paused)
        await rounds(200)
        assert server.sock.attempts == 1


@pytest.mark.parametrize(
    ("numbers", "told"),
    [
        ((errno.ENFILE,) * 3, "the system has no room"),
        ((errno.ENOBUFS,) * 3, "the system has no room"),
        ((errno.ENOMEM,) * 3, "the system has no room"),
        ((errno.EPERM,) * 4, "cannot accept connections"),
        ((errno.ECONNABORTED, errno.EPROTO), ""),  # a connection that left is passed over
    ],
)
async def test_an_error_is_told_once_and_does_not_spin(
    numbers: tuple[int, ...], told: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "ACCEPT_PAUSE", 0.01)
    with serving() as server:
        server.sock.failures = numbers
        server.dial()
        server.acceptor.start()
        await server.until(1)
        assert server.sock.attempts <= len(numbers) + 2
    assert [record.levelname for record in caplog.records] == ["WARNING"] * bool(told)
    assert told in caplog.text


async def test_what_cannot_be_taken_is_closed() -> None:
    def refuse(_sock: socket.socket, _address: object) -> None:
        raise RuntimeError("not today")

    with (
        socket.create_server(("127.0.0.1", 0)) as listening,
        socket.create_connection(listening.getsockname()) as end,
    ):
        acceptor = Acceptor(listening, refuse, name="the test's server")
        with pytest.raises(RuntimeError):
            acceptor._acceptable()
        end.settimeout(10)
        assert end.recv(1) == b""


async def test_closing_ends_a_pause_too() -> None:
    server = Server(Use.LINK)
    server.dial()
    with descriptors_left(0):
        server.acceptor.start()
        await until(lambda: server.acceptor.paused)
        server.close()
        server.close()
    assert not server.acceptor.paused
    assert server.sock.fileno() == -1


async def test_a_socket_of_ours_leaves_the_reserve_alone(descriptors: Descriptors) -> None:
    with descriptors_left(3):
        assert descriptors.reserve >= 3
        with pytest.raises(OSError, match="too many open files") as raised:
            descriptors.open_socket(Use.DATA)
        assert raised.value.errno == errno.EMFILE
        socks = [descriptors.open_socket(Use.LINK) for _ in range(3)]
        with pytest.raises(OSError) as raised:
            descriptors.open_socket(Use.LINK)
        assert raised.value.errno == errno.EMFILE
        for sock in socks:
            sock.close()
    with descriptors.open_socket(Use.DATA) as sock:
        assert not sock.getblocking()
    assert descriptors.counters.as_dict() == {
        "descriptors.refused.data": 1,
        "descriptors.refused.link": 1,
    }

from __future__ import annotations

import asyncio
import errno
import socket
import threading
from typing import TYPE_CHECKING

import pytest

from rmpa.core.errors import UnreachableError
from rmpa.ros.core import liveness
from rmpa.ros.core.liveness import listening_ports, read_tables
from rmpa.runtime.tcp_connections import ask_listening_ports

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path


@pytest.fixture
def listening() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as sock:
        yield sock


@pytest.mark.parametrize("look", [listening_ports, ask_listening_ports, read_tables])
def test_listening_ports_are_found(listening: socket.socket, look: Callable[[], set[int] | None]) -> None:
    port = listening.getsockname()[1]
    with socket.create_connection(("127.0.0.1", port)) as client:
        ports = look()
        if ports is None:
            pytest.skip("this kernel does not tell so")
        assert port in ports
        assert client.getsockname()[1] not in ports
    listening.close()
    assert port not in (look() or ())


@pytest.mark.parametrize("piece", [1, 7, 100, 4096])
def test_lines_are_read_in_any_pieces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, piece: int) -> None:
    table = tmp_path / "tcp"
    table.write_text(
        "  sl  local_address rem_address   st tx_queue rx_queue tr tm->when retrnsmt   uid  timeout inode\n"
        "   0: 00000000:07E8 00000000:0000 0A 00000000:00000000 00:00000000 00000000     0        0 1075 1 0 100 0\n"
        "   1: 0100007F:9035 0100007F:1234 01 00000000:00000000 00:00000000 00000000     0        0 4661 1 0 100 0\n"
        " 100: 0000000000000000FFFF00000100007F:97DB 00000000000000000000000000000000:0000 0A 00000000:00000000\n"
    )
    monkeypatch.setattr(liveness, "_TABLES", (table, tmp_path / "none"))
    monkeypatch.setattr(liveness, "_PIECE", piece)
    assert read_tables() == {0x07E8, 0x97DB}


def test_a_kernel_that_does_not_tell_is_no_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(liveness, "_TABLES", (tmp_path / "none",))
    assert read_tables() is None
    monkeypatch.setattr(liveness, "ask_listening_ports", lambda: None)
    assert listening_ports() is None


async def test_the_end_waits_for_a_look_under_way(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thread cannot be cancelled, and the look has a socket open."""
    began, go = threading.Event(), threading.Event()
    seen: list[socket.socket] = []

    def look() -> set[int]:
        with socket.socket() as sock:
            seen.append(sock)
            began.set()
            assert go.wait(20.0)
        return set()

    monkeypatch.setattr(liveness, "listening_ports", look)
    looking = liveness.Liveness(nodes=dict, on_dead=lambda _node, _api: None)
    looking.start()
    assert await asyncio.to_thread(began.wait, 20.0)
    closing = asyncio.ensure_future(looking.close())
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert not closing.done()
    go.set()
    await closing
    assert seen[0].fileno() < 0


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (OSError(errno.EHOSTUNREACH, "as asked"), "No route to host"),
        (OSError("no number"), "no number"),
        (TimeoutError(), "no answer in 3 s"),
        (UnreachableError("machine", "x", "the name does not resolve here"), "the name does not resolve here"),
        (None, ""),
    ],
)
async def test_why_a_node_cannot_be_reached(
    monkeypatch: pytest.MonkeyPatch, error: Exception | None, text: str
) -> None:
    async def connect(*_: object) -> socket.socket:
        if error is not None:
            raise error
        return socket.socket()

    monkeypatch.setattr(liveness, "connect", connect)
    assert await liveness.try_connect("http://10.9.9.9:1234/") == text
    assert not await liveness.refuses("http://10.9.9.9:1234/")


async def test_an_address_that_is_none_cannot_be_reached() -> None:
    assert "a ROS URI looks like" in await liveness.try_connect("http://nowhere/")


async def test_a_refusal_is_no_outage() -> None:
    with pytest.raises(ConnectionRefusedError):
        await liveness.try_connect("http://127.0.0.1:9/")
    assert await liveness.refuses("http://127.0.0.1:9/")

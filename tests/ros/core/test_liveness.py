from __future__ import annotations

import asyncio
import errno
import socket
import threading

import pytest

from rmpa.core.errors import UnreachableError
from rmpa.ros import limits
from rmpa.ros.core import liveness
from rmpa.ros.core.liveness import Liveness, Unreachable


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

    monkeypatch.setattr(liveness, "ask_listening_ports", look)
    looking = Liveness(nodes=dict, on_dead=lambda _node, _api: None)
    looking.start()
    assert await asyncio.to_thread(began.wait, 20.0)
    closing = asyncio.ensure_future(looking.close())
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert not closing.done()
    go.set()
    await closing
    assert seen[0].fileno() < 0


AT = "http://10.9.9.9:1234/"
AFTER = limits.NODE_UNREACHABLE_AFTER


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


class Bed:
    """Attempts to reach the node ``/n``, and what the log says of them."""

    def __init__(self, caplog: pytest.LogCaptureFixture) -> None:
        self.liveness = Liveness(nodes=lambda: {"/n": "http://127.0.0.1:1/"}, on_dead=lambda _node, _api: None)
        self.log = caplog

    def tried(self, problem: str, now: float, api: str = AT) -> str:
        """An attempt; returns what was logged."""
        self.log.clear()
        self.liveness.tried("/n", api, problem, now)
        return self.log.text


@pytest.fixture
def bed(caplog: pytest.LogCaptureFixture) -> Bed:
    return Bed(caplog)


def test_a_node_is_withdrawn_after_a_while_and_comes_back(bed: Bed) -> None:
    assert not bed.tried("no route", 100.0)
    assert bed.liveness.unreachable == {"/n": Unreachable(AT, "no route", 100.0)}
    assert not bed.tried("no answer", 99.9 + AFTER)
    assert "cannot be reached (no answer)" in bed.tried("no answer", 100.0 + AFTER)
    assert not bed.tried("no answer", 200.0 + AFTER), "told once"
    assert bed.liveness.unreachable == {"/n": Unreachable(AT, "no answer", 100.0, withdrawn=True)}
    assert "can be reached again" in bed.tried("", 300.0)
    assert not bed.tried("", 301.0)
    assert not bed.liveness.unreachable


def test_a_short_outage_withdraws_nothing(bed: Bed) -> None:
    bed.tried("no route", 0.0)
    assert not bed.tried("", 1.0)
    assert not bed.tried("no route", AFTER), "the time counts anew"


def test_a_node_that_moves_is_forgotten(bed: Bed) -> None:
    bed.tried("no route", 0.0)
    assert not bed.tried("no route", AFTER, "http://10.9.9.8:1/"), "another address begins anew"
    assert bed.liveness._not_listening(None) == ["/n"]
    assert not bed.liveness.unreachable

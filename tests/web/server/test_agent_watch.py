"""One snapshot for all clients."""

from __future__ import annotations

import asyncio
import socket
import threading
from typing import TYPE_CHECKING, Protocol

import msgspec
import pytest

from rmpa.core.errors import UnreachableError
from rmpa.web import limits
from rmpa.web.server.agent_watch import AgentWatch, ControlReader
from tests.web.snapshots import FULL

if TYPE_CHECKING:
    from pathlib import Path

    from rmpa.observe.snapshot import Snapshot
from rmpa.observe.control import ControlReply


class Closing(Protocol):
    """Anything that can be closed."""

    def close(self) -> None: ...


class ControlSocket:
    """A control socket that answers the first ``answers`` requests and then hangs."""

    def __init__(self, place: Path, answers: int) -> None:
        self.connections = self.requests = 0
        self._answers = answers
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(place / "base.sock"))
        self._listener.listen()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        held: list[Closing] = []
        while True:
            connection, _ = self._listener.accept()
            held.append(connection)
            file = connection.makefile("rb")
            held.append(file)
            while line := file.readline():
                if b"quit" in line:
                    for each in (*held, self._listener):
                        each.close()
                    return
                self.requests += 1
                if self.requests <= self._answers:
                    connection.sendall(ControlReply(ok=True, value=FULL).serialize())

    def close(self, place: Path) -> None:
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(str(place / "base.sock"))
            client.sendall(b"quit\n")
            self._thread.join(30)


def test_an_agent_that_hangs_is_waited_for_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "WEB_AGENT_TIMEOUT", 0.2)
    agent = ControlSocket(tmp_path, answers=2)
    reader = ControlReader({"RMPA_RUNTIME_DIR": str(tmp_path)}, "base")
    assert reader() == reader() == FULL
    with pytest.raises(UnreachableError, match="in time"):
        reader()
    assert agent.requests == 3
    reader.close()
    agent.close(tmp_path)


class Agent:
    """An agent that a test can stop; counts the questions to it."""

    def __init__(self) -> None:
        self.now = 0.0
        self.up = True
        self.asked = 0
        self.may_answer = threading.Event()
        self.may_answer.set()

    def read(self) -> Snapshot:
        self.asked += 1
        assert self.may_answer.wait(30)
        if not self.up:
            raise UnreachableError("agent", "here", "start it")
        return FULL

    def watch(self) -> AgentWatch:
        return AgentWatch(self.read, lambda: self.now)


async def test_many_clients_cost_the_agent_one_question() -> None:
    agent = Agent()
    watch = agent.watch()
    agent.may_answer.clear()
    asking = [asyncio.create_task(watch.reading()) for _ in range(100)]
    await asyncio.sleep(0)
    agent.may_answer.set()
    assert all(reading.snapshot is FULL for reading in await asyncio.gather(*asking))
    agent.now += limits.WEB_SNAPSHOT_AGE * 0.9
    await watch.reading()
    assert agent.asked == 1
    agent.now += limits.WEB_SNAPSHOT_AGE
    await watch.reading()
    assert agent.asked == watch.reads == 2
    await watch.close()


async def test_a_client_that_leaves_takes_nothing_from_the_others() -> None:
    agent = Agent()
    watch = agent.watch()
    agent.may_answer.clear()
    leaving, staying = (asyncio.create_task(watch.reading()) for _ in range(2))
    await asyncio.sleep(0)
    leaving.cancel()
    await asyncio.sleep(0)
    agent.may_answer.set()
    assert (await staying).snapshot is FULL
    assert agent.asked == 1
    await watch.close()


async def test_an_agent_that_is_away_is_asked_no_more_often_and_found_again() -> None:
    agent = Agent()
    watch = agent.watch()
    agent.up = False
    for _ in range(10):
        reading = await watch.reading()
        assert reading.snapshot is None
        assert "start it" in reading.problem
    assert agent.asked == 1
    agent.up = True
    agent.now += limits.WEB_SNAPSHOT_AGE
    assert (await watch.reading()).snapshot is FULL
    await watch.close()


async def test_all_of_a_large_graph_is_read_only_for_those_that_need_it() -> None:
    part = msgspec.structs.replace(FULL, topics=(), topics_left=len(FULL.topics))
    now, wholes = 0.0, 0
    shown = part

    def read_whole() -> Snapshot:
        nonlocal wholes
        wholes += 1
        return FULL

    watch = AgentWatch(lambda: shown, lambda: now, read_whole)
    assert (await watch.reading()).snapshot == part
    readings = await asyncio.gather(*(watch.reading(whole=True) for _ in range(10)))
    assert all(reading.snapshot is FULL for reading in readings)
    assert wholes == 1
    now += limits.WEB_WHOLE_AGE
    assert (await watch.reading(whole=True)).snapshot is FULL
    assert wholes == 2
    now += limits.WEB_WHOLE_AGE
    shown = FULL  # nothing is left out
    assert (await watch.reading(whole=True)).snapshot is FULL
    assert wholes == 2
    await watch.close()

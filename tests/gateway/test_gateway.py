"""The gateway's process: its agent relays, its neighbours begin once the session is open, and all end in order."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import pytest

from rmpa.config.rules import Crossing, CrossingRule, GatewaySettings
from rmpa.config.settings import TrustSettings
from rmpa.core.errors import StartError
from rmpa.gateway import limits
from rmpa.gateway.gateway import Gateway
from rmpa.observe.control_client import ControlClient
from tests.agent.conftest import pytest_asyncio_loop_factories, settings
from tests.agent.test_agent import until
from tests.gateway.memory_zenoh import MemorySession, MemoryZenoh

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Mapping

    from rmpa.config.settings import Settings
    from rmpa.gateway.own_graph import AgentGraph
    from rmpa.gateway.rules import Neighbour
    from rmpa.gateway.zenoh.session import OpenSession

__all__ = ["pytest_asyncio_loop_factories", "settings"]
CONNECT = GatewaySettings(site="here", connect=("tcp/127.0.0.1:7447",))


class OpenedSession(MemorySession):
    """A session in memory, as its owner has it."""

    def __init__(self, events: list[str]) -> None:
        super().__init__(MemoryZenoh(), "1")
        self.events = events
        self.endpoints: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
        self.stale = False
        self.refused: dict[str, int] = {}

    def take_refused(self) -> dict[str, int]:
        refused, self.refused = self.refused, {}
        return refused

    async def close(self) -> None:  # type: ignore[override] # a real one ends threads
        self.events.append("session closed")


class RecordedNeighbour:
    """A neighbour that records what is done with it."""

    def __init__(self, graph: AgentGraph, events: list[str]) -> None:
        self._graph = graph
        self._events = events

    def start(self) -> None:
        self._events.append(f"started in {self._graph.name}")

    async def close(self) -> None:
        self._events.append("closed")

    def report(self) -> dict[str, object]:
        return {"sites": ["warehouse"]}


class Bed:
    """A gateway whose session fails to open so many times."""

    def __init__(self, settings: Settings, gateway: GatewaySettings, failures: int = 0) -> None:
        self.events: list[str] = []
        self.failures = failures
        self.sessions: list[Any] = []
        self.rules: list[tuple[CrossingRule, ...]] = []
        """Of each time that the neighbours were made."""
        self.settings = replace(settings, gateway=gateway)
        self.gateway = Gateway(self.settings, open_session=cast("Any", self._open), make_neighbours=self._make)

    async def _open(self, _settings: Settings) -> Any:
        if self.failures:
            self.failures -= 1
            raise StartError("zenoh", "no router answers")
        self.sessions.append(OpenedSession(self.events))
        return self.sessions[-1]

    def _make(self, graph: AgentGraph, _session: OpenSession, settings: Settings) -> Mapping[str, Neighbour]:
        self.rules.append(settings.gateway.rules)
        return {"sites": RecordedNeighbour(graph, self.events)}


@asynccontextmanager
async def started(bed: Bed) -> AsyncIterator[Gateway]:
    await bed.gateway.start()
    try:
        yield bed.gateway
    finally:
        await bed.gateway.close()


async def test_neighbours_start_with_the_session_and_close_before_it(settings: Callable[..., Settings]) -> None:
    bed = Bed(settings("g"), CONNECT)
    async with started(bed) as gateway:
        assert gateway.agent.bridge.relay.enabled
        assert bed.events == ["started in g"]
    assert bed.events == ["started in g", "closed", "session closed"]


async def test_the_control_socket_reports_what_is_joined(settings: Callable[..., Settings]) -> None:
    bed = Bed(settings("g"), CONNECT)
    async with started(bed):

        def ask() -> dict[str, object]:
            with ControlClient(Path(bed.settings.runtime_dir) / "g.sock") as client:
                return client.call("gateway", dict[str, object])

        report = await asyncio.to_thread(ask)
        assert (report["name"], report["site"], report["problem"]) == ("g", "here", "")
        assert report["neighbours"] == {"sites": {"sites": ["warehouse"]}}


async def test_other_rules_make_the_neighbours_anew(settings: Callable[..., Settings]) -> None:
    bed = Bed(settings("g"), CONNECT)
    async with started(bed) as gateway:
        other = replace(bed.settings, log_level="warning")
        gateway.agent.apply_settings(other)  # nothing that neighbours are made with
        rules = (CrossingRule(crossing=Crossing.NONE),)
        gateway.agent.apply_settings(replace(other, gateway=replace(CONNECT, rules=rules)))
        await until(lambda: len(bed.events) == 3)
        assert bed.events == ["started in g", "closed", "started in g"]
        assert bed.rules == [(), rules]
    assert bed.events[3:] == ["closed", "session closed"]


async def test_a_session_whose_certificate_was_renewed_is_opened_anew_with_its_neighbours(
    settings: Callable[..., Settings], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "CERTIFICATE_LOOK_PERIOD", 0.05)
    monkeypatch.setattr(limits, "OPEN_RETRY_FIRST", 0.05)
    bed = Bed(settings("g"), CONNECT)
    async with started(bed) as gateway:
        bed.sessions[0].stale = True
        assert gateway.report()["stale"]
        await until(lambda: len(bed.events) == 4)
        assert not gateway.report()["stale"]
        assert bed.events == ["started in g", "closed", "session closed", "started in g"]
        assert gateway.session is bed.sessions[1]
    assert bed.events[4:] == ["closed", "session closed"]


async def test_other_permissions_open_a_session_that_listens_anew(
    settings: Callable[..., Settings], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "OPEN_RETRY_FIRST", 0.05)
    listens = GatewaySettings(router=True, listen=("tcp/127.0.0.1:7447",))
    bed = Bed(settings("g"), listens)
    async with started(bed) as gateway:
        gateway.agent.apply_settings(replace(bed.settings, trust=TrustSettings(default="allow")))
        await until(lambda: len(bed.sessions) == 2 and gateway.session is bed.sessions[1])
        assert bed.events == ["started in g", "closed", "session closed", "started in g"]


async def test_a_router_that_comes_later_is_joined_then(settings: Callable[..., Settings]) -> None:
    bed = Bed(settings("g"), CONNECT, failures=2)
    async with started(bed) as gateway:
        assert bed.events == []
        assert "no router answers" in str(gateway.report()["problem"])
        notes = gateway.agent.operations.snapshot({}).notes
        assert any("no router answers" in note for note in notes)
        await until(lambda: bed.events)
        assert gateway.report()["problem"] == ""
    assert bed.events == ["started in g", "closed", "session closed"]


async def test_a_gateway_that_cannot_listen_does_not_start(settings: Callable[..., Settings]) -> None:
    bed = Bed(settings("g"), GatewaySettings(router=True, listen=("tcp/127.0.0.1:7447",)), failures=1)
    with pytest.raises(StartError):
        await bed.gateway.start()
    again = Bed(settings("g"), CONNECT)
    async with started(again):  # its name and ports are free
        assert again.events == ["started in g"]


async def test_a_session_is_closed_if_the_agent_cannot_start(settings: Callable[..., Settings]) -> None:
    first, second = Bed(settings("g"), CONNECT), Bed(settings("g"), CONNECT)
    async with started(first):
        with pytest.raises(StartError):
            await second.gateway.start()
        assert second.events == ["session closed"]

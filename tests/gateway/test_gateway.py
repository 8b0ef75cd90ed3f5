"""The gateway's process: its agent relays, its neighbours begin once the session is open, and all end in order."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, cast

import pytest

from rmpa.config.rules import Crossing, CrossingRule, GatewaySettings
from rmpa.config.settings import Settings, TrustSettings
from rmpa.core.errors import StartError
from rmpa.gateway import limits
from rmpa.gateway.gateway import Gateway
from rmpa.gateway.own_graph import AgentGraph
from rmpa.gateway.rules import Neighbour
from rmpa.gateway.zenoh.session import OpenSession
from rmpa.observe.control_client import ControlClient
from tests.agent.conftest import pytest_asyncio_loop_factories, settings
from tests.agent.test_agent import until
from tests.gateway.memory_zenoh import MemorySession, MemoryZenoh

__all__ = ["pytest_asyncio_loop_factories", "settings"]
CONNECT = GatewaySettings(site="here", connect=("tcp/127.0.0.1:7447",))
LISTEN = GatewaySettings(router=True, listen=("tcp/127.0.0.1:7447",))


class OpenedSession(MemorySession):
    """A session in memory, as its owner has it."""

    def __init__(self, events: list[str]) -> None:
        super().__init__(MemoryZenoh(), "1")
        self.events = events
        self.stale = False
        self.refused: dict[str, int] = {}

    def take_refused(self) -> dict[str, int]:
        refused, self.refused = self.refused, {}
        return refused

    async def close(self) -> None:
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

    def __init__(self, settings: Settings, gateway: GatewaySettings = CONNECT, failures: int = 0) -> None:
        self.events: list[str] = []
        self.failures = failures
        # How often neighbours still fail to be made.
        self.faults = 0
        self.sessions: list[Any] = []
        # Of each time that the neighbours were made.
        self.rules: list[tuple[CrossingRule, ...]] = []
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
        if self.faults:
            self.faults -= 1
            raise RuntimeError("a fault")
        return {"sites": RecordedNeighbour(graph, self.events)}


@asynccontextmanager
async def started(bed: Bed) -> AsyncIterator[Gateway]:
    await bed.gateway.start()
    try:
        yield bed.gateway
    finally:
        await bed.gateway.close()


@pytest.fixture(autouse=True)
def _short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("CERTIFICATE_LOOK_PERIOD", "OPEN_RETRY_FIRST"):
        monkeypatch.setattr(limits, name, 0.05)


@pytest.fixture
async def bed(settings: Callable[..., Settings]) -> Bed:
    return Bed(settings("g"))


async def test_neighbours_start_with_the_session_end_before_it_are_reported_and_made_anew_by_other_rules(
    bed: Bed,
) -> None:
    async with started(bed) as gateway:
        assert gateway.agent.bridge.relay.enabled
        assert bed.events == ["started in g"]
        bed.sessions[0].refused = {"zenoh.key.long": 2}

        def ask() -> dict[str, object]:
            with ControlClient(Path(bed.settings.runtime_dir) / "g.sock") as client:
                return client.call("gateway", dict[str, object])

        report = await asyncio.to_thread(ask)
        assert (report["name"], report["site"], report["problem"]) == ("g", "here", "")
        assert report["neighbours"] == {"sites": {"sites": ["warehouse"]}}
        assert gateway.agent.bridge.counters["zenoh.key.long"] == 2
        other = replace(bed.settings, log_level="warning")
        gateway.agent.apply_settings(other)  # nothing that neighbours are made with
        rules = (CrossingRule(crossing=Crossing.NONE),)
        gateway.agent.apply_settings(replace(other, gateway=replace(CONNECT, rules=rules)))
        await until(lambda: bed.events == ["started in g", "closed", "started in g"])
        assert bed.rules == [(), rules]
    assert bed.events[3:] == ["closed", "session closed"]


async def test_neighbours_that_failed_are_made_again(bed: Bed) -> None:
    async with started(bed) as gateway:
        bed.faults = 1
        rules = (CrossingRule(crossing=Crossing.NONE),)
        gateway.agent.apply_settings(replace(bed.settings, gateway=replace(CONNECT, rules=rules)))
        await until(lambda: bed.events == ["started in g", "closed", "started in g"])


async def test_a_session_whose_certificate_was_renewed_is_opened_anew_with_its_neighbours(bed: Bed) -> None:
    async with started(bed) as gateway:
        bed.sessions[0].stale = True
        assert gateway.report()["stale"]
        await until(lambda: len(bed.events) == 4)
        assert not gateway.report()["stale"]
        assert bed.events == ["started in g", "closed", "session closed", "started in g"]
        assert gateway.session is bed.sessions[1]
    assert bed.events[4:] == ["closed", "session closed"]


async def test_other_permissions_open_a_session_that_listens_anew(settings: Callable[..., Settings]) -> None:
    bed = Bed(settings("g"), LISTEN)
    async with started(bed) as gateway:
        gateway.agent.apply_settings(replace(bed.settings, trust=TrustSettings(default="allow")))
        await until(lambda: len(bed.sessions) == 2 and gateway.session is bed.sessions[1])
        assert bed.events == ["started in g", "closed", "session closed", "started in g"]


async def test_other_permissions_make_the_neighbours_anew_since_they_decide_what_is_offered(bed: Bed) -> None:
    async with started(bed) as gateway:
        gateway.agent.apply_settings(replace(bed.settings, trust=TrustSettings(default="allow")))
        await until(lambda: bed.events == ["started in g", "closed", "started in g"])
        assert gateway.session is bed.sessions[0]


async def test_a_router_that_comes_later_is_joined_then(bed: Bed) -> None:
    bed.failures = 2
    async with started(bed) as gateway:
        assert bed.events == []
        assert "no router answers" in str(gateway.report()["problem"])
        assert any("no router answers" in note for note in gateway.agent.operations.snapshot({}).notes)
        await until(lambda: bed.events)
        assert gateway.report()["problem"] == ""
    assert bed.events == ["started in g", "closed", "session closed"]


async def test_a_gateway_that_cannot_listen_does_not_start_and_a_session_is_closed_if_the_agent_cannot(
    settings: Callable[..., Settings],
) -> None:
    deaf, bed, second = Bed(settings("g"), LISTEN, failures=1), Bed(settings("g")), Bed(settings("g"))
    with pytest.raises(StartError):
        await deaf.gateway.start()
    async with started(bed):  # its name and ports are free
        assert bed.events == ["started in g"]
        with pytest.raises(StartError):
            await second.gateway.start()
        assert second.events == ["session closed"]


async def test_a_package_adds_a_neighbour_and_a_broken_one_is_left_out(
    bed: Bed, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def make(graph: AgentGraph, _session: OpenSession, _settings: Settings) -> Neighbour:
        return RecordedNeighbour(graph, bed.events)

    def fail(*_: object) -> Neighbour:
        raise ValueError("no cable")

    entries = {make: EntryPoint("other", "", ""), fail: EntryPoint("broken", "", ""), (lambda *_: None): None}
    monkeypatch.setattr(
        "rmpa.gateway.gateway.load_plugins", lambda _: [(entry, each) for each, entry in entries.items()]
    )
    async with started(bed) as gateway:
        assert [*gateway.neighbours] == ["sites", "other"]
        assert bed.events == ["started in g", "started in g"]
        assert "broken of the package  failed: ValueError: no cable [plugin-broken]" in caplog.text
    assert bed.events[2:] == ["closed", "closed", "session closed"]

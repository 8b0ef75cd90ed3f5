"""Services between sites: calls, the server's errors, time-outs, bounds, what leaves during a call; and actions."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Any, cast

import pytest

from rmpa.config.rules import Crossing, CrossingRule
from rmpa.core.errors import PeerRefused, RemoteProtocolError, RmpaError, UnreachableError
from rmpa.gateway import limits
from rmpa.gateway.rules import CrossingRules, ForeignSource, MeshSource, SourceKind
from rmpa.gateway.sites.keys import SiteModule, SiteSource
from rmpa.gateway.sites.plans import SiteExport, SiteImport
from rmpa.gateway.sites.services import ImportedService, SiteActions, SiteServices, asked_type, read_description
from rmpa.ros.wire.tcpros import Buffer, ServiceDescription
from tests.gateway.memory_graph import MemoryGraph, MemoryService
from tests.gateway.memory_zenoh import MemoryZenoh
from tests.gateway.sites.site_bed import site_context

RUN = "0" * 32
MOVE = ServiceDescription("std_srvs/Trigger", "937c9679a518e3a18d831e57125ea522", "a/ARequest", "a/AResponse")
HERE = MeshSource(SourceKind.SERVICE, "arm", RUN, "/driver", "/move", "*", "/move", "/rmpa/arm/driver")
OFFERED = SiteSource(SiteModule("warehouse", "arm", RUN), SourceKind.SERVICE, "*", "/driver", "/move")
FOREIGN = ForeignSource(SourceKind.SERVICE, "warehouse", "arm", "/driver", "/arm/move", "*")
EXPORT = SiteExport(HERE, OFFERED)
IMPORT = SiteImport(FOREIGN, OFFERED)


class ServiceGraph(MemoryGraph):
    """A graph whose service is what the test says: it answers with the request, hangs, raises, or has gone."""

    def __init__(self) -> None:
        super().__init__()
        self.description = MOVE
        self.called = asyncio.Event()
        self.go = asyncio.Event()
        self.go.set()
        self.running = self.most = 0
        self.error: Exception | None = None

    async def describe(self, source: MeshSource) -> ServiceDescription:
        if self.error is not None:
            raise self.error
        return self.description

    async def call(self, source: MeshSource, request: Buffer, timeout: float) -> bytes:
        self.called.set()
        if self.error is not None:
            raise self.error
        self.running += 1
        self.most = max(self.most, self.running)
        await self.go.wait()
        self.running -= 1
        return bytes(request)


class Sites:
    """The parts of two sites on one session."""

    def __init__(self, timeout: float = 30.0, rules: CrossingRules | None = None) -> None:
        self.session, self.there, self.here = MemoryZenoh().session(), ServiceGraph(), MemoryGraph()
        self.exporter = SiteServices(site_context("warehouse", self.there, self.session, rules, timeout=timeout))
        self.exporter.export(EXPORT)
        self.imported = ImportedService(IMPORT, site_context("office", self.here, self.session, timeout=timeout))

    @property
    def service(self) -> MemoryService:
        return self.here.services["/arm/move"]

    async def under_way(self) -> asyncio.Task[bytes]:
        """A call that the server has got and does not answer."""
        self.there.go.clear()
        call = asyncio.ensure_future(self.service.serve(b""))
        await self.there.called.wait()
        return call


@pytest.fixture
async def sites() -> AsyncIterator[Sites]:
    found = Sites()
    yield found
    await found.exporter.close()


async def test_a_call_brings_the_response_and_a_query_the_type(sites: Sites) -> None:
    assert await sites.service.describe() == MOVE
    assert await sites.service.serve(b"abc") == b"abc"
    service = sites.imported
    assert (service.calls, service.failed, service.problem) == (1, 0, "")


async def test_a_program_calls_by_the_exact_type_and_without_attachment(sites: Sites) -> None:
    key = "rmpa/1/warehouse/arm/s/std_srvs%Trigger/move"
    (reply,) = await sites.session.get(key, b"x")
    assert (reply.ok, reply.payload) == (True, b"x")
    await sites.service.describe()
    (wrong,) = await sites.session.get("rmpa/1/warehouse/arm/s/std_srvs%Empty/move", b"x")
    assert (wrong.ok, wrong.text) == (False, "service /move is of the type std_srvs/Trigger, not std_srvs/Empty")


async def test_the_servers_error_arrives_as_an_error(sites: Sites) -> None:
    sites.there.error = PeerRefused("/driver", "the arm is off")
    with pytest.raises(PeerRefused) as caught:
        await sites.service.serve(b"")
    assert caught.value.reason == "the arm is off"
    sites.there.error = UnreachableError("server", "/move")
    for ask in (sites.service.serve(b""), sites.service.describe()):
        with pytest.raises(PeerRefused, match="no server answers at /move"):
            await ask


async def test_a_server_that_hangs_ends_with_the_time_out() -> None:
    sites = Sites(timeout=0.05)
    with pytest.raises(PeerRefused, match=r"has not answered in 0\.05 s"):
        await (await sites.under_way())
    await sites.exporter.close()


async def test_a_service_that_leaves_during_a_call_ends_it_at_once(sites: Sites) -> None:
    call = await sites.under_way()
    sites.imported.close()
    with pytest.raises(PeerRefused, match="service /move of arm at site warehouse has left"):
        await call
    assert sites.here.services == {}


async def test_a_new_run_of_the_module_ends_the_calls_of_the_old_one_and_is_called_then(sites: Sites) -> None:
    call, service = await sites.under_way(), sites.service
    newer = SiteSource(SiteModule("warehouse", "arm", "1" * 32), SourceKind.SERVICE, "*", "/driver", "/move")
    sites.imported.renew(SiteImport(FOREIGN, newer))
    with pytest.raises(PeerRefused, match="has left"):
        await call
    sites.there.go.set()
    assert await sites.service.serve(b"new") == b"new"
    assert sites.service is service


async def test_a_gateway_that_ends_answers_the_calls_under_way(sites: Sites) -> None:
    call = await sites.under_way()
    sites.exporter.withdraw(EXPORT)
    await sites.exporter.close()
    with pytest.raises(PeerRefused, match="the gateway of site warehouse ends"):
        await call
    with pytest.raises(PeerRefused, match="has left"):
        await sites.service.serve(b"")


async def test_a_service_gets_a_bounded_number_of_calls_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "SITE_CALLS_AT_ONCE", 2)
    monkeypatch.setattr(limits, "SITE_CALLS_WAITING", 4)
    sites = Sites()
    sites.there.go.clear()
    calls = [asyncio.ensure_future(sites.service.serve(bytes([n]))) for n in range(6)]
    done, _ = await asyncio.wait(calls, return_when=asyncio.FIRST_EXCEPTION, timeout=30)
    assert all("4 calls of service /move wait already" in str(task.exception()) for task in done)
    sites.there.go.set()
    results = await asyncio.gather(*calls, return_exceptions=True)
    assert sorted(each for each in results if isinstance(each, bytes)) == [bytes([n]) for n in range(4)]
    assert sites.there.most == 2


async def test_a_rule_that_denies_is_the_callers_error() -> None:
    rule = CrossingRule(sites=("office",), crossing=Crossing.NONE)
    with pytest.raises(PeerRefused, match=r"gateway\.rule 1 .* lets it not go out to office"):
        await Sites(rules=CrossingRules((rule,))).service.serve(b"")


async def test_a_server_of_another_definition_is_not_called(sites: Sites) -> None:
    await sites.service.describe()
    sites.exporter.withdraw(EXPORT)
    sites.exporter.export(EXPORT)  # restarted, and the gateway here has not asked again
    sites.there.description = ServiceDescription("std_srvs/Trigger", "f" * 32)
    with pytest.raises(PeerRefused, match="another definition, or the server was replaced"):
        await sites.service.serve(b"")
    assert not sites.there.called.is_set()


@pytest.mark.parametrize(
    "data",
    [b'{"type": "std_srvs/Trigger", "md5sum": "x"}', b'{"type": "", "md5sum": "' + b"0" * 32 + b'"}', b" " * 9000],
)
def test_a_description_without_type_or_md5_sum_is_refused(data: bytes) -> None:
    with pytest.raises(RmpaError):
        read_description(data)


def test_the_type_of_a_key() -> None:
    assert asked_type("rmpa/1/a/b/s/std_srvs%Trigger/x/y") == "std_srvs/Trigger"
    assert asked_type("rmpa/1/a/b/s/*/x") == "*"
    for key in ("", "rmpa/1/a/b/t/std_msgs%String/x", "rmpa/2/a/b/s/*/x", "rmpa/1/a/b/s/*"):
        with pytest.raises(RemoteProtocolError):
            asked_type(key)


# --- Actions between sites ------------------------------------------------------------------------------------------

GOAL, CANCEL = "arm_msgs/MoveActionGoal", "actionlib_msgs/GoalID"


def client(topic: str, type_name: str) -> MeshSource:
    return MeshSource(SourceKind.TOPIC, "base", "0" * 32, "/client", topic, type_name, topic, "/rmpa/base/client")


def server(topic: str, type_name: str = "actionlib_msgs/GoalStatusArray") -> ForeignSource:
    return ForeignSource(SourceKind.TOPIC, "warehouse", "arm", "/server", topic, type_name)


class Heard(set[tuple[str, str]]):
    """The pairs of a graph's topics and the servers under whose names they are listened to."""

    def attend(self, source: MeshSource, listener: ForeignSource) -> Heard:
        self.add((source.here, listener.name))
        tap = Heard()
        tap.close = lambda: self.remove((source.here, listener.name))  # type: ignore[method-assign]
        return tap

    def close(self) -> None:
        raise NotImplementedError


def test_goals_and_cancellations_are_listened_to_under_the_servers_name() -> None:
    heard = Heard()
    actions = SiteActions(cast("Any", heard))
    actions.client(client("/move/goal", GOAL), there=True)
    actions.client(client("/move/goal", GOAL), there=True)  # for another site too
    actions.client(client("/move/other", "std_msgs/String"), there=True)
    actions.server(server("/turn/status"), there=True)
    actions.server(server("/move/feedback", "arm_msgs/MoveActionFeedback"), there=True)
    assert heard == set()
    actions.server(server("/move/status"), there=True)
    actions.client(client("/move/cancel", CANCEL), there=True)
    assert heard == {("/move/goal", "/move/status"), ("/move/cancel", "/move/status")}
    actions.client(client("/move/goal", GOAL), there=False)
    assert len(heard) == 2
    actions.client(client("/move/goal", GOAL), there=False)
    assert heard == {("/move/cancel", "/move/status")}
    actions.server(server("/move/status"), there=False)
    assert heard == set()

"""Services between sites: calls, the server's errors, time-outs, bounds, what leaves during a call."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.config.rules import Crossing, CrossingRule
from rmpa.core.errors import PeerRefused, RemoteProtocolError, RmpaError, UnreachableError
from rmpa.gateway import limits
from rmpa.gateway.neighbour import ForeignSource, MeshSource, SourceKind
from rmpa.gateway.rules import CrossingRules
from rmpa.gateway.sites.keys import SiteModule, SiteSource
from rmpa.gateway.sites.plans import SiteExport, SiteImport
from rmpa.gateway.sites.services import SiteServices, asked_type, read_description, write_description
from rmpa.ros.wire.tcpros import ServiceDescription
from tests.gateway.memory_zenoh import MemoryZenoh
from tests.gateway.sites.site_bed import site_context

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

RUN = "0" * 32
MOVE = ServiceDescription("std_srvs/Trigger", "937c9679a518e3a18d831e57125ea522", "a/ARequest", "a/AResponse")
HERE = MeshSource(SourceKind.SERVICE, "arm", RUN, "/driver", "/move", "*", "/move", "/rmpa/arm/driver")
OFFERED = SiteSource(SiteModule("warehouse", "arm", RUN), SourceKind.SERVICE, "*", "/driver", "/move")
FOREIGN = ForeignSource(SourceKind.SERVICE, "warehouse", "arm", "/driver", "/arm/move", "*")
EXPORT = SiteExport(HERE, OFFERED)
IMPORT = SiteImport(FOREIGN, OFFERED)


class ServiceGraph:
    """The services of a gateway's graph: those of its modules are functions, those of others are kept."""

    def __init__(self) -> None:
        self.server: Callable[[bytes], Awaitable[bytes]] | None = None
        self.description = MOVE
        self.shown: dict[ForeignSource, Any] = {}
        self.closed: list[ForeignSource] = []

    async def describe(self, source: MeshSource) -> ServiceDescription:
        if self.server is None:
            raise UnreachableError("server", source.name)
        return self.description

    async def call(self, source: MeshSource, request: bytes, timeout: float) -> bytes:
        del timeout
        if self.server is None:
            raise UnreachableError("server", source.name)
        return await self.server(request)

    def show_service(self, source: ForeignSource, serve: Any, describe: Any) -> Any:
        graph = self

        class _Shown:
            problem = ""

            def close(self) -> None:
                graph.closed.append(source)

        self.shown[source] = serve, describe
        return _Shown()


class Sites:
    """The parts of two sites on one session."""

    def __init__(self, timeout: float = 30.0, rules: CrossingRules | None = None) -> None:
        network = MemoryZenoh()
        self.session = network.session()
        self.there, self.here = ServiceGraph(), ServiceGraph()
        session = network.session()
        self.exporter = SiteServices(site_context("warehouse", self.there, session, rules, timeout=timeout))
        self.importer = SiteServices(site_context("office", self.here, session, timeout=timeout))
        self.exporter.export(EXPORT)
        self.importer.show(IMPORT)

    async def call(self, request: bytes = b"") -> bytes:
        answer: bytes = await self.here.shown[FOREIGN][0](request)
        return answer

    async def describe(self) -> ServiceDescription:
        found: ServiceDescription = await self.here.shown[FOREIGN][1]()
        return found

    async def close(self) -> None:
        for part in (self.importer, self.exporter):
            await part.close()


async def test_a_call_brings_the_response_and_a_query_the_type() -> None:
    sites = Sites()

    async def server(request: bytes) -> bytes:
        return request[::-1]

    sites.there.server = server
    assert await sites.describe() == MOVE
    assert await sites.call(b"abc") == b"cba"
    service = sites.importer.imported[FOREIGN]
    assert (service.calls, service.failed, service.problem) == (1, 0, "")
    await sites.close()


async def test_a_program_calls_by_the_exact_type_and_without_attachment() -> None:
    sites = Sites()

    async def server(request: bytes) -> bytes:
        return request

    sites.there.server = server
    key = "rmpa/1/warehouse/arm/s/std_srvs%Trigger/move"
    (reply,) = await sites.session.get(key, b"x")
    assert (reply.ok, reply.key, reply.payload) == (True, key, b"x")
    await sites.describe()
    (wrong,) = await sites.session.get("rmpa/1/warehouse/arm/s/std_srvs%Empty/move", b"x")
    assert not wrong.ok
    assert wrong.payload.decode() == "service /move is of the type std_srvs/Trigger, not std_srvs/Empty"
    await sites.close()


async def test_the_text_of_the_servers_error_arrives_as_an_error() -> None:
    sites = Sites()

    async def server(_: bytes) -> bytes:
        raise PeerRefused("/driver", "the arm is off")

    sites.there.server = server
    with pytest.raises(PeerRefused) as caught:
        await sites.call()
    assert caught.value.reason == "the arm is off"
    await sites.close()


async def test_a_server_that_cannot_be_reached_is_an_error_that_says_so() -> None:
    sites = Sites()
    for ask in (sites.call, sites.describe):
        with pytest.raises(PeerRefused, match="no server answers at /move"):
            await ask()
    await sites.close()


async def test_a_server_that_hangs_ends_with_the_time_out() -> None:
    sites = Sites(timeout=0.05)

    async def server(_: bytes) -> bytes:
        await asyncio.Event().wait()
        return b""

    sites.there.server = server
    with pytest.raises(PeerRefused, match=r"has not answered in 0\.05 s"):
        await sites.call()
    await sites.close()


async def test_a_service_that_leaves_during_a_call_ends_it_at_once() -> None:
    sites = Sites()
    begun = asyncio.Event()

    async def server(_: bytes) -> bytes:
        begun.set()
        await asyncio.Event().wait()
        return b""

    sites.there.server = server
    call = asyncio.create_task(sites.call())
    await begun.wait()
    sites.importer.hide(IMPORT)
    with pytest.raises(PeerRefused, match="service /move of arm at site warehouse has left"):
        await call
    assert sites.here.closed == [FOREIGN]
    await sites.close()


async def test_a_new_run_of_the_module_ends_the_calls_of_the_old_one_and_is_called_then() -> None:
    sites = Sites()
    begun = asyncio.Event()

    async def hangs(_: bytes) -> bytes:
        begun.set()
        await asyncio.Event().wait()
        return b""

    async def answers(_: bytes) -> bytes:
        return b"new"

    sites.there.server = hangs
    call = asyncio.create_task(sites.call())
    await begun.wait()
    newer = SiteSource(SiteModule("warehouse", "arm", "1" * 32), SourceKind.SERVICE, "*", "/driver", "/move")
    sites.importer.renew(SiteImport(FOREIGN, newer))
    with pytest.raises(PeerRefused, match="has left"):
        await call
    sites.there.server = answers
    assert await sites.call() == b"new"
    assert sites.here.closed == []
    await sites.close()


async def test_a_gateway_that_ends_answers_the_calls_under_way() -> None:
    sites = Sites()
    begun = asyncio.Event()

    async def server(_: bytes) -> bytes:
        begun.set()
        await asyncio.Event().wait()
        return b""

    sites.there.server = server
    call = asyncio.create_task(sites.call())
    await begun.wait()
    sites.exporter.withdraw(EXPORT)
    await sites.exporter.close()
    with pytest.raises(PeerRefused, match="the gateway of site warehouse ends"):
        await call
    with pytest.raises(PeerRefused, match="has left"):
        await sites.call()
    await sites.close()


async def test_a_service_gets_a_bounded_number_of_calls_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "SITE_CALLS_AT_ONCE", 2)
    monkeypatch.setattr(limits, "SITE_CALLS_WAITING", 4)
    sites = Sites()
    go, most, running = asyncio.Event(), 0, 0

    async def server(request: bytes) -> bytes:
        nonlocal most, running
        running += 1
        most = max(most, running)
        await go.wait()
        running -= 1
        return request

    sites.there.server = server
    calls = [asyncio.create_task(sites.call(bytes([n]))) for n in range(6)]
    done, _ = await asyncio.wait(calls, return_when=asyncio.FIRST_EXCEPTION, timeout=30)
    assert all("4 calls of service /move wait already" in str(task.exception()) for task in done)
    go.set()
    results = await asyncio.gather(*calls, return_exceptions=True)
    assert sorted(each for each in results if isinstance(each, bytes)) == [bytes([n]) for n in range(4)]
    assert most == 2
    await sites.close()


async def test_a_rule_that_denies_is_the_callers_error() -> None:
    rule = CrossingRule(sites=("office",), crossing=Crossing.NONE)
    sites = Sites(rules=CrossingRules((rule,)))
    with pytest.raises(PeerRefused, match=r"gateway\.rule 1 .* lets it not go out to office"):
        await sites.call()
    await sites.close()


async def test_a_server_of_another_definition_is_not_called() -> None:
    sites = Sites()
    called = 0

    async def server(request: bytes) -> bytes:
        nonlocal called
        called += 1
        return request

    sites.there.server = server
    await sites.describe()
    sites.exporter.withdraw(EXPORT)
    sites.exporter.export(EXPORT)  # restarted, and the gateway here has not asked again
    sites.there.description = ServiceDescription("std_srvs/Trigger", "f" * 32)
    with pytest.raises(PeerRefused, match="another definition, or the server was replaced"):
        await sites.call()
    assert called == 0
    await sites.close()


names = st.text("abcXYZ_09", min_size=1, max_size=20).map(lambda text: f"a{text}")


@given(names, names, st.binary(min_size=16, max_size=16), names, names)
def test_descriptions_are_read_back(package: str, name: str, md5: bytes, request: str, response: str) -> None:
    description = ServiceDescription(f"{package}/{name}", md5.hex(), request, response)
    assert read_description(write_description(description)) == description


@given(st.binary(max_size=200))
def test_what_is_no_description_is_refused(data: bytes) -> None:
    with pytest.raises(RemoteProtocolError):
        read_description(data)


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

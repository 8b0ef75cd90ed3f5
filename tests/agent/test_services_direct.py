"""Direct calls of services between whole agents in one process: lookups, hostile answers, links that are lost."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from rmpa.bridge import limits
from rmpa.bridge.direct.paths import Condition
from rmpa.bridge.policy import Needs
from rmpa.config.settings import ServiceSettings, Settings
from rmpa.core.contract import Transport
from rmpa.ros.node.service_client import ServiceConnection
from rmpa.ros.node.service_server import ServiceEndpoint
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.ros.wire.tcpros import ServiceDescription
from tests.agent.test_agent import running, until
from tests.agent.test_services import MD5, Served, Server, come_back, fall_silent, provider, serving

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from rmpa.agent.agent import Agent
    from rmpa.bridge.sessions import PeerSession
    from rmpa.core.facts import ServiceInfo

CLIENT = "/client"
AGAIN = "direct.service_again"


@pytest.fixture
def pair(settings: Callable[..., Settings]) -> tuple[Settings, Settings]:
    """The settings of two modules that call directly where they can."""
    services = ServiceSettings(transport=Transport.AUTO)
    return replace(settings("a"), services=services), replace(settings("b"), services=services)


def register(agent: Agent, name: str = CLIENT) -> None:
    """Make the core know a node."""
    agent.core.call("registerSubscriber", name, "/x", "std_msgs/String", "http://10.0.0.7:1234/")


def lookup(agent: Agent, service: str = "/add", caller: str = CLIENT) -> str:
    """What a node is answered."""
    return str(agent.core.call("lookupService", caller, service).value)


def transport(agent: Agent, service: str = "/add") -> tuple[str, str]:
    """The transport of a peer's service, and why it is relayed."""
    info = about(agent, service)
    return (info.transport, info.condition) if info is not None else ("", "")


def about(agent: Agent, service: str = "/add") -> ServiceInfo | None:
    found = [i for i in agent.operations.snapshot({}).services if i.name == service and i.direction == "in"]
    return found[0] if found else None


def own_uri(server: Server) -> str:
    return server.node.service_uri.replace("localhost", "127.0.0.1")


@pytest.fixture
async def direct(pair: tuple[Settings, Settings]) -> AsyncIterator[Served]:
    """The agents of two modules, and a server in the first one that nodes of the second one call directly."""
    async with running(*pair) as (a, b), serving(a) as server:
        await until(lambda: transport(b) == ("direct", ""))
        yield a, b, server


async def test_registered_nodes_are_told_the_server_and_others_the_proxy(direct: Served) -> None:
    a, b, server = direct
    (proxy,) = b.core.state().services["/add"].values()
    register(b)
    register(b, "/rmpa_service_call")
    assert lookup(b) == own_uri(server) != proxy
    for caller in ("/unknown", "/rmpa", "/rmpa/a/adder", "/rmpa_service", "/rmpa_service_call"):
        assert lookup(b, caller=caller) == proxy, caller
    connection = await ServiceConnection.open(lookup(b), "/add", CLIENT)
    assert await connection.call(b"1", 20.0) == (True, b"1")
    connection.close()
    (here,) = [i for i in b.operations.snapshot({}).services if i.name == "/add"]
    (there,) = [i for i in a.operations.snapshot({}).services if i.name == "/add"]
    assert (here.address, here.lookups, here.calls) == (own_uri(server), 2, 0)
    assert (there.direct_callers, there.calls) == (("b",), 0)


async def test_the_proxy_answers_where_the_lookup_says_so(direct: Served) -> None:
    """A service of this module hides the peer's at once, before the bridge has looked at it."""
    _a, b, _server = direct
    register(b)
    b.core.call("registerService", "/mine", "/add", "rosrpc://127.0.0.1:9", "http://127.0.0.1:9/")
    assert lookup(b) == "rosrpc://127.0.0.1:9"


async def test_direct_warns_once_where_it_cannot_be_had(
    pair: tuple[Settings, Settings], caplog: pytest.LogCaptureFixture
) -> None:
    wish = replace(pair[1], services=ServiceSettings(transport=Transport.DIRECT, timeout=5.0))
    async with running(pair[0], wish) as (a, b), serving(a):
        await until(lambda: transport(b) == ("relay", "contract"))
        b.bridge.reload(wish)
        said = [r.getMessage() for r in caplog.records if 'although transport is "direct"' in r.getMessage()]
        assert len(said) == 1
        assert "timeout of 5 s" in said[0]


async def test_false_answers_lead_nowhere(pair: tuple[Settings, Settings]) -> None:
    """What is no answer at all, ``tests/bridge/test_direct.py`` has."""
    async with running(*pair) as (a, b), serving(b, "/trap", "/trap") as trap:
        # It serves a service of that name too, and would take the calls.
        description = ServiceDescription("a/Add", MD5)
        trap.node.add_service(ServiceEndpoint("/add", "/trap", trap.calls.append, description=description))
        ours = int(trap.node.service_uri.rpartition(":")[2])
        register(b)
        for answer, condition in (
            ({"port": 1, "address": "10.0.0.9", "uri": "rosrpc://10.0.0.9:1"}, Condition.REACHABLE),
            ({"port": ours, "probe": "/trap/get_loggers"}, Condition.REACHABLE),
            ([1, 2], Condition.RELEASE),
            ({"why": "moon", "text": "\x1b[31mred"}, Condition.RELEASE),
        ):
            a.bridge.rpc.on_request("direct.service", lambda _session, _args: answer, Needs((), "a test"))  # noqa: B023
            async with serving(a):
                await until(lambda: transport(b)[1])
                info = about(b)
                assert info is not None
                assert info.condition == condition
                assert "\x1b" not in info.relayed_because
                (proxy,) = b.core.state().services["/add"].values()
                assert lookup(b) == proxy
                assert trap.calls == []
            await until(lambda: not provider(b))


async def test_a_flood_of_notifications_does_no_harm(pair: tuple[Settings, Settings]) -> None:
    asked = 0

    def refuse(_session: PeerSession, _args: dict[str, Any]) -> object:
        nonlocal asked
        asked += 1
        return {"why": "node", "text": "busy"}

    async with running(*pair) as (a, b), serving(a), serving(a, "/sub", "/other"):
        await until(lambda: transport(b)[0] == transport(b, "/sub")[0] == "direct")
        a.bridge.rpc.on_request("direct.service", refuse, Needs((), "a test"))
        (session,) = a.bridge.sessions.linked()
        for number in range(500):
            a.bridge.rpc.notify(session, AGAIN, {"name": f"/no{number}", "node": "/adder"})
            a.bridge.rpc.notify(session, AGAIN, {"name": "/add", "node": "/adder"})
        await until(lambda: transport(b) == ("relay", "node"))
        assert asked <= 2, "once a second, whatever it is told"
        assert transport(b, "/sub") == ("direct", "")
        assert len(list(b.services.direct_imports)) == 2


async def test_a_malformed_notification_ends_its_link_alone(direct: Served) -> None:
    a, b, _server = direct
    (session,) = a.bridge.sessions.linked()
    link = session.link
    a.bridge.rpc.notify(session, AGAIN, {"name": "no name", "node": 7})
    await until(lambda: [s.link for s in a.bridge.sessions.linked()] not in ([], [link]))
    await until(lambda: transport(b)[0] == "direct")


async def test_silence_ends_direct_lookups_at_once_and_the_next_link_restores_them(direct: Served) -> None:
    a, b, server = direct
    register(b)
    (proxy,) = b.core.state().services["/add"].values()
    links = fall_silent(a, b)
    assert lookup(b) == proxy
    come_back(links)
    await until(lambda: lookup(b) == own_uri(server))


def crash(agent: Agent) -> None:
    """The agent at the other end of the link has died, as far as this one can see."""
    (session,) = agent.bridge.sessions.linked()
    session.link.connection.crashed = True
    agent.bridge.sessions.link_down(session.link)


async def test_after_a_crash_direct_services_do_not_stay_for_ever(
    pair: tuple[Settings, Settings], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "DIRECT_KEEP", 0.3)
    async with running(*pair) as (a, b), serving(a):
        await until(lambda: transport(b)[0] == "direct")
        crash(b)
        assert provider(b)
        await until(lambda: not provider(b))


async def test_many_services_of_one_peer_are_all_asked_for(pair: tuple[Settings, Settings]) -> None:
    async with running(*pair) as (a, b), serving(a) as server:
        names = [f"/s{number}" for number in range(60)]
        for name in names:
            a.core.call("registerService", "/adder", name, server.node.service_uri, server.node.uri)
        await until(lambda: all(name in b.core.state().services for name in names))

        # They are not served, only registered: each probe finds the node, and that it does not know the service.
        def asked() -> bool:
            services = {i.name: i for i in b.operations.snapshot({}).services if i.direction == "in"}
            found = {(services[name].transport, services[name].condition) for name in names if name in services}
            return found == {("relay", "reachable")}

        await until(asked)
        await until(lambda: transport(b) == ("direct", ""))


async def test_a_node_without_the_service_of_the_expected_name_is_no_server(pair: tuple[Settings, Settings]) -> None:
    async with running(*pair) as (a, b), serving(a) as server:
        stray = SlaveNode("/stray", "127.0.0.1", a.core.uri)
        await stray.start()
        a.core.call("registerService", "/stray", "/stray_add", server.node.service_uri, stray.uri)
        await until(lambda: transport(b, "/stray_add") == ("relay", "reachable"))
        await stray.close()

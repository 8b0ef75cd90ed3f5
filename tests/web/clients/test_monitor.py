"""The monitor's pages at the whole server: what the hub, the agent and a robot see of a page, and a page of them."""

from __future__ import annotations

import asyncio
import json
import struct
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import aiohttp
import msgspec
import pytest

from rmpa.resource.resource import Resource
from rmpa.resource.runtime import describe
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node
from rmpa.ros.types.definitions import ARRAY_TYPE, DiagnosticLevel, DiagnosticStatus, frame_array
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.tcpros import LENGTH
from rmpa.web import limits as web_limits
from rmpa.web.hub.node_link import FULL, READ_ONLY, Rights
from rmpa.web.monitor import limits
from rmpa.web.monitor.messages import SUBPROTOCOL
from rmpa.web.server.agent_watch import AgentWatch
from tests.waiting import until
from tests.web.clients.server import running_server
from tests.web.hub.client import node
from tests.web.monitor import page as monitor_page
from tests.web.snapshots import FULL as SNAPSHOT
from tests.web.snapshots import Agent

TEXT = MessageType("std_msgs/String")
TWIST = MessageType("geometry_msgs/Twist")


class Page(monitor_page.Page):
    """A page of a server whose agent the test has in hand."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse, agent: Agent) -> None:
        super().__init__(socket)
        self.agent = agent


@asynccontextmanager
async def page_of(core: RosCore, rights: Rights = FULL, agent: Agent | None = None) -> AsyncIterator[Page]:
    agent = agent or Agent(core.uri)
    watch = AgentWatch(agent.read)
    try:
        async with (
            running_server(core, rights, watch=watch) as server,
            server.client(SUBPROTOCOL, path="/monitor") as client,
        ):
            yield Page(client.socket, agent)
    finally:
        await watch.close()


@pytest.fixture
async def page(core: RosCore) -> AsyncIterator[Page]:
    async with page_of(core) as made:
        yield made


def described_by(resource: Resource, node: str) -> str:
    return msgspec.json.encode(describe(resource, node)).decode()


async def text_topic(talker: Node, name: str, text: str) -> Any:
    publisher = await talker.advertise(name, TEXT, latch=True)
    publisher.publish_raw(TEXT.serialize(TEXT.make({"data": text})))
    return publisher


async def status_topic(talker: Node, name: str, level: DiagnosticLevel, message: str, **values: str) -> Any:
    publisher = await talker.advertise(name, MessageType(ARRAY_TYPE), latch=True)
    status = DiagnosticStatus(level, "arm", message, "arm", {"rate": "9 Hz", **values})
    publisher.publish_raw(frame_array(1, time.time_ns(), [status.serialize()])[LENGTH.size :])
    return publisher


async def test_a_page_that_may_only_look_gets_the_state_then_its_changes_and_changes_nothing(core: RosCore) -> None:
    async with page_of(core, READ_ONLY) as page:
        await page.sees(lambda: page.hello)
        assert (page.hello["agent"], page.hello["may"]) == (SNAPSHOT.agent.name, [])
        [peer, *_] = SNAPSHOT.peers
        await page.sees(lambda: peer.name in page.state.get("modules", ()))
        page.agent.snapshot = msgspec.structs.replace(page.agent.snapshot, peers=())
        await page.sees(lambda: page.state["modules"][peer.name]["state"] == "away")
        for what in ("params", "param_names", "set_param", "delete_param", "call", "profile", "context"):
            assert "may" in await page.ask(what, name="/speed", value=1, service="/light", resource="/arm")
        await page.drive(1)
        assert "may not drive" in (await page.next("failed", id=0))["error"]
        assert not core.publishers("/cmd_vel")


async def test_a_page_is_told_when_the_agent_is_silent_and_when_it_is_back(page: Page) -> None:
    await page.sees(lambda: page.state.get("reach", {}).get("ok"))
    page.agent.up = False
    await page.sees(lambda: not page.state["reach"]["ok"])
    assert "rmpa up" in page.state["reach"]["remedy"]
    assert page.state["modules"]
    page.agent.up = True
    await page.sees(lambda: page.state["reach"]["ok"])


async def test_a_page_is_greeted_although_the_agent_hangs(core: RosCore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web_limits, "SETTLE", 0.05)
    agent = Agent(core.uri)
    agent.may_answer.clear()
    async with page_of(core, agent=agent) as page:
        await page.sees(lambda: page.hello)
        assert page.hello["agent"] == ""
        agent.may_answer.set()
        await page.sees(lambda: page.state.get("reach", {}).get("ok"))


async def test_live_values_and_plots_of_a_topic_and_its_details(page: Page, talker: Node) -> None:
    publisher = await talker.advertise("/speed", TWIST, latch=True)
    publisher.publish_raw(struct.pack("<6d", 0.5, 0, 0, 0, 0, 1))
    await page.send("watch", id=1, topic="/speed", how="value")
    value = await page.next("value", id=1)
    assert (value["type"], value["value"]["linear"]["x"]) == ("geometry_msgs/Twist", 0.5)
    await page.send("watch", id=2, topic="/speed", how="plot", fields=["linear.x", "angular.z"])
    points = await page.next("points", id=2)
    assert [column[-1] for column in points["columns"][1:]] == [0.5, 1.0]
    topic = SNAPSHOT.topics[0].name
    await page.send("look", at=[["topic", topic]])
    await page.sees(lambda: page.state.get("detail", {}).get(f"topic:{topic}", {}).get("name") == topic)


async def test_parameters_are_read_and_set_and_told_where_another_node_sets_them(page: Page, core: RosCore) -> None:
    assert (await page.ask("set_param", peer="", name="/speed", value=0.4))["values"]["speed"] == 0.4
    assert core.call("getParam", "/test", "/speed").value == 0.4
    assert "speed" not in (await page.ask("delete_param", peer="", name="/speed"))["values"]
    assert "cannot be null" in await page.ask("set_param", peer="", name="/speed", value=None)
    core.call("setParam", "/other", "/span", [1.0, float("nan")])
    core.call("setParam", "/other", "/reach", float("nan"))
    await page.answered("params", lambda told: told.get("values", {}).get("reach") == "nan", peer="")
    for typed, kept in (("nan", "nan"), ("-inf", "-inf"), (2, 2.0), ("far", "far")):
        await page.ask("set_param", peer="", name="/reach", value=typed)
        value = core.call("getParam", "/test", "/reach").value
        assert (str(value), type(value)) == (str(kept), str if typed == "far" else float)
    await page.ask("set_param", peer="", name="/span", value=[1, "nan", 3])
    span: Any = core.call("getParam", "/test", "/span").value
    assert [str(each) for each in span] == ["1.0", "nan", "3.0"]
    assert "no agent" in await page.ask("params", peer="arm")
    await page.sees(lambda: "parameters" in page.state)
    known, before = await page.ask("params", peer=""), page.state["parameters"]
    core.call("setParam", "/other", "/gain/p", 2.5)
    # The agent's snapshot stays the same one: what is counted is of the core.
    page.agent.snapshot = msgspec.structs.replace(page.agent.snapshot, taken=page.agent.snapshot.taken + 1)
    await page.sees(lambda: page.state["parameters"] != before)
    fresh = await page.ask("params", peer="", has=known["digest"])
    assert fresh["values"]["gain"] == {"p": 2.5}
    assert await page.ask("params", peer="", has=fresh["digest"]) == {"digest": fresh["digest"]}
    assert "/gain/p" in (await page.ask("param_names"))["names"]


async def test_a_service_is_described_and_called(page: Page, talker: Node) -> None:
    await talker.advertise_service("/light", "std_srvs/SetBool", lambda r: {"success": r.data, "message": "as asked"})
    about = await page.answered("describe", service="/light")  # the hub's graph has it soon
    assert (about["type"], about["request"]) == ("std_srvs/SetBool", {"data": False})
    assert "bool success" in about["text"]
    answer = await page.ask("call", service="/light", request={"data": True})
    assert answer["response"] == {"success": True, "message": "as asked"}
    assert "data" in await page.ask("call", service="/light", request={"datum": True})
    assert "no service" in await page.ask("call", service="/none", request={})


async def test_a_smart_resource_shows_with_its_alarms_and_leaves_with_its_node(page: Page, core: RosCore) -> None:
    arm = Resource("arm", role="acting", description="picks things up")
    async with node(core, "/rmpa/lab/arm") as proxy:
        await text_topic(proxy, "/odd/descriptor", "{")
        await text_topic(proxy, "/other/descriptor", "[" * 10_000)
        await text_topic(proxy, "/arm/descriptor", described_by(arm, "/rmpa/lab/arm"))
        await text_topic(proxy, "/arm/state", "active")
        await text_topic(proxy, "/arm/decision", json.dumps({"profile": "fine", "scores": []}))
        # For how long the resource says, whenever the server started.
        began = time.time() - 3600
        await status_topic(proxy, "/arm/quality", DiagnosticLevel.WARN, "adapting: rate 9 Hz", level_for="3600.0 s")
        await page.sees(lambda: page.state.get("alarms", {}).get("lab:/arm"))
        assert set(page.state["resources"]) == {"lab:/arm"}
        seen, alarm = page.state["resources"]["lab:/arm"], page.state["alarms"]["lab:/arm"]
        assert (seen["module"], seen["level"], seen["description"]) == ("lab", "WARN", "picks things up")
        assert (alarm["text"], abs(alarm["at"] - began) < 60) == ("adapting: rate 9 Hz", True)
        await page.sees(lambda: page.state["resources"]["lab:/arm"].get("state") == "active")
        await page.send("look", at=[["resource", "lab:/arm"]])
        decision = {"profile": "fine", "scores": []}
        await page.sees(lambda: page.state["detail"].get("resource:lab:/arm", {}).get("decision") == decision)
    await page.sees(lambda: not page.state["resources"])


async def test_a_setting_is_checked_and_the_page_is_told_what_the_resource_made_of_it(
    page: Page, talker: Node
) -> None:
    motor = Resource("motor", role="acting")
    motor.parameter("speed", 1.0, low=0.0, high=1.0)
    sent: list[Any] = []

    async def take(request: Any) -> dict[str, object]:
        [pair] = request.config.doubles
        sent.append(pair.value)
        return {"config": {"doubles": [{"name": pair.name, "value": min(1.0, pair.value)}]}}

    await text_topic(talker, "/motor/descriptor", described_by(motor, "/motor"))
    await talker.advertise_service("/motor/set_parameters", "dynamic_reconfigure/Reconfigure", take)
    await page.sees(lambda: page.state.get("resources", {}).get("/motor"))
    for value, told in ((0.5, "speed is 0.5"), (5, "speed is 1.0: 5 is beyond its bounds")):
        assert (await page.ask("configure", resource="/motor", name="speed", value=value))["text"] == told
    for wrong in (None, "0,4", True):
        refused = await page.ask("configure", resource="/motor", name="speed", value=wrong)
        assert "no value of the type double" in refused
    assert sent == [0.5, 5.0]


async def test_nothing_is_asked_of_the_agent_without_pages(core: RosCore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "STATE_PERIOD", 0.1)
    agent = Agent(core.uri)
    watch = AgentWatch(agent.read)
    async with running_server(core, watch=watch) as server:
        async with server.client(SUBPROTOCOL, path="/monitor") as client:
            page = Page(client.socket, agent)
            await page.sees(lambda: page.state.get("modules"))
        await until(lambda: not server.sockets.connections)
        await asyncio.sleep(2 * limits.STATE_PERIOD)  # what was under way
        reads = watch.reads
        await asyncio.sleep(4 * limits.STATE_PERIOD)
        assert watch.reads == reads
    await watch.close()


async def test_other_clients_are_sent_to_their_paths(core: RosCore) -> None:
    watch = AgentWatch(Agent(core.uri).read)
    async with running_server(core, watch=watch) as server:
        for protocols in ((), ("foxglove.sdk.v1",)):
            with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
                async with server.client(*protocols, path="/monitor"):
                    pass
            assert refused.value.status == 400
    await watch.close()

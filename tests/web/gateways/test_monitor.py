"""The monitor's pages at the whole server: what the hub, the agent and a robot see of a page, and a page of them."""

from __future__ import annotations

import asyncio
import dataclasses
import json
import struct
import time
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import aiohttp
import msgspec
import pytest

from rmpa.core.errors import UnreachableError
from rmpa.resource.descriptor import describe
from rmpa.resource.resource import Resource
from rmpa.ros.types.definitions import ARRAY_TYPE, DiagnosticLevel, DiagnosticStatus, frame_array
from rmpa.ros.types.installed import ServiceType
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.tcpros import LENGTH
from rmpa.web import limits
from rmpa.web.hub.node_link import FULL, READ_ONLY
from rmpa.web.monitor.messages import SUBPROTOCOL
from rmpa.web.server.agent_watch import AgentWatch
from tests.ros.node.peers import DEADLINE, until
from tests.web.gateways.server import running_server
from tests.web.hub.client import node
from tests.web.monitor.patches import apply
from tests.web.snapshots import FULL as SNAPSHOT

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from rmpa.observe.snapshot import Snapshot
    from rmpa.ros.core.embedded import RosCore
    from rmpa.ros.node.node import Node
    from rmpa.web.hub.node_link import Rights

TEXT = MessageType("std_msgs/String")
TWIST = MessageType("geometry_msgs/Twist")
LOG = MessageType("rosgraph_msgs/Log")
DRIVER = dataclasses.replace(FULL, drive=True)


class Agent:
    """An agent that answers with one snapshot, or does not answer."""

    def __init__(self, core_uri: str) -> None:
        agent = msgspec.structs.replace(SNAPSHOT.agent, core_uri=core_uri)
        self.snapshot = msgspec.structs.replace(SNAPSHOT, agent=agent)
        self.answers = True

    def read(self) -> Snapshot:
        if not self.answers:
            raise UnreachableError("agent", "its socket", "start one with `rmpa up`")
        return self.snapshot


class Page:
    """What the pages' script does: it keeps the state, and acknowledges each patch."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.socket = socket
        self.state: Any = {}
        self.messages: list[dict[str, Any]] = []
        self.pictures: list[bytes] = []
        self.commands = 0

    async def send(self, op: str, **values: Any) -> None:
        await self.socket.send_str(json.dumps({"op": op, **values}))

    async def drive(self, linear: float, angular: float = 0.0) -> None:
        """A command of the joystick, made now: both ends have one clock here."""
        self.commands += 1
        made = {"hold": 1, "n": self.commands, "at": asyncio.get_running_loop().time()}
        await self.send("drive", topic="/cmd_vel", linear=linear, angular=angular, **made)

    async def read(self) -> None:
        message = await self.socket.receive()
        if message.type is aiohttp.WSMsgType.BINARY:
            self.pictures.append(message.data)
            return
        assert message.type is aiohttp.WSMsgType.TEXT, message
        values = json.loads(message.data)
        if values["op"] == "state":
            self.state = values["state"]
        elif values["op"] == "patch":
            self.state = apply(self.state, values["patch"])
        else:
            self.messages.append(values)
            return
        await self.send("ack", n=values["n"])

    async def sees(self, condition: Any) -> None:
        """Read until the condition holds."""
        async with asyncio.timeout(DEADLINE):
            while not condition():
                await self.read()

    async def next(self, op: str, **wanted: Any) -> dict[str, Any]:
        """The first message of this op with these members; it is taken out."""

        def found() -> list[dict[str, Any]]:
            return [each for each in self.messages if each["op"] == op and wanted.items() <= each.items()]

        await self.sees(found)
        first = found()[0]
        self.messages.remove(first)
        return first

    async def ask(self, number: int, what: str, **args: Any) -> dict[str, Any]:
        await self.send("ask", id=number, what=what, args=args, at=asyncio.get_running_loop().time())
        await self.sees(lambda: any(each.get("id") == number for each in self.messages))
        [answer] = [each for each in self.messages if each.get("id") == number]
        self.messages.remove(answer)
        return answer


@asynccontextmanager
async def page_of(core: RosCore, rights: Rights = FULL) -> AsyncIterator[tuple[Page, Agent]]:
    agent = Agent(core.uri)
    watch = AgentWatch(agent.read)
    try:
        async with (
            running_server(core, rights, watch=watch) as server,
            server.client(SUBPROTOCOL, path="/monitor") as client,
        ):
            yield Page(client.socket), agent
    finally:
        await watch.close()


async def text_topic(talker: Node, name: str, text: str) -> Any:
    publisher = await talker.advertise(name, TEXT, latch=True)
    publisher.publish_raw(TEXT.serialize(TEXT.make({"data": text})))
    return publisher


async def status_topic(talker: Node, name: str, level: DiagnosticLevel, message: str, **values: str) -> Any:
    publisher = await talker.advertise(name, MessageType(ARRAY_TYPE), latch=True)
    status = DiagnosticStatus(level, "arm", message, "arm", {"rate": "9 Hz", **values})
    publisher.publish_raw(frame_array(1, time.time_ns(), [status.serialize()])[LENGTH.size :])
    return publisher


async def test_a_page_is_greeted_and_gets_the_state_then_its_changes(core: RosCore) -> None:
    async with page_of(core, READ_ONLY) as (page, agent):
        hello = await page.next("hello")
        assert (hello["agent"], hello["may"]) == (SNAPSHOT.agent.name, [])
        await page.sees(lambda: page.state.get("modules"))
        [peer, *_] = SNAPSHOT.peers
        assert peer.name in page.state["modules"]
        agent.snapshot = msgspec.structs.replace(agent.snapshot, peers=())
        await page.sees(lambda: page.state["modules"][peer.name]["state"] == "away")


async def test_a_page_is_told_when_the_agent_is_silent_and_when_it_is_back(core: RosCore) -> None:
    async with page_of(core) as (page, agent):
        await page.sees(lambda: page.state.get("reach", {}).get("ok"))
        agent.answers = False
        await page.sees(lambda: not page.state["reach"]["ok"])
        assert "rmpa up" in page.state["reach"]["remedy"]
        assert page.state["modules"]
        agent.answers = True
        await page.sees(lambda: page.state["reach"]["ok"])


async def test_the_details_of_what_a_page_looks_at(core: RosCore) -> None:
    async with page_of(core) as (page, _):
        topic = SNAPSHOT.topics[0].name
        await page.send("look", at=[["topic", topic]])
        await page.sees(lambda: f"topic:{topic}" in page.state.get("detail", {}))
        assert page.state["detail"][f"topic:{topic}"]["name"] == topic


async def test_live_values_and_plots_of_a_topic(core: RosCore) -> None:
    async with page_of(core) as (page, _), node(core, "talker") as talker:
        publisher = await talker.advertise("/speed", TWIST, latch=True)
        publisher.publish_raw(struct.pack("<6d", 0.5, 0, 0, 0, 0, 1))
        await page.send("watch", id=1, topic="/speed", how="value")
        value = await page.next("value", id=1)
        assert value["type"] == "geometry_msgs/Twist"
        assert value["value"]["linear"]["x"] == 0.5
        await page.send("watch", id=2, topic="/speed", how="plot", fields=["linear.x", "angular.z"])
        points = await page.next("points", id=2)
        assert [column[-1] for column in points["columns"][1:]] == [0.5, 1.0]
        await page.send("watch", id=3, topic="/speed", how="image")
        assert "not an image" in (await page.next("failed", id=3))["error"]


async def test_parameters_are_read_and_set(core: RosCore) -> None:
    async with page_of(core) as (page, _):
        assert (await page.ask(1, "set_param", peer="", name="/speed", value=0.4))["value"]["values"]["speed"] == 0.4
        assert core.call("getParam", "/test", "/speed").value == 0.4
        assert "speed" not in (await page.ask(2, "delete_param", peer="", name="/speed"))["value"]["values"]
        assert "cannot be null" in (await page.ask(3, "set_param", peer="", name="/speed", value=None))["error"]
        assert "no agent" in (await page.ask(4, "params", peer="arm"))["error"]


async def test_a_parameter_that_another_node_sets_is_told(core: RosCore) -> None:
    async with page_of(core) as (page, agent):
        await page.sees(lambda: "parameters" in page.state)
        known = (await page.ask(1, "params", peer=""))["value"]
        before = page.state["parameters"]
        core.call("setParam", "/other", "/gain/p", 2.5)
        # The agent's snapshot stays the same one: what is counted is of the core.
        agent.snapshot = msgspec.structs.replace(agent.snapshot, taken=agent.snapshot.taken + 1)
        await page.sees(lambda: page.state["parameters"] != before)
        fresh = (await page.ask(2, "params", peer="", has=known["digest"]))["value"]
        assert fresh["values"]["gain"] == {"p": 2.5}
        same = (await page.ask(3, "params", peer="", has=fresh["digest"]))["value"]
        assert same == {"digest": fresh["digest"]}
        assert "/gain/p" in (await page.ask(4, "param_names"))["value"]["names"]


async def test_a_service_is_described_and_called(core: RosCore) -> None:
    kind = ServiceType("std_srvs/SetBool")

    def serve(request: Any) -> Any:
        return kind.response.make({"success": request.data, "message": "as asked"})

    async with page_of(core) as (page, _), node(core, "server") as server:
        await server.advertise_service("/light", kind, serve)
        about = await described(page, "/light")
        assert about["type"] == "std_srvs/SetBool"
        assert about["request"] == {"data": False}
        assert "bool success" in about["text"]
        answer = await page.ask(90, "call", service="/light", request={"data": True})
        assert answer["value"]["response"] == {"success": True, "message": "as asked"}
        assert "data" in (await page.ask(91, "call", service="/light", request={"datum": True}))["error"]
        assert "no service" in (await page.ask(92, "call", service="/none", request={}))["error"]


async def described(page: Page, service: str) -> Any:
    """The description of a service, once the hub's graph has it."""
    for number in range(10, 80):
        answer = await page.ask(number, "describe", service=service)
        if answer["op"] == "answer":
            return answer["value"]
        await asyncio.sleep(0.05)
    raise AssertionError(f"{service} was not described")


async def test_a_page_that_may_only_look_changes_nothing(core: RosCore) -> None:
    async with page_of(core, READ_ONLY) as (page, _):
        for number, what in enumerate(
            ("params", "param_names", "set_param", "delete_param", "call", "profile", "context"), 1
        ):
            answer = await page.ask(number, what, name="/speed", value=1, service="/light", resource="/arm")
            assert "may" in answer["error"]
        await page.drive(1)
        assert "may not drive" in (await page.next("failed", id=0))["error"]
        assert not core.publishers("/cmd_vel")


async def test_the_joystick_drives_and_a_lost_page_stops_the_robot(core: RosCore) -> None:
    got: list[tuple[float, ...]] = []
    async with page_of(core, DRIVER) as (page, _), node(core, "base") as base:
        await base.subscribe("/cmd_vel", TWIST, lambda message: got.append(struct.unpack("<6d", message.raw)))
        async with asyncio.timeout(DEADLINE):
            while not any(speed[0] == 0.5 * limits.DRIVE_SPEED for speed in got):
                await page.drive(0.5, -1)
                await asyncio.sleep(0.05)
        assert got[-1][5] == -limits.DRIVE_TURN
        assert page.socket._response.connection is not None
        transport = page.socket._response.connection.transport
        assert transport is not None
        transport.abort()
        await until(lambda: got[-1] == (0.0,) * 6)


async def test_the_log_is_kept_for_pages_that_open_it(core: RosCore) -> None:
    async with page_of(core) as (page, _), node(core, "lonely") as lonely:
        publisher = await lonely.advertise("/rosout", LOG, latch=True)
        await until(lambda: publisher.subscribers)
        line = {"level": 8, "name": "/lonely", "msg": "<b>the motor is hot</b>"}
        publisher.publish_raw(LOG.serialize(LOG.make(line)))
        await page.send("log", on=True)
        lines = (await page.next("log"))["lines"]
        found = [each for each in lines if each["node"] == "/lonely"]
        assert [(each["level"], each["text"]) for each in found] == [("ERROR", "<b>the motor is hot</b>")]


async def test_a_smart_resource_shows_with_its_alarms_and_leaves_with_its_node(core: RosCore) -> None:
    arm = Resource("arm", role="acting", description="picks things up")
    descriptor = msgspec.json.encode(describe(arm, "/rmpa/lab/arm")).decode()
    async with page_of(core) as (page, _):
        async with node(core, "/rmpa/lab/arm") as proxy:
            await text_topic(proxy, "/arm/descriptor", descriptor)
            await text_topic(proxy, "/arm/state", "active")
            await text_topic(proxy, "/arm/decision", json.dumps({"profile": "fine", "scores": []}))
            await status_topic(proxy, "/arm/quality", DiagnosticLevel.WARN, "adapting: rate 9 Hz")
            await page.sees(lambda: page.state.get("alarms", {}).get("lab:/arm"))
            seen = page.state["resources"]["lab:/arm"]
            assert (seen["module"], seen["level"], seen["description"]) == ("lab", "WARN", "picks things up")
            assert page.state["alarms"]["lab:/arm"]["text"] == "adapting: rate 9 Hz"
            await page.sees(lambda: page.state["resources"]["lab:/arm"].get("state") == "active")
            await page.send("look", at=[["resource", "lab:/arm"]])
            await page.sees(
                lambda: page.state["detail"].get("resource:lab:/arm", {}).get("decision", {}).get("profile") == "fine"
            )
        await page.sees(lambda: not page.state["resources"])


async def test_an_alarm_stands_for_as_long_as_its_resource_says_whenever_the_server_started(core: RosCore) -> None:
    descriptor = msgspec.json.encode(describe(Resource("arm", role="acting"), "/arm")).decode()
    async with page_of(core) as (page, _), node(core, "arm") as arm:
        await text_topic(arm, "/arm/descriptor", descriptor)
        await status_topic(arm, "/arm/quality", DiagnosticLevel.WARN, "adapting", level_for="3600.0 s")
        began = time.time() - 3600
        await page.sees(lambda: page.state.get("alarms", {}).get("/arm"))
        assert abs(page.state["alarms"]["/arm"]["at"] - began) < 60


async def test_a_setting_is_checked_and_the_page_is_told_what_the_resource_made_of_it(core: RosCore) -> None:
    motor = Resource("motor", role="acting")
    motor.parameter("speed", 1.0, low=0.0, high=1.0)
    descriptor = msgspec.json.encode(describe(motor, "/motor")).decode()
    sent: list[Any] = []

    async def take(request: Any) -> dict[str, object]:
        [pair] = request.config.doubles
        sent.append(pair.value)
        return {"config": {"doubles": [{"name": pair.name, "value": min(1.0, pair.value)}]}}

    async with page_of(core) as (page, _), node(core, "motor") as server:
        await text_topic(server, "/motor/descriptor", descriptor)
        await server.advertise_service("/motor/set_parameters", "dynamic_reconfigure/Reconfigure", take)
        await page.sees(lambda: page.state.get("resources", {}).get("/motor"))
        setting = {"resource": "/motor", "name": "speed"}
        for number, (value, told) in enumerate(
            [(0.5, "speed is 0.5"), (5, "speed is 1.0: 5 is beyond its bounds")], start=1
        ):
            assert (await page.ask(number, "configure", value=value, **setting))["value"]["text"] == told
        for number, wrong in enumerate((None, "0,4", True), start=9):
            refused = await page.ask(number, "configure", value=wrong, **setting)
            assert (refused["op"], "no value of the type double" in refused["error"]) == ("failed", True)
        assert sent == [0.5, 5.0]


async def test_a_broken_descriptor_is_no_resource(core: RosCore) -> None:
    async with page_of(core) as (page, _), node(core, "odd") as odd:
        await text_topic(odd, "/odd/descriptor", "{")
        await text_topic(odd, "/other/descriptor", "[" * 10_000)
        arm = msgspec.json.encode(describe(Resource("arm", role="acting"), "/arm")).decode()
        await text_topic(odd, "/arm/descriptor", arm)
        await page.sees(lambda: "/arm" in page.state.get("resources", {}))
        assert set(page.state["resources"]) == {"/arm"}


async def test_pages_share_what_is_asked_of_the_agent_and_nothing_is_asked_without_pages(core: RosCore) -> None:
    agent = Agent(core.uri)
    watch = AgentWatch(agent.read)
    async with running_server(core, watch=watch) as server:
        async with (
            server.client(SUBPROTOCOL, path="/monitor") as one,
            server.client(SUBPROTOCOL, path="/monitor") as other,
        ):
            for page in (Page(one.socket), Page(other.socket)):
                await page.sees(lambda page=page: page.state.get("modules"))
        await until(lambda: not server.gateways.connections)
        await asyncio.sleep(2 * limits.STATE_PERIOD)  # what was under way
        reads = watch.reads
        await asyncio.sleep(4 * limits.STATE_PERIOD)
        assert watch.reads == reads
    await watch.close()


@pytest.mark.parametrize("protocols", [(), ("foxglove.sdk.v1",)])
async def test_other_clients_are_sent_to_their_paths(core: RosCore, protocols: tuple[str, ...]) -> None:
    watch = AgentWatch(Agent(core.uri).read)
    async with running_server(core, watch=watch) as server:
        with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
            async with server.client(*protocols, path="/monitor"):
                pass
        assert refused.value.status == 400
    await watch.close()

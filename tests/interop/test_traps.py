"""Traps of ROS 1 (docs/design/ros-traps.md) that only real nodes spring; those of a bridge through two agents."""

from __future__ import annotations

import asyncio
import itertools
import logging
import signal
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from dataclasses import dataclass

import pytest

from lab.bed.agents import Agent
from lab.bed.processes import Process, eventually
from rmpa.bridge.messages import Description as About
from rmpa.bridge.messages import RouteOpened, Source
from rmpa.core.outbox import ABORT, FIRST, LAST
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.environment import RosEnvironment
from rmpa.ros.http.rpc import call_api
from rmpa.ros.node.node import Node
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.tcpros import encode_header, frame_message, subscriber_header
from tests.bridge.io.proxied import Proxied
from tests.interop.conftest import AgentFactory, ShellFactory, framed
from tests.interop.modules import flows, whole
from tests.interop.nodes.payload import Pattern
from tests.interop.ros import PYTHON, Ros
from tests.ros.node.peers import RawSubscriber
from tests.waiting import until

pytestmark = [pytest.mark.ros, pytest.mark.timeout(120)]
libraries = pytest.mark.parametrize("library", ["rospy", "roscpp"])
BYTES = "std_msgs/UInt8MultiArray"
DEADLINE = 40.0


@pytest.fixture
async def closing(core: RosCore) -> AsyncIterator[AsyncExitStack]:
    async with AsyncExitStack() as stack:
        yield stack


def node(name: str, core: RosCore | Agent) -> Node:
    uri = core.uri if isinstance(core, RosCore) else f"http://127.0.0.1:{core.core_port}/"
    return Node(name, master_uri=uri, environment=RosEnvironment())


# --- at one core ----------------------------------------------------------------------------------------------


@pytest.mark.trap(3)
@libraries
async def test_only_rospy_subscribers_send_a_definition(core: RosCore, ros: Ros, library: str) -> None:
    async with node("ours", core) as ours:
        publisher = await ours.advertise("/chatter", BYTES, latch=True)
        publisher.publish_raw(framed(Pattern(64).payload(1, 1)))
        listener = ros.node(library, "listener", count=1)
        await until(lambda: publisher.publication._connections)
        fields = publisher.publication._connections[0].request
        assert {"callerid", "md5sum", "tcp_nodelay", "topic", "type"} <= fields.keys()
        assert ("message_definition" in fields) is (library == "rospy")
        await listener.expect_event("done", DEADLINE)


@pytest.mark.trap(12)
@libraries
async def test_rospy_closes_the_first_of_two_connections_of_one_caller_id(
    core: RosCore, ros: Ros, library: str
) -> None:
    ros.node(library, "talker", name="talker", rate=50)
    await until(lambda: "/talker" in core.state().publishers.get("/chatter", {}))
    api = core.state().publishers["/chatter"]["/talker"]

    async def connect() -> RawSubscriber:
        reply = await call_api(api, "requestTopic", "/twin", "/chatter", [["TCPROS"]])
        assert isinstance(reply.value, list)
        link = await RawSubscriber.dial((str(reply.value[1]), int(str(reply.value[2]))))
        await link.send(encode_header(subscriber_header("/chatter", "/twin")))
        assert (await link.header())["callerid"] == "/talker"
        await link.message()
        return link

    first = await connect()
    second = await connect()
    if library == "rospy":
        while not await first.ended():
            first.data = b""
    else:
        await first.message()
    await second.message()
    first.close()
    second.close()


@pytest.mark.trap("16a")
async def test_publishers_that_start_at_once_are_all_heard(
    core: RosCore, ros: Ros, caplog: pytest.LogCaptureFixture
) -> None:
    """rospy answers the two lists by connecting twice to one publisher, and hangs one up, perhaps headerless."""
    caplog.set_level(logging.WARNING, "rmpa")
    listener = ros.rospy("listener", each=True)
    await until(lambda: core.state().subscribers.get("/chatter"))
    pattern = Pattern(64)
    for turn in range(4):
        async with node("one", core) as one, node("two", core) as two:
            both = await asyncio.gather(one.advertise("/chatter", BYTES), two.advertise("/chatter", BYTES))
            for source, publisher in enumerate(both, start=10 * turn + 1):
                await asyncio.wait_for(publisher.wait_for_subscriber(), DEADLINE)
                key = str(source)
                sequence = 0
                # What is sent while rospy hangs one of its two connections up may get lost: send until it is heard.
                while not any(f"'{key}'" in str(report["sources"]) for report in listener.events("report")):
                    sequence += 1
                    publisher.publish_raw(framed(pattern.payload(source, sequence)))
                    await asyncio.sleep(0.02)
            refused = {**one.slave.counters.as_dict(), **two.slave.counters.as_dict()}
            assert not [name for name in refused if "refused" in name], refused
    assert all(report["bad"] == 0 for report in listener.events("report"))
    assert [record.getMessage() for record in caplog.records] == []


@pytest.mark.trap(17)
async def test_messages_of_no_bytes_go_both_ways(core: RosCore, ros: Ros) -> None:
    async with node("ours", core) as ours:
        got: list[bytes] = []
        await ours.subscribe("/theirs", "std_msgs/Empty", lambda r: got.append(r.raw))
        ros.start("rostopic", "pub", "-r", "20", "/theirs", "std_msgs/Empty", name="pub")
        await until(lambda: len(got) >= 3)
        assert set(got) == {b""}
        publisher = await ours.advertise("/ours", "std_msgs/Empty")
        echo = ros.start("rostopic", "echo", "-n", "3", "/ours", name="echo")
        await asyncio.wait_for(publisher.wait_for_subscriber(), DEADLINE)
        while echo.returncode is None:
            publisher.publish_raw(b"")
            await asyncio.sleep(0.02)
        assert echo.output.count("---") == 3, echo.output


@pytest.mark.trap(14)
@libraries
async def test_listeners_follow_a_remote_publisher_with_a_new_header(
    core: RosCore, ros: Ros, library: str, closing: AsyncExitStack
) -> None:
    """They are promised another definition by hanging up; rospy comes again only if the master names the proxy."""
    inbound, listener = await proxied(core, ros.node(library, "listener", each=True), closing)
    for route, latching in ((1, False), (2, True)):
        describe(inbound, route, latching=latching)
        await heard(inbound, listener, str(route))


@pytest.mark.trap(14)
@libraries
async def test_listeners_cut_off_within_a_message_come_back(
    core: RosCore, ros: Ros, library: str, closing: AsyncExitStack
) -> None:
    """A remote publisher was killed in the middle of an image: TCPROS cannot take half of it back."""
    inbound, listener = await proxied(core, ros.node(library, "listener", each=True), closing)
    describe(inbound, 1)
    sequence = await heard(inbound, listener, "1")
    publication = inbound.route.publication
    assert publication is not None
    flow, wire = inbound.flow, frame_message(framed(Pattern(1_000_000).payload(2, 1)))
    for end in (LAST | ABORT, 0):
        flow.part(sequence + 1, 0, FIRST, memoryview(wire)[:500_000])
        if end:
            flow.part(sequence + 1, 0, end, memoryview(b""))
        else:
            flow.torn()
        assert publication.subscribers == 0
        await until(lambda: publication.subscribers)
        before = len(listener.events("report"))
        sequence = await heard(inbound, listener, "1", first=sequence + 2, after=before)
    report = listener.events("report")[-1]
    assert (report["bad"], list(report["sources"])) == (0, ["1"])  # type: ignore[call-overload]


SOURCE = Source("/chatter", "/speaker")


async def proxied(core: RosCore, listener: Process, closing: AsyncExitStack) -> tuple[Proxied, Process]:
    """A peer's source, and a listener of it that is connected to its proxy."""
    inbound = Proxied(core, SOURCE, BYTES)
    closing.push_async_callback(inbound.close)
    publication = await inbound.publish()
    await until(lambda: publication.subscribers)
    return inbound, listener


def describe(inbound: Proxied, route: int, *, latching: bool = False) -> None:
    """A route of the source is open."""
    kind = MessageType(BYTES)
    inbound.opened(RouteOpened(route, About(BYTES, kind.md5sum, kind.definition, latching)))


async def heard(inbound: Proxied, listener: Process, source: str, *, first: int = 1, after: int = 0) -> int:
    """Send messages on a route until the listener has heard one; return the last one's number."""
    sequence = first - 1
    while not any(source in str(report["sources"]) for report in listener.events("report")[after:]):
        sequence += 1
        message = frame_message(framed(Pattern(64).payload(int(source), sequence)))
        inbound.flow.message(sequence, 0, memoryview(message))
        await asyncio.sleep(0.02)
    return sequence


# --- through two agents -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Two:
    """Two linked agents on this machine, and a shell at each core."""

    a: Agent
    b: Agent
    at_a: Ros
    at_b: Ros


@pytest.fixture
def two(agent: AgentFactory, shell: ShellFactory) -> Two:
    a, b = agent(name="a"), agent(name="b")
    a.wait_peer("b")
    b.wait_peer("a")
    return Two(a, b, shell(port=a.core_port), shell(port=b.core_port))


def topics(ros: Ros) -> set[str]:
    return set(ros.tool("rostopic", "list").split())


@pytest.mark.trap(12)
def test_many_remote_listeners_are_one_connection_to_a_rospy_talker(
    two: Two, agent: AgentFactory, shell: ShellFactory
) -> None:
    c = agent(name="c")
    c.wait_peer("a")
    hears = [
        ros.node(kind, "listener") for ros in (two.at_b, shell(port=c.core_port)) for kind in ("rospy", "roscpp")
    ]
    two.at_a.rospy("talker", "__name:=speaker", rate=100)
    for heard in hears:
        flows(heard)

    def listeners() -> list[str]:
        info = two.at_a.tool("rosnode", "info", "/speaker").splitlines()
        return [line.strip() for topic, line in itertools.pairwise(info) if topic.strip() == "* topic: /chatter"]

    # A joining subscriber has a connection of its own for a short time.
    eventually(lambda: listeners() == ["* to: /rmpa"], what="one connection")
    for heard in hears:
        report = flows(heard, 50)
        assert (report["bad"], report["gaps"], report["doubled"]) == (0, 0, 0)


@pytest.mark.trap(14)
@libraries
def test_a_listener_stays_when_another_node_takes_the_talkers_name(two: Two, library: str) -> None:
    """Its header differs (it latches), so subscribers must be disconnected; rospy reconnects only when notified."""
    heard = two.at_b.node(library, "listener")
    older = two.at_a.roscpp("talker", "__name:=speaker", rate=100)
    flows(heard)
    two.at_a.rospy("talker", "__name:=speaker", rate=100, latch=True, source=2)
    assert older.wait(DEADLINE) == 0
    heard.wait_event("report", where=lambda event: "2" in event["sources"])  # type: ignore[operator]
    assert flows(heard)["bad"] == 0


@pytest.mark.trap(36)
def test_logs_time_and_logger_services_stay_home(two: Two) -> None:
    speak = (
        "import sys, rospy\nrospy.init_node(sys.argv[1])\nr = rospy.timer.Rate(20)\n"
        "while not rospy.is_shutdown():\n    rospy.logwarn('said by ' + sys.argv[1])\n    r.sleep()\n"
    )
    echoes = {ros: ros.start("rostopic", "echo", "/rosout_agg/msg", name="echo") for ros in (two.at_a, two.at_b)}
    for name, ros in (("node_a", two.at_a), ("node_b", two.at_b)):
        ros.start(PYTHON, "-c", speak, name, name=name)
    echoes[two.at_a].wait_for("said by node_a")
    echoes[two.at_b].wait_for("said by node_b")
    two.at_a.rospy("talker", "__name:=clock", topic="/clock", type="String", rate=50)
    two.at_a.rospy("talker", "__name:=crosses", topic="/crosses", rate=50)
    eventually(lambda: "/crosses" in topics(two.at_b), what="a topic that crosses")
    eventually(lambda: "/clock" in topics(two.at_a), what="/clock at home")
    assert "/clock" not in topics(two.at_b)
    for ros, other in ((two.at_a, "node_b"), (two.at_b, "node_a")):
        for topic in ("/rosout", "/rosout_agg"):
            assert other not in ros.tool("rostopic", "info", topic)
            assert "/rmpa" not in ros.tool("rostopic", "info", topic)
        # Its proxy stands in the graph by a service of its own, which is no logger's.
        services = ros.tool("rosservice", "list").split()
        assert not [name for name in services if other in name and not name.startswith("/rmpa/")]
        assert f"said by {other}" not in echoes[ros].output
    two.at_a.tool("rosparam", "set", "/use_sim_time", "true")
    assert "/use_sim_time" not in two.at_b.tool("rosparam", "list").split()


@pytest.mark.trap(37)
@libraries
def test_a_topic_of_both_sides_is_heard_once_each(two: Two, library: str) -> None:
    hears = [ros.node(library, "listener", topic="/shared") for ros in (two.at_a, two.at_b)]
    for heard in hears:
        heard.wait_event("up")
    for source, ros in enumerate((two.at_a, two.at_b), start=1):
        # Each waits for both listeners: its own, and by the agent's subscription the other one.
        ros.node(library, "talker", topic="/shared", rate=100, count=50, source=source, wait=2)
    for heard in hears:
        whole(heard.wait_event("report", where=lambda event: int(str(event["count"])) >= 100), 100)
    # A loop would go on by itself: another topic's messages come and go meanwhile, and nothing was added.
    after = two.at_b.node(library, "listener", topic="/after", count=50)
    two.at_a.node(library, "talker", topic="/after", rate=100, count=50, wait=1)
    after.wait_event("done")
    for heard in hears:
        whole(heard.events("report")[-1], 100)
    nodes = two.at_b.tool("rosnode", "list").split()
    assert not [name for name in nodes if name.count("/rmpa") > 1], nodes


@pytest.mark.trap(38)
@pytest.mark.parametrize("library", ["rospy", pytest.param("roscpp", marks=pytest.mark.long)])
def test_an_early_subscriber_loses_nothing(two: Two, library: str) -> None:
    first = two.at_b.node(library, "listener", "__name:=first", count=100)
    anything = two.at_b.start("rostopic", "echo", "-n", "1", "/other", name="echo")
    first.wait_event("up")
    anything.wait_for("does not appear to be published yet")
    assert two.at_b.start("rostopic", "type", "/other", name="type").wait() == 1
    two.at_a.node(library, "talker", "__name:=speaker", rate=100, count=100, wait=1)
    whole(first.wait_event("done"), 100)
    assert two.at_b.tool("rostopic", "type", "/chatter").strip() == BYTES
    two.at_a.node(library, "talker", "__name:=other", topic="/other", rate=20)
    assert anything.wait() == 0
    assert "layout:" in anything.output


@pytest.mark.trap(17, 39)
async def test_every_byte_of_a_message_arrives_unchanged(two: Two) -> None:
    kind = MessageType("sensor_msgs/Joy")
    sequences = (4711, 3, 4294967295)
    values = [{"header": {"seq": seq, "frame_id": "pad"}, "axes": [0.5]} for seq in sequences]
    messages = [kind.serialize(kind.make(value)) for value in values]
    messages.append(messages[0] + b"trailing bytes")  # rospy and roscpp take such a message without a word
    got: list[bytes] = []
    async with node("ours", two.a) as ours, node("hears", two.b) as hears:
        await hears.subscribe("/joy", None, lambda received: got.append(received.raw))
        publisher = await ours.advertise("/joy", "sensor_msgs/Joy")
        await asyncio.wait_for(publisher.wait_for_subscriber(), DEADLINE)
        for message in messages:
            publisher.publish_raw(message)
        await until(lambda: len(got) == len(messages))
        assert got == messages
        echo = await asyncio.to_thread(two.at_b.start, "rostopic", "echo", "-n", "1", "/joy/header/seq", name="echo")
        while echo.returncode is None:
            publisher.publish_raw(messages[0])
            await asyncio.sleep(0.05)
        assert "4711" in echo.output


@pytest.mark.trap(40)
@pytest.mark.parametrize(
    ("library", "number"), [("rospy", signal.SIGKILL), pytest.param("roscpp", signal.SIGTERM, marks=pytest.mark.long)]
)
def test_a_node_that_was_killed_leaves_both_graphs(two: Two, library: str, number: signal.Signals) -> None:
    """roscpp unregisters at no signal but SIGINT; the agent learns it from the connection that breaks."""
    talker = two.at_a.node(library, "talker", "__name:=speaker", rate=100)
    flows(two.at_b.roscpp("listener"))
    talker.send(number)
    talker.wait()
    for ros, name in ((two.at_a, "/speaker"), (two.at_b, "/rmpa/a/speaker")):
        eventually(lambda ros=ros, name=name: name not in ros.tool("rosnode", "list").split(), what=f"{name} gone")  # type: ignore[misc]
    for ros in (two.at_a, two.at_b):  # the listener's subscription is in both
        assert "Publishers: None" in ros.tool("rostopic", "info", "/chatter")

"""Real rospy and roscpp nodes against our publications and subscriptions, at the embedded core."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
from typing import Any

import pytest

from lab.bed.processes import Process
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.http.rpc import call_api
from rmpa.ros.node.node import Node, Publisher, Received
from rmpa.ros.node.publication import AcceptedConnection, Publication, PublicationEvents
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.tcpros import frame_message
from tests.interop.conftest import framed
from tests.interop.nodes.payload import Pattern
from tests.interop.ros import PYTHON, Ros
from tests.waiting import until

pytestmark = pytest.mark.ros
libraries = pytest.mark.parametrize("library", ["rospy", "roscpp"])
BYTES = "std_msgs/UInt8MultiArray"
DEADLINE = 40.0


async def event(process: Process, name: str) -> dict[str, Any]:
    report: dict[str, Any] = await asyncio.to_thread(process.wait_event, name, timeout=DEADLINE)
    return report


async def tool(ros: Ros, *argv: str) -> str:
    return await asyncio.to_thread(ros.tool, *argv)


async def send(publisher: Publisher, count: int, size: int, rate: float) -> None:
    """Publish numbered payloads, as the talkers do."""
    pattern = Pattern(size)
    loop = asyncio.get_running_loop()
    due = loop.time()
    for sequence in range(1, count + 1):
        publisher.publish_raw(framed(pattern.payload(1, sequence)))
        due += 1 / rate
        await asyncio.sleep(max(0.0, due - loop.time()))


@pytest.mark.trap(2)
@libraries
async def test_the_real_talkers_own_definition_is_handed_on(node: Node, ros: Ros, library: str) -> None:
    got: list[Received] = []
    await node.subscribe("/chatter", None, got.append)
    ros.node(library, "talker", rate=50)
    await until(lambda: got)
    header = got[0].header
    kind = MessageType(BYTES)
    assert (header["type"], header["md5sum"]) == (BYTES, kind.md5sum)
    # genmsg for C++ ends the text with one more newline than genpy; the bytes of the publisher are what counts.
    assert header["message_definition"].rstrip("\n") == kind.definition.rstrip("\n")
    assert got[0].kind.md5sum == kind.md5sum


@pytest.mark.trap(9)
@libraries
@pytest.mark.parametrize("nodelay", [True, False])
async def test_trap_9_tcp_nodelay_is_what_the_listener_asks_for(
    node: Node, ros: Ros, library: str, nodelay: bool
) -> None:
    publisher = await node.advertise("/chatter", BYTES)
    ros.node(library, "listener", nodelay=nodelay)
    await asyncio.wait_for(publisher.wait_for_subscriber(), DEADLINE)
    (link,) = publisher.publication._connections
    assert isinstance(link, AcceptedConnection)
    assert link._socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) == nodelay


@pytest.mark.trap(1)
async def test_trap_1_rostopic_echo_takes_any_type_and_prints_ours(node: Node, ros: Ros) -> None:
    publisher = await node.advertise("/joy", "sensor_msgs/Joy", latch=True)
    publisher.publish(publisher.make({"header": {"frame_id": "pad"}, "axes": [0.5], "buttons": [1, 0]}))
    output = await tool(ros, "rostopic", "echo", "-n", "1", "/joy")
    assert 'frame_id: "pad"' in output
    assert "axes: [0.5]" in output


@pytest.mark.trap(2)
async def test_trap_2_rosbag_records_our_definition_byte_for_byte(node: Node, ros: Ros) -> None:
    publisher = await node.advertise("/joy", "sensor_msgs/Joy", latch=True)
    publisher.publish(publisher.make({"axes": [0.5]}))
    bag = ros.home / "joy.bag"
    await tool(ros, "rosbag", "record", "-q", "-O", str(bag), "-l", "1", "/joy")
    program = (
        "import json, sys, rosbag, sensor_msgs.msg as m\n"
        "bag = rosbag.Bag(sys.argv[1])\n"
        "(c,) = bag._get_connections()\n"
        "(message,) = [m for _, m, _ in bag.read_messages()]\n"
        "print(json.dumps([c.msg_def, m.Joy._full_text, c.md5sum, list(message.axes)]))\n"
    )
    recorded, real, md5, axes = json.loads(await tool(ros, PYTHON, "-c", program, str(bag)))
    assert recorded == real == MessageType("sensor_msgs/Joy").definition
    assert (md5, axes) == (MessageType("sensor_msgs/Joy").md5sum, [0.5])


@pytest.mark.trap(15, 38)
@libraries
async def test_a_real_listener_waits_while_the_type_is_not_known(core: RosCore, ros: Ros, library: str) -> None:
    proxy = SlaveNode("/proxy", "127.0.0.1", core.uri)
    await proxy.start()
    demand = asyncio.Event()

    class Events(PublicationEvents):
        def first_subscriber(self) -> None:
            demand.set()

    publication = Publication("/chatter", "/proxy", events=Events())
    proxy.add_publication(publication)
    core.call("registerPublisher", "/proxy", "/chatter", BYTES, proxy.uri)
    listener = ros.node(library, "listener", count=3)
    await asyncio.wait_for(demand.wait(), DEADLINE)
    await asyncio.sleep(1.0)  # as long as a route may take; nothing can be waited for
    assert publication.connections()[0].connected is False
    publication.describe(MessageType(BYTES).describe())
    pattern = Pattern(64)
    for sequence in range(1, 4):
        publication.publish_framed(frame_message(framed(pattern.payload(1, sequence))))
    report = await event(listener, "done")
    assert (report["bad"], report["gaps"], report["last"]) == (0, 0, 3)
    core.call("unregisterPublisher", "/proxy", "/chatter", proxy.uri)
    await proxy.close()


@pytest.mark.trap(16)
@libraries
async def test_trap_16_listeners_leave_a_withdrawn_topic_and_find_it_again(
    node: Node, ros: Ros, library: str
) -> None:
    publisher = await node.advertise("/chatter", BYTES)
    listener = ros.node(library, "listener", count=20)
    await asyncio.wait_for(publisher.wait_for_subscriber(), DEADLINE)
    await send(publisher, 10, 64, 1000)
    # roscpp drops what it has not read yet when it hears that the publisher is gone.
    await asyncio.to_thread(listener.wait_event, "report", DEADLINE, where=lambda report: report["count"] == 10)
    await publisher.close()
    again = await node.advertise("/chatter", BYTES)
    await asyncio.wait_for(again.wait_for_subscriber(), DEADLINE)
    pattern = Pattern(64)
    for sequence in range(11, 21):
        again.publish_raw(framed(pattern.payload(1, sequence)))
    report = await event(listener, "done")
    assert (report["gaps"], report["doubled"], report["last"]) == (0, 0, 20)


@pytest.mark.trap(16)
async def test_a_listener_that_was_stopped_finds_a_topic_that_was_gone_meanwhile(node: Node, ros: Ros) -> None:
    """rospy has much to read before the end of its connection, and gets the list with the same publisher first."""
    listener = ros.node("rospy", "listener")
    pattern = Pattern(100)
    for _ in range(3):
        publisher = await node.advertise("/chatter", BYTES, queue_messages=10_000)
        await asyncio.wait_for(publisher.wait_for_subscriber(), DEADLINE)
        os.kill(listener.pid, signal.SIGSTOP)
        try:
            for sequence in range(1, 5001):  # fits the kernel's buffers
                publisher.publish_raw(framed(pattern.payload(1, sequence)))
            await publisher.close()
            publisher = await node.advertise("/chatter", BYTES)
        finally:
            os.kill(listener.pid, signal.SIGCONT)
        await asyncio.wait_for(publisher.wait_for_subscriber(), DEADLINE)
        await publisher.close()


@pytest.mark.trap(11)
@libraries
async def test_trap_11_a_silent_connection_hurts_no_real_listener(node: Node, ros: Ros, library: str) -> None:
    publisher = await node.advertise("/chatter", BYTES)
    address = node.slave.address_of("/chatter")
    assert address is not None
    with socket.create_connection(address):
        ros.node(library, "listener")
        await asyncio.wait_for(publisher.wait_for_subscriber(), DEADLINE)


@pytest.mark.trap(21, 22)
@libraries
async def test_trap_21_requestTopic_answers_as_rospy_does(node: Node, ros: Ros, core: RosCore, library: str) -> None:  # noqa: N802
    ros.node(library, "talker", name="talker")
    await until(lambda: core.state().publishers.get("/chatter"))
    await node.advertise("/ours", BYTES)
    theirs = await call_api(
        core.state().publishers["/chatter"]["/talker"], "requestTopic", "/x", "/chatter", [["TCPROS"]]
    )
    own = await call_api(node.uri, "requestTopic", "/x", "/ours", [["UDPROS", b"", "h", 1, 1500], ["TCPROS"]])
    assert (theirs.code, own.code) == (1, 1)
    assert isinstance(theirs.value, list)
    assert isinstance(own.value, list)
    assert [type(part) for part in theirs.value] == [type(part) for part in own.value]
    assert theirs.value[:2] == own.value[:2]
    assert (await call_api(node.uri, "requestTopic", "/x", "/other", [["TCPROS"]])).code == -1

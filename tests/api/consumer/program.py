"""A program of somebody else, which uses the whole API; type checkers read it beside an installed rmpa."""

import asyncio
import logging
from collections.abc import AsyncGenerator
from typing import Any, assert_type

import rmpa
from rmpa.client import AgentClient, AgentEvent, PeerInfo, PeerLinked, PeerLost, Snapshot, changes, snapshot
from rmpa.resource import Resource, ResourceClient, at_least


async def node() -> None:
    """The asyncio node."""
    async with rmpa.Node("talker", anonymous=True, handle_signals=True) as one:
        publisher = assert_type(await one.advertise("/chatter", "std_msgs/String", latch=True), rmpa.Publisher)
        assert_type(publisher.publish(data="hello"), int)
        assert_type(one.logger, logging.Logger)
        subscriber = assert_type(await one.subscribe("/chatter", "std_msgs/String"), rmpa.Subscriber)
        async for received in subscriber:
            assert_type(received, rmpa.Received)
            assert_type(received.message, Any)
            assert_type(received.raw, bytes)
        async for count in one.rate(10):
            assert_type(count, int)
        assert_type(one.timer(1.0, lambda: None), asyncio.Task[None])
        service = await one.advertise_service(
            "/add", "rospy_tutorials/AddTwoInts", lambda request: {"sum": request.a}
        )
        assert_type(service, rmpa.Service)
        assert_type(await one.connect_service("/add", "rospy_tutorials/AddTwoInts"), rmpa.ServiceClient)
        assert_type(await one.call_service("/add", "rospy_tutorials/AddTwoInts", [1, 2]), Any)
        assert_type(await one.has_param("/gain"), bool)
        assert_type(await one.wait_for_message("/chatter", timeout=1.0), rmpa.Received)
        async with ResourceClient(one, "sonar") as sonar:
            await sonar.require(rate=at_least("20 Hz", hard=True))


def script() -> None:
    """The node for scripts."""

    def heard(message: Any) -> None:
        print(message.data)

    try:
        with rmpa.connect("listener") as one:
            assert_type(one, rmpa.SyncNode)
            one.subscribe("/chatter", "std_msgs/String", heard)
            publisher = assert_type(one.advertise("/chatter", "std_msgs/String"), rmpa.SyncPublisher)
            for count in one.rate(10):
                publisher.publish(data=f"hello {count}")
            assert_type(one.wait_for_message("/chatter"), Any)
            one.spin()
    except rmpa.UnreachableError as error:
        assert_type(error.remedy, str)
        assert_type(error.code, str)
        raise SystemExit(str(error)) from None


async def agent() -> None:
    """The agent's snapshot and events."""
    async with AgentClient() as one:
        first = assert_type(await one.snapshot(), Snapshot)
        assert_type(first.peers, tuple[PeerInfo, ...])
        events = assert_type(one.events(since=first), AsyncGenerator[AgentEvent, None])
        async for event in events:
            match event:
                case PeerLinked() | PeerLost():
                    assert_type(event.peer, PeerInfo)
                case _:
                    pass
    for event in changes(None, snapshot()):
        print(event)


sonar = Resource("sonar", role="sensing")
ranges = sonar.output("ranges", "sensor_msgs/Range")


@sonar.task(rate="20 Hz")
def measure() -> None:
    """Send a measurement."""
    ranges.publish(range=1.0)

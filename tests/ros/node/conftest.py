"""A core of its own for each test, and what serialization loads, loaded before."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator

import pytest

from rmpa.ros.core.embedded import RosCore
from rmpa.ros.types.installed import ServiceType
from rmpa.ros.types.messages import MessageType
from tests.ros.node.peers import RawSubscriber


@pytest.fixture(scope="session", autouse=True)
def _warm() -> None:
    """Import numpy and rosbags outside of any loop: that takes a while, and a test's time is not for it."""
    services = ("rospy_tutorials/AddTwoInts", "roscpp/GetLoggers", "roscpp/SetLoggerLevel", "std_srvs/SetBool")
    kinds = [half for name in services for half in (ServiceType(name).request, ServiceType(name).response)]
    for kind in (MessageType("std_msgs/String"), MessageType("rosgraph_msgs/Log"), *kinds):
        kind.deserialize(kind.serialize(kind.make()))


@pytest.fixture(autouse=True)
def _links(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """All connections that a test has made by hand are closed at its end."""
    made: list[RawSubscriber] = []
    monkeypatch.setattr(RawSubscriber, "made", made)
    yield
    for link in made:
        link.close()


@pytest.fixture
async def core(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[RosCore]:
    """A core at a port of its own; its nodes look soon whether it knows them."""
    monkeypatch.setattr("rmpa.ros.node.node.NODE_MASTER_CHECK", 0.05)
    made = RosCore("127.0.0.1", 0)
    await made.start()
    yield made
    await made.close()

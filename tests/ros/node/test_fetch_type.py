from __future__ import annotations

import socket
from typing import TYPE_CHECKING, Final

import pytest

from rmpa.core.errors import PeerRefused, UnreachableError
from rmpa.ros import limits
from rmpa.ros.node.fetch_type import fetch_type, find_or_fetch
from rmpa.ros.types.definitions import DefinitionError, UnknownTypeError
from rmpa.ros.types.installed import ServiceType, packages_below
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.tcpros import TopicDescription
from tests.ros.node.peers import node, until
from tests.ros.types import workspaces
from tests.ros.types.workspaces import package

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from rmpa.ros.core.embedded import RosCore
    from rmpa.ros.node.endpoints import Received

NAME: Final = "my_msgs/Foo"
FOO: Final = MessageType.learn(NAME, "int32 a\n")
OLD: Final = MessageType.learn(NAME, "int64 a\n")
SET_BOOL: Final = ServiceType("std_srvs/SetBool")


@pytest.fixture(autouse=True)
def nothing_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    workspaces.nothing_installed(tmp_path, monkeypatch)
    yield
    packages_below.cache_clear()


async def learnt(core: RosCore, topic: str = "", *, elsewhere: bool = True) -> tuple[str, str, str] | None:
    found = await fetch_type(core.uri, "/asker", NAME, topic=topic, elsewhere=elsewhere)
    return (found.node, found.topic, found.kind.md5sum) if found is not None else None


async def test_type_is_fetched_from_a_publisher(core: RosCore) -> None:
    async with node(core, "old") as old, node(core, "new") as new, node(core, "/rmpa/base/new") as proxy:
        assert await learnt(core) is None
        await old.advertise("/c", OLD)
        await new.advertise("/b", FOO)
        await proxy.advertise("/a", FOO)
        # Nodes of this module first, then a peer's; those of the topic before all.
        assert await learnt(core) == ("/new", "/b", FOO.md5sum)
        assert await learnt(core, "/c") == ("/old", "/c", OLD.md5sum)
        assert await learnt(core, "/a") == ("/rmpa/base/new", "/a", FOO.md5sum)
        assert await learnt(core, "/d", elsewhere=False) is None
        # Nothing of it stays: neither a registration nor a connection.
        assert "/asker" not in str(core.state())
        await until(lambda: not any(each.connected for each in new.slave.connections()))


async def test_publishers_that_cannot_tell_are_passed_over(core: RosCore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rmpa.ros.node.fetch_type.FETCH_TYPE_TIMEOUT", 0.1)
    silent = socket.create_server(("127.0.0.1", 0))  # listens, and never answers
    port = silent.getsockname()[1]
    core.call("registerPublisher", "/a_gone", "/a", NAME, "http://127.0.0.1:9/")
    core.call("registerPublisher", "/b_silent", "/b", NAME, f"http://127.0.0.1:{port}/")
    async with node(core, "one") as one, node(core, "two") as two:
        await one.advertise("/c", TopicDescription(NAME, FOO.md5sum, ""))  # no definition
        await one.advertise("/d", TopicDescription(NAME, "0" * 32, "int32 a"))  # another sum
        await one.advertise("/e", TopicDescription(NAME, FOO.md5sum, "what is this"))
        assert await learnt(core) is None
        await two.advertise("/f", FOO)
        assert await learnt(core) == ("/two", "/f", FOO.md5sum)
        monkeypatch.setattr(limits, "FETCH_TYPE_PUBLISHERS", 3)
        assert await learnt(core) is None
    silent.close()


async def test_without_a_publisher_the_error_has_all_reasons(core: RosCore) -> None:
    with pytest.raises(UnknownTypeError) as caught:
        await find_or_fetch(core.uri, "/asker", NAME)
    assert str(caught.value) == (
        "message type my_msgs/Foo: is not known here; looked in ROS_PACKAGE_PATH (not set), CMAKE_PREFIX_PATH "
        f"(not set), PYTHONPATH (not set), and at what comes with rmpa; no publisher at {core.uri} tells it; source "
        "the workspace that has it, or let a node that publishes it run, here or at a peer"
    )
    with pytest.raises(UnknownTypeError, match="did you mean std_msgs/String"):
        await find_or_fetch("http://127.0.0.1:9/", "/asker", "std_msgs/Strin")
    with pytest.raises(UnreachableError):
        await find_or_fetch("http://127.0.0.1:9/", "/asker", NAME)


async def test_node_advertises_a_received_type(core: RosCore) -> None:
    async with node(core, "a") as a, node(core, "b") as b:
        with pytest.raises(UnknownTypeError, match="no publisher at"):
            await b.advertise("/y", NAME)
        await a.advertise("/x", FOO)
        publisher = await b.advertise("/y", NAME)
        assert publisher.description == FOO.describe()
        assert publisher.make([7]).a == 7


async def test_a_node_takes_the_definition_of_a_type_from_its_publisher(core: RosCore) -> None:
    async with node(core, "a") as a, node(core, "b") as b, node(core, "c") as c:
        got: list[Received] = []
        subscriber = await b.subscribe("/x", NAME, got.append)
        other = await c.advertise("/x", "std_msgs/String")
        publisher = await a.advertise("/x", FOO)
        await publisher.wait_for_subscriber()
        publisher.publish(publisher.make([7]))
        await until(lambda: got != [])
        assert (got[0].message.a, got[0].kind.name) == (7, NAME)
        await until(lambda: subscriber.refusals != {})
        assert list(subscriber.refusals.values()) == [f"the publisher has [{other.description}], not [{NAME}/*]"]
        with pytest.raises(DefinitionError, match="did you mean"):
            await b.subscribe("/y", "std_msgs/Strin")


async def test_types_of_a_workspace(core: RosCore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package(tmp_path / "deep" / "my_msgs", msg_Foo="int32 a\n", srv_Do="int8 a\n---\n")
    package(tmp_path / "std_srvs", srv_SetBool="bool data\n---\n")  # another version than ours
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path))
    async with node(core, "a") as a, node(core, "b") as b:
        publisher = await a.advertise("/x", NAME)
        assert (publisher.description.md5sum, publisher.description.definition) == (FOO.md5sum, "int32 a\n")
        subscriber = await b.subscribe("/x", NAME)
        assert subscriber.kind is not None
        await a.advertise_service("/do", "my_msgs/Do", lambda request: [] if request.a == 5 else None)
        await b.call_service("/do", "my_msgs/Do", [5])
        # The server's version counts where both are here.
        await a.advertise_service("/ours", SET_BOOL, lambda _: {"message": "ours"})
        assert (await b.call_service("/ours", "std_srvs/SetBool", [True])).message == "ours"
        await a.advertise_service("/theirs", "std_srvs/SetBool", lambda _: {})
        assert not hasattr(await b.call_service("/theirs", "std_srvs/SetBool", [True]), "message")
        with pytest.raises(PeerRefused):
            await b.call_service("/do", "std_srvs/Empty")

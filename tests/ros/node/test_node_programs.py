"""What a program asks of a node: rates, timers, logs, waits, and types of others."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from rmpa.core.errors import PeerRefused, UnreachableError
from rmpa.ros import limits
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.endpoints import Received
from rmpa.ros.node.fetch_type import fetch_type, find_or_fetch
from rmpa.ros.node.node import Node
from rmpa.ros.types.definitions import DefinitionError, UnknownTypeError
from rmpa.ros.types.installed import ServiceType, packages_below
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.tcpros import TopicDescription
from tests.ros.node.peers import node
from tests.ros.types import workspaces
from tests.ros.types.workspaces import package
from tests.waiting import DEADLINE, until


async def test_a_rate_does_not_drift_and_leaves_out_what_is_past(core: RosCore) -> None:
    loop = asyncio.get_running_loop()
    async with node(core, "n") as one:
        begun = first = late = loop.time()  # the rate begins in between the first two
        async for count in one.rate(50):
            assert begun + count / 50 - 0.001 <= loop.time()
            if count == 0:
                first = loop.time()
            elif count == 3:
                await asyncio.sleep(0.1)  # five periods
                late = loop.time()
            elif count > 3:
                # The next number is the one that is due now, not 4.
                assert (late - first) * 50 - 1 <= count <= (loop.time() - begun) * 50 + 1
                break
        assert count >= 8


async def test_a_rate_ends_with_its_node(core: RosCore) -> None:
    async with node(core, "n") as one:
        async for count in one.rate(0.001):
            assert count == 0
            asyncio.get_running_loop().call_soon(lambda: asyncio.ensure_future(one.close()))


async def test_a_timer_goes_on_after_an_exception_and_until_it_is_cancelled(
    core: RosCore, caplog: pytest.LogCaptureFixture
) -> None:
    plain: list[int] = []
    awaited: list[int] = []

    def tick() -> None:
        plain.append(len(plain))
        if len(plain) == 2:
            raise ValueError("the second")

    async def later() -> None:
        await asyncio.sleep(0)
        awaited.append(len(awaited))

    async with node(core, "n") as one:
        timer = one.timer(0.01, tick)
        one.timer(0.01, later)
        await until(lambda: len(plain) > 3 and len(awaited) > 3)
        timer.cancel()
        done, more = len(plain), len(awaited)
        await until(lambda: len(awaited) > more + 3)
        assert len(plain) == done
    assert "ValueError: the second" in caplog.text


async def test_the_log_is_on_rosout_from_its_first_line(core: RosCore, capsys: pytest.CaptureFixture[str]) -> None:
    async with node(core, "eye") as one, node(core, "rqt_console") as console:
        seen = await console.subscribe("/rosout_agg", "rosgraph_msgs/Log")
        await until(lambda: seen.publishers)
        await one.advertise("/t", "std_msgs/String")
        one.logger.info("opened %d lenses", 2)
        one.logger.debug("not told: the level is INFO")
        threading.Thread(target=one.logger.warning, args=("from a thread",)).start()
        async with asyncio.timeout(DEADLINE):
            iterator = aiter(seen)
            records = [(await anext(iterator)).message for _ in range(2)]
        assert [(r.name, r.level, r.msg) for r in records] == [
            ("/eye", 2, "opened 2 lenses"),
            ("/eye", 4, "from a thread"),
        ]
        assert records[0].topics == ["/rosout", "/t"]
        assert records[0].file == __file__
        assert records[0].function == "test_the_log_is_on_rosout_from_its_first_line"
        assert records[0].line > 0
        assert abs(records[0].header.stamp.sec - time.time()) < DEADLINE
    assert logging.getLogger("rosout.eye").handlers == []
    assert "opened 2 lenses" not in capsys.readouterr().err  # pytest has configured logging


async def test_what_is_logged_last_arrives_too(core: RosCore) -> None:
    async with node(core, "rqt_console") as console:
        seen = await console.subscribe("/rosout_agg", "rosgraph_msgs/Log")
        await until(lambda: seen.publishers)
        async with node(core, "brief") as brief:
            brief.logger.error("no camera")
        async with asyncio.timeout(DEADLINE):
            async for received in seen:
                assert (received.message.msg, received.message.level) == ("no camera", 8)
                break


async def test_a_parameters_changes_are_told_to_its_own_callback(core: RosCore) -> None:
    told: list[tuple[str, object]] = []
    async with node(core, "n") as one, node(core, "other") as other:
        await one.follow_param("/gains", lambda key, value: told.append((key, value)))
        await one.follow_param("/else", lambda *_: pytest.fail("another parameter"))
        await other.set_param("/gains/p", 2.5)
        await until(lambda: told)
        await other.delete_param("/gains/p")
        await until(lambda: len(told) == 2)
    assert told == [("/gains/p", 2.5), ("/gains/p", {})]


async def test_waiting_for_a_message(core: RosCore) -> None:
    async with node(core, "n") as one, node(core, "talker") as talker:
        with pytest.raises(UnreachableError, match=r"no publisher of /t answers at /n in 0.05 s; `rmpa why /t`"):
            await one.wait_for_message("t", "std_msgs/String", 0.05)
        (await talker.advertise("/t", "std_msgs/String", latch=True)).publish("hello")
        assert (await one.wait_for_message("t", timeout=DEADLINE)).message.data == "hello"
        waiting = asyncio.create_task(one.wait_for_message("/never"))
        await until(lambda: "/never" in core.state().subscribers)
        await one.close()
        with pytest.raises(UnreachableError, match="which is closed"):
            await waiting


async def test_waiting_for_a_service(core: RosCore) -> None:
    async with node(core, "n") as one, node(core, "server") as server:
        with pytest.raises(UnreachableError, match="no server of service /s"):
            await one.wait_for_service("s", 0.05)
        waiting = asyncio.create_task(one.wait_for_service("s", DEADLINE))
        await asyncio.sleep(0)
        await server.advertise_service("/s", "std_srvs/Trigger", lambda _: {"success": True})
        await waiting
        assert (await one.call_service("s", "std_srvs/Trigger")).success


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
async def test_a_signal_closes_a_node_that_handles_it(core: RosCore, number: signal.Signals) -> None:
    async with node(core, "n", handle_signals=True) as one:
        subscriber = await one.subscribe("/t", "std_msgs/String")
        os.kill(os.getpid(), number)
        async with asyncio.timeout(DEADLINE):
            async for _ in subscriber:
                pytest.fail("nobody publishes")
        await one.close()
    assert "/t" not in core.state().subscribers
    assert signal.getsignal(number) in (signal.default_int_handler, signal.SIG_DFL)


async def test_arguments_replace_names_and_set_private_parameters(
    core: RosCore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_MASTER_URI", core.uri)
    argv = ("2", "chatter:=/talk", "__name:=speaker", "_gain:=2", "--loud", "__log:=/tmp/speaker.log")
    async with Node("talker", argv=argv) as one:
        assert (one.name, await one.get_param("/speaker/gain")) == ("/speaker", 2)
        assert (await one.advertise("chatter", "std_msgs/String")).topic == "/talk"


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
    return (found[2], found[1], found[0].md5sum) if found is not None else None


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

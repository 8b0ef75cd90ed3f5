from __future__ import annotations

import asyncio
import logging
from typing import Any

import pytest

from rmpa.core.errors import LocalProtocolError, PeerRefused, RmpaError, UnreachableError
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.environment import RosEnvironment
from rmpa.ros.http.rpc import call
from rmpa.ros.node.node import Node, Received
from rmpa.ros.types.definitions import DefinitionError
from rmpa.ros.types.messages import MessageError, MessageType
from rmpa.ros.wire.xmlrpc import RosFault
from tests.ros.node.peers import STRING, node
from tests.waiting import DEADLINE, until


async def test_messages_go_from_one_node_to_another(core: RosCore) -> None:
    async with node(core, "talker") as talker, node(core, "listener") as listener:
        publisher = await talker.advertise("chatter", "std_msgs/String")
        got: list[Received] = []
        subscriber = await listener.subscribe("chatter", "std_msgs/String", got.append)
        await publisher.wait_for_subscriber()
        publisher.publish(publisher.make("hello"))
        publisher.publish_raw(b"\x03\x00\x00\x00raw")
        await until(lambda: len(got) == 2)
        assert got[0].message.data == "hello"
        assert got[1].plain == {"data": "raw"}
        assert (got[0].caller_id, got[0].raw) == ("/talker", b"\x05\x00\x00\x00hello")
        assert got[0].header["topic"] == "/chatter"
        assert got[0].stamp_ns > 0
        assert (publisher.subscribers, subscriber.publishers) == (1, 1)
        assert [each.direction for each in listener.slave.connections()] == ["i"]
        assert ("/chatter", "std_msgs/String") in await listener.get_published_topics()
    state = core.state()
    assert "/chatter" not in state.publishers
    assert "/chatter" not in state.subscribers


async def test_any_type_comes_from_its_publisher(core: RosCore) -> None:
    kind = MessageType.learn("my_msgs/Pair", "int32 a\nint32 b\n")
    async with node(core, "talker") as talker, node(core, "echo", anonymous=True) as echo:
        subscriber = await echo.subscribe("/pair")
        publisher = await talker.advertise("/pair", kind, latch=True)
        for n in range(3):
            publisher.publish(kind.make({"a": n, "b": 7}))
        got = []
        async with asyncio.timeout(DEADLINE):
            async for received in subscriber:
                got.append(received.plain)
                if received.plain["a"] == 2:
                    break
        assert got[-1] == {"a": 2, "b": 7}
        assert echo.name.startswith("/echo_")


async def test_messages_with_a_header_are_numbered_as_rospy_numbers_them(core: RosCore) -> None:
    async with node(core, "talker") as talker, node(core, "echo") as echo:
        publisher = await talker.advertise("/points", "geometry_msgs/PointStamped")
        subscriber = await echo.subscribe("/points")
        await publisher.wait_for_subscriber()
        message = publisher.make({"header": {"seq": 99, "frame_id": "map"}, "point": {"x": 7.0}})
        for _ in range(3):
            publisher.publish(message)
        publisher.publish_raw(MessageType("geometry_msgs/PointStamped").serialize(message))
        iterator = aiter(subscriber)
        async with asyncio.timeout(DEADLINE):
            got = [(await anext(iterator)).message for _ in range(4)]
        assert [each.header.seq for each in got] == [1, 2, 3, 99]  # what is relayed raw stays as it is
        assert {(each.header.frame_id, each.point.x) for each in got} == {("map", 7.0)}


async def test_a_node_hears_its_own_publisher_as_rospy_and_roscpp_do(core: RosCore) -> None:
    async with node(core, "both") as both:
        subscriber = await both.subscribe("/t", "std_msgs/String")
        apart = await both.subscribe("/u", "std_msgs/String", own=False)
        for topic in ("/t", "/u"):
            (await both.advertise(topic, "std_msgs/String", latch=True)).publish(data="hello")
        async with asyncio.timeout(DEADLINE):
            async for received in subscriber:
                assert (received.message.data, received.caller_id) == ("hello", "/both")
                break
            async with node(core, "other") as other:  # comes later than what /both would have heard
                (await other.advertise("/u", "std_msgs/String", latch=True)).publish("hello")
                async for received in apart:
                    assert received.caller_id == "/other"
                    break


async def test_a_message_is_published_as_an_object_as_values_or_as_fields(core: RosCore) -> None:
    async with node(core, "talker") as talker, node(core, "echo") as echo:
        publisher = await talker.advertise("/p", "geometry_msgs/Point")
        subscriber = await echo.subscribe("/p")
        await publisher.wait_for_subscriber()
        publisher.publish(publisher.make({"x": 1}))
        publisher.publish({"x": 1})
        publisher.publish([1, 0, 0])
        publisher.publish(x=1)
        publisher.publish()
        async with asyncio.timeout(DEADLINE):
            iterator = aiter(subscriber)
            got = [(await anext(iterator)).message.x for _ in range(5)]
        assert got == [1.0, 1.0, 1.0, 1.0, 0.0]
        for wrong, error in (
            ({"w": 1}, "geometry_msgs/Point has no field 'w'; it has x, y, z"),
            ("x", "geometry_msgs/Point is made of the fields x, y, z, not of 'x'"),
            (
                MessageType("std_msgs/String").make("x"),
                "a message of type geometry_msgs/Point is wanted, not of std_m",
            ),
        ):
            with pytest.raises(MessageError, match=error):
                publisher.publish(wrong)
        with pytest.raises(MessageError, match="a message and fields are given"):
            publisher.publish([1, 0, 0], x=1)


async def test_the_iteration_ends_with_its_subscriber_and_with_its_node(core: RosCore) -> None:
    async with node(core, "n") as one:
        for end in (lambda s: s.close(), lambda _: one.close()):
            subscriber = await one.subscribe("/t")

            async def read(subscriber: object = subscriber) -> list[object]:
                return [received async for received in subscriber]  # type: ignore[attr-defined]

            reading = asyncio.get_running_loop().create_task(read())
            await asyncio.sleep(0)
            await end(subscriber)
            assert await asyncio.wait_for(reading, DEADLINE) == []


async def test_a_slow_iteration_loses_the_oldest(core: RosCore) -> None:
    async with node(core, "talker") as talker, node(core, "listener") as listener:
        publisher = await talker.advertise("/t", "std_msgs/String")
        subscriber = await listener.subscribe("/t", queue_messages=2)
        await publisher.wait_for_subscriber()
        for n in range(5):
            publisher.publish(publisher.make(str(n)))
        await until(lambda: subscriber.dropped == 3)
        iterator = aiter(subscriber)
        assert [(await anext(iterator)).plain["data"] for _ in range(2)] == ["3", "4"]


async def test_a_failing_callback_is_logged_and_called_again(core: RosCore, caplog: pytest.LogCaptureFixture) -> None:
    calls: list[bytes] = []

    def fail(received: Received) -> None:
        calls.append(received.raw)
        raise RuntimeError("the user's mistake")

    async with node(core, "talker") as talker, node(core, "listener") as listener:
        publisher = await talker.advertise("/t", STRING)
        await listener.subscribe("/t", callback=fail)
        await publisher.wait_for_subscriber()
        publisher.publish_raw(b"1")
        publisher.publish_raw(b"2")
        await until(lambda: calls == [b"1", b"2"])
        with pytest.raises(LocalProtocolError, match="use publish_raw"):
            publisher.publish("x")
    assert "the user's mistake" in caplog.text


async def test_a_subscriber_may_take_the_bytes_themselves(core: RosCore) -> None:
    taken: list[tuple[bytes, str]] = []
    async with node(core, "talker") as talker, node(core, "listener") as listener:
        publisher = await talker.advertise("/t", STRING)
        await listener.subscribe("/t", on_bytes=lambda data, header: taken.append((bytes(data), header["callerid"])))
        await publisher.wait_for_subscriber()
        publisher.publish_raw(b"1")
        publisher.publish_raw(b"x" * 300_000)
        await until(lambda: len(taken) == 2)
    assert taken == [(b"1", "/talker"), (b"x" * 300_000, "/talker")]


@pytest.mark.trap(17)
async def test_a_bad_message_is_one_error_and_the_next_is_read(
    core: RosCore, caplog: pytest.LogCaptureFixture
) -> None:
    """rospy closes, and reads what comes next behind the bytes that are left of the bad one."""
    heard: list[str] = []
    async with node(core, "talker") as talker, node(core, "listener") as listener:
        publisher = await talker.advertise("/t", "std_msgs/String")
        subscriber = await listener.subscribe(
            "/t", "std_msgs/String", lambda received: heard.append(received.message.data)
        )
        await publisher.wait_for_subscriber()
        good = b"\x02\x00\x00\x00ok"
        for bad in (b"", b"\xff\xff\xff\x7fx", good[:-1], good + b"trailing"):
            publisher.publish_raw(bad)
            publisher.publish_raw(good)
        await until(lambda: len(heard) == 4)
        assert subscriber.publishers == 1
    assert set(heard) == {"ok"}
    assert caplog.text.count("bytes are not a std_msgs/String") == 4


async def test_another_md5_sum_is_reported_at_both_sides(core: RosCore, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    async with node(core, "talker") as talker, node(core, "listener") as listener:
        publisher = await talker.advertise("/t", "std_msgs/String")
        subscriber = await listener.subscribe("/t", "std_msgs/Int32")
        await until(lambda: subscriber.refusals)
        assert "client [/listener] wants topic /t" in subscriber.refusals[talker.uri]
        assert publisher.subscribers == 0
        text = r"no publisher of /t answers at /listener in .* s; client \[/listener\] wants topic /t"
        with pytest.raises(UnreachableError, match=text):
            await listener.wait_for_message("/t", "std_msgs/Int32", 0.5)
    assert "client [/listener] wants topic /t" in caplog.text


async def test_parameters(core: RosCore) -> None:
    changes: list[tuple[str, object]] = []
    async with (
        node(core, "n", on_param_update=lambda key, value: changes.append((key, value))) as one,
        node(core, "other") as other,
    ):
        await one.set_param("~gains", {"p": 1.5, "names": ["a", True]})
        assert await other.get_param("/n/gains/p") == 1.5
        assert await one.get_param("~gains") == {"p": 1.5, "names": ["a", True]}
        assert await one.search_param("gains") == "/n/gains"
        assert await one.search_param("nothing") is None
        assert not await one.has_param("/nothing")
        assert await one.get_param("/nothing", 7) == 7
        with pytest.raises(PeerRefused, match="nothing"):
            await one.get_param("/nothing")
        assert await one.follow_param("~gains") == {"p": 1.5, "names": ["a", True]}
        await other.set_param("/n/gains/p", 2.5)
        await until(lambda: changes)
        assert changes == [("/n/gains/p", 2.5)]
        await one.delete_param("~gains")
        assert not await one.has_param("~gains")


async def test_nodes_survive_a_restarted_master(core: RosCore) -> None:
    async with node(core, "talker") as talker, node(core, "listener") as listener:
        publisher = await talker.advertise("/t", "std_msgs/String")
        got: list[Received] = []
        subscriber = await listener.subscribe("/t", None, got.append)
        await publisher.wait_for_subscriber()
        port = core.port
        await core.close()
        publisher.publish(publisher.make("meanwhile"))
        await until(lambda: len(got) == 1)
        again = RosCore("127.0.0.1", port)
        await again.start()
        await until(lambda: again.state().publishers.get("/t") == {"/talker": talker.uri})
        await until(lambda: again.state().subscribers.get("/t") == {"/listener": listener.uri})
        publisher.publish(publisher.make("afterwards"))
        await until(lambda: len(got) == 2)
        assert [received.plain["data"] for received in got] == ["meanwhile", "afterwards"]
        assert subscriber.publishers == 1
        await talker.close()
        await listener.close()
        await again.close()


async def test_the_master_ends_a_node_whose_name_is_taken(core: RosCore) -> None:
    reasons: list[str] = []
    async with node(core, "twin", on_shutdown=reasons.append) as first:
        await first.advertise("/t", "std_msgs/String")
        async with node(core, "twin") as second:
            await second.advertise("/u", "std_msgs/String")
            await asyncio.wait_for(first.stopped.wait(), DEADLINE)
            await first.close()
            assert len(reasons) == 1
            assert core.state().publishers["/u"] == {"/twin": second.uri}
            assert "/t" not in core.state().publishers


async def test_no_master_is_a_clear_error() -> None:
    core = RosCore("127.0.0.1", 0)
    await core.start()
    await core.close()
    with pytest.raises(UnreachableError) as caught:
        async with Node("n", master_uri=core.uri, environment=RosEnvironment()):
            pass
    assert f"no ROS master answers at {core.uri} (ROS_MASTER_URI); start one" in str(caught.value)


async def test_unadvertised_and_unsubscribed(core: RosCore) -> None:
    async with node(core, "n") as one:
        publisher = await one.advertise("~out", "std_msgs/String")
        subscriber = await one.subscribe("/in")
        assert core.state().publishers["/n/out"] == {"/n": one.uri}
        with pytest.raises(ValueError, match="publishes /n/out already"):
            await one.advertise("/n/out", "std_msgs/String")
        with pytest.raises(DefinitionError):
            await one.advertise("/x", "no_msgs/Such")
        await publisher.close()
        await subscriber.close()
        with pytest.raises(RmpaError, match="/n/out is not published any more: its publisher is closed"):
            publisher.publish("x")
        assert "/n/out" not in core.state().publishers
        assert "/in" not in core.state().subscribers


async def test_only_an_open_node_registers(core: RosCore) -> None:
    one = node(core, "n")
    with pytest.raises(RmpaError, match=r"/n is not open: write `async with rmpa\.Node"):
        await one.advertise("/t", "std_msgs/String")
    async with one:
        with pytest.raises(RmpaError, match="/n was opened before: make another with rmpa"):
            await one.__aenter__()
        with pytest.raises(TypeError, match="the callback for /t is a plain function, not <function until"):
            await one.subscribe("/t", callback=until)  # type: ignore[arg-type]
        publisher = await one.advertise("/t", "std_msgs/String")
        waiting = asyncio.create_task(publisher.wait_for_subscriber())
        await asyncio.sleep(0)
    for late in (one.advertise("/u", "std_msgs/String"), one.subscribe("/u"), waiting):
        with pytest.raises(RmpaError, match=r"/n is closed|/t is not published any more"):
            await asyncio.wait_for(late, DEADLINE)
    state = core.state()
    assert not any("/n" in who for table in (state.publishers, state.subscribers) for who in table.values())


@pytest.mark.parametrize("ends", [False, True], ids=["the call is cancelled", "the node ends"])
async def test_what_is_registered_while_its_call_ends_is_not_left_at_the_master(
    core: RosCore, monkeypatch: pytest.MonkeyPatch, ends: bool
) -> None:
    async with node(core, "n") as one:
        call_master, registered, go_on = one.call_master, asyncio.Event(), asyncio.Event()

        async def slow(method: str, *params: Any) -> Any:
            if method == "unregisterSubscriber" and not go_on.is_set():
                return 0  # it overtakes the other call
            reply = await call_master(method, *params)
            if method == "registerSubscriber":
                registered.set()
                await go_on.wait()
            return reply

        monkeypatch.setattr(one, "call_master", slow)
        subscribing = asyncio.create_task(one.subscribe("/t"))
        await registered.wait()
        closing = asyncio.create_task(one.close()) if ends else None
        while ends and not one._ended:
            await asyncio.sleep(0)
        go_on.set()
        if closing is None:
            subscribing.cancel()
        with pytest.raises((RmpaError, asyncio.CancelledError)):
            await subscribing
        await until(lambda: "/t" not in core.state().subscribers)
        if closing is not None:
            await closing


@pytest.mark.parametrize("bound", [0, -1])
async def test_a_queue_has_room_for_a_message(core: RosCore, bound: int) -> None:
    async with node(core, "n") as one:
        for make in (one.advertise, one.subscribe):
            with pytest.raises(ValueError, match=f"queue_messages is at least 1, not {bound}"):
                await make("/t", "std_msgs/String", queue_messages=bound)


async def test_a_master_that_hangs_does_not_keep_a_node_from_its_end(
    core: RosCore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rmpa.ros.node.endpoints.NODE_UNREGISTER_TIMEOUT", 0.1)
    one = node(core, "n")
    async with one:
        for number in range(20):
            await one.advertise(f"/out{number}", "std_msgs/String")
        begun: list[str] = []

        async def hanging(_uri: str, method: str, *_params: Any) -> Any:
            begun.append(method)
            await asyncio.Event().wait()

        monkeypatch.setattr("rmpa.ros.node.endpoints.call", hanging)
        async with asyncio.timeout(DEADLINE):
            await one.close()
    assert begun == ["system.multicall"]
    assert one.stopped.is_set()


async def test_a_node_unregisters_at_a_master_without_multicall(
    core: RosCore, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def lacking(uri: str, method: str, *params: Any) -> Any:
        if method == "system.multicall":
            raise RosFault(-1, f"there is no {method}")
        return await call(uri, method, *params)

    async with node(core, "n") as one:
        await one.advertise("/out", "std_msgs/String")
        await one.subscribe("/in", "std_msgs/String")
        monkeypatch.setattr("rmpa.ros.node.endpoints.call", lacking)
    assert not {"/out", "/in"} & {*core.state().publishers, *core.state().subscribers}


async def test_a_service_is_served_and_called(core: RosCore) -> None:
    async def slowly(request: Any) -> dict[str, int]:
        await asyncio.sleep(0)
        return {"sum": request.a + request.b}

    async with node(core, "server") as server, node(core, "client") as client:
        service = await server.advertise_service("~add", "rospy_tutorials/AddTwoInts", slowly)
        assert service.name == "/server/add"
        assert core.call("lookupService", "/x", "/server/add").value == server.slave.service_uri
        assert await client.lookup_service("/server/add") == server.slave.service_uri
        response = await client.call_service("/server/add", "rospy_tutorials/AddTwoInts", [20, 22])
        assert response.sum == 42
        calls = await client.connect_service("/server/add", service.kind)
        assert [(await calls.call({"a": n})).sum for n in range(5)] == list(range(5))
        with pytest.raises(ValueError, match="/server serves /server/add already"):
            await server.advertise_service("~add", "std_srvs/Empty", slowly)
        with pytest.raises(PeerRefused, match="to have md5sum"):
            await client.call_service("/server/add", "std_srvs/Trigger")
        await service.close()
        await until(lambda: calls.closed)
        with pytest.raises(UnreachableError, match="no server of service /server/add answers at the ROS master"):
            await client.call_service("/server/add", "rospy_tutorials/AddTwoInts")
    assert not [name for name, _ in services(core) if name == "/server/add"]


def services(core: RosCore) -> list[tuple[str, object]]:
    """All services and their nodes."""
    value = core.call("getSystemState", "/x").value
    assert isinstance(value, list)
    assert isinstance(value[2], list)
    return [(str(pair[0]), pair[1]) for pair in value[2] if isinstance(pair, list)]


async def test_what_a_handler_raises_is_the_clients_error(core: RosCore, caplog: pytest.LogCaptureFixture) -> None:
    def fails(request: Any) -> object:
        if request.data:
            raise PeerRefused("the gripper", "it is jammed")
        return {"succes": True}

    async with node(core, "server") as server:
        await server.advertise_service("/grip", "std_srvs/SetBool", fails)
        with pytest.raises(PeerRefused, match="service /grip refused: the gripper refused: it is jammed"):
            await server.call_service("/grip", "std_srvs/SetBool", True)
        with pytest.raises(PeerRefused, match="std_srvs/SetBoolResponse has no field 'succes'"):
            await server.call_service("/grip", "std_srvs/SetBool", False)
        assert not [record for record in caplog.records if record.levelno >= logging.WARNING]
        client = await server.connect_service("/grip", "std_srvs/SetBool")
        ok, text = await client.connection.call(b"too long")
        assert not ok
        assert b"8 bytes are not a std_srvs/SetBoolRequest" in bytes(text)
        client.close()


async def test_the_core_and_its_loggers(core: RosCore) -> None:
    found = dict(services(core))
    assert found == {"/rosout/get_loggers": ["/rosout"], "/rosout/set_logger_level": ["/rosout"]}
    async with node(core, "rqt") as client:
        response = await client.call_service("/rosout/get_loggers", "roscpp/GetLoggers")
        assert [logger.name for logger in response.loggers] == ["ros", "ros.rosout"]
        try:
            await client.call_service("/rosout/set_logger_level", "roscpp/SetLoggerLevel", ["ros", "DEBUG"])
            assert logging.getLogger("rmpa.ros").level == logging.DEBUG
            response = await client.call_service("/rosout/get_loggers", "roscpp/GetLoggers")
            assert [logger.level for logger in response.loggers] == ["debug", "debug"]
        finally:
            logging.getLogger("rmpa.ros").setLevel(logging.NOTSET)
        with pytest.raises(PeerRefused, match=r"/rosout has no logger 'nobody'; it has ros, ros\.rosout"):
            await client.call_service("/rosout/set_logger_level", "roscpp/SetLoggerLevel", ["nobody", "info"])
        with pytest.raises(PeerRefused, match="'loud' is not a level; there are debug, info, warn, error, fatal"):
            await client.call_service("/rosout/set_logger_level", "roscpp/SetLoggerLevel", ["ros", "loud"])
        raw = await client.connect_service("/rosout/set_logger_level", "roscpp/SetLoggerLevel")
        for junk in (b"", b"\x01", b"\x03\x00\x00\x00ros", b"\xff\xff\xff\xff", bytes(9)):
            ok, text = await raw.connection.call(junk)
            assert (ok, b"are not a roscpp/SetLoggerLevelRequest" in bytes(text)) == (False, True)
        raw.close()


async def test_restarted_core_gets_the_services_again(core: RosCore) -> None:
    async with node(core, "server") as server:
        await server.advertise_service("/empty", "std_srvs/Empty", lambda _request: None)
        core.call("unregisterService", "/server", "/empty", server.slave.service_uri)
        await until(lambda: ("/empty", ["/server"]) in services(core))

"""A hub with its node at a ROS core, other nodes, and clients without a protocol."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import time
import warnings
from typing import TYPE_CHECKING, Any

import pytest

from rmpa.core.errors import RmpaError
from rmpa.ros.types.definitions import SEPARATOR, known_text, parse_definition
from rmpa.ros.types.installed import ServiceType
from rmpa.ros.types.messages import MessageType
from rmpa.web import limits
from rmpa.web.hub.node_link import CONTROL_REMEDY, FULL, READ_ONLY, READ_REMEDY
from rmpa.web.hub.requests import (
    AdvertiseTopic,
    CallService,
    DeleteParam,
    Described,
    DescribeType,
    EndService,
    Failed,
    FindService,
    FollowGraph,
    FollowParams,
    GetParams,
    GraphChanged,
    OtherType,
    ParamsChanged,
    PublishMessage,
    ReceivedMessage,
    Respond,
    ServeService,
    ServiceFound,
    ServiceRequest,
    ServiceResult,
    SetParam,
    Subscribe,
    UnadvertiseTopic,
    Unsubscribe,
)
from tests.ros.node.peers import DEADLINE, LATCHED, STRING, until
from tests.web.hub.client import FakeClient, node, running_hub

if TYPE_CHECKING:
    from rmpa.ros.core.embedded import RosCore

ONE, TWO = b"\x03\0\0\0one", b"\x03\0\0\0two"
SET_BOOL = "std_srvs/SetBool"


# --- topics ---


async def test_all_clients_share_one_subscription_and_one_payload(core: RosCore) -> None:
    async with running_hub(core) as hub, node(core, "talker") as talker:
        publisher = await talker.advertise("/t", STRING)
        clients = [FakeClient(hub), FakeClient(hub)]
        for client in clients:
            client.ask(Subscribe(1, "/t"))
        await publisher.wait_for_subscriber()
        publisher.publish_raw(ONE)
        await until(lambda: all(client.payloads(1) for client in clients))
        assert publisher.subscribers == 1
        first, second = (client.of(ReceivedMessage)[0] for client in clients)
        assert first.payload is second.payload
        assert (first.topic, first.type, bytes(first.payload)) == ("/t", "std_msgs/String", ONE)
        assert abs(first.stamp_ns - time.time_ns()) < DEADLINE * 1e9


async def test_the_last_client_ends_the_subscription_after_a_while(core: RosCore, monkeypatch: Any) -> None:
    monkeypatch.setattr("rmpa.web.limits.SUBSCRIPTION_LINGER", 0.01)
    async with running_hub(core) as hub, node(core, "talker") as talker:
        publisher = await talker.advertise("/t", STRING)
        one, two = FakeClient(hub), FakeClient(hub)
        one.ask(Subscribe(1, "/t"))
        two.ask(Subscribe(1, "/t"))
        await publisher.wait_for_subscriber()
        one.ask(Unsubscribe(1))
        publisher.publish_raw(ONE)
        await until(lambda: two.payloads(1))
        assert one.payloads(1) == []
        two.close()
        await until(lambda: publisher.subscribers == 0)
        three = FakeClient(hub)
        three.ask(Subscribe(1, "/t"))
        await publisher.wait_for_subscriber()


async def test_beyond_a_bound_only_topics_with_a_publisher_are_subscribed_to(
    core: RosCore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "SUBSCRIBED_TOPICS_MAX", 3)
    async with running_hub(core) as hub, node(core, "talker") as talker:
        publisher = await talker.advertise("/t", STRING)
        client, other = FakeClient(hub), FakeClient(hub)
        await until(lambda: "/t" in hub.graph.topics and hub.graph.topics["/t"].publishers)
        for handle in range(1, 5):
            client.ask(Subscribe(handle, f"/none{handle}"))
        (refused,) = client.of(Failed)
        assert refused.handle == 4
        assert "/none4 has no publisher" in refused.error
        other.ask(Subscribe(1, "/none1"))
        other.ask(Subscribe(2, "/t"))
        assert not other.of(Failed)
        await publisher.wait_for_subscriber()
        client.ask(Unsubscribe(4))
        client.close()


async def test_a_storm_of_subscriptions_leaves_nothing_registered(
    core: RosCore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "SUBSCRIPTION_LINGER", 0.0)
    async with running_hub(core) as hub, node(core, "talker") as talker:
        publisher = await talker.advertise("/t", STRING)
        client = FakeClient(hub)
        for handle in range(1, 300):
            client.ask(Subscribe(handle, "/t" if handle % 2 else f"/none{handle}"))
            client.ask(AdvertiseTopic(handle, "/out", "std_msgs/String", latch=bool(handle % 2)))
            if handle % 3:
                await asyncio.sleep(0)
            client.ask(Unsubscribe(handle))
            client.ask(UnadvertiseTopic(handle))
        client.ask(Subscribe(300, "/t"))
        await publisher.wait_for_subscriber()
        publisher.publish_raw(ONE)
        await until(lambda: client.payloads(300) == [ONE])
        client.ask(Unsubscribe(300))

        async def registered() -> list[str]:
            state: Any = await talker.call_master("getSystemState")
            return [name for part in state[:2] for name, nodes in part if "/rmpa_web" in nodes and name != "/rosout"]

        async with asyncio.timeout(DEADLINE):
            while await registered():
                await asyncio.sleep(0.05)


async def test_newcomers_get_the_latched_message_of_each_source_once(core: RosCore) -> None:
    async with running_hub(core) as hub, node(core, "a") as a, node(core, "b") as b:
        for source, payload in ((a, ONE), (b, TWO)):
            (await source.advertise("/map", LATCHED, latch=True)).publish_raw(payload)
        early, late = FakeClient(hub), FakeClient(hub)
        early.ask(Subscribe(1, "/map"))
        await until(lambda: len(early.payloads(1)) == 2)
        late.ask(Subscribe(7, "/map"))
        assert sorted(late.payloads(7)) == [ONE, TWO]
        assert all(message.latched for message in late.of(ReceivedMessage))
        await asyncio.sleep(0)
        assert sorted(early.payloads(1)) == [ONE, TWO]


async def test_a_latched_message_that_comes_again_after_a_reconnection_is_not_delivered_twice(core: RosCore) -> None:
    async with running_hub(core) as hub, node(core, "a") as a:
        publisher = await a.advertise("/map", LATCHED, latch=True)
        publisher.publish_raw(ONE)
        client = FakeClient(hub)
        client.ask(Subscribe(1, "/map"))
        await until(lambda: client.payloads(1))
        assert publisher.publication.hang_up("/rmpa_web")
        await until(lambda: publisher.subscribers == 1)
        publisher.publish_raw(TWO)
        await until(lambda: client.payloads(1)[-1] == TWO)
        publisher.publish_raw(TWO)  # the same again, over the same connection, is news
        await until(lambda: len(client.payloads(1)) == 3)
        assert client.payloads(1) == [ONE, TWO, TWO]


async def test_a_client_that_fails_costs_the_others_no_message(core: RosCore) -> None:
    async with running_hub(core) as hub, node(core, "a") as a:
        publisher = await a.advertise("/t", STRING)

        def fail(_answer: Any) -> None:
            raise ValueError("a fault of a session")

        broken = hub.connect("broken", FULL, fail)
        hub.ask(broken, Subscribe(1, "/t"))
        client = FakeClient(hub)
        client.ask(Subscribe(1, "/t"))
        await publisher.wait_for_subscriber()
        publisher.publish_raw(ONE)
        await until(lambda: client.payloads(1) == [ONE])
        hub.disconnect(broken)


async def test_what_is_published_while_the_node_is_made_anew_is_sent_then(
    core: RosCore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rmpa.web.limits.NODE_RETRY", 0.05)
    async with running_hub(core) as hub, node(core, "base") as base:
        heard: list[bytes] = []
        await base.subscribe("/cmd_vel", callback=lambda message: heard.append(message.raw))
        client = FakeClient(hub)
        client.ask(AdvertiseTopic(1, "/cmd_vel", "std_msgs/String"))
        client.ask(PublishMessage(1, ONE))
        await until(lambda: heard == [ONE])
        present = hub.link.node
        assert present is not None
        await present.close()
        await until(lambda: hub.link.node is None or hub.link.node is not present)
        client.ask(PublishMessage(1, TWO))  # such as the stop of a robot
        await until(lambda: heard[-1] == TWO)


async def test_what_waits_too_long_for_the_core_is_not_sent(core: RosCore, monkeypatch: Any) -> None:
    monkeypatch.setattr("rmpa.web.limits.EARLY_AGE", 0.0)  # all that waits for the registration is too old
    async with running_hub(core) as hub, node(core, "echo") as echo:
        heard: list[bytes] = []
        for topic in ("/cmd", "/state"):
            await echo.subscribe(topic, callback=lambda message: heard.append(message.raw))
        client = FakeClient(hub)
        client.ask(AdvertiseTopic(1, "/cmd", "std_msgs/String"))
        client.ask(PublishMessage(1, ONE))
        client.ask(AdvertiseTopic(2, "/state", "std_msgs/String", latch=True))
        client.ask(PublishMessage(2, TWO))
        await until(lambda: heard)
        await until(lambda: core.publishers("/cmd") and core.publishers("/state"))
        while len(heard) < 2:
            client.ask(PublishMessage(1, b"\x05\0\0\0three"))
            await asyncio.sleep(0.01)
        assert ONE not in heard
        assert TWO in heard  # the last state counts, however old it is


async def test_two_versions_of_a_type_are_kept_apart(core: RosCore) -> None:
    async with running_hub(core) as hub:
        for text in ("float64 a", "int32 b"):
            kind = MessageType("my_msgs/Pair", parse_definition("my_msgs/Pair", text))
            header = {"type": kind.name, "md5sum": kind.md5sum, "message_definition": kind.definition}
            hub.types.learn(header)
            assert hub.types.version(kind.name, kind.md5sum).definition == kind.definition
        first = MessageType("my_msgs/Pair", parse_definition("my_msgs/Pair", "float64 a"))
        assert hub.types.version(first.name, first.md5sum).md5sum == first.md5sum


async def test_a_publisher_that_has_gone_leaves_no_latched_message(core: RosCore) -> None:
    async with running_hub(core) as hub, node(core, "a") as a:
        publisher = await a.advertise("/map", LATCHED, latch=True)
        publisher.publish_raw(ONE)
        early, late = FakeClient(hub), FakeClient(hub)
        early.ask(Subscribe(1, "/map"))
        await until(lambda: early.payloads(1))
        await publisher.close()
        await until(lambda: not core.publishers("/map"))

        def nothing() -> bool:
            late.ask(Subscribe(late.handle(), "/map"))
            done = not late.answers
            late.answers.clear()
            return done

        await until(nothing)


async def test_two_types_on_one_topic_are_told_apart(core: RosCore) -> None:
    number = MessageType("std_msgs/Int32")
    async with running_hub(core) as hub, node(core, "a") as a, node(core, "b") as b:
        text = await a.advertise("/t", STRING)
        other = await b.advertise("/t", number)
        client = FakeClient(hub)
        client.ask(Subscribe(1, "/t", "std_msgs/String"))
        client.ask(Subscribe(2, "/t", "std_msgs/Int32"))
        client.ask(Subscribe(3, "/t"))
        await text.wait_for_subscriber()
        await other.wait_for_subscriber()
        text.publish_raw(ONE)
        other.publish_raw(b"\x05\0\0\0")
        await until(lambda: len(client.payloads(3)) == 2)
        assert client.payloads(1) == [ONE]
        assert client.payloads(2) == [b"\x05\0\0\0"]
        await until(
            lambda: (
                "/t" in hub.graph.topics
                and set(hub.graph.topics["/t"].types) == {"std_msgs/String", "std_msgs/Int32"}
            )
        )


async def test_a_subscription_of_another_type_is_told_and_refused_by_the_publisher(core: RosCore) -> None:
    async with running_hub(core) as hub, node(core, "talker") as talker:
        client = FakeClient(hub)
        client.ask(Subscribe(1, "/t", "std_msgs/Int32"))  # before any publisher
        publisher = await talker.advertise("/t", STRING)
        await until(lambda: client.of(OtherType))
        assert client.of(OtherType) == [OtherType(1, "/t", "std_msgs/String")]
        await until(lambda: "/rmpa_web" in publisher.refusals)  # as of any node: "rmpa why" has it from there
        assert "std_msgs/Int32" in publisher.refusals["/rmpa_web"]
        other = FakeClient(hub)
        other.ask(Subscribe(1, "/t"))
        await publisher.wait_for_subscriber()
        publisher.publish_raw(ONE)
        await until(lambda: other.payloads(1) == [ONE])
        await publisher.close()
        publisher = await talker.advertise("/t", MessageType("std_msgs/Int32"))
        await until(lambda: publisher.subscribers)
        publisher.publish(publisher.make(7))
        await until(lambda: client.payloads(1) == [b"\x07\0\0\0"])
        assert len(client.of(OtherType)) == 1


async def test_what_a_client_publishes_reaches_nodes_and_other_clients(core: RosCore) -> None:
    async with running_hub(core) as hub, node(core, "echo") as echo:
        heard: list[bytes] = []
        await echo.subscribe("/t", callback=lambda message: heard.append(message.raw))
        await until(lambda: "/t" in hub.graph.topics)
        one, two = FakeClient(hub), FakeClient(hub)
        two.ask(Subscribe(1, "/t"))
        one.ask(AdvertiseTopic(1, "/t", "std_msgs/String"))
        one.ask(PublishMessage(1, ONE))  # at once, before any subscriber is connected
        await until(lambda: heard == [ONE])
        assert two.payloads(1) == [ONE]
        one.ask(PublishMessage(1, TWO))
        await until(lambda: heard == [ONE, TWO])
        assert two.payloads(1) == [ONE, TWO]


async def test_what_clients_publish_is_numbered_as_rospy_numbers_it(core: RosCore) -> None:
    async with running_hub(core) as hub, node(core, "echo") as echo:
        heard: list[int] = []
        await echo.subscribe("/points", callback=lambda message: heard.append(message.message.header.seq))
        await until(lambda: "/points" in hub.graph.topics)
        clients = [FakeClient(hub), FakeClient(hub)]
        listener = FakeClient(hub)
        listener.ask(Subscribe(1, "/points"))
        point = MessageType("geometry_msgs/PointStamped")
        for client in clients:  # they share one publisher, and the first message waits for its subscribers
            client.ask(AdvertiseTopic(1, "/points", point.name))
            client.ask(PublishMessage(1, point.serialize(point.make({"header": {"seq": 9}}))))
        await until(lambda: heard == [1, 2])
        clients[0].ask(PublishMessage(1, point.serialize(point.make())))
        await until(lambda: heard == [1, 2, 3])
        assert [point.deserialize(payload).header.seq for payload in listener.payloads(1)] == [1, 2, 3]


async def test_what_is_published_before_its_type_is_known_is_numbered_too(core: RosCore) -> None:
    async with running_hub(core) as hub, node(core, "other") as other:
        text = f"Header header\n{SEPARATOR}\nMSG: std_msgs/Header\n{known_text('std_msgs/Header')}"
        kind = MessageType.learn("my_msgs/Stamped", text)
        publisher = await other.advertise("/other", kind)
        await until(lambda: "/other" in hub.graph.topics)
        client = FakeClient(hub)
        client.ask(Subscribe(1, "/t"))
        client.ask(AdvertiseTopic(2, "/t", kind.name))
        for _ in range(2):
            client.ask(PublishMessage(2, kind.serialize(kind.make())))
        assert client.payloads(1) == []
        await until(lambda: len(client.payloads(1)) == 2)
        assert [kind.deserialize(payload).header.seq for payload in client.payloads(1)] == [1, 2]
        await publisher.close()


async def test_what_a_client_latches_reaches_late_nodes_and_clients(core: RosCore) -> None:
    async with running_hub(core) as hub, node(core, "echo") as echo:
        one, two = FakeClient(hub), FakeClient(hub)
        one.ask(AdvertiseTopic(1, "/t", "std_msgs/String", latch=True))
        one.ask(PublishMessage(1, ONE))
        await until(lambda: core.publishers("/t"))
        heard: list[bytes] = []
        await echo.subscribe("/t", callback=lambda message: heard.append(message.raw))
        await until(lambda: heard == [ONE])
        two.ask(Subscribe(1, "/t"))
        assert two.payloads(1) == [ONE]


async def test_clients_share_a_publisher_and_the_last_withdraws_it_after_a_while(
    core: RosCore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "UNADVERTISE_DELAY", 0.05)
    async with running_hub(core) as hub:
        one, two = FakeClient(hub), FakeClient(hub)
        one.ask(AdvertiseTopic(1, "/t", "std_msgs/String"))
        two.ask(AdvertiseTopic(1, "/t", "std_msgs/String"))
        await until(lambda: core.publishers("/t"))
        one.ask(UnadvertiseTopic(1))
        assert core.publishers("/t")
        began = time.monotonic()
        two.ask(UnadvertiseTopic(1))
        await until(lambda: not core.publishers("/t"))
        assert time.monotonic() - began >= 0.05


async def test_a_topic_that_is_advertised_again_in_time_stays_and_latches_as_it_is_told(
    core: RosCore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "UNADVERTISE_DELAY", DEADLINE)
    async with running_hub(core) as hub:
        client, listener = FakeClient(hub), FakeClient(hub)
        for handle, latch in ((1, True), (2, True), (3, False)):
            client.ask(AdvertiseTopic(handle, "/t", "std_msgs/String", latch=latch))
            await until(lambda: core.publishers("/t"))
            client.ask(PublishMessage(handle, ONE))
            client.ask(UnadvertiseTopic(handle))
            assert core.publishers("/t")
            listener.ask(Subscribe(handle, "/t"))
            assert listener.payloads(handle) == ([ONE] if latch else [])


async def test_another_type_of_a_published_topic_is_refused(core: RosCore) -> None:
    async with running_hub(core) as hub:
        one, two = FakeClient(hub), FakeClient(hub)
        one.ask(AdvertiseTopic(1, "/t", "std_msgs/String"))
        two.ask(AdvertiseTopic(1, "/t", "std_msgs/Int32"))
        failed = await two.failure(1)
        assert "publish /t as std_msgs/String, not std_msgs/Int32" in failed.error
        one.ask(AdvertiseTopic(2, "/u", "no_msgs/Such"))
        assert "no_msgs/Such" in (await one.failure(2)).error


async def test_a_node_that_was_shut_down_comes_back_with_everything(core: RosCore, monkeypatch: Any) -> None:
    monkeypatch.setattr("rmpa.web.limits.NODE_RETRY", 0.01)
    async with running_hub(core) as hub, node(core, "talker") as talker:
        publisher = await talker.advertise("/t", STRING)
        client = FakeClient(hub)
        client.ask(Subscribe(1, "/t"))
        client.ask(AdvertiseTopic(2, "/u", "std_msgs/String"))
        await publisher.wait_for_subscriber()
        await until(lambda: core.publishers("/u"))
        first = hub.link.node
        assert first is not None
        await first.close()
        await until(lambda: hub.link.node not in (None, first) and core.publishers("/u"))
        await until(lambda: publisher.subscribers == 1)
        publisher.publish_raw(ONE)
        await until(lambda: client.payloads(1) == [ONE])


# --- services ---


async def test_calls_share_a_connection_and_errors_are_told(core: RosCore) -> None:
    def serve(request: object) -> object:
        if not request.data:  # type: ignore[attr-defined]
            raise RmpaError("no")
        return {"success": True, "message": "yes"}

    async with running_hub(core) as hub, node(core, "server") as server:
        service = await server.advertise_service("/set", SET_BOOL, serve)
        # The first news of a service closes the connections to one that had its name before.
        await until(lambda: "/set" in hub.graph.services)
        client = FakeClient(hub)
        for handle in range(1, 4):
            client.ask(CallService(handle, "/set", SET_BOOL, b"\x01"))
            result = await client.answer(ServiceResult, handle)
            assert (result.ok, bytes(result.payload)) == (True, b"\x01\x03\0\0\0yes")
        assert len(service.endpoint._clients) == 1
        client.ask(CallService(4, "/set", SET_BOOL, b"\x00"))
        refused = await client.answer(ServiceResult, 4)
        assert not refused.ok
        assert "no" in refused.error
        client.ask(CallService(5, "/gone", SET_BOOL, b"\x01"))
        assert "/gone" in (await client.answer(ServiceResult, 5)).error
        client.ask(FindService(6, "/set"))
        assert (await client.answer(ServiceFound, 6)).type == SET_BOOL
        await until(lambda: "/set" in hub.graph.services and hub.graph.services["/set"].type == SET_BOOL)


async def test_a_client_that_goes_right_after_its_requests_leaves_no_coroutine_behind(core: RosCore) -> None:
    async with running_hub(core) as hub:
        client = FakeClient(hub)
        client.ask(GetParams(1))
        client.ask(FindService(2, "/rosout/get_loggers"))
        client.ask(CallService(3, "/rosout/get_loggers", None, b""))
        client.close()
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            for _ in range(3):
                await asyncio.sleep(0)
            gc.collect()
        assert not [str(each.message) for each in warned if each.category is RuntimeWarning]
        assert not client.answers


async def test_clients_that_leave_in_the_middle_of_their_calls_keep_no_connection_of_the_server(
    core: RosCore,
) -> None:
    asked = 0

    async def slow(_: Any) -> dict[str, object]:
        nonlocal asked
        asked += 1
        if asked <= limits.CALLS_AT_ONCE:
            await asyncio.Event().wait()
        return {"success": True, "message": "done"}

    async with running_hub(core) as hub, node(core, "server") as server:
        await server.advertise_service("/slow", SET_BOOL, slow)
        leaving, staying = FakeClient(hub), FakeClient(hub)
        for handle in range(1, limits.CALLS_AT_ONCE + 5):
            leaving.ask(CallService(handle, "/slow", SET_BOOL, b"\x01"))
        await until(lambda: asked == limits.CALLS_AT_ONCE)
        staying.ask(CallService(1, "/slow", SET_BOOL, b"\x01"))
        leaving.close()
        await until(lambda: staying.of(ServiceResult))
        assert staying.of(ServiceResult)[0].ok
        assert not leaving.answers
        assert asked == limits.CALLS_AT_ONCE + 1


async def test_a_call_ends_in_time(core: RosCore) -> None:
    async with running_hub(core) as hub, node(core, "server") as server:
        await server.advertise_service("/slow", SET_BOOL, lambda _: asyncio.sleep(DEADLINE))
        client = FakeClient(hub)
        client.ask(CallService(1, "/slow", SET_BOOL, b"\x01", timeout=0.05))
        result = await client.answer(ServiceResult, 1)
        assert not result.ok
        assert "no answer within 0.05 s" in result.error


async def test_a_client_serves_nodes_and_its_end_fails_the_open_call(core: RosCore) -> None:
    kind = ServiceType(SET_BOOL)
    async with running_hub(core) as hub, node(core, "caller") as caller:
        client = FakeClient(hub)
        client.ask(ServeService(1, "/served", SET_BOOL))
        await until(lambda: "/served" in hub.graph.services)
        calling = asyncio.ensure_future(caller.call_service("/served", kind, {"data": True}))
        await until(lambda: client.of(ServiceRequest))
        asked = client.of(ServiceRequest)[0]
        assert (asked.handle, bytes(asked.payload)) == (1, b"\x01")
        client.ask(Respond(1, asked.call, ok=True, response=b"\x01\x02\0\0\0ok"))
        assert (await calling).message == "ok"
        second = asyncio.ensure_future(caller.call_service("/served", kind, {"data": True}))
        await until(lambda: len(client.of(ServiceRequest)) == 2)
        client.ask(EndService(1))
        error = (await asyncio.gather(second, return_exceptions=True))[0]
        assert "has ended it" in str(error)
        await until(lambda: "/served" not in hub.graph.services)


async def test_the_newest_client_that_offers_a_service_has_it(core: RosCore) -> None:
    """As with rosbridge_suite: the client before it may have gone without a word, and connects again."""
    kind = ServiceType(SET_BOOL)
    async with running_hub(core) as hub, node(core, "caller") as caller:
        old, new = FakeClient(hub), FakeClient(hub)
        old.ask(ServeService(1, "/set", SET_BOOL))
        await until(lambda: core.state().services.get("/set"))
        calling = asyncio.ensure_future(caller.call_service("/set", kind, {"data": True}))
        await until(lambda: old.of(ServiceRequest))
        new.ask(ServeService(1, "/set", SET_BOOL))
        assert (await old.failure(1)).error == "another client offers /set now"
        with pytest.raises(RmpaError, match="has ended it"):
            await calling
        old.close()  # it takes nothing with it

        async def call() -> Any:
            while True:
                with contextlib.suppress(RmpaError):  # while it is registered anew
                    return await caller.call_service("/set", kind, {"data": True})

        calling = asyncio.ensure_future(call())
        await until(lambda: new.of(ServiceRequest))
        new.ask(Respond(1, new.of(ServiceRequest)[0].call, ok=True, response=b"\x01\0\0\0\0"))
        assert (await calling).success
        assert len(old.of(ServiceRequest)) == 1


# --- parameters, graph, types ---


async def test_changes_of_parameters_are_told_to_followers(core: RosCore) -> None:
    async with running_hub(core) as hub, node(core, "other") as other:
        client, follower = FakeClient(hub), FakeClient(hub)
        follower.ask(FollowParams(1))
        follower.ask(FollowParams(2, ("/a/x",)))
        client.ask(SetParam(1, "/a", {"x": 1, "y": "two"}))
        assert (await client.answer(ParamsChanged, 1)).values == {"/a": {"x": 1, "y": "two"}}
        assert follower.of(ParamsChanged, 1)[-1].values == {"/a/x": 1, "/a/y": "two"}
        assert follower.of(ParamsChanged, 2)[-1].values == {"/a/x": 1}
        await other.set_param("/a/x", 5)
        await until(lambda: follower.of(ParamsChanged, 2)[-1].values == {"/a/x": 5})
        client.ask(GetParams(2))
        assert {"/a/x": 5, "/a/y": "two"}.items() <= (await client.answer(ParamsChanged, 2)).values.items()
        client.ask(DeleteParam(3, "/a"))
        await client.answer(ParamsChanged, 3)
        assert follower.of(ParamsChanged, 1)[-1].values == {"/a/x": None, "/a/y": None}
        client.ask(DeleteParam(4, "/a"))
        assert "/a" in (await client.failure(4)).error


async def test_a_new_topic_is_seen_soon(core: RosCore) -> None:
    async with running_hub(core) as hub, node(core, "talker") as talker:
        client = FakeClient(hub)
        client.ask(FollowGraph(1))
        assert client.of(GraphChanged)
        await talker.advertise("/new", STRING)
        await until(lambda: any(topic.name == "/new" for topic in client.graph().topics))
        (topic,) = [topic for topic in client.graph().topics if topic.name == "/new"]
        assert (topic.types, topic.publishers) == (("std_msgs/String",), ("/talker",))
        assert "/talker" in hub.graph.nodes


async def test_a_type_that_only_a_publisher_knows_is_described(core: RosCore) -> None:
    kind = MessageType.learn("my_msgs/Pair", "int32 a\nint32 b\n")
    async with running_hub(core) as hub, node(core, "talker") as talker:
        client = FakeClient(hub)
        client.ask(DescribeType(1, "std_msgs/String"))
        assert "string data" in (await client.answer(Described, 1)).text
        client.ask(DescribeType(2, "std_srvs/SetBool", service=True))
        described = await client.answer(Described, 2)
        assert "bool data" in described.text
        assert "bool success" in described.response
        client.ask(DescribeType(3, "my_msgs/Pair"))
        await client.failure(3)
        publisher = await talker.advertise("/pair", kind)
        client.ask(Subscribe(4, "/pair"))
        await publisher.wait_for_subscriber()
        publisher.publish(kind.make({"a": 1, "b": 2}))
        await until(lambda: client.of(Described, 3))
        assert client.of(Described, 3)[0].text == kind.definition


async def test_clock_gives_the_time_where_the_parameter_says_so(core: RosCore) -> None:
    async with running_hub(core) as hub, node(core, "gazebo") as gazebo:
        assert abs(hub.time.now_ns() - time.time_ns()) < DEADLINE * 1e9
        clock = await gazebo.advertise("/clock", "rosgraph_msgs/Clock")
        await gazebo.set_param("/use_sim_time", True)
        await clock.wait_for_subscriber()
        clock.publish_raw(b"\x07\0\0\0\x05\0\0\0")
        await until(lambda: hub.time.now_ns() == 7_000_000_005)
        await gazebo.set_param("/use_sim_time", False)
        await until(lambda: hub.time.now_ns() > 10**18)


# --- rights ---


async def test_a_read_only_client_changes_nothing(core: RosCore) -> None:
    async with running_hub(core) as hub:
        client = FakeClient(hub, READ_ONLY)
        asked: list[Any] = [
            AdvertiseTopic(1, "/t", "std_msgs/String"),
            CallService(2, "/set", SET_BOOL, b"\x01"),
            ServeService(3, "/s", SET_BOOL),
            SetParam(4, "/p", 1),
            DeleteParam(5, "/p"),
            GetParams(6),
            FollowParams(7),
        ]
        for request in asked:
            client.ask(request)
            failed = client.of(type(await client.failure(request.handle)), request.handle)[0]
            assert "may not" in failed.error
            reads = isinstance(request, GetParams | FollowParams)
            assert failed.remedy == (READ_REMEDY if reads else CONTROL_REMEDY)
        client.ask(PublishMessage(1, ONE))
        assert not core.publishers("/t")

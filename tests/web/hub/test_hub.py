"""A hub with its node at a ROS core, other nodes, and clients without a protocol."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable
from typing import Any

import pytest

from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node
from rmpa.ros.types.definitions import SEPARATOR, known_text, parse_definition
from rmpa.ros.types.installed import ServiceType
from rmpa.ros.types.messages import MessageType
from rmpa.web import limits
from rmpa.web.hub.hub import Hub
from rmpa.web.hub.node_link import CONTROL_REMEDY, READ_ONLY, READ_REMEDY
from tests.ros.node.peers import LATCHED, STRING
from tests.waiting import DEADLINE, until
from tests.web.hub.client import FakeClient, listen, node, running_hub

ONE, TWO = b"\x03\0\0\0one", b"\x03\0\0\0two"
SET_BOOL = "std_srvs/SetBool"


@pytest.fixture
def client(hub: Hub) -> FakeClient:
    return FakeClient(hub)


# --- topics ---


async def test_all_clients_share_one_subscription_and_one_payload(hub: Hub, talker: Node) -> None:
    publisher = await talker.advertise("/t", STRING)
    first, second = (FakeClient(hub).hear("/t") for _ in range(2))
    await publisher.wait_for_subscriber()
    publisher.publish_raw(ONE)
    await until(lambda: first.messages and second.messages)
    assert publisher.subscribers == 1
    (message,) = first.messages
    assert message is second.messages[0]
    assert (message.topic, message.type, bytes(message.payload)) == ("/t", "std_msgs/String", ONE)
    assert abs(message.stamp_ns - time.time_ns()) < DEADLINE * 1e9


async def test_beyond_a_bound_only_topics_with_a_publisher_are_subscribed_to(
    hub: Hub, talker: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "SUBSCRIBED_TOPICS_MAX", 3)
    publisher = await talker.advertise("/t", STRING)
    client, other = FakeClient(hub), FakeClient(hub)
    await until(lambda: "/t" in hub.graph.topics and hub.graph.topics["/t"].publishers)
    for number in range(3):
        client.hear(f"/none{number}")
    with pytest.raises(PeerRefused, match="/none4 has no publisher"):
        client.hear("/none4")
    other.hear("/none1")
    other.hear("/t")
    await publisher.wait_for_subscriber()


async def test_a_storm_of_subscriptions_leaves_nothing_registered(
    hub: Hub, client: FakeClient, talker: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "SUBSCRIPTION_LINGER", 0.0)
    publisher = await talker.advertise("/t", STRING)
    for number in range(1, 300):
        heard = client.hear("/t" if number % 2 else f"/none{number}")
        out = client.talk("/out", latch=bool(number % 2))
        if number % 3:
            await asyncio.sleep(0)
        heard.close()
        out.close()
    last = client.hear("/t")
    await publisher.wait_for_subscriber()
    publisher.publish_raw(ONE)
    await until(lambda: last.payloads == [ONE])
    last.close()

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
        early = FakeClient(hub).hear("/map")
        await until(lambda: len(early.payloads) == 2)
        late = FakeClient(hub).hear("/map")
        await until(lambda: sorted(late.payloads) == [ONE, TWO])
        assert sorted(early.payloads) == [ONE, TWO]


async def test_a_latched_message_that_comes_again_is_not_delivered_twice(hub: Hub, talker: Node) -> None:
    publisher = await talker.advertise("/map", LATCHED, latch=True)
    publisher.publish_raw(ONE)
    heard = FakeClient(hub).hear("/map")
    await until(lambda: heard.payloads)
    assert publisher.publication.hang_up("/rmpa_web")
    await until(lambda: publisher.subscribers == 1)
    publisher.publish_raw(TWO)
    await until(lambda: heard.payloads[-1] == TWO)
    publisher.publish_raw(TWO)  # the same again, over the same connection, is news
    await until(lambda: len(heard.payloads) == 3)
    assert heard.payloads == [ONE, TWO, TWO]


async def test_a_client_that_fails_costs_the_others_no_message(hub: Hub, talker: Node) -> None:
    publisher = await talker.advertise("/t", STRING)

    def fail(_: object) -> None:
        raise ValueError("a fault of a session")

    broken = FakeClient(hub)
    broken.subscribe("/t", None, fail, fail)
    heard = FakeClient(hub).hear("/t")
    await publisher.wait_for_subscriber()
    publisher.publish_raw(ONE)
    await until(lambda: heard.payloads == [ONE])


async def test_what_waits_too_long_for_the_core_is_not_sent(
    hub: Hub, client: FakeClient, talker: Node, core: RosCore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "EARLY_AGE", 0.0)  # all that waits for the registration is too old
    heard, states = await listen(talker, "/cmd"), await listen(talker, "/state")
    command = client.talk("/cmd")
    command.publish(ONE)
    client.talk("/state", latch=True).publish(TWO)
    await until(lambda: states == [TWO])  # the last state counts, however old it is
    await until(lambda: core.publishers("/cmd"))
    while not heard:
        command.publish(b"\x05\0\0\0three")
        await asyncio.sleep(0.01)
    assert ONE not in heard


async def test_a_publisher_that_has_gone_leaves_no_latched_message(hub: Hub, talker: Node) -> None:
    publisher = await talker.advertise("/map", LATCHED, latch=True)
    publisher.publish_raw(ONE)
    early, client = FakeClient(hub).hear("/map"), FakeClient(hub)
    await until(lambda: early.payloads)
    await publisher.close()
    async with asyncio.timeout(DEADLINE):
        while True:
            late = client.hear("/map")
            await asyncio.sleep(0.01)
            if not late.payloads:
                return


async def test_two_types_and_two_versions_of_one_are_told_apart(hub: Hub, client: FakeClient, core: RosCore) -> None:
    old, new = (
        MessageType("std_msgs/Int32", parse_definition("std_msgs/Int32", f"{t} a")) for t in ("int8", "int32")
    )
    texts, numbers, all_ = (client.hear("/t", kind) for kind in ("std_msgs/String", "std_msgs/Int32", None))
    async with node(core, "a") as a, node(core, "b") as b, node(core, "c") as c:
        for talker, kind, payload in ((a, STRING, ONE), (b, old, b"\x05"), (c, new, b"\x06\0\0\0")):
            publisher = await talker.advertise("/t", kind)
            await publisher.wait_for_subscriber()
            publisher.publish_raw(payload)
        await until(lambda: len(all_.payloads) == 3)
        assert texts.payloads == [ONE]
        assert [(each.md5sum, bytes(each.payload)) for each in numbers.messages] == [
            (old.md5sum, b"\x05"), (new.md5sum, b"\x06\0\0\0")
        ]  # fmt: skip
        for kind in (old, new):
            assert (await hub.types.find_message(kind.name, kind.md5sum)).definition == kind.definition
        await until(lambda: "/t" in hub.graph.topics)
        await until(lambda: set(hub.graph.topics["/t"].types) == {"std_msgs/String", "std_msgs/Int32"})


async def test_a_subscription_of_another_type_is_told_and_refused_by_the_publisher(hub: Hub, talker: Node) -> None:
    heard = FakeClient(hub).hear("/t", "std_msgs/Int32")  # before any publisher
    publisher = await talker.advertise("/t", STRING)
    await until(lambda: heard.others)
    assert heard.others == ["std_msgs/String"]
    await until(lambda: "/rmpa_web" in publisher.refusals)  # as of any node: "rmpa why" has it from there
    assert "std_msgs/Int32" in publisher.refusals["/rmpa_web"]
    other = FakeClient(hub).hear("/t")
    await publisher.wait_for_subscriber()
    publisher.publish_raw(ONE)
    await until(lambda: other.payloads == [ONE])
    await publisher.close()
    publisher = await talker.advertise("/t", MessageType("std_msgs/Int32"))
    await until(lambda: publisher.subscribers)
    publisher.publish(publisher.make(7))
    await until(lambda: heard.payloads == [b"\x07\0\0\0"])
    assert len(heard.others) == 1


async def test_what_clients_publish_is_numbered_as_rospy_numbers_it(hub: Hub, talker: Node) -> None:
    heard: list[int] = []
    await talker.subscribe("/points", callback=lambda message: heard.append(message.message.header.seq))
    await until(lambda: "/points" in hub.graph.topics)
    listener = FakeClient(hub).hear("/points")
    point = MessageType("geometry_msgs/PointStamped")
    outs = [FakeClient(hub).talk("/points", point.name) for _ in range(2)]
    for out in outs:  # they share one publisher, and the first message waits for its subscribers
        out.publish(point.serialize(point.make({"header": {"seq": 9}})))
    await until(lambda: heard == [1, 2])
    outs[0].publish(point.serialize(point.make()))
    await until(lambda: heard == [1, 2, 3])
    assert [point.deserialize(payload).header.seq for payload in listener.payloads] == [1, 2, 3]


async def test_what_comes_before_its_type_is_known_is_numbered_too(
    hub: Hub, client: FakeClient, talker: Node
) -> None:
    text = f"Header header\n{SEPARATOR}\nMSG: std_msgs/Header\n{known_text('std_msgs/Header')}"
    kind = MessageType.learn("my_msgs/Stamped", text)
    publisher = await talker.advertise("/other", kind)
    await until(lambda: "/other" in hub.graph.topics)
    heard, out = client.hear("/t"), client.talk("/t", kind.name)
    for _ in range(2):
        out.publish(kind.serialize(kind.make()))
    assert heard.payloads == []
    await until(lambda: len(heard.payloads) == 2)
    assert [kind.deserialize(payload).header.seq for payload in heard.payloads] == [1, 2]
    await publisher.close()


async def test_what_a_client_latches_reaches_late_nodes_and_clients(hub: Hub, talker: Node, core: RosCore) -> None:
    FakeClient(hub).talk("/t", latch=True).publish(ONE)
    await until(lambda: core.publishers("/t"))
    heard = await listen(talker, "/t")
    await until(lambda: heard == [ONE])
    late = FakeClient(hub).hear("/t")
    await until(lambda: late.payloads == [ONE])


async def test_a_topic_that_is_advertised_again_in_time_stays_and_latches_as_it_is_told(
    hub: Hub, core: RosCore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "UNADVERTISE_DELAY", DEADLINE)
    client, listener = FakeClient(hub), FakeClient(hub)
    for latch in (True, True, False):
        out = client.talk("/t", latch=latch)
        await until(lambda: core.publishers("/t"))
        out.publish(ONE)
        out.close()
        assert core.publishers("/t")
        heard = listener.hear("/t")
        await asyncio.sleep(0)
        assert heard.payloads == ([ONE] if latch else [])


async def test_another_type_of_a_published_topic_is_refused(hub: Hub) -> None:
    one = FakeClient(hub)
    one.talk("/t")
    with pytest.raises(PeerRefused, match="publish /t as std_msgs/String, not std_msgs/Int32"):
        FakeClient(hub).talk("/t", "std_msgs/Int32")
    refused = one.talk("/u", "no_msgs/Such")
    await until(lambda: one.errors)
    assert "no_msgs/Such" in str(one.errors[0])
    heard = one.hear("/u")
    FakeClient(hub).talk("/u")
    refused.publish(ONE)  # it has ended: nothing of it goes to the publisher of another client
    await asyncio.sleep(0)
    assert heard.payloads == []


async def test_a_node_that_was_shut_down_comes_back_with_everything(
    hub: Hub, client: FakeClient, talker: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "NODE_RETRY", 0.05)
    publisher = await talker.advertise("/t", STRING)
    came = await listen(talker, "/cmd_vel")
    heard, out = client.hear("/t"), client.talk("/cmd_vel")
    await publisher.wait_for_subscriber()
    out.publish(ONE)
    await until(lambda: came == [ONE])
    first = hub.link.node
    assert first is not None
    await first.close()
    await until(lambda: hub.link.node is not first)
    out.publish(TWO)  # such as the stop of a robot
    await until(lambda: came == [ONE, TWO])
    await until(lambda: publisher.subscribers == 1)
    publisher.publish_raw(ONE)
    await until(lambda: heard.payloads == [ONE])


# --- services ---


async def test_calls_share_a_connection_and_errors_are_told(hub: Hub, client: FakeClient, talker: Node) -> None:
    def serve(request: object) -> object:
        if not request.data:  # type: ignore[attr-defined]
            raise RmpaError("no")
        return {"success": True, "message": "yes"}

    service = await talker.advertise_service("/set", SET_BOOL, serve)
    # The first news of a service closes the connections to one that had its name before.
    await until(lambda: "/set" in hub.graph.services)
    for _ in range(3):
        assert bytes(await client.call("/set", SET_BOOL, b"\x01")) == b"\x01\x03\0\0\0yes"
    assert len(service.endpoint._clients) == 1
    with pytest.raises(RmpaError, match="no"):
        await client.call("/set", SET_BOOL, b"\x00")
    with pytest.raises(RmpaError, match="/gone"):
        await client.call("/gone", SET_BOOL, b"\x01")
    assert await client.find_service("/set") == SET_BOOL
    assert hub.graph.services["/set"].type == SET_BOOL


async def test_clients_that_leave_in_the_middle_of_their_calls_keep_no_connection_of_the_server(
    hub: Hub,
    talker: Node,
) -> None:
    asked = 0

    async def slow(_: Any) -> dict[str, object]:
        nonlocal asked
        asked += 1
        if asked <= limits.CALLS_AT_ONCE:
            await asyncio.Event().wait()
        return {"success": True, "message": "done"}

    await talker.advertise_service("/slow", SET_BOOL, slow)
    leaving, staying = FakeClient(hub), FakeClient(hub)
    for _ in range(limits.CALLS_AT_ONCE + 4):
        leaving.start(leaving.call("/slow", SET_BOOL, b"\x01"))
    await until(lambda: asked == limits.CALLS_AT_ONCE)
    staying.start(staying.call("/slow", SET_BOOL, b"\x01"))
    leaving.close()
    await until(lambda: staying.results)
    assert not leaving.results
    assert not leaving.errors
    assert asked == limits.CALLS_AT_ONCE + 1


async def test_a_call_ends_in_time(hub: Hub, talker: Node) -> None:
    await talker.advertise_service("/slow", SET_BOOL, lambda _: asyncio.sleep(DEADLINE))
    with pytest.raises(RmpaError, match=r"no answer within 0\.05 s"):
        await FakeClient(hub).call("/slow", SET_BOOL, b"\x01", timeout=0.05)


async def test_the_newest_client_that_offers_a_service_has_it(hub: Hub, talker: Node, core: RosCore) -> None:
    """As with rosbridge_suite: the client before it may have gone without a word, and connects again."""
    kind = ServiceType(SET_BOOL)
    old, new = FakeClient(hub), FakeClient(hub)
    asked: dict[FakeClient, list[Any]] = {old: [], new: []}

    def serve(client: FakeClient) -> None:
        client.serve("/set", SET_BOOL, lambda *call: asked[client].append(call), client.errors.append)

    serve(old)
    await until(lambda: core.state().services.get("/set"))
    calling = asyncio.ensure_future(talker.call_service("/set", kind, {"data": True}))
    await until(lambda: asked[old])
    serve(new)
    assert [str(each) for each in old.errors] == ["another client offers /set now"]
    with pytest.raises(RmpaError, match="has ended it"):
        await calling
    old.close()  # it takes nothing with it

    async def call() -> Any:
        while True:
            with contextlib.suppress(RmpaError):  # while it is registered anew
                return await talker.call_service("/set", kind, {"data": True})

    calling = asyncio.ensure_future(call())
    await until(lambda: asked[new])
    asked[new][0][1].set_result(b"\x01\0\0\0\0")
    assert (await calling).success
    assert len(asked[old]) == 1
    new.close()
    await until(lambda: not core.state().services.get("/set"))


# --- parameters, graph, types ---


async def test_changes_of_parameters_are_told_to_followers(hub: Hub, client: FakeClient, talker: Node) -> None:
    all_: list[Any] = []
    one: list[Any] = []
    kept = client.follow_params((), all_.append), client.follow_params(("/a/x",), one.append)
    await client.set_param("/a", {"x": 1, "y": "two"})
    assert (all_[-1], one[-1]) == ({"/a/x": 1, "/a/y": "two"}, {"/a/x": 1})
    await talker.set_param("/a/x", 5)
    await until(lambda: one[-1] == {"/a/x": 5})
    assert {"/a/x": 5, "/a/y": "two"}.items() <= (await client.get_params()).items()
    kept[1].close()
    await client.delete_param("/a")
    assert (all_[-1], one[-1]) == ({"/a/x": None, "/a/y": None}, {"/a/x": 5})
    with pytest.raises(RmpaError, match="/a"):
        await client.delete_param("/a")
    client.close()
    await FakeClient(hub).set_param("/b", 1)
    assert "/b" not in all_[-1]


async def test_a_type_that_only_a_publisher_knows_is_learnt(hub: Hub, talker: Node) -> None:
    kind = MessageType.learn("my_msgs/Pair", "int32 a\nint32 b\n")
    learnt: list[str] = []
    hub.types.on_learnt = lambda found: learnt.append(found.definition)
    assert "string data" in (await hub.types.find_message("std_msgs/String")).definition
    assert "bool success" in (await hub.types.find_service("std_srvs/SetBool")).response.definition
    with pytest.raises(RmpaError):
        await hub.types.find_message("my_msgs/Pair")
    publisher = await talker.advertise("/pair", kind)
    FakeClient(hub).hear("/pair")
    await publisher.wait_for_subscriber()
    publisher.publish(kind.make({"a": 1, "b": 2}))
    await until(lambda: kind.definition in learnt)


async def test_clock_gives_the_time_where_the_parameter_says_so(hub: Hub, talker: Node) -> None:
    assert abs(hub.time.now_ns() - time.time_ns()) < DEADLINE * 1e9
    clock = await talker.advertise("/clock", "rosgraph_msgs/Clock")
    await talker.set_param("/use_sim_time", True)
    await clock.wait_for_subscriber()
    clock.publish_raw(b"\x07\0\0\0\x05\0\0\0")
    await until(lambda: hub.time.now_ns() == 7_000_000_005)
    await talker.set_param("/use_sim_time", False)
    await until(lambda: hub.time.now_ns() > 10**18)


# --- rights ---


@pytest.mark.parametrize(
    ("act", "remedy"),
    [
        (lambda client: client.talk("/t"), CONTROL_REMEDY),
        (lambda client: client.call("/set", SET_BOOL, b"\x01"), CONTROL_REMEDY),
        (lambda client: client.serve("/s", SET_BOOL, print, print), CONTROL_REMEDY),
        (lambda client: client.set_param("/p", 1), CONTROL_REMEDY),
        (lambda client: client.delete_param("/p"), CONTROL_REMEDY),
        (lambda client: client.get_params(), READ_REMEDY),
        (lambda client: client.follow_params((), print), READ_REMEDY),
        (lambda client: client.fetch_asset("package://a/b", 10), READ_REMEDY),
    ],
)
async def test_a_read_only_client_changes_nothing(hub: Hub, act: Callable[[FakeClient], Any], remedy: str) -> None:
    with pytest.raises(PeerRefused, match="may not") as refused:
        await act(FakeClient(hub, READ_ONLY))
    assert refused.value.remedy == remedy

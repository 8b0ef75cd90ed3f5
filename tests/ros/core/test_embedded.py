from __future__ import annotations

import asyncio
import uuid
from collections.abc import AsyncIterator
from typing import Final, Self

import pytest

from rmpa.core.errors import StartError
from rmpa.ros import limits
from rmpa.ros.core import liveness
from rmpa.ros.core.embedded import AGGREGATED, LOG, RosCore
from rmpa.ros.http.rpc import call, call_api
from rmpa.ros.node import ask
from rmpa.ros.node.publication import Publication
from rmpa.ros.node.slave_node import SlaveNode, Subscription
from rmpa.ros.wire.tcpros import TopicDescription, frame_message
from rmpa.ros.wire.xmlrpc import RosFault, XmlRpcValue
from rmpa.runtime.accept import Use
from tests.ros.core.slaves import Slave
from tests.waiting import DEADLINE, until

STRING: Final = "std_msgs/String"


def waiting(core: RosCore) -> int:
    """Notifications in the queues."""
    return sum(map(len, core._notifier._queues.values()))


@pytest.fixture
async def core() -> AsyncIterator[RosCore]:
    made = RosCore(port=0, rosout=False)
    await made.start()
    yield made
    await made.close()


@pytest.mark.trap(35)
async def test_it_answers_as_roscore_does(core: RosCore) -> None:
    assert core.uri == f"http://127.0.0.1:{core.port}/"
    assert await call_api(core.uri, "getUri", "/x") == (1, "", core.uri)
    run_id = (await call_api(core.uri, "getParam", "/x", "/run_id")).value
    assert isinstance(run_id, str)
    assert uuid.UUID(run_id).version == 1
    assert core.call("getParam", "/x", "/rosdistro").value == "noetic\n"
    assert core.call("getParam", "/x", "/rosversion").value == "1.15.15\n"


async def test_it_listens_on_loopback_only(core: RosCore) -> None:
    acceptor = core._server._acceptor
    assert acceptor is not None
    assert acceptor.address[0] == "127.0.0.1"


async def test_a_port_in_use(core: RosCore) -> None:
    with pytest.raises(StartError, match=f"port {core.port} is already in use"):
        await RosCore(port=core.port).start()


@pytest.mark.trap(31)
async def test_notifications_never_wait_in_the_reply_and_one_goes_at_a_time(core: RosCore) -> None:
    """A node that holds its lock while it registers would wait for itself."""
    async with Slave() as slow, Slave() as quick:
        slow.go.clear()
        for slave, name in ((slow, "/slow"), (quick, "/quick")):
            core.call("registerSubscriber", name, "/t", STRING, slave.uri)
        for number in range(1, 6):
            await call(core.uri, "registerPublisher", f"/p{number}", "/t", STRING, f"http://127.0.0.1:{number}/")
        await until(lambda: bool(quick.calls) and len(quick.calls[-1][1][2]) == 5)  # type: ignore[arg-type]
        await until(lambda: bool(slow.calls))
        assert len(slow.calls) == 1
        slow.go.set()
        await until(lambda: len(slow.calls) == 2)
        assert slow.calls[-1][1][2] == [f"http://127.0.0.1:{number}/" for number in range(1, 6)]
        assert slow.most_at_once == 1


async def test_silent_node_is_notified_again(core: RosCore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "TCPROS_CONNECT_TIMEOUT", 0.5)
    async with Slave() as slave:
        slave.go.clear()
        core.call("registerSubscriber", "/s", "/t", STRING, slave.uri)
        core.call("registerPublisher", "/p", "/t", STRING, "http://127.0.0.1:1/")
        await until(lambda: len(slave.calls) >= 2)
        slave.go.set()
        await until(lambda: core.counters["notify.sent"] == 1)
        await until(lambda: waiting(core) == 0)


async def test_what_waits_for_a_slow_node_is_bounded(core: RosCore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "NOTIFY_QUEUE_MAX", 100)
    async with Slave() as slave:
        slave.go.clear()
        core.call("subscribeParam", "/s", slave.uri, "/")
        for number in range(1000):
            core.call("setParam", "/x", f"/p{number}", number)
        assert waiting(core) == 100
        assert core.counters["notify.dropped"] == 900


@pytest.mark.trap(33)
async def test_a_twin_pushes_the_older_node_out(core: RosCore) -> None:
    async with Slave("/twin") as old:
        core.call("registerPublisher", "/twin", "/t", STRING, old.uri)
        core.call("registerPublisher", "/twin", "/t", STRING, "http://127.0.0.1:1/")
        await until(lambda: bool(old.calls))
        assert old.calls == [
            ("shutdown", ["/master", "[/twin] Reason: new node registered with same name"]),
        ]


@pytest.mark.parametrize(
    ("says", "registered", "ends"), [("/innocent", "", False), ("", "/innocent", False), ("", "", True)]
)
async def test_another_node_at_a_stale_uri_is_not_shut_down(
    core: RosCore, says: str, registered: str, ends: bool
) -> None:
    """ros_comm#2018, #2241: the port belongs to somebody else by now, as it says or the master knows."""
    async with Slave(says) as there:
        core.call("registerPublisher", "/twin", "/t", STRING, there.uri)
        if registered:
            core.call("registerPublisher", registered, "/u", STRING, there.uri)
        core.call("registerPublisher", "/twin", "/t", STRING, "http://127.0.0.1:1/")
        await until(lambda: there.calls or core.counters["notify.stale"])
        assert [method for method, _ in there.calls] == ["shutdown"] * ends


@pytest.mark.trap(29)
async def test_node_without_get_name_is_identified_by_its_header(monkeypatch: pytest.MonkeyPatch) -> None:
    node = SlaveNode("/like_roscpp", "127.0.0.1", "http://127.0.0.1:11311/")
    await node.start()
    node.add_publication(Publication("/rosout", "/like_roscpp", TopicDescription(LOG.type, LOG.md5sum, "")))

    async def no_get_name(uri: str, method: str, *params: XmlRpcValue, timeout: float = 3.0, use: Use) -> object:
        if method == "getName":
            raise RosFault(-1, "getName: unknown method name")
        return await call_api(uri, method, *params, timeout=timeout, use=use)

    monkeypatch.setattr(ask, "call_api", no_get_name)
    assert await ask.name_at(node.uri, ["/t"]) == "/like_roscpp"
    await node.close()


async def test_a_dead_node_is_purged_when_suspected(core: RosCore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rmpa.ros.core.liveness.NODE_RECHECK_DELAY", 0.01)
    async with Slave() as subscriber:
        async with Slave() as dead:
            core.call("registerPublisher", "/dead", "/t", STRING, dead.uri)
        core.call("registerSubscriber", "/s", "/t", STRING, subscriber.uri)
        core.suspect("/dead")
        core.suspect("/dead")
        core.suspect("/nobody")
        await until(lambda: bool(subscriber.calls))
        assert subscriber.calls == [("publisherUpdate", ["/master", "/t", []])]
        assert core.state().nodes == {"/s": subscriber.uri}
        assert core.counters["node.dead"] == 1
        assert [node for node, _ in core.liveness.died] == ["/dead"]


def lists_of(slave: Slave) -> list[XmlRpcValue]:
    """The lists of publishers that a slave was told."""
    return [publishers for _, publishers in slave.updates]


@pytest.mark.trap(16)
async def test_a_publisher_that_is_soon_back_is_told_twice(core: RosCore, monkeypatch: pytest.MonkeyPatch) -> None:
    """rospy takes itself for connected while it has not read the end of its old connection."""
    monkeypatch.setattr("rmpa.ros.core.embedded.PUBLISHERS_AGAIN", 0.05)
    uri = "http://127.0.0.1:1/"
    async with Slave() as subscriber:
        core.call("registerSubscriber", "/s", "/t", STRING, subscriber.uri)
        core.call("registerPublisher", "/p", "/t", STRING, uri)
        await until(lambda: lists_of(subscriber) == [[uri]])
        core.call("unregisterPublisher", "/p", "/t", uri)
        await until(lambda: lists_of(subscriber) == [[uri], []])
        core.call("registerPublisher", "/p", "/t", STRING, uri)
        await until(lambda: lists_of(subscriber) == [[uri], [], [uri], [uri]])


async def test_withdrawn_publishers_are_forgotten(core: RosCore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rmpa.ros.core.embedded.WITHDRAWN_KEPT", 10)
    for number in range(100):
        core.call("registerPublisher", "/p", f"/t{number}", STRING, "http://127.0.0.1:1/")
        core.call("unregisterPublisher", "/p", f"/t{number}", "http://127.0.0.1:1/")
    assert len(core._withdrawn) == 10


async def test_a_node_that_came_back_meanwhile_is_not_purged(core: RosCore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rmpa.ros.core.liveness.NODE_RECHECK_DELAY", 0.05)
    async with Slave() as dead:
        core.call("registerPublisher", "/n", "/t", STRING, dead.uri)
    async with Slave() as again:
        core.suspect("/n")
        core.call("registerPublisher", "/n", "/t", STRING, again.uri)
        await until(lambda: not core.liveness._checks)
        assert core.state().nodes == {"/n": again.uri}


@pytest.mark.trap(40)
async def test_dead_nodes_are_found_without_a_hint(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "NODE_CHECK_INTERVAL", 0.05)
    nodes = {"/odd": "rosrpc://x"}
    found: list[str] = []
    alive_calls = 0

    def on_dead(node: str, _api: str) -> None:
        found.append(node)
        del nodes[node]

    async with Slave() as alive:
        async with Slave() as dead:
            nodes.update({"/dead": dead.uri, "/alive": alive.uri})
        watch = liveness.Liveness(nodes=lambda: dict(nodes), on_dead=on_dead)
        watch.start()
        await until(lambda: found == ["/dead"])
        alive_calls = len(alive.server._connections)
        await watch.close()
    assert alive_calls == 0, "a node that listens is not knocked at"
    assert nodes.keys() == {"/odd", "/alive"}


async def test_a_client_can_end_it() -> None:
    reasons: list[str] = []
    core = RosCore(port=0, rosout=False, on_shutdown=reasons.append)
    await core.start()
    assert await call_api(core.uri, "shutdown", "/x", "enough") == (1, "the core ends", 0)
    assert reasons == ["/x: 'enough'"]
    await core.close()


class Logs:
    """A node that logs, and one that reads what is aggregated, following the core as ROS nodes do."""

    def __init__(self, core: RosCore) -> None:
        self.core = core
        self.heard: list[bytes] = []
        self.speaker = SlaveNode("/speaker", "127.0.0.1", core.uri)
        self.reader = SlaveNode("/reader", "127.0.0.1", core.uri)
        self.log = Publication("/rosout", "/speaker", TopicDescription(LOG.type, LOG.md5sum, "any"))
        self.aggregated = Subscription(
            AGGREGATED, self.reader, on_message=lambda _, framed: self.heard.append(bytes(framed))
        )

    async def __aenter__(self) -> Self:
        await self.speaker.start()
        await self.reader.start()
        self.speaker.add_publication(self.log)
        self.core.call("registerPublisher", "/speaker", "/rosout", LOG.type, self.speaker.uri)
        self.reader.add_subscription(self.aggregated)
        uris = self.core.call("registerSubscriber", "/reader", AGGREGATED, LOG.type, self.reader.uri).value
        assert isinstance(uris, list)
        self.aggregated.update([str(uri) for uri in uris])
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.reader.close()
        await self.speaker.close()

    async def flow(self, text: bytes) -> None:
        """Wait until a log message comes out at the other end."""
        async with asyncio.timeout(DEADLINE):
            while frame_message(text) not in self.heard:
                self.log.publish_framed(frame_message(text))
                await asyncio.sleep(0.005)


@pytest.fixture
async def whole(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[RosCore]:
    """A core with its /rosout, which comes back soon."""
    monkeypatch.setattr(limits, "ROSOUT_RESPAWN", 0.01)
    monkeypatch.setattr("rmpa.ros.core.embedded.ROSOUT_LOOK", 0.01)
    made = RosCore(port=0)
    await made.start()
    yield made
    await made.close()


def rosout_at(core: RosCore) -> str:
    """The slave API of whatever publishes /rosout_agg; empty for nothing."""
    return core.publishers(AGGREGATED).get("/rosout", "")


@pytest.mark.parametrize("killed", [True, False])
async def test_a_killed_or_unregistered_rosout_comes_back(whole: RosCore, killed: bool) -> None:
    async with Logs(whole) as logs:
        assert whole.call("getPublishedTopics", "/x", "").value == [[AGGREGATED, LOG.type], ["/rosout", LOG.type]]
        await logs.flow(b"before")
        before = rosout_at(whole)
        if killed:
            assert await call_api(before, "shutdown", "/rosnode", "user request") == (1, "shutdown", 0)
        else:
            assert whole.call("unregisterSubscriber", "/rosout", "/rosout", before).value == 1
        await until(lambda: rosout_at(whole) not in {"", before})
        await logs.flow(b"after")
        assert whole.counters["rosout.restarted"] == 1
        services = [name for name in whole.state().services if name.startswith("/rosout/")]
        assert sorted(services) == ["/rosout/get_loggers", "/rosout/set_logger_level"]
    await whole.close()
    assert whole.state().nodes.keys() <= {"/speaker", "/reader"}


async def test_rosout_yields_its_name_and_takes_it_back(whole: RosCore) -> None:
    async with Slave("/rosout") as other, Logs(whole) as logs:
        first = rosout_at(whole)
        whole.call("registerPublisher", "/rosout", AGGREGATED, LOG.type, other.uri)
        whole.call("subscribeParam", "/rosout", other.uri, "/p")
        assert rosout_at(whole) == other.uri
        await until(lambda: whole._rosout is not None and not whole._rosout.uri)
        for _ in range(20):
            await asyncio.sleep(0.01)
            assert rosout_at(whole) == other.uri, "the name is the other node's as long as that is there"
        whole.call("unregisterPublisher", "/rosout", AGGREGATED, other.uri)
        assert whole._api.registrations.node_api("/rosout") == other.uri
        whole.call("unsubscribeParam", "/rosout", other.uri, "/p")
        await until(lambda: rosout_at(whole) not in {"", first, other.uri})
        await logs.flow(b"back")
        assert not [name for name, _ in other.calls if name == "shutdown"]


@pytest.mark.parametrize("error", [StartError("node /rosout", "no file descriptor is left"), RuntimeError("a fault")])
async def test_rosout_starts_when_it_can(whole: RosCore, monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    start, failures = SlaveNode.start, 0

    async def fails_twice(node: SlaveNode) -> None:
        nonlocal failures
        failures += 1
        if failures < 3:
            raise error
        await start(node)

    monkeypatch.setattr(SlaveNode, "start", fails_twice)
    killed = rosout_at(whole)
    await call_api(killed, "shutdown", "/rosnode", "user request")
    await until(lambda: rosout_at(whole) not in {"", killed})
    assert failures == 3


async def test_a_core_ends_while_another_rosout_has_the_name(whole: RosCore) -> None:
    async with Slave("/rosout") as other:
        whole.call("registerSubscriber", "/rosout", "/rosout", LOG.type, other.uri)
        assert whole.state().nodes == {"/rosout": other.uri}
        await until(lambda: whole._rosout is not None and not whole._rosout.uri)
        await whole.close()
        assert whole.state().nodes == {"/rosout": other.uri}, "our late unregisters do not hit it"


@pytest.mark.trap(26)
async def test_services_are_looked_up_at_once_whatever_else_waits(core: RosCore) -> None:
    async with Slave() as stopped:
        stopped.go.clear()
        core.call("registerSubscriber", "/s", "/t", STRING, stopped.uri)
        core.call("registerPublisher", "/p", "/t", STRING, "http://127.0.0.1:1/")
        await until(lambda: bool(stopped.calls))
        await call(core.uri, "registerService", "/p", "/add", "rosrpc://127.0.0.1:5/", "http://127.0.0.1:1/")
        assert (await call_api(core.uri, "lookupService", "/c", "/add"))[::2] == (1, "rosrpc://127.0.0.1:5/")
        assert (await call_api(core.uri, "lookupService", "/c", "/none"))[::2] == (-1, "")
        assert stopped.at_once == 1, "the notification still waits"


@pytest.mark.trap(29)
async def test_no_connection_to_a_node_is_kept_open(core: RosCore) -> None:
    async with Slave() as slave:
        core.call("registerSubscriber", "/s", "/t", STRING, slave.uri)
        for number in range(1, 9):
            core.call("registerPublisher", f"/p{number}", "/t", STRING, f"http://127.0.0.1:{number}/")
            await until(lambda wanted=number: len(slave.calls) == wanted)  # type: ignore[misc]
        await until(lambda: core.counters["notify.sent"] == 8)
        await until(lambda: not slave.server._connections)


async def test_the_log_has_one_line_a_second_of_all_changes(
    core: RosCore, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("rmpa.ros.core.external._GRAPH_LINE", 0.05)

    def said() -> list[str]:
        return [record.getMessage() for record in caplog.records if record.levelname == "INFO"]

    caplog.set_level("INFO")
    api = "http://127.0.0.1:1/"
    for number in range(7):
        core.call("registerPublisher", f"/once_{number}", "/t", STRING, api)
        core.call("unregisterPublisher", f"/once_{number}", "/t", api)
    await until(lambda: bool(said()))
    text = "= 7 registrations more, 7 less, of 7 nodes: /once_0, /once_1, /once_2, /once_3, /once_4, …"
    assert said() == [text]
    caplog.clear()
    core.call("registerPublisher", "/p", "/t", STRING, api)
    await until(lambda: bool(said()))
    assert said() == ["= + publisher /t of /p"]

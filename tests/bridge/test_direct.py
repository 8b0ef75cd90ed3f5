from __future__ import annotations

import asyncio
import json
import re
import socket
from collections.abc import AsyncIterator, Awaitable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest

import rmpa
from rmpa.bridge import limits
from rmpa.bridge.direct.grants import NodePorts, ServiceGrants, end_all, grant_at
from rmpa.bridge.direct.paths import (
    Condition,
    DirectAsk,
    Grant,
    Unmet,
    Want,
    read_ask,
    read_reply,
    reply_of,
)
from rmpa.bridge.topics.direct import bus_links, end_link, publisher_update, standing
from rmpa.config import limits as config_limits
from rmpa.core.contract import Contract, Transport
from rmpa.core.errors import RemoteProtocolError
from rmpa.ros.node.publication import Publication, PublicationEvents
from rmpa.ros.node.slave_node import SlaveNode, Subscription
from rmpa.ros.wire.xmlrpc import RosReply
from rmpa.runtime import kernel_tcp
from rmpa.runtime.kernel_tcp import connections, may_end_connections
from tests.ros.node.peers import STRING
from tests.runtime.capabilities import NET_ADMIN, without
from tests.waiting import until

# The conditions of direct transport, and the response of a peer: a port or a reason, whatever else it says.


GRANT, PLAIN = Grant(45225, "/talker", "/talker/get_loggers"), Grant(45225, "/talker")


@pytest.mark.parametrize(
    ("value", "found"),
    [
        ({"port": 45225, "probe": "/talker/get_loggers"}, GRANT),
        ({"why": "listening", "text": "loopback"}, Unmet(Condition.LISTENING, "loopback")),
        ({"port": 45225, "address": "10.0.0.9", "host": "10.0.0.9", "uri": "http://10.0.0.9/"}, PLAIN),
        *(
            ({"port": 45225, "probe": probe}, PLAIN)
            for probe in ("no_slash", "/a\r\nb", "/" + "x" * 5000, "/a b", "\x00")
        ),
    ],
)
def test_a_response_is_a_port_or_a_reason_and_no_address_nor_a_probe_that_is_no_name(
    value: dict[str, Any], found: Grant | Unmet
) -> None:
    assert read_reply(value, "/talker") == found
    assert found is PLAIN or reply_of(found) == value


@pytest.mark.parametrize(
    "value",
    [
        None, [], "45225", {}, {"port": 0}, {"port": 65536}, {"port": -1}, {"port": 1 << 200}, {"port": "45225"},
        {"port": True}, {"port": 45225.0}, {"port": None}, {"port": 45225, "probe": 7}, {"why": 7},
        {"why": "node", "text": None},
    ],
)  # fmt: skip
def test_what_is_neither_a_port_nor_a_reason_is_refused(value: object) -> None:
    with pytest.raises(RemoteProtocolError):
        read_reply(value, "/talker")


def test_a_reason_is_safe_to_show_and_one_of_a_later_release_is_known_as_such() -> None:
    unmet = read_reply({"why": "quantum", "text": "a\x1b[2Jb\n" + "x" * 1000}, "/talker")
    assert isinstance(unmet, Unmet)
    assert unmet.condition is Condition.RELEASE
    assert unmet.text.isprintable()
    assert len(unmet.text) <= 300


# The arguments of requests about direct transport: golden, malformed, and any that can be written.


WANT = Want("/chatter", "/talker", "/viewer")


def test_a_request_carries_the_whole_contract_and_no_address() -> None:
    asked = DirectAsk(*WANT, Contract(transport=Transport.AUTO))
    written = msgspec.to_builtins(asked)
    assert set(written) == {"name", "node", "user", "contract"}
    assert written["contract"]["transport"] == "auto"
    assert read_ask(json.loads(json.dumps(written))) == asked
    assert msgspec.to_builtins(DirectAsk("/add", "/adder")) == {"name": "/add", "node": "/adder"}


BAD: list[dict[str, Any]] = [
    {"name": "chatter"}, {"name": "/a//b"}, {"name": "/a\n"}, {"name": "/\x1b[2J"},
    {"name": "/" + "x" * config_limits.CROSSING_NAME_MAX}, {"name": 3}, {"name": None}, {"node": ["/talker"]},
    {"node": ""}, {"user": "viewer"}, {"user": {"a": 1}},
]  # fmt: skip


@pytest.mark.parametrize("change", BAD)
def test_what_is_malformed_is_refused_with_a_text_safe_to_log(change: dict[str, Any]) -> None:
    with pytest.raises(RemoteProtocolError) as caught:
        read_ask(msgspec.to_builtins(DirectAsk(*WANT, Contract())) | change)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 1000
    with pytest.raises(RemoteProtocolError):
        read_ask({})


@pytest.mark.parametrize(
    "contract", [{"depth": 0}, {"depth": 1 << 40}, {"max_rate": -1.0}, {"transport": "udp"}, {"outage": 1e9}, 5]
)
def test_a_contract_that_no_rule_can_make_is_refused(contract: object) -> None:
    with pytest.raises(RemoteProtocolError):
        read_ask(WANT._asdict() | {"contract": contract})


# docs/guides/direct-transport.md lists every condition of direct transport, by the word that the commands show.


DOCUMENT = Path(__file__).parents[2] / "docs" / "guides" / "direct-transport.md"


def _first_column(section: str) -> list[str]:
    text = DOCUMENT.read_text("utf-8").partition(section)[2].partition("\n#")[0]
    return re.findall(r"(?m)^\| `(\w+)` \|", text)


def test_every_condition_and_transport_is_documented() -> None:
    assert sorted(_first_column("## When it is relayed all the same")) == sorted(Condition)
    assert sorted(_first_column("# Direct transport")) == sorted(Transport)


# docs/design/introspection.md lists every counter of direct transport.


COUNTERS_PAGE = Path(__file__).parents[2] / "docs" / "design" / "introspection.md"


COUNTED = re.compile(r'(?:counters\.add|_on_warning|\.warn)\("(direct\.\w+)"')


"""A counter where it counts; a warning is counted by its kind."""


def test_every_counter_is_documented() -> None:
    counted = {
        name
        for file in Path(rmpa.__path__[0], "bridge").rglob("*.py")
        for name in COUNTED.findall(file.read_text(encoding="utf-8"))
    }
    rows = re.findall(r"(?m)^\| (`direct\.[^|]*) \|", COUNTERS_PAGE.read_text(encoding="utf-8"))
    documented = [name for row in rows for name in re.findall(r"`(direct\.\w+)`", row)]
    assert sorted(documented) == sorted(counted)


# Where a local node may be reached by a peer: asked of real slave nodes, and of the kernel.


def seen_at(own_address: str) -> Any:
    """A peer that reaches this module at an address."""
    return SimpleNamespace(peer=1, own_address=own_address)


class Talker(PublicationEvents):
    """A node that publishes /t, and the endpoints of its module."""

    def __init__(self, host: str = "127.0.0.1") -> None:
        self.node = SlaveNode("/talker", host, "")
        self.asked: list[str] = []
        self.answer: RosReply | None = None
        self.node.add_publication(Publication("/t", "/talker", STRING, events=self))
        self.ports = NodePorts()

    def request(self, caller: str) -> Awaitable[RosReply | None]:
        self.asked.append(caller)

        async def reply() -> RosReply | None:
            return self.answer

        return reply()

    @property
    def port(self) -> int:
        address = self.node.address_of("/t")
        assert address is not None
        return address[1]

    async def find(self, own_address: str = "127.0.0.1") -> Grant | Unmet:
        port = await self.ports.find("/talker", self.node.uri, "/t")
        return port if isinstance(port, Unmet) else grant_at(seen_at(own_address), "/talker", port, "")


@pytest.fixture
async def talker() -> AsyncIterator[Talker]:
    made = Talker()
    await made.node.start()
    yield made
    await made.ports.close()
    await made.node.close()


def condition(found: Grant | Unmet) -> Condition:
    assert isinstance(found, Unmet), found
    return found.condition


async def test_a_node_on_loopback_is_not_granted_to_another_machine(talker: Talker) -> None:
    found = await talker.find("10.88.0.1")
    assert condition(found) is Condition.LISTENING
    assert "loopback only: start it without ROS_IP" in str(found)


async def test_several_questions_at_a_time_become_one_and_the_answer_is_known_for_a_while(talker: Talker) -> None:
    found = await asyncio.gather(*(talker.find() for _ in range(20)))
    assert found == [Grant(talker.port, "/talker", "")] * 20
    assert talker.asked == ["/rmpa"]
    await talker.find()
    assert len(talker.asked) == 1
    talker.ports.forget(talker.node.uri)
    await talker.find()
    assert len(talker.asked) == 2


@pytest.mark.parametrize(
    "answer",
    [
        RosReply(0, "not now", []), RosReply(1, "", []), RosReply(1, "", ["TCPROS", "127.0.0.1"]),
        RosReply(1, "", ["UDPROS", "127.0.0.1", 45225]), RosReply(1, "", ["TCPROS", "127.0.0.1", 0]),
        RosReply(1, "", ["TCPROS", "127.0.0.1", 65536]), RosReply(1, "", ["TCPROS", "127.0.0.1", "45225"]),
        RosReply(1, "", ["TCPROS", "127.0.0.1", True]), RosReply(1, "x" * 10_000, "TCPROS"),
    ],
)  # fmt: skip
async def test_a_node_that_answers_with_something_else_is_named(talker: Talker, answer: RosReply) -> None:
    talker.answer = answer
    found = await talker.find()
    assert condition(found) is Condition.NODE
    assert len(str(found)) < 500


async def test_a_port_at_which_nothing_listens_any_more_is_not_granted(talker: Talker) -> None:
    talker.answer = RosReply(1, "", ["TCPROS", "127.0.0.1", 1])
    assert condition(await talker.find()) is Condition.LISTENING


async def test_a_dead_node_is_a_passing_reason(talker: Talker) -> None:
    uri = talker.node.uri
    await talker.node.close()
    found = await talker.ports.find("/talker", uri, "/t")
    assert isinstance(found, Unmet)
    assert (found.condition, found.lasting) == (Condition.NODE, False)


async def test_the_answers_of_many_nodes_are_remembered_within_a_bound(
    talker: Talker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "DIRECT_MAX", 3)
    for number in range(20):
        # The same node by other texts of its URI.
        await talker.ports.find("/talker", talker.node.uri + "x" * number, "/t")
    assert len(talker.ports._ports) <= 3


@pytest.mark.parametrize(
    ("uri", "wanted"),
    [
        ("rosrpc://127.0.0.1:{port}", None), ("rosrpc://127.0.0.1:{port}/", None),
        ("rosrpc://127.0.0.1:1", Condition.LISTENING), ("rosrpc://127.0.0.1:0", Condition.NODE),
        ("rosrpc://127.0.0.1:65536", Condition.NODE), ("rosrpc://127.0.0.1:²", Condition.NODE),
        ("rosrpc://127.0.0.1:" + "9" * 5000, Condition.NODE), ("http://127.0.0.1:{port}", Condition.NODE),
        ("", Condition.NODE),
    ],
)  # fmt: skip
async def test_the_port_of_a_service_is_that_of_its_uri(talker: Talker, uri: str, wanted: Condition | None) -> None:
    offered = {"/talker/add": SimpleNamespace(uri=uri.format(port=talker.port))}
    rpc = SimpleNamespace(on_request=lambda *_: None, on_notification=lambda *_: None)
    shared, exports = SimpleNamespace(rpc=rpc), SimpleNamespace(offered=offered)
    grants = ServiceGrants(cast("Any", shared), cast("Any", exports), lambda *_: None)
    found = await grants._find(seen_at("127.0.0.1"), Want("/talker/add", "/talker"))
    if wanted is None:
        assert found == Grant(talker.port, "/talker", "/talker/add")
    else:
        assert condition(found) is wanted


# Calls to nodes and to the kernel: whom a subscriber is connected to, and the end of that connection alone.


needs_right = pytest.mark.skipif(bool(may_end_connections()), reason="this process may not end connections")


class Pair:
    """A subscriber of /t and its publisher."""

    def __init__(self) -> None:
        self.talker = SlaveNode("/talker", "127.0.0.1", "")
        self.viewer = SlaveNode("/viewer", "127.0.0.1", "")
        self.publication = Publication("/t", "/talker", STRING)

    @property
    def endpoint(self) -> tuple[str, int]:
        found = self.talker.address_of("/t")
        assert found is not None
        return found

    @property
    def ports(self) -> set[int]:
        return standing(self.endpoint[0]).get(self.endpoint[1], set())


@pytest.fixture
async def pair() -> AsyncIterator[Pair]:
    made = Pair()
    await made.talker.start()
    await made.viewer.start()
    made.talker.add_publication(made.publication)
    made.viewer.add_subscription(Subscription("/t", made.viewer, on_message=lambda *_: None))
    assert await publisher_update(made.viewer.uri, "/t", [made.talker.uri])
    await until(lambda: made.publication.listeners)
    yield made
    await made.viewer.close()
    await made.talker.close()


async def test_a_subscriber_says_its_connection_and_the_kernel_too(pair: Pair) -> None:
    links = await bus_links(pair.viewer.uri, "/t")
    assert links is not None
    (link,) = links
    assert (link.connected, link.remote) == (True, pair.endpoint)
    assert pair.ports == {link.local_port}
    assert await bus_links(pair.viewer.uri, "/other") == []
    assert await bus_links(pair.talker.uri, "/t") == [], "its own connections are outbound"


async def test_a_node_that_does_not_answer_is_told_from_one_without_connections(pair: Pair) -> None:
    uri = pair.viewer.uri
    await pair.viewer.close()
    assert await bus_links(uri, "/t") is None
    assert not await publisher_update(uri, "/t", [])


@needs_right
async def test_the_connection_of_one_subscriber_ends_and_those_of_others_stay(pair: Pair) -> None:
    with socket.create_connection(pair.endpoint) as other:
        links = await bus_links(pair.viewer.uri, "/t")
        (mine,) = {link.local_port for link in links or ()}
        assert [await end_link(link) for link in links or ()] == [""]
        assert mine not in pair.ports
        assert other.getsockname()[1] in pair.ports, "of another program"
        assert [await end_link(link) for link in links or ()] == [""], "there is none any more"


@needs_right
async def test_a_publishers_connections_to_one_address_end(pair: Pair) -> None:
    assert end_all(connections(local_port=pair.endpoint[1], remote=("127.0.0.2", None))) == ""
    assert pair.publication.listeners == ("/viewer",)
    assert end_all(connections(local_port=pair.endpoint[1], remote=("127.0.0.1", None))) == ""
    await until(lambda: "/viewer" not in pair.publication.listeners or not pair.ports)


async def test_without_the_right_the_reason_is_told(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    # As where the kernel (Yama) lets no process copy another one's descriptors.
    monkeypatch.setattr(kernel_tcp, "_disconnect", lambda _: False)
    ports = pair.ports
    assert ports
    if may_end_connections():
        problem = end_all(connections(remote=pair.endpoint))
    else:
        problem = await asyncio.to_thread(without, NET_ADMIN, lambda: end_all(connections(remote=pair.endpoint)))
    assert "not permitted" in problem
    assert pair.ports == ports

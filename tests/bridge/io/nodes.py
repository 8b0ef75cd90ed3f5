"""The local graph around a bridge without a socket: master, proxies' nodes, publishers and subscribers.

Each message says who published it and its number, and is filled by these, so that what a listener got tells by itself
what was lost, doubled, changed in order, mixed or torn.
"""

from __future__ import annotations

import asyncio
import itertools
from collections import defaultdict, deque
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, ClassVar, Final, cast

from rmpa.core import limits as core_limits
from rmpa.core.outbox import QueuedMessage
from rmpa.ros import limits as ros_limits
from rmpa.ros.master.parameters import GraphChange, RegistrationKind

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from rmpa.ros.core.liveness import Unreachable
    from rmpa.ros.node.publication import Publication
    from tests.bridge.io.two_bridges import Side, World

MD5: Final = "5a9ea5f83505693b71e785041e67a8bb"


stages: Final[list[World]] = []
"""The world that runs is the last one."""


def payload(speaker: int, number: int, size: int) -> bytes:
    """A message, its length in front."""
    text = b"%d:%d:" % (speaker, number)
    body = text + bytes([(speaker * 31 + number) & 0xFF]) * max(0, size - len(text))
    return len(body).to_bytes(4, "little") + body


def read(framed: bytes) -> tuple[int, int]:
    """Who published a message, and its number; it is exactly what was published."""
    speaker, number, _ = framed[4:].split(b":", 2)
    found = int(speaker), int(number)
    assert framed == payload(*found, len(framed) - 4), "not what was published"
    return found


class Core:
    """A master with nothing around it."""

    node_host = node_address = "127.0.0.1"

    def __init__(self, side: Side) -> None:
        self.uri = f"http://core-{side.name}/"
        self._side = side
        self._topics: dict[str, dict[str, str]] = {}
        self._types: dict[str, str] = {}
        self._callbacks: list[Callable[[GraphChange], None]] = []

    def on_change(self, callback: Callable[[GraphChange], None]) -> None:
        """As RosCore's."""
        self._callbacks.append(callback)

    def on_log(self, _callback: object) -> bool:
        """As RosCore's; nothing is logged."""
        return True

    def publishers(self, topic: str) -> Mapping[str, str]:
        """As RosCore's."""
        return dict(self._topics.get(topic, {}))

    def subscribers(self, topic: str) -> Mapping[str, str]:
        """As RosCore's."""
        found: Mapping[str, str] = self.state().subscribers.get(topic, {})
        return found

    def type_of(self, topic: str, _node: str = "") -> str:
        """As RosCore's."""
        return self._types.get(topic, "*")

    def state(self) -> Any:
        """As RosCore's, as far as it is asked for."""
        subscribers = {listener.topic: {"/listener": ""} for listener in self._side.listeners}
        publishers = {topic: dict(nodes) for topic, nodes in self._topics.items()}
        return SimpleNamespace(publishers=publishers, subscribers=subscribers)

    def unreachable(self) -> Mapping[str, Unreachable]:
        """As RosCore's."""
        return {}

    def suspect(self, node: str) -> None:
        """As RosCore's; nobody dies silently here."""

    def call(self, method: str, *params: Any) -> tuple[int, str, int]:
        """Register and unregister publishers; the rest of a master is of no interest here."""
        if method == "registerPublisher":
            node, topic, type_name, uri = params
            self._topics.setdefault(topic, {})[node] = uri
            self._types[topic] = type_name
            self._tell(GraphChange(RegistrationKind.PUBLISHER, True, topic, node, uri, type_name))
        elif method == "unregisterPublisher":
            node, topic, uri = params
            if self._topics.get(topic, {}).get(node) == uri:
                del self._topics[topic][node]
                if not self._topics[topic]:
                    del self._topics[topic]
                self._tell(GraphChange(RegistrationKind.PUBLISHER, False, topic, node, uri))
        return 1, "", 1

    def _tell(self, change: GraphChange) -> None:
        for callback in self._callbacks:
            callback(change)
        self._side.named(change.name)


class Node:
    """A slave node without sockets: the agent's own, or a proxy."""

    numbers: ClassVar[Iterator[int]] = itertools.count()

    def __init__(self, name: str, _host: str, _master: str, **_: object) -> None:
        self.name = name
        self.uri = f"http://node-{next(Node.numbers)}/"
        self.open: dict[str, Publication] = {}

    async def start(self) -> None:
        """Take a moment, as sockets do."""
        await asyncio.sleep(0.001)

    async def close(self) -> None:
        """Likewise."""
        for topic in list(self.open):
            self.remove_publication(topic)
        await asyncio.sleep(0.001)

    def next_number(self) -> int:
        """As SlaveNode's."""
        return next(Node.numbers)

    def publication(self, topic: str) -> Publication | None:
        """As SlaveNode's."""
        return self.open.get(topic)

    def add_publication(self, publication: Publication) -> None:
        """As SlaveNode's."""
        self.open[publication.topic] = publication

    def remove_publication(self, topic: str) -> None:
        """As SlaveNode's."""
        self.open.pop(topic).withdraw()


@dataclass(eq=False)
class Speaker:
    """A local node that publishes one topic.

    Args:
        side: Where.
        number: Whose messages they are; each run of a node has its own.
        topic: Which.
        node: Its name.
        latching: Whether it latches.
        greets: As which it says one thing to each new connection alone.
        greeting: How long that is.
    """

    side: Side
    number: int
    topic: str
    node: str
    latching: bool
    uri: str = ""
    said: int = 0
    connections: list[PublisherConnection] = field(default_factory=list)
    last: bytes | None = None
    greets: Speaker | None = None
    greeting: int = 0

    def say(self, size: int) -> None:
        """Publish one more message."""
        self.said += 1
        self.last = payload(self.number, self.said, size)
        for connection in self.connections:
            connection.take(self.last)


class PublisherConnection:
    """The agent's subscription to a speaker; large messages come in parts, with time between them."""

    def __init__(
        self,
        topic: str,
        uri: str,
        _caller_id: str,
        *,
        on_message: Callable[[memoryview], None],
        on_parts: Any = None,
        on_header: Callable[[Mapping[str, str]], None] = lambda _: None,
        on_refused: Callable[[str], None],
        on_lost: Callable[[str], None],
        on_oversized: Callable[[int], None] = lambda _: None,
        number: int,
        find: object,
    ) -> None:
        self.topic, self.uri, self.number = topic, uri, number
        self._on_message, self._parts, self._on_header, self._on_lost = on_message, on_parts, on_header, on_lost
        self._on_oversized = on_oversized
        self._loop = asyncio.get_running_loop()
        self._queue: deque[bytes] = deque()
        self.malformed = False
        self._rest: memoryview | None = None
        self._speaker: Speaker | None = None
        self._busy = False
        self._closed = False

    def start(self) -> None:
        """Connect, in a moment."""
        self._loop.call_later(stages[-1].rng.uniform(0, 0.01), self._connect)

    def _connect(self) -> None:
        if self._closed:
            return
        self._speaker = stages[-1].speaker_at(self.uri)
        if self._speaker is None:
            self._on_lost("nobody is there")
            return
        self._speaker.connections.append(self)
        self._on_header(
            {
                "type": "a/B",
                "md5sum": MD5,
                "message_definition": "",
                "latching": str(int(self._speaker.latching)),
                "callerid": self._speaker.node,
            }
        )
        if self._speaker.latching and self._speaker.last is not None and not self._closed:
            self.take(self._speaker.last)
        if (greeter := self._speaker.greets) is not None:
            greeter.said += 1
            self.take(payload(greeter.number, greeter.said, self._speaker.greeting))

    def take(self, framed: bytes) -> None:
        """The speaker has said something."""
        if len(framed) - 4 > ros_limits.TCPROS_MESSAGE_MAX:
            self._on_oversized(len(framed) - 4)
            return
        self._queue.append(framed)
        if not self._busy:
            self._go_on()

    def _go_on(self) -> None:
        self._busy = False
        while not self._closed and (self._rest is not None or self._queue):
            if self._rest is None:
                framed = self._queue.popleft()
                if len(framed) <= core_limits.CUT_THROUGH_BYTES or self._parts is None:
                    self._on_message(memoryview(bytearray(framed)))
                    continue
                self._rest = memoryview(framed)
                self._parts.begin(len(framed))
            count = min(len(self._rest), stages[-1].rng.choice([4, 100, 400, 10_000]))
            part, self._rest = self._rest[:count], self._rest[count:] or None
            self._parts.part(memoryview(bytearray(part)))
            self._busy = True
            self._loop.call_later(0.001, self._go_on)
            return

    def lose(self, reason: str) -> None:
        """The speaker has died."""
        self._drop()
        if not self._closed:
            self._on_lost(reason)

    def close(self) -> None:
        """Leave."""
        self._closed = True
        self._drop()

    def _drop(self) -> None:
        self._queue.clear()
        if self._rest is not None:
            self._rest = None
            self._parts.abort()
        if self._speaker is not None and self in self._speaker.connections:
            self._speaker.connections.remove(self)


class Ear:
    """One connection of a listener to one publication; stands in for an accepted TCPROS connection."""

    number = 0
    info = ""
    caller_id = "/ear"
    peer = ("127.0.0.1", 1)
    dropped = pending_bytes = bytes_out = since = 0

    def __init__(self, listener: Listener, publication: Publication) -> None:
        self.request = {"topic": publication.topic, "callerid": self.caller_id, "md5sum": "*", "type": "*"}
        self.publication = publication
        self.closed = False
        self.on_end: Callable[[object, Exception | None], None] = lambda *_: None
        self._listener = listener
        self._parcel: QueuedMessage | None = None
        self._half = bytearray()

    def accept(self, *_: object) -> None:
        """The header came."""

    def bound(self, *_: object) -> None:
        """Never slow."""

    def refuse(self, text: str) -> None:
        """Nobody is refused here."""
        raise AssertionError(text)

    def send(self, parts: tuple[bytes | bytearray | memoryview], _key: int) -> int:
        """A message came."""
        assert not self._half, "a message in the middle of another one"
        self._listener.heard(self, bytes(parts[0]))
        return 0

    def open(self, _key: int, size: int) -> QueuedMessage:
        """A message begins."""
        assert not self._half, "a message in the middle of another one"
        self._parcel = QueuedMessage(0, size)
        return self._parcel

    def extend(self, parcel: QueuedMessage, part: bytes | bytearray | memoryview) -> int:
        """A part came."""
        if self.closed:
            return 0
        assert parcel is self._parcel
        self._half += part
        if len(self._half) == parcel.size:
            whole, self._half = bytes(self._half), bytearray()
            self._listener.heard(self, whole)
        return 0

    def abandon(self, parcel: QueuedMessage) -> bool:
        """The rest will not come; whether we have a part."""
        assert parcel is self._parcel
        return bool(self._half)

    def hang_up(self, *, drain: bool = False) -> None:
        """We were hung up on."""
        self.closed = True
        self._listener.ears.pop(self.publication, None)

    def leave(self) -> None:
        """We hang up."""
        self.closed = True
        self.on_end(self, None)


@dataclass(eq=False)
class Listener:
    """A local node that subscribes to one topic; it connects to every publication that the master names."""

    side: Side
    topic: str
    ears: dict[Publication, Ear] = field(default_factory=dict)
    got: defaultdict[int, list[tuple[Ear, int]]] = field(default_factory=lambda: defaultdict(list))
    """By speaker: by which connection which message came."""

    def heard(self, ear: Ear, framed: bytes) -> None:
        """A message came."""
        speaker, number = read(framed)
        before = self.got[speaker]
        again = stages[-1].keeps(speaker)
        if before and before[-1][0] is ear:
            last = before[-1][1]
            assert number > last or (again and number <= last), f"message {number} of {speaker} behind {last}"
        before.append((ear, number))

    def connect(self) -> None:
        """Look for publications that we have no connection with."""
        for publication in self.side.publications(self.topic):
            if publication not in self.ears:
                ear = self.ears[publication] = Ear(self, publication)
                publication.attach(cast("Any", ear))

    def leave(self) -> None:
        """Listen no more."""
        ears, self.ears = self.ears, {}
        for ear in ears.values():
            ear.leave()

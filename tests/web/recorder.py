"""What a session is tested with: a hub and a connection that write down its calls, and give what the test says."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from concurrent.futures import Future
from types import SimpleNamespace
from typing import Any

import cbor2
import msgspec

from rmpa.core.errors import RmpaError
from rmpa.ros.types.codec import MessageCodec, codec_for
from rmpa.ros.types.installed import ServiceType
from rmpa.ros.types.messages import MessageType
from rmpa.web.hub.connection import ClientStream
from rmpa.web.hub.frame_writer import FairQueue, Opcode, OutFrame
from rmpa.web.hub.graph import GraphService, GraphTopic
from rmpa.web.hub.hub import HubClient
from rmpa.web.hub.node_link import EVERYTHING
from rmpa.web.hub.topics import MadeOnce, ReceivedMessage
from rmpa.web.hub.transforms import TransformTree

NOW_NS = 1_700_000_000_000_000_123


class Asked(SimpleNamespace):
    """One call of a session: its name and arguments, and what the test does with it."""

    what: str
    published: list[bytes]
    receive: Callable[[ReceivedMessage], None]
    differs: Callable[[str], None]
    done: Callable[[Any], None]
    failed: Callable[[RmpaError], None]

    def __init__(self, what: str, **arguments: Any) -> None:
        super().__init__(what=what, closed=False, published=[], reason="", **arguments)

    def close(self, reason: str = "") -> None:
        self.__dict__.update(closed=True, reason=reason)

    def publish(self, payload: Any) -> None:
        self.published.append(bytes(payload))

    def message(self, payload: bytes | memoryview, type_: str = "std_msgs/String", md5sum: str = "") -> None:
        """Let the hub have a message for this subscription."""
        view = payload if isinstance(payload, memoryview) else memoryview(payload)
        self.receive(ReceivedMessage(self.topic, type_, view, NOW_NS, "/talker", md5sum))


class Graph:
    """The graph, as the test makes it up."""

    def __init__(self) -> None:
        self.topics: dict[str, GraphTopic] = {}
        self.services: dict[str, GraphService] = {}
        self.nodes: tuple[str, ...] = ()
        self.found: dict[str, str] = {}
        self.searched: list[str] = []
        self.changed: Callable[[], None] = lambda: None

    def add_topic(self, name: str, *types: str, publishers: Any = (), subscribers: Any = ()) -> None:
        self.topics[name] = GraphTopic(name, types, publishers, subscribers)

    def add_service(self, name: str, kind: str, provider: str = "/server", uri: str = "rosrpc://robot:1234") -> None:
        self.services[name] = GraphService(name, kind, (provider,), uri)

    def show(self, *entries: GraphTopic | GraphService) -> None:
        """The graph is this from now on."""
        self.topics = {each.name: each for each in entries if isinstance(each, GraphTopic)}
        self.services = {each.name: each for each in entries if isinstance(each, GraphService)}
        self.changed()

    def follow(self, changed: Callable[[], None]) -> Asked:
        self.changed = changed
        changed()
        return Asked("follow")

    async def find(self, name: str) -> str:
        self.searched.append(name)
        if name not in self.found:
            raise RmpaError(f"no service {name}")
        self._say(name)
        return self.found[name]

    async def find_all(self) -> None:
        for name in self.found:
            self._say(name)

    def _say(self, name: str) -> None:
        known = self.services.get(name)
        if known is not None:
            self.services[name] = msgspec.structs.replace(known, type=self.found[name])
            self.changed()


class Types:
    """The definitions that rmpa brings; others are learnt when the test says so."""

    def __init__(self) -> None:
        self.missing: dict[str, RmpaError] = {}
        self.versions: dict[str, MessageType] = {}
        self.asked: list[str] = []
        self.on_learnt: Callable[[MessageType], None] = lambda _: None

    def message(self, name: str) -> MessageType:
        return MessageType(name)

    def version(self, name: str, md5sum: str) -> MessageType:
        return self.versions.get(md5sum) or self.message(name)

    def codec(self, name: str, md5sum: str) -> MessageCodec:
        return codec_for(self.version(name, md5sum))

    def service(self, name: str) -> ServiceType:
        return ServiceType(name)

    async def find_message(self, name: str, md5sum: str = "") -> MessageType:
        self.asked.append(name)
        if name in self.missing:
            raise self.missing[name]
        return self.version(name, md5sum)

    async def find_service(self, name: str) -> ServiceType:
        return ServiceType(name)


class Params:
    """The parameters, as the test makes them up; those at ``/denied`` cannot be changed."""

    def __init__(self) -> None:
        self.tree: dict[str, Any] = {}
        self.changes: list[tuple[str, Any]] = []

    async def set(self, name: str, value: Any) -> None:
        if name == "/denied":
            raise RmpaError("the core refuses it")
        self.changes.append((name, value))

    async def delete(self, name: str) -> None:
        await self.set(name, None)


class FakeHub:
    """What sessions read of a hub."""

    def __init__(self, *, sim_time: bool = False) -> None:
        self.graph = Graph()
        self.types = Types()
        self.published: dict[str, str] = {}
        self.params = Params()
        self.frames: MadeOnce[OutFrame] = MadeOnce(1 << 20)
        self.link = SimpleNamespace(rules=EVERYTHING)
        # Of parts that all clients share: what each topic's message is given to, while it is subscribed to.
        self.shared: dict[str, Callable[[ReceivedMessage], None]] = {}
        self.topics = SimpleNamespace(published=self.published, subscribe=self._subscribe)
        topics: Any = self.topics
        types: Any = self.types
        self.transforms = TransformTree(topics, types)
        self.time = SimpleNamespace(now_ns=lambda: NOW_NS, simulated=sim_time)

    def _subscribe(self, topic: str, _type: str | None, receive: Any, _failed: Any) -> Any:
        self.shared[topic] = receive
        return SimpleNamespace(close=lambda: self.shared.pop(topic))


class Connection:
    """The connection of a session: what it was given, encoded at once."""

    def __init__(self, client: Recorded) -> None:
        self._client = client
        self.queue: FairQueue[Any] = FairQueue()
        self.sent: list[OutFrame] = []
        self.ended: list[int] = []

    def push(self, *frames: OutFrame) -> None:
        self.sent += frames

    def pace(self, stream: ClientStream, interval: float, length: int) -> None:
        self.queue.pace(stream, interval, length)

    def push_message(self, stream: ClientStream, message: ReceivedMessage) -> None:
        self.queue.push(stream, functools.partial(stream.frames, message), 1, 0, self._client.now)
        self.flush()

    def flush(self) -> None:
        while (entry := self.queue.pop(self._client.now)) is not None:
            self.sent += entry()

    def end(self, code: int, _reason: str, _refusal: str = "") -> None:
        self.ended.append(code)

    def age(self) -> float:
        return 0.0


class PageConnection(Connection):
    """Of a page of the monitor: a connection that says how much the page has not taken, and why it was ended."""

    unsent = 0
    refusal = reason = ""

    def end(self, code: int, reason: str, refusal: str = "") -> None:
        super().end(code, reason, refusal)
        self.reason, self.refusal = reason, refusal

    def arm(self) -> None:
        """The test looks at the timer."""


class Recorded:
    """One client with its session; `now` is the clock of all calls."""

    def __init__(self, session: Any) -> None:
        self.now = 0.0
        self.session = session
        self.asked: list[Asked] = []
        self.connection = Connection(self)
        self.session.connection = self.connection
        record(session, self.asked)

    def send_raw(self, data: str | bytes) -> list[Asked]:
        """Take a frame of the client; returns what the session has asked for then."""
        count = len(self.asked)
        self.session.received_frame(data, self.now)
        return self.asked[count:]

    def one(self, what: str, asked: list[Asked]) -> Asked:
        (only,) = asked
        assert only.what == what
        return only

    def last(self, what: str) -> Asked:
        return next(each for each in reversed(self.asked) if each.what == what)

    def all(self, what: str) -> list[Asked]:
        return [each for each in self.asked if each.what == what]

    def advance(self, seconds: float) -> None:
        """Let time pass; timers are handled at their time."""
        end = self.now + seconds
        while True:
            due = [
                at for at in (self.session.next_timer(), self.connection.queue.due) if at is not None and at <= end
            ]
            if not due:
                break
            self.now = max(self.now, min(due))
            self.session.handle_timer(self.now)
            self.connection.flush()
        self.now = end

    def frames(self) -> list[OutFrame]:
        """What the client got since the last call."""
        sent, self.connection.sent = self.connection.sent, []
        return sent


# What a session asks of its hub; where the client may not, the refusal names it so.
_ASKED = (
    *("subscribe", "advertise", "serve", "call", "find_service", "fetch_asset"),
    *("get_params", "set_param", "delete_param", "follow_params"),
)
_RIGHTS = {"advertise": "publish", "serve": "offer services"}


def record(client: HubClient, asked: list[Asked]) -> None:
    """Have the calls of a client written down in place of being done."""
    made: Any = client

    def recorded(name: str) -> Callable[..., Asked]:
        signature = inspect.signature(getattr(HubClient, name))

        def say(*args: Any, **kwargs: Any) -> Asked:
            if name in _RIGHTS:
                made.check_control(_RIGHTS[name])
            bound = signature.bind(made, *args, **kwargs)
            bound.apply_defaults()
            del bound.arguments["self"]
            asked.append(Asked(name, **{key.removesuffix("_"): value for key, value in bound.arguments.items()}))
            return asked[-1]

        return say

    def run(work: Any, done: Callable[[Any], None], failed: Callable[[RmpaError], None]) -> None:
        def finish(result: Any) -> None:
            try:
                done(result)
            except RmpaError as error:
                failed(error)

        if isinstance(work, Asked):
            work.done, work.failed = finish, failed
        else:
            drive(work, done, failed)

    for name in _ASKED:
        setattr(made, name, recorded(name))
    made.run = run


def drive(work: Any, done: Callable[[Any], None], failed: Callable[[RmpaError], None]) -> None:
    """Do work that waits for nothing."""
    assert inspect.iscoroutine(work)
    try:
        work.send(None)
    except StopIteration as stop:
        done(stop.value)
    except RmpaError as error:
        failed(error)
    else:
        raise AssertionError("it waits")


def answer(asked: Asked, data: bytes) -> None:
    """Let the hub do something with what it was asked, as it may with any client."""
    results: dict[str, Any] = {"call": data, "fetch_asset": data, "find_service": "std_srvs/Empty"}
    results |= {"set_param": None, "delete_param": None, "get_params": {"/a": 1.0, "/b": data}}
    if asked.what == "subscribe":
        asked.message(data)
    elif asked.what == "serve":
        asked.called(data, Future[bytes]())
    elif asked.what == "follow_params":
        asked.changed({"/a": [data], "/b": None})
    elif asked.what in results:
        asked.done(results[asked.what])
    if asked.what in ("subscribe", "serve", "advertise"):
        asked.failed(RmpaError("it cannot be done"))


def decoded(frame: OutFrame) -> dict[str, Any]:
    opcode, parts = frame
    data = b"".join(parts)
    values: dict[str, Any] = cbor2.loads(data) if opcode is Opcode.BINARY else msgspec.json.decode(data)
    return values

"""ROS 2 through its own client library: the session whose endpoints a child process makes with rclpy.

To the parts of the neighbour it is what a Zenoh session is: tokens declare endpoints and tell of those of ROS 2,
messages and calls go by keys, and each has an attachment. So everything above exists once. The child
(``half``) runs under ROS 2's own Python, with the user's RMW, domain, security and installed types.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import logging
import random
import socket
import struct
from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rmpa.core.errors import StartError
from rmpa.core.outbox import URGENT, Outbox
from rmpa.core.timers import Backoff
from rmpa.gateway import limits
from rmpa.gateway.ros2.format import (
    GID_BYTES,
    NO_HASH,
    OWN_NAMESPACE,
    EntityKind,
    Ros2Attachment,
    Ros2Endpoint,
    Ros2Node,
    Ros2Qos,
    gid_of,
    parse_token,
    qos_fields,
    qos_of_fields,
    ros_type,
)
from rmpa.gateway.zenoh.threads import ZenohQos, ZenohSample
from rmpa.runtime.stream import Stream
from rmpa.runtime.tasks import OwnedTasks

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rmpa.bridge.policy import Needs
    from rmpa.runtime.tls import Buffer

_log = logging.getLogger(__name__)
_PROTOCOL: Final = 1
_HEAD: Final = struct.Struct("<IBI")
_STAMPS: Final = struct.Struct("<qq")
_MESSAGE: Final = ord("M")
# The number of a call.
_CALL: Final = struct.Struct("<Q")
# Bytes of the head behind the length.
_SHORT: Final = 5
# Seconds for the child's first frame: DDS libraries load slowly on small computers.
_START_MAX: Final = 30.0
# The longest time in seconds between two attempts to start the child again.
_RESTART_MAX: Final = 5.0
# Hexadecimal digits of a GID that the participant of DDS has.
_PREFIX: Final = 24
# What stands for the session of ROS 2's nodes: no gateway has it.
_FOREIGN: Final = "f" * 32
_HALF: Final = Path(__file__).with_name("half")
# Its folder is searched last: modules beside it have names of the standard library.
_RUN: Final = (
    "import sys; sys.path[:] = [p for p in sys.path if p] + [sys.argv.pop(1)]; "
    "from importlib import import_module; sys.exit(import_module(sys.argv.pop(1)).main())"
)


def shown_in_ros2(own: Ros2Endpoint) -> str:
    """What a problem of an endpoint in ROS 2 is kept under, apart from those of its source."""
    return f"{own.name} of {own.node.name} in ROS 2 ({own.type})"


def _without_hash(key: str) -> str:
    return key.rpartition("/")[0]


def _closing(end: Callable[[], object]) -> ExitStack:
    """Something that is taken back once."""
    made = ExitStack()
    made.callback(end)
    return made


@dataclass(slots=True)
class _Own:
    """An endpoint that is declared here.

    Attributes:
        key: Of its messages or calls.
        unmade: Whether the child could not make it.
        publisher: What has sent for it; its queue has the bounds of that.
        kept: Its last message, if it is latched: for a child that is started again.
    """

    endpoint: Ros2Endpoint
    key: str
    unmade: bool = False
    publisher: RclpyPublisher | None = None
    kept: bytes | None = None


class RclpyQuery:
    """A call of a ROS 2 client, to be answered once.

    Args:
        answer: Sends the call's number, whether it succeeded (1 byte), and the response as CDR.
        call: The call's number.
        key: The service's.
        request: As CDR.
    """

    def __init__(self, answer: Callable[[bytes], object], call: bytes, key: str, request: bytes) -> None:
        self._answer = answer
        self._call = call
        self.key = key
        self.payload = request
        self.attachment = Ros2Attachment(_CALL.unpack(call)[0], 0, bytes(16)).serialize()

    def reply(self, payload: Buffer, _attachment: bytes = b"") -> None:
        """Give the answer."""
        self._finish(b"\1", bytes(payload))

    def reply_error(self, _text: str) -> None:
        """Give up: ROS 2 has no response that says that a call has failed, and its client goes on waiting."""
        self._finish(b"\0", b"")

    def finish(self) -> None:
        """No answer follows."""
        self._finish(b"\0", b"")

    def _finish(self, succeeded: bytes, payload: bytes) -> None:
        call, self._call = self._call, b""
        if call:
            self._answer(call + succeeded + payload)


class RclpyPublisher:
    """Publishes what has the GID of a declared endpoint; of one key, as a Zenoh publisher is.

    Attributes:
        dropped: Messages that its queue has dropped for newer ones.
    """

    def __init__(self, session: RclpySession, key: str, qos: ZenohQos, matching: Callable[[bool], None]) -> None:
        self._session = session
        self._key = key
        self._qos = qos
        self._matching = matching
        self._matched = False
        self.dropped = 0

    @property
    def waiting(self) -> int:
        """Messages in its queue."""
        own, waiting = self._session.own.items(), self._session.outbox.waiting
        return sum(waiting(number) for number, each in own if each.publisher is self)

    def put_all(self, messages: Sequence[tuple[bytes, bytes]]) -> None:
        """Queue messages."""
        for payload, attachment in messages:
            number = self._session.by_gid.get(Ros2Attachment.parse(attachment).gid)
            if number is not None:
                own = self._session.own[number]
                if own.publisher is not self:
                    own.publisher = self
                    self._session.outbox.set_terms(number, self._qos.messages)
                self.dropped += self._session.write("M", number, payload)
                if self._qos.cache:
                    own.kept = payload

    def judge(self) -> None:
        """Tell whether a node of ROS 2 subscribes, if that has changed."""
        there = self._session.wanted[_without_hash(self._key)] > 0
        if there != self._matched:
            self._matched = there
            self._matching(there)

    def close(self) -> None:
        """Publish no more."""
        self._session.publishers.discard(self)


class RclpySession:
    """Keeps the child, and has what is declared made by it, also by the next one after it has died.

    Args:
        python: The Python of ROS 2.
        domain: The ROS domain id.
        name: The gateway's name.
        environ: For the child.

    Attributes:
        zid: Identifies this session among gateways: the participant of DDS, in hexadecimal digits.
        problem: Why there is no child; empty: there is one.
        outbox: What waits for the child, by endpoint.
        own: What is declared here, by the numbers of frames.
        by_gid: These numbers by GID.
        publishers: Those that are open.
        wanted: The number of ROS 2's subscriptions by their keys without the hash.
    """

    # More than twelve fields: the child with its stream, what is declared, what ROS 2 has, and the calls under way.

    def __init__(self, python: str, domain: int, name: str, environ: dict[str, str]) -> None:
        self._tasks = OwnedTasks()
        self._python = python
        self._domain = domain
        self._name = name
        self._environ = environ
        self.stale = False
        self.zid = f"{random.getrandbits(96):024x}"
        self.hash_of: Callable[[str], str] = lambda _: NO_HASH
        self.say: Callable[[str, str], None] = lambda _what, _text: None
        self.hello: dict[str, Any] = {}
        self.problem = "rclpy is being started"
        self.outbox = Outbox(1000, 64 << 20)
        self._stream: Stream | None = None
        self._process: asyncio.subprocess.Process | None = None
        self._ready: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._ended = asyncio.Event()
        self._numbers = itertools.count(1)
        self.own: dict[int, _Own] = {}
        self.by_gid: dict[bytes, int] = {}
        self.wanted: Counter[str] = Counter()
        # Of services that are called without a declared client, by their keys.
        self._clients: dict[str, int] = {}
        self.publishers: set[RclpyPublisher] = set()
        self._subscribers: dict[str, Callable[[ZenohSample], object]] = {}
        self._servers: dict[str, Callable[[RclpyQuery], object]] = {}
        self._watchers: dict[str, Callable[[str, bool], None]] = {}
        # ROS 2's endpoints by their GID, and its nodes by name.
        self._foreign: dict[str, Ros2Endpoint] = {}
        self._gids: dict[bytes, tuple[bytes, str]] = {}
        self._nodes: dict[str, Ros2Node] = {}
        self._own_prefixes: set[str] = set()
        self._calls: dict[bytes, asyncio.Future[list[ZenohSample]]] = {}
        self._call_numbers = itertools.count(1)

    async def start(self) -> None:
        """Start the child, and keep one running.

        Raises:
            StartError: There is no rclpy; the text says which Python was asked, and what to do.
        """
        await self._begin()
        self._tasks.start(self._keep(), "keep ROS 2's half")

    async def _begin(self) -> None:
        here, there = socket.socketpair()
        here.setblocking(False)
        try:
            self._process = await asyncio.create_subprocess_exec(
                self._python,
                "-c",
                _RUN,
                str(_HALF.parent),
                f"{_HALF.name}.child",
                str(there.fileno()),
                pass_fds=(there.fileno(),),
                env=self._environ,
            )
        except OSError as error:
            here.close()
            raise self._no_rclpy(f"it cannot be started: {error.strerror}") from error
        finally:
            there.close()
        self._ended.clear()
        self._ready = asyncio.get_running_loop().create_future()
        self.outbox.clear()
        self._stream = Stream(here, on_bytes=self._bytes, on_close=self._closed, outbox=self.outbox)
        self._say("H", 0, protocol=_PROTOCOL, domain=self._domain, name=self._name)
        try:
            async with asyncio.timeout(_START_MAX):
                await self._ready
        except TimeoutError:
            await self._kill()
            raise self._no_rclpy(f"no answer within {_START_MAX:g} s") from None
        self.problem = ""
        for number, own in self.own.items():
            self._create(number)
            if own.kept is not None:
                self.write("M", number, own.kept)

    def _no_rclpy(self, why: str) -> StartError:
        return StartError("ROS 2's half", f"{self._python}: {why}", code="no-rclpy")

    async def _keep(self) -> None:
        backoff = Backoff(limits.OPEN_RETRY_FIRST, _RESTART_MAX, random.random)
        while True:
            await self._ended.wait()
            self.problem = f"ROS 2's half ({self._python}) has ended; it is started again"
            _log.warning("! %s [no-rclpy]", self.problem)
            await asyncio.sleep(backoff.delay())
            try:
                await self._begin()
                backoff.reset()
                _log.info("= ROS 2's half runs again")
            except StartError as error:
                self.problem = str(error)
                self._ended.set()

    async def close(self) -> None:
        """End the child."""
        await self._tasks.close()
        await self._kill()

    async def _kill(self) -> None:
        if self._stream is not None:
            self._stream.close()
            self._stream = None
        if self._process is not None and self._process.returncode is None:
            self._process.kill()  # DDS takes seconds to end in order
            await self._process.wait()

    def _closed(self, _error: Exception | None) -> None:
        self._stream = None
        if not self._ready.done():
            self._ready.set_exception(self._no_rclpy("it has ended at once"))
        for gid in list(self._foreign):
            self._remove(gid)
        for name in list(self._nodes):
            self._tell(self._nodes.pop(name), alive=False)
        for answer in self._calls.values():
            if not answer.done():
                answer.set_result([ZenohSample(b"ROS 2's half has ended", ok=False)])
        self._calls.clear()
        self._ended.set()

    def write(self, operation: str, number: int, body: bytes) -> int:
        """Send one frame; return how many older messages of this endpoint were dropped for it."""
        if self._stream is None:
            return 0
        head = _HEAD.pack(len(body) + _SHORT, ord(operation), number)
        return self._stream.send((head, body), number if operation == "M" else URGENT)

    def _say(self, operation: str, number: int, **fields: object) -> None:
        self.write(operation, number, json.dumps(fields).encode())

    def _bytes(self, data: memoryview) -> tuple[int, int]:
        at = 0
        while len(data) - at >= _HEAD.size:
            size, operation, number = _HEAD.unpack_from(data, at)
            end = at + size + 4
            if len(data) < end:
                return at, end - at
            body = data[at + _HEAD.size : end]
            if operation == _MESSAGE:
                self._message(number, body)
            else:
                self._frame(chr(operation), number, bytes(body))
            at = end
        return at, 0

    def _frame(self, operation: str, number: int, body: bytes) -> None:
        if operation == "Q":
            self._query(number, body)
        elif operation == "A":
            self._answered(body)
        elif operation == "G":
            self._graph(json.loads(body))
        elif operation == "H":
            self._hello(json.loads(body))
        elif operation == "!":
            self._failed(number, json.loads(body))

    def _hello(self, hello: dict[str, Any]) -> None:
        self.hello = hello
        if prefix := hello["prefix"]:
            self._own_prefixes.add(prefix)
            self.zid = prefix
        if not self._ready.done():
            self._ready.set_result(None)

    def _failed(self, number: int, told: dict[str, Any]) -> None:
        own = self.own.get(number)
        if own is None:
            if not self._ready.done():
                self._ready.set_exception(self._no_rclpy(str(told.get("text"))))
            return
        endpoint, what = own.endpoint, shown_in_ros2(own.endpoint)
        if policy := told.get("policy"):
            self.say(what, f"its QoS does not fit {told['count']} endpoints of ROS 2: {policy}")
            return
        own.unmade = True
        others = (
            each.endpoint for each in self.own.values() if not each.unmade and each.endpoint.name == endpoint.name
        )
        other = next((each.type for each in others if each.type != endpoint.type), "")
        if other:
            text = (
                f"{other} crosses, and {endpoint.type} does not: rclpy has one type of a topic at a time; rename one"
            )
            self.say(what, text)
        else:
            self.say(what, f"ROS 2 does not have it: {told.get('text')}")

    def token(self, key: str) -> ExitStack:
        """Have an endpoint made; a node is made with its first one."""
        endpoint = parse_token(key)
        if isinstance(endpoint, Ros2Node):
            return ExitStack()
        number, gid = self._declare(endpoint), gid_of(key)
        self.by_gid[gid] = number

        def end() -> None:
            del self.own[number], self.by_gid[gid]
            self.outbox.discard(number)
            self.say(shown_in_ros2(endpoint), "")
            self.write("-", number, b"")
            for other, own in self.own.items():
                if own.unmade and own.endpoint.name == endpoint.name:  # the name may be free for its type now
                    self.say(shown_in_ros2(own.endpoint), "")
                    self._create(other)

        return _closing(end)

    def _declare(self, endpoint: Ros2Endpoint) -> int:
        number = next(self._numbers)
        self.own[number] = _Own(endpoint, endpoint.key())
        self._create(number)
        return number

    def _create(self, number: int) -> None:
        own = self.own[number]
        own.unmade = False
        self._say(
            "+",
            number,
            kind=own.endpoint.kind,
            node=own.endpoint.node.name,
            name=own.endpoint.name,
            type=own.endpoint.type,
            qos=qos_fields(own.endpoint.qos),
        )

    def publisher(self, key: str, qos: ZenohQos, on_matching: Callable[[bool], None]) -> RclpyPublisher:
        """A publisher for the declared endpoints of a key; ``on_matching`` tells whether ROS 2 subscribes."""
        made = RclpyPublisher(self, key, qos, on_matching)
        self.publishers.add(made)
        asyncio.get_running_loop().call_soon(made.judge)
        return made

    def subscribe(self, key: str, on_sample: Callable[[ZenohSample], object], *, history: bool = False) -> ExitStack:
        """Give what arrives for a key to a function; the subscription is declared by its token."""
        del history  # the token has its durability
        self._subscribers[key] = on_sample
        return _closing(lambda: self._subscribers.pop(key, None))

    def queryable(self, key: str, on_query: Callable[[RclpyQuery], object], _needs: Needs | None = None) -> ExitStack:
        """Give the calls of a service to a function; the server is declared by its token."""
        self._servers[key] = on_query
        return _closing(lambda: self._servers.pop(key, None))

    async def get(
        self,
        selector: str,
        payload: Buffer = b"",
        attachment: bytes = b"",
        *,
        timeout: float = 5.0,  # noqa: ASYNC109 - as a Zenoh session
        all_complete: bool = False,  # noqa: ARG002 - likewise
    ) -> list[ZenohSample]:
        """Call a service; no answer within ``timeout`` seconds is an empty list."""
        number = self.by_gid.get(Ros2Attachment.parse(attachment).gid) or self._client(selector)
        call = _CALL.pack(next(self._call_numbers))
        answer: asyncio.Future[list[ZenohSample]] = asyncio.get_running_loop().create_future()
        self._calls[call] = answer
        try:
            if self._stream is None:
                return [ZenohSample(self.problem.encode(), ok=False)]
            self.write("Q", number, call + bytes(payload))
            async with asyncio.timeout(timeout):
                return await answer
        except TimeoutError:
            return []
        finally:
            self._calls.pop(call, None)

    def _client(self, key: str) -> int:
        """A client for a service that is called without a declared one."""
        if key not in self._clients:
            domain, *name, type_name, type_hash = key.split("/")
            node = Ros2Node(int(domain), self.zid, 0, OWN_NAMESPACE + self._name)
            terms = EntityKind.CLIENT, f"/{'/'.join(name)}", ros_type(type_name), type_hash, Ros2Qos()
            self._clients[key] = self._declare(Ros2Endpoint(node, 0, *terms))
        return self._clients[key]

    def _message(self, number: int, body: memoryview) -> None:
        own = self.own.get(number)
        if own is None:
            return
        key = own.key
        at = 1 + body[0]
        real = bytes(body[1:at])
        stamp, sequence = _STAMPS.unpack_from(body, at)
        gid, of = self._gids.get(real, (real[:GID_BYTES].ljust(GID_BYTES, b"\0"), key))
        if of != key:
            return  # of a publisher with another definition of the type, which has a subscription of its own
        sample = ZenohSample(bytes(body[at + _STAMPS.size :]), Ros2Attachment(sequence, stamp, gid).serialize())
        if (take := self._subscribers.get(key)) is not None:
            take(sample)

    def _query(self, number: int, body: bytes) -> None:
        key = own.key if (own := self.own.get(number)) is not None else ""
        query = RclpyQuery(partial(self.write, "A", number), body[: _CALL.size], key, body[_CALL.size :])
        if (take := self._servers.get(key)) is not None:
            take(query)
        else:
            query.finish()

    def _answered(self, body: bytes) -> None:
        answer = self._calls.get(body[: _CALL.size])
        if answer is not None and not answer.done():
            ok, payload = bool(body[_CALL.size]), body[_CALL.size + 1 :]
            answer.set_result([ZenohSample(payload, ok=ok)])

    def watch_tokens(self, key: str, on_token: Callable[[str, bool], None]) -> ExitStack:
        """Call ``on_token(token, alive)`` for what ROS 2 has, and at each change."""
        self._watchers[key] = on_token
        entities: list[Ros2Node | Ros2Endpoint] = [*self._nodes.values(), *self._foreign.values()]
        for entity in entities:
            on_token(entity.token(), True)
        return _closing(lambda: self._watchers.pop(key, None))

    def _tell(self, entity: Ros2Node | Ros2Endpoint, *, alive: bool) -> None:
        for on_token in tuple(self._watchers.values()):
            on_token(entity.token(), alive)

    def _graph(self, change: dict[str, Any]) -> None:
        for gid in change["removed"]:
            self._remove(gid)
        gone = change["removed"] and self._clients.keys() - {each.key() for each in self._foreign.values()}
        for key in gone or ():
            client = self._clients.pop(key)
            del self.own[client]
            self.write("-", client, b"")
        rows = change["added"]
        prefixes = {row["node"]: row["gid"][:_PREFIX] for row in rows if row["kind"] != EntityKind.SERVICE}
        own = OWN_NAMESPACE + self._name
        if own in prefixes:  # also of a half that was killed: its nodes stay in the graph for a while
            self._own_prefixes.add(prefixes[own])
        for name in [name for name in self._nodes if name not in change["nodes"]]:
            self._tell(self._nodes.pop(name), alive=False)
        for name in change["nodes"]:
            prefix = prefixes.get(name, "")
            if name not in self._nodes and (not name.startswith(OWN_NAMESPACE) or prefix):
                if name.startswith(OWN_NAMESPACE) and prefix in self._own_prefixes:
                    continue
                zid = prefix or _FOREIGN
                self._nodes[name] = Ros2Node(self._domain, zid, next(self._numbers), name)
                self._tell(self._nodes[name], alive=True)
        for row in rows:
            self._add(row)
        for publisher in tuple(self.publishers):
            publisher.judge()

    def _add(self, row: dict[str, Any]) -> None:
        name, type_name = row["node"], row["type"]
        if name.startswith(OWN_NAMESPACE) or row["gid"] in self._foreign or type_name.count("/") != 2:
            return
        node = self._nodes.get(name) or Ros2Node(self._domain, _FOREIGN, 0, name)
        type_hash = row["hash"] if row["hash"].startswith("RIHS") else self.hash_of(type_name)
        qos = qos_of_fields(row["qos"])
        kind = EntityKind(row["kind"])
        made = Ros2Endpoint(node, next(self._numbers), kind, row["name"], type_name, type_hash, qos)
        self._foreign[row["gid"]] = made
        self.wanted[_without_hash(made.key())] += kind is EntityKind.SUBSCRIPTION
        if kind is not EntityKind.SERVICE:
            self._gids[bytes.fromhex(row["gid"])] = gid_of(made.token()), made.key()
        self._tell(made, alive=True)

    def _remove(self, gid: str) -> None:
        endpoint = self._foreign.pop(gid, None)
        if endpoint is not None:
            self.wanted[_without_hash(endpoint.key())] -= endpoint.kind is EntityKind.SUBSCRIPTION
            if endpoint.kind is not EntityKind.SERVICE:
                self._gids.pop(bytes.fromhex(gid), None)
            self._tell(endpoint, alive=False)

    @property
    def endpoints(self) -> tuple[str, ...]:
        """What it is connected to: the RMW, once the child runs."""
        return (str(self.hello["rmw"]),) if not self.problem else ()

    @staticmethod
    def take_refused() -> dict[str, int]:
        """Nothing is refused before ROS 2 has it."""
        return {}

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
import os
import random
import socket
import struct
from collections import Counter
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
    EntityKind,
    Ros2Attachment,
    Ros2Endpoint,
    Ros2Node,
    Ros2Qos,
    parse_token,
    qos_fields,
    qos_of_fields,
    ros_type,
)
from rmpa.gateway.ros2.graph import OWN_NAMESPACE, gid_of
from rmpa.gateway.ros2.rclpy_query import CALL, RclpyQuery
from rmpa.gateway.zenoh.threads import ZenohReply, ZenohSample
from rmpa.runtime.stream import Stream
from rmpa.runtime.tasks import OwnedTasks

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rmpa.bridge.policy import Needs
    from rmpa.gateway.zenoh.threads import ZenohPriority, ZenohQos
    from rmpa.runtime.tls import Buffer

_log = logging.getLogger(__name__)
_PROTOCOL: Final = 1
_HEAD: Final = struct.Struct("<IBI")
_STAMPS: Final = struct.Struct("<qq")
_MESSAGE: Final = ord("M")
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


class _Closer:
    """Something that is taken back once; the other declarations of a session have more to do."""

    def __init__(self, end: Callable[[], None]) -> None:
        self._end: Callable[[], None] | None = end

    def close(self) -> None:
        """Take it back."""
        end, self._end = self._end, None
        if end is not None:
            end()


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
        # The endpoints that have sent, and whose queues are bounded.
        self._used: set[int] = set()
        self.dropped = 0

    @property
    def waiting(self) -> int:
        """Messages in its queue."""
        return sum(map(self._session.outbox.waiting, self._used))

    def put(self, payload: Buffer, attachment: bytes = b"") -> int:
        """Queue one message; return how many older ones were dropped."""
        return self.put_all(((bytes(payload), attachment),))

    def put_all(self, messages: Sequence[tuple[bytes, bytes]]) -> int:
        """Queue messages; return how many older ones were dropped."""
        dropped = 0
        for payload, attachment in messages:
            number = self._session.number_of(Ros2Attachment.parse(attachment).gid)
            if number is not None:
                if number not in self._used:
                    self._used.add(number)
                    self._session.outbox.set_terms(number, self._qos.messages)
                dropped += self._session.write("M", number, payload)
                if self._qos.cache:
                    self._session.kept[number] = payload
        self.dropped += dropped
        return dropped

    def judge(self) -> None:
        """Tell whether a node of ROS 2 subscribes, if that has changed."""
        there = self._session.subscribed(self._key)
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
        publishers: Those that are open.
        kept: The last message of each latched endpoint, for a child that is started again.
    """

    # More than twelve fields: the child with its stream, what is declared, what ROS 2 has, and the calls under way.

    def __init__(self, python: str, domain: int, name: str, environ: dict[str, str] | None = None) -> None:
        self._tasks = OwnedTasks()
        self._python = python
        self._domain = domain
        self._name = name
        self._environ = dict(os.environ if environ is None else environ)
        self.stale = False
        self.zid = f"{random.getrandbits(96):024x}"
        self.hash_of: Callable[[str], str] = lambda _: NO_HASH
        self.say: Callable[[str, str], None] = lambda _what, _text: None
        self.hello: dict[str, Any] = {}
        self.problem = "rclpy is being started"
        self.outbox = Outbox(1000, 64 << 20)
        self._stream: Stream | None = None
        self._process: asyncio.subprocess.Process | None = None
        self._ready: asyncio.Future[None] | None = None
        self._ended = asyncio.Event()
        self._numbers = itertools.count(1)
        self._declared: dict[int, Ros2Endpoint] = {}
        self._keys: dict[int, str] = {}
        # Those that the child could not make.
        self._unmade: set[int] = set()
        # The subscriptions of ROS 2 by their keys without the hash.
        self._wanted: Counter[str] = Counter()
        self._by_gid: dict[bytes, int] = {}
        self._clients: dict[str, int] = {}
        self.publishers: set[RclpyPublisher] = set()
        self.kept: dict[int, bytes] = {}
        self._subscribers: dict[str, list[Callable[[ZenohSample], None]]] = {}
        self._servers: dict[str, Callable[[RclpyQuery], object]] = {}
        self._watcher: Callable[[str, bool], None] | None = None
        # ROS 2's endpoints by their GID, and its nodes by name.
        self._foreign: dict[str, Ros2Endpoint] = {}
        self._gids: dict[bytes, tuple[bytes, str]] = {}
        self._nodes: dict[str, Ros2Node] = {}
        self._own_prefixes: set[str] = set()
        self._calls: dict[bytes, tuple[str, asyncio.Future[list[ZenohReply]]]] = {}
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
        self._unmade.clear()
        for number, endpoint in self._declared.items():
            self._create(number, endpoint)
            if number in self.kept:
                self.write("M", number, self.kept[number])

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
        if self._ready is not None and not self._ready.done():
            self._ready.set_exception(self._no_rclpy("it has ended at once"))
        for gid in list(self._foreign):
            self._remove(gid)
        for name in list(self._nodes):
            self._remove_node(name)
        for key, answer in self._calls.values():
            if not answer.done():
                answer.set_result([ZenohReply(key, b"ROS 2's half has ended", b"", ok=False)])
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
        if self._ready is not None and not self._ready.done():
            self._ready.set_result(None)

    def _failed(self, number: int, told: dict[str, Any]) -> None:
        endpoint = self._declared.get(number)
        if endpoint is None:
            if self._ready is not None and not self._ready.done():
                self._ready.set_exception(self._no_rclpy(str(told.get("text"))))
            return
        what = shown_in_ros2(endpoint)
        if policy := told.get("policy"):
            self.say(what, f"its QoS does not fit {told['count']} endpoints of ROS 2: {policy}")
            return
        self._unmade.add(number)
        made = (self._declared[each] for each in self._alike(endpoint) if each not in self._unmade)
        other = next((each.type for each in made if each.type != endpoint.type), "")
        if other:
            text = (
                f"{other} crosses, and {endpoint.type} does not: rclpy has one type of a topic at a time; rename one"
            )
            self.say(what, text)
        else:
            self.say(what, f"ROS 2 does not have it: {told.get('text')}")

    def _alike(self, endpoint: Ros2Endpoint) -> list[int]:
        """What is declared under the name of an endpoint."""
        return [number for number, each in self._declared.items() if each.name == endpoint.name]

    def token(self, key: str) -> _Closer:
        """Have an endpoint made; a node is made with its first one."""
        endpoint = parse_token(key)
        if isinstance(endpoint, Ros2Node):
            return _Closer(lambda: None)
        number, gid = next(self._numbers), gid_of(key)
        self._declared[number], self._keys[number] = endpoint, endpoint.key()
        self._by_gid[gid] = number
        self._create(number, endpoint)

        def end() -> None:
            del self._declared[number], self._keys[number], self._by_gid[gid]
            self.kept.pop(number, None)
            self.outbox.discard(number)
            self.say(shown_in_ros2(endpoint), "")
            self.write("-", number, b"")
            self._unmade.discard(number)
            for each in self._unmade.intersection(self._alike(endpoint)):  # the name may be free for its type now
                self._unmade.discard(each)
                self.say(shown_in_ros2(self._declared[each]), "")
                self._create(each, self._declared[each])

        return _Closer(end)

    def _create(self, number: int, endpoint: Ros2Endpoint) -> None:
        self._say(
            "+",
            number,
            kind=endpoint.kind,
            node=endpoint.node.name,
            name=endpoint.name,
            type=endpoint.type,
            qos=qos_fields(endpoint.qos),
        )

    def number_of(self, gid: bytes) -> int | None:
        """The endpoint with this GID."""
        return self._by_gid.get(gid)

    def publisher(self, key: str, qos: ZenohQos, on_matching: Callable[[bool], None]) -> RclpyPublisher:
        """A publisher for the declared endpoints of a key; ``on_matching`` tells whether ROS 2 subscribes."""
        made = RclpyPublisher(self, key, qos, on_matching)
        self.publishers.add(made)
        asyncio.get_running_loop().call_soon(made.judge)
        return made

    def subscribed(self, key: str) -> bool:
        """Whether a node of ROS 2 subscribes to a topic with this type, whatever hash it has."""
        return self._wanted[_without_hash(key)] > 0

    def subscribe(self, key: str, on_sample: Callable[[ZenohSample], None], *, history: bool = False) -> _Closer:
        """Give what arrives for a key to a function; the subscription is declared by its token."""
        del history  # the token has its durability
        self._subscribers.setdefault(key, []).append(on_sample)

        def end() -> None:
            self._subscribers[key].remove(on_sample)
            if not self._subscribers[key]:
                del self._subscribers[key]

        return _Closer(end)

    def queryable(self, key: str, on_query: Callable[[RclpyQuery], object], _needs: Needs | None = None) -> _Closer:
        """Give the calls of a service to a function; the server is declared by its token."""
        self._servers[key] = on_query

        def end() -> None:
            self._servers.pop(key, None)

        return _Closer(end)

    async def get(
        self,
        selector: str,
        payload: Buffer = b"",
        attachment: bytes = b"",
        *,
        timeout: float = 5.0,  # noqa: ASYNC109 - as a Zenoh session
        all_complete: bool = False,  # noqa: ARG002 - likewise
        priority: ZenohPriority | None = None,  # noqa: ARG002 - likewise
    ) -> list[ZenohReply]:
        """Call a service; no answer within ``timeout`` seconds is an empty list."""
        number = self.number_of(Ros2Attachment.parse(attachment).gid) or self._client(selector)
        call = CALL.pack(next(self._call_numbers))
        answer: asyncio.Future[list[ZenohReply]] = asyncio.get_running_loop().create_future()
        self._calls[call] = selector, answer
        try:
            if self._stream is None:
                return [ZenohReply(selector, self.problem.encode(), b"", ok=False)]
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
            number = self._clients[key] = next(self._numbers)
            kind = EntityKind.CLIENT
            made = Ros2Endpoint(node, number, kind, f"/{'/'.join(name)}", ros_type(type_name), type_hash, Ros2Qos())
            self._declared[number] = made
            self._create(number, made)
        return self._clients[key]

    def _message(self, number: int, body: memoryview) -> None:
        key = self._keys.get(number)
        if key is None:
            return
        at = 1 + body[0]
        real = bytes(body[1:at])
        stamp, sequence = _STAMPS.unpack_from(body, at)
        gid, of = self._gids.get(real, (real[:GID_BYTES].ljust(GID_BYTES, b"\0"), key))
        if of != key:
            return  # of a publisher with another definition of the type, which has a subscription of its own
        sample = ZenohSample(key, bytes(body[at + _STAMPS.size :]), Ros2Attachment(sequence, stamp, gid).serialize())
        for take in tuple(self._subscribers.get(key, ())):
            take(sample)

    def _query(self, number: int, body: bytes) -> None:
        key = self._keys.get(number, "")
        query = RclpyQuery(partial(self.write, "A", number), body[: CALL.size], key, body[CALL.size :])
        if (take := self._servers.get(key)) is not None:
            take(query)
        else:
            query.finish()

    def _answered(self, body: bytes) -> None:
        key, answer = self._calls.get(body[: CALL.size], ("", None))
        if answer is not None and not answer.done():
            ok, payload = bool(body[CALL.size]), body[CALL.size + 1 :]
            answer.set_result([ZenohReply(key, payload, b"", ok=ok)])

    def watch_tokens(self, key: str, on_token: Callable[[str, bool], None]) -> _Closer:
        """Call ``on_token(token, alive)`` for what ROS 2 has, and at each change."""
        del key
        self._watcher = on_token
        for node in self._nodes.values():
            on_token(node.token(), True)
        for endpoint in self._foreign.values():
            on_token(endpoint.token(), True)

        def end() -> None:
            self._watcher = None

        return _Closer(end)

    def _tell(self, entity: Ros2Node | Ros2Endpoint, *, alive: bool) -> None:
        if self._watcher is not None:
            self._watcher(entity.token(), alive)

    def _graph(self, change: dict[str, Any]) -> None:
        for gid in change["removed"]:
            self._remove(gid)
        gone = change["removed"] and self._clients.keys() - {each.key() for each in self._foreign.values()}
        for key in gone or ():
            client = self._clients.pop(key)
            del self._declared[client]
            self.write("-", client, b"")
        rows = change["added"]
        prefixes = {row["node"]: row["gid"][:_PREFIX] for row in rows if row["kind"] != EntityKind.SERVICE}
        own = OWN_NAMESPACE + self._name
        if own in prefixes:  # also of a half that was killed: its nodes stay in the graph for a while
            self._own_prefixes.add(prefixes[own])
        for name in [name for name in self._nodes if name not in change["nodes"]]:
            self._remove_node(name)
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
        self._wanted[_without_hash(made.key())] += kind is EntityKind.SUBSCRIPTION
        if kind is not EntityKind.SERVICE:
            self._gids[bytes.fromhex(row["gid"])] = gid_of(made.token()), made.key()
        self._tell(made, alive=True)

    def _remove(self, gid: str) -> None:
        endpoint = self._foreign.pop(gid, None)
        if endpoint is not None:
            self._wanted[_without_hash(endpoint.key())] -= endpoint.kind is EntityKind.SUBSCRIPTION
            if endpoint.kind is not EntityKind.SERVICE:
                self._gids.pop(bytes.fromhex(gid), None)
            self._tell(endpoint, alive=False)

    def _remove_node(self, name: str) -> None:
        self._tell(self._nodes.pop(name), alive=False)

    @property
    def endpoints(self) -> tuple[str, ...]:
        """What it is connected to: the RMW, once the child runs."""
        return (str(self.hello["rmw"]),) if not self.problem else ()

    @staticmethod
    def take_refused() -> dict[str, int]:
        """Nothing is refused before ROS 2 has it."""
        return {}

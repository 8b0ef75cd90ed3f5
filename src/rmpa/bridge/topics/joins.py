"""Subscribers that join a topic which is already sent to their module: for the publisher each is a new connection.

A publisher may have something to say to each new subscriber alone (rospy's ``SubscribeListener.peer_publish``,
connect callbacks of roscpp: costmap_2d sends the whole map, theora its header). So the publisher's agent connects
once more, for a short time, and the subscriber gets what comes there instead of what all get::

    subscriber's agent                              publisher's agent
      asks {route, own, node} ─────────────────────► connects as that subscriber
      ◄── on the route ``own``: a message of that connection, or the number of the same message on ``route``
      ◄── at the end: the number from which the subscriber gets what comes on ``route``

The messages of both connections are compared byte by byte (by a digest), so a message that all get crosses once. What
was sent to the module before the further connection stood, and is still on its way, the joining subscriber gets too.
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
import struct
import time
from collections import deque
from typing import TYPE_CHECKING, Any, Final

from rmpa.bridge import limits, messages
from rmpa.bridge.data.route_sender import RouteSender
from rmpa.core.contract import Contract, History
from rmpa.core.errors import LimitExceeded, RemoteProtocolError, RmpaError
from rmpa.core.identity import is_later, serial_add
from rmpa.core.limits import UINT32_MAX
from rmpa.core.outbox import ABORT, FIRST, LAST, QueuedMessage
from rmpa.ros import limits as ros_limits

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rmpa.bridge.data.export import ExportFlow, ExportRoute
    from rmpa.bridge.data.reception import ImportFlow
    from rmpa.bridge.sessions import PeerSession
    from rmpa.bridge.topics.part import Topics
    from rmpa.mesh.io.link import PeerLink
    from rmpa.ros.node.publication import Publication, SubscriberConnection
    from rmpa.ros.node.subscription import TopicConnection
    from rmpa.runtime.tls import Buffer

_log = logging.getLogger(__name__)

JOIN: Final = "topic.join"
# A length that no message has, the kind, and the number of a message on the route of all.
_MARK: Final = struct.Struct("<IBI")
_SAME, _END = 0, 1
_MESSAGES: Final = 0


def _digest(framed: Buffer) -> bytes:
    return hashlib.blake2b(framed, digest_size=16).digest()


class ServedJoin:
    """The further connection to a publisher for one joining subscriber of a peer.

    Its flow has it beside the senders, so that it sees what all get. A message of the further connection waits for
    the same one of the agent's own connection; if nothing comes there for ``limits.JOIN_HOLD``, or a later one does,
    it is for the subscriber alone.

    Args:
        flow: What the agent gets of the publisher.
        route: The route to the peer, which has it until everything has arrived.
        common: Sends what all get.
        own: Sends to the subscriber.
        link: The link to the peer.
    """

    def __init__(
        self, flow: ExportFlow, route: ExportRoute, common: RouteSender, own: RouteSender, link: PeerLink
    ) -> None:
        self._flow, self._route, self._common, self.own, self._link = flow, route, common, own, link
        self.connection: TopicConnection | None = None
        self._loop = asyncio.get_running_loop()
        self._last = common.last
        # What a latching publisher may repeat to a new connection: the subscriber has it from its own agent.
        self._latched: deque[bytes] = deque(maxlen=limits.JOIN_LATCHED)
        if flow.latching and flow.latched:
            self._latched.append(_digest(flow.latched))
        # Digest and number of what all got and the subscriber did not yet.
        self._seen: deque[tuple[bytes, int]] = deque()
        # Digest, number (if known) and bytes of what came by the further connection.
        self._waiting: deque[tuple[bytes, int | None, bytes]] = deque()
        # When the last message came by either connection; whether one is coming by the agent's own.
        self._came = 0.0
        self._busy = False
        self._alone: deque[bytes] = deque(maxlen=limits.JOIN_REMEMBERED)
        self._timer: asyncio.TimerHandle | None = None
        self._finishing = self._ended = False
        self.drained = False
        self._end = self._loop.call_later(limits.JOIN_WINDOW, self.finish)

    def message(self, _stamp_ns: int, framed: Buffer) -> int:
        """Note what all get."""
        if self._ended:
            return 0
        digest, number, self._busy = _digest(framed), self._common.last, False
        self._came = self._loop.time()
        if self._flow.latching:
            self._latched.append(digest)
        if digest in self._alone:  # it came here so late that the subscriber has it
            self._alone.remove(digest)
            self._last = number
            self._seen.clear()
        else:
            for at, (other, known, whole) in enumerate(self._waiting):
                if other == digest and known is None:
                    self._waiting[at] = digest, number, whole
                    # Published before the further connection stood.
                    self._waiting.extendleft((*one, b"") for one in reversed(self._seen))
                    self._seen.clear()
                    break
            else:
                self._seen.append((digest, number))
        self._flush()
        return 0

    def begin(self, _stamp_ns: int, _size: int) -> None:
        """A message begins; it is needed whole."""
        self._busy = True

    def skip(self, _sequence: int) -> None:
        """What was lost before the next message was lost for all."""

    def drain(self, _done: Callable[[], None]) -> None:
        """The publisher has gone."""
        self.finish()

    def close(self) -> None:
        """End at once: the route of all has ended."""
        self._stop()
        if not self.drained:
            self.drained = True
            self.own.close()
            del self._route.joins[self.own.route]
            self._link.close_route(self.own.route)
            self._flow.joins_changed()

    def connected(self, _fields: object) -> None:
        """The publisher has answered: it has ``limits.JOIN_WINDOW`` to say what it has to say."""
        self._end.cancel()
        self._end = self._loop.call_later(limits.JOIN_WINDOW, self.finish)

    def came(self, framed: Buffer) -> None:
        """Take a message of the further connection."""
        digest = _digest(framed)
        if any(other == digest for other, _ in self._seen):
            while (one := self._seen.popleft())[0] != digest:
                self._waiting.append((*one, b""))
            self._waiting.append((*one, b""))
        elif digest not in self._latched:
            self._waiting.append((digest, None, bytes(framed)))
            self._came = self._loop.time()
        self._flush()

    def finish(self, _reason: str = "") -> None:
        """Close the further connection, and say from where on the subscriber gets what all get."""
        if self._finishing:
            return
        self._finishing = True
        self._disconnect()
        self._end = self._loop.call_later(limits.JOIN_WINDOW, lambda: self._flush(all_of_it=True))
        self._flush()

    def _disconnect(self) -> None:
        self._end.cancel()
        if self.connection is not None:
            self.connection.close()

    def _stop(self) -> None:
        self._ended = self._finishing = True
        self._disconnect()
        if self._timer is not None:
            self._timer.cancel()

    def _flush(self, *, all_of_it: bool = False) -> None:
        if self._ended:
            return
        due = self._came + limits.JOIN_HOLD
        known = any(number is not None for _, number, _ in self._waiting)
        while self._waiting:
            digest, number, whole = self._waiting[0]
            if number is None and not known and not all_of_it and (self._busy or self._loop.time() < due):
                if self._timer is not None:
                    self._timer.cancel()
                if not self._busy:
                    self._timer = self._loop.call_at(due, self._flush)
                return
            self._waiting.popleft()
            if number is None and (known or not all_of_it):  # else it may still come for all
                self._alone.append(digest)
                self.own.message(time.time_ns(), whole)
            elif number is not None:
                self._last = number
                self._mark(_SAME, number)
                known = any(number is not None for _, number, _ in self._waiting)
        if self._finishing:
            self._stop()
            self._mark(_END, serial_add(self._last, 1))
            self.own.drain(self.close)

    def _mark(self, kind: int, number: int) -> None:
        self.own.message(time.time_ns(), _MARK.pack(UINT32_MAX, kind, number))


class JoiningSubscriber:
    """A subscriber that gets the messages of its own connection to the publisher, until it gets what all get.

    Its publication gives it what all get in place of the connection; that is held until its number is named.

    Args:
        connection: The subscriber.
        publication: What it is connected to.
        flow: The route of all.
        link: The link that has its own route until the end.
        own: The number of that.
    """

    def __init__(
        self,
        connection: SubscriberConnection,
        publication: Publication,
        flow: ImportFlow,
        link: PeerLink,
        own: int,
    ) -> None:
        self._connection, self._publication, self._flow, self._link, self._own = (
            connection,
            publication,
            flow,
            link,
            own,
        )
        link.routes[own] = self
        self._held: dict[int, bytes] = {}
        self._held_bytes = 0
        self._whole = bytearray()
        self._part = bytearray()
        # What the publisher's agent has sent and is not given yet: bytes, or kind and number.
        self._given: deque[bytes | tuple[int, int]] = deque()
        self._last: int | None = None
        self._after: int | None = None
        self.ended = False
        self._timer = asyncio.get_running_loop().call_later(3 * limits.JOIN_WINDOW, self.release)

    def send(self, parts: Sequence[Buffer], _key: int) -> int:
        """Hold one message."""
        self._hold(b"".join(parts))
        return 0

    def open(self, key: int, size: int) -> QueuedMessage:
        """Begin a message that comes in parts."""
        self._whole = bytearray()
        return QueuedMessage(key, size)

    def extend(self, message: QueuedMessage, part: Buffer) -> int:
        """Take a part; the last one completes the message."""
        self._whole += part
        if len(self._whole) == message.size:
            self._hold(bytes(self._whole))
        return 0

    def abandon(self, _message: QueuedMessage) -> bool:
        """Drop the message in progress."""
        return False

    def _hold(self, framed: bytes) -> None:
        if self.ended:
            self._connection.send((framed,), _MESSAGES)
            return
        number = self._flow.number
        if self._after is not None and not is_later(number, self._after):
            self._connection.send((framed,), _MESSAGES)
            return
        self._held[number] = framed
        self._held_bytes += len(framed)
        while self._held_bytes > ros_limits.SUBSCRIBER_QUEUE_BYTES and len(self._held) > 1:
            self._held_bytes -= len(self._held.pop(next(iter(self._held))))
        self._give()

    def begin(self, after: int) -> None:
        """The publisher's agent names from now on what comes behind ``after``; what comes before is for all."""
        self._after = self._last = after
        for number in [number for number in self._held if not is_later(number, after)]:
            self._connection.send((self._held.pop(number),), _MESSAGES)
        self._give()

    def message(self, _sequence: int, _stamp_ns: int, framed: memoryview) -> None:
        """Take a message of the subscriber's own connection, or what is said of those of all."""
        if len(framed) == _MARK.size and (mark := _MARK.unpack(framed))[0] == UINT32_MAX:
            _, kind, number = mark
            self._given.append((kind, number))
        else:
            self._given.append(bytes(framed))
        self._give()

    def part(self, sequence: int, stamp_ns: int, flags: int, part: memoryview) -> None:
        """Take a part of a large one.

        Raises:
            LimitExceeded: It is too long.
        """
        if flags & FIRST:
            self._part = bytearray()
        self._part += part
        if len(self._part) > ros_limits.MESSAGE_MAX:
            raise LimitExceeded("message", len(self._part), ros_limits.MESSAGE_MAX)
        if flags & LAST and not flags & ABORT:
            self.message(sequence, stamp_ns, memoryview(self._part))

    def _give(self) -> None:
        while self._after is not None and self._given and not self.ended:
            one = self._given[0]
            if isinstance(one, bytes):
                self._connection.send((one,), _MESSAGES)
            elif one[0] == _END:
                self._last = serial_add(one[1], -1)
                self.release()
                return
            elif (framed := self._held.pop(one[1], None)) is not None:
                self._held_bytes -= len(framed)
                self._last = one[1]
                self._connection.send((framed,), _MESSAGES)
            elif not self._held or not is_later(next(reversed(self._held)), one[1]):
                return  # it is still on its way; else it is lost
            self._given.popleft()

    def release(self) -> None:
        """Give the subscriber the rest of what is held, and from now on what all get."""
        if self.ended:
            return
        self.close()
        for number, framed in self._held.items():
            if self._last is None or is_later(number, self._last):
                self._connection.send((framed,), _MESSAGES)
        self._held.clear()

    def close(self) -> None:
        """End: the subscriber has gone, or all is given."""
        if not self.ended:
            self.ended = True
            self._timer.cancel()
            self._link.routes.pop(self._own, None)
            self._publication.joined(self._connection)


def join(
    part: Topics, session: PeerSession, publication: Publication, flow: ImportFlow, connection: SubscriberConnection
) -> JoiningSubscriber | None:
    """Let the publisher see a new subscriber of an open route here; ``None`` if that is not possible."""
    if not session.linked or flow.contract.max_rate is not None:
        return None
    own = part.imports.next_route(session.peer)
    joining = JoiningSubscriber(connection, publication, flow, session.link, own)
    args = {"route": flow.route, "own": own, "node": connection.caller_id}
    part.tasks.start(_ask(part, session, joining, args), f"join {publication.topic}")
    return joining


async def _ask(part: Topics, session: PeerSession, joining: JoiningSubscriber, args: dict[str, Any]) -> None:
    if joining.ended:  # with its link: the number is one of another route by now
        return
    try:
        after = await part.bridge.rpc.request(session, JOIN, args, limits.JOIN_WINDOW)
        joining.begin(messages.convert(JOIN, after, messages.Sequence))
    except RmpaError as error:
        _log.debug("= %s: a subscriber joins unseen: %s", session.link.name, error)
        joining.release()


def serve(part: Topics, session: PeerSession, args: dict[str, Any]) -> int:
    """Connect to a publisher for a joining subscriber of a peer; return the number of the last message that all got.

    Raises:
        RmpaError: That is not possible.
    """
    match args:
        case {"route": int(number), "own": int(own), "node": str(node)} if 0 < own < limits.SERVICE_ROUTES:
            exports = part.exports
        case _:
            raise RemoteProtocolError(f"{JOIN} names no route")
    route, numbers = exports.route(session.peer, number), [one for of in exports.of(session.peer) for one in of.joins]
    if route is None or route.sender is None or own in numbers or exports.route(session.peer, own) is not None:
        raise RmpaError(f"route {number} is not open")
    if len(numbers) >= limits.JOINS_MAX:
        raise LimitExceeded("joining subscribers", limits.JOINS_MAX + 1, limits.JOINS_MAX)
    flow = exports.flows[route.source]
    sender = RouteSender(session.link, own, Contract(history=History.KEEP_ALL), large=flow.large)
    served = route.joins[own] = ServedJoin(flow, route, route.sender, sender, session.link)
    caller = part.exports.listener(session, node, route.source.topic) or f"{session.proxies.prefix}/joins"
    _log.debug("> %s: %s joins", route.source, caller)
    served.connection = exports.connection(
        route.source,
        flow.uri,
        caller,
        on_message=served.came,
        on_header=served.connected,
        on_refused=served.finish,
        on_lost=served.finish,
    )
    flow.joins_changed()
    served.connection.start()
    return route.sender.last

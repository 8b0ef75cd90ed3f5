"""Both ends of an open service: ``Caller`` at the clients' module, ``Server`` at the server's module."""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict
from functools import partial
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits
from rmpa.bridge.services.io.bodies import BodyReceiver, BodySender, Budget
from rmpa.core.counters import SampleRing
from rmpa.core.identity import SERIAL_MASK
from rmpa.mesh import limits as mesh_limits
from rmpa.ros.wire.tcpros import ServiceDescription

if TYPE_CHECKING:
    from rmpa.bridge.data.io.link_time import LinkTime
    from rmpa.bridge.services.actions import ServiceAbout
    from rmpa.bridge.services.io.connection_pool import ServicePool
    from rmpa.mesh.io.link import PeerLink
    from rmpa.ros.node.service_server import ServiceCall
    from rmpa.runtime.tls import Buffer

_OK: Final = b"\x01"
_FAILED: Final = b"\x00"
_RECENT: Final = 64
"""How many of the latest replies by the bulk lane are reported as lost if its connection is lost. Replies leave
within a link's lease, so only the latest can be lost."""


def description_of(about: ServiceAbout) -> ServiceDescription:
    """The types that a peer tells of its service, as clients get them."""
    return ServiceDescription(about.type, about.md5, about.request_type, about.response_type)


def _text(body: Buffer) -> str:
    """The text of an error in a reply, up to ``limits.CONTROL_TEXT_MAX`` bytes."""
    return bytes(body[: limits.CONTROL_TEXT_MAX]).decode(errors="replace")


class Budgets:
    """Bounds the bytes that the calls of one link hold, each way.

    ``outgoing`` counts requests and replies that this module sends; ``incoming`` counts those that are reassembled
    here, and requests that are being served.
    """

    def __init__(self) -> None:
        self.outgoing = Budget()
        self.incoming = Budget()


class CallStats:
    """Counts and latencies of the calls of one service, shared by all sessions."""

    def __init__(self) -> None:
        self.calls = 0
        self.failed = 0
        self.active = 0
        self.problem = ""
        """The error of the last call that failed, or empty."""
        self.latencies = SampleRing(limits.SERVICE_LATENCIES)
        """Seconds from request to reply, of calls that succeeded."""

    def fail(self, problem: str) -> None:
        """Count a failed call, and store its error."""
        self.failed += 1
        self.problem = problem[: limits.CONTROL_TEXT_MAX]


class Caller(BodyReceiver):
    """Calls one service of a peer, for all clients of this module.

    Args:
        link: The link to the peer.
        requests: The route of requests; the peer has chosen its number.
        what: The service and its peer, for texts.
        budgets: The budgets of the peer's link.
        stats: The counts of the service.
        description: Its types, as its server told them when it was opened.
    """

    def __init__(
        self,
        link: PeerLink,
        requests: int,
        what: str,
        budgets: Budgets,
        stats: CallStats,
        description: ServiceDescription,
    ) -> None:
        super().__init__(budgets.incoming)
        self.description: Final = description
        self._sender = BodySender(link, requests)
        self._what = what
        self._outgoing = budgets.outgoing
        self._stats = stats
        self._loop = asyncio.get_running_loop()
        self._serial = 0
        self._pending: dict[int, tuple[ServiceCall, float, bool]] = {}
        self.used_at = self._loop.time()
        """When a call was last begun or answered, in the event loop's seconds."""

    @property
    def active(self) -> int:
        """The number of calls under way."""
        return len(self._pending)

    def call(self, call: ServiceCall) -> None:
        """Send a call's request; the call ends with the reply, or with an error."""
        stats = self._stats
        stats.calls += 1
        size = len(call.request)
        if not self._outgoing.take(size):
            text = f"{self._what}: more than {self._outgoing.limit >> 20} MiB of calls are under way; try again later"
            stats.fail(text)
            call.fail(text)
            return
        stats.active += 1
        self._serial = serial = self._serial + 1 & SERIAL_MASK
        call.on_gone = partial(self._gone, serial)
        now = self.used_at = self._loop.time()
        self._pending[serial] = (call, now, size > mesh_limits.EXPRESS_MESSAGE_MAX)
        self._sender.send(serial, call.request)

    def body(self, sequence: int, body: bytes | bytearray) -> None:
        """Handle a reply; it is dropped if its call has ended already."""
        call, began, _ = self._pending.pop(sequence, (None, 0.0, False))
        if call is None:
            return
        now = self.used_at = self._loop.time()
        ok = body[:1] == _OK
        self._ended(call)
        if ok:
            self._stats.latencies.add(now - began)
        else:
            self._stats.fail(_text(memoryview(body)[1:]))
        if isinstance(body, bytearray):
            del body[:1]  # costs nothing; a copy of a large one would
            call.reply(ok, body)
        else:
            call.reply(ok, memoryview(body)[1:])

    def failed(self, sequence: int, reason: str) -> None:
        """Fail the call of a reply whose rest was lost."""
        self._fail(sequence, f"{self._what}: its reply was lost on the way: {reason}")

    def lane_lost(self) -> None:
        """Fail the calls with large requests, and drop a reply in parts: the bulk lane's connection is gone.

        It is unknown what was lost with it.
        """
        self.drop("the connection for large messages was lost")
        for sequence, (_, _, bulk) in list(self._pending.items()):
            if bulk:
                self._fail(
                    sequence, f"{self._what}: the connection for large messages was lost in the middle of the call"
                )

    def close(self, reason: str) -> None:
        """Fail the calls under way with this reason, and send nothing more."""
        self._sequence = None
        if self._buffer is not None:
            self._buffer = None
            self._budget.give(self._size)
        for sequence in list(self._pending):
            self._fail(sequence, f"{self._what}: {reason}")
        self._sender.close()

    def _fail(self, sequence: int, text: str) -> None:
        call, _, _ = self._pending.pop(sequence, (None, 0.0, False))
        if call is not None:
            self._ended(call)
            self._stats.fail(text)
            call.fail(text)

    def _gone(self, sequence: int) -> None:
        """End a call whose client has left, or whose deadline is over."""
        call, _, _ = self._pending.pop(sequence, (None, 0.0, False))
        if call is not None:
            self._ended(call)
            late = self._loop.time() >= call.deadline
            self._stats.fail("no answer in time" if late else "the client left in the middle of the call")

    def _ended(self, call: ServiceCall) -> None:
        self._stats.active -= 1
        self._outgoing.give(len(call.request))


class Server(BodyReceiver):
    """Serves one service of this module to one peer.

    Args:
        link: The link to the peer.
        route: The route of replies; the peer has chosen its number.
        pool: The connections to the server.
        timeout: Seconds that the peer waits for a reply.
        budgets: The budgets of the peer's link.
        stats: The counts of the service.
        link_time: The peer's clock.
    """

    def __init__(
        self,
        link: PeerLink,
        route: int,
        pool: ServicePool,
        timeout: float,
        budgets: Budgets,
        stats: CallStats,
        link_time: LinkTime,
    ) -> None:
        super().__init__(budgets.incoming)
        self._link = link
        self._time = link_time
        self._sender: BodySender | None = BodySender(link, route)
        self._pool = pool
        self._timeout = timeout
        self._outgoing = budgets.outgoing
        self._stats = stats
        self._loop = asyncio.get_running_loop()
        self._recent: OrderedDict[int, None] = OrderedDict()

    def body(self, sequence: int, body: bytes | bytearray) -> None:
        """Pass a request to the server, unless its caller has given it up: it must not act then."""
        stats, size = self._stats, len(body)
        stats.calls += 1
        if late := self._late():
            self._reply_failed(sequence, late)
            return
        if not self._budget.take(size):
            self._reply_failed(sequence, f"more than {self._budget.limit >> 20} MiB of requests are being served")
            return
        stats.active += 1
        timeout = self._timeout + limits.SERVICE_GRACE
        self._pool.call(body, timeout, partial(self._answered, sequence, size, self._loop.time()))

    def _late(self) -> str:
        """Why the caller waits no longer for the present request; empty while it may."""
        if self._link.abandoned:
            return "this agent was stopped when the request came, and the caller has given it up"
        error = self._time.error_ns
        age = time.time_ns() - self._stamp_ns + self._time.ahead_ns
        if error is not None and age - error > self._timeout * 1e9:
            return f"the request came {age / 1e9:.1f} s late; the caller waits for {self._timeout:g} s"
        return ""

    def failed(self, sequence: int, reason: str) -> None:
        """Reply with an error to a request whose rest was lost."""
        self._stats.calls += 1
        self._reply_failed(sequence, f"the request was lost on its way: {reason}")

    def lane_lost(self) -> None:
        """Send an error for each call whose reply may have been lost with the bulk lane's connection."""
        self.drop("the connection for large messages was lost")
        for sequence in self._recent:
            self._send(sequence, False, b"the connection for large messages was lost behind the call")
        self._recent.clear()

    def close(self) -> None:
        """Send nothing more: the replies of calls that are being served are dropped."""
        sender, self._sender = self._sender, None
        if sender is not None:
            sender.close()
        if self._buffer is not None:
            self._sequence = self._buffer = None
            self._budget.give(self._size)

    def _answered(self, sequence: int, size: int, began: float, ok: bool, body: Buffer) -> None:
        self._budget.give(size)
        stats = self._stats
        stats.active -= 1
        if ok:
            stats.latencies.add(self._loop.time() - began)
        else:
            stats.fail(_text(body))
        if not self._outgoing.take(len(body)):
            self._reply_failed(sequence, f"more than {self._outgoing.limit >> 20} MiB of replies wait for the link")
        elif not self._send(sequence, ok, body, self._outgoing):
            self._recent[sequence] = None
            if len(self._recent) > _RECENT:
                self._recent.popitem(last=False)

    def _reply_failed(self, sequence: int, reason: str) -> None:
        text = f"service [{self._pool.service}]: {reason}"
        self._stats.fail(text)
        self._send(sequence, False, text.encode())

    def _send(self, sequence: int, ok: bool, body: Buffer, budget: Budget | None = None) -> bool:
        """Send a reply; return whether it took the express lane, or was dropped after ``close``.

        Args:
            sequence: The number of the call.
            ok: Whether the call succeeded.
            body: The response, or the text of the error.
            budget: Gets the body's bytes back when they were sent or dropped.
        """
        if self._sender is not None:
            return not self._sender.send(sequence, body, _OK if ok else _FAILED, budget)
        if budget is not None:
            budget.give(len(body))
        return True

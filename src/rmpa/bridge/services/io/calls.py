"""Both ends of an open service: ``Caller`` where the clients are, ``Server`` where the server is."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from functools import partial
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits
from rmpa.bridge.services.io.bodies import BodyReceiver, BodySender, Budget
from rmpa.core.serial_number import SERIAL_MASK
from rmpa.core.stats import SampleRing
from rmpa.mesh import limits as mesh_limits

if TYPE_CHECKING:
    from rmpa.bridge.services.io.bodies import BodyLink
    from rmpa.bridge.services.io.connection_pool import ServicePool
    from rmpa.ros.node.service_server import ServiceCall
    from rmpa.runtime.stream import Buffer

_OK: Final = b"\x01"
_FAILED: Final = b"\x00"
_RECENT: Final = 64
"""Large replies that may be lost with the bulk lane; they leave within a lease, so only some can be."""


def _text(body: Buffer) -> str:
    """The text of an error, as far as it is kept."""
    return bytes(body[: limits.CONTROL_TEXT_MAX]).decode(errors="replace")


class Budgets:
    """What the calls of one link may hold.

    Args:
        outgoing: Requests and replies that we send.
        incoming: Those that are put together here, and requests that are being served.
    """

    def __init__(self) -> None:
        self.outgoing = Budget()
        self.incoming = Budget()


class CallStats:
    """What became of a service's calls; shared by all sessions of one service."""

    def __init__(self) -> None:
        self.calls = 0
        self.failed = 0
        self.active = 0
        self.problem = ""
        """Of the last call that failed on our way."""
        self.latencies = SampleRing(limits.SERVICE_LATENCIES)
        """Seconds from a request to its reply, of those that went well."""

    def fail(self, problem: str) -> None:
        """A call failed."""
        self.failed += 1
        self.problem = problem[: limits.CONTROL_TEXT_MAX]


class Caller(BodyReceiver):
    """Calls one service of a peer, for all clients of this module.

    Args:
        link: The peer's.
        requests: The route that requests go out on; the peer's.
        what: The service and its peer, for texts.
        budgets: The peer's.
        stats: Of the service.
    """

    def __init__(self, link: BodyLink, requests: int, what: str, budgets: Budgets, stats: CallStats) -> None:
        super().__init__(budgets.incoming)
        self._sender = BodySender(link, requests)
        self._what = what
        self._outgoing = budgets.outgoing
        self._stats = stats
        self._loop = asyncio.get_running_loop()
        self._serial = 0
        self._pending: dict[int, tuple[ServiceCall, float, bool]] = {}
        self.used_at = self._loop.time()
        """When it was last used."""

    @property
    def active(self) -> int:
        """Calls under way."""
        return len(self._pending)

    def call(self, call: ServiceCall) -> None:
        """Make a call; it is answered by the reply, or by an error."""
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
        """A reply came; one that is not waited for any more is dropped."""
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
        """A reply had begun, and the rest does not come."""
        self._fail(sequence, f"{self._what}: its reply was lost on the way: {reason}")

    def lane_lost(self) -> None:
        """The bulk lane's connection is gone, and it is unknown what was lost with it."""
        self.drop("the connection for large messages was lost")
        for sequence, (_, _, bulk) in list(self._pending.items()):
            if bulk:
                self._fail(
                    sequence, f"{self._what}: the connection for large messages was lost in the middle of the call"
                )

    def close(self, reason: str) -> None:
        """No more calls can be made; those under way get an error."""
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
        """The client has left, or the deadline is over."""
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
        link: The peer's.
        route: The route that replies go out on; the peer's.
        pool: The connections to the server.
        timeout: Seconds that the peer waits for a reply.
        budgets: The peer's.
        stats: Of the service.
    """

    def __init__(
        self, link: BodyLink, route: int, pool: ServicePool, timeout: float, budgets: Budgets, stats: CallStats
    ) -> None:
        super().__init__(budgets.incoming)
        self._sender: BodySender | None = BodySender(link, route)
        self._pool = pool
        self._timeout = timeout
        self._outgoing = budgets.outgoing
        self._stats = stats
        self._loop = asyncio.get_running_loop()
        self._recent: OrderedDict[int, None] = OrderedDict()

    def body(self, sequence: int, body: bytes | bytearray) -> None:
        """A request came."""
        stats, size = self._stats, len(body)
        stats.calls += 1
        if not self._budget.take(size):
            self._reply_failed(sequence, f"more than {self._budget.limit >> 20} MiB of requests are being served")
            return
        stats.active += 1
        timeout = self._timeout + limits.SERVICE_GRACE
        self._pool.call(body, timeout, partial(self._answered, sequence, size, self._loop.time()))

    def failed(self, sequence: int, reason: str) -> None:
        """A request had begun, and the rest does not come."""
        self._stats.calls += 1
        self._reply_failed(sequence, f"the request was lost on its way: {reason}")

    def lane_lost(self) -> None:
        """The bulk lane's connection is gone: calls fail whose replies may have been on it."""
        self.drop("the connection for large messages was lost")
        for sequence in self._recent:
            self._send(sequence, False, b"the connection for large messages was lost behind the call")
        self._recent.clear()

    def close(self) -> None:
        """The peer calls no more; what is being served is not answered."""
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
        """Send a reply, and give the budget its bytes back when it has left; whether it took the express lane."""
        if self._sender is not None:
            return not self._sender.send(sequence, body, _OK if ok else _FAILED, budget)
        if budget is not None:
            budget.give(len(body))
        return True

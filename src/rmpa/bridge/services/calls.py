"""Both ends of a service: ``ShownService`` at the clients' module, ``Server`` at the server's module."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits
from rmpa.bridge.services.bodies import (
    BodyReceiver,
    BodySender,
    Budget,
    Done,
    LocalService,
    ServicePool,
)
from rmpa.core.errors import ConfigError, RmpaError
from rmpa.core.identity import SERIAL_MASK, is_type_name
from rmpa.mesh import limits as mesh_limits
from rmpa.ros.http.rpc import is_own_name
from rmpa.ros.node.listeners import local_addresses
from rmpa.ros.wire.tcpros import ServiceDescription, parse_service_uri
from rmpa.runtime.kernel_tcp import ask_listening_ports
from rmpa.runtime.loop import sleep_to_tick, yielding_to_data
from rmpa.runtime.tasks import OwnedTasks, end_tasks, keep_task

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping

    from rmpa.bridge.bridge import Bridge
    from rmpa.bridge.data.reception import LinkTime
    from rmpa.bridge.services.books import RemoteService, ServiceExports, ServiceRoute
    from rmpa.bridge.sessions import PeerSession
    from rmpa.mesh.io.link import PeerLink
    from rmpa.ros.node.service_server import ServiceCall, ServiceEndpoint
    from rmpa.ros.node.slave_node import SlaveNode
    from rmpa.runtime.tls import Buffer

_OK: Final = b"\x01"
_FAILED: Final = b"\x00"


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
    """Counts and latencies of the calls of one service, shared by all sessions.

    Attributes:
        problem: The error of the last call that failed, or empty.
        latencies: Seconds from request to reply, of calls that succeeded.
    """

    def __init__(self) -> None:
        self.calls = 0
        self.failed = 0
        self.active = 0
        self.problem = ""
        self.latencies: deque[float] = deque(maxlen=limits.SERVICE_LATENCIES)

    def fail(self, problem: str) -> None:
        """Count a failed call, and store its error."""
        self.failed += 1
        self.problem = problem[: limits.CONTROL_TEXT_MAX]


class ShownService(BodyReceiver):
    """A peer's service in the local graph, and its calls by all clients of this module.

    Args:
        remote: The service.
        session: The peer.
        want: ``(self)``: called when calls, or questions for its types, wait until it is open.

    Attributes:
        stats: Counts and latencies of its calls.
        proxy: The proxy of its node; ``None`` until that exists.
        endpoint: The endpoint that clients connect to; ``None`` until the proxy exists.
        mismatch: The error that the last client with another MD5 sum got; empty if there was none.
        description: Its types, as its server told them when it was opened.
        asking: Questions for its types that wait until it is open.
        used_at: When a call was last begun or answered, in the event loop's seconds.
    """

    def __init__(self, remote: RemoteService, session: PeerSession, want: Callable[[ShownService], None]) -> None:
        super().__init__(Budget())  # that of the link is taken when it is opened
        self.remote = remote
        self.session = session
        self.stats = CallStats()
        self.proxy: SlaveNode | None = None
        self.endpoint: ServiceEndpoint | None = None
        self.mismatch = ""
        self.description: ServiceDescription | None = None
        self.asking: list[asyncio.Future[ServiceDescription | str]] = []
        self.used_at = 0.0
        self._want = want
        self._loop = asyncio.get_running_loop()
        self._sender: BodySender | None = None
        self._outgoing = self._budget
        self._serial = 0
        self._pending: dict[int, tuple[ServiceCall, float, bool]] = {}
        self._waiting: list[ServiceCall] = []

    @property
    def text(self) -> str:
        """The service and its peer, for texts."""
        return f"service [{self.remote.name}] of {self.session.link.name}"

    @property
    def is_open(self) -> bool:
        """Whether it can be called now."""
        return self._sender is not None

    @property
    def active(self) -> int:
        """The number of calls under way."""
        return len(self._pending)

    @property
    def wanted(self) -> bool:
        """Whether something waits until it is open."""
        return bool(self._waiting or self.asking)

    def open(self, about: ServiceDescription, budgets: Budgets) -> None:
        """Begin to call it: requests go out on ``remote.requests``; ``budgets`` are those of the peer's link."""
        self._sender = BodySender(self.session.link, self.remote.requests)
        self._budget, self._outgoing = budgets.incoming, budgets.outgoing
        self.description, self.used_at = about, self._loop.time()
        self._answer(about)
        waiting, self._waiting = self._waiting, []
        for call in waiting:
            self.call(call)

    def call(self, call: ServiceCall) -> None:
        """Send a call's request, or have it wait; the call ends with the reply, or with an error. The hot path."""
        sender, stats = self._sender, self.stats
        if sender is None:
            self._waiting.append(call)
            call.on_gone = lambda: self._waiting.remove(call) if call in self._waiting else None
            self._want(self)
            return
        stats.calls += 1
        size = len(call.request)
        if not self._outgoing.take(size):
            text = f"{self.text}: more than {self._outgoing.limit >> 20} MiB of calls are under way; try again later"
            stats.fail(text)
            call.fail(text)
            return
        stats.active += 1
        self._serial = serial = self._serial + 1 & SERIAL_MASK
        call.on_gone = partial(self._gone, serial)
        now = self.used_at = self._loop.time()
        self._pending[serial] = (call, now, size > mesh_limits.EXPRESS_MESSAGE_MAX)
        sender.send(serial, call.request)

    def body(self, sequence: int, body: bytes | bytearray) -> None:
        """Handle a reply; it is dropped if its call has ended already."""
        if (found := self._end(sequence)) is None:
            return
        call, began, _ = found
        now = self.used_at = self._loop.time()
        ok = body[:1] == _OK
        if ok:
            self.stats.latencies.append(now - began)
        else:
            self.stats.fail(_text(memoryview(body)[1:]))
        if isinstance(body, bytearray):
            del body[:1]  # costs nothing; a copy of a large one would
            call.reply(ok, body)
        else:
            call.reply(ok, memoryview(body)[1:])

    def failed(self, sequence: int, reason: str) -> None:
        """Fail the call of a reply whose rest was lost."""
        self._fail(sequence, f"its reply was lost on the way: {reason}")

    def lane_lost(self) -> None:
        """Fail the calls with large requests, and drop a reply in parts: the bulk lane's connection is gone.

        It is unknown what was lost with it.
        """
        self.drop("the connection for large messages was lost")
        for sequence, (_, _, bulk) in list(self._pending.items()):
            if bulk:
                self._fail(sequence, "the connection for large messages was lost in the middle of the call")

    def close(self, reason: str) -> None:
        """Call it no more: the calls under way fail with this reason, and so do those that wait."""
        self.discard()
        for sequence in list(self._pending):
            self._fail(sequence, reason)
        if self._sender is not None:
            self._sender.close()
            self._sender = None
        self.fail_waiting(f"{self.text}: {reason}")

    def fail_waiting(self, text: str) -> None:
        """End what waits until it is open with an error."""
        self._answer(text)
        waiting, self._waiting = self._waiting, []
        for call in waiting:
            self.stats.calls += 1
            self.stats.fail(text)
            call.fail(text)

    def _answer(self, about: ServiceDescription | str) -> None:
        asking, self.asking = self.asking, []
        for future in asking:
            if not future.done():
                future.set_result(about)

    def _fail(self, sequence: int, reason: str) -> None:
        if (found := self._end(sequence)) is not None:
            text = f"{self.text}: {reason}"
            self.stats.fail(text)
            found[0].fail(text)

    def _gone(self, sequence: int) -> None:
        """End a call whose client has left, or whose deadline is over."""
        if (found := self._end(sequence)) is not None:
            late = self._loop.time() >= found[0].deadline
            self.stats.fail("no answer in time" if late else "the client left in the middle of the call")

    def _end(self, sequence: int) -> tuple[ServiceCall, float, bool] | None:
        found = self._pending.pop(sequence, None)
        if found is not None:
            self.stats.active -= 1
            self._outgoing.give(len(found[0].request))
        return found


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
        self._sender = BodySender(link, route)
        self._pool = pool
        self._timeout = timeout
        self._outgoing = budgets.outgoing
        self._stats = stats
        self._loop = asyncio.get_running_loop()
        # The latest replies by the bulk lane. They leave within a link's lease, so only these can be lost with it.
        self._recent: deque[int] = deque(maxlen=64)

    def body(self, sequence: int, body: bytes | bytearray) -> None:
        """Pass a request to the server, unless its caller has given it up: it must not act then."""
        stats, size = self._stats, len(body)
        stats.calls += 1
        if not self._budget.take(size):
            self._reply_failed(sequence, f"more than {self._budget.limit >> 20} MiB of requests are being served")
            return
        done = partial(self._answered, sequence, size, self._loop.time())
        self._link.when_proven(partial(self._pass, body, self._stamp_ns, done))

    def _pass(self, body: bytes | bytearray, stamp_ns: int, done: Done) -> None:
        self._stats.active += 1
        if late := self._late(stamp_ns):
            done(False, f"service [{self._pool.service}]: {late}".encode())
        else:
            self._pool.call(body, self._timeout + limits.SERVICE_GRACE, done)

    def _late(self, stamp_ns: int) -> str:
        """Why the caller waits no longer for a request that was sent then; empty while it may."""
        if self._sender.closed:
            return "the caller has left"
        error = self._time.error_ns
        age = time.time_ns() - stamp_ns + self._time.ahead_ns
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
            self._sender.send(sequence, b"the connection for large messages was lost behind the call", _FAILED)
        self._recent.clear()

    def close(self) -> None:
        """Send nothing more: the replies of calls that are being served are dropped."""
        self._sender.close()
        self.discard()

    def _answered(self, sequence: int, size: int, began: float, ok: bool, body: Buffer) -> None:
        self._budget.give(size)
        stats = self._stats
        stats.active -= 1
        if ok:
            stats.latencies.append(self._loop.time() - began)
        else:
            stats.fail(_text(body))
        if not self._outgoing.take(len(body)):
            self._reply_failed(sequence, f"more than {self._outgoing.limit >> 20} MiB of replies wait for the link")
        elif self._sender.send(sequence, body, _OK if ok else _FAILED, self._outgoing):
            self._recent.append(sequence)

    def _reply_failed(self, sequence: int, reason: str) -> None:
        text = f"service [{self._pool.service}]: {reason}"
        self._stats.fail(text)
        self._sender.send(sequence, text.encode(), _FAILED)


_MD5_LENGTH: Final = 32


class Serving:
    """The servers that peers call, and what they say of their services.

    Args:
        bridge: The local core, and the peers.
        exports: What peers may call; it gets the servers' answers.
        budgets: The budgets of the links, by peer number.
    """

    def __init__(self, bridge: Bridge, exports: ServiceExports, budgets: Mapping[int, Budgets]) -> None:
        self._core = bridge.core
        self._sessions = bridge.sessions
        self._exports = exports
        self._budgets = budgets
        self.stats: dict[str, CallStats] = {}
        self._pools: dict[str, ServicePool] = {}
        self._tasks = OwnedTasks()
        self._looking: asyncio.Task[None] | None = None

    def look_after(self) -> None:
        """Check that servers live, for as long as services are offered: a module without any sleeps meanwhile."""
        if self._exports.offered and (self._looking is None or self._looking.done()):
            self._looking = keep_task(self._look_after, "servers' liveness")

    async def close(self) -> None:
        """End all calls and all connections to servers."""
        await end_tasks(self._looking, *self._tasks)
        pools, self._pools = list(self._pools.values()), {}
        for pool in pools:
            pool.close("the agent ends")
            await pool.closed()

    def probe(self, service: str, server: LocalService) -> None:
        """Ask a server for its types; the answer goes to the exports."""
        self._tasks.start(self._ask_server(service, server), f"describe {service}")

    def serve(self, peer: int, number: int, route: ServiceRoute, server: LocalService) -> None:
        """Serve a peer's calls: requests come in on ``route.requests``, replies go out on the route ``number``."""
        session = self._sessions.get(peer)
        if session is None or not session.linked:
            return
        pool, stats = self._pool(route.service, server), self.stats.setdefault(route.service, CallStats())
        budgets = self._budgets[peer]
        served = Server(session.link, number, pool, route.timeout, budgets, stats, session.time)
        session.link.routes[route.requests] = served

    def end_route(self, peer: int, requests: int) -> None:
        """End an open route: no more requests come, and replies of calls under way are dropped."""
        session = self._sessions.get(peer)
        server = session.link.routes.pop(requests, None) if session is not None else None
        if isinstance(server, Server):
            server.close()

    def server_gone(self, service: str) -> None:
        """Close the connections to a server that left or was replaced."""
        pool = self._pools.pop(service, None)
        if pool is not None:
            pool.close("its server has gone")

    def close_idle(self, before: float) -> None:
        """Close the connections to servers that were not used since ``before`` (``loop.time()``).

        The counts of services that have left the local graph are dropped too.
        """
        for service, pool in list(self._pools.items()):
            pool.close_idle(before)
            if pool.unused and not self._exports.callers(service):
                del self._pools[service]
        for service in [one for one in self.stats if one not in self._exports.seen]:
            del self.stats[service]

    def _pool(self, service: str, server: LocalService) -> ServicePool:
        pool = self._pools.get(service)
        if pool is None or pool.server != server:
            if pool is not None:
                pool.close("its server has restarted")
            pool = ServicePool(service, server, lambda: self._core.suspect(server.node))
            self._pools[service] = pool
        return pool

    async def _ask_server(self, service: str, server: LocalService) -> None:
        try:
            told = await self._pool(service, server).describe()
        except RmpaError as error:
            self._exports.refused(service, server, str(error))
            return
        if not is_type_name(told.type) or len(told.md5sum) != _MD5_LENGTH:
            text = f"service [{service}]: its server says neither type nor md5 sum (but {told})"
            self._exports.refused(service, server, text)
            return
        self._exports.described(service, server, told)

    async def _look_after(self) -> None:
        """Find killed servers: a node with an offered service whose port has no listener is suspected."""
        while servers := list(self._exports.offered.items()):
            ports, here, cost = await asyncio.to_thread(_listening)
            for service, server in yielding_to_data(servers):
                if self._exports.offered.get(service) == server and _is_deaf(server, ports, here):
                    self._core.suspect(server.node)
            await sleep_to_tick(max(limits.SERVER_LOOK, 50 * cost))  # at most 2 % of the processor's time


def _listening() -> tuple[set[int] | None, frozenset[str], float]:
    """Returns the listening ports, this machine's addresses, and the processor seconds that it took; for a thread.

    The ports are ``None`` if the kernel cannot be asked.
    """
    began = time.thread_time()
    try:
        ports, here = ask_listening_ports(), frozenset(local_addresses())
    except OSError:  # no file descriptor is left to ask the kernel; the next check may succeed
        ports, here = None, frozenset()
    return ports, here, time.thread_time() - began


def _is_deaf(server: LocalService, ports: set[int] | None, here: Collection[str]) -> bool:
    """Whether a server on this machine does not listen.

    ``False`` for servers on other machines, and when the ports are unknown.
    """
    try:
        host, port = parse_service_uri(server.uri)
    except ConfigError:
        return False
    local = is_own_name(host) or host.startswith("127.") or host in here
    return local and ports is not None and port not in ports

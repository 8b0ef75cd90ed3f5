"""Serves services of this module to peers: a pool of connections to each server, and checks that servers live."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits
from rmpa.bridge.services.actions import (
    EndRoute,
    ExportAction,
    LocalService,
    Probe,
    ServerGone,
    ServeRoute,
    ServiceAbout,
)
from rmpa.bridge.services.io.calls import Budgets, CallStats, Server
from rmpa.bridge.services.io.connection_pool import ServicePool
from rmpa.core.errors import ConfigError, RmpaError
from rmpa.core.identity import is_type_name
from rmpa.ros.core.liveness import listening_ports
from rmpa.ros.http.rpc import is_own_name
from rmpa.ros.node.listeners import local_addresses
from rmpa.ros.wire.tcpros import parse_service_uri
from rmpa.runtime.loop import sleep_to_tick, yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Coroutine, Mapping

    from rmpa.bridge.services.exports import ServiceExports
    from rmpa.bridge.session.peer_sessions import PeerSessions
    from rmpa.ros.core.api import Core

_MD5_LENGTH: Final = 32
_LOOK_SHARE: Final = 50
"""The checks of the servers' ports take at most one in this many seconds of processor time."""


class Serving:
    """Carries out the actions of the outbound plan.

    Args:
        core: The local core.
        exports: The outbound plan; it gets the servers' answers.
        sessions: The peers' sessions.
        budgets: The budgets of the links, by peer number.
        act: Carries out the actions that the plan returns for a server's answer.
    """

    def __init__(
        self,
        core: Core,
        exports: ServiceExports,
        sessions: PeerSessions,
        budgets: Mapping[int, Budgets],
        act: Callable[[list[ExportAction]], None],
    ) -> None:
        self._core = core
        self._exports = exports
        self._sessions = sessions
        self._budgets = budgets
        self._act = act
        self.stats: dict[str, CallStats] = {}
        self._servers: dict[tuple[int, int], Server] = {}
        self._pools: dict[str, ServicePool] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._offering = asyncio.Event()

    def start(self) -> None:
        """Begin to check that servers live."""
        self._spawn(self._look_after(), "servers' liveness")

    async def close(self) -> None:
        """End all calls and all connections to servers."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        pools, self._pools = list(self._pools.values()), {}
        for pool in pools:
            pool.close("the agent ends")
            await pool.closed()

    def changed(self) -> None:
        """Begin with the checks again, if services are offered now."""
        if self._exports.offered:
            self._offering.set()

    def do(self, action: ExportAction) -> None:
        """Carry out one action."""
        self.changed()
        match action:
            case Probe():
                self._spawn(self._ask_server(action), f"describe {action.service}")
            case ServeRoute():
                self._serve(action)
            case EndRoute():
                server = self._servers.pop((action.peer, action.requests), None)
                if server is not None:
                    server.close()
                session = self._sessions.get(action.peer)
                if session is not None:
                    session.handlers.pop(action.requests, None)
            case ServerGone():
                pool = self._pools.pop(action.service, None)
                if pool is not None:
                    pool.close("its server has gone")

    def lane_lost(self, peer: int) -> None:
        """Report the calls whose replies may be lost: the bulk lane's connection to a peer is gone."""
        for (owner, _), server in list(self._servers.items()):
            if owner == peer:
                server.lane_lost()

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

    # --- inside ---------------------------------------------------------------------------------------------

    def _spawn(self, work: Coroutine[None, None, None], name: str) -> None:
        task = asyncio.get_running_loop().create_task(work, name=name)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def _pool(self, service: str, server: LocalService) -> ServicePool:
        pool = self._pools.get(service)
        if pool is None or pool.server != server:
            if pool is not None:
                pool.close("its server has restarted")
            pool = ServicePool(service, server, lambda: self._core.suspect(server.node))
            self._pools[service] = pool
        return pool

    async def _ask_server(self, action: Probe) -> None:
        try:
            told = await self._pool(action.service, action.server).describe()
        except RmpaError as error:
            self._act(self._exports.refused(action.service, action.server, str(error)))
            return
        if not is_type_name(told.type) or len(told.md5sum) != _MD5_LENGTH:
            text = f"service [{action.service}]: its server says neither type nor md5 sum (but {told})"
            self._act(self._exports.refused(action.service, action.server, text))
            return
        about = ServiceAbout(told.type, told.md5sum, told.request_type, told.response_type)
        self._act(self._exports.described(action.service, action.server, about))

    def _serve(self, action: ServeRoute) -> None:
        session = self._sessions.get(action.peer)
        if session is None or not session.linked:
            return
        server = Server(
            session.link,
            action.route,
            self._pool(action.service, action.server),
            action.timeout,
            self._budgets[action.peer],
            self.stats.setdefault(action.service, CallStats()),
            session.time,
        )
        self._servers[action.peer, action.requests] = server
        session.handlers[action.requests] = server

    async def _look_after(self) -> None:
        """Find killed servers: a node with an offered service whose port has no listener is suspected."""
        while True:
            if not self._exports.offered:
                self._offering.clear()
                await self._offering.wait()
            servers = dict(self._exports.offered)
            ports, here, cost = await asyncio.to_thread(_listening)
            for service, server in yielding_to_data(list(servers.items())):
                if self._exports.offered.get(service) == server and _is_deaf(server, ports, here):
                    self._core.suspect(server.node)
            await sleep_to_tick(max(limits.SERVER_LOOK, _LOOK_SHARE * cost))


def _listening() -> tuple[set[int] | None, frozenset[str], float]:
    """Returns the listening ports, this machine's addresses, and the processor seconds that it took; for a thread.

    The ports are ``None`` if the kernel cannot be asked.
    """
    began = time.thread_time()
    try:
        ports, here = listening_ports(), frozenset(local_addresses())
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

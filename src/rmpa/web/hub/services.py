"""Services that clients call: a few open connections to each server, shared by all clients."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rmpa.config.peer_rules import Access
from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.ros import limits as ros_limits
from rmpa.ros.node.endpoints import probe
from rmpa.ros.node.service_client import ServiceConnection, ServiceFailed
from rmpa.ros.wire.tcpros import ANY
from rmpa.web import limits

if TYPE_CHECKING:
    from rmpa.ros.wire.tcpros import ServiceDescription
    from rmpa.web.hub.node_link import NodeLink
    from rmpa.web.hub.requests import Payload


@dataclass(frozen=True, slots=True)
class FoundService:
    """What a server has said of its service."""

    type: str
    uri: str


@dataclass(slots=True, eq=False)
class _Server:
    """The connections to the server of one service, for one md5 sum."""

    slots: asyncio.Semaphore
    idle: list[tuple[ServiceConnection, float]] = field(default_factory=list)
    busy: set[ServiceConnection] = field(default_factory=set)
    users: int = 0


class ServiceCalls:
    """Calls services, and asks servers for their types.

    Args:
        link: Has the node.
    """

    def __init__(self, link: NodeLink) -> None:
        self._link = link
        self._servers: dict[tuple[str, str], _Server] = {}
        self._sweep: asyncio.TimerHandle | None = None
        self._found: dict[str, FoundService] = {}
        self._finding: dict[str, asyncio.Future[FoundService]] = {}
        self._probes = asyncio.Semaphore(limits.PROBES_AT_ONCE)

    @property
    def found(self) -> dict[str, FoundService]:
        """What is known of services, by name."""
        return self._found

    async def call(self, service: str, md5sum: str, request: Payload, timeout: float | None) -> Payload:  # noqa: ASYNC109
        """Call a service.

        Args:
            service: The global name.
            md5sum: Of its type; empty for any.
            request: Serialized.
            timeout: Seconds for all; ``None`` for ``limits.CALL_TIMEOUT``.

        Returns:
            The serialized response.

        Raises:
            RmpaError: The call failed; the text says why.
        """
        self._link.rules.check(Access.CALL, service)
        seconds = limits.CALL_TIMEOUT if timeout is None else min(timeout, limits.CALL_TIMEOUT_MAX)
        key = service, md5sum or ANY
        server = self._servers.get(key)
        if server is None:
            server = self._servers[key] = _Server(asyncio.Semaphore(limits.CALLS_AT_ONCE))
        if server.users >= limits.CALLS_WAITING + limits.CALLS_AT_ONCE:
            raise ServiceFailed(service, f"{limits.CALLS_WAITING} calls wait for its server already", sent=False)
        server.users += 1
        try:
            async with asyncio.timeout(seconds), server.slots:
                ok, body = await self._exchange(server, key, request)
        except TimeoutError:
            raise ServiceFailed(service, f"no answer within {seconds:g} s") from None
        finally:
            server.users -= 1
            if not server.users and not server.idle and self._servers.get(key) is server:
                del self._servers[key]
        if not ok:
            raise PeerRefused(f"service {service}", str(bytes(body), "utf-8", "replace"))
        return body

    async def find(self, service: str) -> FoundService:
        """Ask a service's server for its type; the answer is kept until ``forget``.

        Raises:
            RmpaError: There is no such service, or its server does not answer.
        """
        found = self._found.get(service)
        if found is not None:
            return found
        asked = self._finding.get(service)
        if asked is None:
            asked = self._finding[service] = asyncio.ensure_future(self._probe(service))
            asked.add_done_callback(lambda _: self._finding.pop(service, None))
        return await asyncio.shield(asked)

    def forget(self, service: str) -> None:
        """The service has another provider, or none: forget what is known of it, and connect anew."""
        self._found.pop(service, None)
        for (name, _), server in self._servers.items():
            if name == service:
                for connection, _ in server.idle:
                    connection.close()
                server.idle.clear()

    async def close(self) -> None:
        """Close all connections; the callers have been cancelled before."""
        if self._sweep is not None:
            self._sweep.cancel()
        asked = [*self._finding.values()]
        for each in asked:
            each.cancel()
        await asyncio.gather(*asked, return_exceptions=True)
        for server in self._servers.values():
            for connection in [*(each for each, _ in server.idle), *server.busy]:
                connection.close()
        self._servers.clear()

    # --- inside -----------------------------------------------------------------------------------------------

    async def _exchange(
        self, server: _Server, key: tuple[str, str], request: Payload
    ) -> tuple[bool, bytes | bytearray]:
        while True:
            connection, fresh = await self._take(server, key)
            server.busy.add(connection)
            try:
                result = await connection.call(request)
            except ServiceFailed as error:
                connection.close()
                if error.sent or fresh:
                    raise
            except BaseException:
                connection.close()
                raise
            else:
                self._give_back(server, connection)
                return result
            finally:
                server.busy.discard(connection)

    async def _take(self, server: _Server, key: tuple[str, str]) -> tuple[ServiceConnection, bool]:
        while server.idle:
            connection, _ = server.idle.pop()
            if not connection.closed:
                return connection, False
        service, md5sum = key
        node = self._link.need()
        uri = await node.lookup_service(service)
        return await ServiceConnection.open(uri, service, node.name, md5sum=md5sum), True

    def _give_back(self, server: _Server, connection: ServiceConnection) -> None:
        loop = asyncio.get_running_loop()
        if not connection.closed:
            server.idle.append((connection, loop.time()))
        if self._sweep is None:
            self._sweep = loop.call_later(limits.CALL_IDLE, self._close_unused)

    def _close_unused(self) -> None:
        loop = asyncio.get_running_loop()
        self._sweep = None
        before = loop.time() - limits.CALL_IDLE
        for key, server in [*self._servers.items()]:
            for connection, since in server.idle:
                if since <= before:
                    connection.close()
            server.idle = [each for each in server.idle if not each[0].closed]
            if not server.users and not server.idle:
                del self._servers[key]
        if self._servers:
            self._sweep = loop.call_later(limits.CALL_IDLE / 2, self._close_unused)

    async def _probe(self, service: str) -> FoundService:
        async with self._probes:
            node = self._link.need()
            uri = await node.lookup_service(service)
            opened = await probe(uri, service, node.name, ros_limits.SERVICE_OPEN_TIMEOUT)
        description: ServiceDescription = opened.description
        if not description.type or description.type == ANY:
            raise RmpaError(f"the server of {service} does not tell its type")
        found = self._found[service] = FoundService(description.type, uri)
        return found

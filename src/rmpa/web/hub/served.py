"""Services that clients offer: the node serves them, and hands each call to its client."""

from __future__ import annotations

import asyncio
import functools
import itertools
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rmpa.config.peer_rules import Access
from rmpa.core.errors import RmpaError
from rmpa.web import limits
from rmpa.web.hub.node_link import EndingRegistrations, Registration

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.ros.node.node import Node, Service
    from rmpa.ros.types.installed import ServiceType
    from rmpa.web.hub.clients import Key
    from rmpa.web.hub.node_link import NodeLink
    from rmpa.web.hub.requests import Payload


@dataclass(slots=True, eq=False)
class _Served:
    name: str
    key: Key
    kind: ServiceType
    request: Callable[[int, bytes], None]
    failed: Callable[[RmpaError], None]
    registration: Registration[Service] | None = None
    calls: dict[int, asyncio.Future[Payload]] = field(default_factory=dict)


class ServedServices:
    """All services that clients offer.

    Args:
        link: Has the node.
    """

    def __init__(self, link: NodeLink) -> None:
        self._link = link
        self._served: dict[str, _Served] = {}
        self._ending: EndingRegistrations[Service] = EndingRegistrations()
        self._numbers = itertools.count(1)

    def serve(
        self,
        key: Key,
        name: str,
        kind: ServiceType,
        request: Callable[[int, bytes], None],
        failed: Callable[[RmpaError], None],
    ) -> None:
        """Offer a service; a client that offers it already loses it, which may have gone without a word.

        Args:
            key: The client and its handle.
            name: The global name.
            kind: Its type.
            request: ``(call, payload)``: hands a call to the client, which answers by ``respond``.
            failed: Called where the service cannot be registered, or another client offers it; it has then ended.

        Raises:
            PeerRefused: The rules deny it.
        """
        self._link.rules.check(Access.SERVE, name)
        if (old := self._served.get(name)) is not None:
            self._refused(old, RmpaError(f"another client offers {name} now"))
        served = self._served[name] = _Served(name, key, kind, request, failed)
        served.registration = Registration(
            self._link,
            name,
            functools.partial(self._register, served),
            _withdraw,
            functools.partial(self._refused, served),
            after=self._ending.take(name),
        )

    def respond(self, key: Key, name: str, call: int, *, ok: bool, response: Payload | str) -> None:
        """Answer a call; one that has ended is ignored."""
        served = self._served.get(name)
        future = served.calls.get(call) if served is not None and served.key == key else None
        if future is None or future.done():
            return
        if ok and not isinstance(response, str):
            future.set_result(response)
        else:
            future.set_exception(RmpaError(str(response)))

    def end(self, key: Key, name: str) -> None:
        """End a service; its open calls fail."""
        served = self._served.get(name)
        if served is not None and served.key == key:
            self._end(served)

    async def close(self) -> None:
        """End all, after the node was closed."""
        for served in [*self._served.values()]:
            self._end(served)
        await self._ending.closed()

    # --- inside -----------------------------------------------------------------------------------------------

    async def _register(self, served: _Served, node: Node) -> Service:
        handler = functools.partial(self._call, served)
        return await node.advertise_service(
            served.name, served.kind, handler, timeout=limits.SERVED_TIMEOUT, raw=True
        )

    async def _call(self, served: _Served, request: bytes) -> Payload:
        if len(served.calls) >= limits.SERVED_CALLS_MAX:
            raise RmpaError(f"{len(served.calls)} calls of {served.name} wait for its client, which is the limit")
        number = next(self._numbers)
        future: asyncio.Future[Payload] = asyncio.get_running_loop().create_future()
        served.calls[number] = future
        try:
            served.request(number, request)
            return await future
        finally:
            del served.calls[number]

    def _refused(self, served: _Served, error: RmpaError) -> None:
        if self._served.get(served.name) is served:
            self._end(served)
            served.failed(error)

    def _end(self, served: _Served) -> None:
        del self._served[served.name]
        for future in served.calls.values():
            if not future.done():
                future.set_exception(RmpaError(f"the client that offers {served.name} has ended it"))
        if served.registration is not None:
            self._ending.end(served.name, served.registration)


async def _withdraw(service: Service) -> None:
    await service.close()

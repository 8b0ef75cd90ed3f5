"""A service of a neighbour in the gateway's graph."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from rmpa.bridge.messages import Source
from rmpa.bridge.policy import service_place
from rmpa.core.errors import RmpaError
from rmpa.gateway.graph.foreign_source import ProxiedSource
from rmpa.ros.node.service_server import ServiceEndpoint

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from rmpa.bridge.messages import Origin
    from rmpa.bridge.policy import Relay
    from rmpa.bridge.proxies import PeerProxies
    from rmpa.gateway.neighbour import ForeignSource
    from rmpa.ros.core.api import Core
    from rmpa.ros.node.service_server import ServiceCall
    from rmpa.ros.node.slave_node import SlaveNode
    from rmpa.ros.wire.tcpros import ServiceDescription

_log = logging.getLogger(__name__)


class ProxiedService(ProxiedSource):
    """A foreign service in the gateway's graph; calls under way get an error once it is closed.

    A graph has one server of each service: while another node has its name, it waits, and ``problem`` says so.

    Args:
        source: The service.
        origin: The origin to offer it with.
        number: The number of its site in the relay.
        core: The gateway's core.
        relay: Offers it to the modules.
        proxies: The proxies of its site.
        serve: Awaited with each request for its response.
        describe: Awaited for the service's type.
        timeout: Seconds for a call.
        taken: Returns which module has a service of this name; empty if there is none.
        on_closed: Called once it is closed.
    """

    def __init__(
        self,
        source: ForeignSource,
        origin: Origin,
        number: int,
        *,
        core: Core,
        relay: Relay,
        proxies: PeerProxies,
        serve: Callable[[bytes], Awaitable[bytes]],
        describe: Callable[[], Awaitable[ServiceDescription]],
        timeout: float,
        taken: Callable[[], str],
        on_closed: Callable[[], None],
    ) -> None:
        super().__init__(source, origin, number, core=core, relay=relay, proxies=proxies, on_closed=on_closed)
        self._serve = serve
        self._taken = taken
        self._offered = Source(service_place(source.name, "")[0], proxies.name(origin.node))
        self._calls: set[asyncio.Task[None]] = set()
        self.endpoint = ServiceEndpoint(
            source.name,
            self._offered.node,
            self._called,
            describe,
            timeout=timeout,
            on_mismatch=self._mismatched,
        )
        """Takes the clients."""

    def reconcile(self, services: Mapping[str, Mapping[str, str]]) -> None:
        """Register it if the core has lost it, or if its name has become free."""
        node = self._node
        if node is not None and services.get(self.source.name, {}).get(node.name) != node.service_uri:
            self._register()

    def make_room(self) -> None:
        """Leave the name to a module's service, until that one has gone."""
        if self._node is not None and self._taken():
            self._unregister(self._node)
            self._register()

    def _withdraw(self) -> None:
        self.endpoint.withdraw(f"service [{self.source.name}] of {self.source.site} has gone")
        for task in self._calls:
            task.cancel()

    def _called(self, call: ServiceCall) -> None:
        task = asyncio.get_running_loop().create_task(self._answer(call), name=f"call {self.source.name}")
        self._calls.add(task)
        task.add_done_callback(self._calls.discard)
        call.on_gone = lambda: _cancel(task)

    async def _answer(self, call: ServiceCall) -> None:
        try:
            call.reply(True, await self._serve(bytes(call.request)))
        except RmpaError as error:
            call.fail(str(error))
        except Exception:  # noqa: BLE001 - a task's top
            _log.exception("! service %s of %s failed", self.source.name, self.source.site)
            call.fail(f"service [{self.source.name}]: the gateway failed at this call; its log says why")

    def _mismatched(self, _fields: Mapping[str, str], text: str) -> None:
        self._mismatch = text

    def _ready(self, node: SlaveNode) -> None:
        self._node = node
        self._relay.shown(self._number, self._offered, service_place(self.source.name, node.name), self._origin)
        node.add_service(self.endpoint)
        self._register()

    def _register(self) -> None:
        node = self._node
        if node is None:
            return
        other = next((one for one in self._core.state().services.get(self.source.name, {}) if one != node.name), "")
        if other := other or self._taken():
            self._refused = f"{other} has a service of this name here"
            return
        code, status, _ = self._core.call("registerService", node.name, self.source.name, node.service_uri, node.uri)
        self._registered(node, code, status)

    def _unregister(self, node: SlaveNode) -> None:
        self._core.call("unregisterService", node.name, self.source.name, node.service_uri)

    def _left(self, node: SlaveNode) -> None:
        self._node = None
        self._unregister(node)
        node.remove_service(self.source.name)
        self._relay.gone(self._number, self._offered)


def _cancel(task: asyncio.Task[None]) -> None:
    task.cancel()

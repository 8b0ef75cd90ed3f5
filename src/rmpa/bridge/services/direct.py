"""The clients' side of direct calls: answers the lookups of this module's nodes with the servers' own addresses."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from typing import TYPE_CHECKING

from rmpa.bridge import limits
from rmpa.bridge.direct.grants import end_all
from rmpa.bridge.direct.paths import Condition, Grant, Path, Paths, Unmet, Want, unmet_by_contract, unmet_by_rules
from rmpa.bridge.policy import Needs
from rmpa.core.contract import Contract, Transport
from rmpa.core.errors import RmpaError
from rmpa.core.identity import OWN_NODE, is_own
from rmpa.ros.environment import host_of, is_loopback
from rmpa.ros.node.service_client import ServiceConnection
from rmpa.ros.wire.tcpros import printable
from rmpa.runtime.kernel_tcp import connections

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rmpa.bridge.bridge import Bridge
    from rmpa.bridge.services.books import RemoteService
    from rmpa.bridge.sessions import PeerSession

    ServicePath = Path[RemoteService]

_log = logging.getLogger(__name__)


class ServicePaths(Paths["RemoteService"]):
    """Direct calls of local nodes to services of peers.

    Args:
        bridge: As of ``Paths``.
        on_warning: As of ``Paths``.
        proxy_uri: ``(peer, service)``: the proxy's address for a service; empty if there is none.

    Attributes:
        answers: The services whose lookups are answered with the server's address, by their names here.
        lookups: How many lookups of each were answered so.
        _looked: Those looked up since ``_look``, or to whose servers clients were connecting then.
        _waiting: The sockets that were connecting then, by their cookies.
        _used: By the peer's name: the addresses to which clients may have connections.
    """

    kind = "service"

    def __init__(
        self, bridge: Bridge, on_warning: Callable[[str, str, str], None], proxy_uri: Callable[[int, str], str]
    ) -> None:
        super().__init__(bridge, on_warning)
        own = Needs((), "the peer's own services that are called directly")
        bridge.rpc.on_notification("direct.service_again", self._asked_again, own)
        self._proxy_uri = proxy_uri
        self.answers: dict[str, ServicePath] = {}
        self.lookups: Counter[str] = Counter()
        self._looked: set[str] = set()
        self._waiting: set[bytes] = set()
        self._looking: asyncio.TimerHandle | None = None
        self._used: dict[str, set[tuple[str, int]]] = {}
        self._able = bridge.core.on_lookup(self._lookup)

    def _lookup(self, service: str, uri: str, caller: str, api: str) -> str:
        """Answer a lookup; see ``Core.on_lookup``. It is called for each of them."""
        path = self.answers.get(service)
        if path is None or path.task is not None or self._proxy_uri(path.session.peer, service) != uri:
            return ""
        nearby = path.session.same_machine  # clients that are bound to loopback reach it too
        local_only = not nearby and is_loopback(host_of(api))
        # Calls of the nodes of ``rmpa service`` are relayed, so that the agents measure them.
        if not api or local_only or is_own(caller) or caller.startswith("/rmpa_service"):
            self._bridge.counters.add("direct.lookup_relayed")
            return ""
        self.lookups[service] += 1
        if not nearby:
            self._looked.add(service)
            self._look_later()
        return self.address(path.session.peer, service)

    def address(self, peer: int, service: str) -> str:
        """What lookups of a peer's service are answered; empty: the proxy's address."""
        path = self.answers.get(service)
        if path is None or path.session.peer != peer or path.endpoint is None:
            return ""
        return f"rosrpc://{path.endpoint[0]}:{path.endpoint[1]}"

    def _look_later(self) -> None:
        if self._looking is None and not self._closed:
            self._looking = asyncio.get_running_loop().call_later(limits.DIRECT_CHECK, self._look)

    def _look(self) -> None:
        """Find servers that clients cannot reach any more, as behind a new firewall: relay them.

        It is called while services are looked up. A connection that waits for its first answer from one look to the
        next is ended, so that its client gets an error instead of waiting for minutes.
        """
        self._looking = None
        looked, self._looked = self._looked, set()
        before, self._waiting = self._waiting, set()
        for service in looked:
            path = self.answers.get(service)
            if path is None or path.endpoint is None:
                continue
            connecting = [one for one in connections(remote=path.endpoint) or () if one.state == "SYN_SENT"]
            self._waiting |= {one.id for one in connecting}
            if connecting:
                self._looked.add(service)
            if stuck := [one for one in connecting if one.id in before]:
                end_all(stuck)
                self._bridge.counters.add("direct.service_unreachable")
                text = f"clients get no answer from {self.address(path.session.peer, service)}"
                self._stop(path)
                self._decide(path, Unmet(Condition.REACHABLE, text))
        if looked:
            self._look_later()

    def unmet(self, remote: RemoteService) -> Unmet | None:
        """Why the calls of a shown service are relayed; ``None``: they are direct, or it is not decided yet."""
        path = self.get(remote.peer, Want(remote.name, remote.node))
        if path is not None:
            return path.unmet
        contract = Contract(transport=self._bridge.context.services.transport(remote.name))
        return unmet_by_contract(contract, "this module")  # nothing is kept of what is relayed by rule

    def shown(self, remote: RemoteService) -> None:
        """Judge a service that is in the local graph, or to which other rules apply."""
        session, want = self._bridge.sessions.get(remote.peer), Want(remote.name, remote.node)
        contract = Contract(transport=self._bridge.context.services.transport(remote.name))
        if contract.transport is not Transport.RELAY and session is not None:
            self.judge(session, want, remote, contract, self._unmet_here(session, remote, contract))
        elif (path := self.get(remote.peer, want)) is not None:
            self.forget(path)  # nothing is kept of services that are relayed by rule

    def hidden(self, remote: RemoteService, *, end: bool = False) -> None:
        """Forget a service that leaves the local graph; clients keep the connections that they have.

        Args:
            remote: The service.
            end: End these connections, too: the peer may not serve it here any more.
        """
        path = self.get(remote.peer, Want(remote.name, remote.node))
        if path is not None:
            endpoint = path.endpoint
            self.forget(path)
            if end and endpoint is not None:
                self._end(path.session, (endpoint,))

    def forget(self, path: ServicePath) -> None:
        """As of ``Paths``; lookups are answered with the proxy's address again."""
        super().forget(path)
        path.found = None
        self._decided(path)

    def renewed(self, remote: RemoteService) -> None:
        """Ask again for a service that was offered again: its server may be another one."""
        path = self.get(remote.peer, Want(remote.name, remote.node))
        if path is not None and path.here is None:
            self.update(path)

    def _unmet_here(self, session: PeerSession, remote: RemoteService, contract: Contract) -> Unmet | None:
        rules, service, owner = self._bridge.context.services, remote.name, "the server's module"
        other = remote.wire if remote.wire != service else ""
        unmet = unmet_by_rules(contract, self._bridge, session, "this module", owner, other, remote.origin)
        if unmet is not None:
            return unmet
        if not self._able:
            return Unmet(Condition.CORE, "this module uses a roscore, which answers all nodes alike")
        if rules.has_timeout(service):
            text = f"its timeout of {rules.timeout(service):g} s is kept by agents: a direct call has none"
            return Unmet(Condition.CONTRACT, text)
        return None

    def link_down(self, session: PeerSession) -> None:
        """Stop direct calls to a peer that cannot be reached, those under way too; unless only its agent has died."""
        super().link_down(session)
        if not session.link.crashed:
            self._end(session, self._used.pop(session.link.name, ()))

    def called(self, peer: int) -> set[str]:
        """The services of a peer that are called directly."""
        return {service for service, path in self.answers.items() if path.session.peer == peer}

    def gone(self, session: PeerSession) -> None:
        """As of ``Paths``."""
        super().gone(session)
        self._used.pop(session.link.name, None)

    def _end(self, session: PeerSession, endpoints: Iterable[tuple[str, int]]) -> None:
        """End the connections of clients; over loopback nothing can hang, and others use the same address."""
        for endpoint in () if session.same_machine else endpoints:
            self._bridge.counters.add("direct.service_stopped")
            if problem := end_all(connections(remote=endpoint)):
                text = "! %s: calls to %s:%d may hang: they cannot be ended (%s); see rmpa doctor [stale-connections]"
                _log.warning(text, session.link.name, *endpoint, problem)

    async def _probe(self, path: ServicePath, grant: Grant) -> str:
        address = f"rosrpc://{path.session.address}:{grant.port}"
        try:
            connection = await ServiceConnection.open(
                address, path.want.name, OWN_NODE, persistent=False, probe=True, timeout=limits.DIRECT_PROBE_TIMEOUT
            )
        except RmpaError as error:
            return str(error)
        connection.close()
        if connection.caller_id != grant.node:
            return f"{printable(connection.caller_id) or 'another program'} listens at {address}"
        return ""

    def _subject(self, path: ServicePath) -> str:
        return f"{path.want.name} of {path.session.link.name}"

    def _decided(self, path: ServicePath) -> None:
        service, peer = path.want.name, path.session.link.name
        answered, before, path.place = self.answers.get(service), path.place, path.target
        if path.place is None:
            if answered is path:
                del self.answers[service], self.lookups[service]
                _log.info("= %s of %s is relayed", service, peer)
        elif answered is not path or before != path.place:
            self.answers[service], self.lookups[service] = path, 0
            used = self._used.setdefault(peer, set())
            if len(used) < limits.DIRECT_MAX:
                used.add(path.place)
            _log.info("= %s of %s is called directly at %s", service, peer, self.address(path.session.peer, service))

    async def close(self) -> None:
        """As of ``Paths``."""
        if self._looking is not None:
            self._looking.cancel()
        self.answers.clear()
        await super().close()

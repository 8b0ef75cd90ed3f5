"""The clients' side of direct calls: answers the lookups of this module's nodes with the servers' own addresses."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from rmpa.bridge import limits
from rmpa.bridge.direct import service_requests as requests
from rmpa.bridge.direct.client_side import (
    AnswerDirect,
    AnswerRelay,
    AskPeer,
    DirectServices,
    Lost,
    ProbeServer,
    ReleaseGrant,
    ServiceFallback,
    ServiceKey,
)
from rmpa.bridge.direct.conditions import NO_LINK, Condition, Grant, Unmet, read_reply, read_unmet, unmet_by_trust
from rmpa.bridge.direct.io.nodes import connecting, end_these, end_to
from rmpa.bridge.direct.service_requests import AskService, ReleaseService
from rmpa.bridge.permission_gate import OPEN_GATE, Needs, PermissionGate
from rmpa.bridge.policy import OWN_NODE, is_own
from rmpa.bridge.session.peer_rpc import UNKNOWN_QUESTION
from rmpa.core.contract import Transport
from rmpa.core.errors import PeerRefused, RemoteProtocolError, RmpaError
from rmpa.ros.environment import host_of, is_loopback
from rmpa.ros.node.service_client import ServiceConnection
from rmpa.ros.wire.tcpros import printable
from rmpa.runtime.machine_timer import MachineTimer

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterable

    from rmpa.bridge.direct.client_side import ServiceAction
    from rmpa.bridge.services.imports import ServiceImports
    from rmpa.bridge.services.remote_service import RemoteService
    from rmpa.bridge.services.rules import ServiceRules
    from rmpa.bridge.session.peer_rpc import PeerRpc
    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.bridge.session.peer_sessions import PeerSessions
    from rmpa.core.counters import Counters
    from rmpa.ros.core.api import Core

_log = logging.getLogger(__name__)
_OWN_TOOLS: Final = "/rmpa_service"
"""The names of the nodes of ``rmpa service`` begin so: their calls are relayed, so that the agents measure them."""


@dataclass(slots=True)
class DirectAnswer:
    """What lookups of a service are answered.

    Args:
        peer: The number of the peer's session.
        uri: The server's address, ``rosrpc://address:port``.
        endpoint: The same as address and port.
        nearby: Whether the server runs on this machine, so that clients that are bound to loopback reach it too.
        lookups: How many lookups were answered so.
        looked_at: How many of these the last ``_look`` has seen.
        waiting: The sockets that were connecting then, by their cookies.
    """

    peer: int
    uri: str
    endpoint: tuple[str, int]
    nearby: bool
    lookups: int = 0
    looked_at: int = 0
    waiting: frozenset[tuple[int, int]] = frozenset()


class DirectServiceImporter:
    """Direct calls of local nodes to services of peers.

    Args:
        core: The local core.
        imports: The peers' services.
        rules: The rules of this module; replaced by ``reload``.
        sessions: The peers.
        rpc: Carries the requests.
        proxy_uri: ``(peer, service)``: the proxy's address for a service; empty if there is none.
        on_lost: ``(peer, service, problem)``: removes a service whose agent has crashed and whose server is gone.
        on_warning: ``(kind, subject, text)``: logs and counts a warning.
        counters: Count ``direct.service_stopped``, ``direct.service_unreachable`` and ``direct.lookup_relayed``.
        gate: Whether the mesh is secured.
    """

    def __init__(
        self,
        core: Core,
        imports: ServiceImports,
        rules: ServiceRules,
        sessions: PeerSessions,
        rpc: PeerRpc,
        *,
        proxy_uri: Callable[[int, str], str],
        on_lost: Callable[[int, str, str], None],
        on_warning: Callable[[str, str, str], None],
        counters: Counters,
        gate: PermissionGate = OPEN_GATE,
    ) -> None:
        self._gate = gate
        self._imports = imports
        self._rules = rules
        self._sessions = sessions
        self._rpc = rpc
        self._proxy_uri = proxy_uri
        self._on_lost = on_lost
        self._on_warning = on_warning
        self._counters = counters
        self.services = DirectServices()
        """The state of each service that is not relayed by rule."""
        self.answers: dict[str, DirectAnswer] = {}
        """The services whose lookups are answered with the server's address, by their names here."""
        self._used: dict[str, set[tuple[str, int]]] = {}
        """By the peer's name: the addresses to which clients may have connections."""
        self._timer = MachineTimer(self.services.next_timer, lambda now: self._act(self.services.handle_timer(now)))
        self._tasks: dict[ServiceKey, asyncio.Task[None]] = {}
        """The question or the probe for each service: the latest one, so that floods of notifications add none."""
        self._looking: asyncio.TimerHandle | None = None
        self._closed = False
        self._able = core.on_lookup(self._lookup)
        own = Needs((), "the peer's own services that are called directly")
        rpc.on_notification(requests.SERVICE_CLOSED, self._closed_there, own)
        rpc.on_notification(requests.SERVICE_RETRY, self._retry, own)

    @staticmethod
    def _now() -> float:
        return asyncio.get_running_loop().time()

    # --- lookups -------------------------------------------------------------------------------------------------

    def _lookup(self, service: str, uri: str, caller: str, api: str) -> str:
        """Answer a lookup; see ``Core.on_lookup``. It is called for each of them."""
        found = self.answers.get(service)
        if found is None or self._proxy_uri(found.peer, service) != uri:
            return ""
        local_only = not found.nearby and is_loopback(host_of(api))
        if not api or local_only or is_own(caller) or caller.startswith(_OWN_TOOLS):
            self._counters.add("direct.lookup_relayed")
            return ""
        found.lookups += 1
        if self._looking is None and not found.nearby:
            self._looking = asyncio.get_running_loop().call_later(limits.DIRECT_CHECK, self._look)
        return found.uri

    def _look(self) -> None:
        """Find servers that clients cannot reach any more, as behind a new firewall: relay them.

        It is called while services are looked up. A connection that waits for its first answer from one look to the
        next is ended, so that its client gets an error instead of waiting for minutes.
        """
        self._looking = None
        again = False
        for service, found in list(self.answers.items()):
            if found.nearby or (found.lookups == found.looked_at and not found.waiting):
                continue
            again, found.looked_at = True, found.lookups
            waiting = connecting(found.endpoint)
            stuck = [one for one in waiting if one.cookie in found.waiting]
            found.waiting = frozenset(one.cookie for one in waiting)
            if stuck:
                end_these(stuck)
                self._counters.add("direct.service_unreachable")
                problem = f"clients get no answer from {found.uri}"
                self._act(self.services.unreachable(ServiceKey(found.peer, service), problem, self._now()))
        if again and not self._closed:
            self._looking = asyncio.get_running_loop().call_later(limits.DIRECT_CHECK, self._look)

    def answer(self, peer: int, service: str) -> DirectAnswer | None:
        """What lookups of a peer's service are answered; ``None``: the proxy's address."""
        found = self.answers.get(service)
        return found if found is not None and found.peer == peer else None

    def unmet(self, peer: int, service: str) -> Unmet | None:
        """Why the calls of a shown service are relayed; ``None``: they are direct, or it is not decided yet."""
        key, remote = ServiceKey(peer, service), self._imports.get(peer, service)
        known = self.services.get(key)
        if known is not None:
            return known.unmet
        return self._unmet_here(peer, service, remote) if remote is not None else None

    # --- the local graph -----------------------------------------------------------------------------------------

    def reload(self, rules: ServiceRules) -> None:
        """Take new rules."""
        self._rules = rules

    def shown(self, peer: int, service: str) -> None:
        """Judge a service that is in the local graph, or to which other rules apply."""
        session, remote = self._sessions.get(peer), self._imports.get(peer, service)
        if session is None or remote is None or not remote.shown:
            return
        key, wanted = ServiceKey(peer, service), self._rules.transport(service)
        if wanted is Transport.RELAY:
            self._act(self.services.remove(key))  # nothing is kept of services that are relayed by rule
            return
        unmet = self._unmet_here(peer, service, remote)
        if unmet is None and not session.linked:
            self.services.wait(key, remote.node, wanted)
            return
        self._act(self.services.consider(key, remote.node, wanted, unmet, self._now()))

    def hidden(self, peer: int, service: str, *, end: bool = False) -> None:
        """Forget a service that leaves the local graph; clients keep the connections that they have.

        Args:
            peer: The peer.
            service: The service.
            end: End these connections, too: the peer may not serve it here any more.
        """
        found = self.answer(peer, service)
        self._stop(ServiceKey(peer, service))
        self._act(self.services.remove(ServiceKey(peer, service)))
        if end and found is not None:
            self._end(self._imports.peer_name(peer), (found.endpoint,), same_machine=found.nearby)

    def renewed(self, peer: int, service: str) -> None:
        """Ask again for a service that was offered again."""
        self._act(self.services.renewed(ServiceKey(peer, service)))

    def _unmet_here(self, peer: int, service: str, remote: RemoteService) -> Unmet | None:
        if self._rules.transport(service) is Transport.RELAY:
            return Unmet(Condition.TRANSPORT, 'transport is "relay" in this module')
        if not self._able:
            return Unmet(Condition.CORE, "this module uses a roscore, which answers all nodes alike")
        if self._rules.has_timeout(service):
            text = f"its timeout of {self._rules.timeout(service):g} s is kept by agents: a direct call has none"
            return Unmet(Condition.CONTRACT, text)
        if remote.origin is not None:
            return Unmet(Condition.OWN_SOURCE, f"it is {remote.origin.name}'s, and comes by a relay")
        if remote.wire != service:
            return Unmet(Condition.NAME, f"it is {remote.wire} in the server's module")
        session = self._sessions.get(peer)
        same_machine = session is not None and session.same_machine
        return unmet_by_trust(self._gate, "this module", same_machine=same_machine)

    # --- links ---------------------------------------------------------------------------------------------------

    def link_up(self, session: PeerSession) -> None:
        """Ask for the services of a peer that was without a link."""
        self._act(self.services.link_up(session.peer))

    def link_down(self, session: PeerSession, *, crashed: bool) -> None:
        """Stop direct calls to a peer that cannot be reached, those under way too; unless only its agent has died."""
        self._act(self.services.link_down(session.peer, self._now(), crashed=crashed))
        if not crashed:
            self._end(session.link.name, self._used.pop(session.link.name, set()), same_machine=session.same_machine)

    def adrift(self, peer: int) -> set[str]:
        """The services of a peer that are called directly although its agent has crashed."""
        return self.services.adrift(peer)

    def gone(self, session: PeerSession) -> None:
        """Forget a peer; connections from before a crash are ended unless its next run takes them over."""
        for key, _ in self.services:
            if key.peer == session.peer:
                self._act(self.services.remove(key))
        left, name = self._used.pop(session.link.name, set()), session.link.name
        if left and not self._closed:
            same = session.same_machine
            later = asyncio.get_running_loop().call_later
            later(limits.DIRECT_ADOPT, lambda: self._end(name, left - self._used.get(name, set()), same_machine=same))

    def _end(self, name: str, endpoints: Iterable[tuple[str, int]], *, same_machine: bool) -> None:
        """Ends the connections of clients; over loopback nothing can hang, and others use the same address."""
        for endpoint in () if same_machine else endpoints:
            self._counters.add("direct.service_stopped")
            if problem := end_to(endpoint):
                text = "! %s: calls under way to %s:%d may hang: they cannot be ended (%s); see rmpa doctor"
                _log.warning(text, name, *endpoint, problem)

    # --- the peer ------------------------------------------------------------------------------------------------

    def _named(self, session: PeerSession, wire: str) -> ServiceKey:
        return ServiceKey(session.peer, wire)  # what is not of the same name here is never asked for

    def _closed_there(self, session: PeerSession, args: dict[str, Any]) -> None:
        told = requests.read_closed(args)
        unmet = read_unmet(told.why, printable(told.text))
        self._act(self.services.closed(self._named(session, told.service), told.node, unmet, self._now()))

    def _retry(self, session: PeerSession, args: dict[str, Any]) -> None:
        told = requests.read_retry(args)
        self._act(self.services.retry(self._named(session, told.service), told.node))

    async def _ask(self, key: ServiceKey, attempt: int) -> None:
        session, known = self._sessions.get(key.peer), self.services.get(key)
        found: Grant | Unmet
        if session is None or not session.reachable or known is None:
            found = NO_LINK
        else:
            found = await self._request(session, AskService(key.service, known.node, known.wanted))
        if isinstance(found, Unmet):
            found = Unmet(found.condition, printable(found.text))
        self._act(self.services.replied(key, attempt, found, self._now()))

    async def _request(self, session: PeerSession, asked: AskService) -> Grant | Unmet:
        args = requests.write(asked)
        try:
            value = await self._rpc.request(session, requests.SERVICE, args, limits.DIRECT_ASK_TIMEOUT)
            return read_reply(value, asked.node)
        except PeerRefused as error:
            older = UNKNOWN_QUESTION in error.reason
            return Unmet(Condition.RELEASE if older else Condition.AGENT, str(error))
        except RemoteProtocolError as error:
            return Unmet(Condition.RELEASE, f"{session.link.name}: {error}")
        except RmpaError as error:
            return Unmet(Condition.AGENT, str(error))

    async def _probe(self, key: ServiceKey, attempt: int, grant: Grant) -> None:
        session = self._sessions.get(key.peer)
        if session is None:
            return
        address = f"rosrpc://{session.address}:{grant.port}"
        problem = ""
        try:
            connection = await ServiceConnection.open(
                address, key.service, OWN_NODE, persistent=False, probe=True, timeout=limits.DIRECT_PROBE_TIMEOUT
            )
        except RmpaError as error:
            problem = str(error)
        else:
            connection.close()
            if connection.caller_id != grant.node:
                problem = f"{printable(connection.caller_id) or 'another program'} listens at {address}"
        self._act(self.services.probed(key, attempt, problem, self._now()))

    # --- carrying out --------------------------------------------------------------------------------------------

    def _act(self, actions: Iterable[ServiceAction]) -> None:
        if self._closed:
            return
        for action in actions:
            match action:
                case AskPeer(key, attempt):
                    self._start(key, self._ask(key, attempt), f"ask for {key.service}")
                case ProbeServer(key, attempt, grant):
                    self._start(key, self._probe(key, attempt, grant), f"probe {key.service}")
                case AnswerDirect(key, grant):
                    self._answer(key, grant)
                case AnswerRelay(key):
                    self._relay(key)
                case ReleaseGrant(key, node):
                    session = self._sessions.get(key.peer)
                    if session is not None and session.linked:
                        closed = requests.write(ReleaseService(key.service, node))
                        self._rpc.notify(session, requests.SERVICE_CLOSE, closed)
                case Lost(key, problem):
                    self._on_lost(key.peer, key.service, problem)
                case ServiceFallback(key, unmet):
                    name = self._imports.peer_name(key.peer)
                    text = f'{key.service} of {name}: relayed although transport is "direct": {unmet.text}'
                    self._on_warning("direct.service_relayed", f"{name} {key.service} {unmet.condition}", text)
        self._timer.arm()

    def _answer(self, key: ServiceKey, grant: Grant) -> None:
        session = self._sessions.get(key.peer)
        if session is None:
            return
        uri = f"rosrpc://{session.address}:{grant.port}"
        endpoint = (session.address, grant.port)
        self.answers[key.service] = DirectAnswer(key.peer, uri, endpoint, session.same_machine)
        used = self._used.setdefault(session.link.name, set())
        if len(used) < limits.DIRECT_MAX:
            used.add(endpoint)
        _log.info("= %s of %s is called directly at %s", key.service, session.link.name, uri)

    def _relay(self, key: ServiceKey) -> None:
        found = self.answers.get(key.service)
        if found is not None and found.peer == key.peer:
            del self.answers[key.service]
            _log.info("= %s of %s is relayed", key.service, self._imports.peer_name(key.peer))

    def _start(self, key: ServiceKey, work: Coroutine[Any, Any, None], name: str) -> None:
        self._stop(key)
        task = self._tasks[key] = asyncio.create_task(work, name=name)
        task.add_done_callback(lambda done: self._tasks.pop(key) if self._tasks.get(key) is done else None)

    def _stop(self, key: ServiceKey) -> None:
        task = self._tasks.get(key)
        if task is not None and task is not asyncio.current_task():
            task.cancel()

    async def close(self) -> None:
        """Stop everything; direct connections go on."""
        self._closed = True
        self._timer.close()
        if self._looking is not None:
            self._looking.cancel()
        self.answers.clear()
        tasks = list(self._tasks.values())
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

"""The subscriber's side of direct transport for topics: answers, moves and watches the subscribers of this module."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from typing import TYPE_CHECKING, Any, Final

from rmpa.bridge import limits
from rmpa.bridge.direct import requests
from rmpa.bridge.direct.conditions import (
    NO_LINK,
    Condition,
    Grant,
    Unmet,
    read_reply,
    read_unmet,
    unmet_by_contract,
    unmet_by_trust,
)
from rmpa.bridge.direct.direct_route import (
    Ask,
    Decided,
    DirectKey,
    Fallback,
    HangUp,
    Interruptions,
    Move,
    Path,
    ProbeNode,
    Release,
)
from rmpa.bridge.direct.io.nodes import direct_links, end_links, kernel_tells, report_failure, standing, standing_at
from rmpa.bridge.direct.requests import CloseDirect, OpenDirect
from rmpa.bridge.direct.subscriber_side import DirectSubscriptions
from rmpa.bridge.permission_gate import OPEN_GATE, Needs, PermissionGate
from rmpa.bridge.policy import is_own
from rmpa.bridge.session.peer_rpc import UNKNOWN_QUESTION
from rmpa.bridge.topics.audience import compares_names
from rmpa.bridge.topics.io.direct_moves import SubscriberMoves
from rmpa.core.contract import Transport
from rmpa.core.errors import PeerRefused, RemoteProtocolError, RmpaError
from rmpa.ros.environment import host_of, is_loopback
from rmpa.ros.http.client import is_own_name
from rmpa.ros.master.effects import GraphChange, RegistrationKind
from rmpa.ros.node.local_addresses import local_addresses
from rmpa.ros.node.probe import probe
from rmpa.ros.wire.slave_api import TCPROS
from rmpa.ros.wire.xmlrpc import RosReply
from rmpa.runtime.machine_timer import MachineTimer

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine, Iterable, Mapping

    from rmpa.bridge.direct.direct_route import DirectAction
    from rmpa.bridge.messages import Source
    from rmpa.bridge.session.peer_rpc import PeerRpc
    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.bridge.session.peer_sessions import PeerSessions
    from rmpa.bridge.topics.imports import Imports
    from rmpa.bridge.topics.io.peer_topics import PeerTopics
    from rmpa.bridge.topics.remote_topic import RemoteTopic
    from rmpa.core.contract import Contracts
    from rmpa.core.counters import Counters
    from rmpa.ros.core.api import Core
    from rmpa.ros.node.publication import Publication

_log = logging.getLogger(__name__)
MEASURING: Final = "/rmpa_topic_"
"""Names of nodes of ``rmpa topic hz|bw|delay|echo`` begin so; they are relayed, so that the agents measure."""


class DirectImporter:
    """Direct connections of local subscribers to nodes of peers.

    Args:
        core: The local core.
        imports: The remote sources.
        topics: The peers' topics in the local graph, by the numbers of their sessions.
        contracts: The contracts of this module; replaced by ``reload``.
        sessions: The peers.
        rpc: Carries the requests.
        on_demand: ``(peer, source, wanted)``: opens the relayed route of a source, or lets it close.
        on_warning: ``(kind, subject, text)``: logs and counts a warning.
        counters: Count ``direct.moved`` and others.
        gate: Whether the mesh is secured.
    """

    def __init__(
        self,
        core: Core,
        imports: Imports,
        topics: Mapping[int, PeerTopics],
        contracts: Contracts,
        sessions: PeerSessions,
        rpc: PeerRpc,
        *,
        on_demand: Callable[[int, Source, bool], None],
        on_warning: Callable[[str, str, str], None],
        counters: Counters,
        gate: PermissionGate = OPEN_GATE,
    ) -> None:
        self._gate = gate
        self._core = core
        self._imports = imports
        self._topics = topics
        self._contracts = contracts
        self._sessions = sessions
        self._rpc = rpc
        self._on_warning = on_warning
        self._counters = counters
        self.routes = DirectSubscriptions(self._is_latched, self._is_relayed)
        """The state of each subscriber."""
        self.interruptions = Interruptions()
        """When subscribers were without their path."""
        self._timer = MachineTimer(self.routes.next_timer, lambda now: self._act(self.routes.handle_timer(now)))
        self._waiting: dict[DirectKey, list[asyncio.Future[None]]] = {}
        self._moves = SubscriberMoves(
            core,
            imports,
            topics,
            sessions,
            self.routes,
            on_demand=on_demand,
            on_left=self._interrupted,
            on_warning=on_warning,
            counters=counters,
        )
        self._tasks: set[asyncio.Task[None]] = set()
        self._adrift: dict[int, list[RemoteTopic]] = {}
        """The sources of each peer that are kept because of direct subscribers while its agent is gone."""
        self._strays: dict[tuple[Source, str], tuple[str, int]] = {}
        """Direct connections that a crashed agent left, by source and subscriber: the publisher's endpoint."""
        self._asking: dict[int, asyncio.Semaphore] = {}
        self._checking: asyncio.TimerHandle | None = None
        self._closed = False
        self._kernel_tells = kernel_tells()
        self._started = self._now()
        """Subscribers may have direct connections from before this moment, of an earlier run of this agent."""
        own = Needs((), "the peer's own topics that come directly")
        rpc.on_notification(requests.CLOSED, self._closed_there, own)
        rpc.on_notification(requests.RETRY, self._retry, own)

    @staticmethod
    def _now() -> float:
        return asyncio.get_running_loop().time()

    # --- the local graph --------------------------------------------------------------------------------------------

    def reload(self, contracts: Contracts) -> None:
        """Take new contracts, and judge every subscriber again."""
        self._contracts = contracts
        self.judge_all()

    def judge_all(self) -> None:
        """Judge the subscribers of every remote source."""
        for topic in {entry.topic for _, _, entry in self._imports}:
            self._judge(topic)

    def graph_changed(self, change: GraphChange) -> None:
        """Judge a local subscriber that came, or forget one that went."""
        if change.kind is not RegistrationKind.SUBSCRIBER or is_own(change.node):
            return
        for peer, source in list(self._imports.at(change.name)):
            if change.added:
                self._consider(peer, source, change.node, change.api)
            else:
                # It ends its connections itself; it may subscribe again while a call from here is on its way.
                self._act(self.routes.remove(DirectKey(peer, source, change.node), hang_up=False))

    def shown(self, peer: int, source: Source) -> None:
        """Judge the subscribers of a source that appears in the local graph."""
        entry = self._imports.get(peer, source)
        if entry is not None:
            for node, uri in self._core.subscribers(entry.topic).items():
                self._consider(peer, source, node, uri)

    def hidden(self, peer: int, source: Source, *, hang_up: bool = True) -> None:
        """Forget the subscribers of a source that leaves the local graph.

        Args:
            peer: The peer.
            source: The source.
            hang_up: End their direct connections.
        """
        for name, _ in self.routes.of(peer, source):
            self._act(self.routes.remove(DirectKey(peer, source, name), hang_up=hang_up))

    def _judge(self, topic: str) -> None:
        subscribers = self._core.subscribers(topic)
        for peer, source in list(self._imports.at(topic)):
            for node, uri in subscribers.items():
                self._consider(peer, source, node, uri)

    def _consider(self, peer: int, source: Source, node: str, uri: str) -> None:
        session, entry = self._sessions.get(peer), self._imports.get(peer, source)
        if session is None or entry is None or not entry.shown or is_own(node):
            return
        key, contract = DirectKey(peer, source, node), self._contracts.of(entry.topic, entry.type)
        if contract.transport is Transport.RELAY and self.routes.get(key) is None:
            return  # nothing is kept of topics that are relayed by rule
        unmet = self._unmet(session, source, entry, node, uri)
        self._act(self.routes.consider(key, contract.transport, unmet, self._now()))

    def _unmet(self, session: PeerSession, source: Source, entry: RemoteTopic, node: str, uri: str) -> Unmet | None:
        unmet = unmet_by_contract(self._contracts.of(entry.topic, entry.type), "this module")
        unmet = unmet or unmet_by_trust(self._gate, "this module", same_machine=session.same_machine)
        if unmet is not None:
            return unmet
        if entry.origin is not None:
            return Unmet(Condition.OWN_SOURCE, f"it is {entry.origin.name}'s, and comes by a relay")
        if entry.topic != source.topic:
            return Unmet(Condition.NAME, f"it is {source.topic} in the publisher's module")
        if compares_names(entry.type):
            return Unmet(Condition.ACTION, f"actions compare the names of the nodes at {entry.type}")
        if node.startswith(MEASURING):
            return Unmet(Condition.MEASURES, "rmpa's own tools measure by the agents")
        host = host_of(uri)
        if not is_loopback(self._core.node_host) and not (is_own_name(host) or host in local_addresses()):
            return Unmet(Condition.SUBSCRIBER, f"{node} runs at {host}, not on its agent's machine")
        if not self._kernel_tells:
            return Unmet(Condition.SUBSCRIBER, "the kernel does not list the connections of this machine (sock_diag)")
        if is_loopback(host) and not session.same_machine:
            text = f"{node} connects within its machine only (ROS_IP or ROS_HOSTNAME is {host_of(uri)})"
            return Unmet(Condition.SUBSCRIBER, text)
        return None

    def _is_latched(self, key: DirectKey) -> bool:
        entry = self._imports.get(key.peer, key.source)
        return entry is not None and entry.description is not None and entry.description.latching

    def _is_relayed(self, key: DirectKey) -> bool:
        publication = self._publication(key.peer, key.source)
        return publication is not None and key.subscriber in publication.callers

    # --- what subscribers ask ---------------------------------------------------------------------------------------

    def request(self, peer: int, source: Source, subscriber: str) -> Awaitable[RosReply | None] | None:
        """Answer a subscriber's ``requestTopic`` at the proxy of a source; see ``PublicationEvents``."""
        key = DirectKey(peer, source, subscriber)
        if self.routes.get(key) is None and not self._is_new and not self._moves.is_stuck(key):
            return None
        return self._answer(key)

    @property
    def _is_new(self) -> bool:
        """Whether subscribers may still have direct connections of an earlier run of this agent."""
        return self._now() < self._started + limits.DIRECT_ADOPT

    async def _answer(self, key: DirectKey) -> RosReply | None:
        if self.routes.decision(key) is None:
            await self._decision(key)
        entry, topic = self._imports.get(key.peer, key.source), key.source.topic
        uri = self._moves.uri(key.subscriber, topic)
        stray = self._strays.get((key.source, key.subscriber))
        session = self._sessions.get(key.peer)
        decision = self.routes.decision(key)
        direct = (session.address, decision.port) if session is not None and isinstance(decision, Grant) else None
        for endpoint in dict.fromkeys(one for one in (stray, self._endpoint(key), direct) if one is not None):
            # A connection from an earlier answer, or an earlier run of an agent: a second one would double messages.
            if not uri or not standing(endpoint) or not (links := await direct_links(uri, topic, endpoint)):
                continue
            if endpoint == direct and self.routes.decision(key) == decision:
                _log.info("= %s: %s is connected directly already", key.source, key.subscriber)
                return self._answered(key, direct, RosReply(0, "connected to the publisher already", []))
            if problem := await end_links(endpoint, links):
                self._act(self.routes.answered(key, endpoint, self._now()))
                self._moves.stuck(key, endpoint, problem)
                return RosReply(0, "connected to the publisher directly still", [])
        if direct is None and entry is not None and session is not None:
            left = await self._left_by_others(key, entry.topic, session.address)
            if left is not None:
                return left
        if self.routes.decision(key) != decision or direct is None:
            return self._answered(key, None, None)  # it is moved if it is direct by now
        reply = RosReply(1, f"ready on {direct[0]}:{direct[1]}", [TCPROS, direct[0], direct[1]])
        return self._answered(key, direct, reply)

    async def _left_by_others(self, key: DirectKey, topic: str, address: str) -> RosReply | None:
        """Ends direct connections that no present decision knows of; the answer to give if one cannot be ended."""
        if not self._is_new and not self._moves.is_stuck(key):
            return None
        endpoint, problem = await self._moves.end_unknown(key, topic, address)
        if endpoint is None:
            return None
        self._act(self.routes.answered(key, endpoint, self._now()))
        if (route := self.routes.get(key)) is not None:
            route.stuck = problem
        self._watch()
        return RosReply(0, f"connected to {endpoint[0]}:{endpoint[1]} still", [])

    def _endpoint(self, key: DirectKey) -> tuple[str, int] | None:
        """Where a subscriber was connected directly by its last answer."""
        route = self.routes.get(key)
        return route.endpoint if route is not None and route.path is Path.DIRECT else None

    def _answered(self, key: DirectKey, endpoint: tuple[str, int] | None, reply: RosReply | None) -> RosReply | None:
        self._strays.pop((key.source, key.subscriber), None)
        self._has_path(key)
        self._act(self.routes.answered(key, endpoint, self._now()))
        self._watch()
        return reply

    async def _decision(self, key: DirectKey) -> None:
        """Waits for the decision about a subscriber, at most ``limits.DIRECT_HOLD``."""
        future: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.setdefault(key, []).append(future)
        try:
            async with asyncio.timeout(limits.DIRECT_HOLD):
                await future
        except TimeoutError:
            self._counters.add("direct.undecided")
        finally:
            waiting = self._waiting.get(key, [])
            if future in waiting:
                waiting.remove(future)
            if not waiting:
                self._waiting.pop(key, None)

    def listeners_changed(self, peer: int, source: Source) -> None:
        """Note which subscribers have left the proxy of a source, or have come back to it by themselves."""
        routes = self.routes.of(peer, source)
        if not routes:
            return
        publication = self._publication(peer, source)
        there = publication.callers if publication is not None else frozenset()
        for name, _ in routes:
            key = DirectKey(peer, source, name)
            if key in self._moves:
                continue
            if name not in there:
                self._act(self.routes.left(key, self._now()))
            else:
                self._has_path(key)
                self._act(self.routes.arrived(key, self._now()))

    def _interrupted(self, key: DirectKey) -> None:
        if (session := self._sessions.get(key.peer)) is not None:
            self.interruptions.begin(session.link.name, key.source, key.subscriber, self._now())

    def _has_path(self, key: DirectKey) -> None:
        if (session := self._sessions.get(key.peer)) is not None:
            self.interruptions.end(session.link.name, key.source, key.subscriber, self._now())

    # --- links ------------------------------------------------------------------------------------------------------

    def link_up(self, session: PeerSession) -> None:
        """Ask again for the subscribers of a peer that was without a link."""
        for key, route in self.routes.connected():
            if key.peer == session.peer and route.endpoint is not None and route.endpoint[0] != session.address:
                self._act([Move(key)])  # the peer has another address now
        for entry in self._adrift.pop(session.peer, ()):
            entry.direct = False
        self._act(self.routes.link_up(session.peer, self._now()))

    def link_down(self, session: PeerSession, *, crashed: bool) -> None:
        """End direct connections to a peer that cannot be reached; unless only its agent has died."""
        for key, _ in self.routes.connected() if not crashed else ():
            if key.peer == session.peer:
                self._interrupted(key)
        self._act(self.routes.link_down(session.peer, self._now(), crashed=crashed))
        for _, source in {(key.peer, key.source) for key, _ in self.routes if key.peer == session.peer}:
            entry = self._imports.get(session.peer, source)
            direct = any(route.path is Path.DIRECT for _, route in self.routes.of(session.peer, source))
            if entry is not None and direct:
                entry.direct = True  # they were made to hang up above unless only the agent has died
                self._adrift.setdefault(session.peer, []).append(entry)

    def gone(self, session: PeerSession, *, hang_up: bool) -> None:
        """Forget every subscriber of a peer.

        Args:
            session: The peer.
            hang_up: End their connections, rather than leave them to the peer's next agent.
        """
        left: dict[tuple[Source, str], tuple[str, int]] = {}
        for key, route in self.routes:
            if key.peer == session.peer:
                if not hang_up and route.path is Path.DIRECT and route.endpoint is not None:
                    left[key.source, key.subscriber] = route.endpoint
                self._act(self.routes.remove(key, hang_up=hang_up))
        self._adrift.pop(session.peer, None)
        self._asking.pop(session.peer, None)
        if left and not self._closed:
            self._strays |= left
            asyncio.get_running_loop().call_later(limits.DIRECT_ADOPT, self._end_strays, left)

    def _end_strays(self, left: Mapping[tuple[Source, str], tuple[str, int]]) -> None:
        """Ends direct connections from before a crash of the peer's agent that its next run has not taken over."""
        for (source, subscriber), endpoint in left.items():
            if not self._closed and self._strays.get((source, subscriber)) == endpoint:
                del self._strays[source, subscriber]
                self._start(self._end_stray(source.topic, subscriber, endpoint), f"end {subscriber}'s connection")

    async def _end_stray(self, topic: str, subscriber: str, endpoint: tuple[str, int]) -> None:
        uri = self._moves.uri(subscriber, topic)
        links = await direct_links(uri, topic, endpoint) if uri and standing(endpoint) else None
        await end_links(endpoint, links or ())

    # --- the peer ---------------------------------------------------------------------------------------------------

    def _closed_there(self, session: PeerSession, args: dict[str, Any]) -> None:
        told = requests.read_closed(args)
        unmet = read_unmet(told.why, told.text)
        self._act(self.routes.closed(session.peer, told.source, told.subscriber, unmet, self._now()))

    def _retry(self, session: PeerSession, args: dict[str, Any]) -> None:
        self._act(self.routes.retry(session.peer, requests.read_retry(args).source, self._now()))

    async def _ask(self, key: DirectKey, attempt: int) -> None:
        try:
            await self._ask_peer(key, attempt)
        except Exception:
            self._act(self.routes.replied(key, attempt, Unmet(Condition.AGENT, "this agent failed"), self._now()))
            raise

    async def _ask_peer(self, key: DirectKey, attempt: int) -> None:
        session, entry = self._sessions.get(key.peer), self._imports.get(key.peer, key.source)
        found: Grant | Unmet
        if session is None or not session.reachable or entry is None:
            found = NO_LINK
        else:
            limit = self._asking.setdefault(key.peer, asyncio.Semaphore(limits.DIRECT_ASKS))
            async with limit:
                route = self.routes.get(key)
                if route is None or route.attempt != attempt:
                    return  # no request has been sent for this attempt
                found = await self._request(session, key, entry)
        self._act(self.routes.replied(key, attempt, found, self._now()))

    async def _request(self, session: PeerSession, key: DirectKey, entry: RemoteTopic) -> Grant | Unmet:
        contract = self._contracts.of(entry.topic, entry.type)
        asked = OpenDirect(key.source.topic, key.source.node, key.subscriber, contract)
        try:
            value = await self._rpc.request(session, requests.OPEN, requests.write(asked), limits.DIRECT_ASK_TIMEOUT)
            return read_reply(value, key.source.node)
        except PeerRefused as error:
            older = UNKNOWN_QUESTION in error.reason
            return Unmet(Condition.RELEASE if older else Condition.AGENT, str(error))
        except RemoteProtocolError as error:
            return Unmet(Condition.RELEASE, f"{session.link.name}: {error}")
        except RmpaError as error:
            return Unmet(Condition.AGENT, str(error))

    async def _probe(self, peer: int, grant: Grant) -> None:
        session = self._sessions.get(peer)
        if session is None:
            return
        address, link = session.address, session.link
        try:
            timeout = limits.DIRECT_PROBE_TIMEOUT
            problem = await probe(address, grant.port, grant.probe, node=grant.node, timeout=timeout)
        except Exception:
            self._act(self.routes.probed(peer, grant.port, "this agent failed", self._now()))
            raise
        if problem:
            problem = f"no connection to {address}:{grant.port}: {problem}"
        if session.link is not link:
            return  # the next link has probes of its own
        self._act(self.routes.probed(peer, grant.port, problem, self._now()))

    # --- carrying out -----------------------------------------------------------------------------------------------

    def _act(self, actions: Iterable[DirectAction]) -> None:
        if self._closed:
            return
        for action in actions:
            match action:
                case Ask(key, attempt):
                    self._start(self._ask(key, attempt), f"ask for {key.source}")
                case ProbeNode(peer, grant):
                    self._start(self._probe(peer, grant), f"probe {grant.node}")
                case Decided(key):
                    self._decided(key)
                case Move(key):
                    self._moves.move(key)
                case HangUp(key, endpoint):
                    self._counters.add("direct.hung_up")
                    self._moves.hang_up(key, endpoint)
                case Release(key, broken):
                    self._release(key, broken=broken)
                case Fallback(key, unmet) if unmet.condition is not Condition.MEASURES:
                    subject = f"{key.source} to {key.subscriber}"
                    text = f'{subject}: relayed although transport is "direct": {unmet.text}'
                    self._on_warning("direct.relayed", f"{key.peer} {subject} {unmet.condition}", text)
        self._timer.arm()

    def _decided(self, key: DirectKey) -> None:
        for future in self._waiting.pop(key, ()):
            if not future.done():
                future.set_result(None)
        self._watch()

    def _release(self, key: DirectKey, *, broken: bool) -> None:
        session = self._sessions.get(key.peer)
        if session is not None and session.linked:
            closed = CloseDirect(key.source.topic, key.source.node, key.subscriber, broken)
            self._rpc.notify(session, requests.CLOSE, requests.write(closed))

    def _start(self, work: Coroutine[Any, Any, None], name: str) -> asyncio.Task[None]:
        task = asyncio.create_task(work, name=name)
        self._tasks.add(task)
        task.add_done_callback(self._ended)
        return task

    def _ended(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        report_failure(task, self._counters)

    def _watch(self) -> None:
        """Begins to watch direct connections."""
        if self._checking is None and (self.routes.connected() or any(route.stranded for _, route in self.routes)):
            self._checking = asyncio.get_running_loop().call_later(limits.DIRECT_CHECK, self._check)

    def _publication(self, peer: int, source: Source) -> Publication | None:
        topics = self._topics.get(peer)
        return topics.publication(source) if topics is not None else None

    # --- watching direct connections --------------------------------------------------------------------------------

    def _check(self) -> None:
        """Compares the direct connections with the kernel's table; asks the nodes only where some are missing."""
        self._checking = None
        now, connected = self._now(), self.routes.connected()
        stranded = self.routes.waiting(now)
        if self._closed or not (connected or stranded):
            return
        self._checking = asyncio.get_running_loop().call_later(limits.DIRECT_CHECK, self._check)
        for key in stranded:
            self._moves.move(key)  # its call-back was lost
        settled = [
            (key, route.endpoint)
            for key, route in connected
            if route.endpoint is not None
            and now - route.answered_at > limits.DIRECT_SETTLE
            and key not in self._moves
        ]
        wanted = Counter(endpoint for _, endpoint in settled)
        there = {address: standing_at(address) for address in {endpoint[0] for endpoint in wanted}}
        short = {end for end, count in wanted.items() if len(there[end[0]].get(end[1], ())) < count}
        for key, endpoint in settled:
            route = self.routes.get(key)
            if route is not None and not route.stuck and self.routes.misplaced(key):
                self._moves.move(key)
            elif endpoint in short:
                self._start(self._check_one(key, endpoint), f"check {key.subscriber}")

    async def _check_one(self, key: DirectKey, endpoint: tuple[str, int]) -> None:
        entry = self._imports.get(key.peer, key.source)
        uri = self._moves.uri(key.subscriber, entry.topic) if entry is not None else ""
        if entry is None or not uri:
            return
        links = await direct_links(uri, entry.topic, endpoint)
        route = self.routes.get(key)
        if links or route is None or route.endpoint != endpoint:
            return
        if links is None:
            self._core.suspect(key.subscriber)
        self._counters.add("direct.broken")
        self._interrupted(key)
        actions = self.routes.broken(key, self._now())
        self._act(actions)

    async def close(self) -> None:
        """Stop everything; direct connections go on."""
        self._closed = True
        self._timer.close()
        if self._checking is not None:
            self._checking.cancel()
        tasks = list(self._tasks)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, self._moves.close(), return_exceptions=True)

"""Drives the imports: one proxy node in the local graph for each node of a peer that publishes something."""

from __future__ import annotations

import asyncio
import logging
import os
from collections import OrderedDict
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rmpa.bridge import limits
from rmpa.bridge.actions import Publish
from rmpa.bridge.data.io.import_flow import ImportFlow
from rmpa.bridge.data.io.link_time import LinkTime
from rmpa.bridge.proxy_names import proxy_name
from rmpa.bridge.session.proxy_nodes import ProxyNodes
from rmpa.core.contract import Durability, Reliability
from rmpa.core.errors import RmpaError
from rmpa.core.open_files import remedy
from rmpa.mesh import limits as mesh_limits
from rmpa.ros.node.publication import Publication
from rmpa.ros.wire.tcpros import TopicDescription, printable
from rmpa.ros.wire.xmlrpc import RosReply
from rmpa.runtime.descriptors import is_shortage
from rmpa.runtime.event_loop import yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator, Mapping

    from rmpa.bridge.actions import Describe, Detach, Retract
    from rmpa.bridge.data.losses import ReceptionHistory
    from rmpa.bridge.data.qos_events import QosEvent
    from rmpa.bridge.messages import Source
    from rmpa.core.counters import Counters
    from rmpa.ros.core.api import Core
    from rmpa.ros.node.slave_node import SlaveNode

_log = logging.getLogger(__name__)


async def _stays(node: str, _caller: str, _reason: str) -> RosReply:
    return RosReply(0, f"{node} is a node of another module", 0)


@dataclass(slots=True)
class Proxy:
    """A node of a peer, standing in the local graph.

    Args:
        node: What stands there.
        types: By topic as the peer has it: its message type.
        publications: Likewise: its local end, whose ``topic`` is what it is called here.
    """

    node: SlaveNode
    types: dict[str, str] = field(default_factory=dict)
    publications: dict[str, Publication] = field(default_factory=dict)
    held: dict[str, Callable[[SlaveNode], None]] = field(default_factory=dict)
    """What else it is kept for, and who was told that it is there."""

    @property
    def idle(self) -> bool:
        """Whether it stands for nothing any more."""
        return not self.publications and not self.held


@dataclass(frozen=True, slots=True)
class _Hold:
    """Somebody keeps the proxy of a node for something else than a topic, or no longer does."""

    node: str
    key: str


class PeerProxies:
    """The proxies of one peer.

    Making a proxy may bind sockets, which takes a turn of the loop; so what changes the graph is done one after the
    other by a task, in the order in which it was asked for.

    Args:
        core: The local core, in which the proxies are registered.
        prefix: The namespace of this peer's proxies.
        nodes: Makes the proxies; by default with sockets of their own.
        counters: Where refusals at the proxies' ports, and messages that reach no subscriber, are counted.
        on_demand: Called with a source and whether somebody local listens to it.
        on_mismatch: Called with a source, the caller id of a refused subscriber and the text it was told.
        on_occurred: Called with a source and what became of its contract.
        on_listeners: Called with a source when other nodes than before are served with it.
        pasts: What is known of reliable sources from before, by ``leave`` of another one.
        on_kill: ``(node, caller id, reason) -> reply``: a proxy was asked to end; the node is the peer's.
    """

    def __init__(
        self,
        core: Core,
        prefix: str,
        *,
        nodes: ProxyNodes | None = None,
        counters: Counters | None = None,
        on_demand: Callable[[Source, bool], None],
        on_mismatch: Callable[[Source, str, str], None],
        on_occurred: Callable[[Source, QosEvent], None],
        on_listeners: Callable[[Source], None] = lambda _: None,
        pasts: Mapping[Source, ReceptionHistory] | None = None,
        on_kill: Callable[[str, str, str], Awaitable[RosReply]] = _stays,
    ) -> None:
        self._on_listeners = on_listeners
        self._on_kill = on_kill
        self._on_occurred = on_occurred
        self.prefix = prefix
        self._core = core
        self._counters = counters
        self._nodes = nodes if nodes is not None else ProxyNodes(core, counters)
        self._on_demand = on_demand
        self._on_mismatch = on_mismatch
        self._proxies: dict[str, Proxy] = {}
        self._wanted: dict[Source, Publish] = {}
        self._holds: dict[tuple[str, str], Callable[[SlaveNode], None]] = {}
        self._jobs: asyncio.Queue[Publish | Retract | _Hold | None] = asyncio.Queue()
        self.problems: dict[str, str] = {}
        """Why the proxy of a node could not be made, ready to read; it is tried again by ``reconcile``."""
        self._task = asyncio.create_task(self._work(), name=f"proxies {prefix}")
        self.names: dict[str, str] = {}
        """Of nodes of other modules that the peer passes on: what stands for them here."""
        self.flows: dict[int, ImportFlow] = {}
        """Open routes; the data path looks here."""
        self.time = LinkTime()
        self._latest: dict[Source, ImportFlow] = {}
        """Of each source: the flow of its route, or of the one that its last link had."""
        self._watches: dict[Source, asyncio.TimerHandle] = {}
        self._pasts: OrderedDict[Source, ReceptionHistory] = OrderedDict(pasts or {})
        """Of each reliable source without a flow that had one: what its next one must know."""

    @property
    def count(self) -> int:
        """How many proxies there are."""
        return len(self._proxies)

    def __iter__(self) -> Iterator[tuple[str, Proxy]]:
        """Each remote node and its proxy."""
        return iter(self._proxies.items())

    def publication(self, source: Source) -> Publication | None:
        """The local end of a source, if it is there."""
        proxy = self._proxies.get(source.node)
        return proxy.publications.get(source.topic) if proxy else None

    def flow(self, source: Source, route: int) -> ImportFlow | None:
        """What comes of a source: over its open route, or what waits for its peer to come back."""
        return self.flows.get(route) or self._latest.get(source)

    def publish(self, action: Publish) -> None:
        """Let a source appear; takes a moment."""
        self._wanted[action.source] = action
        self._jobs.put_nowait(action)

    def retract(self, action: Retract) -> None:
        """Let a source disappear: its data stops at once, its registration a moment later."""
        self._wanted.pop(action.source, None)
        self._over(action.source, missed=True)
        self._jobs.put_nowait(action)

    def hold(self, node: str, key: str, ready: Callable[[SlaveNode], None]) -> None:
        """Keep the proxy of a node for something else than a topic, until ``release``.

        Args:
            node: In the peer's graph.
            key: What for; names it at ``release``.
            ready: Gets the proxy in a moment; what it registers there it takes away itself.
        """
        self._holds[node, key] = ready
        self._jobs.put_nowait(_Hold(node, key))

    def release(self, node: str, key: str) -> None:
        """The proxy is not needed for that any more."""
        self._holds.pop((node, key), None)
        self._jobs.put_nowait(_Hold(node, key))

    def describe(self, action: Describe, on_ack: Callable[[int], None]) -> None:
        """Data of a source will come on a route; its subscribers learn what it is.

        Args:
            action: What is known of it.
            on_ack: Acknowledges the messages of a reliable route.
        """
        publication = self.publication(action.source)
        if publication is None:
            return
        flow, goes_on = self._flow(action, publication, on_ack)
        self.flows[action.route] = flow
        about = action.description
        text = about.definition.encode("latin-1").decode(errors="surrogateescape")
        if publication.describe(TopicDescription(about.type, about.md5, text, about.latching)):
            self._call_back_soon(action.source, publication)
        if not goes_on:
            flow.expect_replay(publication.latched)

    def position(self, source: Source) -> tuple[int, int] | None:
        """Where a reliable source goes on that outlived its link, or whose route ended though somebody listens."""
        flow = self._latest.get(source)
        if flow is not None:
            return flow.position
        past = self._pasts.get(source)
        return past.receiver.position() if past is not None and past.receiver is not None else None

    def past(self, source: Source) -> ReceptionHistory | None:
        """What is known of a reliable source without a route."""
        return self._pasts.get(source)

    def left_out(self, source: Source, count: int, size: int) -> bool:
        """A source's agent says how many of its messages were too long; whether that is news of an open route.

        Args:
            source: Which.
            count: Messages, since that agent connected to the publisher.
            size: The last one's bytes.
        """
        flow = self._latest.get(source)
        if flow is None or (count, size) == (flow.oversized, flow.oversized_bytes):
            return False
        flow.oversized, flow.oversized_bytes = count, size
        return True

    def unheard(self, subscribed: Callable[[str], bool]) -> None:
        """Nobody misses what comes on topics that nobody subscribes to any more.

        Args:
            subscribed: Whether a local node subscribes to a topic.
        """
        for past in self._pasts.values():
            if past.missed and not subscribed(past.topic):
                past.forget_position(missed=False)

    def _flow(
        self, action: Describe, publication: Publication, on_ack: Callable[[int], None]
    ) -> tuple[ImportFlow, bool]:
        """The flow of a route, and whether it goes on exactly where it was when its link fell."""
        source, contract = action.source, action.contract
        reliable = contract.reliability is Reliability.RELIABLE
        flow = self._latest.pop(source, None)
        outlived = flow is not None and flow.contract == contract and reliable
        past = self._pasts.pop(source, None)
        if flow is not None and outlived:
            flow.rebind(on_ack)
            flow.watch.link_up(asyncio.get_running_loop().time())
            missed = True
        else:
            if flow is not None:
                past = flow.past(publication.topic, missed=True)
                self._end(source, flow)
            missed = past is not None and past.missed
            flow = ImportFlow(
                publication,
                contract,
                self.time,
                on_ack=on_ack,
                on_torn=lambda: self._call_back_soon(source, publication),
                on_broken=lambda occurred: self._on_occurred(source, occurred),
                counters=self._counters,
                past=past if reliable else None,
            )
        same = missed and flow.position is not None and flow.position[0] == action.epoch
        flow.begin_epoch(action.epoch, action.first)
        publication.bound(contract.depth)
        if contract.durability is Durability.TRANSIENT_LOCAL:
            publication.keep(contract.kept)
        self._latest[source] = flow
        self._watch(source, flow)
        if reliable:
            self._count_missed(flow, action, missed=missed, same=same)
        return flow, outlived and same

    @staticmethod
    def _count_missed(flow: ImportFlow, action: Describe, *, missed: bool, same: bool) -> None:
        """Count what the peer says that it has given up.

        Args:
            flow: The source's.
            action: What the peer says.
            missed: Whether somebody listened before, so that nothing may be lost unseen.
            same: Whether the numbering goes on.
        """
        if same:
            if action.following is not None:
                flow.skip(action.following)
            return
        if action.lost is not None:
            flow.missed(action.lost)
        if action.at_least or (missed and action.lost is None):
            what = "more than that" if action.lost else "its agent was restarted, or knows nothing of what it missed"
            flow.missed_unknown(what)

    def _watch(self, source: Source, flow: ImportFlow) -> None:
        """Look at a source's contract when it may be broken next."""
        timer = self._watches.pop(source, None)
        if timer is not None:
            timer.cancel()
        due = flow.watch.next_timer()
        if due is not None:
            loop = asyncio.get_running_loop()
            self._watches[source] = loop.call_at(due, self._watch_due, source, flow)

    def _watch_due(self, source: Source, flow: ImportFlow) -> None:
        self._watches.pop(source, None)
        for occurred in flow.watch.handle_timer(asyncio.get_running_loop().time()):
            self._on_occurred(source, occurred)
        self._watch(source, flow)

    def _end(self, source: Source, flow: ImportFlow) -> None:
        timer = self._watches.pop(source, None)
        if timer is not None:
            timer.cancel()
        flow.close()

    def _over(self, source: Source, *, missed: bool) -> None:
        """No flow of a source goes on; its proxy may go with it, so the lease is not waited for.

        Args:
            source: Which.
            missed: Whether somebody listens all the same.
        """
        flow = self._latest.pop(source, None)
        if flow is None:
            if not missed and (past := self._pasts.get(source)) is not None:
                past.forget_position(missed=False)
        else:
            self._remember(source, flow, missed=missed)
            for occurred in flow.watch.link_gone(asyncio.get_running_loop().time()):
                self._on_occurred(source, occurred)
            self._end(source, flow)

    def _remember(self, source: Source, flow: ImportFlow, *, missed: bool) -> None:
        publication = self.publication(source)
        past = flow.past(publication.topic if publication is not None else source.topic, missed=missed)
        if past is not None and (missed or past.lost or past.counts):
            self._pasts[source] = past
            if len(self._pasts) > mesh_limits.LOSSES_REMEMBERED:
                self._pasts.popitem(last=False)

    def leave(self) -> dict[Source, ReceptionHistory]:
        """The peer has been away for too long: what is to be known when it is back."""
        for source, flow in self._latest.items():
            self._remember(source, flow, missed=True)
        return dict(self._pasts)

    def _call_back_soon(self, source: Source, publication: Publication) -> None:
        """Subscribers were hung up on: they come again when the master names the proxy.

        rospy only then, and only if it has noticed the end by that time.
        """
        for delay in limits.CALL_BACK_DELAYS:
            asyncio.get_running_loop().call_later(delay, self._call_back, source, publication)

    def _call_back(self, source: Source, publication: Publication) -> None:
        proxy = self._proxies.get(source.node)
        if proxy is not None and proxy.publications.get(source.topic) is publication:
            self._register(proxy, source.topic)

    def link_down(self) -> int:
        """The link is gone: what it brought in part is dropped, and nobody says any more that its sources live.

        Returns:
            How many best-effort routes were open: what they miss from now on nobody can count.
        """
        now = asyncio.get_running_loop().time()
        for flow in self.flows.values():
            flow.torn()
            flow.watch.link_down(now)
        return sum(flow.contract.reliability is not Reliability.RELIABLE for flow in self.flows.values())

    def detach(self, action: Detach) -> None:
        """No data comes on a route any more, or not until its peer is back."""
        flow = self.flows.pop(action.route, None)
        if action.keep:
            if flow is not None:
                self._watch(action.source, flow)
            return
        self._over(action.source, missed=action.missed)
        publication = self.publication(action.source)
        if publication is not None:
            publication.forget_latched()

    def reconcile(self, publishers: Mapping[str, Mapping[str, str]]) -> int:
        """Register again what is missing from the local graph; return how many that were."""
        missing = [
            (proxy, topic)
            for proxy in yielding_to_data(list(self._proxies.values()), every=1)
            for topic, publication in tuple(proxy.publications.items())
            if publishers.get(publication.topic, {}).get(proxy.node.name) != proxy.node.uri
        ]
        for proxy, topic in missing:
            self._register(proxy, topic)
        if self._jobs.empty():
            if self.names or self.problems:
                there = set(self._proxies)
                there.update(source.node for source in yielding_to_data(list(self._wanted)))
                there.update(node for node, _ in yielding_to_data(list(self._holds)))
                self.names = {node: name for node, name in self.names.items() if node in there}
                self.problems = {node: text for node, text in self.problems.items() if node in there}
            for source, action in yielding_to_data(list(self._wanted.items())):
                if self.publication(source) is None:
                    self._jobs.put_nowait(action)
            for (node, key), ready in yielding_to_data(list(self._holds.items())):
                kept = self._proxies.get(node)
                if kept is None or kept.held.get(key) is not ready:
                    self._jobs.put_nowait(_Hold(node, key))
        return len(missing)

    async def close(self) -> None:
        """Retract everything that is still there."""
        for flow in self._latest.values():
            flow.close()
        for timer in self._watches.values():
            timer.cancel()
        self._watches.clear()
        self._latest.clear()
        self.flows.clear()
        self._jobs.put_nowait(None)
        await self._task

    async def _work(self) -> None:
        while (job := await self._jobs.get()) is not None:
            try:
                if isinstance(job, Publish):
                    await self._publish(job)
                elif isinstance(job, _Hold):
                    await self._hold(job)
                else:
                    await self._retract(job.source)
            except (RmpaError, OSError) as error:
                self._failed(job.node if isinstance(job, _Hold) else job.source.node, error)
            except Exception:  # noqa: BLE001 - the task's top: one source that fails must not stop the others
                _log.exception("! %s: %s failed; the others go on", self.prefix, job)
        for node in list(self._proxies):
            await self._close_proxy(node)

    def _failed(self, node: str, error: Exception) -> None:
        """A proxy could not be made; it is tried again by ``reconcile``, and told once."""
        text = (
            f"no file descriptor is left for its proxy; {remedy(os.getpid())}" if is_shortage(error) else str(error)
        )
        if self.problems.get(node) != text:
            self.problems[node] = text
            level = logging.DEBUG if is_shortage(error) else logging.ERROR  # a shortage is told for the process
            _log.log(level, "! %s: %s is not in the local graph: %s", self.prefix, node, text)

    async def _publish(self, action: Publish) -> None:
        source = action.source
        if self.publication(source) is not None:
            return  # asked for again while the first attempt was still at work
        proxy = await self._proxy(source.node)
        if self._wanted.get(source) != action:
            # Retracted while the proxy's sockets were being made: to register it would change the topic's type.
            if proxy.idle:
                await self._close_proxy(source.node)
            return
        publication = Publication(
            action.topic or source.topic,
            proxy.node.name,
            on_first_subscriber=lambda: self._on_demand(source, True),
            on_last_subscriber=lambda: self._on_demand(source, False),
            on_mismatch=lambda fields, text: self._on_mismatch(source, printable(fields.get("callerid", "")), text),
            on_listeners=lambda: self._on_listeners(source),
        )
        proxy.node.add_publication(publication)
        proxy.publications[source.topic] = publication
        proxy.types[source.topic] = action.type
        self._register(proxy, source.topic)

    async def _retract(self, source: Source) -> None:
        proxy = self._proxies.get(source.node)
        publication = proxy.publications.pop(source.topic, None) if proxy else None
        if proxy is None or publication is None:
            return
        del proxy.types[source.topic]
        self._core.call("unregisterPublisher", proxy.node.name, publication.topic, proxy.node.uri)
        # rospy never leaves a publisher because the master says so: it must be hung up on.
        proxy.node.remove_publication(publication.topic)
        if proxy.idle:
            await self._close_proxy(source.node)

    async def _hold(self, job: _Hold) -> None:
        if (job.node, job.key) in self._holds:
            proxy = await self._proxy(job.node)
            ready = self._holds.get((job.node, job.key))
            if ready is not None and proxy.held.get(job.key) is not ready:
                proxy.held[job.key] = ready
                ready(proxy.node)
        maybe = self._proxies.get(job.node)
        if maybe is not None and (job.node, job.key) not in self._holds:
            maybe.held.pop(job.key, None)
            if maybe.idle:
                await self._close_proxy(job.node)

    async def _proxy(self, remote: str) -> Proxy:
        """The proxy of a node, made if it is not there."""
        proxy = self._proxies.get(remote)
        if proxy is None:
            name = self.names.get(remote) or proxy_name(self.prefix, remote)
            node = self._nodes.make(name, lambda caller, reason: self._on_kill(remote, caller, reason))
            await node.start()
            self.problems.pop(remote, None)
            proxy = self._proxies[remote] = Proxy(node)
        return proxy

    async def _close_proxy(self, node: str) -> None:
        proxy = self._proxies.pop(node)
        for publication in proxy.publications.values():
            self._core.call("unregisterPublisher", proxy.node.name, publication.topic, proxy.node.uri)
        await proxy.node.close()

    def _register(self, proxy: Proxy, topic: str) -> None:
        code, status, _ = self._core.call(
            "registerPublisher",
            proxy.node.name,
            proxy.publications[topic].topic,
            proxy.types[topic],
            proxy.node.uri,
        )
        if code != 1:
            _log.error("! the local core does not take %s of %s: %s", topic, proxy.node.name, status)

"""Drives the imports: one proxy node in the local graph for each node of a peer that publishes something."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rmpa.bridge.actions import Publish
from rmpa.bridge.aio.flows import ImportFlow, LinkTime
from rmpa.bridge.proxy_names import proxy_name
from rmpa.core import limits
from rmpa.core.aio.loop import breathing
from rmpa.core.contract import Durability, Reliability
from rmpa.core.errors import RmpaError
from rmpa.ros.aio.publication import Publication
from rmpa.ros.aio.slave_server import SlaveNode
from rmpa.ros.tcpros import Description, printable

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from rmpa.bridge.actions import Describe, Detach, Retract
    from rmpa.bridge.messages import Source
    from rmpa.bridge.watch import Occurred
    from rmpa.core.counters import Counters
    from rmpa.ros.aio.core_api import Core

_log = logging.getLogger(__name__)


def _not_here(name: str, reason: str) -> None:
    """Somebody asked a proxy to end (``rosnode kill``); only its module can do that."""
    _log.warning("! %s stands for a node of another module and cannot be ended from here (%s)", name, reason)


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


class Inbound:
    """The proxies of one peer.

    Making a proxy binds sockets, which takes a turn of the loop; so what changes the graph is done one after the
    other by a task, in the order in which it was asked for.

    Args:
        core: The local core, in which the proxies are registered.
        prefix: The namespace of this peer's proxies.
        counters: Where refusals at the proxies' ports, and messages that reach no subscriber, are counted.
        on_demand: Called with a source and whether somebody local listens to it.
        on_mismatch: Called with a source, the caller id of a refused subscriber and the text it was told.
        on_occurred: Called with a source and what became of its contract.
        on_listeners: Called with a source when other nodes than before are served with it.
    """

    def __init__(
        self,
        core: Core,
        prefix: str,
        *,
        counters: Counters | None = None,
        on_demand: Callable[[Source, bool], None],
        on_mismatch: Callable[[Source, str, str], None],
        on_occurred: Callable[[Source, Occurred], None],
        on_listeners: Callable[[Source], None] = lambda _: None,
    ) -> None:
        self._on_listeners = on_listeners
        self._on_occurred = on_occurred
        self.prefix = prefix
        self._core = core
        self._counters = counters
        self._on_demand = on_demand
        self._on_mismatch = on_mismatch
        self._proxies: dict[str, Proxy] = {}
        self._wanted: dict[Source, Publish] = {}
        self._holds: dict[tuple[str, str], Callable[[SlaveNode], None]] = {}
        self._jobs: asyncio.Queue[Publish | Retract | _Hold | None] = asyncio.Queue()
        self._task = asyncio.create_task(self._work(), name=f"proxies {prefix}")
        self.names: dict[str, str] = {}
        """Of nodes of other modules that the peer passes on: what stands for them here."""
        self.flows: dict[int, ImportFlow] = {}
        """Open routes; the data path looks here."""
        self.time = LinkTime()
        self._latest: dict[Source, ImportFlow] = {}
        """Of each source: the flow of its route, or of the one that its last link had."""
        self._watches: dict[Source, asyncio.TimerHandle] = {}

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
        self._over(action.source)
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
        if publication.describe(Description(about.type, about.md5, text, about.latching)):
            self._call_back_soon(action.source, publication)
        if not goes_on:
            flow.expect_replay(publication.latched)

    def position(self, source: Source) -> tuple[int, int] | None:
        """Where a reliable source goes on that outlived its link."""
        flow = self._latest.get(source)
        return flow.position if flow is not None else None

    def _flow(
        self, action: Describe, publication: Publication, on_ack: Callable[[int], None]
    ) -> tuple[ImportFlow, bool]:
        """The flow of a route, and whether it goes on exactly where it was when its link fell."""
        source, contract = action.source, action.contract
        flow = flow_before = self._latest.pop(source, None)
        goes_on = False
        if flow is not None and flow.contract == contract and contract.reliability is Reliability.RELIABLE:
            flow.rebind(on_ack)
            flow.watch.link_up(asyncio.get_running_loop().time())
            goes_on = flow.begin_epoch(action.epoch, action.first)
            if not goes_on:
                _log.warning("! %s: %s: messages were lost, it is not known how many", self.prefix, source)
        else:
            if flow is not None:
                self._end(source, flow)
            flow = ImportFlow(
                publication,
                contract,
                self.time,
                on_ack=on_ack,
                on_torn=lambda: self._call_back_soon(source, publication),
                on_broken=lambda occurred: self._on_occurred(source, occurred),
                counters=self._counters,
            )
            position = flow_before.position if flow_before is not None else None
            known = position is not None and position[0] == action.epoch
            flow.begin_epoch(action.epoch, position[1] + 1 if position is not None and known else action.first)
        publication.bound(contract.depth)
        if contract.durability is Durability.TRANSIENT_LOCAL:
            publication.keep(contract.kept)
        self._latest[source] = flow
        self._watch(source, flow)
        return flow, goes_on

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

    def _over(self, source: Source) -> None:
        """No flow of a source goes on; its proxy may go with it, so the lease is not waited for."""
        flow = self._latest.pop(source, None)
        if flow is not None:
            for occurred in flow.watch.link_gone(asyncio.get_running_loop().time()):
                self._on_occurred(source, occurred)
            self._end(source, flow)

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
        self._over(action.source)
        publication = self.publication(action.source)
        if publication is not None:
            publication.forget_latched()

    def reconcile(self, publishers: Mapping[str, Mapping[str, str]]) -> int:
        """Register again what is missing from the local graph; return how many that were."""
        missing = [
            (proxy, topic)
            for proxy in breathing(list(self._proxies.values()), every=1)
            for topic, publication in tuple(proxy.publications.items())
            if publishers.get(publication.topic, {}).get(proxy.node.name) != proxy.node.uri
        ]
        for proxy, topic in missing:
            self._register(proxy, topic)
        if self._jobs.empty():
            there = {*self._proxies, *(source.node for source in self._wanted), *(node for node, _ in self._holds)}
            self.names = {node: name for node, name in self.names.items() if node in there}
            for source, action in breathing(list(self._wanted.items())):
                if self.publication(source) is None:
                    self._jobs.put_nowait(action)
            for (node, key), ready in breathing(list(self._holds.items())):
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
                # Most likely no file descriptor is left; what is wanted is tried again by ``reconcile``.
                what = job.key if isinstance(job, _Hold) else job.source
                _log.error("! %s: %s is not in the local graph: %s", self.prefix, what, error)
            except Exception:  # noqa: BLE001 - the task's top: one source that fails must not stop the others
                _log.exception("! %s: %s failed; the others go on", self.prefix, job)
        for node in list(self._proxies):
            await self._close_proxy(node)

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
            node = SlaveNode(
                name,
                self._core.node_host,
                self._core.uri,
                advertised_host=self._core.node_address,
                counters=self._counters,
                on_shutdown=lambda reason: _not_here(name, reason),
            )
            await node.start()
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

"""One publisher of another site in the gateway's graph, and the part for topics.

One publisher of another site, in the gateway's graph.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rmpa.bridge.policy import Needs
from rmpa.config.peer_rules import Access
from rmpa.core.counters import Counters
from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway import limits
from rmpa.gateway.neighbour import SourceKind, ZenohPriority
from rmpa.gateway.sites.catalogue import SiteTraffic
from rmpa.gateway.sites.exported_topic import REFUSED, ExportedTopic, SequenceCounter, TopicHeader
from rmpa.gateway.sites.keys import ROOT, AttachmentReader
from rmpa.gateway.sites.plans import SitePart, site_counts
from rmpa.ros.wire.tcpros import printable

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.core.contract import Contracts
    from rmpa.gateway.neighbour import ZenohSample
    from rmpa.gateway.own_graph import AgentGraph
    from rmpa.gateway.sites.catalogue import CrossingRules
    from rmpa.gateway.sites.keys import MessageSource, SiteModule
    from rmpa.gateway.sites.plans import SiteExport, SiteImport
    from rmpa.gateway.zenoh.config import ArrivedQuery
    from rmpa.gateway.zenoh.session import Declaration, OpenSession
    from rmpa.ros.wire.tcpros import TopicDescription
    from rmpa.runtime.loop import SystemClock

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class InterruptedTopic:
    """What is kept of a topic that went while nodes subscribed, so that what is lost meanwhile is counted.

    Args:
        sequence: Its counts of messages and losses.
        traffic: Its traffic.
    """

    sequence: SequenceCounter
    traffic: SiteTraffic


class ImportedTopic:
    """Shows one publisher of another site, and publishes its messages while nodes subscribe.

    On demand its key is subscribed to, and its gateway is asked for the publisher's header. Messages that come before
    the header wait for it, since no subscriber is accepted before.

    Args:
        entry: The source.
        site: This site's name.
        graph: The gateway's graph.
        session: The Zenoh session.
        clock: Both clocks.
        on_demand: ``(topic, wanted)``: its key is to be subscribed to, or no longer.
        interrupted: What ``close`` returned before, if the same topic was there and went.
    """

    def __init__(
        self,
        entry: SiteImport,
        site: str,
        graph: AgentGraph,
        session: OpenSession,
        clock: SystemClock,
        on_demand: Callable[[ImportedTopic, bool], None],
        interrupted: InterruptedTopic | None = None,
    ) -> None:
        self.entry = entry
        self._site = site
        self._session = session
        self._clock = clock
        self._on_demand = on_demand
        self.wanted = False
        """Whether its key is subscribed to for it."""
        self._description: TopicDescription | None = None
        self._problem = ""
        self._held: deque[tuple[bytes, str]] = deque()
        self._sequence = SequenceCounter() if interrupted is None else interrupted.sequence
        self._traffic = SiteTraffic(clock.now()) if interrupted is None else interrupted.traffic
        self._resumes_until = 0.0 if interrupted is None else clock.now() + limits.RESUMED_WITHIN
        self._check_at = float("inf")
        self._check_pause = limits.IDLE_CHECK
        self._fresh = False
        self._run = 0
        self._last_latched: bytes | None = None
        self._held_dropped = self._mismatched = self._dropped = 0
        self._task: asyncio.Task[None] | None = None
        self._linger: asyncio.TimerHandle | None = None
        self._closed = False
        self._topic = graph.show_topic(entry.source, self._demand)

    @property
    def used(self) -> bool:
        """Whether there is anything to tell of it."""
        return self.wanted or bool(self._traffic.messages or self.problem)

    @property
    def problem(self) -> str:
        """Why its messages do not come, or are not understood; empty for nothing."""
        return self._problem or self._topic.problem

    def take(self, payload: bytes, sequence: int, source: MessageSource) -> None:
        """Take a message of this publisher, with what its attachment says."""
        if not self._sequence.take(source.run, sequence):
            return
        self._fresh = True
        self._traffic.add(len(payload))
        if source.latched:
            renewed, self._run = source.run != self._run, source.run
            if renewed and payload == self._last_latched:
                return  # another gateway of that site has taken over, and had it from the publisher again
            self._last_latched = payload
        if self._description is None or source.md5 != self._description.md5sum:
            self._hold(payload, source.md5)
        else:
            self._dropped += self._topic.publish(payload)

    def renew(self, entry: SiteImport) -> None:
        """Its module has started anew, or the way to it was interrupted: ask for the header again."""
        if entry.announced.module != self.entry.announced.module:
            self._topic.forget_latched()
            self._last_latched = None
        moved = self.wanted and entry.announced.key() != self.entry.announced.key()
        if moved:
            self._on_demand(self, False)
        self.entry = entry
        if moved:
            self._on_demand(self, True)
        if self.wanted:
            self._ask()

    def check(self, now: float) -> None:
        """Ask for the last sequence number if no message has come for a while: a loss at the end leaves no gap.

        It is asked again after twice the time, as long as no message comes, at most
        ``limits.IDLE_CHECK_MAX`` later.
        """
        if self._fresh:
            self._fresh = False
            self._check_soon()
        elif self.wanted and now >= self._check_at and self._task is None:
            self._check_pause = min(self._check_pause * 2, limits.IDLE_CHECK_MAX)
            self._check_at = now + self._check_pause
            self._ask()

    def report(self) -> dict[str, object]:
        """What ``rmpa site info`` shows of it, as JSON values."""
        self._traffic.read(self._clock.now())
        source, announced, traffic = self.entry.source, self.entry.announced, self._traffic
        return {
            "site": source.site,
            "module": source.module,
            "node": source.node,
            "name": announced.name,
            "here": source.name,
            "type": source.type,
            "md5sum": self._description.md5sum if self._description is not None else "",
            "latching": self._description is not None and self._description.latching,
            "wanted": self.wanted,
            "messages": traffic.messages,
            "bytes": traffic.bytes,
            "rate": round(traffic.rate, 2),
            "bandwidth": round(traffic.bandwidth),
            "lost": self._sequence.lost,
            "mismatched": self._mismatched,
            "dropped": self._dropped + self._held_dropped,
            "problem": self.problem,
        }

    def close(self) -> InterruptedTopic | None:
        """Take it out of the graph; what it returns is for the same topic once it is back."""
        self._closed = True
        interrupted = None
        if self.wanted and self._linger is None:
            interrupted = InterruptedTopic(self._sequence, self._traffic)
            self._sequence = SequenceCounter()
        self._stop_lingering()
        if self._task is not None:
            self._task.cancel()
            self._task = None
        self._detach()
        self._topic.close()
        return interrupted

    # --- demand ---------------------------------------------------------------------------------------------------

    def _demand(self, wanted: bool) -> None:
        if self._closed:
            return
        self._stop_lingering()
        if not wanted:
            if self.wanted:
                self._linger = asyncio.get_running_loop().call_later(limits.DEMAND_LINGER, self._detach)
        elif not self.wanted:
            self.wanted = True
            if self._clock.now() > self._resumes_until:
                self._sequence.restart()
            self._resumes_until = 0.0
            self._on_demand(self, True)
            self._check_soon()
            self._ask()

    def _stop_lingering(self) -> None:
        if self._linger is not None:
            self._linger.cancel()
            self._linger = None

    def _detach(self) -> None:
        self._linger = None
        if not self.wanted:
            return
        self.wanted = False
        self._on_demand(self, False)
        # The next subscriber gets the last message from over there.
        self._sequence.restart()
        self._topic.forget_latched()
        self._last_latched = None
        self._held.clear()

    # --- the header -----------------------------------------------------------------------------------------------

    def _ask(self) -> None:
        if self._task is None:
            self._task = asyncio.get_running_loop().create_task(
                self._ask_until_known(), name=f"header of {self.entry.source.name} at {self.entry.source.site}"
            )

    async def _ask_until_known(self) -> None:
        pause = limits.HEADER_RETRY / 16
        try:
            while self.wanted:
                if await self._ask_once():
                    break
                await asyncio.sleep(pause)
                pause = min(limits.HEADER_RETRY, pause * 2)
        finally:
            if self._task is asyncio.current_task():
                self._task = None

    async def _ask_once(self) -> bool:
        """Ask for the header; return whether it need not be asked again."""
        announced = self.entry.announced
        key = f"{ROOT}/{announced.module.site}/{announced.module.name}/d/t{announced.name}"
        replies = await self._session.get(
            f"{key}?node={announced.node};site={self._site}",
            timeout=limits.HEADER_TIMEOUT,
            priority=ZenohPriority.INTERACTIVE_HIGH,
        )
        if not replies:
            self._problem = f"site {announced.module.site} does not answer the question for its header"
            return False
        reply = next((each for each in replies if each.ok), replies[0])
        if not reply.ok:
            text = printable(reply.payload[:400].decode(errors="replace"))
            self._problem = f"site {announced.module.site} says: {text}"
            if text.startswith(REFUSED):
                self._detach()
                return True
            return False
        try:
            header = TopicHeader.parse(reply.payload)
        except RemoteProtocolError as error:
            self._problem = str(error)
            return False
        self._described(header)
        return True

    def _described(self, header: TopicHeader) -> None:
        self._problem = ""
        self._sequence.announced(header.run, header.sequence - header.waiting)
        if header.waiting:
            self._check_soon()
        described, self._description = self._description, header.description
        if header.description != described:
            self._topic.describe(header.description)
        held, self._held = self._held, deque()
        for payload, md5 in held:
            if md5 == header.description.md5sum:
                self._dropped += self._topic.publish(payload)
            else:
                self._mismatched += 1

    def _hold(self, payload: bytes, md5: str) -> None:
        """Keep a message until the header is known, or known anew: its publisher has another definition."""
        self._held.append((payload, md5))
        size = sum(len(each) for each, _ in self._held) if len(payload) > limits.LARGE_MESSAGE else 0
        while len(self._held) > limits.HELD_MESSAGES_MAX or (size > limits.HELD_BYTES and len(self._held) > 1):
            size -= len(self._held.popleft()[0])
            self._held_dropped += 1
        if self._description is not None:
            self._problem = f"its messages have the md5 sum {md5}, its header {self._description.md5sum}"
        self._ask()

    def _check_soon(self) -> None:
        self._check_pause = limits.IDLE_CHECK
        self._check_at = self._clock.now() + limits.IDLE_CHECK


# The part of the neighbour "other sites" for topics.


@dataclass(slots=True)
class _Subscription:
    """The subscription to one topic of one module at another site, which its publishers share."""

    declared: Declaration
    topics: dict[str, ImportedTopic] = field(default_factory=dict)
    """By node."""
    latched: dict[str, tuple[bytes, int, MessageSource]] = field(default_factory=dict)
    """The last latched message of nodes that are not wanted: they were told once, and would not be again."""


class SiteTopics(SitePart):
    """Topics between sites: a ``SitePart``.

    Args:
        site: This site's name.
        graph: The gateway's graph.
        session: The Zenoh session.
        rules: Tell which site may have which topic.
        contracts: The contracts of topics, which become Zenoh's QoS.
        clock: Both clocks.
        counters: ``site.message.malformed``, ``site.message.looped``, ``site.message.unwanted_node``, and
            ``site.message.unkept``: a latched message of a node that no node here wants, and that found no room.
    """

    name = "topics"

    def __init__(
        self,
        site: str,
        graph: AgentGraph,
        session: OpenSession,
        rules: CrossingRules,
        contracts: Contracts,
        clock: SystemClock,
        counters: Counters | None = None,
    ) -> None:
        self._site = site
        self._graph = graph
        self._session = session
        self._rules = rules
        self._contracts = contracts
        self._clock = clock
        self._exported: dict[tuple[str, str], dict[tuple[str, str], ExportedTopic]] = {}
        """By module and topic, then by node and the site that it is for (empty: for all)."""
        self._imported: dict[tuple[str, str, str, str], ImportedTopic] = {}
        """By site, module, node and name there."""
        self._interrupted: dict[tuple[str, str, str, str], InterruptedTopic] = {}
        """Likewise: those that went while nodes subscribed."""
        self._subscriptions: dict[str, _Subscription] = {}
        self._questions: dict[SiteModule, tuple[Declaration, Declaration]] = {}
        self._reader = AttachmentReader()
        self._check_timer: asyncio.TimerHandle | None = None
        self.counters = counters if counters is not None else Counters()

    # --- SitePart -------------------------------------------------------------------------------------------------

    def export(self, entry: SiteExport) -> None:
        """Declare a publisher of this site, for other sites."""
        if entry.source.kind is not SourceKind.TOPIC:
            return
        self.withdraw(entry)
        contract = self._contracts.of(entry.source.here, entry.announced.type)
        topics = self._exported.setdefault((entry.source.module, entry.source.name), {})
        topics[entry.source.node, entry.announced.to] = ExportedTopic(
            entry, self._graph, self._session, contract, self._clock
        )

    def withdraw(self, entry: SiteExport) -> None:
        """Undeclare it."""
        if entry.source.kind is not SourceKind.TOPIC:
            return  # a service of a node may have the name of its topic
        key = (entry.source.module, entry.source.name)
        topic = self._exported.get(key, {}).pop((entry.source.node, entry.announced.to), None)
        if topic is not None:
            topic.close()
            if not self._exported[key]:
                del self._exported[key]

    def show(self, entry: SiteImport) -> None:
        """Show a publisher of another site."""
        if entry.source.kind is SourceKind.TOPIC:
            self.hide(entry)
            ident = _ident(entry)
            interrupted = self._interrupted.pop(ident, None)
            self._imported[ident] = ImportedTopic(
                entry,
                self._site,
                self._graph,
                self._session,
                self._clock,
                self._on_demand,
                interrupted,
            )

    def renew(self, old: SiteImport, new: SiteImport) -> None:
        """It is of another run of its module, or comes by another gateway."""
        del old
        topic = self._imported.get(_ident(new))
        if topic is not None and new.source.kind is SourceKind.TOPIC:
            topic.renew(new)

    def hide(self, entry: SiteImport) -> None:
        """Take it out of the graph."""
        if entry.source.kind is SourceKind.TOPIC:
            topic = self._imported.pop(_ident(entry), None)
            interrupted = topic.close() if topic is not None else None
            if interrupted is not None:
                self._interrupted[_ident(entry)] = interrupted
                if len(self._interrupted) > limits.INTERRUPTED_TOPICS_MAX:
                    del self._interrupted[next(iter(self._interrupted))]

    def module_changed(self, module: SiteModule, there: bool) -> None:
        """Answer questions for headers and definitions of a module of this site."""
        if module.site != self._site:
            return
        if there and module not in self._questions:
            prefix = f"{ROOT}/{module.site}/{module.name}/d"
            self._questions[module] = (
                self._session.queryable(
                    f"{prefix}/t/**",
                    lambda query: self._on_header_query(module, query),
                    Needs((Access.SUBSCRIBE,), "the topic, of the site", key="rmpa/1/<site>/<module>/d/t/**"),
                ),
                self._session.queryable(
                    f"{prefix}/m/*",
                    lambda query: self._on_definition_query(module, query),
                    Needs((), "the definition of a type whose md5 sum is known", key="rmpa/1/<site>/<module>/d/m/*"),
                ),
            )
        elif not there:
            for declared in self._questions.pop(module, ()):
                declared.close()

    def report(self) -> dict[str, object]:
        """The topics that go out and come in, as far as they are or were used."""
        out = [topic for nodes in self._exported.values() for topic in nodes.values()]
        return {
            "out": [topic.report() for topic in out if topic.used],
            "in": [topic.report() for topic in self._imported.values() if topic.used],
            "counters": site_counts(self.counters),
        }

    async def close(self) -> None:
        """End it: everything was withdrawn and hidden before."""
        if self._check_timer is not None:
            self._check_timer.cancel()
            self._check_timer = None
        for declared in (each for pair in self._questions.values() for each in pair):
            declared.close()
        self._questions.clear()

    # --- what comes in --------------------------------------------------------------------------------------------

    def _on_demand(self, topic: ImportedTopic, wanted: bool) -> None:
        announced = topic.entry.announced
        key = announced.key()
        subscription = self._subscriptions.get(key)
        if wanted:
            if subscription is None:
                declared = self._session.subscribe(key, lambda sample: self._on_sample(key, sample), history=True)
                subscription = self._subscriptions[key] = _Subscription(declared)
            subscription.topics[announced.node] = topic
            self._check_later()
            known = subscription.latched.pop(announced.node, None)
            if known is not None:
                topic.take(*known)
        elif subscription is not None:
            subscription.topics.pop(announced.node)
            if not subscription.topics:
                del self._subscriptions[key]
                subscription.declared.close()

    def _on_sample(self, key: str, sample: ZenohSample) -> None:
        try:
            sequence, _, source = self._reader.read(sample.attachment)
        except RemoteProtocolError:
            self.counters.add("site.message.malformed")
            return
        if self._site in source.path:
            self.counters.add("site.message.looped")
            return
        subscription = self._subscriptions.get(key)
        if subscription is None:
            return
        topic = subscription.topics.get(source.node)
        if topic is not None:
            topic.take(sample.payload, sequence, source)
            return
        self.counters.add("site.message.unwanted_node")
        known = subscription.latched
        if source.latched and (source.node in known or len(known) < limits.LATCHED_NODES_MAX):
            others = sum(len(each[0]) for node, each in known.items() if node != source.node)
            if others + len(sample.payload) > limits.HELD_BYTES:
                self.counters.add("site.message.unkept")
            else:
                known[source.node] = sample.payload, sequence, source

    def _check_later(self) -> None:
        if self._check_timer is None and self._subscriptions:
            self._check_timer = asyncio.get_running_loop().call_later(limits.IDLE_CHECK, self._check)

    def _check(self) -> None:
        self._check_timer = None
        now = self._clock.now()
        for subscription in self._subscriptions.values():
            for topic in subscription.topics.values():
                topic.check(now)
        self._check_later()

    # --- questions of other sites -----------------------------------------------------------------------------------

    def _on_header_query(self, module: SiteModule, query: ArrivedQuery) -> None:
        name = query.key.removeprefix(f"{ROOT}/{module.site}/{module.name}/d/t")
        asked = dict(pair.partition("=")[::2] for pair in query.parameters.split(";"))
        node, site = asked.get("node", ""), asked.get("site", "")
        if refusal := self._rules.refusal(site, module.name, name):
            query.reply_error(f"{REFUSED}{refusal}")
            return
        topics = self._exported.get((module.name, name), {})
        fitting = (each for (its, to), each in topics.items() if node in ("", its) and to in ("", site))
        topic = next(fitting, None)
        if topic is None:
            query.reply_error(f"no such publisher of {name[:200]} at {module.name}")
            return
        topic.ask(query)

    def _on_definition_query(self, module: SiteModule, query: ArrivedQuery) -> None:
        md5 = query.key.rpartition("/")[2]
        for (name, _), nodes in self._exported.items():
            for topic in nodes.values() if name == module.name else ():
                if topic.description is not None and topic.description.md5sum == md5:
                    query.reply(query.key, topic.description.definition.encode(errors="surrogateescape"))
                    query.finish()
                    return
        query.reply_error(f"no publisher with the md5 sum {md5[:40]} was connected yet")


def _ident(entry: SiteImport) -> tuple[str, str, str, str]:
    return entry.source.site, entry.source.module, entry.source.node, entry.announced.name

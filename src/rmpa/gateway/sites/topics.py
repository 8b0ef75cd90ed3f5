"""Topics between sites: publishers of this one for the others, and those of other sites in the gateway's graph."""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.bridge.policy import BridgeContext, Needs
from rmpa.config.peer_rules import Access
from rmpa.core.contract import Contract, Contracts, Priority, Reliability
from rmpa.core.errors import RemoteProtocolError, RmpaError
from rmpa.gateway import limits
from rmpa.gateway.foreign import Answering
from rmpa.gateway.sites.keys import ROOT, AttachmentReader, MessageSource, SequenceCounter, TopicHeader
from rmpa.gateway.topics import ExportedTopic
from rmpa.gateway.zenoh.threads import PRIORITIES, BoundedQueue, ZenohPriority, ZenohQos, ZenohSample, first_answer
from rmpa.ros.wire.tcpros import TopicDescription, printable
from rmpa.runtime.loop import Delay
from rmpa.runtime.tasks import keep_task

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.core.statistics import Counters
    from rmpa.gateway.own_graph import AgentGraph
    from rmpa.gateway.rules import CrossingRules, ForeignSource
    from rmpa.gateway.sites.plans import SiteExport, SiteImport
    from rmpa.gateway.zenoh.session import ArrivedQuery, Declaration, OpenSession

# Seconds that a query for a publisher's header waits for it: the gateway there connects to the publisher first.
_HEADER_TIMEOUT: Final = 5.0
# Seconds at most until a header is asked for again, when there was no answer and nodes wait for it; at first a
# sixteenth.
_HEADER_RETRY: Final = 2.0
# Seconds for which a publisher stays connected after its header was asked for: its subscriber comes right after.
_TAP_LINGER: Final = 2.0
# Bytes that wait likewise; one message always fits.
_HELD_BYTES: Final = 64 * 1024 * 1024
# Nodes that publish one latched topic of another site, and of which no node here wants one, whose last message is
# kept.
_LATCHED_NODES_MAX: Final = 64
# Seconds for which a topic of another site stays subscribed after its last subscriber left, as in the mesh.
_DEMAND_LINGER: Final = 1.0
# Seconds without a message after which a receiver asks for the last sequence number: losses at the end of a burst
# leave no gap.
_IDLE_CHECK: Final = 1.0
# Seconds between two such questions at most: the pause doubles while no message comes.
_IDLE_CHECK_MAX: Final = 60.0

# What an error begins with that a rule causes: asking again is of no use.
REFUSED: Final = "refused: "
_HEADER_NEEDS: Final = Needs((Access.SUBSCRIBE,), "the topic, of the site", key="rmpa/1/<site>/<module>/d/t/**")
_DEFINITION_NEEDS: Final = Needs(
    (), "the definition of a type whose md5 sum is known", key="rmpa/1/<site>/<module>/d/m/*"
)


@dataclass(frozen=True, slots=True)
class SiteContext:
    """What topics, services and parameters of a site share.

    Args:
        name: This site's name.
        graph: The gateway's graph.
        session: The Zenoh session.
        rules: Decide what may cross.
        bridge: The gateway's own policy: seconds for calls.
        contracts: The contracts of topics, which become Zenoh's QoS.
        counters: ``site.message.malformed``, ``site.message.looped``, ``site.message.unwanted_node``, and
            ``site.message.unkept``: a latched message of a node that no node here wants, and that found no room.
    """

    name: str
    graph: AgentGraph
    session: OpenSession
    rules: CrossingRules
    bridge: BridgeContext
    contracts: Contracts
    counters: Counters


def qos_of(contract: Contract, *, latching: bool = False, large: bool = False) -> ZenohQos:
    """The QoS of one topic's publisher (docs/design/gateway.md, "Contracts"): a pure table.

    A thread waits for Zenoh; what exceeds the queue before it is dropped there and counted. None has the congestion
    control ``BLOCK``: it ends the link behind which a message waits for seconds, as each large one does on a thin
    link. With ``DROP`` a message waits likewise (``limits.DROP_WAIT``), and the link stays; the receiver counts
    what is lost there by its number.

    Args:
        contract: The topic's.
        latching: Whether a late subscriber gets the last message.
        large: Whether its messages are large: they yield to others unless the contract has a priority.
    """
    return ZenohQos(
        reliable=True,
        block=False,
        priority=PRIORITIES[Priority.LOW if large and contract.priority is Priority.NORMAL else contract.priority],
        messages=contract.queue_depth,
        bytes=limits.RELIABLE_BYTES if contract.reliability is Reliability.RELIABLE else limits.BEST_EFFORT_BYTES,
        cache=1 if latching else 0,
    )


class SiteExportedTopic(ExportedTopic):
    """A publisher of this site for others: messages go as they are.

    Args:
        entry: The source.
        context: What is shared with services.

    Attributes:
        run: By which the numbers of its messages are told apart from those of an earlier export.
    """

    def __init__(self, entry: SiteExport, context: SiteContext) -> None:
        super().__init__(entry.source, context.graph, context.session, entry.rate, entry.size)
        self._announced = entry.announced
        self._contract = context.contracts.of(entry.source.here, entry.announced.type)
        self.run: Final = max(1, time.time_ns())

    def announce(self, about: TopicDescription | None, *, latched: bool, large: bool) -> tuple[str, ZenohQos]:
        """Of ``ExportedTopic``."""
        if about is not None:
            source = self._announced
            try:
                common = MessageSource(about.md5sum, source.node, (source.site,), about.latching, self.run)
                self.attachment = common.writer()
            except ValueError:
                raise RmpaError(f"its publisher names the md5 sum {about.md5sum[:40]!r}") from None
        return self._announced.key(), qos_of(self._contract, latching=latched, large=large)

    def linger(self, *, keeps: bool) -> float:
        """A subscriber that is lost with its link is no different from one that has left.

        While the publisher stays connected its messages are numbered, so that the subscriber counts them as lost when
        it is back.
        """
        del keeps
        reliable = self._contract.reliability is Reliability.RELIABLE
        return max(_TAP_LINGER, self._contract.resume_window if reliable else 0.0)

    async def answer_header(self, _query: ArrivedQuery) -> tuple[bytes, bytes]:
        """The answer to a question for its publisher's header."""
        about = await self.header(_HEADER_TIMEOUT * 0.8)
        definition = about.definition.encode(errors="replace").decode()  # JSON has no bytes that are not UTF-8
        fields = about.type, about.md5sum, definition, about.latching
        header = TopicHeader(*fields, self.source.node, self.run, self.messages, self.waiting)
        return msgspec.json.encode(header), b""


class ImportedTopic:
    """Shows one publisher of another site, and publishes its messages while nodes subscribe.

    On demand its key is subscribed to, and its gateway is asked for the publisher's header. Messages that come before
    the header wait for it, since no subscriber is accepted before. If no message comes for a while its gateway is
    asked for the last number too, for a loss at the end leaves no gap; again after twice the time, at most
    ``_IDLE_CHECK_MAX``.

    Args:
        entry: The source.
        part: Subscribes to its key, and keeps its counts if it goes while nodes subscribe.

    Attributes:
        wanted: Whether its key is subscribed to for it.
    """

    # More than twelve fields: demand, header, and the counts of what was lost meanwhile change each other.

    def __init__(self, entry: SiteImport, part: SiteTopics) -> None:
        now, interrupted = time.monotonic(), part.interrupted.pop((entry.source, entry.announced.name), None)
        self.entry = entry
        self.wanted = False
        self._part = part
        self._description: TopicDescription | None = None
        self._problem = ""
        self._held: BoundedQueue[tuple[bytes, str]] = BoundedQueue(limits.HELD_MESSAGES_MAX, _HELD_BYTES)
        self._sequence, self.messages = interrupted or (SequenceCounter(), 0)
        self._resumes_until = 0.0 if interrupted is None else now + limits.RESUMED_WITHIN
        self._rate_since = 0.0, now, self.messages
        self._fresh = False
        self._run = 0
        self._last_latched: bytes | None = None
        self.mismatched = self.dropped = 0
        self._task: asyncio.Task[None] | None = None
        self._linger, self._checking = Delay(), Delay()
        self._topic = part.context.graph.show_topic(entry.source, self._demand)

    def take(self, payload: bytes, sequence: int, source: MessageSource) -> None:
        """Take a message of this publisher, with what its attachment says."""
        if not self._sequence.take(source.run, sequence):
            return
        self._fresh = True
        self.messages += 1
        if source.latched:
            renewed, self._run = source.run != self._run, source.run
            if renewed and payload == self._last_latched:
                return  # another gateway of that site has taken over, and had it from the publisher again
            self._last_latched = payload
        if self._description is None or source.md5 != self._description.md5sum:
            self._hold(payload, source.md5)
        else:
            self.dropped += self._topic.publish(payload)

    def renew(self, entry: SiteImport) -> None:
        """Its module has started again, or the way to it was interrupted: ask for the header again."""
        if entry.announced.module != self.entry.announced.module:
            self._topic.forget_latched()
            self._last_latched = None
        moved = self.wanted and entry.announced.key() != self.entry.announced.key()
        if moved:
            self._part.unsubscribe(self)
        self.entry = entry
        if moved:
            self._part.subscribe(self)
        if self.wanted:
            self._ask()

    @property
    def lost(self) -> int:
        """Messages that were lost between the gateways."""
        return self._sequence.lost

    @property
    def problem(self) -> str:
        """Why its messages do not come, or are not understood; empty for nothing."""
        return self._problem or self._topic.problem

    def rate(self) -> float:
        """Messages a second since this was last asked."""
        rate, since, before = self._rate_since
        passed = time.monotonic() - since
        if passed >= 1:
            rate = (self.messages - before) / passed
            self._rate_since = rate, since + passed, self.messages
        return rate

    def close(self) -> None:
        """Take it out of the graph; its counts are kept for the same topic once it is back."""
        if self.wanted and not self._linger:
            kept = self._part.interrupted
            kept[self.entry.source, self.entry.announced.name] = self._sequence, self.messages
            if len(kept) > limits.INTERRUPTED_TOPICS_MAX:
                del kept[next(iter(kept))]
            self._sequence = SequenceCounter()
        if self._task is not None:
            self._task.cancel()
        self._detach()
        self._topic.close()

    def _demand(self, wanted: bool) -> None:
        self._linger.cancel()
        if not wanted:
            if self.wanted:
                self._linger.set(_DEMAND_LINGER, self._detach)
        elif not self.wanted:
            self.wanted = True
            if time.monotonic() > self._resumes_until:
                self._sequence.restart()
            self._resumes_until = 0.0
            self._part.subscribe(self)
            self._check_in(_IDLE_CHECK)
            self._ask()

    def _detach(self) -> None:
        self._linger.cancel()
        if not self.wanted:
            return
        self.wanted = False
        self._checking.cancel()
        self._part.unsubscribe(self)
        # The next subscriber gets the last message from over there.
        self._sequence.restart()
        self._topic.forget_latched()
        self._last_latched = None
        self._held.clear()

    def _check_in(self, pause: float) -> None:
        self._checking.set(pause, partial(self._check, pause))

    def _check(self, pause: float) -> None:
        if self._fresh:
            self._fresh = False
            self._check_in(_IDLE_CHECK)
        else:
            self._ask()
            self._check_in(min(pause * 2, _IDLE_CHECK_MAX))

    def _ask(self) -> None:
        if self._task is None or self._task.done():
            source = self.entry.source
            self._task = keep_task(self._ask_until_known, f"header of {source.name} at {source.site}")

    async def _ask_until_known(self) -> None:
        pause = _HEADER_RETRY / 16
        while self.wanted and not await self._ask_once():
            await asyncio.sleep(pause)
            pause = min(_HEADER_RETRY, pause * 2)

    async def _ask_once(self) -> bool:
        """Ask for the header; return whether it need not be asked again."""
        announced, context = self.entry.announced, self._part.context
        replies = await context.session.get(
            f"{ROOT}/{announced.site}/{announced.module.name}/d/t{announced.name}"
            f"?node={announced.node};site={context.name}",
            timeout=_HEADER_TIMEOUT,
            priority=ZenohPriority.INTERACTIVE_HIGH,
        )
        reply = first_answer(replies)
        if reply is None:
            self._problem = f"site {announced.site} does not answer the question for its header"
            return False
        if not reply.ok:
            text = printable(reply.payload[:400].decode(errors="replace"))
            self._problem = f"site {announced.site} says: {text}"
            if text.startswith(REFUSED):
                self._detach()
            return text.startswith(REFUSED)
        try:
            self._described(TopicHeader.parse(reply.payload))
        except RemoteProtocolError as error:
            self._problem = str(error)
            return False
        return True

    def _described(self, header: TopicHeader) -> None:
        self._problem = ""
        self._sequence.announced(header.run, header.sequence - header.waiting)
        if header.waiting and self.wanted:
            self._check_in(_IDLE_CHECK)
        described, self._description = self._description, header.description
        if self._description != described:
            self._topic.describe(self._description)
        for payload, md5 in self._held.clear():
            if md5 == header.md5sum:
                self.dropped += self._topic.publish(payload)
            else:
                self.mismatched += 1

    def _hold(self, payload: bytes, md5: str) -> None:
        """Keep a message until the header is known, or known anew: its publisher has another definition."""
        self.dropped += len(self._held.push((payload, md5), len(payload)))
        if self._description is not None:
            self._problem = f"its messages have the md5 sum {md5}, its header {self._description.md5sum}"
        self._ask()


@dataclass(slots=True)
class _Subscription:
    """The subscription to one topic of one module at another site, which its publishers share.

    Attributes:
        topics: By node.
        latched: The last latched message of nodes that are not wanted: they were told once, and would not be
            again.
    """

    declared: Declaration
    topics: dict[str, ImportedTopic] = field(default_factory=dict)
    latched: dict[str, tuple[bytes, int, MessageSource]] = field(default_factory=dict)


class SiteTopics:
    """Topics between sites.

    Args:
        context: What is shared with services and parameters.

    Attributes:
        questions: Declare what is answered about headers and definitions while this gateway leads its site.
        interrupted: The counts of topics that went while nodes subscribed, so that what is lost meanwhile is counted.
    """

    def __init__(self, context: SiteContext) -> None:
        self.context = context
        # By module and topic, then by node and the site that it is for (empty: for all).
        self._exported: dict[tuple[str, str], dict[tuple[str, str], SiteExportedTopic]] = {}
        self.interrupted: dict[tuple[ForeignSource, str], tuple[SequenceCounter, int]] = {}
        self._subscriptions: dict[str, _Subscription] = {}
        self._reader = AttachmentReader()
        self._headers = Answering("headers", f"the gateway of site {context.name} ends", limits.SITE_CALLS_WAITING)
        prefix, session = f"{ROOT}/{context.name}/*/d", context.session
        self.questions: Final[tuple[Callable[[], Declaration], ...]] = (
            lambda: session.queryable(f"{prefix}/t/**", self._asked_header, _HEADER_NEEDS),
            lambda: session.queryable(f"{prefix}/m/*", self._asked_definition, _DEFINITION_NEEDS),
        )

    def export(self, entry: SiteExport) -> None:
        """Declare a publisher of this site, for other sites."""
        source, export = entry.source, SiteExportedTopic(entry, self.context)
        self._exported.setdefault((source.module, source.name), {})[source.node, entry.announced.to] = export
        export.start()

    def withdraw(self, entry: SiteExport) -> None:
        """Undeclare it."""
        key = (entry.source.module, entry.source.name)
        self._exported[key].pop((entry.source.node, entry.announced.to)).close()
        if not self._exported[key]:
            del self._exported[key]

    def exported(self, entry: SiteExport) -> SiteExportedTopic | None:
        """A topic that goes out."""
        topics = self._exported.get((entry.source.module, entry.source.name), {})
        return topics.get((entry.source.node, entry.announced.to))

    async def close(self) -> None:
        """End it: everything was withdrawn and hidden before."""
        await self._headers.close()

    def subscribe(self, topic: ImportedTopic) -> None:
        """Subscribe to the key of a topic."""
        announced = topic.entry.announced
        key = announced.key()
        if (subscription := self._subscriptions.get(key)) is None:
            declared = self.context.session.subscribe(key, partial(self._sample, key), history=True)
            subscription = self._subscriptions[key] = _Subscription(declared)
        subscription.topics[announced.node] = topic
        if (known := subscription.latched.pop(announced.node, None)) is not None:
            topic.take(*known)

    def unsubscribe(self, topic: ImportedTopic) -> None:
        """Take that back, with the last topic of the key."""
        announced = topic.entry.announced
        subscription = self._subscriptions[announced.key()]
        del subscription.topics[announced.node]
        if not subscription.topics:
            self._subscriptions.pop(announced.key()).declared.close()

    def _sample(self, key: str, sample: ZenohSample) -> None:
        counters, subscription = self.context.counters, self._subscriptions.get(key)
        try:
            sequence, _, source = self._reader.read(sample.attachment)
        except RemoteProtocolError:
            counters.add("site.message.malformed")
            return
        if self.context.name in source.path:
            counters.add("site.message.looped")
        elif subscription is not None and source.node in subscription.topics:
            subscription.topics[source.node].take(sample.payload, sequence, source)
        elif subscription is not None:
            counters.add("site.message.unwanted_node")
            known = subscription.latched
            if source.latched and (source.node in known or len(known) < _LATCHED_NODES_MAX):
                others = sum(len(each[0]) for node, each in known.items() if node != source.node)
                if others + len(sample.payload) > _HELD_BYTES:
                    counters.add("site.message.unkept")
                else:
                    known[source.node] = sample.payload, sequence, source

    def _asked_header(self, query: ArrivedQuery) -> None:
        module, _, topic = query.key.removeprefix(f"{ROOT}/{self.context.name}/").partition("/d/t/")
        name = f"/{topic}"
        asked = dict(pair.partition("=")[::2] for pair in query.parameters.split(";"))
        node, site = asked.get("node", ""), asked.get("site", "")
        if refusal := self.context.rules.refusal(site, module, name):
            query.reply_error(f"{REFUSED}{refusal}")
            return
        topics = self._exported.get((module, name), {}).items()
        found = next((each for (its, to), each in topics if node in ("", its) and to in ("", site)), None)
        if found is None:
            query.reply_error(f"no such publisher of {name[:200]} at {module[:64]}")
        else:
            self._headers.take(query, found.answer_header)

    def _asked_definition(self, query: ArrivedQuery) -> None:
        module, _, md5 = query.key.removeprefix(f"{ROOT}/{self.context.name}/").partition("/d/m/")
        of_module = (nodes for (name, _), nodes in self._exported.items() if name == module)
        for about in (export.about for nodes in of_module for export in nodes.values()):
            if about is not None and about.md5sum == md5:
                query.reply(about.definition.encode(errors="surrogateescape"))
                return
        query.reply_error(f"no publisher with the md5 sum {md5[:40]} was connected yet")

"""One publisher of this site, for the other sites."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from rmpa.core.contract import Priority, Reliability
from rmpa.gateway import limits
from rmpa.gateway.sites.attachment import AttachmentWriter
from rmpa.gateway.sites.topic_header import TopicHeader
from rmpa.gateway.sites.topic_limits import TopicLimits
from rmpa.gateway.sites.topic_qos import qos_of
from rmpa.gateway.sites.traffic import SiteTraffic
from rmpa.runtime.tls import after_read

if TYPE_CHECKING:
    from rmpa.core.contract import Contract
    from rmpa.core.counters import Clock
    from rmpa.gateway.graph.own_graph import AgentGraph
    from rmpa.gateway.graph.taps import TopicTap
    from rmpa.gateway.sites.part import SiteExport
    from rmpa.gateway.zenoh.queries import ArrivedQuery
    from rmpa.gateway.zenoh.sending import QueuedPublisher
    from rmpa.gateway.zenoh.session import OpenSession
    from rmpa.ros.wire.tcpros import TopicDescription


class ExportedTopic:
    """Subscribes to one local publisher while other sites want it, and puts its messages to Zenoh.

    The Zenoh publisher is declared all the time, since it tells of demand. It is declared anew where its QoS changes:
    with a cache once the topic is known to be latched, and with a lower priority once its messages are large.

    Messages that come by one read are numbered, stamped and queued together.

    Args:
        entry: The source.
        graph: The gateway's graph.
        session: The Zenoh session.
        contract: The topic's contract.
        clock: Both clocks.
    """

    def __init__(
        self,
        entry: SiteExport,
        graph: AgentGraph,
        session: OpenSession,
        contract: Contract,
        clock: Clock,
    ) -> None:
        self.entry = entry
        self._graph = graph
        self._session = session
        self._contract = contract
        self._clock = clock
        self._run = max(1, clock.wall_ns())
        self._sequence = 0
        self._limits = TopicLimits(entry.rate, entry.size)
        self._limited = bool(self._limits)
        self._traffic = SiteTraffic(clock.now())
        self._sent_before = self._dropped_before = 0
        self._problem = ""
        self._tap: TopicTap | None = None
        self.description: TopicDescription | None = None
        """The publisher's last header; ``None`` before the first."""
        self._writer: AttachmentWriter | None = None
        self._collected: list[bytes] = []
        """The messages of the present read."""
        self.wanted = False
        """Whether another site subscribes."""
        self._linger: asyncio.TimerHandle | None = None
        self._queries: list[tuple[ArrivedQuery, asyncio.TimerHandle]] = []
        self._large = self._cached = False
        self._latched: bytes | None = None
        self._repeated = False
        self._held: bytes | None = None
        self._held_timer: asyncio.TimerHandle | None = None
        self._retired: list[QueuedPublisher] = []
        self._retire_timer: asyncio.TimerHandle | None = None
        self._publisher = self._declare()

    @property
    def dropped(self) -> int:
        """Messages that the queues to Zenoh dropped."""
        return self._dropped_before + sum(each.dropped for each in (self._publisher, *self._retired))

    def ask(self, query: ArrivedQuery) -> None:
        """Answer a question for the publisher's header, once it is connected."""
        if self._tap is not None and self._tap.description is not None:
            self._answer(query)
            return
        if len(self._queries) >= limits.HEADER_QUERIES_MAX:
            query.reply_error("too many questions for this publisher's header wait already")
            return
        timer = asyncio.get_running_loop().call_later(limits.HEADER_TIMEOUT * 0.8, self._give_up, query)
        self._queries.append((query, timer))
        self._judge()

    def report(self) -> dict[str, object]:
        """What ``rmpa site info`` shows of it, as JSON values."""
        self._traffic.read(self._clock.now())
        entry, traffic = self.entry, self._traffic
        return {
            "module": entry.source.module,
            "node": entry.source.node,
            "name": entry.source.name,
            "to": entry.announced.to,
            "type": entry.announced.type,
            "md5sum": self.description.md5sum if self.description is not None else "",
            "latching": self.description is not None and self.description.latching,
            "wanted": self.wanted,
            "messages": traffic.messages,
            "bytes": traffic.bytes,
            "rate": round(traffic.rate, 2),
            "bandwidth": round(traffic.bandwidth),
            "waiting": self._waiting(),
            "dropped": self.dropped,
            "limited": self._limits.dropped,
            "problem": self._problem,
        }

    @property
    def used(self) -> bool:
        """Whether there is anything to tell of it."""
        return self.wanted or bool(self._traffic.messages or self._problem or self._limits.dropped)

    def close(self) -> None:
        """Disconnect and undeclare; what waits for Zenoh is still sent for a moment."""
        self._stop_lingering()
        self._drop_held()
        for query, timer in self._queries:
            timer.cancel()
            query.reply_error(f"{self.entry.source.name} of {self.entry.source.module} is not offered any more")
        self._queries.clear()
        self._flush()
        self._close_tap()
        if self._retire_timer is not None:
            self._retire_timer.cancel()
            self._retire_timer = None
        for publisher in (self._publisher, *self._retired):
            publisher.close()

    # --- demand ---------------------------------------------------------------------------------------------------

    def _declare(self) -> QueuedPublisher:
        qos = qos_of(self._contract, latching=self._cached, large=self._large)
        return self._session.publisher(self.entry.announced.key(), qos, self._on_matching)

    def _declare_anew(self) -> None:
        """Declare with another QoS; the old one ends when nothing waits in it."""
        self._flush()
        self._retired.append(self._publisher)
        self._publisher = self._declare()
        self._close_retired()

    def _close_retired(self) -> None:
        if self._retire_timer is not None:
            self._retire_timer.cancel()
            self._retire_timer = None
        self._retired = [each for each in self._retired if not self._retire(each)]
        if self._retired:
            self._retire_timer = asyncio.get_running_loop().call_later(limits.IDLE_CHECK, self._close_retired)

    def _retire(self, publisher: QueuedPublisher) -> bool:
        """Close a publisher if nothing waits in it; return whether that was done."""
        if publisher.waiting:
            return False
        publisher.close()
        self._dropped_before += publisher.dropped
        return True

    def _on_matching(self, there: bool) -> None:
        self.wanted = there
        self._judge()

    def _judge(self) -> None:
        """Connect to the publisher, or disconnect after a while."""
        if self.wanted or self._queries:
            self._stop_lingering()
            if self._tap is None:
                self._tap = self._graph.tap(self.entry.source, self._on_message, self._on_described, self._on_lost)
                self._judge()
        elif self._tap is not None and self._linger is None:
            # A subscriber that is lost with its link is no different from one that has left. While the publisher
            # stays connected its messages are numbered, so that the subscriber counts them as lost when it is back.
            reliable = self._contract.reliability is Reliability.RELIABLE
            delay = max(limits.TAP_LINGER, self._contract.outage if reliable else 0.0)
            self._linger = asyncio.get_running_loop().call_later(delay, self._end_demand)

    def _stop_lingering(self) -> None:
        if self._linger is not None:
            self._linger.cancel()
            self._linger = None

    def _end_demand(self) -> None:
        self._linger = None
        self._close_tap()
        self._latched = None
        if self._cached:
            # What it keeps would be told to the next subscriber, although the publisher may have a newer message.
            self._cached = False
            self._declare_anew()

    def _close_tap(self) -> None:
        tap, self._tap = self._tap, None
        if tap is not None:
            tap.close()

    # --- the publisher --------------------------------------------------------------------------------------------

    def _on_described(self, description: TopicDescription) -> None:
        self._flush()
        self.description = description
        self._problem = ""
        announced = self.entry.announced
        try:
            self._writer = AttachmentWriter(
                description.md5sum,
                announced.node,
                (announced.module.site,),
                latched=description.latching,
                run=self._run,
            )
        except ValueError:
            self._writer = None
            self._problem = f"its publisher names the md5 sum {description.md5sum[:40]!r}"
            return
        if description.type != announced.type:
            self._problem = f"its publisher has the type {description.type}, the graph says {announced.type}"
        self._repeated = description.latching and self._latched is not None
        if description.latching != self._cached:
            self._cached = description.latching
            self._declare_anew()
        for query, timer in self._queries:
            timer.cancel()
            self._answer(query)
        self._queries.clear()
        if self._tap is not None:
            self._judge()

    def _on_lost(self, reason: str) -> None:
        self._problem = reason

    def _on_message(self, body: memoryview) -> None:
        if self._writer is None:
            return
        size = len(body)
        message: bytes | memoryview = body
        if self._cached:
            message = bytes(body)
            repeated, self._repeated = self._repeated and message == self._latched, False
            if repeated:
                return  # the publisher was connected anew, and gave its last message again
            self._latched = message
        if self._limited and not self._limits.admit(self._clock.now(), size):
            self._limit(message)
            return
        if self._held is not None:
            self._drop_held()
        self._send(message)

    def _send(self, message: bytes | memoryview) -> None:
        if len(message) >= limits.LARGE_MESSAGE and not self._large:
            self._large = True
            if self._contract.priority is Priority.NORMAL:
                self._declare_anew()
        collected = self._collected
        collected.append(bytes(message))
        if len(collected) == 1:
            after_read(self._flush)
        elif len(collected) >= limits.COLLECTED_MESSAGES:
            self._flush()

    def _flush(self) -> None:
        """Queue what has come by the present read."""
        messages, self._collected = self._collected, []
        if messages and self._writer is not None:
            first, stamp, write = self._sequence + 1, self._clock.wall_ns(), self._writer.write
            self._sequence += len(messages)
            self._traffic.add(sum(map(len, messages)), len(messages))
            self._publisher.put_all([(each, write(number, stamp)) for number, each in enumerate(messages, first)])

    # --- the limits of a rule -------------------------------------------------------------------------------------

    def _limit(self, message: bytes | memoryview) -> None:
        """Keep a message back; the last one of a latched topic is sent as soon as the limits let it."""
        self._limits.dropped += 1
        if isinstance(message, bytes) and self._cached:
            self._drop_held()
            self._held = message
            due = self._limits.next(self._clock.now(), len(message))
            self._held_timer = asyncio.get_running_loop().call_at(due, self._send_held)

    def _send_held(self) -> None:
        message = self._held
        self._drop_held()
        if message is None:
            return
        if self._limits.admit(self._clock.now() + 0.001, len(message)):
            self._limits.dropped -= 1
            self._send(message)

    def _drop_held(self) -> None:
        self._held = None
        if self._held_timer is not None:
            self._held_timer.cancel()
            self._held_timer = None

    # --- questions for the header ---------------------------------------------------------------------------------

    def _answer(self, query: ArrivedQuery) -> None:
        if self.description is None or self._writer is None:
            query.reply_error(self._problem or "the publisher's header is not known")
            return
        header = TopicHeader(
            self.description,
            self.entry.announced.node,
            self._run,
            self._sequence,
            self._waiting(),
        )
        query.reply(query.key, header.serialize())
        query.finish()

    def _give_up(self, query: ArrivedQuery) -> None:
        self._queries = [each for each in self._queries if each[0] is not query]
        source = self.entry.source
        query.reply_error(
            f"{source.node} of {source.module} does not answer: {self._problem or 'no connection to it yet'}"
        )
        self._judge()

    def _waiting(self) -> int:
        return sum(each.waiting for each in (self._publisher, *self._retired))

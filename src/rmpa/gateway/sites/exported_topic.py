"""One publisher of this site for the other sites: QoS, header, numbers, limits of rate and size.

One publisher of this site, for the other sites.
"""

from __future__ import annotations

import asyncio
import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.core.contract import Priority, Reliability
from rmpa.core.counters import TokenBucket
from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.identity import is_type_name
from rmpa.gateway import limits
from rmpa.gateway.neighbour import ZenohPriority, ZenohQos
from rmpa.gateway.sites.catalogue import SiteTraffic
from rmpa.gateway.sites.keys import AttachmentWriter
from rmpa.ros.wire.tcpros import TopicDescription
from rmpa.runtime.tls import after_read

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from rmpa.core.contract import Contract
    from rmpa.gateway.foreign import TopicTap
    from rmpa.gateway.own_graph import AgentGraph
    from rmpa.gateway.sites.plans import SiteExport
    from rmpa.gateway.zenoh.config import ArrivedQuery
    from rmpa.gateway.zenoh.session import OpenSession
    from rmpa.gateway.zenoh.threads import QueuedPublisher
    from rmpa.ros.wire.tcpros import Buffer
    from rmpa.runtime.loop import SystemClock


# The limits of rate and size of one topic that goes out: a thin link is protected at its near end. Sans-I/O.


class TopicLimits:
    """Admits the messages of one topic within its limits.

    Args:
        rate: Messages a second; ``None``: no limit.
        size: Bytes a second; ``None``: no limit. A message that is larger than ``limits.LIMIT_BURST`` seconds of it
            passes after a rest, and later ones wait until it is paid off.
    """

    def __init__(self, rate: float | None, size: int | None) -> None:
        self._rate = None if rate is None else TokenBucket(rate, max(1.0, rate * limits.LIMIT_BURST))
        self._size = None if size is None else TokenBucket(size, max(1.0, size * limits.LIMIT_BURST))
        self.dropped = 0
        """Messages that the limits kept back; the caller counts them here."""

    def __bool__(self) -> bool:
        """Whether there is a limit."""
        return self._rate is not None or self._size is not None

    def admit(self, now: float, size: int) -> bool:
        """Whether a message of ``size`` bytes may cross at ``now`` (monotonic seconds)."""
        if all(bucket.has(now, amount) for bucket, amount in self._buckets(size)):
            for bucket, amount in self._buckets(size):
                bucket.spend(amount)
            return True
        return False

    def next(self, now: float, size: int) -> float:
        """When a message of this size may cross, if no other does before; not before ``now``."""
        return max((bucket.next(now, amount) for bucket, amount in self._buckets(size)), default=now)

    def _buckets(self, size: int) -> Iterator[tuple[TokenBucket, int]]:
        if self._rate is not None:
            yield self._rate, 1
        if self._size is not None:
            yield self._size, size


# From a topic's contract to Zenoh's QoS (docs/design/gateway.md, "Contracts"): a pure table.


def qos_of(contract: Contract, *, latching: bool = False, large: bool = False) -> ZenohQos:
    """The QoS of one topic's publisher.

    A thread waits for Zenoh; what exceeds the queue before it is dropped there and counted. None has the congestion
    control ``BLOCK``: it ends the link behind which a message waits for seconds, as each large one does on a thin
    link. With ``DROP`` a message waits likewise (``zenoh.limits.DROP_WAIT``), and the link stays; the receiver counts
    what is lost there by its number.

    Args:
        contract: The topic's.
        latching: Whether a late subscriber gets the last message.
        large: Whether its messages are large: they yield to others unless the contract has a priority.
    """
    if contract.priority is Priority.HIGH:
        priority = ZenohPriority.REAL_TIME
    elif contract.priority is Priority.LOW or large:
        priority = ZenohPriority.DATA_LOW
    else:
        priority = ZenohPriority.DATA
    return ZenohQos(
        reliable=True,
        block=False,
        priority=priority,
        messages=contract.depth,
        bytes=limits.RELIABLE_BYTES if contract.reliability is Reliability.RELIABLE else limits.BEST_EFFORT_BYTES,
        cache=1 if latching else 0,
    )


# The answer of a gateway to the question for a publisher's header (``…/d/t/<topic>``): JSON.
#
# ::
#
#     {"type": "std_msgs/String", "md5sum": "992ce8a1687cec8c8bd883ec73ca41d1", "latching": false,
#      "definition": "string data\n", "node": "/talker", "run": 17, "sequence": 42, "waiting": 0}
#
# The question's parameters are ``node`` (one publisher of several; without it any) and ``site`` (the site that
# asks).


REFUSED: Final = "refused: "
"""What an error begins with that a rule causes: asking again is of no use."""
_HEX: Final = frozenset("0123456789abcdef")
_COUNT_MAX: Final = 2**63 - 1


@dataclass(frozen=True, slots=True)
class TopicHeader:
    """What a gateway says of one publisher of its site.

    Args:
        description: The publisher's own header.
        node: The publisher, in its module.
        run: The run of its exporter, by which sequence numbers are told apart.
        sequence: The number of the last message that was taken for the other sites.
        waiting: Messages that wait there for a slow link.
    """

    description: TopicDescription
    node: str
    run: int = 0
    sequence: int = 0
    waiting: int = 0

    def serialize(self) -> bytes:
        """The JSON of it."""
        fields = asdict(self)
        return json.dumps({**fields.pop("description"), **fields}).encode()

    @classmethod
    def parse(cls, data: Buffer) -> TopicHeader:
        """Read an answer; unknown keys are ignored.

        Raises:
            RemoteProtocolError: It is too long, no JSON object, or type, md5 sum or a number is none.
        """
        if len(data) > limits.HEADER_MAX:
            raise LimitExceeded("the header of a publisher at another site", len(data), limits.HEADER_MAX)
        try:
            fields = msgspec.json.decode(data)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise RemoteProtocolError(f"the header of a publisher at another site is no JSON: {error}") from error
        if not isinstance(fields, dict):
            raise RemoteProtocolError("the header of a publisher at another site is no JSON object")
        type_name, md5sum, definition, node = (_text(fields, key) for key in ("type", "md5sum", "definition", "node"))
        if not is_type_name(type_name):
            raise RemoteProtocolError(f"another site names the type {type_name[:80]!r}")
        if len(md5sum) != 32 or not _HEX.issuperset(md5sum):
            raise RemoteProtocolError(f"another site names the md5 sum {md5sum[:80]!r}")
        numbers = {key: _number(fields, key) for key in ("run", "sequence", "waiting")}
        description = TopicDescription(type_name, md5sum, definition, fields.get("latching") is True)
        return cls(description, node, **numbers)


def _text(fields: Mapping[str, object], key: str) -> str:
    value = fields.get(key, "")
    if not isinstance(value, str):
        raise RemoteProtocolError(f"the header of a publisher at another site has a {key} that is no text")
    return value


def _number(fields: Mapping[str, object], key: str) -> int:
    value = fields.get(key, 0)
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= _COUNT_MAX:
        raise RemoteProtocolError(f"the header of a publisher at another site has a {key} that is no count")
    return value


# Counts the messages of one source of another site that were lost, by their sequence numbers. Sans-I/O.


class SequenceCounter:
    """Follows the sequence numbers of one source, which count from 1 in each run of its exporter.

    A latched message that comes once more (from a cache) has a number that is known.
    """

    def __init__(self) -> None:
        self._run: int | None = None
        self._last = 0
        self._announced = 0
        self._expects_first = False
        self._gaps = 0

    @property
    def lost(self) -> int:
        """Messages that were sent and have not come; those on their way count too until they come."""
        return self._gaps + max(0, self._announced - self._last)

    def take(self, run: int, sequence: int) -> bool:
        """Count a message that came.

        Args:
            run: The exporter's run.
            sequence: Its number.

        Returns:
            Whether it is new; else it is to be dropped.
        """
        if run != self._run:
            self._settle()
            self._run, self._announced = run, sequence
        elif self._expects_first:
            self._gaps += max(0, sequence - self._last - 1)
        elif sequence <= self._last:
            return False
        else:
            self._gaps += sequence - self._last - 1
        self._last, self._expects_first = sequence, False
        return True

    def announced(self, run: int, sequence: int) -> None:
        """The exporter says how many messages it has sent; if none has come yet, what it sends later is expected."""
        if self._run is None:
            self._run, self._last, self._announced, self._expects_first = run, sequence, sequence, True
        elif run == self._run:
            self._announced = max(self._announced, sequence)

    def restart(self) -> None:
        """Nothing is subscribed any more: the next message begins anew, without a loss."""
        self._settle()
        self._run, self._last, self._announced, self._expects_first = None, 0, 0, False

    def _settle(self) -> None:
        self._gaps = self.lost
        self._announced = self._last


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
        clock: SystemClock,
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

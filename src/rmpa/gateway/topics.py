"""One publisher of this mesh for a neighbour: demand, limits, numbers. Sites and ROS 2 have forms of their own."""

from __future__ import annotations

import asyncio
import time
from abc import ABC, abstractmethod
from functools import partial
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RmpaError
from rmpa.core.timers import TokenBucket
from rmpa.gateway import limits
from rmpa.observe.check import OK, WARN, Check
from rmpa.runtime.loop import Delay
from rmpa.runtime.stream import after_read

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from rmpa.gateway.own_graph import AgentGraph, TopicTap
    from rmpa.gateway.ros2.graph import Publishing, Ros2Link
    from rmpa.gateway.rules import MeshSource
    from rmpa.gateway.zenoh.threads import ZenohQos
    from rmpa.ros.wire.tcpros import TopicDescription

# Queries that wait for the header of one publisher; further ones are refused at once.
_HEADER_QUERIES_MAX: Final = 64
# Seconds of a topic's limit of rate or size that may cross at once after a rest: jitter must not cost messages.
_LIMIT_BURST: Final = 0.5
# Messages of one read that are collected before they are queued for other sites; the read may go on for longer.
_COLLECTED_MESSAGES: Final = 256

# Seconds by which a timer may be early.
_BOUNDARY = 0.001


def flow(stage: str, text: str, messages: int, losses: Iterable[tuple[int, str]], remedy: str = "") -> Check:
    """The stage of ``rmpa why`` for messages that have crossed, with losses: how many, and the words for them."""
    lost = [f"{count} {words}" for count, words in losses if count]
    return Check(stage, OK if messages and not lost else WARN, "; ".join((text, *lost)), remedy if lost else "")


class TopicLimits:
    """Admits the messages of one topic within its limits: a thin link is protected at its near end.

    Args:
        rate: Messages a second; ``None``: no limit.
        size: Bytes a second; ``None``: no limit. A message that is larger than ``_LIMIT_BURST`` seconds of it
            passes after a rest, and later ones wait until it is paid off.
    """

    def __init__(self, rate: float | None, size: int | None) -> None:
        self._rate, self._size = (
            None if each is None else TokenBucket(each, max(1.0, each * _LIMIT_BURST)) for each in (rate, size)
        )

    @classmethod
    def of(cls, rate: float | None, size: int | None) -> TopicLimits | None:
        """The limits; ``None``: there is none."""
        return None if rate is None and size is None else cls(rate, size)

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


class ExportedTopic(ABC):
    """Subscribes to one local publisher while there is demand, and puts its messages to a neighbour, in its form.

    Zenoh's publisher is declared all the time, since it tells of demand. It is declared anew where its key or QoS
    changes: with another type, with a cache once the topic is known to be latched, and with a lower priority once its
    messages are large. What waits in the old one is still sent for a second. Messages that come by one read are
    numbered, stamped and queued together.

    Args:
        source: The topic.
        graph: The gateway's graph.
        session: The session of the neighbour.
        rate: Messages a second that cross at most; ``None``: no limit.
        size: Bytes a second that cross at most; ``None``: no limit.

    Attributes:
        payload: Makes the neighbour's form of a message; ``None``: it has none, and is left out.
        attachment: Makes what goes with a message, of its number from 1, and of when it came, in nanoseconds since
            1970.
        about: The publisher's last header; ``None`` before the first.
        wanted: Whether the neighbour subscribes.
        problem: Why its messages do not cross; empty for nothing.
        messages: Messages that were taken for the neighbour: the number of the last one.
        limited: Messages that a limit has kept back.
    """

    # More than twelve fields: the demand, the publishers here and there, and the counts change each other.

    def __init__(
        self, source: MeshSource, graph: AgentGraph, session: Ros2Link, rate: float | None, size: int | None
    ) -> None:
        self.source: Final = source
        self.payload: Callable[[memoryview], bytes | None] = bytes
        self.attachment: Callable[[int, int], bytes] = lambda _sequence, _stamp: b""
        self._graph = graph
        self._session = session
        self._limits = TopicLimits.of(rate, size)
        self.about: TopicDescription | None = None
        self.wanted = False
        self.problem = ""
        self.messages = 0
        self.limited = 0
        self._failed = self._was_wanted = self._large = self._latched = self._repeated = False
        self._dropped_before = 0
        self._terms: tuple[str, ZenohQos] | None = None
        self._publisher: Publishing | None = None
        self._tap: TopicTap | None = None
        self._opening = self._closed = False
        self._linger = Delay()
        # Questions for the header that wait, and whether it has come by the present connection.
        self._asking = 0
        self._header_came = asyncio.Event()
        # The messages of the present read.
        self._collected: list[bytes] = []
        # The last message of a latched topic.
        self._last: bytes | None = None
        # When that is sent, which a limit holds back.
        self._held = Delay()

    @abstractmethod
    def announce(self, about: TopicDescription | None, *, latched: bool, large: bool) -> tuple[str, ZenohQos] | None:
        """Announce it; return the key and the QoS to publish by; ``None``: the header has to be known first.

        Args:
            about: The publisher's header; ``None`` while it is not known.
            latched: Whether a late subscriber is to get its last message.
            large: Whether its messages are large.

        Raises:
            RmpaError: It cannot cross; the text says why.
        """

    @abstractmethod
    def linger(self, *, keeps: bool) -> float | None:
        """Seconds for which its publisher stays connected without demand; ``None``: for good.

        Args:
            keeps: Whether its last message is kept for late subscribers, of which one has come.
        """

    def say(self, problem: str) -> None:
        """Why its messages do not cross has changed; empty for nothing."""
        self.problem = problem

    @property
    def announced(self) -> bool:
        """Whether the neighbour sees it."""
        return self._terms is not None

    @property
    def dropped(self) -> int:
        """Messages that the queue to Zenoh dropped."""
        return self._dropped_before + (self._publisher.dropped if self._publisher is not None else 0)

    @property
    def waiting(self) -> int:
        """Messages in the queue to Zenoh."""
        return self._publisher.waiting if self._publisher is not None else 0

    def start(self) -> None:
        """Announce it, or ask its publisher for its header first; again, if it is not announced yet."""
        if not self._closed and self._terms is None:
            self._announce()
            self._judge()

    async def header(self, within: float) -> TopicDescription:
        """The publisher's header; it is connected for that.

        Args:
            within: Seconds.

        Raises:
            RmpaError: It does not answer in that time, or cannot cross.
        """
        if self._tap is None or self._tap.description is None:
            if self._closed or self._asking >= _HEADER_QUERIES_MAX:
                raise RmpaError("too many questions for this publisher's header wait already, or it has gone")
            self._asking += 1
            self._judge()
            try:
                async with asyncio.timeout(within):
                    await self._header_came.wait()
            except TimeoutError:
                why = self.problem or "no connection to it yet"
                raise RmpaError(f"{self.source.node} of {self.source.module} does not answer: {why}") from None
            finally:
                self._asking -= 1
                self._judge()
            if self._closed:
                raise RmpaError(f"{self.source.name} of {self.source.module} is not offered any more")
        if self.about is None or self._failed:
            raise RmpaError(self.problem or "the publisher's header is not known")
        return self.about

    def close(self) -> None:
        """Take everything back; what waits for Zenoh is still sent for a moment."""
        self._closed = True
        self._linger.cancel()
        self._held.cancel()
        self._header_came.set()
        self._flush()
        self._disconnect()
        if self._publisher is not None:
            self._publisher.close()
        self.say("")

    def _announce(self) -> None:
        """Declare the publisher that the facts ask for."""
        try:
            terms = self.announce(self.about, latched=self._latched, large=self._large)
            self._failed = False
        except RmpaError as error:
            terms, self._failed = None, True
            self.say(str(error))
        if terms == self._terms:
            return
        self._flush()
        self._terms, old = terms, self._publisher
        self._publisher = None
        if terms is None:
            self.wanted = False
        else:
            self._publisher = self._session.publisher(*terms, partial(self._matching, terms))
        if old is not None:
            self._dropped_before += old.dropped
            old.close()

    def _matching(self, terms: tuple[str, ZenohQos], there: bool) -> None:
        if terms == self._terms and not self._closed:  # else it is of an earlier publisher
            self.wanted = there
            if there and not self._was_wanted:
                self._was_wanted = True
                if self._last is not None:
                    self._admit(self._last)
            self._judge()

    def _judge(self) -> None:
        """Connect to the publisher, or disconnect after a while."""
        if self._closed:
            return
        if self.wanted or self._asking or (self._terms is None and not self._failed):
            self._linger.cancel()
            if self._tap is None and not self._opening:
                self._opening = True
                self._tap = self._graph.tap(self.source, self._message, self._described, self._lost)
                self._opening = False
                self._judge()
        elif self._tap is not None and not self._linger:
            delay = self.linger(keeps=self._latched and self._was_wanted)
            if delay is not None:
                self._linger.set(delay, self._end_demand)

    def _end_demand(self) -> None:
        self._disconnect()
        # What it keeps would be told to the next subscriber, although the publisher may have a newer message.
        self._last, self._latched, self._was_wanted = None, False, False
        self._announce()

    def _disconnect(self) -> None:
        tap, self._tap = self._tap, None
        self._header_came.clear()
        if tap is not None:
            tap.close()

    def _described(self, about: TopicDescription) -> None:
        self._flush()
        self.about = about
        differs = f"its publisher has the type {about.type}, the graph says {self.source.type}"
        self.say(differs if about.type != self.source.type else "")
        self._latched = about.latching
        self._repeated = about.latching and self._last is not None
        self._announce()
        self._header_came.set()
        self._judge()

    def _lost(self, reason: str) -> None:
        self.problem = reason
        self._header_came.clear()

    def _message(self, body: memoryview) -> None:
        if self._failed or (payload := self.payload(body)) is None:
            return
        if self._latched:
            repeated, self._repeated = self._repeated and payload == self._last, False
            if repeated:
                return  # the publisher was connected anew, and gave its last message again
            self._last = payload
        if self._was_wanted:
            self._admit(payload)  # else its publisher was only asked for its header: a cache must not keep that

    def _admit(self, payload: bytes) -> None:
        """Send a message as soon as the limits let it, or leave it out."""
        if self._limits is not None:
            now = time.monotonic()
            if not self._limits.admit(now, len(payload)):
                self.limited += 1
                if self._latched:  # the last one is sent as soon as the limits let it
                    delay = self._limits.next(now, len(payload)) - now
                    self._held.set(delay, partial(self._send_last, payload))
                return
            self._held.cancel()
        self._send(payload)

    def _send_last(self, payload: bytes) -> None:
        if self._limits is not None and self._limits.admit(time.monotonic() + _BOUNDARY, len(payload)):
            self.limited -= 1
            self._send(payload)

    def _send(self, payload: bytes) -> None:
        if len(payload) >= limits.LARGE_MESSAGE and not self._large:
            self._large = True
            self._announce()
        collected = self._collected
        collected.append(payload)
        if len(collected) == 1:
            after_read(self._flush)
        elif len(collected) >= _COLLECTED_MESSAGES:
            self._flush()

    def _flush(self) -> None:
        """Queue what has come by the present read."""
        payloads, self._collected = self._collected, []
        if payloads and self._publisher is not None:
            first, stamp, attachment = self.messages + 1, time.time_ns(), self.attachment
            self.messages += len(payloads)
            self._publisher.put_all(
                [(each, attachment(number, stamp)) for number, each in enumerate(payloads, first)]
            )

"""One publisher of another site, in the gateway's graph."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway import limits
from rmpa.gateway.sites.keys import ROOT
from rmpa.gateway.sites.sequence import SequenceCounter
from rmpa.gateway.sites.topic_header import REFUSED, TopicHeader
from rmpa.gateway.sites.traffic import SiteTraffic
from rmpa.gateway.zenoh_api import ZenohPriority
from rmpa.ros.wire.tcpros import printable

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.core.counters import Clock
    from rmpa.gateway.graph.own_graph import AgentGraph
    from rmpa.gateway.sites.attachment import MessageSource
    from rmpa.gateway.sites.part import SiteImport
    from rmpa.gateway.zenoh.session import OpenSession
    from rmpa.ros.wire.tcpros import TopicDescription

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
        clock: Clock,
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

"""What the recorder takes of the graph: subscriptions to this module's own nodes, within the budget of each topic.

Publishers of other modules are not connected to: each module records its own nodes, and nothing crosses the network.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RmpaError
from rmpa.core.identity import is_own, matches_any
from rmpa.core.timers import TokenBucket
from rmpa.record import limits
from rmpa.record.format import STATIC, RecordedSource
from rmpa.ros.http.rpc import call_api

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from rmpa.config.settings import RecordSettings
    from rmpa.core.facts import TopicInfo
    from rmpa.ros.node.endpoints import Subscriber
    from rmpa.ros.node.node import Node

_log = logging.getLogger(__name__)
# Seconds of its budget that a topic may write at once.
_BURST: Final = 2.0


class _Taken:
    """One topic that is recorded."""

    def __init__(self, settings: RecordSettings, total: TokenBucket | None) -> None:
        self._settings = settings
        self.uris: set[str] = set()
        self.subscriber: Subscriber | None = None
        self._budgets = [one for one in (_bucket(settings.topic_rate), total) if one is not None]
        # By the publisher's header: its source, and the bucket of its type's messages.
        self._known: dict[int, tuple[Mapping[str, str], RecordedSource, TokenBucket | None]] = {}

    def source(self, topic: str, header: Mapping[str, str]) -> tuple[RecordedSource, TokenBucket | None]:
        """The source of a connection, and the bucket that thins its messages."""
        known = self._known.get(id(header))
        if known is not None and known[0] is header:
            return known[1:]
        kind, md5, text, node = (header.get(key, "") for key in ("type", "md5sum", "message_definition", "callerid"))
        source = RecordedSource(topic, kind, md5, text, node, header.get("latching") == "1")
        thin, bucket = self._settings.thin, None
        if thin is not None and matches_any(self._settings.thin_types, kind):
            bucket = TokenBucket(thin, max(1.0, thin / 2))
        self._known[id(header)] = header, source, bucket
        return source, bucket

    def room(self, size: int, thin: TokenBucket | None, now: float) -> bool:
        """Whether a message is within the topic's budget and that of all; if so, it is taken off."""
        if not all(one.has(now, size) for one in self._budgets) or (thin is not None and not thin.take(now)):
            return False
        for one in self._budgets:
            one.spend(size)
        return True


def _bucket(rate: int | None) -> TokenBucket | None:
    return TokenBucket(rate, _BURST * rate) if rate else None


class Capture:
    """The topics that are recorded.

    Args:
        node: The recorder's node.
        settings: Which topics, and how much of each.
        put: Takes a message: ``(source, log time, publish time, bytes)``.
        listeners: Called with ``(source, bytes)`` of each message of a type, by that type, before its budget counts.
        everything: Record what nodes of other modules publish, too.
    """

    def __init__(
        self,
        node: Node,
        settings: RecordSettings,
        put: Callable[[RecordedSource, int, int, bytes], bool],
        listeners: Mapping[str, Callable[[RecordedSource, bytes], None]],
        *,
        everything: bool = False,
    ) -> None:
        self._node = node
        self._settings = settings
        self._put = put
        self._listeners = listeners
        self._everything = everything
        self._total = _bucket(settings.total_rate)
        self._taken: dict[str, _Taken] = {}
        # The last message of each source that latches: repeated in each segment.
        self.latched: dict[RecordedSource, tuple[int, bytes]] = {}
        # Messages that were left out for the budget of their topics.
        self.left_out: Counter[str] = Counter()
        # Messages and bytes that were taken so far, by topic.
        self.count: Counter[str] = Counter()
        self.bytes: Counter[str] = Counter()

    def wanted(self, topic: str) -> bool:
        """Whether a topic is to be recorded."""
        return matches_any(self._settings.topics, topic) and not matches_any(self._settings.deny, topic)

    async def update(self, topics: Iterable[TopicInfo]) -> None:
        """Subscribe to what is there now, and end what is gone."""
        published = {
            topic.name: topic.publishers
            for topic in topics
            if (topic.publishers or self._everything) and self.wanted(topic.name)
        }
        for name in self._taken.keys() - published.keys():
            gone = self._taken.pop(name)
            self.latched = {source: last for source, last in self.latched.items() if source.topic != name}
            if gone.subscriber is not None:
                await gone.subscriber.close()
        for name, publishers in published.items():
            taken = self._taken.setdefault(name, _Taken(self._settings, self._total))
            uris = {uri for node in publishers if not is_own(node) and (uri := await self._uri(node))}
            fresh, taken.uris = uris - taken.uris, uris
            if taken.subscriber is None:
                await self._subscribe(name, taken)
            elif fresh:
                await taken.subscriber.register()  # the master's list may have had them before their names were known
            self._forget(name, publishers)

    async def _subscribe(self, name: str, taken: _Taken) -> None:
        def received(data: memoryview, header: Mapping[str, str]) -> None:
            self._take(name, taken, data, header)

        def accepts(uri: str) -> bool:
            return self._everything or uri in taken.uris

        try:
            taken.subscriber = await self._node.subscribe(name, on_bytes=received, own=False, accepts=accepts)
        except RmpaError as error:
            _log.debug("! %s is not recorded yet: %s", name, error)

    async def _uri(self, node: str) -> str:
        try:
            reply = await call_api(self._node.master_uri, "lookupNode", self._node.name, node)
        except RmpaError:
            return ""
        return str(reply.value) if reply.code == 1 else ""

    def _forget(self, topic: str, publishers: tuple[str, ...]) -> None:
        """Do not repeat what publishers that are gone have latched."""
        if not self._everything:
            gone = [one for one in self.latched if one.topic == topic and one.node not in publishers]
            for source in gone:
                del self.latched[source]

    def _take(self, topic: str, taken: _Taken, data: memoryview, header: Mapping[str, str]) -> None:
        source, thin = taken.source(topic, header)
        raw = bytes(data)
        if (listener := self._listeners.get(source.type)) is not None:
            listener(source, raw)
        latches = source.latching or topic == STATIC
        if not taken.room(len(raw), None if latches else thin, time.monotonic()):
            self.left_out[topic] += 1
            return
        now = time.time_ns()
        if self._put(source, now, now, raw):
            self.count[topic] += 1
            self.bytes[topic] += len(raw)
            if latches and len(raw) <= limits.LATCHED_MAX:
                self.latched[source] = now, raw

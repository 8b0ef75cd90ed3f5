"""The subscription to one topic of one module at another site, which its publishers share."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from rmpa.gateway import limits

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.gateway.sites.attachment import MessageSource
    from rmpa.gateway.sites.io.imported_topic import ImportedTopic
    from rmpa.gateway.sites.keys import SiteSource
    from rmpa.gateway.zenoh_api import Declared, ZenohSample, ZenohSession


class TopicSubscription:
    """Subscribes to single messages, and to batches instead once the other gateway has them.

    Both have all messages. Single ones are subscribed to until batches have come for a while: no message is lost,
    also if a router lets no batches through.

    Args:
        session: The Zenoh session.
        source: One of the topic's publishers.
        on_sample: ``(sample)``: a message or a batch.
    """

    def __init__(self, session: ZenohSession, source: SiteSource, on_sample: Callable[[ZenohSample], None]) -> None:
        self._session = session
        self._source = source
        self._on_sample = on_sample
        self.topics: dict[str, ImportedTopic] = {}
        """By node."""
        self.latched: dict[str, tuple[bytes, int, int, MessageSource]] = {}
        """The last latched message of nodes that are not wanted: they were told once, and would not be again."""
        self._singles: Declared | None = session.subscribe(source.key(), on_sample, history=True)
        self._batches: Declared | None = None
        self._came: set[str] = set()
        """The nodes of which a batch has come."""
        self._settling: asyncio.TimerHandle | None = None

    def use_batches(self) -> None:
        """Subscribe to batches too; single messages end once they come."""
        if self._batches is None:
            self._batches = self._session.subscribe(
                self._source.batch_key(), self._on_sample, beside=self._singles, batches=True
            )

    def use_singles(self) -> None:
        """Subscribe to single messages alone: the other gateway has no batches, or is another one."""
        if self._singles is None:
            self._singles = self._session.subscribe(
                self._source.key(), self._on_sample, history=True, beside=self._batches
            )
        self._end_batches()

    def batch_came(self, node: str) -> None:
        """Note that a batch of this node has come."""
        if self._batches is None:
            return
        self._came.add(node)
        if self._singles is not None and self._settling is None:
            self._settling = asyncio.get_running_loop().call_later(limits.BATCH_SETTLE, self._end_singles)

    def is_repeated(self, node: str) -> bool:
        """Whether single messages of this node come in batches too, before."""
        return node in self._came

    def close(self) -> None:
        """Subscribe to nothing."""
        self._end_batches()
        self._end_singles()

    def _end_singles(self) -> None:
        self._settling = None
        singles, self._singles = self._singles, None
        if singles is not None:
            singles.close()

    def _end_batches(self) -> None:
        self._came.clear()
        if self._settling is not None:
            self._settling.cancel()
            self._settling = None
        batches, self._batches = self._batches, None
        if batches is not None:
            batches.close()

"""Zenoh in memory: sessions of one network, for tests of what speaks through ``OpenSession``."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from rmpa.gateway.zenoh.threads import ZenohQos, ZenohSample
from rmpa.ros.wire.tcpros import Buffer


async def eventually(condition: Callable[[], object], seconds: float = 20.0) -> None:
    """Wait until ``condition()`` is true; raises ``TimeoutError`` after ``seconds``."""
    async with asyncio.timeout(seconds):
        while not condition():
            await asyncio.sleep(0.005)


def fits(one: str, other: str) -> bool:
    """Whether two key expressions with ``*`` and ``**`` intersect."""
    return _fit(one.split("/"), other.split("/"))


def _fit(one: list[str], other: list[str]) -> bool:
    if not one or not other:
        return all(chunk == "**" for chunk in (*one, *other))
    if one[0] == "**":
        return _fit(one[1:], other) or _fit(one, other[1:])
    if other[0] == "**":
        return _fit(other, one)
    return (one[0] == other[0] or "*" in (one[0], other[0])) and _fit(one[1:], other[1:])


@dataclass(eq=False)
class Entry:
    """What one session has declared under a key, until it is closed."""

    session: MemorySession
    table: list[Any]
    key: str
    callback: Callable[..., object] = lambda: None
    closed: Callable[[], None] = lambda: None

    def __post_init__(self) -> None:
        self.table.append(self)

    def call(self, *args: Any) -> None:
        """Call back in the event loop, unless it was closed before."""
        loop = asyncio.get_running_loop()
        loop.call_soon(lambda: self.callback(*args) if self in self.table else None)

    def close(self) -> None:
        if self in self.table:
            self.table.remove(self)
            self.closed()


@dataclass(eq=False)
class MemoryPublisher(Entry):
    """A publisher that delivers at once."""

    cache: int = field(default=0, kw_only=True)
    cached: list[ZenohSample] = field(default_factory=list)
    matched: bool | None = None
    sent: int = 0
    dropped = waiting = 0

    def put(self, payload: Buffer, attachment: bytes = b"") -> None:
        self.sent += 1
        sample = ZenohSample(bytes(payload), attachment)
        self.cached = [*self.cached, sample][-self.cache :] if self.cache else []
        for each in self.session.network.subscribers:
            if fits(each.key, self.key):
                each.call(sample)

    def put_all(self, messages: Sequence[tuple[bytes, bytes]]) -> None:
        for message in messages:
            self.put(*message)


@dataclass
class MemoryQuery:
    """One query, with the answers that were given."""

    key: str
    payload: bytes
    attachment: bytes
    parameters: str
    done: asyncio.Event = field(default_factory=asyncio.Event)
    replies: list[ZenohSample] = field(default_factory=list)

    def reply(self, payload: Buffer, attachment: bytes = b"") -> None:
        self.replies.append(ZenohSample(bytes(payload), attachment))
        self.finish()

    def answer(self, payload: Buffer) -> None:
        """Answer with the attachment of the query."""
        self.reply(payload, self.attachment)

    def reply_error(self, text: str) -> None:
        self.replies.append(ZenohSample(text.encode(), ok=False))
        self.finish()

    def finish(self) -> None:
        self.done.set()


class MemoryZenoh:
    """One network of sessions."""

    def __init__(self) -> None:
        self.publishers: list[MemoryPublisher] = []
        self.subscribers: list[Entry] = []
        self.queryables: list[Entry] = []
        self.tokens: list[Entry] = []
        self.watches: list[Entry] = []
        self._numbers = itertools.count(1)

    def session(self) -> MemorySession:
        """Open one more session."""
        return MemorySession(self, f"{next(self._numbers):032x}")

    @property
    def token_keys(self) -> list[str]:
        """The tokens that are declared."""
        return sorted(entry.key for entry in self.tokens)

    def match(self) -> None:
        """Tell each publisher whether there is a subscriber."""
        for entry in self.publishers:
            matched = any(fits(each.key, entry.key) for each in self.subscribers)
            if entry.matched is not matched:
                entry.matched = matched
                entry.call(matched)

    def tell(self, key: str, alive: bool) -> None:
        """Tell of a token."""
        for each in self.watches:
            if fits(each.key, key):
                each.call(key, alive)


class MemorySession:
    """One session; ``close`` ends it as the end of its process would."""

    endpoints: tuple[str, ...] = ("tcp/192.0.2.1:7447",)

    def __init__(self, network: MemoryZenoh, zid: str) -> None:
        self.network, self.zid = network, zid

    def publisher(self, key: str, qos: ZenohQos, on_matching: Callable[[bool], None]) -> MemoryPublisher:
        made = MemoryPublisher(self, self.network.publishers, key, on_matching, cache=qos.cache)
        self.network.match()
        return made

    def subscribe(self, key: str, on_sample: Callable[[ZenohSample], None], *, history: bool = False) -> Entry:
        made = Entry(self, self.network.subscribers, key, on_sample, self.network.match)
        for publisher in self.network.publishers if history else ():
            for sample in publisher.cached if fits(key, publisher.key) else ():
                made.call(sample)
        self.network.match()
        return made

    def token(self, key: str) -> Entry:
        made = Entry(self, self.network.tokens, key, closed=lambda: self.network.tell(key, alive=False))
        self.network.tell(key, alive=True)
        return made

    def watch_tokens(self, key: str, on_token: Callable[[str, bool], None]) -> Entry:
        made = Entry(self, self.network.watches, key, on_token)
        for token in self.network.tokens:
            if fits(key, token.key):
                made.call(token.key, True)
        return made

    def queryable(self, key: str, on_query: Callable[[Any], object], _needs: object = None) -> Entry:
        return Entry(self, self.network.queryables, key, on_query)

    async def get(
        self, selector: str, payload: Buffer = b"", attachment: bytes = b"", *, timeout: float = 5.0, **_terms: object
    ) -> list[ZenohSample]:
        key, _, parameters = selector.partition("?")
        asked = [entry for entry in self.network.queryables if fits(key, entry.key)]
        queries = [MemoryQuery(key, bytes(payload), attachment, parameters) for _ in asked]
        for entry, query in zip(asked, queries, strict=True):
            entry.call(query)
        if queries:
            await asyncio.wait([asyncio.ensure_future(query.done.wait()) for query in queries], timeout=timeout)
        return [reply for query in queries for reply in query.replies]

    async def close(self) -> None:
        """Take back all that it declared."""
        network = self.network
        for table in (network.publishers, network.subscribers, network.queryables, network.watches, network.tokens):
            for entry in [each for each in table if each.session is self]:
                entry.close()

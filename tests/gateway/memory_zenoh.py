"""Zenoh in memory: sessions of one network, for tests of what speaks through ``OpenSession``."""

from __future__ import annotations

import asyncio
import itertools
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from rmpa.gateway.zenoh.threads import ZenohReply, ZenohSample

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rmpa.gateway.zenoh.threads import ZenohQos
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


@dataclass
class Entry:
    """What one session declared under a key."""

    session: MemorySession
    key: str
    callback: Callable[..., object]
    cached: list[ZenohSample] = field(default_factory=list)
    matched: bool | None = None


class MemoryDeclared:
    """An entry of a table, until it is closed."""

    def __init__(self, table: list[Entry], entry: Entry, closed: Callable[[], None] = lambda: None) -> None:
        self._table, self._entry, self._closed = table, entry, closed
        table.append(entry)

    def close(self) -> None:
        if self._entry in self._table:
            self._table.remove(self._entry)
            self._closed()


@dataclass
class MemoryQuery:
    """One query, with the answers that were given."""

    key: str
    payload: bytes
    attachment: bytes
    done: asyncio.Future[None]
    parameters: str = ""
    replies: list[ZenohReply] = field(default_factory=list)

    def reply(self, key: str, payload: Buffer, attachment: bytes = b"") -> None:
        self.replies.append(ZenohReply(key, bytes(payload), attachment, True))

    def answer(self, payload: Buffer) -> None:
        """Give the only answer, with the attachment of the query."""
        self.reply(self.key, payload, self.attachment)
        self.finish()

    def reply_error(self, text: str) -> None:
        self.replies.append(ZenohReply("", text.encode(), b"", False))
        self.finish()

    def finish(self) -> None:
        if not self.done.done():
            self.done.set_result(None)


class MemoryPublisher:
    """A publisher that delivers at once."""

    def __init__(self, network: MemoryZenoh, entry: Entry, cache: int) -> None:
        self._network, self._entry, self._cache = network, entry, cache
        self._declared = MemoryDeclared(network.publishers, entry)
        self.sent = self.dropped = self.waiting = 0

    def put(self, payload: Buffer, attachment: bytes = b"") -> int:
        self.sent += 1
        sample = ZenohSample(self._entry.key, bytes(payload), attachment)
        self._entry.cached = [*self._entry.cached, sample][-self._cache :] if self._cache else []
        for each in [each for each in self._network.subscribers if fits(each.key, sample.key)]:
            self._network.soon(self._network.subscribers, each, sample)
        return 0

    def put_all(self, messages: Sequence[tuple[bytes, bytes]]) -> int:
        return sum(self.put(*each) for each in messages)

    def close(self) -> None:
        self._declared.close()


class MemoryZenoh:
    """One network of sessions."""

    def __init__(self) -> None:
        self.publishers: list[Entry] = []
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

    def soon(self, table: list[Entry], entry: Entry, *args: Any) -> None:
        """Call back in the event loop, unless it was closed before."""
        loop = asyncio.get_running_loop()
        loop.call_soon(lambda: entry.callback(*args) if entry in table else None)

    def match(self) -> None:
        """Tell each publisher whether there is a subscriber."""
        for entry in self.publishers:
            matched = any(fits(each.key, entry.key) for each in self.subscribers)
            if entry.matched is not matched:
                entry.matched = matched
                self.soon(self.publishers, entry, matched)

    def tell(self, key: str, alive: bool) -> None:
        """Tell of a token."""
        for each in self.watches:
            if fits(each.key, key):
                self.soon(self.watches, each, key, alive)


class MemorySession:
    """One session; ``close`` ends it as the end of its process would."""

    endpoints: tuple[str, ...] = ("tcp/192.0.2.1:7447",)

    def __init__(self, network: MemoryZenoh, zid: str) -> None:
        self.network, self.zid = network, zid

    def publisher(self, key: str, qos: ZenohQos, on_matching: Callable[[bool], None]) -> MemoryPublisher:
        made = MemoryPublisher(self.network, Entry(self, key, on_matching), qos.cache)
        self.network.match()
        return made

    def subscribe(
        self, key: str, on_sample: Callable[[ZenohSample], None], *, history: bool = False
    ) -> MemoryDeclared:
        network, entry = self.network, Entry(self, key, on_sample)
        declared = MemoryDeclared(network.subscribers, entry, network.match)
        for publisher in network.publishers if history else ():
            for sample in publisher.cached if fits(key, publisher.key) else ():
                network.soon(network.subscribers, entry, sample)
        network.match()
        return declared

    def token(self, key: str) -> MemoryDeclared:
        declared = MemoryDeclared(
            self.network.tokens, Entry(self, key, lambda: None), lambda: self.network.tell(key, alive=False)
        )
        self.network.tell(key, alive=True)
        return declared

    def watch_tokens(self, key: str, on_token: Callable[[str, bool], None]) -> MemoryDeclared:
        entry = Entry(self, key, on_token)
        declared = MemoryDeclared(self.network.watches, entry)
        for token in self.network.tokens:
            if fits(key, token.key):
                self.network.soon(self.network.watches, entry, token.key, True)
        return declared

    def queryable(self, key: str, on_query: Callable[[Any], None], _needs: object = None) -> MemoryDeclared:
        return MemoryDeclared(self.network.queryables, Entry(self, key, on_query))

    async def get(
        self,
        selector: str,
        payload: Buffer = b"",
        attachment: bytes = b"",
        *,
        timeout: float = 5.0,
        **_terms: object,
    ) -> list[ZenohReply]:
        queries = []
        key, _, parameters = selector.partition("?")
        for entry in [entry for entry in self.network.queryables if fits(key, entry.key)]:
            query = MemoryQuery(key, bytes(payload), attachment, asyncio.Future(), parameters)
            queries.append(query)
            self.network.soon(self.network.queryables, entry, query)
        if queries:
            await asyncio.wait([query.done for query in queries], timeout=timeout)
        return [reply for query in queries for reply in query.replies]

    async def close(self) -> None:
        """Take back all that it declared."""
        network = self.network
        for table in (network.publishers, network.subscribers, network.queryables, network.watches):
            table[:] = [entry for entry in table if entry.session is not self]
        gone = [entry for entry in network.tokens if entry.session is self]
        network.tokens[:] = [entry for entry in network.tokens if entry.session is not self]
        for entry in gone:
            network.tell(entry.key, alive=False)
        network.match()

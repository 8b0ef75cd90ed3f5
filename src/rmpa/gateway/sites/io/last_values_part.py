"""The part of the neighbour "other sites" that keeps last values, and answers queries for them."""

from __future__ import annotations

import asyncio
import itertools
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rmpa.bridge.permission_gate import Needs
from rmpa.config.permission_rules import Access
from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway import limits
from rmpa.gateway.neighbour import SourceKind
from rmpa.gateway.sites.attachment import SiteAttachment
from rmpa.gateway.sites.last_values import (
    HEADER,
    LastValue,
    ValueHeader,
    ValueKey,
    fits,
    is_descriptor,
    may_be_latched,
    parse_value_key,
    value_key,
)
from rmpa.gateway.sites.part import PassivePart

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from rmpa.gateway.neighbour import MeshSource, OwnGraph, Tap
    from rmpa.gateway.sites.io.last_value_store import LastValueStore
    from rmpa.gateway.sites.part import SiteExport
    from rmpa.gateway.zenoh_api import Declared, ZenohQuery, ZenohSession
    from rmpa.ros.wire.tcpros import TopicDescription

_NEEDS = Needs((Access.SUBSCRIBE,), "each topic, of the site", key="rmpa/1/<site>/<module>/v/**")
_log = logging.getLogger(__name__)


@dataclass(slots=True, eq=False)
class _Watched:
    """A topic of this site: whether its messages are kept is known once its publisher told its header."""

    source: MeshSource
    wanted: bool
    sites: set[str]
    """To which it is offered; empty text: to all."""
    tap: Tap | None = None
    description: TopicDescription | None = None
    described: asyncio.Event | None = None


class SiteLastValues(PassivePart):
    """Last values of this site: a ``SitePart``.

    Latched topics and descriptors of Smart Resources are kept, and what a rule names.

    Args:
        site: This site's name.
        session: The Zenoh session.
        graph: The gateway's graph.
        store: The file; this part opens and closes it.
        wanted: ``(module, topic)``: whether a rule says that a topic is kept.
        why_not: ``(site, module, topic)``: why a site may not have a topic; empty if it may. The site is empty for
            programs that do not tell theirs.
        stamp: The wall clock, nanoseconds since 1970.
    """

    name = "last_values"

    def __init__(
        self,
        site: str,
        session: ZenohSession,
        graph: OwnGraph,
        store: LastValueStore,
        wanted: Callable[[str, str], bool],
        why_not: Callable[[str, str, str], str],
        stamp: Callable[[], int],
    ) -> None:
        self._site = site
        self._graph = graph
        self._store = store
        self._wanted = wanted
        self._why_not = why_not
        self._stamp = stamp
        self._watched: dict[ValueKey, _Watched] = {}
        self._looks = asyncio.Semaphore(limits.LATCH_LOOKS_AT_ONCE)
        self._tasks: set[asyncio.Task[None]] = set()
        self._answering = self._refused = 0
        self._looking: dict[ValueKey, asyncio.Task[None]] = {}
        self._opening = asyncio.get_running_loop().create_task(store.open(), name="open last values")
        self._queryable: Declared = session.queryable(value_key(site, "*", "**"), self._take, _NEEDS)

    def export(self, entry: SiteExport) -> None:
        """Keep the last value of a topic, if it is of those that are kept."""
        source = entry.source
        if source.kind is not SourceKind.TOPIC:
            return
        known = self._watched.get(_key(source))
        if known is not None and known.source == source:
            known.sites.add(entry.announced.to)
            return
        if known is not None:
            self._forget(known)
        wanted = is_descriptor(source.name, source.type) or self._wanted(source.module, source.name)
        watched = self._watched[_key(source)] = _Watched(source, wanted, {entry.announced.to})
        if wanted:
            self._listen(watched)
        elif may_be_latched(source.type):
            task = self._spawn(self._look(watched), f"whether {source.name} is latched")
            self._looking[_key(source)] = task

    def withdraw(self, entry: SiteExport) -> None:
        """End listening; the value stays."""
        if entry.source.kind is not SourceKind.TOPIC:
            return
        watched = self._watched.get(_key(entry.source))
        if watched is not None:
            watched.sites.discard(entry.announced.to)
            if not watched.sites:
                self._forget(watched)

    def report(self) -> dict[str, object]:
        """What is kept, as JSON values."""
        values = [
            {
                "module": key.module,
                "topic": key.topic,
                "node": key.node,
                "type": header.type,
                "stamp": header.stamp,
                "size": header.size,
                "latching": header.latching,
            }
            for key, header in self._store.headers.items()
        ]
        return {
            "values": values,
            "problem": self._store.problem,
            "dropped": self._store.dropped,
            "refused": self._refused,
        }

    async def close(self) -> None:
        """Write what waits, and end."""
        self._queryable.close()
        for watched in self._watched.values():
            if watched.tap is not None:
                watched.tap.close()
        self._watched.clear()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._opening
        await self._store.close()

    # --- what is kept -----------------------------------------------------------------------------------------------

    def _forget(self, watched: _Watched) -> None:
        key = _key(watched.source)
        del self._watched[key]
        if watched.tap is not None:
            watched.tap.close()
        if (task := self._looking.pop(key, None)) is not None:
            task.cancel()

    def _listen(self, watched: _Watched) -> None:
        watched.tap = self._graph.tap(
            watched.source,
            lambda body: self._received(watched, body),
            lambda description: self._described(watched, description),
            lambda _reason: None,
        )

    async def _look(self, watched: _Watched) -> None:
        """Ask the publisher of a topic once whether it is latched, and listen only if it is."""
        await asyncio.sleep(limits.LATCH_LOOK_AFTER)
        async with self._looks:
            watched.described = asyncio.Event()
            self._listen(watched)
            try:
                async with asyncio.timeout(limits.LATCH_LOOK_TIMEOUT):
                    await watched.described.wait()
            except TimeoutError:
                pass
            finally:
                watched.described = None
        if watched.tap is not None and not (watched.description is not None and watched.description.latching):
            watched.tap.close()
            watched.tap = None

    def _described(self, watched: _Watched, description: TopicDescription) -> None:
        watched.description = description
        if watched.described is not None:
            watched.described.set()

    def _received(self, watched: _Watched, body: memoryview) -> None:
        description = watched.description
        if description is None or not (watched.wanted or description.latching):
            return
        if len(body) > limits.LAST_VALUE_MAX:
            self._store.dropped += 1
            return
        value = LastValue(
            description.type,
            description.md5sum,
            description.definition,
            description.latching,
            self._stamp(),
            bytes(body),
        )
        self._store.put(_key(watched.source), value)

    # --- what is asked ----------------------------------------------------------------------------------------------

    def _take(self, query: ZenohQuery) -> None:
        if self._answering >= limits.LAST_VALUES_ASKED_MAX:
            self._refused += 1
            query.reply_error("too many questions for last values at once; ask again later")
            return
        self._answering += 1
        self._spawn(self._answer(query), "answer of last values").add_done_callback(self._answered)

    def _answered(self, _task: asyncio.Task[None]) -> None:
        self._answering -= 1

    async def _answer(self, query: ZenohQuery) -> None:
        try:
            await asyncio.shield(self._opening)
            parse_value_key(query.key)
            asker = SiteAttachment.parse(query.attachment).path[-1] if query.attachment else ""
            found = [
                (key, header)
                for key, header in self._store.headers.items()
                if fits(query.key, value_key(self._site, key.module, key.topic))
            ]
            refusals = {key: self._why_not(asker, key.module, key.topic) for key, _ in found}
            if found and all(refusals.values()):
                query.reply_error(refusals[found[0][0]])
                return
            await self._reply(query, [each for each in found if not refusals[each[0]]])
            query.finish()
        except RemoteProtocolError as error:
            query.reply_error(str(error))
        except Exception:  # noqa: BLE001 - a task's top
            _log.exception("! a query of last values failed")
            query.reply_error(f"the gateway of site {self._site} failed at last values; its log says why")

    async def _reply(self, query: ZenohQuery, found: list[tuple[ValueKey, ValueHeader]]) -> None:
        total = 0
        for (key, header), number in zip(
            sorted(found, key=lambda each: -each[1].stamp), itertools.count(1), strict=False
        ):
            name = value_key(self._site, key.module, key.topic)
            if HEADER in query.parameters.split(";"):
                payload: bytes | None = header.serialize()
            else:
                payload = await self._store.body(key)
            if payload is None:
                continue
            total += len(payload)
            if total > limits.LAST_VALUES_ANSWER_MAX and number > 1:
                break
            attachment = SiteAttachment(
                1, header.stamp, header.md5sum, key.node, (self._site,), latched=header.latching
            )
            query.reply(name, payload, attachment.serialize())

    def _spawn(self, work: Coroutine[None, None, None], name: str) -> asyncio.Task[None]:
        task = asyncio.get_running_loop().create_task(work, name=name)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task


def _key(source: MeshSource) -> ValueKey:
    return ValueKey(source.module, source.name, source.node)

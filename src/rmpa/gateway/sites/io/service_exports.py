"""Answers the calls of other sites to the services of this one."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from rmpa.bridge.policy import Needs
from rmpa.config.peer_rules import Access
from rmpa.core.errors import PeerRefused, RemoteProtocolError, RmpaError
from rmpa.gateway import limits
from rmpa.gateway.neighbour import SourceKind
from rmpa.gateway.sites.attachment import SiteAttachment
from rmpa.gateway.sites.keys import UNKNOWN_TYPE, data_key
from rmpa.gateway.sites.part import SitePart
from rmpa.gateway.sites.services import (
    DESCRIPTION,
    NO_MD5,
    asked_type,
    md5_problem,
    type_problem,
    write_description,
)
from rmpa.ros import limits as ros_limits

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.gateway.graph.own_graph import AgentGraph
    from rmpa.gateway.neighbour import MeshSource
    from rmpa.gateway.sites.part import SiteExport
    from rmpa.gateway.zenoh.queries import ArrivedQuery
    from rmpa.gateway.zenoh.session import Declaration, OpenSession
    from rmpa.ros.wire.tcpros import ServiceDescription

_NEEDS = Needs((Access.CALL,), "the service, of the site", key="rmpa/1/<site>/<module>/s/**")
_log = logging.getLogger(__name__)
_ANYBODY: Final = ""
"""The site of a program that sends no attachment."""


@dataclass(slots=True, eq=False)
class _Exported:
    """One service that other sites may call."""

    source: MeshSource
    to: str
    queryable: Declaration
    slots: asyncio.Semaphore
    tasks: set[asyncio.Task[None]] = field(default_factory=set)
    description: ServiceDescription | None = None
    calls: int = 0
    failed: int = 0
    refused: int = 0
    problem: str = ""

    def report(self) -> dict[str, object]:
        return {
            "module": self.source.module,
            "node": self.source.node,
            "name": self.source.name,
            "to": self.to,
            "type": self.description.type if self.description is not None else self.source.type,
            "calls": self.calls,
            "failed": self.failed,
            "refused": self.refused,
            "problem": self.problem,
        }


class SiteServiceExports(SitePart):
    """The services of this site, as queryables: a ``SitePart``.

    Args:
        site: This site's name.
        session: The Zenoh session.
        graph: The gateway's graph.
        timeout: Seconds that a call of a service may take, by its name in the gateway's graph (``[[service]]``).
        why_not: ``(site, source)``: why a site may not call a service; empty if it may. The site is empty for
            programs that do not tell theirs.
    """

    name = "services"

    def __init__(
        self,
        site: str,
        session: OpenSession,
        graph: AgentGraph,
        timeout: Callable[[str], float],
        why_not: Callable[[str, MeshSource], str] = lambda _site, _source: "",
    ) -> None:
        self._site = site
        self._session = session
        self._graph = graph
        self._timeout = timeout
        self._why_not = why_not
        self._exported: dict[tuple[str, str, str], _Exported] = {}
        """By module, service and the site that it is for."""
        self._bytes = 0

    def export(self, entry: SiteExport) -> None:
        """Let other sites call a service."""
        self.withdraw(entry)
        source, to = entry.source, entry.announced.to
        if source.kind is not SourceKind.SERVICE:
            return
        key = data_key(self._site, source.module, SourceKind.SERVICE, UNKNOWN_TYPE, source.name, to)
        queryable = self._session.queryable(key, lambda query: self._take(source, to, query), _NEEDS)
        slots = asyncio.Semaphore(limits.SITE_CALLS_AT_ONCE)
        self._exported[source.module, source.name, to] = _Exported(source, to, queryable, slots)

    def withdraw(self, entry: SiteExport) -> None:
        """Take it back; calls under way end as the server lets them."""
        if entry.source.kind is SourceKind.SERVICE:
            known = self._exported.pop((entry.source.module, entry.source.name, entry.announced.to), None)
            if known is not None:
                known.queryable.close()

    async def close(self) -> None:
        """Withdraw all services; calls under way get an error."""
        entries = list(self._exported.values())
        self._exported.clear()
        tasks = [task for entry in entries for task in entry.tasks]
        for entry in entries:
            entry.queryable.close()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def report(self) -> dict[str, object]:
        """What ``rmpa why`` is answered from, as JSON values."""
        return {"out": [entry.report() for entry in self._exported.values()]}

    # --- inside ---------------------------------------------------------------------------------------------------

    def _take(self, source: MeshSource, to: str, query: ArrivedQuery) -> None:
        entry = self._exported.get((source.module, source.name, to))
        if entry is None or entry.source is not source:
            query.reply_error(f"service {source.name} of {source.module} has left")
            return
        try:
            site, md5 = _caller(query)
            why = self._why_not(site, source) or type_problem(source.name, asked_type(query.key), _type_of(entry))
        except RemoteProtocolError as error:
            site, md5, why = _ANYBODY, NO_MD5, str(error)
        size = len(query.payload)
        if not why and (len(entry.tasks) >= limits.SITE_CALLS_WAITING or self._is_full(size)):
            why = f"{len(entry.tasks)} calls of service {source.name} wait already; try again later"
        if why:
            entry.refused += 1
            entry.problem = why
            query.reply_error(why)
            return
        self._bytes += size
        task = asyncio.get_running_loop().create_task(
            self._answer(entry, query, md5), name=f"call of {source.name} by {site or 'a program'}"
        )
        entry.tasks.add(task)
        task.add_done_callback(lambda done: self._done(entry, done, size))

    def _is_full(self, size: int) -> bool:
        return size > ros_limits.SERVICE_MESSAGE_MAX or self._bytes + size > limits.SITE_CALL_BYTES

    def _done(self, entry: _Exported, task: asyncio.Task[None], size: int) -> None:
        entry.tasks.discard(task)
        self._bytes -= size

    async def _answer(self, entry: _Exported, query: ArrivedQuery, md5: str) -> None:
        try:
            if DESCRIPTION in query.parameters.split(";"):
                query.reply(query.key, write_description(await self._describe(entry)))
            else:
                await self._call(entry, query, md5)
            query.finish()
        except PeerRefused as error:
            self._fail(entry, query, error.reason)
        except RmpaError as error:
            self._fail(entry, query, str(error))
        except asyncio.CancelledError:
            query.reply_error(f"the gateway of site {self._site} ends")
            raise
        except Exception:  # noqa: BLE001 - a task's top
            _log.exception("! a call of %s by another site failed", entry.source.name)
            self._fail(entry, query, f"the gateway of site {self._site} failed at the call; its log says why")

    async def _call(self, entry: _Exported, query: ArrivedQuery, md5: str) -> None:
        source = entry.source
        entry.calls += 1
        timeout = self._timeout(source.here)
        began = asyncio.get_running_loop().time()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout):
                await entry.slots.acquire()
                try:
                    if problem := await self._other_definition(entry, md5):
                        raise PeerRefused(source.module, problem)
                    left = max(0.001, timeout - (asyncio.get_running_loop().time() - began))
                    query.reply(query.key, await self._graph.call(source, query.payload, left))
                    return
                finally:
                    entry.slots.release()
        raise PeerRefused(
            source.module, f"service {source.name} of {source.module} has not answered in {timeout:g} s"
        )

    async def _other_definition(self, entry: _Exported, md5: str) -> str:
        """Why the client's definition is not the server's; a server that was replaced is asked once more."""
        if md5 == NO_MD5 or (entry.description is not None and entry.description.md5sum == md5):
            return ""
        return md5_problem(entry.source.name, md5, await self._describe(entry))

    async def _describe(self, entry: _Exported) -> ServiceDescription:
        try:
            async with asyncio.timeout(limits.DESCRIBE_TIMEOUT):
                entry.description = await self._graph.describe(entry.source)
        except TimeoutError:
            text = f"service {entry.source.name} does not tell its type within {limits.DESCRIBE_TIMEOUT:g} s"
            raise PeerRefused(entry.source.module, text) from None
        return entry.description

    def _fail(self, entry: _Exported, query: ArrivedQuery, text: str) -> None:
        entry.failed += 1
        entry.problem = text
        query.reply_error(text)


def _type_of(entry: _Exported) -> str:
    return entry.description.type if entry.description is not None else entry.source.type


def _caller(query: ArrivedQuery) -> tuple[str, str]:
    """The site that calls, and the md5 sum that it takes the service for.

    Raises:
        RemoteProtocolError: The attachment is malformed.
    """
    if not query.attachment:
        return _ANYBODY, NO_MD5
    attachment = SiteAttachment.parse(query.attachment)
    return attachment.path[-1], attachment.md5

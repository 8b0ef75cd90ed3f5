"""Services and actions between sites: descriptions, calls, and the two directions.

Services between sites: the description that a queryable gives, and the texts of calls that fail. Without I/O.

``get`` on ``rmpa/1/<site>/<module>/s/<package>%<Type>/<service>`` calls: the query's payload is the request, the
reply the response, both as TCPROS has them without length. With the parameter ``description`` it asks for the type::

    {"type": "std_srvs/Trigger", "md5sum": "937c9679…", "request_type": "std_srvs/TriggerRequest", "response_type": …}

An error reply has the server's text. The query's attachment is that of a message (``sites.attachment``): it tells
which site calls, and the md5 sum that it takes the service for; programs may leave it out.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.bridge.policy import Needs
from rmpa.bridge.topics.subscribers import is_watched
from rmpa.config.peer_rules import Access
from rmpa.core.errors import PeerRefused, RemoteProtocolError, RmpaError, UnreachableError
from rmpa.core.identity import is_type_name
from rmpa.gateway import limits
from rmpa.gateway.neighbour import SourceKind, ZenohPriority
from rmpa.gateway.sites.keys import ROOT, TO, UNKNOWN_TYPE, SiteAttachment, data_key
from rmpa.gateway.sites.plans import SitePart
from rmpa.ros import limits as ros_limits
from rmpa.ros.wire.tcpros import ServiceDescription

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.gateway.foreign import ProxiedService, TopicTap
    from rmpa.gateway.neighbour import ForeignSource, MeshSource
    from rmpa.gateway.own_graph import AgentGraph
    from rmpa.gateway.sites.keys import SiteSource
    from rmpa.gateway.sites.plans import SiteExport, SiteImport
    from rmpa.gateway.zenoh.config import ArrivedQuery
    from rmpa.gateway.zenoh.session import Declaration, OpenSession
    from rmpa.ros.wire.tcpros import Buffer

DESCRIPTION: Final = "description"
"""The parameter of a query for the type."""
NO_MD5: Final = "0" * 32
"""The md5 sum in the attachment of a call whose client has not asked for the type."""
_MD5_LENGTH: Final = 32


class _Described(msgspec.Struct):
    type: str
    md5sum: str
    request_type: str = ""
    response_type: str = ""


def write_description(description: ServiceDescription) -> bytes:
    """The reply to a query for the type."""
    told = _Described(description.type, description.md5sum, description.request_type, description.response_type)
    return msgspec.json.encode(told)


def read_description(data: Buffer) -> ServiceDescription:
    """Read a reply of ``write_description``.

    Raises:
        RemoteProtocolError: It is none, or names no type.
    """
    if len(data) > limits.SERVICE_DESCRIPTION_MAX:
        raise RemoteProtocolError(f"a description of a service has {len(data)} bytes")
    try:
        told = msgspec.json.decode(data, type=_Described)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise RemoteProtocolError(f"not a description of a service: {error}") from None
    hexadecimal = len(told.md5sum) == _MD5_LENGTH and not told.md5sum.strip("0123456789abcdef")
    if not is_type_name(told.type) or not hexadecimal:
        raise RemoteProtocolError(f"not a description of a service: {told.type[:80]!r}, {told.md5sum[:40]!r}")
    return ServiceDescription(told.type, told.md5sum, told.request_type, told.response_type)


def asked_type(key: str) -> str:
    """The type in the key expression of a query; ``*`` for any.

    Raises:
        RemoteProtocolError: It is not the key of a service.
    """
    chunks = key.split("/")
    if len(chunks) > 6 and chunks[4] == TO:
        del chunks[4:6]
    if len(key) > limits.KEY_MAX or len(chunks) < 7 or "/".join(chunks[:2]) != ROOT or chunks[4] != "s":
        raise RemoteProtocolError(f"{key[:120]!r} is not the key of a service")
    return UNKNOWN_TYPE if "*" in chunks[5] else chunks[5].replace("%", "/")


def type_problem(service: str, asked: str, has: str) -> str:
    """Why a call by another type is refused; empty if the types are equal or one of them is unknown."""
    if UNKNOWN_TYPE in (asked, has) or asked == has:
        return ""
    return f"service {service} is of the type {has}, not {asked}"


def md5_problem(service: str, asked: str, description: ServiceDescription) -> str:
    """Why a call by another definition of the type is refused; empty if it is not."""
    if asked in (NO_MD5, description.md5sum):
        return ""
    return (
        f"the md5 sum of service {service} is {description.md5sum} ({description.type}) at its site, and the client "
        f"takes it for {asked}: another definition, or the server was replaced; build both from the same package"
    )


def unanswered(service: str, module: str, site: str, waited: float, timeout: float) -> str:
    """What a client reads of a call that brought no reply.

    Args:
        service: By its name in its module.
        module: The module that has it.
        site: The site of the module.
        waited: Seconds until the session gave up.
        timeout: Seconds that it was to wait.
    """
    if waited < timeout:
        return f"service {service} of {module} at site {site} has left: no gateway there answers for it"
    return f"service {service} of {module} at site {site} has not answered within {timeout:g} s ([[service]] timeout)"


# The part of the neighbour "other sites" that lets actions work: clients accept a server by the names of its nodes.
#
# The five topics of an action cross as all topics do. But a client of actionlib waits for a node that publishes the
# status *and* listens to goals and cancellations (``bridge.topics.subscribers``). The gateway listens to these for
# all other sites, by one connection. So it opens one more for each server of another site, under the server's name
# here.


_STATUS: Final = "actionlib_msgs/GoalStatusArray"


class SiteActions(SitePart):
    """Names the action servers of other sites to clients of this one: a ``SitePart``.

    Args:
        attend: Listens to a topic under the name of a foreign node: ``AgentGraph.attend``.
    """

    name = "actions"

    def __init__(self, attend: Callable[[MeshSource, ForeignSource], TopicTap]) -> None:
        self._attend = attend
        self._clients: dict[MeshSource, str] = {}
        """The topics of goals and cancellations of this site, with the action's name."""
        self._offered: dict[MeshSource, set[str]] = {}
        """The sites that each of them is offered to; empty text: all."""
        self._servers: dict[ForeignSource, str] = {}
        """The topics of status of other sites, likewise."""
        self._listening: dict[tuple[MeshSource, ForeignSource], TopicTap] = {}

    def export(self, entry: SiteExport) -> None:
        """A client of this site sends goals or cancellations."""
        source = entry.source
        if source.kind is not SourceKind.TOPIC or not is_watched(source.type):
            return
        self._offered.setdefault(source, set()).add(entry.announced.to)
        if source not in self._clients:
            self._clients[source] = _action(source.here)
            for server, action in self._servers.items():
                self._join(source, server, action)

    def withdraw(self, entry: SiteExport) -> None:
        """It has gone."""
        sites = self._offered.get(entry.source, set())
        sites.discard(entry.announced.to)
        if not sites and self._clients.pop(entry.source, None) is not None:
            self._offered.pop(entry.source, None)
            self._leave(lambda client, _: client == entry.source)

    def show(self, entry: SiteImport) -> None:
        """A server of another site publishes its status."""
        source = entry.source
        if source.kind is SourceKind.TOPIC and source.type == _STATUS:
            action = self._servers[source] = _action(source.name)
            for client in self._clients:
                self._join(client, source, action)

    def hide(self, entry: SiteImport) -> None:
        """It has gone."""
        if self._servers.pop(entry.source, None) is not None:
            self._leave(lambda _, server: server == entry.source)

    async def close(self) -> None:
        """Listen no more."""
        self._leave(lambda _client, _server: True)

    def _join(self, client: MeshSource, server: ForeignSource, action: str) -> None:
        if self._clients[client] == action and len(self._listening) < limits.SITE_ACTIONS_MAX:
            self._listening[client, server] = self._attend(client, server)

    def _leave(self, which: Callable[[MeshSource, ForeignSource], bool]) -> None:
        for pair in [pair for pair in self._listening if which(*pair)]:
            self._listening.pop(pair).close()


def _action(topic: str) -> str:
    """The action that a topic belongs to: ``/arm/move`` for ``/arm/move/goal``."""
    return topic.rpartition("/")[0]


# Answers the calls of other sites to the services of this one.


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


# Puts the services of other sites into the gateway's graph, and calls them.


@dataclass(slots=True, eq=False)
class _Imported:
    """One service of another site."""

    source: SiteSource
    foreign: ForeignSource
    gone: asyncio.Event = field(default_factory=asyncio.Event)
    service: ProxiedService | None = None
    description: ServiceDescription | None = None
    calls: int = 0
    failed: int = 0
    problem: str = ""

    def report(self) -> dict[str, object]:
        return {
            "site": self.source.module.site,
            "module": self.source.module.name,
            "node": self.source.node,
            "name": self.source.name,
            "here": self.foreign.name,
            "type": self.description.type if self.description is not None else self.source.type,
            "calls": self.calls,
            "failed": self.failed,
            "problem": (self.service.problem if self.service is not None else "") or self.problem,
        }


class SiteServiceImports(SitePart):
    """The services of other sites in the gateway's graph: a ``SitePart``.

    Args:
        site: This site's name.
        session: The Zenoh session.
        graph: The gateway's graph.
        timeout: Seconds that a call may take, by the service's name in the gateway's graph (``[[service]]``).
        stamp: The wall clock, nanoseconds since 1970.
    """

    name = "services"

    def __init__(
        self,
        site: str,
        session: OpenSession,
        graph: AgentGraph,
        timeout: Callable[[str], float],
        stamp: Callable[[], int],
    ) -> None:
        self._site = site
        self._session = session
        self._graph = graph
        self._timeout = timeout
        self._stamp = stamp
        self._numbers = itertools.count(1)
        self._imported: dict[ForeignSource, _Imported] = {}

    def show(self, entry: SiteImport) -> None:
        """Show a service."""
        foreign = entry.source
        self._hide(foreign)
        if foreign.kind is SourceKind.SERVICE:
            made = self._imported[foreign] = _Imported(entry.announced, foreign)
            made.service = self._graph.show_service(
                foreign, lambda request: self._call(made, request), lambda: self._describe(made)
            )

    def renew(self, old: SiteImport, new: SiteImport) -> None:
        """A service is of another run of its module: calls under way end with an error, and its type is unknown."""
        if old.source != new.source:
            self._hide(old.source)
        entry = self._imported.get(new.source)
        if entry is None:
            self.show(new)
            return
        entry.gone.set()
        entry.source, entry.description, entry.gone = new.announced, None, asyncio.Event()

    def hide(self, entry: SiteImport) -> None:
        """Take a service back; calls under way end with an error at once."""
        self._hide(entry.source)

    async def close(self) -> None:
        """Take all services back."""
        for foreign in list(self._imported):
            self._hide(foreign)

    def report(self) -> dict[str, object]:
        """What ``rmpa why`` is answered from, as JSON values."""
        return {"in": [entry.report() for entry in self._imported.values()]}

    # --- inside ---------------------------------------------------------------------------------------------------

    def _hide(self, foreign: ForeignSource) -> None:
        entry = self._imported.pop(foreign, None)
        if entry is not None:
            entry.gone.set()
            if entry.service is not None:
                entry.service.close()

    async def _call(self, entry: _Imported, request: bytes) -> bytes:
        """Call the service.

        Raises:
            PeerRefused: Its server, or its site's gateway, answered with an error; the reason is its text.
            UnreachableError: No answer came.
        """
        entry.calls += 1
        try:
            md5 = entry.description.md5sum if entry.description is not None else NO_MD5
            timeout = self._timeout(entry.foreign.name)
            return await self._ask(entry, "", request, md5, timeout)
        except (PeerRefused, UnreachableError) as error:
            entry.failed += 1
            entry.problem = error.reason if isinstance(error, PeerRefused) else str(error)
            raise

    async def _describe(self, entry: _Imported) -> ServiceDescription:
        """Ask for the type; raises as ``_call``, and ``RemoteProtocolError`` for a reply that is none."""
        reply = await self._ask(entry, f"?{DESCRIPTION}", b"", NO_MD5, limits.DESCRIBE_TIMEOUT)
        entry.description = read_description(reply)
        return entry.description

    async def _ask(self, entry: _Imported, parameters: str, request: bytes, md5: str, within: float) -> bytes:
        source, loop = entry.source, asyncio.get_running_loop()
        module, site = source.module.name, source.module.site
        call = SiteAttachment(next(self._numbers), self._stamp(), md5, source.node, (self._site,))
        began = loop.time()
        asking = loop.create_task(
            self._session.get(
                source.key() + parameters,
                request,
                call.serialize(),
                timeout=within + limits.SITE_CALL_GRACE,
                priority=ZenohPriority.INTERACTIVE_HIGH,
            )
        )
        leaving = loop.create_task(entry.gone.wait())  # of the run that is called, not of the next
        try:
            await asyncio.wait((asking, leaving), return_when=asyncio.FIRST_COMPLETED)
            replies = asking.result() if asking.done() else []
        finally:
            for task in (asking, leaving):
                task.cancel()
            await asyncio.gather(asking, leaving, return_exceptions=True)
        for reply in sorted(replies, key=lambda each: not each.ok):
            if reply.ok:
                return reply.payload
            raise PeerRefused(f"{module} at site {site}", reply.payload.decode(errors="replace"))
        text = unanswered(source.name, module, site, loop.time() - began, within)
        raise PeerRefused(f"site {site}", text)

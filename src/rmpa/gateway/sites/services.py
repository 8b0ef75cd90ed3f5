"""Services and actions between sites: descriptions, calls, and the two directions.

``get`` on ``rmpa/1/<site>/<module>/s/<package>%<Type>/<service>`` calls: the query's payload is the request, the
reply the response, both as TCPROS has them without length. With the parameter ``description`` it asks for the type::

    {"type": "std_srvs/Trigger", "md5sum": "937c9679…", "request_type": "std_srvs/TriggerRequest", "response_type": …}

An error reply has the server's text. The query's attachment is that of a message (``sites.attachment``): it tells
which site calls, and the md5 sum that it takes the service for; programs may leave it out.
"""

from __future__ import annotations

import asyncio
import itertools
import time
from collections import Counter
from functools import partial
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.bridge.policy import Needs
from rmpa.bridge.topics.reports import is_watched
from rmpa.config.peer_rules import Access
from rmpa.core.errors import PeerRefused, RemoteProtocolError
from rmpa.core.identity import is_type_name
from rmpa.gateway import limits
from rmpa.gateway.foreign import Answering
from rmpa.gateway.rules import ForeignSource, MeshSource, SourceKind
from rmpa.gateway.sites.keys import ROOT, TO, UNKNOWN_TYPE, AttachmentReader, MessageSource, data_key, read_json
from rmpa.gateway.zenoh.threads import ZenohPriority, first_answer
from rmpa.ros import limits as ros_limits
from rmpa.ros.wire.tcpros import Buffer, ServiceDescription
from rmpa.runtime.tasks import OwnedTasks

if TYPE_CHECKING:
    from rmpa.gateway.own_graph import AgentGraph, TopicTap
    from rmpa.gateway.sites.plans import SiteExport, SiteImport
    from rmpa.gateway.sites.topics import SiteContext
    from rmpa.gateway.zenoh.session import ArrivedQuery

# Bytes of the description of another site's service: four names.
_SERVICE_DESCRIPTION_MAX: Final = 8192
# Bytes of the requests of other sites that are under way here: four of the largest.
_SITE_CALL_BYTES: Final = 256 * 1024 * 1024
# Seconds that the calling site waits longer than the serving one, whose error text tells more.
_SITE_CALL_GRACE: Final = 1.0
# Seconds for the description of another site's service; its server may be probed for it over two meshes.
_DESCRIBE_TIMEOUT: Final = 10.0

_NEEDS: Final = Needs((Access.CALL,), "the service, of the site", key="rmpa/1/<site>/<module>/s/**")
_STATUS: Final = "actionlib_msgs/GoalStatusArray"
# The parameter of a query for the type.
DESCRIPTION: Final = "description"
# The md5 sum in the attachment of a call whose client has not asked for the type.
NO_MD5: Final = "0" * 32
_MD5_LENGTH: Final = 32


def read_description(data: Buffer) -> ServiceDescription:
    """Read the reply to a query for the type.

    Raises:
        RemoteProtocolError: It is none, or names no type.
    """
    found = read_json(data, ServiceDescription, "a description of a service", _SERVICE_DESCRIPTION_MAX)
    hexadecimal = len(found.md5sum) == _MD5_LENGTH and not found.md5sum.strip("0123456789abcdef")
    if not is_type_name(found.type) or not hexadecimal:
        raise RemoteProtocolError(f"not a description of a service: {found.type[:80]!r}, {found.md5sum[:40]!r}")
    return found


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


def caller(query: ArrivedQuery) -> tuple[str, str]:
    """The site that asks, and the md5 sum that it takes a service for; empty and zeros for a program that tells none.

    Raises:
        RemoteProtocolError: The attachment is malformed.
    """
    if not query.attachment:
        return "", NO_MD5
    source = AttachmentReader().read(query.attachment)[2]
    return source.path[-1], source.md5


class ExportedService:
    """One service of this site, as a queryable for other sites.

    Args:
        entry: The service.
        part: Bounds what waits of all services.
    """

    def __init__(self, entry: SiteExport, part: SiteServices) -> None:
        source, context = entry.source, part.context
        self._source = source
        self._part = part
        self._description: ServiceDescription | None = None
        self._slots = asyncio.Semaphore(limits.SITE_CALLS_AT_ONCE)
        self.answering = Answering(
            f"service {source.name}", f"the gateway of site {context.name} ends", limits.SITE_CALLS_WAITING
        )
        key = data_key(context.name, source.module, SourceKind.SERVICE, UNKNOWN_TYPE, source.name, entry.announced.to)
        self.queryable = context.session.queryable(key, self._take, _NEEDS)

    def _take(self, query: ArrivedQuery) -> None:
        source, size = self._source, len(query.payload)
        has = self._description.type if self._description is not None else source.type
        try:
            site, md5 = caller(query)
            why = self._part.context.rules.refusal(site, source.module, source.name, Access.CALL)
            asked = asked_type(query.key)
            if not why and UNKNOWN_TYPE not in (asked, has) and asked != has:
                why = f"service {source.name} is of the type {has}, not {asked}"
        except RemoteProtocolError as error:
            md5, why = NO_MD5, str(error)
        if not why and (size > ros_limits.SERVICE_MESSAGE_MAX or self._part.waiting + size > _SITE_CALL_BYTES):
            why = f"{len(self.answering)} calls of service {source.name} wait already; try again later"
        if why:
            query.reply_error(why)
        elif self.answering.take(query, partial(self._respond, md5)):
            self._part.waiting += size

    async def _respond(self, md5: str, query: ArrivedQuery) -> tuple[bytes, bytes]:
        try:
            if DESCRIPTION in query.parameters.split(";"):
                return msgspec.json.encode(await self._describe()), b""
            return await self._call(md5, query.payload), b""
        finally:
            self._part.waiting -= len(query.payload)

    async def _call(self, md5: str, request: bytes) -> bytes:
        source, graph = self._source, self._part.context.graph
        timeout = self._part.context.bridge.services.timeout(source.here)
        try:
            async with asyncio.timeout(timeout), self._slots:
                known = self._description
                if md5 != NO_MD5 and (known is None or known.md5sum != md5):
                    known = await self._describe()  # a server that was replaced is asked once more
                    if md5 != known.md5sum:
                        raise PeerRefused(
                            source.module,
                            f"the md5 sum of service {source.name} is {known.md5sum} ({known.type}) at its site, and "
                            f"the client takes it for {md5}: another definition, or the server was replaced; build "
                            "both from the same package",
                            code="service-failed",
                        )
                return bytes(await graph.call(source, request, timeout))
        except TimeoutError:
            text = f"service {source.name} of {source.module} has not answered in {timeout:g} s"
            raise PeerRefused(source.module, text) from None

    async def _describe(self) -> ServiceDescription:
        try:
            async with asyncio.timeout(_DESCRIBE_TIMEOUT):
                self._description = await self._part.context.graph.describe(self._source)
        except TimeoutError:
            text = f"service {self._source.name} does not say its type within {_DESCRIBE_TIMEOUT:g} s"
            raise PeerRefused(self._source.module, text) from None
        return self._description


class ImportedService:
    """One service of another site in the gateway's graph.

    Args:
        entry: The service.
        context: What is shared with topics and parameters.
    """

    def __init__(self, entry: SiteImport, context: SiteContext) -> None:
        self._source = entry.announced
        self._context = context
        self._here = entry.source.name
        self._description: ServiceDescription | None = None
        self._numbers = itertools.count(1)
        self._asking = OwnedTasks()
        self._problem = ""
        self.calls = self.failed = 0
        self._shown = context.graph.show_service(entry.source, self._serve, self._describe)

    def renew(self, entry: SiteImport) -> None:
        """It is of another run of its module, or its way was interrupted: calls under way end with an error."""
        self._asking.cancel()
        self._source, self._description = entry.announced, None

    def close(self) -> None:
        """Take it back; calls under way end with an error at once."""
        self._asking.cancel()
        self._shown.close()

    @property
    def problem(self) -> str:
        """Why it cannot be called, or why the last call failed; empty for nothing."""
        return self._shown.problem or self._problem

    async def _serve(self, request: bytes) -> bytes:
        """Call the service.

        Raises:
            PeerRefused: Its server, or its site's gateway, answered with an error; the reason is its text.
        """
        self.calls += 1
        md5 = self._description.md5sum if self._description is not None else NO_MD5
        try:
            return await self._ask("", request, md5, self._context.bridge.services.timeout(self._here))
        except PeerRefused as error:
            self.failed += 1
            self._problem = error.reason
            raise

    async def _describe(self) -> ServiceDescription:
        """Ask for the type; raises as ``_serve``, and ``RemoteProtocolError`` for a reply that is none."""
        reply = await self._ask(f"?{DESCRIPTION}", b"", NO_MD5, _DESCRIBE_TIMEOUT)
        self._description = read_description(reply)
        return self._description

    async def _ask(self, parameters: str, request: bytes, md5: str, within: float) -> bytes:
        source, loop = self._source, asyncio.get_running_loop()
        attachment = MessageSource(md5, source.node, (self._context.name,)).writer()
        began = loop.time()
        asking = self._asking.start(
            self._context.session.get(
                source.key() + parameters,
                request,
                attachment(next(self._numbers), time.time_ns()),
                timeout=within + _SITE_CALL_GRACE,
                priority=ZenohPriority.INTERACTIVE_HIGH,
            ),
            f"call {source.name} of {source.site}",
            raises=(Exception,),
        )
        try:
            await asyncio.wait((asking,))
        finally:
            asking.cancel()
        reply = None if asking.cancelled() else first_answer(asking.result())
        where = f"{source.module.name} at site {source.site}"
        if reply is not None:
            if reply.ok:
                return reply.payload
            raise PeerRefused(where, reply.text, code="service-failed")
        text = f"service {source.name} of {where} has left: no gateway there answers for it"
        if loop.time() - began >= within:
            text = f"service {source.name} of {where} has not answered within {within:g} s ([[service]] timeout)"
        raise PeerRefused(f"site {source.site}", text, code="service-failed")


class SiteServices:
    """Services between sites; and what lets actions work.

    Args:
        context: What is shared with topics and parameters.

    Attributes:
        waiting: Bytes of the requests of other sites that are under way here.
    """

    def __init__(self, context: SiteContext) -> None:
        self.context = context
        self.waiting = 0
        self._exported: dict[SiteExport, ExportedService] = {}
        self._ending: list[Answering] = []

    def export(self, entry: SiteExport) -> None:
        """Let other sites call a service."""
        self._exported[entry] = ExportedService(entry, self)

    def withdraw(self, entry: SiteExport) -> None:
        """Take it back; calls under way end as the server lets them."""
        gone = self._exported.pop(entry)
        gone.queryable.close()
        self._ending = [*(each for each in self._ending if each), gone.answering]

    async def close(self) -> None:
        """End calls under way with an error."""
        for each in (*self._ending, *(exported.answering for exported in self._exported.values())):
            await each.close()


class SiteActions:
    """Names the action servers of other sites to clients of this one: clients accept a server by its nodes' names.

    The five topics of an action cross as all topics do. But a client of actionlib waits for a node that publishes the
    status *and* listens to goals and cancellations (``bridge.topics.reports``). The gateway listens to these for
    all other sites, by one connection. So it opens one more for each server of another site, under the server's name
    here.

    Args:
        graph: The gateway's graph.
    """

    def __init__(self, graph: AgentGraph) -> None:
        self._graph = graph
        # By action the topics of goals and cancellations of this site, with the number of their exports.
        self._clients: dict[str, Counter[MeshSource]] = {}
        # By action the topics of status of other sites.
        self._servers: dict[str, set[ForeignSource]] = {}
        self._listening: dict[tuple[MeshSource, ForeignSource], TopicTap] = {}

    def client(self, source: MeshSource, *, there: bool) -> None:
        """A topic of this site is offered to others, or taken back: perhaps goals or cancellations of a client."""
        if is_watched(source.type):
            action = source.here.rpartition("/")[0]
            clients = self._clients.setdefault(action, Counter())
            clients[source] += 1 if there else -1
            self._clients[action] = +clients  # without those that have gone
            self._judge(action)

    def server(self, source: ForeignSource, *, there: bool) -> None:
        """A topic of another site is shown, or hidden: perhaps the status of a server."""
        if source.type == _STATUS:
            action = source.name.rpartition("/")[0]
            servers = self._servers.setdefault(action, set())
            (servers.add if there else servers.discard)(source)
            self._judge(action)

    def _judge(self, action: str) -> None:
        """Listen for each server to each client."""
        clients, servers = self._clients.get(action, Counter()), self._servers.get(action, set())
        for client, server in tuple(self._listening):
            if client.here.rpartition("/")[0] == action and not (client in clients and server in servers):
                self._listening.pop((client, server)).close()
        for pair in ((client, server) for client in clients for server in servers):
            if pair not in self._listening and len(self._listening) < limits.SITE_ACTIONS_MAX:
                self._listening[pair] = self._graph.attend(*pair)
        for table in (self._clients, self._servers):
            if not table.get(action):
                table.pop(action, None)

"""What a neighbour has in the gateway's graph, and answers to its queries."""

from __future__ import annotations

import asyncio
import hashlib
import logging
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits as bridge_limits
from rmpa.bridge.messages import Origin, Source, is_crossing_name, is_crossing_type
from rmpa.bridge.policy import is_outside, service_place
from rmpa.bridge.proxies import PeerProxies
from rmpa.core import limits as core_limits
from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.core.identity import OUTSIDE_GUID, peer_name_problem
from rmpa.gateway.rules import ForeignSource, SourceKey, SourceKind
from rmpa.ros.node.publication import Publication, PublicationEvents
from rmpa.ros.node.service_server import ServiceCall, ServiceEndpoint
from rmpa.ros.wire.tcpros import LENGTH, Buffer, ServiceDescription, TopicDescription, printable
from rmpa.runtime.tasks import OwnedTasks

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from rmpa.agent.agent import Agent
    from rmpa.gateway.zenoh.session import ArrivedQuery
    from rmpa.ros.node.slave_node import SlaveNode

    Respond = Callable[[ArrivedQuery], Awaitable[tuple[bytes, bytes]]]

_log = logging.getLogger(__name__)
_INSTANCE_LABEL: Final = b"rmpa site 1"


class Answering(OwnedTasks):
    """Answers queries in tasks, a bounded number at once; an error is the reply, and the end of the gateway too.

    Args:
        what: What is asked for, for the log and for texts.
        ends: What is answered if the gateway ends meanwhile.
        most: Queries that are answered at once, or wait.
    """

    def __init__(self, what: str, ends: str, most: int) -> None:
        self._what: Final = what
        self._ends: Final = ends
        self._most: Final = most
        super().__init__()

    def take(self, query: ArrivedQuery, respond: Respond) -> bool:
        """Answer a query by what ``respond`` returns for it: the payload, and its attachment (empty for none).

        Returns:
            Whether there was room.
        """
        if len(self) >= self._most:
            query.reply_error(f"{len(self)} calls of {self._what} wait already; try again later")
            return False
        self.start(self._answer(query, respond), f"answer for {self._what}")
        return True

    async def _answer(self, query: ArrivedQuery, respond: Respond) -> None:
        try:
            query.reply(*(await respond(query)))
        except PeerRefused as error:
            query.reply_error(error.reason)
        except RmpaError as error:
            query.reply_error(str(error))
        except asyncio.CancelledError:
            query.reply_error(self._ends)
            raise
        except Exception:
            query.reply_error(f"the gateway failed at {self._what}; its log says why")
            raise


def foreign_origin(source: ForeignSource) -> Origin:
    """The origin with which the relay offers a neighbour's source; its path is empty.

    The instance of a site is the same in all gateways that reach it. The node is ``/<module>/<node>``, or ``/<node>``
    where there is no module.
    """
    digest = hashlib.sha256(_INSTANCE_LABEL + source.site.encode()).digest()
    node = f"/{source.module}{source.node}" if source.module else source.node
    return Origin(source.site, OUTSIDE_GUID, digest[: core_limits.INSTANCE_ID_BYTES].hex(), node, ())


class ForeignSite:
    """What one site, or ROS 2, has in the gateway's graph; of sources of one node and name the first is shown.

    Args:
        agent: The gateway's agent.
        source: A source of it.
        number: Its number in the relay: negative, for no peer has such a one.

    Attributes:
        shown: By kind, name here, and proxy; the first one of several is in the graph.
    """

    def __init__(self, agent: Agent, source: ForeignSource, number: int) -> None:
        origin = foreign_origin(source)
        bad = peer_name_problem(source.site)
        prefix = "" if bad else agent.bridge.sessions.reserved_name(origin)[: -len(origin.node)]
        self.agent: Final = agent
        self.core: Final = agent.core
        self.relay: Final = agent.bridge.relay
        self.number: Final = number
        self.proxies: Final = PeerProxies(prefix, agent.bridge.proxy_nodes)
        self.shown: dict[SourceKey, list[ProxiedSource]] = {}
        self._instance = origin.instance

    def key(self, source: ForeignSource) -> SourceKey:
        """Kind, name here, and proxy of a source."""
        return source.kind, source.name, self.proxies.name(foreign_origin(source).node)

    def show(self, one: ProxiedSource) -> None:
        """Put a source into the graph, or have it wait until its name is free."""
        if problem := _name_problem(one.source):
            one.refused = problem
            return
        if not self.shown:
            self._reach(reached=True)
        same = self.shown.setdefault(self.key(one.source), [])
        same.append(one)
        if len(same) == 1:
            one.begin()

    def hide(self, one: ProxiedSource) -> None:
        """Forget a source that is closed; the next of its name takes its place."""
        key = self.key(one.source)
        same = self.shown.get(key, [])
        if one not in same:
            return
        first = same[0] is one
        same.remove(one)
        if same and first:
            same[0].begin()
        elif not same:
            del self.shown[key]
            if not self.shown:
                self._reach(reached=False)

    def module_with(self, service: str) -> str:
        """The module of this mesh that has a service of this name; empty if there is none."""
        imports = self.agent.services.imports
        found = imports.shown(service)
        if found is None or (found.origin is not None and is_outside(found.origin)):
            return ""
        return imports.peer_name(found.peer)

    def _reach(self, *, reached: bool) -> None:
        """Hide, or show, what other gateways of this site bring from there: this gateway has its own way."""
        self.agent.bridge.topics.reached_here(self._instance, reached=reached)
        self.agent.services.reached_here(self._instance, reached=reached)


def _name_problem(source: ForeignSource) -> str:
    """Why a foreign source cannot be in a graph of ROS 1, or empty."""
    if problem := peer_name_problem(source.site):
        return f"site {source.site[:64]!r}: {problem}"
    for name in (foreign_origin(source).node, source.name):
        if not is_crossing_name(name):
            return f"{name[:64]!r} is not a global name of ROS, or too long"
    if source.kind is SourceKind.TOPIC and not is_crossing_type(source.type):
        return f"{source.type[:64]!r} is not a message type of ROS 1"
    return ""


class ProxiedSource(ABC):
    """A foreign source in the gateway's graph: what topics and services share.

    Args:
        source: The source.
        site: Its site, whose proxies it stands at.

    Attributes:
        refused: Why it is not in the graph; empty if it is.
    """

    def __init__(self, source: ForeignSource, site: ForeignSite) -> None:
        self.source = source
        self.refused = "another source of this node has its name here"
        self._site = site
        self._origin = foreign_origin(source)
        self._key = f"{source.kind.name} {source.name}"
        self._place = service_place(source.name, "") if source.kind is SourceKind.SERVICE else (source.name, "")
        self._offered = Source(self._place[0], site.proxies.name(self._origin.node))
        self._node: SlaveNode | None = None
        self._begun = False
        self._mismatch = ""
        self._closed = False

    def begin(self) -> None:
        """Put it into the graph, in a later turn of the loop."""
        self._begun = True
        self.refused = ""
        self._site.proxies.hold(self._origin.node, self._key, self._ready, self._left)

    @property
    def problem(self) -> str:
        """Why it is not in the graph, or not understood by its subscribers or clients; empty for nothing."""
        return self.refused or self._site.proxies.problems.get(self._origin.node, "") or self._mismatch

    def reconcile(self) -> None:
        """Register it if the core has lost it, or if its name has become free."""
        state, node = self._site.core.state(), self._node
        of_topic = self.source.kind is SourceKind.TOPIC
        names, uri = (
            (state.publishers, node and node.uri) if of_topic else (state.services, node and node.service_uri)
        )
        if node is not None and names.get(self.source.name, {}).get(node.name) != uri:
            self._register()

    def close(self) -> None:
        """Take it out of the graph in a later turn of the loop; what its users wait for ends now."""
        if not self._closed:
            self._closed = True
            self._withdraw()
            if self._begun:
                self._site.proxies.release(self._origin.node, self._key)
            self._site.hide(self)

    def _ready(self, node: SlaveNode) -> None:
        """Its proxy node is in the graph: show the source there."""
        self._node = node
        self._site.relay.shown(self._site.number, self._offered, (self._place[0], node.name), self._origin)
        self._attach(node)
        self._register()

    def _left(self, node: SlaveNode) -> None:
        """Take the source out of the graph: its proxy node leaves."""
        self._node = None
        self._detach(node)
        self._site.relay.gone(self._site.number, self._offered)

    def _call(self, method: str, node: SlaveNode, *args: str) -> None:
        """Register it with the core; what the core says against it is its problem."""
        code, status, _ = self._site.core.call(method, node.name, self.source.name, *args)
        self.refused = "" if code == 1 else f"the gateway's core does not accept it: {status}"
        if self.refused:
            _log.error("! %s of %s: %s [core-refuses]", self.source.name, node.name, self.refused)

    @abstractmethod
    def _withdraw(self) -> None:
        """End what subscribers or clients have of it."""

    @abstractmethod
    def _attach(self, node: SlaveNode) -> None: ...

    @abstractmethod
    def _register(self) -> None: ...

    @abstractmethod
    def _detach(self, node: SlaveNode) -> None: ...


class ProxiedTopic(ProxiedSource, PublicationEvents):
    """A foreign topic in the gateway's graph; until ``describe`` its subscribers wait.

    Args:
        source: The topic.
        site: Its site.
        on_demand: ``(wanted)``: a first subscriber has come, or the last one has left.
    """

    def __init__(self, source: ForeignSource, site: ForeignSite, on_demand: Callable[[bool], None]) -> None:
        super().__init__(source, site)
        self._on_demand = on_demand
        self._wanted = False
        self._publication = Publication(source.name, self._offered.node, events=self)
        site.show(self)

    def describe(self, description: TopicDescription) -> None:
        """Set type, md5 sum, definition and latching; subscribers of another definition are disconnected."""
        if self._publication.describe(description) and not self._closed:
            for delay in bridge_limits.CALL_BACK_DELAYS:
                asyncio.get_running_loop().call_later(delay, self._register)

    def publish(self, body: Buffer) -> int:
        """Send one message without its length; return the messages dropped for slow subscribers."""
        size = len(body)
        if size <= core_limits.CUT_THROUGH_BYTES:
            return self._publication.publish_framed(LENGTH.pack(size) + body)
        before = self._publication.dropped
        self._publication.begin(LENGTH.size + size)
        self._publication.extend(LENGTH.pack(size))
        self._publication.extend(body)
        return self._publication.dropped - before

    def forget_latched(self) -> None:
        """Drop the latched message: its publisher is gone."""
        self._publication.forget_latched()

    def first_subscriber(self) -> None:
        """Of ``PublicationEvents``."""
        self._demand(wanted=True)

    def last_subscriber(self) -> None:
        """Of ``PublicationEvents``."""
        self._demand(wanted=False)

    def mismatch(self, fields: Mapping[str, str], text: str) -> None:
        """Of ``PublicationEvents``."""
        self._mismatch = f"{printable(fields.get('callerid', ''))}: {text}"

    def _demand(self, *, wanted: bool) -> None:
        if wanted != self._wanted and not self._closed:
            self._wanted = wanted
            self._on_demand(wanted)

    def _withdraw(self) -> None:
        self._publication.withdraw()

    def _attach(self, node: SlaveNode) -> None:
        node.add_publication(self._publication)

    def _register(self) -> None:
        if self._node is not None:
            self._call("registerPublisher", self._node, self.source.type, self._node.uri)

    def _detach(self, node: SlaveNode) -> None:
        self._site.core.call("unregisterPublisher", node.name, self.source.name, node.uri)
        node.remove_publication(self.source.name)


class ProxiedService(ProxiedSource):
    """A foreign service in the gateway's graph; calls under way get an error once it is closed.

    A graph has one server of each service: while another node has its name, it waits, and ``problem`` says so.

    Args:
        source: The service.
        site: Its site.
        serve: Awaited with each request for its response.
        describe: Awaited for the service's type.
    """

    def __init__(
        self,
        source: ForeignSource,
        site: ForeignSite,
        serve: Callable[[bytes], Awaitable[bytes]],
        describe: Callable[[], Awaitable[ServiceDescription]],
    ) -> None:
        super().__init__(source, site)
        self._serve = serve
        self._calls = OwnedTasks()
        timeout = site.agent.bridge.context.services.timeout(source.name)
        self._endpoint = ServiceEndpoint(
            source.name,
            self._offered.node,
            self._called,
            describe,
            timeout=timeout,
            on_mismatch=self._mismatched,
        )
        site.show(self)

    def make_room(self) -> None:
        """Leave the name to a module's service, until that one has gone."""
        if self._node is not None and self._site.module_with(self.source.name):
            self._unregister(self._node)
            self._register()

    def _called(self, call: ServiceCall) -> None:
        task = self._calls.start(self._answer(call), f"call {self.source.name}")
        call.on_gone = lambda: task.cancel() and None

    async def _answer(self, call: ServiceCall) -> None:
        try:
            call.reply(True, await self._serve(bytes(call.request)))
        except RmpaError as error:
            call.fail(str(error))
        except Exception:
            call.fail(f"service [{self.source.name}]: the gateway failed at this call; its log says why")
            raise

    def _mismatched(self, _fields: Mapping[str, str], text: str) -> None:
        self._mismatch = text

    def _withdraw(self) -> None:
        self._endpoint.withdraw(f"service [{self.source.name}] of {self.source.site} has gone")
        self._calls.cancel()

    def _attach(self, node: SlaveNode) -> None:
        node.add_service(self._endpoint)

    def _register(self) -> None:
        node, name = self._node, self.source.name
        if node is None:
            return
        servers = self._site.core.state().services.get(name, {})
        if other := next((one for one in servers if one != node.name), "") or self._site.module_with(name):
            self.refused = f"{other} has a service of this name here"
        else:
            self._call("registerService", node, node.service_uri, node.uri)

    def _unregister(self, node: SlaveNode) -> None:
        self._site.core.call("unregisterService", node.name, self.source.name, node.service_uri)

    def _detach(self, node: SlaveNode) -> None:
        self._unregister(node)
        node.remove_service(self.source.name)

"""What passes between the gateway's graph and its neighbours: sources of the mesh, values of Zenoh, permissions.

What a neighbour of the gateway (other sites, ROS 2) carries between its graph and the gateway's own one.

The gateway is a peer of the mesh that relays. Its core has the proxies of the modules at its site, which are *mesh
sources*; a neighbour carries those out. What a neighbour brings in are *foreign sources*; they become proxies in the
same core, which the relay offers to the modules (``gateway.own_graph``).
"""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from typing import TYPE_CHECKING, Protocol

from rmpa.bridge.context import BridgeContext
from rmpa.bridge.messages import is_crossing_name, is_crossing_type
from rmpa.bridge.policy import OPEN_GATE, is_outside, service_place
from rmpa.bridge.topics.local import LocalSources
from rmpa.core.counters import logged_failure
from rmpa.core.identity import is_own
from rmpa.ros.master.parameters import RegistrationKind
from rmpa.runtime.loop import yielding_to_data
from rmpa.trust.permissions import refusal

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rmpa.agent.agent import Agent
    from rmpa.bridge.policy import PermissionGate, PolicyDecision
    from rmpa.config.peer_rules import Access
    from rmpa.config.settings import Settings
    from rmpa.ros.master.parameters import GraphChange
    from rmpa.trust.permissions import PermissionDecision


class SourceKind(StrEnum):
    """What a source is; the value is its chunk in the keys of sites."""

    TOPIC = "t"
    SERVICE = "s"


@dataclass(frozen=True, slots=True)
class MeshSource:
    """A topic of one publisher, or a service, that a module at this site has.

    Args:
        kind: What it is.
        module: The module's name.
        instance: The module's run, 32 hexadecimal digits.
        node: The node in the module's graph, ``/like/this``.
        name: The topic or service in the module's graph.
        type: ``package/Name``; ``*`` for a service whose server was not asked.
        here: The topic or service in the gateway's graph.
        proxy: The node in the gateway's graph.
    """

    kind: SourceKind
    module: str
    instance: str
    node: str
    name: str
    type: str
    here: str
    proxy: str


@dataclass(frozen=True, slots=True)
class ForeignSource:
    """A topic of one publisher, or a service, that a neighbour has.

    Args:
        kind: What it is.
        site: The site's name, or ``ros2``: its proxies are ``/rmpa/<site>/…``.
        module: The module at that site; empty where the neighbour has none.
        node: The node in the module's graph.
        name: The topic or service in the gateway's graph, after the rules for names.
        type: ``package/Name`` of ROS 1.
    """

    kind: SourceKind
    site: str
    module: str
    node: str
    name: str
    type: str


class Neighbour(Protocol):
    """One kind of neighbour, which the gateway starts and closes."""

    def start(self) -> None:
        """Begin, in the event loop: the graph and the session are there."""

    async def close(self) -> None:
        """Take back everything."""

    def report(self) -> dict[str, object]:
        """What ``rmpa site`` and the snapshot show of it, as JSON values."""


# Values of Zenoh that the neighbours and ``gateway.zenoh`` share. The library is imported only by the latter.


class ZenohPriority(IntEnum):
    """Zenoh's priorities; a lower number goes first."""

    REAL_TIME = 1
    INTERACTIVE_HIGH = 2
    INTERACTIVE_LOW = 3
    DATA_HIGH = 4
    DATA = 5
    DATA_LOW = 6
    BACKGROUND = 7


@dataclass(frozen=True, slots=True)
class ZenohQos:
    """The QoS of one publisher, and the bounds of its queue in this process.

    Args:
        reliable: Zenoh's reliability ``RELIABLE``; else ``BEST_EFFORT``.
        block: Congestion control ``BLOCK`` (it waits in a thread of its own); else ``DROP``.
        priority: Zenoh's priority.
        messages: Messages that wait at most; above it the oldest is dropped, and counted.
        bytes: Bytes that wait at most; one message always fits.
        cache: Samples that a later subscriber gets (an advanced publisher); 0: an ordinary publisher.
    """

    reliable: bool = True
    block: bool = True
    priority: ZenohPriority = ZenohPriority.DATA
    messages: int = 1000
    bytes: int = 64 * 1024 * 1024
    cache: int = 0


@dataclass(frozen=True, slots=True)
class ZenohSample:
    """One message that was received.

    Args:
        key: Its key.
        payload: Its bytes.
        attachment: Its attachment; empty if it has none.
    """

    key: str
    payload: bytes
    attachment: bytes


@dataclass(frozen=True, slots=True)
class ZenohReply:
    """One answer to ``get``.

    Args:
        key: The key that was answered; empty for an error.
        payload: The answer, or the error's text in UTF-8.
        attachment: Its attachment; empty if it has none.
        ok: Whether it is an answer and no error.
    """

    key: str
    payload: bytes
    attachment: bytes
    ok: bool


# What other sites may do here, by ``[[permission]]``: the rules of the module that the gateway is.
#
# Zenoh proves which gateway is connected, but not which site or module a message is of: so they are judged as
# ``PermissionGate.judge_site`` says.


class SitePermissions:
    """Decides what sites and their modules may do here.

    Args:
        gate: Judges modules, counts what is refused, and logs it once; without trust it lets everything pass.
    """

    def __init__(self, gate: PermissionGate = OPEN_GATE) -> None:
        self._gate = gate

    def judge(self, access: Access, site: str, module: str, name: str) -> PermissionDecision:
        """Decide whether a module at a site may do something.

        Args:
            access: What it would do.
            site: The site's name.
            module: The module that the message, query or token names; empty where it names none.
            name: The topic, service or parameter, by its name here.
        """
        return self._gate.judge_site(access, site, (module,) if module else (), name)

    def admits(self, access: Access, site: str, module: str, name: str) -> bool:
        """Decide as ``judge`` does; a refusal is counted (``permission.publish`` and so on), and logged once."""
        decision = self.judge(access, site, module, name)
        if not decision.allowed:
            self._gate.refused(access, site, name, decision)
        return decision.allowed

    def why_not(
        self, access: Access, site: str, name: str, modules: Iterable[str] = (), told: str | None = None
    ) -> str:
        """What another site is told if it may not do something, which is counted here; empty if it may.

        Args:
            access: What it would do.
            site: The site's name.
            name: The topic, service or parameter, by its name here.
            modules: Those of its modules that ask.
            told: The name that it asked for, if ``name`` was found in it and may be a secret.
        """
        decision = self._gate.judge_site(access, site, modules, name)
        if decision.allowed:
            return ""
        self._gate.refused(access, site, name, decision)
        return refusal(access, site, name if told is None else told)


# The sources of the modules at this site, as the gateway's core and relay know them.


_log = logging.getLogger(__name__)

SourceKey = tuple[SourceKind, str, str]
"""Kind, name here, and node here."""
OnChange = "Callable[[MeshSource, bool], None]"

_ANY = "*"


class MeshSources:
    """Follows the gateway's graph, and reports which sources of the mesh there are.

    A source counts if the gateway's own policy lets it cross. What a neighbour has brought here, through this gateway
    or another one of this site, does not count.

    Args:
        agent: The gateway's agent.
        settings: Its settings.
    """

    def __init__(self, agent: Agent, settings: Settings) -> None:
        self._name = settings.name
        self._core = agent.core
        self._relay = agent.bridge.relay
        self._topics = agent.bridge.topics
        self._services = agent.services
        self._local = LocalSources(agent.core, agent.bridge.relay)
        self._bridge = agent.bridge
        self.known: dict[SourceKey, MeshSource] = {}
        """The sources that were reported."""
        self._by_name: dict[tuple[SourceKind, str], dict[SourceKey, MeshSource]] = {}
        self._watchers: list[Callable[[MeshSource, bool], None]] = []
        self._changed: dict[tuple[SourceKind, str], None] = {}
        self._soon: asyncio.Handle | None = None
        self._begun = False

    def watch(self, on_change: Callable[[MeshSource, bool], None]) -> None:
        """Report each source that is there, then each change."""
        self._watchers.append(on_change)
        for source in list(self.known.values()):
            on_change(source, True)

    def unwatch(self, kept: Callable[[MeshSource, bool], None]) -> None:
        """Report to one watcher alone."""
        self._watchers = [kept]

    def begin(self) -> None:
        """Begin to report; the agent's place in the network is known."""
        self._begun = True
        self.look_at_all()

    def close(self) -> None:
        """Report nothing more."""
        self._begun = False
        self._watchers.clear()
        if self._soon is not None:
            self._soon.cancel()
            self._soon = None

    def changed(self, change: GraphChange) -> None:
        """Have a name examined that was registered or unregistered."""
        self._local.changed(change)
        if change.kind is RegistrationKind.PUBLISHER:
            self._look((SourceKind.TOPIC, change.name))
        elif change.kind is RegistrationKind.SERVICE:
            self._look((SourceKind.SERVICE, change.name))

    def look_at_all(self) -> None:
        """Have every name examined."""
        state = self._core.state()
        for names in (
            [(SourceKind.TOPIC, topic) for topic in state.publishers],
            [(SourceKind.SERVICE, service) for service in state.services],
            list(self._by_name),
        ):
            for name in names:
                self._look(name)

    def _look(self, name: tuple[SourceKind, str]) -> None:
        self._changed[name] = None
        if self._begun and self._soon is None:
            self._soon = asyncio.get_running_loop().call_soon(self._examine)

    def _examine(self) -> None:
        self._soon = None
        changed, self._changed = self._changed, {}
        for kind, name in yielding_to_data(list(changed), every=16):
            found = self._topic(name) if kind is SourceKind.TOPIC else self._service(name)
            self._replace((kind, name), {(kind, name, source.proxy): source for source in found})

    def _replace(self, name: tuple[SourceKind, str], found: dict[SourceKey, MeshSource]) -> None:
        before = self._by_name.pop(name, {})
        if found:
            self._by_name[name] = found
        for key, source in before.items():
            if found.get(key) != source:
                del self.known[key]
                self._tell(source, there=False)
        for key, source in found.items():
            if before.get(key) != source:
                self.known[key] = source
                self._tell(source, there=True)

    def _tell(self, source: MeshSource, *, there: bool) -> None:
        for on_change in tuple(self._watchers):
            with logged_failure(_log, "a neighbour failed at %s; the others are told", source):
                on_change(source, there)

    def _topic(self, topic: str) -> Iterable[MeshSource]:
        for node, local in self._local.of(topic).items():
            if self._may_cross(topic, local.type, node):
                yield MeshSource(
                    SourceKind.TOPIC, self._name, self._relay.instance, node, topic, local.type, topic, node
                )
        for proxy, local in self._local.relayed(topic).items():
            shown = self._relay.source((topic, proxy))
            if local.origin is None or shown is None or is_outside(local.origin):
                continue
            if self._may_cross(topic, local.type, local.origin.node):
                origin, wire = local.origin, shown[1].topic
                yield MeshSource(
                    SourceKind.TOPIC, origin.name, origin.instance, origin.node, wire, local.type, topic, proxy
                )

    def _may_cross(self, topic: str, type_name: str, node: str) -> bool:
        known = is_crossing_name(topic) and is_crossing_name(node) and is_crossing_type(type_name)
        return known and self._bridge.context.policy.judge(topic, type_name, node).allowed

    def _service(self, service: str) -> Iterable[MeshSource]:
        for node in self._core.state().services.get(service, {}):
            if not is_own(node):
                if is_crossing_name(service) and self._bridge.context.services.judge(service, node).allowed:
                    yield MeshSource(
                        SourceKind.SERVICE, self._name, self._relay.instance, node, service, _ANY, service, node
                    )
                continue
            origin, shown = (self._relay.origin(place := service_place(service, node)), self._relay.source(place))
            if origin is None or shown is None or is_outside(origin):
                continue
            if is_crossing_name(service) and self._bridge.context.services.judge(service, origin.node).allowed:
                remote = self._services.imports.get(shown[0], service)
                wire = remote.wire if remote is not None else service
                yield MeshSource(
                    SourceKind.SERVICE, origin.name, origin.instance, origin.node, wire, _ANY, service, node
                )


# The gateway's own policy of what crosses, by its ``[bridge]`` and ``[services]``, for topics and services alike.


class OwnPolicy:
    """Judges what comes in from a neighbour or goes out to it, as an agent judges what comes from a peer.

    Args:
        settings: The gateway's.
    """

    def __init__(self, settings: Settings) -> None:
        context = BridgeContext.of(settings)
        self._topics, self._services = context.policy, context.services

    def judge(self, kind: SourceKind, name: str, type_name: str, node: str) -> PolicyDecision:
        """Decide whether a source may cross; ``type_name`` counts for topics alone."""
        if kind is SourceKind.SERVICE:
            return self._services.judge(name, node)
        return self._topics.judge(name, type_name, node)

    def timeout(self, service: str) -> float:
        """Seconds that a call of a service may take (``[[service]]``)."""
        return self._services.timeout(service)

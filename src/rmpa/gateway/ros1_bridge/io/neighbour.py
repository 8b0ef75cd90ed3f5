"""The neighbour zenoh-bridge-ros1: topics and services of its robots here, and those of the modules there."""

from __future__ import annotations

import asyncio
import logging
import re
from typing import TYPE_CHECKING, Final

from rmpa.config.permission_rules import Access
from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway.neighbour import ForeignSource, MeshSource, SourceKind
from rmpa.gateway.ros1_bridge.io.announcer import OWN_DISCOVERY, BridgeAnnouncer
from rmpa.gateway.ros1_bridge.io.services import BridgedServiceExport, BridgedServiceImport
from rmpa.gateway.ros1_bridge.io.topics import BridgedExport, BridgedImport
from rmpa.gateway.ros1_bridge.keys import DISCOVERY, PRESENCE_PERIOD, BridgedKind, BridgedTopic, parse_presence
from rmpa.gateway.ros1_bridge.presence import PresenceTable

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.gateway.neighbour import OwnGraph
    from rmpa.gateway.sites.rules import CrossingRules
    from rmpa.gateway.zenoh_api import Declared, ZenohSample, ZenohSession

_log = logging.getLogger(__name__)
SITE: Final = "ros1_bridge"
"""The name of this neighbour in rules, and in the names of its proxies."""
_NODE: Final = "zenoh_bridge_ros1"
_SHOWN: Final = {BridgedKind.PUBLISHER: SourceKind.TOPIC, BridgedKind.SERVICE: SourceKind.SERVICE}


class Ros1BridgeNeighbour:
    """Speaks the format of zenoh-bridge-ros1; what came from a bridge is not offered to bridges again.

    Args:
        graph: The gateway's graph.
        session: The Zenoh session.
        rules: What may cross, and its name here: those that are about this neighbour.
        namespace: The bridge namespace.
        timeout: Seconds that a call may take, by the service's name here.
    """

    def __init__(
        self,
        graph: OwnGraph,
        session: ZenohSession,
        rules: CrossingRules,
        namespace: str,
        timeout: Callable[[str], float],
    ) -> None:
        self._graph = graph
        self._session = session
        self._rules = rules
        self._namespace = namespace
        self._timeout = timeout
        self._announcer = BridgeAnnouncer(session)
        self._present = PresenceTable()
        self._exports: dict[MeshSource, BridgedExport | BridgedServiceExport] = {}
        self._imports: dict[tuple[BridgedKind, BridgedTopic], BridgedImport | BridgedServiceImport] = {}
        self._shown: set[tuple[SourceKind, str, str]] = set()
        self._refused: dict[tuple[str, str], str] = {}
        self._malformed = 0
        self._listening: Declared | None = None
        self._beats: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Begin to listen and to announce."""
        key = f"{DISCOVERY}/*/*/*/*/{self._namespace}/*/**"
        self._listening = self._session.subscribe(key, self._presence)
        self._graph.watch(self._changed)
        self._beats = asyncio.get_running_loop().create_task(self._beat(), name="presence for zenoh-bridge-ros1")

    async def close(self) -> None:
        """Take back everything."""
        if self._beats is not None:
            self._beats.cancel()
            await asyncio.wait([self._beats])
            self._beats = None
        if self._listening is not None:
            self._listening.close()
            self._listening = None
        for each in (*self._exports.values(), *self._imports.values()):
            each.close()
        self._exports.clear()
        self._imports.clear()
        self._shown.clear()
        self._announcer.close()

    def report(self) -> dict[str, object]:
        """What ``rmpa site`` and the snapshot show of it, as JSON values."""
        entries = (*self._exports.values(), *self._imports.values())
        return {
            "namespace": self._namespace,
            "topics": [each.report() for each in entries if isinstance(each, BridgedExport | BridgedImport)],
            "services": [each.report() for each in entries if not isinstance(each, BridgedExport | BridgedImport)],
            "refused": [
                {"direction": direction, "name": name, "rule": why}
                for (direction, name), why in self._refused.items()
            ],
            "malformed": self._malformed,
            "ignored": self._present.ignored,
        }

    # --- out ------------------------------------------------------------------------------------------------------

    def _changed(self, source: MeshSource, there: bool) -> None:
        if not there or self._listening is None:
            known = self._exports.pop(source, None)
            if known is not None:
                known.close()
            self._refused.pop(("out", source.here), None)
            return
        decision = self._rules.outgoing(source.kind, source.module, source.name, source.type, source.node)
        if decision.allowed:
            decision = self._rules.outgoing_to(SITE, source.module, source.name)
        access = Access.SUBSCRIBE if source.kind is SourceKind.TOPIC else Access.CALL
        refusal = decision.why
        if decision.allowed:
            refusal = self._rules.refusal(SITE, source.module, source.name, access)
        if refusal:
            self._refused["out", source.here] = refusal
            return
        export: BridgedExport | BridgedServiceExport
        if source.kind is SourceKind.TOPIC:
            export = BridgedExport(self._graph, self._session, self._announcer, source, decision, self._namespace)
        else:
            export = BridgedServiceExport(
                self._graph,
                self._session,
                self._announcer,
                source,
                self._namespace,
                self._timeout(source.here),
                decision.why,
            )
        self._exports[source] = export
        export.start()

    # --- in -------------------------------------------------------------------------------------------------------

    def _presence(self, sample: ZenohSample) -> None:
        if sample.key.startswith(f"{DISCOVERY}/{OWN_DISCOVERY}/"):
            return
        try:
            kind, topic = parse_presence(sample.key)
        except RemoteProtocolError as error:
            self._malformed += 1
            if self._malformed == 1:
                _log.warning("! zenoh-bridge-ros1: %s", error)
            return
        now = asyncio.get_running_loop().time()
        if kind in _SHOWN and self._present.seen((kind, topic), now):
            self._show(kind, topic)

    def _show(self, kind: BridgedKind, topic: BridgedTopic) -> None:
        node = f"/{_NODE}" if topic.namespace == "*" else f"/{_base_name(topic.namespace)}/{_NODE}"
        decision = self._rules.incoming(_SHOWN[kind], SITE, SITE, topic.name, topic.type, node)
        why = decision.why if not decision.allowed else ""
        if not why and "*" in (topic.type, topic.md5):
            why = "the bridge does not know its type"
        source = ForeignSource(_SHOWN[kind], SITE, "", node, decision.name, topic.type)
        if not why and _place(source) in self._shown:
            why = "bridges have it with another type too, which was seen first"
        if why:
            self._refused["in", topic.name] = why
            return
        made: BridgedImport | BridgedServiceImport
        if kind is BridgedKind.PUBLISHER:
            made = BridgedImport(self._graph, self._session, self._announcer, topic, source, decision.why)
        else:
            timeout = self._timeout(source.name)
            made = BridgedServiceImport(
                self._graph, self._session, self._announcer, topic, source, timeout, decision.why
            )
        self._imports[kind, topic] = made
        self._shown.add(_place(source))

    def _hide(self, kind: BridgedKind, topic: BridgedTopic) -> None:
        self._refused.pop(("in", topic.name), None)
        made = self._imports.pop((kind, topic), None)
        if made is not None:
            made.close()
            self._shown.discard(_place(made.source_here))

    async def _beat(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            await asyncio.sleep(PRESENCE_PERIOD)
            self._announcer.beat()
            for kind, topic in self._present.expire(loop.time(), self._announcer.announced):
                self._hide(kind, topic)


def _place(source: ForeignSource) -> tuple[SourceKind, str, str]:
    """What only one type can have here."""
    return source.kind, source.node, source.name


def _base_name(namespace: str) -> str:
    """A name of ROS for a bridge namespace, which may have other characters."""
    name = re.sub(r"\W", "_", namespace, flags=re.ASCII)
    return name if name[:1].isalpha() else f"ns_{name}"

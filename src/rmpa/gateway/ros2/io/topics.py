"""The topics of modules in ROS 2's graph, and ROS 2's topics in the gateway's graph."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway import limits
from rmpa.gateway.neighbour import SourceKind
from rmpa.gateway.ros2.conversion import NoConversion
from rmpa.gateway.ros2.graph import valid_name
from rmpa.gateway.ros2.io.topic_export import Ros2TopicExport
from rmpa.gateway.ros2.io.topic_import import Ros2TopicImport
from rmpa.gateway.ros2.mismatch import mismatch
from rmpa.gateway.ros2.pairs import Ros2Pairs
from rmpa.gateway.ros2.tokens import EntityKind
from rmpa.ros.types.find import find_message_type

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.gateway.neighbour import MeshSource
    from rmpa.gateway.ros2.io.part import Ros2Context
    from rmpa.gateway.ros2.tokens import Ros2Endpoint
    from rmpa.ros.types.messages import MessageType

_TOPIC_ENDS: Final = (EntityKind.PUBLISHER, EntityKind.SUBSCRIPTION)


class Ros2Topics:
    """Joins topics both ways.

    Args:
        context: What the parts share.
        find: Finds a ROS 1 type on this machine by its name; raises ``RmpaError`` if there is none.
    """

    def __init__(self, context: Ros2Context, find: Callable[[str], MessageType] = find_message_type) -> None:
        self._context = context
        self._pairs = Ros2Pairs(context.types, context.mapping, find)
        self._exports: dict[tuple[str, str], Ros2TopicExport] = {}
        self._exports_named: dict[str, dict[tuple[str, str], Ros2TopicExport]] = {}
        self._imports: dict[str, Ros2TopicImport] = {}
        self._refused: dict[str, str] = {}
        self._looks = asyncio.Semaphore(limits.LATCH_LOOKS_AT_ONCE)

    def close(self) -> None:
        """Take back all topics of both sides."""
        for exported in self._exports.values():
            exported.close()
        for imported in self._imports.values():
            imported.close()
        self._exports.clear()
        self._exports_named.clear()
        self._imports.clear()

    def report(self) -> dict[str, object]:
        """The topics that cross, one row for each source, and those that do not cross, with the reason."""
        rows = [each.report() for each in self._exports.values()]
        for imported in self._imports.values():
            rows += imported.report()
        return {"topics": rows, "topics_refused": dict(self._refused)}

    # --- from the mesh to ROS 2 ----------------------------------------------------------------------------------

    def mesh_source(self, source: MeshSource, *, there: bool) -> bool:
        """Put a topic of a module into ROS 2's graph, or take it out."""
        context = self._context
        if source.kind is not SourceKind.TOPIC:
            return False
        key = source.here, source.proxy
        if (old := self._exports.pop(key, None)) is not None:
            self._exports_named[source.here].pop(key, None)
            if not self._exports_named[source.here]:
                del self._exports_named[source.here]
            old.close()
        refused = f"{source.here} of {source.proxy}"
        self._refused.pop(refused, None)
        if not there:
            return True
        decision = context.crossing.outgoing(source.module, source.name)
        if not valid_name(source.here) or not valid_name(source.proxy):
            self._refuse(refused, "ROS 2 allows no such name: a part of it begins with a digit, or it is too long")
        elif not decision.allowed:
            self._refuse(refused, decision.why)
        else:
            export = self._exports[key] = Ros2TopicExport(
                context, self._pairs, source, decision, self._looks, self._declared
            )
            self._exports_named.setdefault(source.here, {})[key] = export
            export.start()
        return True

    def _declared(self, export: Ros2TopicExport) -> None:
        """A topic has another type or hash now: compare it with what ROS 2 has under its name."""
        for other in list(self._context.ros2.at(export.source.here, *_TOPIC_ENDS)):
            self._compare(export, other)
        self._retry_imports()

    def _retry_imports(self) -> None:
        """A type was learnt: topics of ROS 2 whose fields were not known may have it."""
        for imported in self._imports.values():
            if imported.converts:
                continue
            try:
                found = self._pairs.incoming(imported.type, imported.type_hash)
            except NoConversion:
                continue
            if found is not None:
                imported.converted(found, "")

    def _compare(self, export: Ros2TopicExport, other: Ros2Endpoint) -> None:
        if export.endpoint is not None:
            text = mismatch(export.endpoint.endpoint, other, self._context.types.distribution)
            if text:
                self._context.say(f"{other.name} of {other.node.name}", text)

    # --- from ROS 2 to the mesh ----------------------------------------------------------------------------------

    def endpoint(self, endpoint: Ros2Endpoint, *, there: bool) -> bool:
        """Show a publisher of ROS 2 in the gateway's graph, or take it out; compare it with what is here."""
        if endpoint.kind not in _TOPIC_ENDS:
            return False
        if not there:
            self._context.say(f"{endpoint.name} of {endpoint.node.name}", "")
        for export in self._exports_named.get(endpoint.name, {}).values() if there else ():
            self._compare(export, endpoint)
        if endpoint.kind is EntityKind.PUBLISHER and not _hidden(endpoint.name):
            (self._publisher_there if there else self._publisher_gone)(endpoint)
        return True

    def _publisher_there(self, endpoint: Ros2Endpoint) -> None:
        context, pairs = self._context, self._pairs
        key = endpoint.key()
        imported = self._imports.get(key)
        if imported is None:
            ros1_type = pairs.ros1_name(endpoint.type)
            decision = context.crossing.incoming(SourceKind.TOPIC, endpoint.name, ros1_type, endpoint.node.name)
            if not decision.allowed:
                self._refuse(f"{endpoint.name} of {endpoint.node.name}", decision.why)
                return
            imported = self._imports[key] = Ros2TopicImport(
                context, endpoint, ros1_type, decision, lambda: self._drop_unused(key)
            )
            imported.add(endpoint)
            self._find_conversion(imported, endpoint)
        else:
            imported.add(endpoint)
            if imported.problem:  # this node may be able to describe the type
                self._find_conversion(imported, endpoint)

    def _publisher_gone(self, endpoint: Ros2Endpoint) -> None:
        self._refused.pop(f"{endpoint.name} of {endpoint.node.name}", None)
        key = endpoint.key()
        if (imported := self._imports.get(key)) is not None:
            imported.remove(endpoint)
            self._drop_unused(key)

    def _drop_unused(self, key: str) -> None:
        """A topic without publishers goes; one that was wanted stays for a while, as its publisher may restart."""
        imported = self._imports.get(key)
        if imported is not None and not imported.publishers and not imported.lingers:
            del self._imports[key]
            imported.close()

    def _find_conversion(self, imported: Ros2TopicImport, endpoint: Ros2Endpoint) -> None:
        context, pairs = self._context, self._pairs
        try:
            conversion = pairs.incoming(endpoint.type, endpoint.type_hash)
        except NoConversion as error:
            imported.converted(None, str(error))
            return
        if conversion is not None:
            imported.converted(conversion, "")
        else:
            context.spawn(self._ask_type(imported, endpoint))

    async def _ask_type(self, imported: Ros2TopicImport, endpoint: Ros2Endpoint) -> None:
        """Ask the publisher's node for the fields of its type."""
        context, pairs = self._context, self._pairs
        try:
            pairs.described(endpoint.type, endpoint.type_hash, await context.asker.learn(of=endpoint))
            imported.converted(pairs.incoming(endpoint.type, endpoint.type_hash), "")
        except (NoConversion, RemoteProtocolError) as error:
            if not imported.converts:
                imported.converted(None, str(error))
            return
        for export in self._exports.values():
            export.retry()

    def _refuse(self, what: str, why: str) -> None:
        if len(self._refused) >= limits.ROS2_PROBLEMS_MAX:
            del self._refused[next(iter(self._refused))]
        self._refused[what] = why


def _hidden(name: str) -> bool:
    """Whether ROS 2's tools hide a topic: a part of its name begins with ``_``, as those of actions."""
    return "/_" in name

"""Topics of modules in ROS 2's graph.

One topic of one publisher of the mesh, as that of a node of ROS 2.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RemoteProtocolError, RmpaError
from rmpa.gateway import limits
from rmpa.gateway.neighbour import SourceKind
from rmpa.gateway.ros2.conversion import Conversion, ConversionError, NoConversion
from rmpa.gateway.ros2.format import EntityKind, Ros2Attachment, ros2_qos, zenoh_qos
from rmpa.gateway.ros2.graph import mismatch, valid_name
from rmpa.gateway.ros2.pairs import Ros2Pairs
from rmpa.gateway.ros2.topic_import import Ros2TopicImport
from rmpa.gateway.sites.exported_topic import TopicLimits
from rmpa.ros.types.find import find_message_type, type_of_header

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.gateway.foreign import TopicTap
    from rmpa.gateway.neighbour import MeshSource
    from rmpa.gateway.ros2.format import Ros2Endpoint
    from rmpa.gateway.ros2.graph import OwnEndpoint
    from rmpa.gateway.ros2.services import Ros2Context
    from rmpa.gateway.sites.catalogue import CrossingDecision
    from rmpa.gateway.zenoh.threads import QueuedPublisher
    from rmpa.ros.types.messages import MessageType
    from rmpa.ros.wire.tcpros import TopicDescription

_STATIC_TF: Final = "/tf_static"
"""Its publishers latch, in ROS 1 and ROS 2 (tf2_ros)."""
_STREAMS: Final = frozenset(
    (
        "sensor_msgs/Image",
        "sensor_msgs/CompressedImage",
        "sensor_msgs/PointCloud",
        "sensor_msgs/PointCloud2",
        "sensor_msgs/LaserScan",
        "stereo_msgs/DisparityImage",
    )
)
"""Types of streams: their publishers are not asked whether they latch, since a driver may start by being asked."""


class Ros2TopicExport:
    """Declares the topic in ROS 2's graph, and sends its messages while a ROS 2 node subscribes.

    A type that ROS 2's distribution does not have is learnt first from the publisher's header: its hash is part of
    the key. Whether a topic is latched only its publisher's header tells too, so each is asked once, a while after it
    appeared; those of images, scans and clouds are not, for a driver may start by that. A latched one becomes
    transient local, and stays subscribed to once it was wanted, so that what is kept for late subscribers is the last
    message.

    Args:
        context: What the parts share.
        pairs: The pairs of types.
        source: The topic.
        decision: The rule that lets it cross.
        looks: Bounds how many publishers are asked at once whether they latch.
        on_declared: Called with this once it has another type or hash in ROS 2's graph.
    """

    def __init__(
        self,
        context: Ros2Context,
        pairs: Ros2Pairs,
        source: MeshSource,
        decision: CrossingDecision,
        looks: asyncio.Semaphore,
        on_declared: Callable[[Ros2TopicExport], None],
    ) -> None:
        self._on_declared = on_declared
        self._context = context
        self._pairs = pairs
        self.source: Final = source
        self._why = decision.why
        self._limit = TopicLimits(decision.rate, decision.size)
        self._latching = source.name == _STATIC_TF or (
            source.name.endswith("/descriptor") and source.type == "std_msgs/String"  # of a Smart Resource
        )
        self._looks = looks
        self._was_described = asyncio.Event()
        self._tap: TopicTap | None = None
        self._opening = False
        self._publisher: QueuedPublisher | None = None
        self._endpoint: OwnEndpoint | None = None
        self._conversion: Conversion | None = None
        self._wanted = self._was_wanted = False
        self._closed = False
        self._sequence = 0
        self._sent_before = 0
        self._dropped_before = 0
        self._failed = 0
        self.problem = ""
        """Why its messages do not reach ROS 2; empty for nothing."""

    @property
    def endpoint(self) -> OwnEndpoint | None:
        """The publisher in ROS 2's graph; ``None`` while its type is not known."""
        return self._endpoint

    def start(self) -> None:
        """Declare it, or ask its publisher for its type first."""
        try:
            found = self._pairs.ros2_type(self.source.type)
        except NoConversion as error:
            self._fail(str(error))
            return
        if found is None:
            self._open_tap()
        else:
            self._declare(*found)
            if self._endpoint is not None and not self._endpoint.endpoint.qos.latched:
                self._context.spawn(self._look())

    def retry(self) -> None:
        """Types were learnt: try again if its own was missing."""
        if self._endpoint is None and self._tap is None and not self._closed:
            self.start()

    def close(self) -> None:
        """Take it out of ROS 2's graph."""
        self._closed = True
        self._close_tap()
        self._withdraw()
        self._context.say(self._subject, "")

    def report(self) -> dict[str, object]:
        """Its state, as JSON values."""
        publisher = self._publisher
        endpoint = None if self._endpoint is None else self._endpoint.endpoint
        return {
            "direction": "out",
            "topic": self.source.name,
            "here": self.source.here,
            "module": self.source.module,
            "node": self.source.node,
            "type": self.source.type,
            "ros2_type": "" if endpoint is None else endpoint.type,
            "latched": endpoint is not None and endpoint.qos.latched,
            "wanted": self._wanted,
            "rule": self._why,
            "sent": self._sent_before + (0 if publisher is None else publisher.sent),
            "dropped": self._dropped_before + (0 if publisher is None else publisher.dropped),
            "limited": self._limit.dropped,
            "waiting": 0 if publisher is None else publisher.waiting,
            "unconverted": self._failed,
            "problem": self.problem,
        }

    # --- in ROS 2's graph ----------------------------------------------------------------------------------------

    def _declare(self, type_name: str, type_hash: str) -> None:
        """Declare it, or declare it anew with another type or QoS; messages that wait are sent before."""
        context, source = self._context, self.source
        contract = context.contracts.of(source.name, source.type)
        qos = ros2_qos(context.contracts, source.name, source.type, latching=self._latching)
        old_endpoint, old_publisher = self._endpoint, self._publisher
        self._endpoint = context.nodes.declare(
            source.proxy, EntityKind.PUBLISHER, source.here, type_name, type_hash, qos
        )
        publisher: list[QueuedPublisher] = []

        def matching(there: bool) -> None:
            if not publisher or publisher[0] is self._publisher:
                self._matching(there=there)

        self._publisher = context.session.publisher(self._endpoint.endpoint.key(), zenoh_qos(contract, qos), matching)
        publisher.append(self._publisher)
        self._sequence = 0
        self._drop(old_endpoint, old_publisher)
        self._on_declared(self)

    def _withdraw(self) -> None:
        endpoint, publisher = self._endpoint, self._publisher
        self._endpoint, self._publisher = None, None
        self._drop(endpoint, publisher)

    def _drop(self, endpoint: OwnEndpoint | None, publisher: QueuedPublisher | None) -> None:
        if endpoint is not None:
            endpoint.close()
        if publisher is not None:
            self._sent_before += publisher.sent + publisher.waiting
            self._dropped_before += publisher.dropped
            publisher.close()

    def _matching(self, *, there: bool) -> None:
        """Zenoh's matching tells of demand, not the tokens of subscriptions: what is sent before it is lost."""
        if self._closed or self._endpoint is None:
            return
        self._wanted = there
        if there:
            self._was_wanted = True
            self._open_tap()
        elif not self._keeps:
            self._close_tap()

    # --- in the mesh ---------------------------------------------------------------------------------------------

    @property
    def _keeps(self) -> bool:
        """Whether its messages are kept for late subscribers, once one has come."""
        return self._was_wanted and self._endpoint is not None and self._endpoint.endpoint.qos.latched

    def _open_tap(self) -> None:
        if self._tap is None and not self._opening:
            self._opening = True
            self._tap = self._context.graph.tap(self.source, self._message, self._described, self._lost)
            self._opening = False

    async def _look(self) -> None:
        """Ask the publisher once for its header, unless a subscriber has it asked before."""
        if self.source.type in _STREAMS:
            return
        await asyncio.sleep(limits.LATCH_LOOK_AFTER)
        async with self._looks:
            if self._closed or self._was_described.is_set():
                return
            self._open_tap()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(limits.LATCH_LOOK_TIMEOUT):
                    await self._was_described.wait()
        if not self._closed:
            self._close_unwanted()

    def _close_tap(self) -> None:
        tap, self._tap = self._tap, None
        if tap is not None:
            tap.close()

    def _close_unwanted(self) -> None:
        """Disconnect if nothing is wanted, or nothing can be done with it. Not within the tap's own callback."""
        if self._endpoint is None or not (self._wanted or self._keeps):
            self._close_tap()

    def _lost(self, reason: str) -> None:
        self._conversion = None
        self.problem = f"the publisher in the mesh: {reason}"

    def _described(self, description: TopicDescription) -> None:
        self._was_described.set()
        fields = {
            "type": description.type,
            "md5sum": description.md5sum,
            "message_definition": description.definition,
        }
        try:
            kind = type_of_header(fields)
            found = self._pairs.learn(kind)
            self._conversion = self._pairs.outgoing(kind)
        except (NoConversion, RmpaError) as error:
            self._conversion = None
            self._fail(str(error))
            return
        self.problem = ""
        self._context.say(self._subject, "")
        known = self._endpoint
        changed = known is None or (known.endpoint.type, known.endpoint.type_hash) != found
        if changed or (description.latching and not self._latching):
            self._latching = self._latching or description.latching
            self._declare(*found)
        asyncio.get_running_loop().call_soon(self._close_unwanted)  # it may have been asked for its type only

    def _message(self, body: memoryview) -> None:
        publisher, conversion, endpoint = self._publisher, self._conversion, self._endpoint
        if publisher is None or conversion is None or endpoint is None:
            return
        if not self._limit.admit(time.monotonic(), len(body)):
            self._limit.dropped += 1
            return
        try:
            payload = conversion.to_ros2(body)
        except ConversionError as error:
            self._failed += 1
            if self._failed == 1:
                self._context.say(self._subject, str(error))
            return
        self._sequence += 1
        publisher.put(payload, Ros2Attachment(self._sequence, time.time_ns(), endpoint.gid).serialize())

    @property
    def _subject(self) -> str:
        return f"{self.source.here} of {self.source.proxy}"

    def _fail(self, text: str) -> None:
        """No ROS 2 node can get it: it is not in ROS 2's graph either, but told."""
        self.problem = text
        self._context.say(self._subject, text)
        self._withdraw()
        asyncio.get_running_loop().call_soon(self._close_unwanted)


# The topics of modules in ROS 2's graph, and ROS 2's topics in the gateway's graph.


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

"""Topics between modules and ROS 2: exports in ROS 2's graph, and ROS 2's topics in the gateway's graph."""

from __future__ import annotations

import asyncio
import contextlib
import struct
import time
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RemoteProtocolError, RmpaError
from rmpa.gateway import limits
from rmpa.gateway.ros2.conversion import Conversion, ConversionError, NoConversion
from rmpa.gateway.ros2.format import (
    DEFAULT_DEPTH,
    GID_BYTES,
    EntityKind,
    Ros2Attachment,
    Ros2Durability,
    Ros2Qos,
    Ros2Reliability,
    gid_of,
    ros2_qos,
    zenoh_qos,
)
from rmpa.gateway.ros2.graph import SITE, OwnEndpoint, mismatch, valid_name
from rmpa.gateway.ros2.types import Ros2Sequences
from rmpa.gateway.rules import CrossingDecision, ForeignSource, MeshSource, SourceKind
from rmpa.gateway.topics import ExportedTopic, TopicLimits
from rmpa.gateway.zenoh.threads import BoundedQueue, ZenohQos, ZenohSample
from rmpa.ros.types.find import type_of_header
from rmpa.ros.wire.tcpros import Buffer, TopicDescription
from rmpa.runtime.loop import Delay

if TYPE_CHECKING:
    from rmpa.gateway.foreign import ProxiedTopic
    from rmpa.gateway.ros2.format import Ros2Endpoint
    from rmpa.gateway.ros2.services import Ros2Context
    from rmpa.ros.types.messages import MessageType

# Seconds for a publisher's answer whether it is latched.
_LATCH_LOOK_TIMEOUT: Final = 10.0
# Publishers that are asked so at once: each opens a route in the mesh for a moment.
_LATCH_LOOKS_AT_ONCE: Final = 2
# Seconds for which a topic of ROS 2 that is wanted stays subscribed after a publisher came or went: messages of a
# publisher that restarts are held until nodes have subscribed to it anew, which takes a module some 0.1 s.
_ROS2_LINGER: Final = 5.0
# Messages of one topic of ROS 2 that are held so; the oldest are dropped, and counted as unheard.
_ROS2_EARLY_MESSAGES: Final = 1000
# Bytes of these; one message always fits.
_ROS2_EARLY_BYTES: Final = 16 * 1024 * 1024

# Messages that ROS 2 keeps for the gateway, but of images and the like: as many as a topic of ROS 1 may have waiting.
_DEPTH: Final = 1000
# Messages that wait for a slow node of ROS 2, but of images and the like: 0.2 s of a topic of 500 Hz.
_OUT_DEPTH: Final = 100

# Its publishers latch, in ROS 1 and ROS 2 (tf2_ros).
_STATIC_TF: Final = "/tf_static"
# Types of streams: their publishers are not asked whether they latch, since a driver may start by being asked.
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
_TOPIC_ENDS: Final = (EntityKind.PUBLISHER, EntityKind.SUBSCRIPTION)
_SEQ: Final = struct.Struct("<I")


class Ros2Export(ExportedTopic):
    """A topic in ROS 2: messages are converted, and a token has the type's hash.

    A type that ROS 2's distribution does not have is learnt first from the publisher's header: its hash is part of
    the key. A latched topic becomes transient local, and stays connected once it was wanted, so that what is kept for
    late subscribers is the last message.

    Args:
        part: Compares it with what ROS 2 has.
        source: The topic.
        decision: The rule that lets it cross.

    Attributes:
        endpoint: The publisher in ROS 2's graph; ``None`` while its type is not known.
    """

    def __init__(self, part: Ros2Topics, source: MeshSource, decision: CrossingDecision) -> None:
        context = part.context
        super().__init__(source, context.graph, context.session, decision.rate, decision.size)
        self.payload, self.attachment = self._converted, self._attached
        self.why: Final = decision.why
        self.endpoint: OwnEndpoint | None = None
        self.unconverted = 0
        self._part = part
        self._conversion: Conversion | None = None
        self._latching = source.name == _STATIC_TF or (
            source.name.endswith("/descriptor") and source.type == "std_msgs/String"  # of a Smart Resource
        )

    @property
    def latched(self) -> bool:
        """Whether it is transient local in ROS 2."""
        return self.endpoint is not None and self.endpoint.endpoint.qos.latched

    def announce(self, about: TopicDescription | None, *, latched: bool, large: bool) -> tuple[str, ZenohQos] | None:
        """Of ``ExportedTopic``: once latched it stays so, and no message yields for its size."""
        del large
        context, source = self._part.context, self.source
        try:
            found = context.pairs.ros2_type(source.type) if about is None else self._learn(about)
        except RmpaError:
            self._conversion = None
            self._undeclare()
            raise
        if found is None:
            return None
        self._latching = self._latching or latched
        depth = DEFAULT_DEPTH if source.type in _STREAMS else _OUT_DEPTH
        qos = ros2_qos(context.contracts, source.name, source.type, latching=self._latching, depth=depth)
        old = self.endpoint
        if old is None or (old.endpoint.type, old.endpoint.type_hash, old.endpoint.qos) != (*found, qos):
            self.endpoint = context.nodes.declare(source.proxy, EntityKind.PUBLISHER, source.here, found, qos)
            if old is not None:
                old.close()
            self._part.declared(self)
        assert self.endpoint is not None  # noqa: S101 - it is declared here, or was before
        return self.endpoint.endpoint.key(), zenoh_qos(context.contracts.of(source.name, source.type), qos)

    def linger(self, *, keeps: bool) -> float | None:
        """Of ``ExportedTopic``."""
        return None if keeps else 0.0

    def say(self, problem: str) -> None:
        """Of ``ExportedTopic``; the log tells it too."""
        super().say(problem)
        self._log(problem)

    def close(self) -> None:
        """Take everything back."""
        super().close()
        self._undeclare()

    def _log(self, problem: str) -> None:
        self._part.context.say(f"{self.source.here} of {self.source.proxy}", problem)

    def _converted(self, body: memoryview) -> bytes | None:
        if self._conversion is None:
            return None
        try:
            return self._conversion.to_ros2(body)
        except ConversionError as error:
            self.unconverted += 1
            if self.unconverted == 1:
                self._log(str(error))
            return None

    def _attached(self, sequence: int, stamp: int) -> bytes:
        return Ros2Attachment(sequence, stamp, self.endpoint.gid if self.endpoint is not None else b"").serialize()

    def _undeclare(self) -> None:
        if self.endpoint is not None:
            self.endpoint.close()
            self.endpoint = None

    def _learn(self, about: TopicDescription) -> tuple[str, str]:
        fields = {"type": about.type, "md5sum": about.md5sum, "message_definition": about.definition}
        kind, pairs = type_of_header(fields), self._part.context.pairs
        found = pairs.learn(kind)
        self._conversion = pairs.outgoing(kind)
        return found


class Ros2Publisher:
    """What one node of ROS 2 publishes of a topic; it may have several publishers of it.

    Attributes:
        kept: The last message of a transient local one that is not wanted.
    """

    def __init__(self, node: str, topic: Ros2Import) -> None:
        self.node: Final = node
        self.endpoints: list[Ros2Endpoint] = []
        self.wanted = False
        self.kept: bytes | None = None
        self.received = self.dropped = 0
        source = ForeignSource(SourceKind.TOPIC, SITE, "", node, topic.decision.name, topic.ros1_type)
        self.topic: ProxiedTopic = topic.part.context.graph.show_topic(
            source, lambda wanted: topic.demand(self, wanted)
        )

    @property
    def latched(self) -> bool:
        """Whether one of them is transient local."""
        return any(each.qos.latched for each in self.endpoints)


class Ros2Import:
    """Shows the publishers of one key, and subscribes to it while a node or module wants one of them.

    All publishers of one topic, type and hash share a key. What comes is given to the node whose publisher's GID is
    in the attachment; a GID that fits no token (plain Zenoh programs choose their own) is given to a publisher
    without messages of its own. A header's ``seq``, which ROS 2 lacks, is the message's number at its publisher.

    Args:
        part: Is told once it is idle.
        first: A publisher of the topic.
        ros1_type: ``package/Name`` of ROS 1.
        decision: The rule that lets it cross, and its name here.

    Attributes:
        problem: Why its messages do not come; empty for nothing.
        publishers: By node.
        early: What came before a node subscribed.
    """

    # More than twelve fields: publishers, demand, and messages that are too early change each other.

    def __init__(self, part: Ros2Topics, first: Ros2Endpoint, ros1_type: str, decision: CrossingDecision) -> None:
        self.part: Final = part
        self.first: Final = first
        self.ros1_type: Final = ros1_type
        self.decision: Final = decision
        self.conversion: Conversion | None = None
        self.problem = ""
        self.publishers: dict[str, Ros2Publisher] = {}
        self._by_gid: dict[bytes, Ros2Publisher] = {}
        self._adopted: dict[bytes, Ros2Publisher] = {}
        self._has_seq = False
        # The gateway's subscription in ROS 2.
        self._subscription: OwnEndpoint | None = None
        self._history = False
        self._qos = Ros2Qos()
        self.sequences = Ros2Sequences()
        self.early: BoundedQueue[tuple[bytes, int, bytes]] = BoundedQueue(_ROS2_EARLY_MESSAGES, _ROS2_EARLY_BYTES)
        self.unconverted = self.limited = 0
        self._limits = TopicLimits.of(decision.rate, decision.size)
        self._lingering = Delay()

    @property
    def declared(self) -> Ros2Endpoint | None:
        """The gateway's subscription in ROS 2; ``None``: there is none."""
        return self._subscription.endpoint if self._subscription is not None else None

    @property
    def idle(self) -> bool:
        """Whether it has no publishers, and none came or went a moment ago: its publisher does not restart."""
        return not self.publishers and not self._lingering

    def problem_of(self, publisher: Ros2Publisher) -> str:
        """Why messages of one of its publishers do not come, or are not understood; empty for nothing."""
        return self.problem or publisher.topic.problem

    def add(self, endpoint: Ros2Endpoint) -> None:
        """A publisher appeared."""
        node = endpoint.node.name
        if node not in self.publishers:
            self.publishers[node] = Ros2Publisher(node, self)
        publisher = self.publishers[node]
        publisher.endpoints.append(endpoint)
        self._by_gid[gid_of(endpoint.token())] = publisher
        self._describe(publisher)
        self._linger()
        if (publisher.latched and not self._history) or self._terms() != self._qos:
            self._unsubscribe()  # again, with the history, or by what this publisher offers too
        self._follow_demand()

    def remove(self, endpoint: Ros2Endpoint) -> None:
        """A publisher is gone."""
        publisher = self._by_gid.pop(gid_of(endpoint.token()), None)
        if publisher is None:
            return
        self._linger()
        publisher.endpoints.remove(endpoint)
        self._adopted = {gid: each for gid, each in self._adopted.items() if each is not publisher}
        if not publisher.endpoints:
            self.publishers.pop(publisher.node).topic.close()
        self._follow_demand()

    def converted(self, conversion: Conversion | None, problem: str = "") -> None:
        """The conversion of its type was found, or why there is none."""
        self.conversion, self.problem = conversion, problem
        self._has_seq = conversion is not None and _begins_with_header(conversion.ros1)
        self._say(problem)
        for publisher in self.publishers.values():
            self._describe(publisher)
        self._follow_demand()

    def close(self) -> None:
        """Take it out of the gateway's graph."""
        self._lingering.cancel()
        for publisher in self.publishers.values():
            publisher.topic.close()
        self._unsubscribe()
        self.publishers.clear()
        self._say("")

    def demand(self, publisher: Ros2Publisher, wanted: bool) -> None:
        """A node or module wants a publisher, or none does any more."""
        publisher.wanted = wanted
        kept, publisher.kept = publisher.kept, None
        if not wanted:
            publisher.topic.forget_latched()
        self._follow_demand()
        if not wanted:
            return
        if kept is not None:  # this key was subscribed to already: its history came then
            self._deliver(publisher, kept, 0)
        for gid, sequence, payload in self.early.clear():
            if self._publisher_of(gid) is publisher:
                self._deliver(publisher, payload, sequence)
            else:
                self.early.push((gid, sequence, payload), len(payload))

    def _describe(self, publisher: Ros2Publisher) -> None:
        if self.conversion is not None:
            kind = self.conversion.ros1
            described = TopicDescription(kind.name, kind.md5sum, kind.definition, latching=publisher.latched)
            publisher.topic.describe(described)

    def _linger(self) -> None:
        """Stay subscribed for a moment, and hold what comes: nodes subscribe to a new source some time after it."""
        if self._subscription is not None:
            self._lingering.set(_ROS2_LINGER, self._end_lingering)

    def _end_lingering(self) -> None:
        self.early.clear()
        self._follow_demand()
        self.part.drop_idle(self)

    def _follow_demand(self) -> None:
        wanted = self.conversion is not None and any(each.wanted for each in self.publishers.values())
        if not wanted and not self._lingering:
            self._unsubscribe()
        elif wanted and self._subscription is None:
            nodes, first = self.part.context.nodes, self.first
            self._history = any(each.latched for each in self.publishers.values())
            self._qos = self._terms()
            terms = EntityKind.SUBSCRIPTION, first.name, (first.type, first.type_hash), self._qos
            self._subscription = nodes.declare(nodes.own_name, *terms, take=self._sample, history=self._history)

    def _terms(self) -> Ros2Qos:
        """The QoS that fits all publishers: DDS connects no subscription that asks for more than one offers."""
        offered = [each.qos for publisher in self.publishers.values() for each in publisher.endpoints]
        kept = bool(offered) and all(each.latched for each in offered)
        reliable = all(each.reliability is Ros2Reliability.RELIABLE for each in offered)
        return Ros2Qos(
            Ros2Reliability.RELIABLE if reliable else Ros2Reliability.BEST_EFFORT,
            Ros2Durability.TRANSIENT_LOCAL if kept else Ros2Durability.VOLATILE,
            depth=DEFAULT_DEPTH if self.ros1_type in _STREAMS else _DEPTH,
        )

    def _unsubscribe(self) -> None:
        if self._subscription is not None:
            self._subscription.close()
            self._subscription = None
        self.sequences.forget()
        self._adopted.clear()
        for publisher in self.publishers.values():
            publisher.kept = None

    def _sample(self, sample: ZenohSample) -> None:
        gid, sequence = b"", 0
        if sample.attachment:
            try:
                attachment = Ros2Attachment.parse(sample.attachment)
            except RemoteProtocolError as error:
                self._fail(str(error))
                return
            gid, sequence = attachment.gid, attachment.sequence
            own = gid in self.part.context.nodes.gids
            if own or not self.sequences.accept(attachment, history=self._history):
                return
        publisher = self._publisher_of(gid)
        if publisher is not None and publisher.wanted:
            self._deliver(publisher, sample.payload, sequence)
        elif publisher is not None and publisher.latched:
            publisher.kept = sample.payload
        elif self._lingering:
            self.early.push((gid, sequence, sample.payload), len(sample.payload))

    def _publisher_of(self, gid: bytes) -> Ros2Publisher | None:
        return self._by_gid.get(gid[:GID_BYTES]) or self._adopted.get(gid) or self._adopt(gid)

    def _adopt(self, gid: bytes) -> Ros2Publisher | None:
        """The publisher of a GID that is of no token: one that has none yet, else the first."""
        taken, every = list(self._adopted.values()), list(self.publishers.values())
        found = next((each for each in every if each not in taken), every[0] if every else None)
        if found is not None and len(self._adopted) < len(self._by_gid):
            self._adopted[gid] = found
        return found

    def _deliver(self, publisher: Ros2Publisher, payload: bytes, sequence: int) -> None:
        if self.conversion is None:
            return
        try:
            body: Buffer = self.conversion.to_ros1(payload)
        except ConversionError as error:
            self._fail(str(error))
            return
        if self._limits is not None and not publisher.latched and not self._limits.admit(time.monotonic(), len(body)):
            self.limited += 1
            return
        publisher.received += 1
        if self._has_seq:
            body = bytearray(body)
            _SEQ.pack_into(body, 0, (sequence or publisher.received) & 0xFFFFFFFF)
        publisher.dropped += publisher.topic.publish(body)

    def _fail(self, text: str) -> None:
        self.unconverted += 1
        if self.unconverted == 1:
            self._say(text)

    def _say(self, text: str) -> None:
        self.part.context.say(f"{self.first.name} of ROS 2 ({self.first.type})", text)


def _begins_with_header(kind: MessageType) -> bool:
    """Whether a message's first bytes are the ``seq`` of its header, which ROS 2 does not have."""
    return bool(kind.fields) and kind.fields[0].type == "std_msgs/Header" and not kind.fields[0].array


class Ros2Topics:
    """Joins topics both ways.

    Args:
        context: What the parts share.

    Attributes:
        refused: Why topics do not cross, by ``<topic> of <node>``.
        imports: ROS 2's topics in the gateway's graph, by key.
    """

    def __init__(self, context: Ros2Context) -> None:
        self.context: Final = context
        self.refused: dict[str, str] = {}
        # By name here, then by proxy.
        self._exports: dict[str, dict[str, Ros2Export]] = {}
        self.imports: dict[str, Ros2Import] = {}
        self._looks = asyncio.Semaphore(_LATCH_LOOKS_AT_ONCE)

    def close(self) -> None:
        """Take back all topics of both sides."""
        for export in self.exports():
            export.close()
        for imported in self.imports.values():
            imported.close()

    def exports(self) -> list[Ros2Export]:
        """The topics of modules in ROS 2's graph."""
        return [each for exports in self._exports.values() for each in exports.values()]

    def _refuse(self, what: str, why: str) -> None:
        if len(self.refused) >= limits.ROS2_PROBLEMS_MAX:
            del self.refused[next(iter(self.refused))]
        self.refused[what] = why

    def mesh_source(self, source: MeshSource, *, there: bool) -> None:
        """Put a topic of a module into ROS 2's graph, or take it out."""
        exports = self._exports.setdefault(source.here, {})
        if (old := exports.pop(source.proxy, None)) is not None:
            old.close()
        what = f"{source.here} of {source.proxy}"
        self.refused.pop(what, None)
        decision = self.context.rules.outgoing_to(SITE, source.module, source.name)
        if there and not (valid_name(source.here) and valid_name(source.proxy)):
            self._refuse(what, "ROS 2 allows no such name: a part of it begins with a digit, or it is too long")
        elif there and not decision.allowed:
            self._refuse(what, decision.why)
        elif there:
            export = exports[source.proxy] = Ros2Export(self, source, decision)
            export.start()
            if export.announced and not export.latched and source.type not in _STREAMS:
                self.context.start(self._look(export), f"look at {source.here}")
        if not exports:
            del self._exports[source.here]

    async def _look(self, export: Ros2Export) -> None:
        """Ask the publisher once for its header, which tells whether it latches, unless it was asked before."""
        await asyncio.sleep(limits.LATCH_LOOK_AFTER)
        async with self._looks:
            if export.about is None:
                with contextlib.suppress(RmpaError):
                    await export.header(_LATCH_LOOK_TIMEOUT)

    def declared(self, export: Ros2Export) -> None:
        """A topic has another type or hash now: compare it with what ROS 2 has under its name."""
        for other in list(self.context.ros2.at(export.source.here, *_TOPIC_ENDS)):
            self._compare(export, other)
        for imported in self.imports.values():  # a type was learnt: topics whose fields were not known may have it
            if imported.conversion is None:
                with contextlib.suppress(NoConversion):
                    found = self.context.pairs.incoming(imported.first.type, imported.first.type_hash)
                    if found is not None:
                        imported.converted(found)

    def _compare(self, export: Ros2Export, other: Ros2Endpoint) -> None:
        if export.endpoint is not None:
            text = mismatch(export.endpoint.endpoint, other, self.context.types.distribution)
            if text:
                self.context.say(f"{other.name} of {other.node.name}", text)

    def endpoint(self, endpoint: Ros2Endpoint, *, there: bool) -> None:
        """Show a publisher of ROS 2 in the gateway's graph, or take it out; compare it with what is here."""
        what = f"{endpoint.name} of {endpoint.node.name}"
        if there:
            for export in self._exports.get(endpoint.name, {}).values():
                self._compare(export, endpoint)
        else:
            self.context.say(what, "")
        if endpoint.kind is not EntityKind.PUBLISHER or "/_" in endpoint.name:
            return  # ROS 2's tools hide what has such a name, as the topics of actions
        imported = self.imports.get(endpoint.key())
        if there:
            self._add(endpoint, imported, what)
        else:
            self.refused.pop(what, None)
            if imported is not None:
                imported.remove(endpoint)
                self.drop_idle(imported)

    def drop_idle(self, imported: Ros2Import) -> None:
        """A topic without publishers goes; one that was wanted stays for a while, as its publisher may restart."""
        if imported.idle and self.imports.pop(imported.first.key(), None) is not None:
            imported.close()

    def _add(self, endpoint: Ros2Endpoint, imported: Ros2Import | None, what: str) -> None:
        if imported is None:
            kind = self.context.pairs.ros1_name(endpoint.type)
            source = ForeignSource(SourceKind.TOPIC, SITE, "", endpoint.node.name, endpoint.name, kind)
            decision = self.context.rules.incoming(source)
            if not decision.allowed:
                self._refuse(what, decision.why)
                return
            imported = self.imports[endpoint.key()] = Ros2Import(self, endpoint, kind, decision)
            imported.add(endpoint)
        else:
            imported.add(endpoint)
            if not imported.problem:
                return  # else this node may be able to describe the type
        try:
            conversion = self.context.pairs.incoming(endpoint.type, endpoint.type_hash)
        except NoConversion as error:
            imported.converted(None, str(error))
            return
        if conversion is not None:
            imported.converted(conversion)
        else:
            self.context.start(self._ask_type(imported, endpoint), f"type of {endpoint.name}")

    async def _ask_type(self, imported: Ros2Import, endpoint: Ros2Endpoint) -> None:
        """Ask the publisher's node for the fields of its type."""
        name, type_hash = endpoint.type, endpoint.type_hash
        try:
            self.context.pairs.described(name, type_hash, await self.context.asker.learn(of=endpoint))
            imported.converted(self.context.pairs.incoming(name, type_hash))
        except (NoConversion, RemoteProtocolError) as error:
            if imported.conversion is None:
                imported.converted(None, str(error))
            return
        for export in self.exports():
            export.start()

"""One topic of ROS 2 in the gateway's graph: a source for each node that publishes it.

All publishers of one topic, type and hash share a key. What comes is given to the node whose publisher's GID is in
the attachment; a GID that fits no token (plain Zenoh programs choose their own) is given to a publisher without
messages of its own. A header's ``seq``, which ROS 2 lacks, is the message's number at its publisher.
"""

from __future__ import annotations

import asyncio
import struct
from collections import deque
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway import limits
from rmpa.gateway.neighbour import ForeignSource, SourceKind
from rmpa.gateway.ros2.conversion import Conversion, ConversionError
from rmpa.gateway.ros2.format import GID_BYTES, EntityKind, Ros2Attachment, Ros2Durability, Ros2Qos
from rmpa.gateway.ros2.graph import SITE, gid_of
from rmpa.gateway.ros2.types import Ros2Sequences
from rmpa.ros.wire.tcpros import TopicDescription

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.gateway.foreign import ProxiedTopic
    from rmpa.gateway.neighbour import ZenohSample
    from rmpa.gateway.ros2.format import Ros2Endpoint
    from rmpa.gateway.ros2.graph import OwnEndpoint
    from rmpa.gateway.ros2.services import Ros2Context
    from rmpa.gateway.sites.catalogue import CrossingDecision
    from rmpa.gateway.zenoh.session import Declaration
    from rmpa.ros.types.messages import MessageType
    from rmpa.ros.wire.tcpros import Buffer

_SEQ: Final = struct.Struct("<I")


class _Publisher:
    """What one node publishes of the topic; it may have several publishers of it."""

    def __init__(self, node: str) -> None:
        self.node: Final = node
        self.endpoints: list[Ros2Endpoint] = []
        self.topic: ProxiedTopic | None = None
        self.wanted = False
        self.kept: bytes | None = None
        self.received = 0
        self.dropped = 0

    @property
    def latched(self) -> bool:
        return any(each.qos.latched for each in self.endpoints)


class Ros2TopicImport:
    """Shows the publishers of one key, and subscribes to it while a node or module wants one of them.

    Args:
        context: What the parts share.
        first: A publisher of the topic.
        ros1_type: ``package/Name`` of ROS 1.
        decision: The rule that lets it cross, and its name here.
        on_idle: Called once it does not linger any more.
    """

    def __init__(
        self,
        context: Ros2Context,
        first: Ros2Endpoint,
        ros1_type: str,
        decision: CrossingDecision,
        on_idle: Callable[[], None],
    ) -> None:
        self._on_idle = on_idle
        self._context = context
        self.name: Final = first.name
        self.type: Final = first.type
        self.type_hash: Final = first.type_hash
        self._key = first.key()
        self._ros1_type = ros1_type
        self._decision = decision
        self._publishers: dict[str, _Publisher] = {}
        self._by_gid: dict[bytes, _Publisher] = {}
        self._gids: dict[Ros2Endpoint, bytes] = {}
        self._adopted: dict[bytes, _Publisher] = {}
        self._conversion: Conversion | None = None
        self._has_seq = False
        self._subscription: Declaration | None = None
        self._endpoint: OwnEndpoint | None = None
        self._history = False
        self._sequences = Ros2Sequences()
        self._early: deque[tuple[bytes, int, bytes]] = deque()
        self._unheard = 0
        self._early_bytes = 0
        self._timer: asyncio.TimerHandle | None = None
        self._failed = 0
        self.problem = ""
        """Why its messages do not come; empty for nothing."""

    @property
    def publishers(self) -> int:
        """The publishers of ROS 2."""
        return len(self._gids)

    @property
    def converts(self) -> bool:
        """Whether the conversion of its type was found."""
        return self._conversion is not None

    @property
    def lingers(self) -> bool:
        """Whether it stays subscribed although none wants it now: a publisher came or went a moment ago."""
        return self._timer is not None

    def add(self, endpoint: Ros2Endpoint) -> None:
        """A publisher appeared."""
        node = endpoint.node.name
        publisher = self._publishers.get(node)
        if publisher is None:
            publisher = self._publishers[node] = _Publisher(node)
        publisher.endpoints.append(endpoint)
        gid = self._gids[endpoint] = gid_of(endpoint.token())
        self._by_gid[gid] = publisher
        if publisher.topic is None:
            source = ForeignSource(SourceKind.TOPIC, SITE, "", node, self._decision.name, self._ros1_type)
            shown = publisher  # for the callback
            publisher.topic = self._context.graph.show_topic(source, lambda wanted: self._demand(shown, wanted))
        self._describe(publisher)
        if self._subscription is not None:
            self._linger()
        if publisher.latched and not self._history and self._subscription is not None:
            self._unsubscribe()  # again, with the history
        self._follow_demand()

    def remove(self, endpoint: Ros2Endpoint) -> None:
        """A publisher is gone."""
        publisher = self._publishers.get(endpoint.node.name)
        gid = self._gids.pop(endpoint, None)
        if publisher is None or gid is None:
            return
        self._by_gid.pop(gid, None)
        if self._subscription is not None:
            self._linger()
        publisher.endpoints.remove(endpoint)
        self._adopted = {key: each for key, each in self._adopted.items() if each is not publisher}
        if not publisher.endpoints:
            del self._publishers[publisher.node]
            if publisher.topic is not None:
                publisher.topic.close()
        self._follow_demand()

    def converted(self, conversion: Conversion | None, problem: str) -> None:
        """The conversion of its type was found, or why there is none."""
        self._conversion = conversion
        self._has_seq = conversion is not None and _begins_with_header(conversion.ros1)
        self.problem = problem
        self._context.say(self._subject, problem)
        for publisher in self._publishers.values():
            self._describe(publisher)
        self._follow_demand()

    def close(self) -> None:
        """Take it out of the gateway's graph."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        publishers, self._publishers = self._publishers, {}
        for publisher in publishers.values():
            if publisher.topic is not None:
                publisher.topic.close()
        self._unsubscribe()
        self._context.say(self._subject, "")

    def report(self) -> list[dict[str, object]]:
        """Its state, as JSON values: one row for each node."""
        common: dict[str, object] = {
            "direction": "in",
            "topic": self.name,
            "here": self._decision.name,
            "type": self._ros1_type,
            "ros2_type": self.type,
            "rule": self._decision.why,
            "lost": self._sequences.lost,
            "unheard": self._unheard,
            "unconverted": self._failed,
        }
        return [
            common
            | {
                "node": each.node,
                "publishers": len(each.endpoints),
                "latched": each.latched,
                "wanted": each.wanted,
                "received": each.received,
                "dropped": each.dropped,
                "problem": self.problem or (each.topic.problem if each.topic is not None else ""),
            }
            for each in self._publishers.values()
        ]

    # --- demand --------------------------------------------------------------------------------------------------

    def _describe(self, publisher: _Publisher) -> None:
        if self._conversion is not None and publisher.topic is not None:
            kind = self._conversion.ros1
            publisher.topic.describe(
                TopicDescription(kind.name, kind.md5sum, kind.definition, latching=publisher.latched)
            )

    def _demand(self, publisher: _Publisher, wanted: bool) -> None:
        publisher.wanted = wanted
        kept, publisher.kept = publisher.kept, None
        if not wanted and publisher.topic is not None:
            publisher.topic.forget_latched()
        self._follow_demand()
        if not wanted:
            return
        if kept is not None:  # this key was subscribed to already: its history came then
            self._deliver(publisher, kept, 0)
        early, self._early, self._early_bytes = self._early, deque(), 0
        for gid, sequence, payload in early:
            if self._publisher_of(gid) is publisher:
                self._deliver(publisher, payload, sequence)
            else:
                self._hold(gid, sequence, payload)

    def _linger(self) -> None:
        """Stay subscribed for a moment, and hold what comes: nodes subscribe to a new source some time after it."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer = asyncio.get_running_loop().call_later(limits.ROS2_LINGER, self._end_lingering)

    def _end_lingering(self) -> None:
        self._timer = None
        self._early.clear()
        self._early_bytes = 0
        self._follow_demand()
        self._on_idle()

    def _hold(self, gid: bytes, sequence: int, payload: bytes) -> None:
        self._early.append((gid, sequence, payload))
        self._early_bytes += len(payload)
        while len(self._early) > limits.ROS2_EARLY_MESSAGES or self._early_bytes > limits.ROS2_EARLY_BYTES:
            self._early_bytes -= len(self._early.popleft()[2])
            self._unheard += 1

    def _follow_demand(self) -> None:
        wanted = self._conversion is not None and any(each.wanted for each in self._publishers.values())
        if wanted and self._subscription is None:
            self._subscribe()
        elif not wanted and not self.lingers:
            self._unsubscribe()

    def _subscribe(self) -> None:
        context = self._context
        self._history = any(each.latched for each in self._publishers.values())
        durability = Ros2Durability.TRANSIENT_LOCAL if self._history else Ros2Durability.VOLATILE
        self._subscription = context.session.subscribe(self._key, self._sample, history=self._history)
        self._endpoint = context.nodes.declare(
            context.nodes.own_name,
            EntityKind.SUBSCRIPTION,
            self.name,
            self.type,
            self.type_hash,
            Ros2Qos(durability=durability),
        )

    def _unsubscribe(self) -> None:
        if self._subscription is not None:
            self._subscription.close()
            self._subscription = None
        if self._endpoint is not None:
            self._endpoint.close()
            self._endpoint = None
        self._sequences.forget()
        self._adopted.clear()
        for publisher in self._publishers.values():
            publisher.kept = None

    # --- messages ------------------------------------------------------------------------------------------------

    def _sample(self, sample: ZenohSample) -> None:
        gid, sequence = b"", 0
        if sample.attachment:
            try:
                attachment = Ros2Attachment.parse(sample.attachment)
            except RemoteProtocolError as error:
                self._fail(str(error))
                return
            gid, sequence = attachment.gid, attachment.sequence
            if gid in self._context.nodes.gids or not self._sequences.accept(attachment, history=self._history):
                return
        publisher = self._publisher_of(gid)
        if publisher is not None and publisher.wanted:
            self._deliver(publisher, sample.payload, sequence)
        elif publisher is not None and publisher.latched:
            publisher.kept = sample.payload
        elif self.lingers:
            self._hold(gid, sequence, sample.payload)

    def _publisher_of(self, gid: bytes) -> _Publisher | None:
        return self._by_gid.get(gid[:GID_BYTES]) or self._adopted.get(gid) or self._adopt(gid)

    def _adopt(self, gid: bytes) -> _Publisher | None:
        """The publisher of a GID that is of no token: one that has none yet, else the first."""
        taken = {id(each) for each in self._adopted.values()}
        free = (each for each in self._publishers.values() if id(each) not in taken)
        found = next(free, None) or next(iter(self._publishers.values()), None)
        if found is not None and len(self._adopted) < len(self._gids):
            self._adopted[gid] = found
        return found

    def _deliver(self, publisher: _Publisher, payload: bytes, sequence: int) -> None:
        conversion, topic = self._conversion, publisher.topic
        if conversion is None or topic is None:
            return
        try:
            body: Buffer = conversion.to_ros1(payload)
        except ConversionError as error:
            self._fail(str(error))
            return
        publisher.received += 1
        if self._has_seq:
            numbered = bytearray(body)
            _SEQ.pack_into(numbered, 0, (sequence or publisher.received) & 0xFFFFFFFF)
            body = numbered
        publisher.dropped += topic.publish(body)

    def _fail(self, text: str) -> None:
        self._failed += 1
        if self._failed == 1:
            self._context.say(self._subject, text)

    @property
    def _subject(self) -> str:
        return f"{self.name} of ROS 2 ({self.type})"


def _begins_with_header(kind: MessageType) -> bool:
    """Whether a message's first bytes are the ``seq`` of its header, which ROS 2 does not have."""
    return bool(kind.fields) and kind.fields[0].type == "std_msgs/Header" and not kind.fields[0].array

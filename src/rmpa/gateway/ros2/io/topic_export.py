"""One topic of one publisher of the mesh, as that of a node of ROS 2."""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RmpaError
from rmpa.gateway import limits
from rmpa.gateway.ros2.attachment import Ros2Attachment
from rmpa.gateway.ros2.contract_qos import ros2_qos, zenoh_qos
from rmpa.gateway.ros2.conversion import Conversion, ConversionError, NoConversion
from rmpa.gateway.ros2.tokens import EntityKind
from rmpa.gateway.sites.topic_limits import TopicLimits
from rmpa.ros.types.find import type_of_header

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.gateway.graph.taps import TopicTap
    from rmpa.gateway.neighbour import MeshSource
    from rmpa.gateway.ros2.io.own_nodes import OwnEndpoint
    from rmpa.gateway.ros2.io.part import Ros2Context
    from rmpa.gateway.ros2.pairs import Ros2Pairs
    from rmpa.gateway.sites.rules import CrossingDecision
    from rmpa.gateway.zenoh.sending import QueuedPublisher
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

"""Topics between the mesh and bridges, one object for each source."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RmpaError
from rmpa.gateway.ros1_bridge.keys import BridgedKind, BridgedTopic
from rmpa.gateway.sites.topic_limits import TopicLimits
from rmpa.gateway.zenoh_api import ZenohQos
from rmpa.ros.types.find import find_message_type
from rmpa.ros.wire.tcpros import TopicDescription

if TYPE_CHECKING:
    from rmpa.gateway.neighbour import ForeignSource, MeshSource, OwnGraph, Tap
    from rmpa.gateway.ros1_bridge.io.announcer import BridgeAnnouncer
    from rmpa.gateway.sites.rules import CrossingDecision
    from rmpa.gateway.zenoh_api import Declared, ZenohPublisher, ZenohSample, ZenohSession

OWN_MARK: Final = b"rmpa"
"""The attachment of what gateways put; bridges put none. A gateway leaves it out, so that nothing crosses twice."""


class BridgedExport:
    """A topic of a module, announced to bridges; it is subscribed to while one of them wants it.

    Args:
        graph: The gateway's graph.
        session: The Zenoh session.
        announcer: Announces it.
        source: The topic.
        decision: Lets it cross, within its limits.
        namespace: The bridge namespace.
    """

    def __init__(
        self,
        graph: OwnGraph,
        session: ZenohSession,
        announcer: BridgeAnnouncer,
        source: MeshSource,
        decision: CrossingDecision,
        namespace: str,
    ) -> None:
        self._graph = graph
        self._session = session
        self._announcer = announcer
        self.source: Final = source
        self._why = decision.why
        self._limit = TopicLimits(decision.rate, decision.size)
        self._namespace = namespace
        self._topic: BridgedTopic | None = None
        self._publisher: ZenohPublisher | None = None
        self._tap: Tap | None = None
        self._wanted = self._closed = False
        self._sent_before = self._dropped_before = 0
        self._problem = ""

    def start(self) -> None:
        """Announce it; the md5 sum, which the key has, is asked of the publisher if the type is not known here."""
        try:
            kind = find_message_type(self.source.type)
        except RmpaError:
            self._open_tap()
        else:
            self._declare(kind.name, kind.md5sum)

    def close(self) -> None:
        """Announce it no more."""
        self._closed = True
        self._close_tap()
        self._withdraw()

    def report(self) -> dict[str, object]:
        """Its state, as JSON values."""
        publisher = self._publisher
        return {
            "direction": "out",
            "topic": self.source.here,
            "module": self.source.module,
            "node": self.source.node,
            "type": self.source.type,
            "md5sum": "" if self._topic is None else self._topic.md5,
            "wanted": self._wanted,
            "rule": self._why,
            "sent": self._sent_before + (0 if publisher is None else publisher.sent),
            "dropped": self._dropped_before + (0 if publisher is None else publisher.dropped),
            "limited": self._limit.dropped,
            "problem": self._problem,
        }

    def _declare(self, type_name: str, md5: str) -> None:
        topic = BridgedTopic(self.source.here, type_name, md5, self._namespace)
        if topic == self._topic or self._closed:
            return
        self._withdraw()
        self._topic = topic
        self._announcer.add(BridgedKind.PUBLISHER, topic)

        def matched(there: bool) -> None:
            if self._topic == topic:
                self._matched(there)

        self._publisher = self._session.publisher(topic.key(), ZenohQos(), matched)

    def _withdraw(self) -> None:
        topic, publisher = self._topic, self._publisher
        self._topic, self._publisher = None, None
        if topic is not None:
            self._announcer.remove(BridgedKind.PUBLISHER, topic)
        if publisher is not None:
            self._sent_before += publisher.sent + publisher.waiting
            self._dropped_before += publisher.dropped
            publisher.close()

    def _matched(self, there: bool) -> None:
        self._wanted = there and not self._closed
        if self._wanted:
            self._open_tap()
        else:
            self._close_tap()

    def _open_tap(self) -> None:
        if self._tap is None:
            self._tap = self._graph.tap(self.source, self._message, self._described, self._lost)

    def _close_tap(self) -> None:
        tap, self._tap = self._tap, None
        if tap is not None:
            tap.close()

    def _close_unwanted(self) -> None:
        if not self._wanted:
            self._close_tap()

    def _described(self, description: TopicDescription) -> None:
        self._problem = ""
        self._declare(description.type, description.md5sum)
        asyncio.get_running_loop().call_soon(self._close_unwanted)  # it may have been asked for its md5 sum only

    def _lost(self, reason: str) -> None:
        self._problem = f"the publisher in the mesh: {reason}"

    def _message(self, body: memoryview) -> None:
        if self._publisher is None or not self._wanted:
            return
        if not self._limit.admit(time.monotonic(), len(body)):
            self._limit.dropped += 1
            return
        self._publisher.put(body, OWN_MARK)


class BridgedImport:
    """A topic of a bridge in the gateway's graph; it is subscribed to while a node here wants it.

    Args:
        graph: The gateway's graph.
        session: The Zenoh session.
        announcer: Announces the subscription.
        topic: The topic.
        source: What it is here.
        why: The rule that lets it cross.
    """

    def __init__(
        self,
        graph: OwnGraph,
        session: ZenohSession,
        announcer: BridgeAnnouncer,
        topic: BridgedTopic,
        source: ForeignSource,
        why: str,
    ) -> None:
        self._session = session
        self._announcer = announcer
        self._topic = topic
        self.source_here: Final = source
        self._why = why
        self._subscription: Declared | None = None
        self._received = self._dropped = 0
        self._foreign = graph.show_topic(source, self._demand)
        self._foreign.describe(_describe(topic))

    def close(self) -> None:
        """Take it out of the graph."""
        self._demand(wanted=False)
        self._foreign.close()

    def report(self) -> dict[str, object]:
        """Its state, as JSON values."""
        return {
            "direction": "in",
            "topic": self._topic.name,
            "here": self.source_here.name,
            "node": self.source_here.node,
            "type": self._topic.type,
            "md5sum": self._topic.md5,
            "wanted": self._subscription is not None,
            "rule": self._why,
            "received": self._received,
            "dropped": self._dropped,
            "problem": self._foreign.problem,
        }

    def _demand(self, wanted: bool) -> None:
        if wanted and self._subscription is None:
            self._announcer.add(BridgedKind.SUBSCRIBER, self._topic)
            self._subscription = self._session.subscribe(self._topic.key(), self._sample)
        elif not wanted and self._subscription is not None:
            self._subscription.close()
            self._subscription = None
            self._announcer.remove(BridgedKind.SUBSCRIBER, self._topic)

    def _sample(self, sample: ZenohSample) -> None:
        if sample.attachment == OWN_MARK:
            return
        self._received += 1
        self._dropped += self._foreign.publish(sample.payload)


def _describe(topic: BridgedTopic) -> TopicDescription:
    """The header of a topic: the bridge sends no definition, so that it has one only if the type is known here."""
    try:
        return find_message_type(topic.type, topic.md5).describe()
    except RmpaError:
        return TopicDescription(topic.type, topic.md5, "")

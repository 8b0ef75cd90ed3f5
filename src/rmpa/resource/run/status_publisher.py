"""Publishes the reports of a resource: quality, diagnostics, alarms, responses, profile and decision."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.ros.types.definitions import ARRAY_TYPE, DiagnosticLevel, DiagnosticStatus, frame_array
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.tcpros import LENGTH

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rmpa.resource.run.runtime import Runtime
    from rmpa.ros.node.endpoints import Publisher

LEVEL_FOR: Final = "level_for"
"""The value of ``quality`` that has how long its level has stood: an age, since the clocks of modules differ."""
_LATCHED: Final = {"quality": False, "alarms": False, "responses": True}


class StatusPublisher:
    """The report topics of one resource (``docs/smart-resources.md`` lists them).

    Args:
        runtime: The runtime of the resource.
    """

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._name = runtime.resource.name
        self.publishers: dict[str, Publisher] = {}
        self._responses: list[bytes] | None = None
        self._level: tuple[DiagnosticLevel, float] | None = None
        """The level of ``quality``, and since when, in monotonic seconds."""

    async def start(self) -> None:
        """Advertise the topics."""
        node = self._runtime.node
        for name, latch in _LATCHED.items():
            topic = f"{node.name}/{name}"
            self.publishers[name] = await node.advertise(topic, MessageType(ARRAY_TYPE), latch=latch)
        self.publishers["diagnostics"] = await node.advertise("/diagnostics", MessageType(ARRAY_TYPE))
        for name in ("profile", "decision"):
            await self._runtime.advertise_text(name, "")

    def close(self) -> None:
        """Stop publishing; later reports of quality, alarms and responses are dropped."""
        self.publishers.clear()

    def quality(self, level: DiagnosticLevel, message: str, values: Mapping[str, str]) -> None:
        """Publish the quality of a window, also on ``/diagnostics``, with how long it has had this level."""
        now = time.monotonic()
        if self._level is None or self._level[0] != level:
            self._level = level, now
        lasting = {LEVEL_FOR: f"{now - self._level[1]:.1f} s"}
        status = [DiagnosticStatus(level, self._name, message, self._name, {**values, **lasting})]
        self._publish("quality", status)
        self._publish("diagnostics", status)

    def alarm(self, level: DiagnosticLevel, message: str, values: Mapping[str, str]) -> None:
        """Publish an alarm."""
        self._publish("alarms", [DiagnosticStatus(level, self._name, message, self._name, values)])

    def responses(self, statuses: Sequence[DiagnosticStatus]) -> None:
        """Publish the responses to all clients, if they differ from the last ones."""
        serialized = [status.serialize() for status in statuses]
        if serialized != self._responses and "responses" in self.publishers:
            self._responses = serialized
            self._publish("responses", statuses)

    def decision(self, profile: str, decision: Mapping[str, Any]) -> None:
        """Publish the profile that runs and the decision (see ``decision_report``), each if it has changed."""
        self._runtime.publish_text("profile", profile)
        self._runtime.publish_text("decision", msgspec.json.encode(decision).decode())

    def _publish(self, topic: str, statuses: Sequence[DiagnosticStatus]) -> None:
        if (publisher := self.publishers.get(topic)) is not None:
            array = frame_array(0, time.time_ns(), [status.serialize() for status in statuses])[LENGTH.size :]
            publisher.publish_raw(publisher.numbers.stamp(array) if publisher.numbers is not None else array)

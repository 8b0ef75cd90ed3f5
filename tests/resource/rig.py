"""What the tests of resources share: waiting for what comes, and listening to topics."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, NamedTuple

from rmpa.resource.decision import Alarm
from rmpa.resource.quality import Attribute, Bound, QoSRequest
from rmpa.ros.node.endpoints import Subscriber
from rmpa.ros.node.node import Node

TEXT = "std_msgs/String"
ARRAY = "diagnostic_msgs/DiagnosticArray"
DEADLINE = 30.0
OK, WARN, ERROR, STALE = range(4)


class Apply(NamedTuple):
    profile: str
    why: str


class Raise(NamedTuple):
    alarm: Alarm


class Clear(NamedTuple):
    alarm: Alarm


class Reacted(NamedTuple):
    profile: str
    reaction: float


Action = Apply | Raise | Clear | Reacted


class Recorder:
    """A driver of the adaptation that lists what it is told."""

    def __init__(self) -> None:
        self.told: list[Action] = []

    def apply(self, profile: str, why: str) -> None:
        assert why
        self.told.append(Apply(profile, why))

    def alarm(self, alarm: Alarm, *, cleared: bool) -> None:
        self.told.append(Clear(alarm) if cleared else Raise(alarm))

    def reacted(self, profile: str, reaction: float) -> None:
        self.told.append(Reacted(profile, reaction))


def bound(attribute: Attribute, **request: Any) -> Bound:
    """The bound of a request: ``bound(RATE, at_least="20 Hz", hard=True)``."""
    return QoSRequest(**request).bound(attribute)


async def listen(node: Node, topic: str, kind: str = TEXT) -> list[Any]:
    """The messages of a topic, which come later."""
    found: list[Any] = []
    await node.subscribe(topic, kind, lambda received: found.append(received.message))
    return found


async def status(topic: Subscriber, fits: Callable[[Any], bool]) -> Any:
    """The first status on a topic that fits."""
    async with asyncio.timeout(DEADLINE):
        async for received in topic:
            for one in received.message.status:
                if fits(one):
                    return one
    raise AssertionError


def pairs(one: Any) -> dict[str, str]:
    """The values of a status."""
    return {pair.key: pair.value for pair in one.values}

"""Plays a recording into a ROS core: at its pace or another one, from any time, again and again, step by step.

All topics are published by one node, ``/rmpa_play``; latched ones come first. A topic that another node publishes is
left out: so a node under test stands in for the one that was recorded. With a clock, ``/clock`` is published and
``/use_sim_time`` set while it plays (wiki.ros.org/Clock).
"""

from __future__ import annotations

import asyncio
import logging
import struct
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from rmpa.core.errors import RmpaError
from rmpa.core.identity import is_own, matches
from rmpa.record.format import EVENTS, Recorded
from rmpa.ros.http.rpc import call_api
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.tcpros import TopicDescription
from rmpa.runtime.tasks import start_task

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from rmpa.record.format import RecordedSource
    from rmpa.ros.node.endpoints import Publisher
    from rmpa.ros.node.node import Node

_log = logging.getLogger(__name__)
NODE: Final = "rmpa_play"
_SECOND: Final = 1_000_000_000
# Seconds between two messages on /clock, by the clock of the machine.
_TICK: Final = 0.01
# Seconds from the registration of the publishers to the first message, for subscribers to connect.
_CONNECT: Final = 0.5
_TIME: Final = struct.Struct("<II")
_SIM_TIME: Final = "/use_sim_time"


@dataclass(frozen=True, slots=True)
class PlayOptions:
    """How a recording is played.

    Args:
        rate: So many times as fast as it was.
        start: Seconds of it that are left out at its beginning.
        duration: Seconds of it that are played; ``None``: all.
        loop: Begin again at its end.
        clock: Publish its time.
        topics: Globs of the topics that are played.
        deny: Globs of those that are not.
        modules: The modules whose messages are played; empty: all.
        remap: Other names for topics.
        over: Play topics that other nodes publish, too.
    """

    rate: float = 1.0
    start: float = 0.0
    duration: float | None = None
    loop: bool = False
    clock: bool = False
    topics: tuple[str, ...] = ("/**",)
    deny: tuple[str, ...] = ()
    modules: tuple[str, ...] = ()
    remap: Mapping[str, str] = field(default_factory=dict)
    over: bool = False


class Player:
    """Plays one recording.

    Args:
        node: A node of the core.
        messages: Returns the messages, in order of their log times; called for each round.
        options: How.
    """

    def __init__(self, node: Node, messages: Callable[[], Iterable[Recorded]], options: PlayOptions) -> None:
        self._node = node
        self._messages = messages
        self._options = options
        self._publishers: dict[str, Publisher] = {}
        # Topics that are not played, with the reason.
        self.left_out: dict[str, str] = {}
        # Messages that were played.
        self.count = 0
        # Time of the recording, Unix nanoseconds, and seconds since its beginning.
        self.now = 0
        self.position = 0.0
        # The time of the next message: the clock waits for it.
        self._next = 0
        self._running = asyncio.Event()
        self._running.set()
        self._steps = 0
        self._woken = asyncio.Event()

    @property
    def paused(self) -> bool:
        """Whether it waits."""
        return not self._running.is_set()

    def pause(self) -> None:
        """Wait, or go on."""
        if self.paused:
            self._running.set()
        else:
            self._running.clear()
        self._woken.set()

    def step(self) -> None:
        """Play one message, and wait."""
        self._steps += 1
        self._running.clear()
        self._woken.set()

    async def run(self) -> None:
        """Play until the end, or for ever with ``loop``.

        Raises:
            RmpaError: The core does not answer, or the recording has nothing to play.
        """
        sources = self._sources()
        await self._advertise(sources)
        if not self._publishers:
            why = "; ".join(f"{topic}: {text}" for topic, text in self.left_out.items())
            raise RmpaError(f"nothing is played: {why or 'the recording has no such topic'}", code="unknown-name")
        before = await self._node.get_param(_SIM_TIME, default=None)
        if self._options.clock:
            await self._node.set_param(_SIM_TIME, True)
        try:
            await asyncio.sleep(_CONNECT)
            await self._round()
            while self._options.loop:
                await self._round()
        finally:
            if self._options.clock:
                if before is None:
                    await self._node.delete_param(_SIM_TIME)
                else:
                    await self._node.set_param(_SIM_TIME, before)

    def _wanted(self, source: RecordedSource) -> bool:
        options, topic = self._options, source.topic
        return (
            topic != EVENTS
            and (not options.modules or source.module in options.modules)
            and any(matches(glob, topic) for glob in options.topics)
            and not any(matches(glob, topic) for glob in options.deny)
        )

    def _sources(self) -> dict[str, RecordedSource]:
        """The sources to play, one of each topic: of those of several types the first."""
        found: dict[str, RecordedSource] = {}
        for message in self._messages():
            source = message.source
            if not self._wanted(source):
                continue
            first = found.setdefault(source.topic, source)
            if first.md5sum != source.md5sum:
                self.left_out[source.topic] = f"it changes its type, from {first.type} to {source.type}"
            elif source.latching and not first.latching:
                found[source.topic] = source
        return found

    async def _advertise(self, sources: Mapping[str, RecordedSource]) -> None:
        state: Any = (await call_api(self._node.master_uri, "getSystemState", self._node.name)).value
        published: dict[str, list[str]] = dict(state[0])
        for topic, source in sources.items():
            name = self._options.remap.get(topic, topic)
            others = [node for node in published.get(name, ()) if not is_own(node) and node != self._node.name]
            if others and not self._options.over:
                self.left_out[topic] = f"{', '.join(others)} publishes it"
                continue
            description = TopicDescription(source.type, source.md5sum, source.definition, source.latching)
            self._publishers[topic] = await self._node.advertise(name, description)
        if self._options.clock and "/clock" not in self._publishers:
            self._publishers["/clock"] = await self._node.advertise("/clock", MessageType("rosgraph_msgs/Clock"))

    async def _round(self) -> None:
        """Play it once."""
        options = self._options
        ticking = start_task(self._tick(), "publish the time") if options.clock else None
        began = end = 0
        latched: dict[RecordedSource, bytes] = {}
        due = 0.0
        try:
            for message in self._played():
                if not began:
                    began = message.log_time
                    self.now = began + round(options.start * _SECOND)
                    end = began + round((options.start + options.duration) * _SECOND) if options.duration else 0
                    due = time.monotonic() - options.start / options.rate
                if end and message.log_time > end:
                    break
                at = (message.log_time - began) / _SECOND
                if at < options.start:
                    if message.source.latching:
                        latched[message.source] = message.data
                    continue
                for source, data in latched.items():
                    self._publish(source, data)
                latched.clear()
                self._next = message.log_time
                due = await self._wait(due, at)
                self.now, self.position = message.log_time, at
                self._publish(message.source, message.data)
        finally:
            if ticking is not None:
                ticking.cancel()

    def _played(self) -> Iterator[Recorded]:
        for message in self._messages():
            publisher = self._publishers.get(message.source.topic)
            if publisher is not None and publisher.description.md5sum == message.source.md5sum:
                yield message

    async def _wait(self, due: float, at: float) -> float:
        """Wait until the message of a time is due; returns when the recording's beginning would have been."""
        while True:
            if self.paused and self._steps:
                self._steps -= 1
                return time.monotonic() - at / self._options.rate
            left = due + at / self._options.rate - time.monotonic()
            if not self.paused and left <= 0:
                if self.count % 64 == 0:
                    await asyncio.sleep(0)  # others of the loop take their turn
                return due
            self._woken.clear()
            paused_at = time.monotonic() if self.paused else None
            try:
                async with asyncio.timeout(None if self.paused else left):
                    await self._woken.wait()
            except TimeoutError:
                continue
            if paused_at is not None:
                due += time.monotonic() - paused_at

    def _publish(self, source: RecordedSource, data: bytes) -> None:
        self._publishers[source.topic].publish_raw(data)
        self.count += 1

    async def _tick(self) -> None:
        """Publish the time of the recording, which never goes back within a round."""
        shown, before = 0, time.monotonic()
        while True:
            now = time.monotonic()
            if shown and not self.paused:
                shown += round((now - before) * self._options.rate * _SECOND)
                shown = min(shown, self._next) if self._next else shown
            shown, before = max(shown, self.now), now
            if shown and "/clock" in self._publishers:
                self._publishers["/clock"].publish_raw(_TIME.pack(*divmod(shown, _SECOND)))
            await asyncio.sleep(_TICK)

"""Plays a recording into a ROS core: at its pace or another one, from any time, again and again, step by step.

All topics are published by one node; latched ones come first. A topic that another node publishes is left out while
it does: so a node under test stands in for the one that was recorded. With a clock, ``/clock`` is published and
``/use_sim_time`` set while it plays (wiki.ros.org/Clock).
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import struct
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from rmpa.core.errors import RmpaError
from rmpa.core.identity import OWN_NODE, matches_any
from rmpa.record.format import EVENTS, STATIC, Recorded, RecordedSource
from rmpa.ros.http.rpc import call_api
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.tcpros import TopicDescription
from rmpa.runtime.tasks import end_tasks, start_task

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable, Iterator, Mapping

    from rmpa.record.merge import Timeline
    from rmpa.ros.node.endpoints import Publisher
    from rmpa.ros.node.node import Node

# Two players of one core have two names: a core ends the first of two nodes of one name.
NODE: Final = f"rmpa_play_{os.getpid()}"
_SECOND: Final = 1_000_000_000
# Seconds between two messages on /clock, by the clock of the machine.
_TICK: Final = 0.01
# Seconds from the registration of the publishers to the first message, for subscribers to connect.
_CONNECT: Final = 0.5
# Seconds between two looks for nodes that publish what is played.
_LOOK: Final = 1.0
# The loop's timers are this late, in seconds; the rest is slept.
_COARSE: Final = 0.0015
# Messages that are read at once, and bytes of them.
_BATCH, _BATCH_BYTES = 500, 4_000_000
_TIME: Final = struct.Struct("<II")
_CLOCK: Final = "/clock"
_SIM_TIME: Final = "/use_sim_time"
# What /use_sim_time was; there after a player was killed.
_BEFORE: Final = "/rmpa_play/use_sim_time"
_UNSET: Final = "unset"


@dataclass(frozen=True, slots=True)
class PlayOptions:
    """How a recording is played.

    Args:
        rate: So many times as fast as it was.
        start: Seconds of it that are left out at its beginning.
        duration: Seconds of it that are played; ``None``: all.
        loop: Begin again at its end.
        clock: Publish its time; if it has ``/clock``, that is played in place of it.
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
        timeline: The recording.
        options: How.
        told: Called with what a user should know as it happens: topics that are not played, or are again.
    """

    def __init__(
        self, node: Node, timeline: Timeline, options: PlayOptions, told: Callable[[str], object] = lambda _: None
    ) -> None:
        self._node = node
        self._timeline = timeline
        self._options = options
        self._told = told
        # What is played of each topic, and the publisher where it is published now.
        self._topics: dict[str, list[RecordedSource]] = {}
        self._publishers: dict[str, Publisher] = {}
        # The last latched message of each source, so far.
        self._latched: dict[RecordedSource, bytes] = {}
        # Sources whose nodes are there themselves.
        self._replaced: set[RecordedSource] = set()
        # Topics that are not played, or not all of them, with the reason.
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
            RmpaError: The core does not answer, the recording cannot be read or has nothing to play, or another node
                publishes ``/clock``.
        """
        self._choose()
        published = await self._published()
        await self._restore_time(published)
        await self._judge(published)
        if not self._publishers:
            why = "; ".join(f"{topic}: {text}" for topic, text in self.left_out.items())
            raise RmpaError(f"nothing is played: {why or 'the recording has no such topic'}", code="unknown-name")
        if self._options.clock:
            await self._set_time(published)
        looking = start_task(self._look(), "look for other publishers") if not self._options.over else None
        try:
            await asyncio.sleep(_CONNECT)
            await self._round()
            while self._options.loop:
                await self._round()
        finally:
            await end_tasks(looking)
            if self._options.clock:
                await self._restore_time({})

    def _choose(self) -> None:
        """Choose what is played of which topic: of several types the first.

        Raises:
            RmpaError: A name that is given fits nothing, or two topics have one name.
        """
        options = self._options
        sources = self._timeline.sources
        if unknown := set(options.modules) - {source.module for source in sources}:
            text = f"the recording has nothing of {', '.join(sorted(unknown))}"
            raise RmpaError(text, code="unknown-name")
        for source in sources:
            topic = source.topic
            if (
                topic == EVENTS
                or (options.modules and source.module not in options.modules)
                or not matches_any(options.topics, topic)
                or matches_any(options.deny, topic)
            ):
                continue
            chosen = self._topics.setdefault(topic, [])
            if not chosen or chosen[0].md5sum == source.md5sum:
                chosen.append(source)
            else:
                self._leave(f"{topic} as {source.type}", f"it is {chosen[0].type} at first")
        names = [options.remap.get(topic, topic) for topic in self._topics]
        if unknown := options.remap.keys() - self._topics:
            raise RmpaError(f"no topic {', '.join(sorted(unknown))} is played", code="unknown-name")
        if double := {name for name in names if names.count(name) > 1}:
            raise RmpaError(f"two topics are played as {', '.join(sorted(double))}", code="unknown-name")

    async def _published(self) -> dict[str, set[str]]:
        """The nodes that publish each topic, but for this one."""
        state: Any = (await call_api(self._node.master_uri, "getSystemState", self._node.name)).value
        return {topic: set(nodes) - {self._node.name} for topic, nodes in state[0]}

    async def _look(self) -> None:
        while True:
            await asyncio.sleep(_LOOK)
            with contextlib.suppress(RmpaError):  # the core is gone: what is connected goes on
                await self._judge(await self._published())

    async def _judge(self, published: Mapping[str, set[str]]) -> None:
        """Publish what no other node does, and leave the rest to the nodes that do."""
        for topic, sources in self._topics.items():
            name = self._options.remap.get(topic, topic)
            others = set() if self._options.over else published.get(name, set())
            recorded = {source: {source.node, f"{OWN_NODE}/{source.module}{source.node}"} for source in sources}
            replaced = {source for source, nodes in recorded.items() if nodes & others}
            if not others <= set().union(*recorded.values()):
                replaced = set(sources)  # it may stand in for any of them
            self._replaced = self._replaced - set(sources) | replaced
            publisher = self._publishers.get(topic)
            if replaced:
                self._leave(topic, f"{', '.join(sorted(others))} publishes it")
            elif self.left_out.pop(topic, None) is not None:
                self._told(f"played again: {topic}")
            if replaced == set(sources):
                if publisher is not None:
                    del self._publishers[topic]
                    await publisher.close()
            elif publisher is None:
                latching = any(source.latching for source in sources)
                first = sources[0]
                description = TopicDescription(first.type, first.md5sum, first.definition, latching)
                self._publishers[topic] = await self._node.advertise(name, description)
                for source in sources:
                    if source in self._latched:
                        self._publish(source, self._latched[source])

    def _leave(self, topic: str, why: str) -> None:
        if self.left_out.get(topic) != why:
            self.left_out[topic] = why
            self._told(f"not played: {topic}: {why}")

    async def _set_time(self, published: Mapping[str, set[str]]) -> None:
        if others := published.get(_CLOCK):
            text = f"{', '.join(sorted(others))} publishes {_CLOCK}: end it, or play without --clock"
            raise RmpaError(text, code="name-taken")
        await self._node.set_param(_BEFORE, await self._node.get_param(_SIM_TIME, default=_UNSET))
        await self._node.set_param(_SIM_TIME, True)
        if _CLOCK not in self._topics:
            self._publishers[_CLOCK] = await self._node.advertise(_CLOCK, MessageType("rosgraph_msgs/Clock"))

    async def _restore_time(self, published: Mapping[str, set[str]]) -> None:
        """Set ``/use_sim_time`` as it was before this player, or before one that was killed."""
        before = await self._node.get_param(_BEFORE, default=None)
        if before is None or published.get(_CLOCK):
            return
        with contextlib.suppress(RmpaError):  # another one has done it
            await (
                self._node.delete_param(_SIM_TIME) if before == _UNSET else self._node.set_param(_SIM_TIME, before)
            )
            await self._node.delete_param("/rmpa_play")

    async def _round(self) -> None:
        """Play it once."""
        options, begin = self._options, self._timeline.begin
        clock = options.clock and _CLOCK not in self._topics
        ticking = start_task(self._tick(), "publish the time") if clock else None
        self._next = self.now = begin + round(options.start * _SECOND)
        self._latched.clear()
        due = 0.0
        try:
            async with contextlib.aclosing(self._read()) as messages:
                async for message in messages:
                    at = (message.log_time - begin) / _SECOND
                    due = due or time.monotonic() - options.start / options.rate
                    if options.duration is not None and at > options.start + options.duration:
                        break
                    if at >= options.start:
                        self._next = message.log_time
                        due = await self._wait(due, at)
                        self.now, self.position = message.log_time, at
                    if message.source.latching:
                        self._latched[message.source] = message.data
                    self._publish(message.source, message.data)
        finally:
            await end_tasks(ticking)

    async def _read(self) -> AsyncGenerator[Recorded]:
        """Read ahead in a thread, so that nothing that is due waits for it."""
        messages, loop = self._played(), asyncio.get_running_loop()

        def batch() -> list[Recorded]:
            found, size = list[Recorded](), 0
            for message in messages:
                found.append(message)
                size += len(message.data)
                if len(found) >= _BATCH or size >= _BATCH_BYTES:
                    break
            return found

        ahead = loop.run_in_executor(None, batch)
        try:
            while found := await asyncio.shield(ahead):
                ahead = loop.run_in_executor(None, batch)
                for message in found:
                    yield message
        finally:
            await asyncio.wait([ahead])

    def _played(self) -> Iterator[Recorded]:
        """What is to be played; first, what latched before the start."""
        wanted = {source for sources in self._topics.values() for source in sources}
        start = self._timeline.begin + round(self._options.start * _SECOND)
        before: dict[RecordedSource, Recorded] = {}
        for message in self._timeline.messages(start):
            if message.source not in wanted:
                continue
            if message.log_time >= start:
                yield from before.values()
                before.clear()
                yield message
            elif message.source.latching or message.source.topic == STATIC:
                before[message.source] = message

    async def _wait(self, due: float, at: float) -> float:
        """Wait until the message of a time is due; returns when the recording's beginning would have been."""
        while True:
            if self.paused and self._steps:
                self._steps -= 1
                return time.monotonic() - at / self._options.rate
            left = due + at / self._options.rate - time.monotonic()
            if not self.paused and left <= _COARSE:
                if left > 0 or self.count % 64 == 0:
                    await asyncio.sleep(0)  # others of the loop take their turn
                if (left := due + at / self._options.rate - time.monotonic()) > 0:
                    time.sleep(left)  # noqa: ASYNC251 - the loop's own timers are a millisecond late
                return due
            self._woken.clear()
            paused_at = time.monotonic() if self.paused else None
            try:
                async with asyncio.timeout(None if self.paused else max(0.0, left - _COARSE)):
                    await self._woken.wait()
            except TimeoutError:
                continue
            if paused_at is not None:
                due += time.monotonic() - paused_at

    def _publish(self, source: RecordedSource, data: bytes) -> None:
        publisher = self._publishers.get(source.topic)
        if publisher is not None and source not in self._replaced:
            publisher.publish_raw(data)
            self.count += 1

    async def _tick(self) -> None:
        """Publish the time of the recording, which never goes back within a round."""
        shown, before = self.now, time.monotonic()
        while True:
            now = time.monotonic()
            if not self.paused:
                shown = min(shown + round((now - before) * self._options.rate * _SECOND), self._next)
            shown, before = max(shown, self.now), now
            self._publishers[_CLOCK].publish_raw(_TIME.pack(*divmod(shown, _SECOND)))
            await asyncio.sleep(_TICK)

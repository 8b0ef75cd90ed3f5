"""The recorder's process: what it takes, what happened, and what makes it keep a recording."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import logging
import os
import signal
import time
from collections import Counter
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa import client
from rmpa.bridge.kept import KEPT, REQUESTS, Kept, end_request, read_requests, recording_id, request_keep
from rmpa.config.recording import ALARM, CONTRACT, NODE_DIED, PEER_LOST, RecordSettings
from rmpa.core.errors import RmpaError
from rmpa.core.identity import is_own, matches_any
from rmpa.observe.control_client import ControlClient, choose_agent
from rmpa.record import limits
from rmpa.record.capture import Capture
from rmpa.record.format import (
    CLOCK,
    EVENT_SOURCE,
    MODULE,
    ClockRecord,
    Event,
    ModuleRecord,
    RecordedSource,
    SegmentWriter,
    event_bytes,
)
from rmpa.record.ring import RingThread
from rmpa.ros.node.node import Node
from rmpa.ros.types.definitions import ARRAY_TYPE, DiagnosticLevel
from rmpa.ros.types.messages import MessageType
from rmpa.runtime.files import replace_file
from rmpa.runtime.tasks import OwnedTasks, keep_task, start_task

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from rmpa.observe.snapshot import Snapshot

_log = logging.getLogger(__name__)
_SECOND: Final = 1_000_000_000
_MB: Final = 1_000_000
# Seconds between two looks for requests, and between two writings of the status.
_REQUESTS: Final = 0.2
_STATUS: Final = 5.0
# So many seconds behind the end of what is to be kept its request comes at the most; what it notes belongs to it.
_LATE: Final = 1.0
# Seconds from one snapshot of the agent to the next, where its graph does not change.
_PERIOD: Final = 5.0
# Seconds between two looks whether the core is still the same: they were half of what an idle recorder cost, and what
# is connected stays so while a core restarts.
_MASTER: Final = 5.0
# Seconds between two readings of the parameters, and bytes of them that a segment repeats.
_PARAMETERS: Final = 30.0
_PARAMETERS_MAX: Final = 1024 * 1024
STATUS: Final = "status.json"
_BOOL: Final = "std_msgs/Bool"


class RecorderStatus(msgspec.Struct, frozen=True, kw_only=True):
    """What the recorder of a module does, as ``status.json`` has it.

    Attributes:
        pid: Its process.
        since: When it began, Unix seconds.
        at: When this was written, Unix seconds.
        messages: By topic.
        size: Bytes of messages, by topic.
        left_out: Messages above the budgets, or that the disk did not take, by topic.
        written: Bytes written to the disk.
        ring: Bytes of the ring, and how far it goes back, seconds.
        bounds: The most bytes and seconds of the ring; ``None``: any.
        problem: Why nothing can be written; empty: all is well.
        failed: What could not be kept, the latest by its name: why.
    """

    pid: int
    since: float
    at: float
    messages: dict[str, int] = {}
    size: dict[str, int] = {}
    left_out: dict[str, int] = {}
    written: int = 0
    ring: tuple[int, float] = (0, 0.0)
    bounds: tuple[int, float | None] = (0, None)
    problem: str = ""
    failed: dict[str, str] = {}


class Recorder:
    """Records one module.

    Args:
        settings: What, and how much.
        folder: Its folder; made if it is missing.
        agent: The name of the module's agent.
        master_uri: The module's core.
        everything: Record what nodes of other modules publish, too.
    """

    def __init__(
        self, settings: RecordSettings, folder: Path, agent: str, master_uri: str, *, everything: bool = False
    ) -> None:
        self._settings = settings
        self._folder = folder
        self._agent = agent
        self._node = Node("rmpa_record", master_uri=master_uri)
        self._node.master_check = _MASTER
        self._module = ModuleRecord(name=agent)
        self._clocks: dict[str, str] = {}
        # This machine's wall clock less the monotonic one when the other clocks were read, ns.
        self._clocks_epoch = 0
        self._keeping: set[str] = set()
        self._failed: dict[str, str] = {}
        # By topic and name, what an alarm said last; empty: it is over.
        self._alarms_said: dict[tuple[str, str], str] = {}
        self._parameters = b""
        self._last: Snapshot | None = None
        self._kept_at: dict[str, float] = {}
        self._left_out: Counter[str] = Counter()
        self._since = time.time()
        self._work = OwnedTasks()
        listeners = {ARRAY_TYPE: self._alarms, _BOOL: self._stops}
        self.ring = RingThread(
            folder,
            self._begin,
            most_bytes=settings.megabytes * _MB,
            # When what happened behind a reason is there, too, all of the time before it must still be.
            most_seconds=(settings.seconds or float("inf")) + (settings.after or 0.0),
            fsync=settings.fsync,
            kept_bytes=settings.kept_megabytes * _MB,
        )
        self.capture = Capture(self._node, settings, self.ring.put, listeners, everything=everything)

    async def run(self, stop: asyncio.Event) -> None:
        """Record until ``stop`` is set.

        Raises:
            RmpaError: There is no core, or the folder cannot be made.
        """
        for name in (KEPT, REQUESTS):
            (self._folder / name).mkdir(parents=True, exist_ok=True)
        self.ring.start()
        tasks = [keep_task(one, name) for one, name in ((self._follow, "follow the agent"), (self._tend, "requests"))]
        try:
            async with self._node:
                await stop.wait()
        finally:
            for task in tasks:
                task.cancel()
            await self._work.close()
            await asyncio.to_thread(self.ring.end)
            self._write_status()

    def happened(self, event: Event) -> None:
        """Write an event, and keep a recording if it is a reason."""
        now = time.time_ns()
        self.ring.put(EVENT_SOURCE, now, now, event_bytes(msgspec.structs.replace(event, module=self._module.name)))
        if event.trigger:
            self._work.start(self._keep(event, now), "keep a recording")

    def _begin(self, writer: SegmentWriter, now: int) -> None:
        """The beginning of a segment; called in the ring's thread."""
        writer.metadata(MODULE, msgspec.to_builtins(self._module))
        if self._clocks and abs(_epoch() - self._clocks_epoch) < limits.CLOCK_STEP * _SECOND:  # else they are wrong
            writer.metadata(CLOCK, self._clocks)
        if self._parameters:
            writer.attachment("parameters.json", "application/json", self._parameters, now)
        for source, (first, raw) in list(self.capture.latched.items()):
            with contextlib.suppress(ValueError):  # it was counted as lost
                writer.write(source, now, first, raw)
        before, self._left_out = self._left_out, self._all_left_out()
        if counts := self._left_out - before:
            text = f"left out: {', '.join(f'{n} of {topic}' for topic, n in counts.items())}"
            event = Event("left_out", text, module=self._module.name, facts=dict(counts))
            writer.write(EVENT_SOURCE, now, now, event_bytes(event))

    def _all_left_out(self) -> Counter[str]:
        """Messages above the budgets, or that the disk did not take, by topic; called in any thread."""
        return Counter(self.capture.left_out) + Counter(self.ring.lost)

    async def _follow(self) -> None:
        """Follow the agent: what there is to record, and what happens."""
        read = 0.0
        async with client.AgentClient(self._agent) as agent:
            async for now in agent.snapshots(period=_PERIOD):
                if isinstance(now, client.AgentLost):
                    self.happened(Event("agent_lost", now.problem))
                    continue
                self._module = msgspec.convert(now.agent, ModuleRecord, from_attributes=True)
                self._clocks_epoch = _epoch()
                self._clocks = {
                    peer.name: msgspec.json.encode(
                        ClockRecord(round(now.taken * 1e9), peer.link.clock_offset, peer.link.clock_error)
                    ).decode()
                    for peer in now.peers
                    if peer.link is not None and peer.link.clock_offset is not None
                }
                for event in _events(self._last, now):
                    self.happened(self._judged(event))
                graph_changed = self._last is None or self._last.topics != now.topics
                self._last = now
                await self.capture.update(now.topics)
                if graph_changed or time.monotonic() - read > _PARAMETERS:
                    read = time.monotonic()
                    await self._read_parameters()

    async def _read_parameters(self) -> None:
        with contextlib.suppress(RmpaError):
            found = msgspec.json.encode(await self._node.get_param("/", default={}), enc_hook=str)
            self._parameters = found if len(found) <= _PARAMETERS_MAX else b""

    def _judged(self, event: Event) -> Event:
        return msgspec.structs.replace(event, trigger=event.kind in self._settings.keep_on)

    def _alarms(self, source: RecordedSource, raw: bytes) -> None:
        """Look for alarms of resources in a ``DiagnosticArray``."""
        if not source.topic.endswith("/alarms"):
            return
        for status in _ARRAY.deserialize(raw).status:
            level = int(status.level)
            raised = level in (DiagnosticLevel.WARN, DiagnosticLevel.ERROR)
            key, said = (source.topic, str(status.name)), str(status.message) if raised else ""
            if self._alarms_said.get(key, "") == said:
                continue  # some publish the state of their alarms all the time
            self._alarms_said[key] = said
            facts: dict[str, Any] = {str(pair.key): str(pair.value) for pair in status.values}
            event = Event(ALARM if raised else "alarm_over", str(status.message), source.node, facts=facts)
            self.happened(self._judged(event))

    def _stops(self, source: RecordedSource, raw: bytes) -> None:
        """Look for an emergency stop."""
        if raw[:1] != b"\0" and matches_any(self._settings.stop_topics, source.topic):
            self.happened(Event("stop", f"emergency stop on {source.topic}", source.topic, trigger=True))

    async def _keep(self, event: Event, now: int) -> None:
        """Ask the agent to keep a recording, here and at all peers; without an agent, here alone."""
        if time.monotonic() - self._kept_at.get(event.kind, float("-inf")) < limits.KEEP_AGAIN:
            return
        self._kept_at[event.kind] = time.monotonic()
        after, seconds = self._settings.after or 0.0, self._settings.seconds or 86_400.0
        kept = Kept(
            id=recording_id(event.kind, self._module.name, now),
            why=event.text,
            since=now - round(seconds * _SECOND),
            until=now + round(after * _SECOND),
            asked_by=self._module.name,
        )
        try:
            await asyncio.to_thread(self._ask_agent, kept)
        except RmpaError as error:
            _log.warning("! only this module keeps %s: %s [%s]", kept.id, error, error.code)
            await asyncio.to_thread(request_keep, self._folder, kept)

    def _ask_agent(self, kept: Kept) -> None:
        with ControlClient(choose_agent(os.environ, self._agent).path) as agent:
            agent.call("record", object, what="keep", kept=msgspec.to_builtins(kept))

    async def _tend(self) -> None:
        """Do what is requested by files, and write the status."""
        status, seen, requests = 0.0, 0, self._folder / REQUESTS
        while True:
            changed = requests.stat().st_mtime_ns  # one call of the kernel: the folder is read when it has changed
            if changed != seen:
                for kept in await asyncio.to_thread(lambda: list(read_requests(self._folder))):
                    if kept.id not in self._keeping:
                        self._keeping.add(kept.id)
                        self._work.start(self._kept(kept), f"keep {kept.id}")
                seen = changed
            if time.monotonic() - status >= _STATUS:
                status = time.monotonic()
                await asyncio.to_thread(self._write_status)
            await asyncio.sleep(_REQUESTS)

    async def _kept(self, kept: Kept) -> None:
        epoch = _epoch()  # from here on it does not matter whether the clock is set
        self.happened(Event("kept", f"{kept.id}: {kept.why}", kept.asked_by))  # where nothing else happens, too
        since, until = ((at - epoch) / _SECOND for at in (kept.since, kept.until))
        await asyncio.sleep(max(0.0, until - time.monotonic()))
        kept = msgspec.structs.replace(kept, module=self._module.name)
        await asyncio.to_thread(self._write_status)  # what was left out until now is asked for with the recording
        try:
            made = await asyncio.wrap_future(self.ring.call(self.ring.keep, kept, since, until + _LATE))
            why = "nothing of that time is here" + (f": {self.ring.problem}" if self.ring.problem else "")
        except (OSError, RmpaError) as error:
            made, why = None, f"{self._folder}: {getattr(error, 'strerror', None) or error}"
        with contextlib.suppress(OSError):
            await asyncio.to_thread(end_request, self._folder, kept)
            self._keeping.discard(kept.id)
        if made is not None:
            _log.info("= kept %s: %s, %.1f MB in %d files", made.id, made.why, made.size / _MB, len(made.files))
            return
        _log.warning("! %s is not kept: %s [recording-stopped]", kept.id, why)
        self._failed[kept.id] = why
        while len(self._failed) > limits.FAILED:
            del self._failed[next(iter(self._failed))]
        await asyncio.to_thread(self._write_status)

    def _write_status(self) -> None:
        segments = list(self.ring.segments)
        back = time.monotonic() - segments[0].began if segments else 0.0
        status = RecorderStatus(
            pid=os.getpid(),
            since=self._since,
            at=time.time(),
            messages=dict(self.capture.count),
            size=dict(self.capture.bytes),
            left_out=dict(self._all_left_out()),
            written=self.ring.written,
            ring=(sum(one.size for one in segments), back),
            bounds=(self._settings.megabytes * _MB, self._settings.seconds),
            problem=self.ring.problem,
            failed=dict(self._failed),
        )
        with contextlib.suppress(OSError):  # the disk is full: the log says so
            replace_file(self._folder / STATUS, msgspec.json.encode(status))


_ARRAY: Final = MessageType(ARRAY_TYPE)


def _epoch() -> int:
    """The wall clock less the monotonic one, ns: it changes where the wall clock is set."""
    return time.time_ns() - time.monotonic_ns()


def _events(before: Snapshot | None, after: Snapshot) -> Iterator[Event]:
    """What happened between two snapshots."""
    if before is None:
        return
    for change in client.changes(before, after):
        if (event := _event(change)) is not None:
            yield event
    nodes, known, told = _nodes(after), _nodes(before), {one.node for one in before.unreachable}
    died = {node for node, _ in set(after.died).difference(before.died)}
    dead = {node: f"{node} died: no process listens where it did" for node in died & known}
    dead |= {one.node: f"{one.node} does not answer: {one.problem}" for one in after.unreachable}
    yield from (Event(NODE_DIED, dead[node], node) for node in sorted(dead.keys() - told))
    yield from (Event("node_gone", f"{node} is gone", node) for node in sorted(known - nodes - dead.keys()))
    yield from (Event("node_came", f"{node} is there", node) for node in sorted(nodes - known))


def _nodes(snapshot: Snapshot) -> set[str]:
    """The nodes of the module that publish or subscribe."""
    found = {node for topic in snapshot.topics for node in (*topic.publishers, *topic.subscribers)}
    return {node for node in found if not is_own(node) and not node.startswith("/rmpa_")}  # nodes of our commands


def _event(change: client.AgentEvent) -> Event | None:
    match change:
        case client.PeerLost():
            text = f"the link to {change.peer.name} is lost: {change.peer.last_error}"
            return Event(PEER_LOST, text, change.peer.name)
        case client.PeerLinked():
            return Event("peer_linked", f"{change.peer.name} is linked", change.peer.name)
        case client.TopicAppeared():
            return Event("topic_came", f"{change.topic.name} is there", change.topic.name)
        case client.TopicGone():
            return Event("topic_gone", f"{change.topic.name} is gone", change.topic.name)
        case client.ServiceAppeared():
            return Event("service_came", f"{change.service.name} is there", change.service.name)
        case client.ServiceGone():
            return Event("service_gone", f"{change.service.name} is gone", change.service.name)
        case client.ContractBroken():
            text = f"{change.topic}: {change.kind.replace('_', ' ')}, {change.count} times ({change.peer})"
            return Event(CONTRACT, text, change.topic, facts={"kind": change.kind, "count": change.count})
        case client.NoteRaised():
            return Event("note", change.text)
        case client.NoteCleared():
            return Event("note_over", change.text)
    return None


async def record_file(
    settings: RecordSettings,
    folder: Path,
    agent: str,
    master_uri: str,
    progress: Callable[[float, int, int], bool],
    duration: float | None,
    *,
    everything: bool = False,
) -> dict[str, int]:
    """Record by hand into segments, until Ctrl-C.

    Args:
        settings: Which topics, and how much.
        folder: Where the segments go.
        agent: The name of the module's agent.
        master_uri: The module's core.
        progress: Called several times a second with seconds, messages and bytes so far; true: it is enough.
        duration: The most seconds; ``None``: any.
        everything: Record what nodes of other modules publish, too.

    Returns:
        The number of messages, by topic.

    Raises:
        RmpaError: There is no core.
    """
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    endless = dataclasses.replace(settings, seconds=None, megabytes=1_000_000, keep_on=(), stop_topics=())
    recorder = Recorder(endless, folder, agent, master_uri, everything=everything)
    running = start_task(recorder.run(stop), "record", raises=(RmpaError,))
    began = time.monotonic()
    while not running.done():
        seconds, capture = time.monotonic() - began, recorder.capture
        enough = progress(seconds, capture.count.total(), capture.bytes.total())
        if enough or (duration is not None and seconds >= duration):
            stop.set()
        await asyncio.wait([running], timeout=_REQUESTS)
    await running
    return dict(recorder.capture.count)

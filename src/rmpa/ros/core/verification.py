"""Verifies the nodes restored from the previous run: those that still run are registered again, the others discarded.

A rospy node gives its name in ``getName``, a roscpp node in the header of a topic that it publishes. A node is gone
if its port refuses connections, or another node has the port. One that does not answer is asked again for
``limits.VERIFY_PATIENCE``. What a node registered or unregistered while there was no core follows from its own lists
(``getPublications``, ``getSubscriptions``), which are compared last.
"""

from __future__ import annotations

import asyncio
import enum
import logging
import random
from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.core.backoff import Backoff
from rmpa.core.errors import RemoteProtocolError, RmpaError, UnreachableError
from rmpa.ros import limits
from rmpa.ros.core.identify import name_at
from rmpa.ros.core.liveness import is_gone, listening_ports
from rmpa.ros.http.client import call_api
from rmpa.ros.master.effects import RegistrationKind
from rmpa.ros.node.local_addresses import local_addresses
from rmpa.ros.wire.xmlrpc import RosFault
from rmpa.runtime.event_loop import yield_to_data

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.ros.master.registrations import Registrations
    from rmpa.ros.master.unverified import NodeRecord
    from rmpa.ros.wire.xmlrpc import RosReply

_log = logging.getLogger(__name__)
_CALLER_ID: Final = "/rmpa_identify"
_LISTS: Final = ((RegistrationKind.PUBLISHER, "getPublications"), (RegistrationKind.SUBSCRIBER, "getSubscriptions"))


class _ProbeResult(enum.Enum):
    """The result of a probe of the address of restored nodes."""

    UP = "it is still that node"
    GONE = "no process listens there"
    OTHER = "another node is there"
    SILENT = "it does not answer"


@dataclass(slots=True)
class VerificationCounts:
    """Counts of the restored nodes.

    Args:
        nodes: All.
        up: Those that answered and are registered again.
        gone: Those at whose address nothing or another node listens.
        given_up: Those that did not answer for ``limits.VERIFY_PATIENCE``.
    """

    nodes: int = 0
    up: int = 0
    gone: int = 0
    given_up: int = 0


class NodeVerification:
    """Verifies the unverified nodes of one master.

    Args:
        registrations: The master's tables.
        carry_out: Called after each change of the tables.
    """

    def __init__(self, registrations: Registrations, carry_out: Callable[[], None]) -> None:
        self._registrations = registrations
        self._carry_out = carry_out
        self.counts = VerificationCounts()
        self._slots = asyncio.Semaphore(limits.VERIFY_AT_ONCE)
        self._lists = asyncio.Semaphore(limits.VERIFY_LISTS)
        self._tasks: set[asyncio.Task[None]] = set()
        self._at_start: defaultdict[str, list[str]] = defaultdict(list)
        self._first = 0
        self._queued: set[str] = set()
        """Addresses that were not asked yet, or whose first answer is awaited for less than
        ``limits.VERIFY_PROMPT``."""
        self._all_asked = asyncio.Event()
        self._published: dict[str, None] = {}
        self._subscribed: list[tuple[str, str]] = []
        self._notification_timer: asyncio.TimerHandle | None = None

    def start(self) -> None:
        """Begin to verify all unverified nodes, in tasks."""
        loop = asyncio.get_running_loop()
        for node, api in self.silent.items():
            self._at_start[api].append(node)
        self.counts.nodes = len(self._registrations.unverified)
        self._first = len(self._at_start)
        self._queued = set(self._at_start)
        for api in self._at_start:
            task = loop.create_task(self._verify(api), name=f"verify {api}")
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    async def close(self) -> None:
        """Stop; nodes that have not answered stay unverified."""
        tasks = list(self._tasks)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        if self._notification_timer is not None:
            self._notification_timer.cancel()

    @property
    def all_asked(self) -> bool:
        """Whether each restored node has been probed at least once."""
        return self._all_asked.is_set()

    @property
    def silent(self) -> dict[str, str]:
        """Nodes that have not answered yet, and the URIs of their slave APIs."""
        awaited = self._registrations.unverified
        return {node: record.api for node in awaited if (record := awaited.get(node)) is not None}

    # --- one address ------------------------------------------------------------------------------------------

    async def _verify(self, api: str) -> None:
        loop = asyncio.get_running_loop()
        deadline = loop.time() + limits.VERIFY_PATIENCE
        backoff = Backoff(limits.VERIFY_RETRY_FIRST, limits.VERIFY_RETRY_MAX, random.random)
        first = True
        try:
            while nodes := self._at(api):
                result = await self._ask(api, nodes)
                if result is _ProbeResult.SILENT and loop.time() > deadline:
                    self.counts.given_up += len(nodes)
                    self._discard(nodes, api, f"it did not answer for {limits.VERIFY_PATIENCE:g} s")
                elif result is _ProbeResult.UP:
                    self._confirm(self._at(api))
                elif result is not _ProbeResult.SILENT:
                    self.counts.gone += len(nodes)
                    self._discard(nodes, api, result.value)
                first = self._asked(first)
                if result is not _ProbeResult.SILENT:
                    await self._compare(api, nodes if result is _ProbeResult.UP else {})
                    return
                await asyncio.sleep(backoff.delay())
        except Exception:  # noqa: BLE001 - a task's top
            _log.exception("! the node at %s cannot be taken up", api)
        finally:
            self._asked(first)
            self._unqueue(api)

    def _at(self, api: str) -> dict[str, NodeRecord]:
        """The unverified nodes with this slave API: nodelets share one."""
        awaited = self._registrations.unverified
        found = {node: awaited.get(node) for node in self._at_start[api]}
        return {node: record for node, record in found.items() if record is not None and record.api == api}

    async def _ask(self, api: str, nodes: dict[str, NodeRecord]) -> _ProbeResult:
        """Probe an address.

        At most ``limits.VERIFY_AT_ONCE`` probes run at once; one that takes longer than ``limits.VERIFY_PROMPT`` no
        longer counts among them.
        """
        await self._slots.acquire()
        held = True

        def leave() -> None:
            nonlocal held
            if held:
                held = False
                self._slots.release()
                self._unqueue(api)

        timer = asyncio.get_running_loop().call_later(limits.VERIFY_PROMPT, leave)
        try:
            return await _probe(api, nodes)
        finally:
            timer.cancel()
            leave()

    def _unqueue(self, api: str) -> None:
        """Note that an address has answered or is slow; after the last one, notify the subscribers."""
        self._queued.discard(api)
        if not self._queued:
            self._schedule_notifications(0.0)

    def _confirm(self, nodes: dict[str, NodeRecord]) -> None:
        for node in nodes:
            published, subscribed = self._registrations.confirm(node)
            self._published.update(dict.fromkeys(published))
            self._subscribed += [(topic, node) for topic in subscribed]
            self.counts.up += 1
            self._carry_out()
            yield_to_data()
        self._schedule_notifications(limits.VERIFY_ANNOUNCE if self._queued else 0.0)

    def _schedule_notifications(self, seconds: float) -> None:
        if not seconds and self._notification_timer is not None:
            self._notification_timer.cancel()
            self._notification_timer = None
        if self._notification_timer is None and (self._published or self._subscribed):
            self._notification_timer = asyncio.get_running_loop().call_later(seconds, self._notify_subscribers)

    def _notify_subscribers(self) -> None:
        self._notification_timer = None
        published, self._published = self._published, {}
        subscribed, self._subscribed = self._subscribed, []
        for topic, node in subscribed:
            self._registrations.notify_subscriber(topic, node)
            self._carry_out()
            yield_to_data()
        for topic in published:
            self._registrations.notify_new_subscribers(topic)
            self._carry_out()
            yield_to_data()

    def _discard(self, nodes: dict[str, NodeRecord], api: str, why: str) -> None:
        for node in nodes:
            _log.info("= node %s at %s, of the run before, is not taken up: %s", node, api, why)
            self._registrations.discard(node)
            self._carry_out()

    def _asked(self, first: bool) -> bool:
        """Count an address that has been asked for the first time; return ``False``, the next value of ``first``."""
        if first:
            self._first -= 1
            if not self._first:
                self._all_asked.set()
                _log.info("= %s", self.summary())
        return False

    def summary(self) -> str:
        """``12 of 15 nodes of the run before are taken up, 1 does not answer yet, 2 are gone``."""
        counts = self.counts
        parts = [f"{counts.up} of {counts.nodes} nodes of the run before are taken up"]
        if silent := len(self._registrations.unverified):
            parts.append(f"{silent} {'does' if silent == 1 else 'do'} not answer yet")
        if counts.gone:
            parts.append(f"{counts.gone} {'is' if counts.gone == 1 else 'are'} gone")
        if counts.given_up:
            parts.append(f"{counts.given_up} did not answer for {limits.VERIFY_PATIENCE:g} s")
        return ", ".join(parts)

    # --- what changed while there was no core -----------------------------------------------------------------

    async def _compare(self, api: str, nodes: dict[str, NodeRecord]) -> None:
        """Make the registrations of a node equal to its own lists."""
        if len(nodes) != 1:
            return  # the lists of nodelets do not say which node an entry belongs to
        await self._all_asked.wait()
        [node] = nodes
        registrations = self._registrations
        async with self._lists:
            for kind, method in _LISTS:
                for _ in range(limits.VERIFY_COMPARED):
                    mark = registrations.revisions.get(node)
                    try:
                        listed = _topics(await call_api(api, method, _CALLER_ID))
                    except (RmpaError, RosFault) as error:
                        _log.debug("= %s does not tell what it has: %s", node, error)
                        return
                    if listed is None or registrations.node_api(node) != api:
                        return
                    if registrations.revisions.get(node) == mark:  # else the node changed meanwhile: ask again
                        self._adjust(kind, node, api, listed)
                        break

    def _adjust(self, kind: RegistrationKind, node: str, api: str, listed: dict[str, str]) -> None:
        registrations = self._registrations
        record = registrations.record(node)
        known = record.of(kind) if record is not None else {}
        for topic in known.keys() - listed.keys():
            registrations.unregister(kind, topic, node, api)
        for topic in listed.keys() - known.keys():
            if kind is RegistrationKind.PUBLISHER:
                registrations.register_publisher(topic, listed[topic], node, api)
            else:
                registrations.register_subscriber(topic, listed[topic], node, api)
                registrations.notify_subscriber(topic, node)
        self._carry_out()


async def any_left(nodes: Mapping[str, NodeRecord]) -> bool:
    """Whether one of these nodes still runs; a node that does not answer counts as running."""
    if not nodes:
        return False
    try:
        ports, addresses = await asyncio.to_thread(lambda: (listening_ports(), set(local_addresses())))
    except OSError:  # such as no file descriptor left to ask the kernel
        ports, addresses = None, set()
    found: defaultdict[str, dict[str, NodeRecord]] = defaultdict(dict)
    for name, record in nodes.items():
        if not is_gone(record.api, ports, addresses):
            found[record.api][name] = record
    slots = asyncio.Semaphore(limits.VERIFY_AT_ONCE)

    async def is_left(api: str) -> bool:
        async with slots:
            return await _probe(api, found[api]) in (_ProbeResult.UP, _ProbeResult.SILENT)

    asking = [asyncio.create_task(is_left(api), name=f"verify {api}") for api in found]
    try:
        for answer in asyncio.as_completed(asking, timeout=limits.VERIFY_START):
            if await answer:
                return True
    except TimeoutError:
        return True
    finally:
        for task in asking:
            task.cancel()
        await asyncio.gather(*asking, return_exceptions=True)
    return False


async def _probe(api: str, nodes: dict[str, NodeRecord]) -> _ProbeResult:
    topics = [topic for record in nodes.values() for topic in record.publishers if topic != "/rosout"]
    try:
        found = await name_at(api, topics)
        if found is None:
            knows = await _has_registrations(api, nodes)
            if knows is None:
                return _ProbeResult.SILENT
            if knows:
                return _ProbeResult.UP
            # A publisher sends its name in a header, unless it is too busy at present.
            return _ProbeResult.SILENT if topics else _ProbeResult.OTHER
    except UnreachableError as error:
        return _ProbeResult.GONE if isinstance(error.__cause__, ConnectionRefusedError) else _ProbeResult.SILENT
    except (RosFault, RemoteProtocolError):
        return _ProbeResult.OTHER
    return _ProbeResult.UP if found in nodes else _ProbeResult.OTHER


async def _has_registrations(api: str, nodes: dict[str, NodeRecord]) -> bool | None:
    """Whether the node at an address lists all topics that the restored nodes had registered, and at least one.

    For a node whose name cannot be found out. ``None`` if the node does not answer with its lists either.
    """
    for kind, method in _LISTS:
        had = {topic for record in nodes.values() for topic in record.of(kind)}
        if not had:
            continue
        listed = _topics(await call_api(api, method, _CALLER_ID))
        if listed is None:
            return None
        if not had <= listed.keys():
            return False
    return any(record.publishers or record.subscribers for record in nodes.values())


def _topics(reply: RosReply) -> dict[str, str] | None:
    """The topics and types of a node's list; ``None`` if the node answers with an error or with no list."""
    if reply.code != 1 or not isinstance(reply.value, list):
        return None
    found = {}
    for entry in reply.value:
        match entry:
            case [str(topic), str(topic_type)] if topic.startswith("/"):
                found[topic] = topic_type
    return found

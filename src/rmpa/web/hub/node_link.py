"""The hub's node, its clients with their rights, and the turns of their messages.

The hub's node, made anew when its master was away or has shut it down, and what is registered with it.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Generic, TypeAlias, TypeVar

from rmpa.config.peer_rules import Access
from rmpa.core.counters import logged_failure
from rmpa.core.errors import PeerRefused, RmpaError, UnreachableError
from rmpa.ros.master.parameters import canonical, leaves
from rmpa.web import limits

if TYPE_CHECKING:
    from collections.abc import Awaitable

    from rmpa.ros.node.node import Node
    from rmpa.ros.wire.xmlrpc import XmlRpcValue
    from rmpa.trust.permissions import Permissions
    from rmpa.web.hub.requests import Answer, ParamValue


# The messages that wait for one client: a queue for each subscription, bounded in bytes, served in turn. No I/O.
#
# Higher priorities go first; the subscriptions of one priority take turns, a message each, so that a map does not
# hold
# up commands. Beyond a bound the oldest message of the subscription with the most bytes is dropped, of the lowest
# priority first. Handle 0 is for all that is no message of a subscription: it goes before all else and is never
# dropped; a client that lets it grow beyond the bound does not read at all, and is to be disconnected
# (``overflow``).


_T = TypeVar("_T")


@dataclass(slots=True)
class _Queue(Generic[_T]):
    handle: int
    priority: int
    entries: deque[tuple[_T, int]] = field(default_factory=deque)
    size: int = 0


class FairQueue(Generic[_T]):
    """The queues of one client.

    Args:
        total_bytes: Bytes of all entries together. One message always fits where no other waits.
        subscription_bytes: Bytes of one subscription; its newest message always fits.
    """

    def __init__(
        self,
        total_bytes: int = limits.CLIENT_QUEUE_BYTES,
        subscription_bytes: int = limits.SUBSCRIPTION_QUEUE_BYTES,
    ) -> None:
        self._total = total_bytes
        self._each = subscription_bytes
        self._urgent: deque[tuple[_T, int]] = deque()
        self._urgent_bytes = 0
        self._data_bytes = 0
        self._queues: dict[int, _Queue[_T]] = {}
        self._turns: dict[int, deque[_Queue[_T]]] = {}
        """The subscriptions that have entries, by priority, in the order of their turns."""
        self.dropped: Counter[int] = Counter()
        """Messages dropped so far, by handle, of the present subscriptions."""
        self.dropped_total = 0
        """Messages dropped so far, those of ended subscriptions included."""

    def __bool__(self) -> bool:
        """Whether there is anything to send."""
        return bool(self._urgent or self._turns)

    @property
    def bytes(self) -> int:
        """Bytes that wait."""
        return self._urgent_bytes + self._data_bytes

    @property
    def overflow(self) -> bool:
        """Whether the entries of handle 0 alone exceed the bound."""
        return self._urgent_bytes > self._total

    @property
    def waiting(self) -> Mapping[int, int]:
        """Messages that wait, by handle."""
        return {queue.handle: len(queue.entries) for queue in self._queues.values() if queue.entries}

    def push(self, handle: int, entry: _T, size: int, priority: int = 0) -> int:
        """Add an entry; returns the number of older ones that were dropped for it.

        Args:
            handle: The subscription; 0 for an entry that is never dropped.
            entry: What is to be sent.
            size: Its bytes.
            priority: Of the subscription; a higher one is served first.
        """
        if handle == 0:
            self._urgent.append((entry, size))
            self._urgent_bytes += size
            return self._make_room(None)
        queue = self._queues.get(handle)
        if queue is None:
            queue = self._queues[handle] = _Queue(handle, priority)
        if not queue.entries:
            queue.priority = priority
            self._turns.setdefault(priority, deque()).append(queue)
        queue.entries.append((entry, size))
        queue.size += size
        self._data_bytes += size
        dropped = 0
        while queue.size > self._each and len(queue.entries) > 1:
            self._drop_oldest(queue)
            dropped += 1
        return dropped + self._make_room(queue)

    def pop(self) -> _T | None:
        """The next entry; ``None`` where there is none."""
        if self._urgent:
            entry, size = self._urgent.popleft()
            self._urgent_bytes -= size
            return entry
        if not self._turns:
            return None
        priority = max(self._turns)
        turns = self._turns[priority]
        queue = turns.popleft()
        entry, size = queue.entries.popleft()
        queue.size -= size
        self._data_bytes -= size
        if queue.entries:
            turns.append(queue)
        elif not turns:
            del self._turns[priority]
        return entry

    def end(self, handle: int) -> None:
        """Forget a subscription, and what waits for it."""
        self.dropped.pop(handle, None)
        queue = self._queues.pop(handle, None)
        if queue is not None and queue.entries:
            self._data_bytes -= queue.size
            self._forget_turn(queue)

    def clear(self) -> None:
        """Forget everything that waits."""
        self._urgent.clear()
        self._turns.clear()
        self._queues.clear()
        self._urgent_bytes = self._data_bytes = 0

    # --- inside -----------------------------------------------------------------------------------------------

    def _make_room(self, newest: _Queue[_T] | None) -> int:
        """Drop until all together fit; the newest message stays where it is the only one."""
        dropped = 0
        while self.bytes > self._total and self._turns:
            turns = self._turns[min(self._turns)]
            fullest = max(turns, key=lambda queue: queue.size)
            if fullest is newest and len(fullest.entries) == 1:
                if len(self._turns) == 1 and len(turns) == 1 and not self._urgent:
                    break
                # Others of the same or a higher priority wait: the newest gives way if it alone has this priority.
                others = [queue for queue in turns if queue is not newest]
                fullest = max(others, key=lambda queue: queue.size) if others else fullest
            self._drop_oldest(fullest)
            dropped += 1
        return dropped

    def _drop_oldest(self, queue: _Queue[_T]) -> None:
        _, size = queue.entries.popleft()
        queue.size -= size
        self._data_bytes -= size
        self.dropped[queue.handle] += 1
        self.dropped_total += 1
        if not queue.entries:
            self._forget_turn(queue)

    def _forget_turn(self, queue: _Queue[_T]) -> None:
        turns = self._turns[queue.priority]
        turns.remove(queue)
        if not turns:
            del self._turns[queue.priority]


# What clients may do: kinds of acts by ``[web]``, and names by the rules of ``[[permission]]``.


_WHO: Final = "the web server"
_NODE: Final = "web"
"""The name of ``rmpa web`` for the rules."""


@dataclass(frozen=True, slots=True)
class Rights:
    """What clients may do beyond reading topics and the graph; nothing unless it is said.

    Attributes:
        view: Read parameters, and files of ROS packages.
        control: Publish, call and offer services, set parameters, choose a Smart Resource's profile and context.
        drive: Command a robot by the monitor's joystick.
        command_age: Seconds that what a client publishes, calls and sets may be old; 0: any age.
    """

    view: bool = False
    control: bool = False
    drive: bool = False
    command_age: float = 0.0


@dataclass(frozen=True, slots=True)
class NodeRules:
    """What the node of ``rmpa web`` may do, by names: for ``[[permission]]`` it is the module ``web``.

    Args:
        permissions: Judges; ``None``: it may do everything.
    """

    permissions: Permissions | None = None

    def check(self, access: Access, name: str) -> None:
        """Check one name.

        Raises:
            PeerRefused: It may not; the text has the rule.
        """
        if self.permissions is not None:
            decision = self.permissions.judge(access, _NODE, _resolved(name))
            if not decision.allowed:
                raise PeerRefused(_WHO, f"{_NODE} may not {access} {name}", decision.rule)

    def check_param_change(self, name: str, value_of: Callable[[str], ParamValue], after: ParamValue = None) -> None:
        """Check each parameter that a change of a name replaces, makes or removes; raises as ``check``.

        Args:
            name: A parameter, or a namespace, which is changed as a whole.
            value_of: Returns the present value of a name; ``None`` if there is none.
            after: Its next value; ``None``: it is deleted.
        """
        if self.permissions is None:
            return
        if (key := _bad_key(after)) is not None:
            # A core tells /motors/limit of the change where a key below /speed is that name.
            text = f"{_NODE} may not set {name}: the key {key[:80]!r} is not one part of a name"
            raise PeerRefused(_WHO, text, "write a namespace as a value of values")
        name = _resolved(name)
        values = value_of(name), after
        changed = {leaf for value in values for leaf, each in leaves(name, value) if each is not None}
        # A parameter that stands where a namespace is needed is replaced by one.
        above = [name[:at] for at in range(1, len(name)) if name[at] == "/"]
        changed |= {each for each in above if not isinstance(value_of(each), Mapping | None)}
        for each in sorted(changed) or [name]:
            self.check(Access.PARAM, each)

    def visible(self, values: Mapping[str, ParamValue]) -> Mapping[str, ParamValue]:
        """Those of some parameters that clients may read.

        Args:
            values: Values by global names; a namespace is a mapping.
        """
        if self.permissions is None:
            return values
        shown = {name: self._pruned(name, value) for name, value in values.items()}
        return {name: value for name, value in shown.items() if value is not _HIDDEN}

    def visible_tree(self, tree: Mapping[str, ParamValue]) -> Mapping[str, ParamValue]:
        """The same of a tree of parameters, whose keys are names below the root."""
        if self.permissions is None:
            return tree
        return {name[1:]: value for name, value in self.visible({f"/{key}": tree[key] for key in tree}).items()}

    def _pruned(self, name: str, value: ParamValue) -> ParamValue:
        """A parameter without what is denied; ``_HIDDEN``: nothing is left."""
        if not isinstance(value, Mapping):
            try:
                self.check(Access.PARAM, name)
            except PeerRefused:
                return _HIDDEN
            return value
        pruned = {key: self._pruned(f"{name}/{key}", each) for key, each in value.items()}
        kept = {key: each for key, each in pruned.items() if each is not _HIDDEN}
        return kept if kept or not value else _HIDDEN


_HIDDEN: Final[ParamValue] = object()  # type: ignore[assignment] # it is compared by identity, and never shown


def _resolved(name: str) -> str:
    """A name as the core resolves it: ``//a/`` is ``/a``, and so is ``a``."""
    return canonical(f"/{name}")


def _bad_key(value: ParamValue) -> str | None:
    """A key in a namespace, at any depth, that a core takes for another name than that of a parameter in it."""
    if not isinstance(value, Mapping):
        return None
    for key, each in value.items():
        if not key or "/" in key:
            return key
        if (inner := _bad_key(each)) is not None:
            return inner
    return None


EVERYTHING = NodeRules()
READ_ONLY = Rights()
FULL = Rights(view=True, control=True)
"""Everything but ``drive``, which has a setting of its own."""
CONTROL_REMEDY = "start rmpa web with --control, and give its token"
"""For clients that want to change something."""
READ_REMEDY = "send the token of rmpa web; where it has none, start it with --token-file FILE or --control"
"""For clients that want to read what only clients with the token may."""


_log = logging.getLogger(__name__)

_U = TypeVar("_U")

MakeNode: TypeAlias = "Callable[[str, Callable[[str, XmlRpcValue], None]], Node]"
"""Makes a node that is not started: ``(master URI, on_param_update)``."""
Where: TypeAlias = "Callable[[], Awaitable[str]]"
"""Finds the master's URI; raises ``RmpaError`` while there is none."""


class NodeLink:
    """Keeps a node running.

    Args:
        where: Finds the master.
        make: Makes a node.
        on_param_update: ``(key, value)``: a parameter has changed that the node follows.
        rules: What the node may do.
    """

    def __init__(
        self,
        where: Where,
        make: MakeNode,
        on_param_update: Callable[[str, XmlRpcValue], None],
        rules: NodeRules = EVERYTHING,
    ) -> None:
        self.rules = rules
        self._where = where
        self._make = make
        self._on_param_update = on_param_update
        self._task: asyncio.Task[None] | None = None
        self._ready: asyncio.Event = asyncio.Event()
        self.node: Node | None = None
        """The node, while the master knows it."""
        self.problem = "the ROS master was not asked yet"
        """Why there is no node; empty while there is one."""
        self.on_node: list[Callable[[Node], None]] = []
        """Called with each new node."""
        self.on_registration: list[Callable[[], None]] = []
        """Called when something was registered or withdrawn."""

    def registration_changed(self) -> None:
        """Call ``on_registration``."""
        for callback in self.on_registration:
            with logged_failure(_log, "what follows a registration failed"):
                callback()

    def start(self) -> None:
        """Begin, in a task."""
        self._task = asyncio.get_running_loop().create_task(self._run(), name="node of the web server")

    async def close(self) -> None:
        """End the node."""
        if self._task is not None:
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task

    async def current(self) -> Node:
        """The node; waits until there is one."""
        while self.node is None:
            await self._ready.wait()
        return self.node

    async def check_master(self) -> None:
        """The node's master does not answer: end the node where another master is the right one now."""
        node = self.node
        try:
            uri = await self._where()
        except (RmpaError, OSError) as error:
            _log.debug("! %s", error)
            return
        if node is not None and uri != node.master_uri:
            _log.info("= the master is at %s now", uri)
            await node.close()

    def need(self) -> Node:
        """The node.

        Raises:
            UnreachableError: There is none at the moment.
        """
        if self.node is None:
            raise UnreachableError("ROS master", "ROS_MASTER_URI", self.problem)
        return self.node

    async def _run(self) -> None:
        while True:
            try:
                async with self._make(await self._where(), self._on_param_update) as node:
                    self._began(node)
                    try:
                        await node.stopped.wait()
                    finally:
                        self.node = None
                        self._ready.clear()
                _log.warning("! the node %s was shut down; it is started anew", node.name)
                self.problem = "the node was shut down, and is started anew"
            except RmpaError as error:
                if str(error) != self.problem:
                    _log.warning("! %s", error)
                self.problem = str(error)
            except Exception as error:  # noqa: BLE001 - a task's top: without it the server has no node until it ends
                _log.exception("! the node of the web server failed")
                self.problem = f"it failed: {error}"
            await asyncio.sleep(limits.NODE_RETRY)

    def _began(self, node: Node) -> None:
        self.node = node
        self.problem = ""
        self._ready.set()
        for callback in self.on_node:
            with logged_failure(_log, "what follows a new node failed"):
                callback(node)


class Registration(Generic[_T]):
    """Keeps one thing registered with the present node: a subscription, a publisher or a service.

    Args:
        link: Has the node.
        name: For logs.
        register: Registers it; what it returns is handed to ``withdraw``.
        withdraw: Ends it.
        on_failed: ``(error)``: it was refused, and is not tried again. What only waits for the master is.
        after: The registration of the same name that is ending.
    """

    def __init__(
        self,
        link: NodeLink,
        name: str,
        register: Callable[[Node], Awaitable[_T]],
        withdraw: Callable[[_T], Awaitable[None]],
        on_failed: Callable[[RmpaError], None],
        after: Registration[_T] | None = None,
    ) -> None:
        self._link = link
        self._register = register
        self._withdraw = withdraw
        self._on_failed = on_failed
        self._unwanted = asyncio.Event()
        self.value: _T | None = None
        """What ``register`` returned, while it is registered."""
        self._task: asyncio.Task[None] = asyncio.get_running_loop().create_task(
            self._run(after), name=f"register {name}"
        )

    def end(self) -> None:
        """Withdraw it, in its task."""
        self._unwanted.set()

    async def closed(self) -> None:
        """Wait, after ``end``, until it is withdrawn."""
        await asyncio.wait([self._task])

    def when_closed(self, call: Callable[[], None]) -> None:
        """Have a function called when all is done."""
        self._task.add_done_callback(lambda _: call())

    async def _run(self, after: Registration[_T] | None) -> None:
        if after is not None:
            await after.closed()
        while not self._unwanted.is_set():
            node = await self._first(self._link.current())
            if node is None:
                return
            try:
                self.value = await self._register(node)
            except UnreachableError as error:
                _log.debug("! %s", error)
                await self._first(asyncio.sleep(limits.NODE_RETRY))
                continue
            except (RmpaError, ValueError) as error:  # ValueError: an illegal name
                self._on_failed(error if isinstance(error, RmpaError) else RmpaError(str(error)))
                return
            self._link.registration_changed()
            await self._first(node.stopped.wait())
            value, self.value = self.value, None
            if not node.stopped.is_set():
                await self._withdraw(value)
                self._link.registration_changed()

    async def _first(self, other: Awaitable[_U]) -> _U | None:
        """Wait for it, or until it is no longer wanted: then ``None``."""
        loop = asyncio.get_running_loop()
        unwanted = loop.create_task(self._unwanted.wait())
        task = asyncio.ensure_future(other)
        try:
            await asyncio.wait([unwanted, task], return_when=asyncio.FIRST_COMPLETED)
            return task.result() if task.done() else None
        finally:
            for each in (unwanted, task):
                each.cancel()
            await asyncio.wait([unwanted, task])


class EndingRegistrations(Generic[_T]):
    """Registrations that are being withdrawn, by name: a new one of the same name waits for the old one."""

    def __init__(self) -> None:
        self._registrations: dict[str, Registration[_T]] = {}

    def end(self, name: str, registration: Registration[_T]) -> None:
        """Withdraw a registration; it is kept until that is done."""
        registration.end()
        self._registrations[name] = registration
        registration.when_closed(functools.partial(self._closed, name, registration))

    def take(self, name: str) -> Registration[_T] | None:
        """The registration of this name that is still being withdrawn, which is no longer kept here."""
        return self._registrations.pop(name, None)

    async def closed(self) -> None:
        """Wait until all are withdrawn."""
        for registration in [*self._registrations.values()]:
            await registration.closed()

    def _closed(self, name: str, registration: Registration[_T]) -> None:
        if self._registrations.get(name) is registration:
            del self._registrations[name]


# A client as the hub knows it, and the key of what it has asked for.


Key: TypeAlias = "tuple[int, int]"
"""The number of a client and one of its handles: unique in the hub."""
OWN_CLIENT: Final = 0
"""The number of the hub itself, and of what it keeps for all clients; clients count from 1."""
Receive: TypeAlias = "Callable[[Answer], None]"


@dataclass(slots=True, eq=False)
class HubClient:
    """One client.

    Args:
        number: Never used again.
        name: For logs and lists.
        rights: What it may do.
        receive: Takes answers; it must not raise.
    """

    number: int
    name: str
    rights: Rights
    receive: Receive
    subscriptions: dict[int, str] = field(default_factory=dict)
    """The topics by handle."""
    publishers: dict[int, str] = field(default_factory=dict)
    """The published topics by handle."""
    services: dict[int, str] = field(default_factory=dict)
    """The served services by handle."""

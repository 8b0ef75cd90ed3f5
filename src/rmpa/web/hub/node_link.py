"""What clients and the node may do, and the hub's node: made anew when its master was away or has shut it down."""

from __future__ import annotations

import asyncio
import functools
import logging
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Generic, TypeAlias, TypeVar, Union

from rmpa.config.peer_rules import Access
from rmpa.core.errors import PeerRefused, RmpaError, UnreachableError
from rmpa.ros.master.parameters import canonical, leaves
from rmpa.runtime.tasks import end_tasks, keep_task, start_task
from rmpa.web import limits

if TYPE_CHECKING:
    from rmpa.ros.node.node import Node, Publisher, Service, Subscriber
    from rmpa.ros.wire.xmlrpc import XmlRpcValue
    from rmpa.trust.permissions import Permissions

_log = logging.getLogger(__name__)
ParamValue: TypeAlias = Union[  # noqa: UP007 - | does not take the forward references of a recursive type
    bool, int, float, str, bytes, list["ParamValue"], dict[str, "ParamValue"], None
]
# A ROS 1 serialized message, without its length prefix.
Payload: TypeAlias = bytes | bytearray | memoryview


_WHO: Final = "the web server"
# The name of ``rmpa web`` for the rules.
_NODE: Final = "web"


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
                raise PeerRefused(_WHO, f"{_NODE} may not {access} {name}", decision.rule, code="not-permitted")

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

    def check_param(self, name: str, value: object) -> None:
        """Check that a parameter may be read, with all in it if it is a namespace; raises as ``check``."""
        if self.permissions is not None:
            for each in [leaf for leaf, _ in leaves(_resolved(name), value)] or [name]:
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
# Everything but ``drive``, which has a setting of its own.
FULL = Rights(view=True, control=True)
# For clients that want to change something.
CONTROL_REMEDY = "start rmpa web with --control, and give its token"
# For clients that want to read what only clients with the token may.
READ_REMEDY = "send the token of rmpa web; where it has none, start it with --token-file FILE or --control"


class Follower:
    """What follows changes, until it is closed.

    Args:
        followers: All of one kind, with what is called for each.
        followed: What is called for this one.
    """

    def __init__(self, followers: dict[Follower, _U], followed: _U) -> None:
        self._followers: dict[Follower, Any] = followers
        followers[self] = followed

    def close(self) -> None:
        """Follow no more."""
        self._followers.pop(self, None)


# Makes a node that is not started: ``(master URI, on_param_update)``.
MakeNode: TypeAlias = "Callable[[str, Callable[[str, XmlRpcValue], None]], Node]"
# Finds the master's URI; raises ``RmpaError`` while there is none.
Where: TypeAlias = "Callable[[], Awaitable[str]]"
_T = TypeVar("_T", bound="Subscriber | Publisher | Service")
_U = TypeVar("_U")


class NodeLink:
    """Keeps a node running.

    Args:
        where: Finds the master.
        make: Makes a node.
        rules: What the node may do.
    """

    def __init__(self, where: Where, make: MakeNode, rules: NodeRules = EVERYTHING) -> None:
        self.rules = rules
        self._where = where
        self._make = make
        self._task: asyncio.Task[None] | None = None
        self._ready: asyncio.Event = asyncio.Event()
        # The node, while the master knows it.
        self.node: Node | None = None
        # Why there is no node; empty while there is one.
        self.problem = "the ROS master was not asked yet"
        # What is being withdrawn, by kind and name.
        self.ending: dict[tuple[str, str], Registration[Any]] = {}
        # Called with each new node.
        self.on_node: Callable[[Node], None] = lambda _: None
        # Called when something was registered or withdrawn.
        self.on_registration: Callable[[], None] = lambda: None
        # ``(key, value)``: a parameter has changed that the node follows.
        self.on_param_update: Callable[[str, XmlRpcValue], None] = lambda *_: None

    def start(self) -> None:
        """Begin, in a task."""
        self._task = keep_task(self._run, "the node of the web server")

    async def close(self) -> None:
        """End the node."""
        await end_tasks(self._task)

    async def withdrawn(self) -> None:
        """Wait until all is withdrawn that has ended."""
        while self.ending:
            await next(iter(self.ending.values())).closed()

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
                async with self._make(await self._where(), self.on_param_update) as node:
                    self.node, self.problem = node, ""
                    self._ready.set()
                    try:
                        self.on_node(node)
                        await node.stopped.wait()
                    finally:
                        self.node, self.problem = None, "the node was shut down, and is started again"
                        self._ready.clear()
                _log.warning("! the node %s was shut down; it is started again [node-killed]", node.name)
            except RmpaError as error:
                if str(error) != self.problem:
                    _log.warning("! %s [%s]", error, error.code)
                self.problem = str(error)
            await asyncio.sleep(limits.NODE_RETRY)


class Registration(Generic[_T]):
    """Keeps one thing registered with the present node, after that of the same kind and name is withdrawn.

    Args:
        link: Has the node.
        kind: ``topic``, ``publisher`` or ``service``.
        name: Of the topic or service.
        register: Registers it.
        on_failed: ``(error)``: it was refused, and is not tried again. What only waits for the master is.
    """

    def __init__(
        self,
        link: NodeLink,
        kind: str,
        name: str,
        register: Callable[[Node], Awaitable[_T]],
        on_failed: Callable[[RmpaError], None],
    ) -> None:
        self._link = link
        self._key = kind, name
        self._register = register
        self._on_failed = on_failed
        self._wanted = True
        self._resting: asyncio.Future[Any] | None = None
        # What ``register`` returned, while it is registered.
        self.value: _T | None = None
        run = functools.partial(self._run, link.ending.get(self._key))
        self._task = keep_task(run, f"register {kind} {name}")

    def end(self) -> None:
        """Withdraw it, in its task."""
        self._wanted = False
        if self._resting is not None:
            self._resting.cancel()
        self._link.ending[self._key] = self
        self._task.add_done_callback(self._ended)

    def _ended(self, _: object) -> None:
        if self._link.ending.get(self._key) is self:
            del self._link.ending[self._key]

    async def closed(self) -> None:
        """Wait, after ``end``, until it is withdrawn."""
        await asyncio.wait([self._task])
        await asyncio.sleep(0)  # its callback has run

    async def _run(self, before: Registration[_T] | None) -> None:
        if before is not None:
            await before.closed()
        while self._wanted:
            node = await self._rest(self._link.current())
            if node is None:
                return
            try:
                self.value = await self._register(node)
            except UnreachableError as error:
                _log.debug("! %s", error)
                await self._rest(asyncio.sleep(limits.NODE_RETRY))
                continue
            except (RmpaError, ValueError) as error:  # ValueError: an illegal name
                if node.stopped.is_set():
                    continue
                self._on_failed(error if isinstance(error, RmpaError) else RmpaError(str(error)))
                return
            self._link.on_registration()
            if self._wanted:
                await self._rest(node.stopped.wait())
            value, self.value = self.value, None
            if not node.stopped.is_set():
                await value.close()
                self._link.on_registration()

    async def _rest(self, other: Coroutine[Any, Any, _U]) -> _U | None:
        """Wait for it, or until this is no longer wanted: then ``None``."""
        self._resting = start_task(other, self._task.get_name(), raises=(Exception,))
        await asyncio.wait([self._resting])
        return None if self._resting.cancelled() else self._resting.result()

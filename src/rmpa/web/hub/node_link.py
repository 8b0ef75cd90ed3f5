"""The hub's node, made anew when its master was away or has shut it down, and what is registered with it."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
from typing import TYPE_CHECKING, Generic, TypeAlias, TypeVar

from rmpa.core.counters import logged_failure
from rmpa.core.errors import RmpaError, UnreachableError
from rmpa.web import limits
from rmpa.web.hub.rights import EVERYTHING

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from rmpa.ros.node.node import Node
    from rmpa.ros.wire.xmlrpc import XmlRpcValue
    from rmpa.web.hub.rights import NodeRules

_log = logging.getLogger(__name__)
_T = TypeVar("_T")
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

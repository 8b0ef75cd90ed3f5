"""The nodes in the local graph that stand for the nodes of one peer."""

from __future__ import annotations

import asyncio
import logging
import os
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

from rmpa.bridge.proxy_names import proxy_name
from rmpa.core.counters import remedy
from rmpa.core.errors import RmpaError
from rmpa.ros.wire.xmlrpc import RosReply
from rmpa.runtime.accept import is_shortage
from rmpa.runtime.loop import yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Hashable, Iterator

    from rmpa.bridge.session.proxy_nodes import ProxyNodes
    from rmpa.ros.node.slave_node import SlaveNode

_log = logging.getLogger(__name__)


async def _refuse_to_end(node: str, _caller: str, _reason: str) -> RosReply:
    return RosReply(0, f"{node} is a node of another module", 0)


def _nothing(_node: SlaveNode) -> None:
    """Does nothing: the user has nothing to remove from the proxy."""


class ProxyUser(Protocol):
    """What a topic or service does with its proxy."""

    __slots__ = ()

    def ready(self, node: SlaveNode) -> None:
        """The proxy exists: register the topic or service there."""

    def left(self, node: SlaveNode) -> None:
        """Remove the topic or service from the proxy, which may be closed afterwards."""


@dataclass(frozen=True, slots=True)
class ProxyCallbacks:
    """A user of a proxy by functions, which get the proxy; see ``ProxyUser``."""

    ready: Callable[[SlaveNode], None]
    left: Callable[[SlaveNode], None] = _nothing


@dataclass(frozen=True, slots=True, eq=False)
class _Hold:
    """A topic or service for which a proxy is kept.

    Args:
        node: The peer's node.
        key: Identifies the topic or service among those of its node.
        user: The topic or service.
    """

    node: str
    key: Hashable
    user: ProxyUser


@dataclass(frozen=True, slots=True)
class _Release:
    """A request to remove a topic or service from its proxy."""

    node: str
    key: Hashable


@dataclass(slots=True)
class Proxy:
    """The proxy of one node of a peer.

    Args:
        node: The local node that stands for it.
        held: The topics and services for which it is kept, by key.
    """

    node: SlaveNode
    held: dict[Hashable, _Hold] = field(default_factory=dict)


class PeerProxies:
    """The proxies of one peer; each exists while a topic or service holds it.

    Making a proxy may bind sockets, which takes a turn of the loop. Therefore one task makes all changes of the
    graph, in the order of the calls.

    Args:
        prefix: The namespace of this peer's proxies.
        nodes: Makes the proxies.
        on_kill: ``(node, caller id, reason) -> reply``: called when the proxy of this peer's node is asked to end.
    """

    def __init__(
        self,
        prefix: str,
        nodes: ProxyNodes,
        on_kill: Callable[[str, str, str], Awaitable[RosReply]] = _refuse_to_end,
    ) -> None:
        self.prefix = prefix
        self._nodes = nodes
        self._on_kill = on_kill
        self._proxies: dict[str, Proxy] = {}
        self._holds: dict[tuple[str, Hashable], _Hold] = {}
        self._jobs: deque[_Hold | _Release] | None = None
        self._incomplete = False
        """Whether a change of the graph failed, so that ``reconcile`` has something to mend."""
        self.problems: dict[str, str] = {}
        """Why the proxy of a node could not be made, as text by node; ``reconcile`` tries again."""
        self.names: dict[str, str] = {}
        """Names of the proxies of relayed nodes, by the peer's node; all others are named with ``prefix``."""
        self._task: asyncio.Task[None] | None = None
        """Carries out the queued changes; ``None`` while there are none."""

    def __len__(self) -> int:
        return len(self._proxies)

    def __iter__(self) -> Iterator[tuple[str, Proxy]]:
        """Each node of the peer that has a proxy, and the proxy."""
        return iter(self._proxies.items())

    def name(self, node: str) -> str:
        """The name of the proxy of one of the peer's nodes."""
        return self.names.get(node) or proxy_name(self.prefix, node)

    def get(self, node: str) -> SlaveNode | None:
        """The proxy of one of the peer's nodes; ``None`` if it does not exist."""
        proxy = self._proxies.get(node)
        return proxy.node if proxy is not None else None

    def hold(
        self,
        node: str,
        key: Hashable,
        user: ProxyUser,
    ) -> None:
        """Keep a proxy for a node because of one topic or service, until ``release``.

        Args:
            node: In the peer's graph.
            key: Identifies the topic or service for ``release``.
            user: Its ``ready`` is called in a later turn of the loop, and after that its ``left``.
        """
        job = self._holds[node, key] = _Hold(node, key, user)
        self._do(job)

    def release(self, node: str, key: Hashable) -> None:
        """Remove a topic or service from its proxy in a later turn of the loop; the last one closes the proxy."""
        self._holds.pop((node, key), None)
        self._do(_Release(node, key))

    def reconcile(self) -> None:
        """Try failed proxies again, and forget names and problems of nodes that have gone."""
        if self._jobs:
            return
        if self.names or self.problems:
            there = set(self._proxies)
            there.update(node for node, _ in yielding_to_data(list(self._holds)))
            self.names = {node: name for node, name in self.names.items() if node in there}
            self.problems = {node: text for node, text in self.problems.items() if node in there}
        if not self._incomplete:
            return
        self._incomplete = False
        for hold in yielding_to_data(list(self._holds.values())):
            proxy = self._proxies.get(hold.node)
            if proxy is None or proxy.held.get(hold.key) is not hold:
                self._do(hold)

    async def close(self) -> None:
        """Carry out the queued changes, then close all proxies."""
        while self._task is not None:
            await self._task
        for node in list(self._proxies):
            await self._close_proxy(node)

    def _do(self, job: _Hold | _Release) -> None:
        if self._jobs is None:
            self._jobs = deque()
        self._jobs.append(job)
        if self._task is None:
            self._task = asyncio.create_task(self._work(), name=f"proxies {self.prefix}")

    async def _work(self) -> None:
        while self._jobs:
            job = self._jobs.popleft()
            try:
                await (self._hold(job) if isinstance(job, _Hold) else self._release(job))
            except (RmpaError, OSError) as error:
                self._failed(job.node, error)
            except Exception:  # noqa: BLE001 - the task's top: one thing that fails must not stop the others
                _log.exception("! %s: %s failed; the others go on", self.prefix, job)
                self._incomplete = True
        self._jobs = self._task = None

    async def _hold(self, hold: _Hold) -> None:
        if self._holds.get((hold.node, hold.key)) is not hold:
            return  # released meanwhile
        proxy = await self._proxy(hold.node)
        if self._holds.get((hold.node, hold.key)) is not hold:
            # Released while the proxy's sockets were being made: registering it now could change a topic's type.
            if not proxy.held:
                await self._close_proxy(hold.node)
        elif (before := proxy.held.get(hold.key)) is not hold:
            if before is not None:
                before.user.left(proxy.node)
            hold.user.ready(proxy.node)
            proxy.held[hold.key] = hold

    async def _release(self, job: _Release) -> None:
        proxy = self._proxies.get(job.node)
        if proxy is None:
            return
        hold = proxy.held.pop(job.key, None)
        if hold is not None:
            hold.user.left(proxy.node)
        if not proxy.held:
            await self._close_proxy(job.node)

    async def _proxy(self, node: str) -> Proxy:
        """Returns the proxy of a node, and makes it if necessary."""
        proxy = self._proxies.get(node)
        if proxy is None:
            made = self._nodes.make(self.name(node), lambda caller, reason: self._on_kill(node, caller, reason))
            await made.start()
            self.problems.pop(node, None)
            proxy = self._proxies[node] = Proxy(made)
        return proxy

    async def _close_proxy(self, node: str) -> None:
        proxy = self._proxies.pop(node)
        for hold in proxy.held.values():
            hold.user.left(proxy.node)
        await proxy.node.close()

    def _failed(self, node: str, error: Exception) -> None:
        """Log why a proxy could not be made, once for each reason; ``reconcile`` tries again."""
        self._incomplete = True
        text = (
            f"no file descriptor is left for its proxy; {remedy(os.getpid())}" if is_shortage(error) else str(error)
        )
        if self.problems.get(node) != text:
            self.problems[node] = text
            level = logging.DEBUG if is_shortage(error) else logging.ERROR  # a shortage is reported for the process
            _log.log(level, "! %s: %s is not in the local graph: %s", self.prefix, node, text)

"""The proxies that stand for a peer's nodes here, and their names."""

from __future__ import annotations

import logging
import os
from collections.abc import Awaitable, Callable, Collection, Hashable, Iterable, Iterator
from functools import partial
from typing import TYPE_CHECKING
from weakref import WeakValueDictionary

from rmpa.core.errors import RmpaError, StartError
from rmpa.core.identity import Guid, Identity, proxied_node, proxy_name, proxy_prefix
from rmpa.ros.environment import is_loopback
from rmpa.ros.node.listeners import SharedListener
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.ros.wire.slave_api import OUTBOUND, BusConnection
from rmpa.runtime.accept import DESCRIPTORS, Use, is_shortage, open_files_advice
from rmpa.runtime.loop import yielding_to_data
from rmpa.runtime.tasks import start_task

if TYPE_CHECKING:
    import asyncio

    from rmpa.bridge.messages import Origin
    from rmpa.core.statistics import Counters
    from rmpa.ros.core.external import Core
    from rmpa.ros.node.publication import Publication
    from rmpa.ros.wire.xmlrpc import RosReply

_log = logging.getLogger(__name__)


class ProxyNamespaces:
    """The namespaces of peers and of relayed modules; no two modules share one.

    Attributes:
        _linked: The module's instance and its namespace, by the session's number.
        _relayed: The namespace of each relayed module, by its instance.
        _reserved: The instances whose namespaces are kept while they have no proxy.
    """

    def __init__(self) -> None:
        self._linked: dict[int, tuple[str, str]] = {}
        self._relayed: dict[str, str] = {}
        self._reserved: set[str] = set()

    def add(self, peer: int, identity: Identity) -> str:
        """Return the namespace of a peer, which is reserved until ``remove``."""
        instance = identity.instance.hex()
        prefix = self._relayed.get(instance) or proxy_prefix(identity, self._taken(instance))
        self._linked[peer] = (instance, prefix)
        return prefix

    def remove(self, peer: int) -> None:
        """Release the namespace of a peer that is gone for good."""
        self._linked.pop(peer, None)

    def relayed_name(self, origin: Origin, *, reserve: bool = False) -> str:
        """The name of a relayed node's proxy, made by the same rules as for linked modules.

        Args:
            origin: Its module and node.
            reserve: Whether the namespace is kept for good.
        """
        if reserve:
            self._reserved.add(origin.instance)
        prefix = self._relayed.get(origin.instance)
        if prefix is None:
            module = Identity(Guid.parse(origin.guid), bytes.fromhex(origin.instance), origin.name)
            linked = (prefix for instance, prefix in self._linked.values() if instance == origin.instance)
            prefix = next(linked, None) or proxy_prefix(module, self._taken(origin.instance))
            self._relayed[origin.instance] = prefix
        return proxy_name(prefix, origin.node)

    def forget_unused(self, prefixes: Collection[str]) -> None:
        """Forget the relayed modules whose namespace is not among those with a proxy."""
        self._relayed = {
            instance: prefix
            for instance, prefix in self._relayed.items()
            if instance in self._reserved or prefix in prefixes
        }

    def _taken(self, instance: str) -> set[str]:
        """The namespaces that other modules have."""
        linked = {prefix for other, prefix in self._linked.values() if other != instance}
        return linked | {prefix for other, prefix in self._relayed.items() if other != instance}


class ProxyNodes:
    """Makes proxies, and owns the listener that they share.

    On loopback all proxies share a listener, and each has an address of its own. Where nodes of other machines must
    reach them, or this machine does not allow it, each has two listening sockets.

    Args:
        core: The local core.
        counters: Where refusals at the proxies' ports are counted.
        on_kill: ``(proxy, caller id, reason) -> reply``: called when a proxy is asked to end (``rosnode kill``).

    Attributes:
        _made: The last node of each name.
        listening: How the proxies listen, as text: at which ports, or why each has two sockets of its own.
    """

    def __init__(
        self,
        core: Core,
        counters: Counters | None = None,
        on_kill: Callable[[str, str, str], Awaitable[RosReply]] | None = None,
    ) -> None:
        self._core = core
        self._counters = counters
        self._on_kill = on_kill
        self._listener: SharedListener | None = None
        self._made: WeakValueDictionary[str, SlaveNode] = WeakValueDictionary()
        self.listening = ""

    def sockets(self, proxies: int) -> int:
        """The number of listening sockets for a number of proxies."""
        return 2 * (proxies if self._listener is None else 1)  # XML-RPC and TCPROS

    async def start(self) -> None:
        """Open the shared listener, if this host allows it."""
        host = self._core.node_host
        if not is_loopback(host):
            self.listening = f"two for each: nodes of other machines reach them, at {self._core.node_address}"
            return
        listener = SharedListener(self._core.uri, counters=self._counters)
        try:
            await listener.start()
        except StartError as error:
            self.listening = f"two for each, at {host}: all cannot share two ({error.problem})"
            _log.info("= proxies listen by sockets of their own, %s", self.listening)
            return
        self._listener = listener
        xmlrpc, tcpros = listener.ports
        self.listening = f"two for all, ports {xmlrpc} and {tcpros}, and an address 127.a.b.c for each"

    async def close(self) -> None:
        """Close the shared listener; call it after all proxies are closed."""
        if self._listener is not None:
            await self._listener.close()
            self._listener = None

    def make(self, name: str) -> SlaveNode:
        """Make a proxy of this name, which is not started.

        Raises:
            OSError: It would have sockets of its own, and too few file descriptors are left (``EMFILE``).
        """
        if self._listener is None:
            with DESCRIPTORS.open_socket(Use.PROXY, what=f"the proxy {name}"):
                pass  # only checks that there is room for its sockets, and for connections to them
        node = self._made[name] = SlaveNode(
            name,
            self._core.node_host,
            self._core.uri,
            advertised_host=self._core.node_address,
            listener=self._listener,
            counters=self._counters,
            on_kill=partial(self._on_kill, name) if self._on_kill is not None else None,
            elsewhere=lambda topic: self._elsewhere(name, topic),
        )
        return node

    def _elsewhere(self, name: str, topic: str) -> Iterable[BusConnection]:
        """The subscribers of other modules to a proxy's topic, which are connected to its node."""
        for number, node in enumerate(self._core.subscribers(topic), 1):
            if proxied_node(node) is not None and node != name:
                yield BusConnection(number, node, OUTBOUND, topic, True, f"by the agents, to {node}", 0, 0)

    def publication(self, name: str, uri: str, topic: str) -> Publication | None:
        """The topic of a proxy of this process, for subscribers of this process; ``None`` if there is none.

        Args:
            name: The proxy.
            uri: Its slave API, which tells it from an earlier proxy of that name.
            topic: The topic.
        """
        node = self._made.get(name)
        return node.publication(topic) if node is not None and node.uri == uri else None


# What a topic or service does at its proxy: ``ready(proxy)`` registers it there, ``left(proxy)`` removes it.
User = tuple[Callable[[SlaveNode], None], Callable[[SlaveNode], None]]


class PeerProxies:
    """The proxies of one module; each exists while a topic or service holds it.

    It does not matter by which peer a topic or service comes. Where another peer brings it in the same turn of the
    loop, the proxy stays.

    Making a proxy may bind sockets, which takes a turn of the loop. Therefore one task makes what stands in the graph
    equal to what is wanted there, in the order of the calls.

    Args:
        prefix: The namespace of this module's proxies.
        nodes: Makes the proxies.

    Attributes:
        _wanted: By the module's node: the topics and services that hold its proxy, by key.
        _held: What of them stands at the proxy.
        _changed: The keys of which what is wanted, or what stands, has changed.
        _failed: The nodes of which a change failed; ``reconcile`` tries again.
        problems: Why the proxy of a node could not be made, as text by node.
        _task: Carries out the changes; ``None`` while there are none.
    """

    def __init__(self, prefix: str, nodes: ProxyNodes) -> None:
        self.prefix = prefix
        self._nodes = nodes
        self._wanted: dict[str, dict[Hashable, User]] = {}
        self._held: dict[str, dict[Hashable, User]] = {}
        self._proxies: dict[str, SlaveNode] = {}
        self._changed: dict[str, dict[Hashable, None]] = {}
        self._failed: set[str] = set()
        self.problems: dict[str, str] = {}
        self._task: asyncio.Task[None] | None = None

    def __len__(self) -> int:
        return len(self._proxies)

    def __iter__(self) -> Iterator[tuple[str, SlaveNode]]:
        """Each node of the module that has a proxy, and the proxy."""
        return iter(self._proxies.items())

    @property
    def used(self) -> bool:
        """Whether a proxy exists, or is wanted."""
        return bool(self._proxies or self._wanted or self._task)

    def name(self, node: str) -> str:
        """The name of the proxy of one of the module's nodes."""
        return proxy_name(self.prefix, node)

    def get(self, node: str) -> SlaveNode | None:
        """The proxy of one of the module's nodes; ``None`` if it does not exist."""
        return self._proxies.get(node)

    def hold(
        self,
        node: str,
        key: Hashable,
        ready: Callable[[SlaveNode], None],
        left: Callable[[SlaveNode], None] = lambda _: None,
    ) -> None:
        """Keep a proxy for a node because of one topic or service, until ``release``.

        Args:
            node: In the module's graph.
            key: Identifies the topic or service for ``release``.
            ready: ``(proxy)``: called in a later turn of the loop, when the proxy exists, to register it there.
            left: ``(proxy)``: called afterwards to remove it; the proxy may be closed then.
        """
        self._wanted.setdefault(node, {})[key] = ready, left
        self._change(node, (key,))

    def release(self, node: str, key: Hashable) -> None:
        """Remove a topic or service from its proxy in a later turn of the loop; the last one closes the proxy."""
        wanted = self._wanted.get(node, {})
        wanted.pop(key, None)
        if not wanted:
            self._wanted.pop(node, None)
        self._change(node, (key,))

    def reconcile(self) -> None:
        """Try failed proxies again, and forget problems of nodes that have gone."""
        if self._changed:
            return
        if self.problems:
            there = self._proxies.keys() | self._wanted.keys()
            self.problems = {node: text for node, text in self.problems.items() if node in there}
        failed, self._failed = self._failed, set()
        for node in failed:
            self._change(node, self._wanted.get(node, ()))

    async def close(self) -> None:
        """Carry out the changes, then close all proxies."""
        while self._task is not None:
            await self._task
        self._wanted.clear()
        for node, held in list(self._held.items()):
            await self._settle(node, list(held))

    def _change(self, node: str, keys: Iterable[Hashable]) -> None:
        self._changed.setdefault(node, {}).update(dict.fromkeys(keys))
        if self._task is None:
            self._task = start_task(self._work(), f"proxies {self.prefix}")

    async def _work(self) -> None:
        while self._changed:
            node = next(iter(self._changed))
            try:
                await self._settle(node, self._changed.pop(node))
            except Exception as error:  # noqa: BLE001 - one node that fails must not stop the others
                self._fail(node, error)
        self._task = None

    async def _settle(self, node: str, keys: Iterable[Hashable]) -> None:
        """Makes what stands at a proxy equal to what is wanted; the proxy is there while anything is."""
        proxy = self._proxies.get(node)
        if proxy is None:
            if node not in self._wanted:
                return
            proxy = self._nodes.make(self.name(node))
            await proxy.start()  # meanwhile less may be wanted: a released topic may have another type elsewhere
            self.problems.pop(node, None)
            self._proxies[node], self._held[node] = proxy, {}
        held = self._held[node]
        for key in yielding_to_data(keys):
            wanted, before = self._wanted.get(node, {}).get(key), held.get(key)
            try:
                if before is not None and before is not wanted:
                    del held[key]
                    before[1](proxy)
                if wanted is not None and before is not wanted:
                    wanted[0](proxy)
                    held[key] = wanted
            except Exception as error:  # noqa: BLE001 - one topic that fails must not stop the others
                self._fail(node, error)
        if not held:
            del self._proxies[node], self._held[node]
            await proxy.close()

    def _fail(self, node: str, error: Exception) -> None:
        """Log what failed, once for each reason; ``reconcile`` tries again."""
        self._failed.add(node)
        if not isinstance(error, RmpaError | OSError):
            _log.error("! %s: %s failed; the others go on", self.prefix, node, exc_info=error)
            return
        text = (
            f"no file descriptor is left for its proxy; {open_files_advice(os.getpid())}"
            if is_shortage(error)
            else str(error)
        )
        if self.problems.get(node) != text:
            self.problems[node] = text
            level = logging.DEBUG if is_shortage(error) else logging.ERROR  # a shortage is reported for the process
            _log.log(level, "! %s: %s is not in the local graph: %s [name-taken]", self.prefix, node, text)

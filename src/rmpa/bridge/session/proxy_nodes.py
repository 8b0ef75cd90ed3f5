"""Makes the proxy nodes; where possible, all of them share one pair of listening sockets."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Final
from weakref import WeakValueDictionary

from rmpa.core.errors import StartError
from rmpa.ros.environment import is_loopback
from rmpa.ros.node.listeners import SharedListener
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.runtime.accept import DESCRIPTORS, Use

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from rmpa.core.counters import Counters
    from rmpa.ros.core.api import Core
    from rmpa.ros.node.publication import Publication
    from rmpa.ros.wire.xmlrpc import RosReply

_log = logging.getLogger(__name__)
_SOCKETS: Final = 2
"""The listening sockets of one node: XML-RPC and TCPROS."""


class ProxyNodes:
    """Makes proxies, and owns the listener that they share.

    On loopback all proxies share a listener, and each has an address of its own. Where nodes of other machines must
    reach them, or this machine does not allow it, each has two listening sockets.

    Args:
        core: The local core.
        counters: Where refusals at the proxies' ports are counted.
    """

    def __init__(self, core: Core, counters: Counters | None = None) -> None:
        self._core = core
        self._counters = counters
        self._listener: SharedListener | None = None
        self._made: WeakValueDictionary[str, SlaveNode] = WeakValueDictionary()
        """The last node of each name."""
        self.listening = ""
        """How the proxies listen, as text: at which ports, or why each has two sockets of its own."""

    def sockets(self, proxies: int) -> int:
        """The number of listening sockets for a number of proxies."""
        return _SOCKETS if self._listener is not None else _SOCKETS * proxies

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

    def make(self, name: str, on_kill: Callable[[str, str], Awaitable[RosReply]] | None = None) -> SlaveNode:
        """Make a proxy, which is not started.

        Args:
            name: Its name in the local graph.
            on_kill: ``(caller id, reason) -> reply``: called when it is asked to end (``rosnode kill``).

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
            on_kill=on_kill,
        )
        return node

    def publication(self, name: str, uri: str, topic: str) -> Publication | None:
        """The topic of a proxy of this process, for subscribers of this process; ``None`` if there is none.

        Args:
            name: The proxy.
            uri: Its slave API, which tells it from an earlier proxy of that name.
            topic: The topic.
        """
        node = self._made.get(name)
        return node.publication(topic) if node is not None and node.uri == uri else None

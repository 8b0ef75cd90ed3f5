"""What a foreign topic and service share in the gateway's graph: its proxy node, or why it has none."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

from rmpa.bridge.proxies import ProxyCallbacks

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.bridge.messages import Origin
    from rmpa.bridge.policy import Relay
    from rmpa.bridge.proxies import PeerProxies
    from rmpa.gateway.neighbour import ForeignSource
    from rmpa.ros.core.api import Core
    from rmpa.ros.node.slave_node import SlaveNode

_log = logging.getLogger(__name__)


class ProxiedSource(ABC):
    """A foreign source in the gateway's graph.

    Args:
        source: The source.
        origin: The origin to offer it with.
        number: The number of its site in the relay.
        core: The gateway's core.
        relay: Offers it to the modules.
        proxies: The proxies of its site.
        on_closed: Called once it is closed.
    """

    def __init__(
        self,
        source: ForeignSource,
        origin: Origin,
        number: int,
        *,
        core: Core,
        relay: Relay,
        proxies: PeerProxies,
        on_closed: Callable[[], None],
    ) -> None:
        self.source = source
        self._origin = origin
        self._number = number
        self._core = core
        self._relay = relay
        self._proxies = proxies
        self._on_closed = on_closed
        self._key = f"{source.kind.name} {source.name}"
        self._node: SlaveNode | None = None
        self._begun = False
        self._refused = "another source of this node has its name here"
        self._mismatch = ""
        self._closed = False

    def begin(self) -> None:
        """Put it into the graph, in a later turn of the loop."""
        self._begun = True
        self._refused = ""
        self._proxies.hold(self._origin.node, self._key, ProxyCallbacks(self._ready, self._left))

    def refuse(self, text: str) -> None:
        """Say why it cannot be in the graph."""
        self._refused = text

    @property
    def problem(self) -> str:
        """Why it is not in the graph, or not understood by its subscribers or clients; empty for nothing."""
        return self._refused or self._proxies.problems.get(self._origin.node, "") or self._mismatch

    def close(self) -> None:
        """Take it out of the graph in a later turn of the loop; what its users wait for ends now."""
        if self._closed:
            return
        self._closed = True
        self._withdraw()
        if self._begun:
            self._proxies.release(self._origin.node, self._key)
        self._on_closed()

    def _registered(self, node: SlaveNode, code: int, status: str) -> None:
        """Take in the core's answer to a registration."""
        self._refused = "" if code == 1 else f"the gateway's core does not take it: {status}"
        if self._refused:
            _log.error("! %s of %s: %s", self.source.name, node.name, self._refused)

    @abstractmethod
    def _withdraw(self) -> None:
        """End what subscribers or clients have of it."""

    @abstractmethod
    def _ready(self, node: SlaveNode) -> None:
        """Its proxy node is in the graph: show the source there."""

    @abstractmethod
    def _left(self, node: SlaveNode) -> None:
        """Take the source out of the graph: its proxy node leaves."""

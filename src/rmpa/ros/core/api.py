"""The interface of a ROS core as the agent needs it: the embedded one (``ros.core.embedded``) or a real roscore."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Protocol

from rmpa.core.counters import logged_failure
from rmpa.ros.master.parameters import RegistrationKind
from rmpa.ros.master.registrations import ANY_TYPE

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from rmpa.core.counters import Counters
    from rmpa.ros.master.parameters import GraphChange, GraphState
    from rmpa.ros.master.registrations import Registrations, Unreachable
    from rmpa.ros.wire.xmlrpc import RosReply, XmlRpcValue


_log = logging.getLogger(__name__)


class Core(Protocol):
    """The local graph: read at any time, changed by ``call``, observed by ``on_change``."""

    counters: Counters
    registrations: Registrations
    """The local graph's tables, or a copy of a real roscore's."""
    listeners: list[Callable[[GraphChange], None]]

    @property
    def uri(self) -> str:
        """The master's URI: ``ROS_MASTER_URI`` of the nodes of this graph."""

    @property
    def node_host(self) -> str:
        """The address that the agent's own nodes (its proxies among them) listen at."""

    @property
    def node_address(self) -> str:
        """The address of the agent's own nodes that is registered in this graph."""

    async def start(self) -> None:
        """Start the core, or connect to it.

        Raises:
            StartError: The core cannot be started with these settings.
        """

    async def close(self) -> None:
        """Unregister what the agent registered; an embedded core ends."""

    def call(self, method: str, *params: XmlRpcValue) -> RosReply:
        """Register or unregister, or write a parameter, as over XML-RPC but without waiting.

        For a real roscore the call is queued, and the reply follows from the local copy of the graph. Use ``ask`` for
        values that only the master has, such as parameters.

        Returns:
            ``(code, status, value)``; the value must not be changed, nor may ``params`` be afterwards.
        """

    async def ask(self, method: str, *params: XmlRpcValue) -> RosReply:
        """Call any method, after all previous ``call``s, and wait for the master's own answer.

        Raises:
            UnreachableError: The master does not answer (a real roscore may be gone).
            RosFault: There is no such method.
            RemoteProtocolError: The answer is malformed.
            LocalProtocolError: A parameter cannot be expressed in XML-RPC.
        """

    def state(self) -> GraphState:
        """All known registrations; the same object until one changes."""
        return self.registrations.state()

    def publishers(self, topic: str) -> Mapping[str, str]:
        """The publishers of a topic with their slave APIs; never changed afterwards."""
        return self.registrations.at(RegistrationKind.PUBLISHER, topic)

    def subscribers(self, topic: str) -> Mapping[str, str]:
        """The subscribers of a topic with their slave APIs; never changed afterwards."""
        return self.registrations.at(RegistrationKind.SUBSCRIBER, topic)

    def type_of(self, topic: str) -> str:
        """The type last registered for a topic; ``*`` for none."""
        return self.registrations.types().get(topic, ANY_TYPE)

    def on_change(self, callback: Callable[[GraphChange], None]) -> None:
        """Call ``callback`` in the loop after each change of a registration."""
        self.listeners.append(callback)

    def report(self, changes: Iterable[GraphChange]) -> None:
        """Log changes and call the listeners, in order; an exception of one is logged, and affects no other."""
        for change in changes:
            _log.info("= %s %s %s of %s", "+" if change.added else "-", change.kind.value, change.name, change.node)
            for callback in self.listeners:
                with logged_failure(_log, "a listener failed at %s", change):
                    callback(change)

    def on_lookup(self, callback: Callable[[str, str, str, str], str]) -> bool:
        """Let ``callback`` answer ``lookupService`` for each caller.

        Args:
            callback: ``(service, uri, caller id, slave API)``: the URI to answer in place of the registered ``uri``,
                or an empty text. The slave API is the caller's; empty if no node of that name is registered. It is
                called for each lookup of a registered service, and must return at once.

        Returns:
            Whether this core can do so: a real roscore cannot.
        """

    def unreachable(self) -> Mapping[str, Unreachable]:
        """The registered nodes to which connecting fails, by name; the caller must not change the mapping."""

    def suspect(self, node: str) -> None:
        """Check now whether this node is dead or has moved."""

    def notes(self) -> tuple[str, ...]:
        """Problems that the user should know of, such as a master that does not answer."""

    def restored(self) -> str:
        """Where the core stores its state and what it restored, for people; empty for nothing."""

"""What the agent needs of a ROS core, whichever it is: the embedded one (``ros.core.embedded``) or a real roscore."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.core.counters import Counters
    from rmpa.ros.master.effects import GraphChange, GraphState
    from rmpa.ros.master.reachability import Unreachable
    from rmpa.ros.wire.xmlrpc import RosReply, XmlRpcValue


class Core(Protocol):
    """The local graph: asked at any time, changed by ``call``, followed by ``on_change``."""

    counters: Counters

    @property
    def uri(self) -> str:
        """The master's; what ``ROS_MASTER_URI`` is for the nodes of this graph."""
        ...

    @property
    def node_host(self) -> str:
        """The address that the agent's own nodes (its proxies among them) listen at."""
        ...

    @property
    def node_address(self) -> str:
        """What the nodes of this graph are told to connect to for them."""
        ...

    async def start(self) -> None:
        """Be there.

        Raises:
            StartError: It cannot be, as asked.
        """
        ...

    async def close(self) -> None:
        """Take the agent's registrations away, and end what ends with the agent."""
        ...

    def call(self, method: str, *params: XmlRpcValue) -> RosReply:
        """Register or unregister, or write a parameter, as over XML-RPC but at once.

        With a real roscore the call leaves a moment later, in order; its reply is what is known here by then. What
        only the master knows (parameters' values) is to be asked by ``ask``.

        Returns:
            ``(code, status, value)``; the value must not be changed, nor may ``params`` be afterwards.
        """
        ...

    async def ask(self, method: str, *params: XmlRpcValue) -> RosReply:
        """Call any method and wait for the master's own answer, behind all that ``call`` was given before.

        Raises:
            UnreachableError: The master does not answer (a real roscore may be gone).
            RosFault: There is no such method.
            RemoteProtocolError: The answer is none.
            LocalProtocolError: A parameter cannot be said in XML-RPC.
        """
        ...

    def state(self) -> GraphState:
        """All registrations that are known; the same object until one changes."""
        ...

    def publishers(self, topic: str) -> Mapping[str, str]:
        """Who publishes a topic, and their slave APIs; never changed afterwards."""
        ...

    def type_of(self, topic: str) -> str:
        """The type that was last said for a topic; ``*`` for none."""
        ...

    def on_change(self, callback: Callable[[GraphChange], None]) -> None:
        """Call ``callback`` in the loop after each change of a registration."""
        ...

    def unreachable(self) -> Mapping[str, Unreachable]:
        """The registered nodes that nothing can connect to; not to be changed."""
        ...

    def suspect(self, node: str) -> None:
        """Say that this node may be dead, or may have moved: it is looked at now."""
        ...

    def notes(self) -> tuple[str, ...]:
        """What the user should know: that the master does not answer, say."""
        ...

    def restored(self) -> str:
        """What the core keeps over its end, and took up of the run before, ready to read; empty for nothing."""
        ...

    def unverified(self, topic: str) -> Mapping[str, str]:
        """Nodes that published a topic in the run before and have not answered since, and their slave APIs."""
        ...

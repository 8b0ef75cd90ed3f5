"""The ROS core of this machine: master, parameter server and /rosout, for nodes as they are.

Every call is answered at once, in the loop: what follows from it (notifications) leaves later, in tasks of its own.
"""

from __future__ import annotations

import asyncio
import logging
import os
import uuid
from typing import TYPE_CHECKING, Final

from rmpa.core.counters import Counters
from rmpa.ros.core.liveness import Liveness
from rmpa.ros.core.notifier import Notifier
from rmpa.ros.core.persistence import CorePersistence
from rmpa.ros.core.rosout import NODE, Rosout
from rmpa.ros.http.server import XmlRpcServer
from rmpa.ros.master.api import MasterApi
from rmpa.ros.master.effects import RegistrationKind
from rmpa.ros.master.registrations import ANY_TYPE
from rmpa.runtime.descriptors import Use
from rmpa.runtime.event_loop import yield_to_data, yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from rmpa.ros.master.effects import GraphChange, GraphState
    from rmpa.ros.master.reachability import Unreachable
    from rmpa.ros.wire.xmlrpc import RosReply, XmlRpcValue

_log = logging.getLogger(__name__)

DEFAULT_PORT: Final = 11311
CALLER_ID: Final = "/rmpa_core"
_LOOPBACK: Final = "127.0.0.1"
ROS_DISTRO: Final = "noetic\n"
"""With the line break that roscore's ``rosversion -d`` leaves in it; programs strip it."""
ROS_VERSION: Final = "1.15.15\n"
"""Of ros_comm, whose master this one stands in for."""


class RosCore:
    """A drop-in for ``roscore``.

    Args:
        host: The address to listen at; loopback unless the whole network shall see this core.
        port: 0 lets the system choose.
        advertised_host: What ``uri`` says; default: ``host``, or this machine's name where ``host`` is 0.0.0.0.
        rosout: Whether to aggregate ``/rosout``.
        counters: Where refusals, calls and notifications are counted.
        on_shutdown: ``(reason)``: a client called ``shutdown``; the owner closes the core then.
        state: The file that keeps registrations and parameters over the core's end; ``None`` keeps nothing.
        fresh: Begin empty, whatever the file says.
        temporary: Whether a node of this name is not to be kept: who makes it makes it anew.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = DEFAULT_PORT,
        *,
        advertised_host: str = "",
        rosout: bool = True,
        counters: Counters | None = None,
        on_shutdown: Callable[[str], None] | None = None,
        state: Path | None = None,
        fresh: bool = False,
        temporary: Callable[[str], bool] = lambda _: False,
    ) -> None:
        self.counters = counters if counters is not None else Counters()
        self._host = host
        self._advertised = advertised_host or (os.uname().nodename if host in {"", "0.0.0.0"} else host)  # noqa: S104
        self._on_shutdown = on_shutdown
        self._api = MasterApi("", os.getpid(), self._asked_to_end, yielder=yielding_to_data)
        self._server = XmlRpcServer(self._answer, host, port, counters=self.counters, name="ROS core", use=Use.CORE)
        self._notifier: Notifier | None = None
        self._liveness: Liveness | None = None
        self._with_rosout = rosout
        self._rosout: Rosout | None = None
        self._callbacks: list[Callable[[GraphChange], None]] = []
        self.memory: CorePersistence | None = None
        """What it keeps over its end, if it keeps anything."""
        if state is not None:
            own = {NODE, CALLER_ID}
            self.memory = CorePersistence(
                state,
                self._api,
                fresh=fresh,
                temporary=lambda node: node in own or temporary(node),
                carry_out=self._carry_out,
                counters=self.counters,
            )

    # --- its life ---------------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Take up what was kept; listen; set ``/run_id``, ``/rosdistro`` and ``/rosversion``; start ``/rosout``.

        Raises:
            StartError: The port is taken, or the address cannot be used.
        """
        registrations = self._api.registrations
        self._notifier = Notifier(
            nodes_at=registrations.nodes_at, on_unreachable=self._unreachable, counters=self.counters
        )
        self._liveness = Liveness(nodes=registrations.nodes, on_dead=self._dead)
        if self.memory is not None:
            await self.memory.open()
        try:
            await self._server.start()
        except BaseException:
            await self.close()
            raise
        self._api.uri = f"http://{self._advertised}:{self.port}/"
        # roslaunch's convention: nodes of one run find their logs by it.
        if not isinstance(self.call("getParam", CALLER_ID, "/run_id").value, str):
            self.call("setParam", CALLER_ID, "/run_id", str(uuid.uuid1()))
        self.call("setParam", CALLER_ID, "/rosversion", ROS_VERSION)
        self.call("setParam", CALLER_ID, "/rosdistro", ROS_DISTRO)
        self._liveness.start()
        if self.memory is not None:
            self.memory.start()
        if self._with_rosout:
            self._rosout = Rosout(self._host, self._advertised, self.uri, self.call, registrations, self.counters)
            self.on_change(self._rosout.graph_changed)
            try:
                await self._rosout.start()
            except BaseException:
                self._rosout = None
                await self.close()
                raise

    async def close(self) -> None:
        """End: /rosout first, then what calls the nodes, then the server; what was last is kept."""
        rosout, self._rosout = self._rosout, None
        if rosout is not None:
            await rosout.close()
        if self.memory is not None:
            await self.memory.stop_verification()
        if self._notifier is not None:
            await self._notifier.close()
        if self._liveness is not None:
            await self._liveness.close()
        await self._server.close()
        if self.memory is not None:
            await self.memory.close()

    @property
    def uri(self) -> str:
        """``http://127.0.0.1:11311/``; empty before ``start()``."""
        return self._api.uri

    @property
    def port(self) -> int:
        """The port that it listens at."""
        return self._server.port

    @property
    def node_host(self) -> str:
        """Loopback: only nodes of this machine may reach the agent's."""
        return _LOOPBACK

    @property
    def node_address(self) -> str:
        """Likewise."""
        return _LOOPBACK

    # --- asking it --------------------------------------------------------------------------------------------

    def call(self, method: str, *params: XmlRpcValue) -> RosReply:
        """Call a method of the Master or Parameter Server API, as over XML-RPC but at once.

        It breathes before it does: who registers hundreds of topics in a row gives way to data between them.

        Returns:
            ``(code, status, value)``; the value must not be changed, nor may ``params`` be afterwards.

        Raises:
            RosFault: There is no such method.
        """
        yield_to_data()
        reply = self._api.call(method, params)
        self._carry_out()
        return reply

    async def ask(self, method: str, *params: XmlRpcValue) -> RosReply:
        """The same as ``call``, for who can wait: a real roscore's answer takes its time."""
        return self.call(method, *params)

    def state(self) -> GraphState:
        """All registrations at this moment; the same object until one changes."""
        return self._api.state()

    def publishers(self, topic: str) -> Mapping[str, str]:
        """Who publishes a topic now, and their slave APIs; never changed afterwards."""
        return self._api.registrations.at(RegistrationKind.PUBLISHER, topic)

    def type_of(self, topic: str) -> str:
        """The type that was last said for a topic; ``*`` for none."""
        return self._api.registrations.types().get(topic, ANY_TYPE)

    def on_change(self, callback: Callable[[GraphChange], None]) -> None:
        """Call ``callback`` in the loop after each change of a registration, before the reply to it leaves.

        A callback may call the core; an exception of one is logged and does not reach the node.
        """
        self._callbacks.append(callback)

    def notes(self) -> tuple[str, ...]:
        """What is wrong with what it keeps: it is there itself as long as the agent is."""
        return self.memory.notes() if self.memory is not None else ()

    def restored(self) -> str:
        """Its file, and what became of the nodes and parameters in it."""
        return self.memory.summary() if self.memory is not None else ""

    def unverified(self, topic: str) -> Mapping[str, str]:
        """Nodes that published a topic in the run before and have not answered since, and their slave APIs."""
        return self._api.registrations.unverified.publishers_of(topic)

    def unreachable(self) -> Mapping[str, Unreachable]:
        """The registered nodes that nothing can connect to; not to be changed."""
        return self._liveness.unreachable if self._liveness is not None else {}

    def suspect(self, node: str) -> None:
        """Say that this node may be dead: it is checked now, and purged if it is."""
        if self._liveness is not None:
            self._liveness.suspect(node)

    # --- inside -----------------------------------------------------------------------------------------------

    def _answer(self, method: str, params: tuple[XmlRpcValue, ...], _client: str) -> XmlRpcValue:
        try:
            return self._api.answer(method, params)
        finally:
            self._carry_out()

    def _carry_out(self) -> None:
        effects, changes = self._api.take()
        if self.memory is not None:
            self.memory.schedule_write()
        # Queued before anybody hears of the change: a callback that registers something must not be overtaken by
        # the list as it was before.
        if self._notifier is not None:
            for effect in effects:
                self._notifier.add(effect)
        for change in changes:
            _log.info("= %s %s %s of %s", "+" if change.added else "-", change.kind.value, change.name, change.node)
            for callback in self._callbacks:
                try:
                    callback(change)
                except Exception:  # noqa: BLE001 - a stranger's code within a call
                    _log.exception("! a listener failed at %s", change)

    def _unreachable(self, api: str) -> None:
        for node in self._api.registrations.nodes_at(api):
            self.suspect(node)

    def _dead(self, node: str, api: str) -> None:
        if self._api.registrations.purge(node, api):
            self.counters.add("node.dead")
            self._carry_out()

    def _asked_to_end(self, reason: str) -> None:
        if self._on_shutdown is not None:
            # Behind the reply, which the caller waits for.
            asyncio.get_running_loop().call_soon(self._on_shutdown, reason)

"""The embedded ROS core: master, parameter server and /rosout, for unmodified ROS nodes.

Every call is answered at once, in the event loop; the notifications that follow from it are sent by other tasks.
"""

from __future__ import annotations

import asyncio
import logging
import os
import uuid
from typing import TYPE_CHECKING, Final

from rmpa.core.counters import Counters
from rmpa.ros.core.api import Core
from rmpa.ros.core.liveness import Liveness
from rmpa.ros.core.notifier import Notifier
from rmpa.ros.core.returned_publishers import ReturnedPublishers
from rmpa.ros.core.rosout import NODE, Rosout
from rmpa.ros.core.state import CoreState
from rmpa.ros.http.server import XmlRpcServer
from rmpa.ros.master.master_api import MasterApi
from rmpa.runtime.accept import Use
from rmpa.runtime.loop import yield_to_data, yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from rmpa.ros.master.reachability import Unreachable
    from rmpa.ros.wire.xmlrpc import RosReply, XmlRpcValue

_log = logging.getLogger(__name__)

DEFAULT_PORT: Final = 11311
CALLER_ID: Final = "/rmpa_core"
_LOOPBACK: Final = "127.0.0.1"
ROS_DISTRO: Final = "noetic\n"
"""The value of ``/rosdistro``, with the line break that roscore takes from ``rosversion -d``; programs strip it."""
ROS_VERSION: Final = "1.15.15\n"
"""The value of ``/rosversion``: the version of ros_comm whose master this core replaces."""


class RosCore(Core):
    """A drop-in for ``roscore``.

    Args:
        host: The address to listen at; loopback unless the network shall reach this core.
        port: 0 lets the system choose.
        advertised_host: The host in ``uri``; default: ``host``, or this machine's name where ``host`` is 0.0.0.0.
        rosout: Whether to aggregate ``/rosout``.
        counters: Where refusals, calls and notifications are counted.
        on_shutdown: ``(reason)``: a client called ``shutdown``; the owner closes the core then.
        state: The file that stores registrations and parameters for the next run; ``None`` stores nothing.
        keep: When the content of the file is restored; see ``CoreState``.
        temporary: Whether a node of this name is not stored, because its owner registers it anew.
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
        keep: str = "auto",
        temporary: Callable[[str], bool] = lambda _: False,
    ) -> None:
        self.counters = counters if counters is not None else Counters()
        self._host = host
        self._advertised = advertised_host or (os.uname().nodename if host in {"", "0.0.0.0"} else host)  # noqa: S104
        self._on_shutdown = on_shutdown
        self._api = MasterApi("", os.getpid(), self._shutdown_requested, yielder=yielding_to_data)
        self._server = XmlRpcServer(self._answer, host, port, counters=self.counters, name="ROS core", use=Use.CORE)
        self._notifier: Notifier | None = None
        self._liveness: Liveness | None = None
        self._with_rosout = rosout
        self._rosout: Rosout | None = None
        self.registrations = self._api.registrations
        self.listeners = []
        self._returned = ReturnedPublishers(self._repeat_publishers)
        self.on_change(self._returned.graph_changed)
        self.stored: CoreState | None = None
        """Stores the state for the next run, if ``state`` is given."""
        if state is not None:
            own = {NODE, CALLER_ID}
            self.stored = CoreState(
                state,
                self._api,
                keep=keep,
                temporary=lambda node: node in own or temporary(node),
                carry_out=self._carry_out,
            )

    # --- its life ---------------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Restore the stored state; listen; set ``/run_id``, ``/rosdistro`` and ``/rosversion``; start ``/rosout``.

        Raises:
            StartError: The port is taken, or the address cannot be used.
        """
        registrations = self._api.registrations
        self._notifier = Notifier(
            nodes_at=registrations.nodes_at, on_unreachable=self._unreachable, counters=self.counters
        )
        self._liveness = Liveness(nodes=registrations.nodes, on_dead=self._dead)
        if self.stored is not None:
            await self.stored.restore()
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
        if self.stored is not None:
            self.stored.start()
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
        """Close /rosout, then the tasks that call nodes, then the server; then write the last state."""
        rosout, self._rosout = self._rosout, None
        if rosout is not None:
            await rosout.close()
        self._returned.close()
        if self._notifier is not None:
            await self._notifier.close()
        if self._liveness is not None:
            await self._liveness.close()
        await self._server.close()
        if self.stored is not None:
            await self.stored.close()

    @property
    def uri(self) -> str:
        return self._api.uri

    @property
    def port(self) -> int:
        """The port at which the core listens."""
        return self._server.port

    @property
    def node_host(self) -> str:
        return _LOOPBACK

    @property
    def node_address(self) -> str:
        return _LOOPBACK

    # --- asking it --------------------------------------------------------------------------------------------

    def call(self, method: str, *params: XmlRpcValue) -> RosReply:
        """Call a method of the Master or Parameter Server API, as over XML-RPC but at once.

        Pending data is served before, so that hundreds of registrations in a row do not hold it up.

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
        return self.call(method, *params)

    def on_lookup(self, callback: Callable[[str, str, str, str], str]) -> bool:
        self._api.service_lookup = callback
        return True

    def notes(self) -> tuple[str, ...]:
        """Problems with storing the core's state; the core itself runs as long as the agent."""
        return self.stored.notes() if self.stored is not None else ()

    def restored(self) -> str:
        return self.stored.summary() if self.stored is not None else ""

    def unreachable(self) -> Mapping[str, Unreachable]:
        return self._liveness.unreachable if self._liveness is not None else {}

    def suspect(self, node: str) -> None:
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
        if self.stored is not None:
            self.stored.schedule_write()
        # Queued before the callbacks run: what a callback registers must be notified after these effects.
        if self._notifier is not None:
            for effect in effects:
                self._notifier.add(effect)
        self.report(changes)

    def _repeat_publishers(self, topics: list[str]) -> None:
        for topic in yielding_to_data(topics):  # a thousand peers that return have 20,000
            self._api.registrations.notify_subscribers(topic)
        self._carry_out()

    def _unreachable(self, api: str) -> None:
        for node in self._api.registrations.nodes_at(api):
            self.suspect(node)

    def _dead(self, node: str, api: str) -> None:
        if self._api.registrations.purge(node, api):
            self.counters.add("node.dead")
            self._carry_out()

    def _shutdown_requested(self, reason: str) -> None:
        if self._on_shutdown is not None:
            # Not at once: the caller waits for the reply, which is sent first.
            asyncio.get_running_loop().call_soon(self._on_shutdown, reason)

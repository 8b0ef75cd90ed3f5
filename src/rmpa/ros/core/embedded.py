"""The embedded ROS core: master, parameter server and /rosout, for unmodified ROS nodes.

Every call is answered at once, in the event loop; the notifications that follow from it are sent by other tasks.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import uuid
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RemoteProtocolError, RmpaError
from rmpa.core.identity import is_own
from rmpa.ros import limits
from rmpa.ros.core.external import Core
from rmpa.ros.core.liveness import Notifier
from rmpa.ros.core.state import CoreState
from rmpa.ros.http.server import XmlRpcServer
from rmpa.ros.master.api import MasterApi
from rmpa.ros.master.parameters import GraphChange, RegistrationKind
from rmpa.ros.node.loggers import serve_loggers
from rmpa.ros.node.publication import Publication
from rmpa.ros.node.slave_node import SlaveNode, Subscription
from rmpa.ros.types.definitions import known_description
from rmpa.ros.wire.log import renamed
from rmpa.runtime.accept import Use
from rmpa.runtime.loop import yield_to_data, yielding_to_data
from rmpa.runtime.tasks import end_tasks, keep_task

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from rmpa.ros.node.subscription import PublisherConnection
    from rmpa.ros.wire.xmlrpc import RosReply, XmlRpcValue

_log = logging.getLogger(__name__)

# Seconds within which a publisher that was withdrawn and is registered again, with the same URI, has its topic's list
# of publishers repeated: a busy subscriber may not have read yet that its old connection ended.
WITHDRAWN_LATELY: Final = 5.0
# Seconds from a publisher's return until the list is repeated.
PUBLISHERS_AGAIN: Final = 2.0
# Withdrawn publishers that are remembered; the oldest is forgotten first.
WITHDRAWN_KEPT: Final = 16_384
# Seconds between two checks whether the name /rosout is free again, and between attempts to start.
ROSOUT_LOOK: Final = 1.0

# Log messages queued for a slow reader of /rosout_agg.
_ROSOUT_QUEUE: Final = 1000

NODE: Final = "/rosout"
TOPIC: Final = "/rosout"
AGGREGATED: Final = "/rosout_agg"
# Python's loggers, by the names that the rosout of a roscore gives to its own.
_LOGGERS: Final = {"ros": "rmpa.ros", "ros.rosout": "rmpa.ros.core.embedded"}
LOG: Final = known_description("rosgraph_msgs/Log")
DEFAULT_PORT: Final = 11311
CALLER_ID: Final = "/rmpa_core"
# The value of ``/rosdistro``, with the line break that roscore takes from ``rosversion -d``; programs strip it.
ROS_DISTRO: Final = "noetic\n"
# The value of ``/rosversion``: the version of ros_comm whose master this core replaces.
ROS_VERSION: Final = "1.15.15\n"


class Rosout:
    """The node ``/rosout``: forwards the log messages of all nodes to ``/rosout_agg`` (wiki.ros.org/rosout).

    The messages are never decoded; in those of a proxy its name replaces that of the node, so that their origin is
    seen. Like roscore it restarts the node when that ends (``rosnode kill /rosout``), at a new address, after
    ``limits.ROSOUT_RESPAWN`` seconds. While another node has the name, this one does not run.

    Args:
        core: The core, whose counters count ``rosout.restarted``.
        host: The address to listen at.
        advertised_host: The address that is registered.
    """

    def __init__(self, core: RosCore, host: str, advertised_host: str) -> None:
        self._core = core
        self._host = host
        self._advertised = advertised_host
        self._node: SlaveNode | None = None
        self._keeper: asyncio.Task[None] | None = None
        self._changed = asyncio.Event()
        self._publishers: Mapping[str, str] = {}
        self._nodes: dict[str, str] = {}
        # Called with the publishing node and the framed bytes of each message.
        self.listeners: list[Callable[[str, memoryview], None]] = []

    @property
    def uri(self) -> str:
        """The node's slave API; empty while it does not run."""
        return self._node.uri if self._node is not None else ""

    async def start(self) -> None:
        """Listen, register, and stay registered.

        Raises:
            StartError: The address cannot be used.
        """
        await self._begin()
        self._keeper = keep_task(self._keep, "keep /rosout")

    async def close(self) -> None:
        """Unregister and close."""
        await end_tasks(self._keeper)
        await self._end()

    def graph_changed(self, change: GraphChange) -> None:
        """Note a change in the graph: the name may be free now, or taken."""
        if change.node == NODE and not change.added:
            self._changed.set()

    async def _begin(self) -> None:
        core = self._core
        node = SlaveNode(
            NODE,
            self._host,
            core.uri,
            advertised_host=self._advertised,
            counters=core.counters,
            on_shutdown=self._killed,
        )
        await node.start()
        self._node = node
        aggregated = Publication(AGGREGATED, NODE, LOG, queue_messages=_ROSOUT_QUEUE)
        node.add_publication(aggregated)

        def pass_on(publisher: PublisherConnection, framed: memoryview) -> None:
            source = self._node_at(publisher.uri)
            if is_own(source):  # another module's node
                with contextlib.suppress(RemoteProtocolError):
                    framed = memoryview(renamed(framed, source))
            aggregated.publish_framed(framed)
            for listener in self.listeners:
                listener(source, framed)

        subscription = Subscription(
            TOPIC,
            node,
            on_message=pass_on,
            on_refused=lambda publisher, text: _log.info("! %s is not aggregated: %s", publisher.uri, text),
            wanted=LOG,
        )
        node.add_subscription(subscription)
        core.call("registerPublisher", NODE, AGGREGATED, LOG.type, node.uri)
        core.call("registerSubscriber", NODE, TOPIC, LOG.type, node.uri)
        subscription.update(list(core.publishers(TOPIC).values()))
        serve_loggers(node, core.call, _LOGGERS)

    def _node_at(self, uri: str) -> str:
        """The publishing node with a slave API."""
        known = self._core.publishers(TOPIC)
        if known is not self._publishers:  # another object after each change
            self._publishers, self._nodes = known, {each: name for name, each in known.items()}
        return self._nodes.get(uri, NODE)

    async def _end(self) -> None:
        node, self._node = self._node, None
        if node is not None:
            self._core.purge(NODE, node.uri)
            await node.close()

    def _killed(self, reason: str) -> None:
        _log.info("= %s was asked to end (%s)", NODE, reason)
        self._core.purge(NODE, self.uri)  # which is noticed as any such change

    async def _keep(self) -> None:
        while True:
            # Both registrations must be in the graph.
            core, ours = self._core, self.uri
            if not core.publishers(AGGREGATED).get(NODE) == core.subscribers(TOPIC).get(NODE) == ours:
                await self._end()
                await asyncio.sleep(limits.ROSOUT_RESPAWN)
                await self._restart()
            await self._changed.wait()
            self._changed.clear()

    async def _restart(self) -> None:
        warned = False
        while True:
            if (holder := self._core.registrations.node_api(NODE)) is not None:
                if not warned:
                    _log.warning(
                        "= another node has the name %s, at %s; ours waits until it ends [name-taken]", NODE, holder
                    )
                    warned = True
            else:
                try:
                    await self._begin()
                    break
                except (RmpaError, OSError) as error:
                    _log.error("! %s cannot be started again; it is tried again: %s [cannot-start]", NODE, error)
            await asyncio.sleep(ROSOUT_LOOK)
        self._core.counters.add("rosout.restarted")
        _log.info("= %s is back at %s", NODE, self.uri)


class RosCore(Core):
    """A drop-in for ``roscore``.

    Args:
        host: The address to listen at; loopback unless the network shall reach this core.
        port: 0 lets the system choose.
        advertised_host: The host in ``uri``; default: ``host``, or this machine's name where ``host`` is 0.0.0.0.
        rosout: Whether to aggregate ``/rosout``.
        on_shutdown: ``(reason)``: a client called ``shutdown``; the owner closes the core then.
        state: The file that stores registrations and parameters for the next run; ``None`` stores nothing.
        keep: When the content of the file is restored; see ``CoreState``.
        temporary: Whether a node of this name is not stored, because its owner registers it anew.

    Attributes:
        stored: Stores the state for the next run, if ``state`` is given.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = DEFAULT_PORT,
        *,
        advertised_host: str = "",
        rosout: bool = True,
        on_shutdown: Callable[[str], None] | None = None,
        state: Path | None = None,
        keep: str = "auto",
        temporary: Callable[[str], bool] = lambda _: False,
    ) -> None:
        self._advertised = advertised_host or (os.uname().nodename if host in {"", "0.0.0.0"} else host)  # noqa: S104
        self._on_shutdown = on_shutdown
        self._api = MasterApi("", os.getpid(), self._shutdown_requested, yielder=yielding_to_data)
        super().__init__("", self._api.registrations, self._api.registrations.nodes)
        self._server = XmlRpcServer(self._answer, host, port, counters=self.counters, name="ROS core", use=Use.CORE)
        self._notifier = Notifier(self.registrations, self.suspect, self.counters)
        self._rosout = Rosout(self, host, self._advertised) if rosout else None
        # Topics and slave APIs of withdrawn publishers, and when.
        self._withdrawn: dict[tuple[str, str], float] = {}
        # Topics whose lists will be repeated.
        self._repeated = set[str]()
        self.on_change(self._publisher_changed)
        self.stored: CoreState | None = None
        if state is not None:
            own = {NODE, CALLER_ID}
            self.stored = CoreState(
                state,
                self._api,
                keep=keep,
                temporary=lambda node: node in own or temporary(node),
                carry_out=self._carry_out,
            )

    async def start(self) -> None:
        """Restore the stored state; listen; set ``/run_id``, ``/rosdistro`` and ``/rosversion``; start ``/rosout``.

        Raises:
            StartError: The port is taken, or the address cannot be used.
        """
        if self.stored is not None:
            await self.stored.restore()
        try:
            await self._server.start()
            self.uri = self._api.uri = f"http://{self._advertised}:{self.port}/"
            # roslaunch's convention: nodes of one run find their logs by it.
            if not isinstance(self.call("getParam", CALLER_ID, "/run_id").value, str):
                self.call("setParam", CALLER_ID, "/run_id", str(uuid.uuid1()))
            self.call("setParam", CALLER_ID, "/rosversion", ROS_VERSION)
            self.call("setParam", CALLER_ID, "/rosdistro", ROS_DISTRO)
            self.liveness.start()
            if self.stored is not None:
                self.stored.start()
            if self._rosout is not None:
                self.on_change(self._rosout.graph_changed)
                await self._rosout.start()
        except BaseException:
            await self.close()
            raise

    async def close(self) -> None:
        """Close /rosout, then the tasks that call nodes, then the server; then write the last state."""
        if self._rosout is not None:
            await self._rosout.close()
        await self._notifier.close()
        await self.liveness.close()
        await self._server.close()
        if self.stored is not None:
            await self.stored.close()

    @property
    def port(self) -> int:
        """The port at which the core listens."""
        return self._server.port

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

    def on_log(self, callback: Callable[[str, memoryview], None]) -> bool:
        if self._rosout is not None:
            self._rosout.listeners.append(callback)
        return self._rosout is not None

    def notes(self) -> tuple[str, ...]:
        """Problems with storing the core's state; the core itself runs as long as the agent."""
        return self.stored.notes() if self.stored is not None else ()

    def restored(self) -> str:
        return self.stored.summary() if self.stored is not None else ""

    def _answer(self, method: str, params: tuple[XmlRpcValue, ...]) -> XmlRpcValue:
        try:
            return self._api.answer(method, params)
        finally:
            self._carry_out()

    def _carry_out(self) -> None:
        calls, changes = self.registrations.take()
        if self.stored is not None:
            self.stored.note_change()
        # Queued before the callbacks run: what a callback registers must be notified after these calls.
        for call in calls:
            self._notifier.add(call)
        self.report(changes)

    def _publisher_changed(self, change: GraphChange) -> None:
        """Repeat the list of a topic's publishers after one of them was withdrawn and soon registered again.

        A rospy subscriber that gets the new list before it has read the end of its connection to that publisher takes
        itself for connected, and would never connect again. Lists that bring nothing new change nothing at a node.
        """
        if change.kind is not RegistrationKind.PUBLISHER:
            return
        loop = asyncio.get_running_loop()
        key = change.name, change.api
        at = self._withdrawn.pop(key, None)
        if not change.added:
            self._withdrawn[key] = loop.time()
            if len(self._withdrawn) > WITHDRAWN_KEPT:
                del self._withdrawn[next(iter(self._withdrawn))]
        elif at is not None and loop.time() - at <= WITHDRAWN_LATELY and change.name not in self._repeated:
            self._repeated.add(change.name)
            loop.call_later(PUBLISHERS_AGAIN, self._repeat_publishers, change.name)

    def _repeat_publishers(self, topic: str) -> None:
        self._repeated.discard(topic)
        self.registrations.notify_subscribers(topic)
        self._carry_out()

    def purge(self, node: str, api: str) -> bool:
        """Remove all registrations of a node; return whether there was one of that name with this slave API."""
        there = self.registrations.purge(node, api)
        self._carry_out()
        return there

    def _dead(self, node: str, api: str) -> None:
        if self.purge(node, api):
            self.counters.add("node.dead")

    def _shutdown_requested(self, reason: str) -> None:
        if self._on_shutdown is not None:
            # Not at once: the caller waits for the reply, which is sent first.
            asyncio.get_running_loop().call_soon(self._on_shutdown, reason)

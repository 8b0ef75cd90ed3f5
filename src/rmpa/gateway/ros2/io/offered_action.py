"""An actionlib server of a module, as an action server in ROS 2's graph."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RmpaError
from rmpa.gateway import limits
from rmpa.gateway.neighbour import ForeignSource, SourceKind
from rmpa.gateway.ros2.action_pair import CANCEL_TYPE, PART, STATUS_TYPE
from rmpa.gateway.ros2.attachment import Ros2Attachment
from rmpa.gateway.ros2.crossing import SITE
from rmpa.gateway.ros2.goals_to_ros1 import Answer, GoalsToRos1, TellServer
from rmpa.gateway.ros2.graph import valid_name
from rmpa.gateway.ros2.io.action_types import find_action, find_topics
from rmpa.gateway.ros2.io.part import SERVICE_NEEDS
from rmpa.gateway.ros2.qos import Ros2Durability, Ros2Qos
from rmpa.gateway.ros2.tokens import EntityKind, data_key
from rmpa.gateway.zenoh_api import ZenohQos
from rmpa.runtime.machine_timer import MachineTimer

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.gateway.neighbour import ForeignTopic, MeshSource, Tap
    from rmpa.gateway.ros2.io.own_nodes import OwnEndpoint
    from rmpa.gateway.ros2.io.part import Ros2Context
    from rmpa.gateway.zenoh_api import Declared, ZenohPublisher, ZenohQuery

_CANCEL: Final = "actionlib_msgs/GoalID"
_NODE: Final = "/action_clients"
"""The node that publishes goals and cancellations for all clients of ROS 2, below ``/rmpa/ros2``."""


class OfferedAction:
    """Offers one actionlib server to ROS 2.

    Args:
        context: What the parts share.
        name: The action's name in the gateway's graph, and in ROS 2.
        ros1: ``package/Name`` of the action.
        server: The server's topics by *status*, *feedback* and *result*.
    """

    def __init__(self, context: Ros2Context, name: str, ros1: str, server: Mapping[str, MeshSource]) -> None:
        self.name = name
        self.ros1 = ros1
        self.server = dict(server)
        self._context = context
        self._machine: GoalsToRos1 | None = None
        self._timer: MachineTimer | None = None
        self._topics: dict[str, ForeignTopic] = {}
        self._connected: dict[str, bool] = {}
        self._taps: dict[str, Tap] = {}
        self._ready = asyncio.Event()
        self._declared: list[Declared | OwnEndpoint | ZenohPublisher] = []
        self._publishers: dict[str, tuple[ZenohPublisher, OwnEndpoint]] = {}
        self._queries: dict[int, ZenohQuery] = {}
        self._requests = 0
        self._sequence = 0
        self._closed = False

    def start(self) -> None:
        """Find the types, and offer it if they are a pair."""
        self._context.spawn(self._offer())

    def close(self) -> None:
        """The server is gone: goals under way end as aborted, and all is taken back."""
        self._closed = True
        self._context.say(self.name, "")
        if self._machine is not None:
            self._machine.server_gone(time.time_ns(), _now())
            self._pump()
        if self._timer is not None:
            self._timer.close()
        for query in self._queries.values():
            query.reply_error("the action server of ROS 1 is gone")
        self._queries.clear()
        for closing in (*self._declared, *self._taps.values(), *self._topics.values()):
            closing.close()

    def report(self) -> dict[str, object]:
        """Its state, as JSON values."""
        machine = self._machine
        return {
            "direction": "out",
            "action": self.name,
            "ros2_type": "" if machine is None else machine.pair.types.name,
            "node": self.server["result"].proxy,
            "goals": 0 if machine is None else machine.active,
        }

    # --- inside ---------------------------------------------------------------------------------------------------

    async def _offer(self) -> None:
        context = self._context
        if not valid_name(self.name):
            context.say(self.name, "ROS 2 does not allow the name of this action")
            return
        try:
            pair = await find_action(context, self.ros1, context.mapping.action(self.ros1))
            headers = await find_topics((pair.messages[0], _CANCEL))
        except RmpaError as error:
            context.say(self.name, f"ROS 2 does not see this action: {error}")
            return
        if self._closed:
            return
        self._machine = machine = GoalsToRos1(pair)
        self._timer = MachineTimer(machine.next_timer, self._due)
        for part, header in zip(("goal", "cancel"), headers, strict=True):
            source = ForeignSource(SourceKind.TOPIC, SITE, "", _NODE, f"{self.name}/{part}", header.type)
            self._topics[part] = topic = context.graph.show_topic(source, self._demand(part))
            topic.describe(header)
        types = pair.types
        for part, kind, take in (
            ("send_goal", types.send_goal, self._send_goal),
            ("get_result", types.get_result, self._get_result),
            ("cancel_goal", CANCEL_TYPE, self._cancel_goal),
        ):
            key = data_key(context.settings.ros2.domain, f"{self.name}{PART}{part}", kind, types.hashes[kind])
            # Before its token, which clients wait for.
            self._declared.append(context.session.queryable(key, take, SERVICE_NEEDS))
            self._declare(machine, part, EntityKind.SERVICE, kind, Ros2Qos())
        latched = Ros2Qos(durability=Ros2Durability.TRANSIENT_LOCAL, depth=1)
        for part, kind, qos, cache in (
            ("feedback", types.feedback, Ros2Qos(), 0),
            ("status", STATUS_TYPE, latched, 1),
        ):
            endpoint = self._declare(machine, part, EntityKind.PUBLISHER, kind, qos)
            publisher = context.session.publisher(endpoint.endpoint.key(), ZenohQos(cache=cache), _ignore)
            self._declared.append(publisher)
            self._publishers[part] = publisher, endpoint

    def _declare(
        self, machine: GoalsToRos1, part: str, kind: EntityKind, type_name: str, qos: Ros2Qos
    ) -> OwnEndpoint:
        hashes, node = machine.pair.types.hashes, self.server["result"].proxy
        made = self._context.nodes.declare(node, kind, f"{self.name}{PART}{part}", type_name, hashes[type_name], qos)
        self._declared.append(made)
        return made

    def _demand(self, part: str) -> Callable[[bool], None]:
        def demand(wanted: bool) -> None:
            self._connected[part] = wanted
            self._judge_ready()

        return demand

    def _judge_ready(self) -> None:
        listening = all(tap.description is not None for tap in self._taps.values()) and len(self._taps) == 3
        if listening and self._connected.get("goal") and self._connected.get("cancel"):
            self._ready.set()
        else:
            self._ready.clear()

    def _listen(self) -> None:
        """Listen to the server from the first goal on."""
        takes = {"status": self._states, "feedback": self._feedback, "result": self._result}
        for part, source in self.server.items():
            if part not in self._taps:
                self._taps[part] = self._context.graph.tap(
                    source,
                    takes[part],
                    self._changed,
                    self._changed,
                    listener=f"/rmpa/{SITE}{_NODE}",
                )
        self._judge_ready()

    def _changed(self, _value: object) -> None:
        asyncio.get_running_loop().call_soon(self._judge_ready)

    # --- requests of ROS 2 ------------------------------------------------------------------------------------------

    def _send_goal(self, query: ZenohQuery) -> None:
        self._listen()
        self._context.spawn(self._send_when_ready(query))

    async def _send_when_ready(self, query: ZenohQuery) -> None:
        try:
            async with asyncio.timeout(limits.ROS2_ACTION_READY):
                await self._ready.wait()
        except TimeoutError:
            query.reply_error("the action server of ROS 1 does not listen to goals")
            return
        self._request(query, lambda m, number: m.send_goal(number, query.payload, time.time_ns(), _now()))

    def _get_result(self, query: ZenohQuery) -> None:
        self._request(query, lambda machine, number: machine.get_result(number, query.payload))

    def _cancel_goal(self, query: ZenohQuery) -> None:
        self._request(query, lambda machine, number: machine.cancel_goal(number, query.payload))

    def _request(self, query: ZenohQuery, take: Callable[[GoalsToRos1, int], None]) -> None:
        if self._machine is None or self._closed or len(self._queries) >= limits.ROS2_GOALS_MAX:
            query.reply_error("the action server of ROS 1 is gone, or has too many requests")
            return
        self._requests += 1
        number = self._requests
        self._queries[number] = query
        try:
            take(self._machine, number)
        except RmpaError as error:
            del self._queries[number]
            query.reply_error(str(error))
        self._pump()

    # --- messages of ROS 1 ------------------------------------------------------------------------------------------

    def _states(self, body: memoryview) -> None:
        self._guarded(lambda machine: machine.states(body, time.time_ns(), _now()))

    def _feedback(self, body: memoryview) -> None:
        self._guarded(lambda machine: machine.feedback(body, time.time_ns(), _now()))

    def _result(self, body: memoryview) -> None:
        self._guarded(lambda machine: machine.result(body, time.time_ns(), _now()))

    def _guarded(self, take: Callable[[GoalsToRos1], None]) -> None:
        if self._machine is None or self._closed:
            return
        try:
            take(self._machine)
        except RmpaError as error:
            self._context.say(f"{self.name} (messages)", str(error))
        self._pump()

    # --- events of the machine --------------------------------------------------------------------------------------

    def _due(self, now: float) -> None:
        if self._machine is not None:
            self._machine.handle_timer(now)
            self._pump()

    def _pump(self) -> None:
        for event in self._machine.take() if self._machine is not None else ():
            if isinstance(event, Answer):
                self._answer(event)
            elif isinstance(event, TellServer):
                self._topics[event.topic].publish(event.message)
            else:
                publisher, endpoint = self._publishers[event.topic]
                self._sequence += 1
                attachment = Ros2Attachment(self._sequence, time.time_ns(), endpoint.gid)
                publisher.put(event.message, attachment.serialize())
        if self._timer is not None and not self._closed:
            self._timer.arm()

    def _answer(self, answer: Answer) -> None:
        query = self._queries.pop(answer.request, None)
        if query is None:
            return
        if answer.response is None:
            query.reply_error(answer.error)
            return
        try:
            asked = Ros2Attachment.parse(query.attachment)
        except RmpaError as error:
            query.reply_error(str(error))
            return
        attachment = Ros2Attachment(asked.sequence, time.time_ns(), asked.gid)
        query.reply(query.key, answer.response, attachment.serialize())
        query.finish()


def _ignore(_value: object) -> None:
    """Nothing is to be done."""


def _now() -> float:
    return asyncio.get_running_loop().time()

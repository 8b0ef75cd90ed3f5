"""An action server of ROS 2, as one of actionlib in the gateway's graph."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RemoteProtocolError, RmpaError
from rmpa.gateway import limits
from rmpa.gateway.neighbour import ForeignSource, SourceKind
from rmpa.gateway.ros2.action_messages import CancelCode, cancel_code, is_accepted
from rmpa.gateway.ros2.action_pair import CANCEL_TYPE, PART, STATUS_TYPE, ActionPair
from rmpa.gateway.ros2.attachment import Ros2Attachment
from rmpa.gateway.ros2.conversion import NoConversion
from rmpa.gateway.ros2.crossing import SITE
from rmpa.gateway.ros2.goals_to_ros2 import AskServer, GoalsToRos2
from rmpa.gateway.ros2.io.action_types import find_parts, find_topics, learn_action, learnt_topics
from rmpa.gateway.ros2.mapping import ActionRule
from rmpa.gateway.ros2.qos import Ros2Qos
from rmpa.gateway.ros2.tokens import EntityKind
from rmpa.runtime.machine_timer import MachineTimer

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.gateway.neighbour import ForeignTopic, MeshSource, Tap
    from rmpa.gateway.ros2.io.own_nodes import OwnEndpoint
    from rmpa.gateway.ros2.io.part import Ros2Context
    from rmpa.gateway.ros2.tokens import Ros2Endpoint
    from rmpa.gateway.zenoh_api import Declared, ZenohSample
    from rmpa.ros.types.messages import MessageType
    from rmpa.ros.wire.tcpros import TopicDescription

_STATUS: Final = "actionlib_msgs/GoalStatusArray"


class ShownAction:
    """Shows one action server of ROS 2 to actionlib's clients.

    Args:
        context: What the parts share.
        server: The server's endpoint *send_goal*.
        name: The action's name in ROS 2.
        here: Its name in the gateway's graph.
    """

    def __init__(self, context: Ros2Context, server: Ros2Endpoint, name: str, here: str) -> None:
        self.server = server
        self.here = here
        self._context = context
        self._name = name
        self._machine: GoalsToRos2 | None = None
        self._timer: MachineTimer | None = None
        self._topics: dict[str, ForeignTopic] = {}
        self._clients: dict[MeshSource, Tap | None] = {}
        self._subscribed: list[Declared | OwnEndpoint] = []
        self._callers: dict[str, OwnEndpoint] = {}
        self._sequence = 0
        self._leaving: asyncio.TimerHandle | None = None
        self._closed = False

    def start(self) -> None:
        """Find the types, and show it if they are a pair."""
        self._context.spawn(self._show())

    def client(self, source: MeshSource, *, there: bool) -> None:
        """A client's topic *goal* or *cancel* appeared or is gone."""
        if there:
            self._clients.setdefault(source, None)
            self._listen()
        elif (tap := self._clients.pop(source, None)) is not None:
            tap.close()

    def close(self) -> None:
        """The server is gone: goals under way end as aborted, then the topics go."""
        self._closed = True
        self._context.say(self.here, "")
        if self._machine is not None:
            self._machine.server_gone(time.time_ns(), _now())
            self._pump()
        if self._timer is not None:
            self._timer.close()
        for tap in self._clients.values():
            if tap is not None:
                tap.close()
        self._clients.clear()
        for each in (*self._subscribed, *self._callers.values()):
            each.close()
        # The last results have to leave before their publishers.
        self._leaving = asyncio.get_running_loop().call_later(limits.ROS2_LAST_RESULTS, self.finish)

    def finish(self) -> None:
        """Take its topics out of the graph, once it is closed; once."""
        if self._leaving is not None:
            self._leaving.cancel()
        for topic in self._topics.values():
            topic.close()
        self._topics.clear()

    def report(self) -> dict[str, object]:
        """Its state, as JSON values."""
        machine = self._machine
        return {
            "direction": "in",
            "action": self.here,
            "ros2_type": self.server.type.removesuffix("_SendGoal"),
            "node": self.server.node.name,
            "clients": sum(tap is not None for tap in self._clients.values()),
            "goals": 0 if machine is None else machine.active,
        }

    # --- inside ----------------------------------------------------------------------------------------------------

    async def _show(self) -> None:
        context, server = self._context, self.server
        try:
            pair, headers = await self._find_pair()
        except RmpaError as error:
            context.say(self.here, f"the action of ROS 2's node {server.node.name} is not shown: {error}")
            return
        if self._closed:
            return
        self._machine = GoalsToRos2(pair)
        self._timer = MachineTimer(self._machine.next_timer, self._due)
        for part, header in zip(("status", "feedback", "result"), headers, strict=True):
            source = ForeignSource(SourceKind.TOPIC, SITE, "", server.node.name, f"{self.here}/{part}", header.type)
            topic = context.graph.show_topic(source, self._wanted if part == "status" else _ignore)
            topic.describe(header)
            self._topics[part] = topic
        self._listen()

    async def _find_pair(self) -> tuple[ActionPair, list[TopicDescription]]:
        """The types, and the headers of status, feedback and result; its node is asked for what is not known here.

        Raises:
            RmpaError: The types are no pair, or ROS 2's are not known.
        """
        context, server = self._context, self.server
        ros2 = server.type.removesuffix("_SendGoal")
        ros1 = context.mapping.ros1_action(ros2)
        rule = context.mapping.action(ros1)
        if rule.name != ros2:
            rule = ActionRule(ros2)
        known: list[MessageType] = []
        try:
            known = await find_parts(ros1)
            pair = ActionPair(known[0], known[1], known[2], rule, context.types)
            if pair.types.hashes[pair.types.send_goal] == server.type_hash:
                return pair, await self._headers(pair)
            problem = f"{ros2} has another definition there than {ros1} here: its type hash differs"
        except RmpaError as error:
            problem = str(error)
        try:
            pair = await learn_action(context, server, ros1, rule, known)
        except RmpaError as error:
            raise NoConversion(f"{problem}; {error}") from error
        return pair, await self._headers(pair)

    @staticmethod
    async def _headers(pair: ActionPair) -> list[TopicDescription]:
        _, result, feedback = pair.messages
        (status,) = await find_topics((_STATUS,))
        try:
            return [status, *await find_topics((feedback, result))]
        except RmpaError:
            return [status, *learnt_topics(pair)]

    def _wanted(self, wanted: bool) -> None:
        if self._machine is not None and not self._closed:
            self._machine.show_status(_now(), wanted=wanted)
            self._pump()

    def _listen(self) -> None:
        """Listen to clients that are not listened to yet, as the node that publishes the status."""
        if self._machine is None or self._closed:
            return
        for source, tap in self._clients.items():
            if tap is None:
                take = self._goal if source.name.endswith("/goal") else self._cancel
                listener = f"/rmpa/{SITE}{self.server.node.name}"
                self._clients[source] = self._context.graph.tap(source, take, _ignore, _ignore, listener=listener)
        if self._clients and not self._subscribed:
            self._subscribe(self._machine)

    def _subscribe(self, machine: GoalsToRos2) -> None:
        types, context = machine.pair.types, self._context
        for part, kind, take in (
            ("feedback", types.feedback, self._feedback),
            ("status", STATUS_TYPE, self._states),
        ):
            endpoint = context.nodes.declare(
                context.nodes.own_name,
                EntityKind.SUBSCRIPTION,
                f"{self._name}{PART}{part}",
                kind,
                types.hashes[kind],
                Ros2Qos(),
            )
            self._subscribed += (endpoint, context.session.subscribe(endpoint.endpoint.key(), take, history=False))

    def _goal(self, body: memoryview) -> None:
        self._guarded(lambda machine: machine.goal(body, time.time_ns(), _now()))

    def _cancel(self, body: memoryview) -> None:
        self._guarded(lambda machine: machine.cancel(body))

    def _feedback(self, sample: ZenohSample) -> None:
        self._guarded(lambda machine: machine.feedback(sample.payload, time.time_ns()))

    def _states(self, sample: ZenohSample) -> None:
        self._guarded(lambda machine: machine.states(sample.payload, time.time_ns()))

    def _guarded(self, take: Callable[[GoalsToRos2], None]) -> None:
        if self._machine is None or self._closed:
            return
        try:
            take(self._machine)
        except RmpaError as error:
            self._context.say(f"{self.here} (messages)", str(error))
        self._pump()

    def _due(self, now: float) -> None:
        if self._machine is not None:
            self._machine.handle_timer(time.time_ns(), now)
            self._pump()

    def _pump(self) -> None:
        if self._machine is None:
            return
        for event in self._machine.take():
            if not isinstance(event, AskServer):
                if event.topic in self._topics:
                    self._topics[event.topic].publish(event.message)
            elif not self._closed:
                self._context.spawn(self._ask(self._machine, event))
        if self._timer is not None and not self._closed:
            self._timer.arm()

    async def _ask(self, machine: GoalsToRos2, event: AskServer) -> None:
        uuid = event.uuid
        try:
            response = await self._call(machine, event)
            stamp, now = time.time_ns(), _now()
            if event.service == "send_goal":
                machine.accepted(uuid, stamp, now, accepted=is_accepted(response))
            elif event.service == "get_result":
                machine.result(uuid, response, stamp, now)
            else:
                machine.cancelling(uuid, stamp, agreed=cancel_code(response) == CancelCode.NONE)
        except RmpaError as error:
            if event.service == "cancel_goal":
                machine.cancelling(uuid, time.time_ns(), agreed=False)
            else:
                machine.failed(uuid, str(error), time.time_ns(), _now())
        if not self._closed:
            self._pump()

    async def _call(self, machine: GoalsToRos2, event: AskServer) -> bytes:
        types, nodes = machine.pair.types, self._context.nodes
        kind = {"send_goal": types.send_goal, "get_result": types.get_result}.get(event.service, CANCEL_TYPE)
        if event.service not in self._callers:
            name = f"{self._name}{PART}{event.service}"
            self._callers[event.service] = nodes.declare(
                nodes.own_name, EntityKind.CLIENT, name, kind, types.hashes[kind], Ros2Qos()
            )
        caller = self._callers[event.service]
        self._sequence += 1
        timeout = limits.ROS2_GOAL_TIMEOUT if event.service == "get_result" else limits.ROS2_CALL_TIMEOUT
        answers = await self._context.session.get(
            caller.endpoint.key(),
            event.request,
            Ros2Attachment(self._sequence, time.time_ns(), caller.gid).serialize(),
            timeout=timeout,
            all_complete=True,
        )
        for answer in answers:
            if answer.ok:
                return answer.payload
        text = answers[0].payload.decode(errors="replace") if answers else "it is gone"
        raise RemoteProtocolError(f"the action server of ROS 2 gave no answer to {event.service}: {text}")


def _ignore(_value: object) -> None:
    """Nothing is to be done."""


def _now() -> float:
    return asyncio.get_running_loop().time()

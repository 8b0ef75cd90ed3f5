"""Actions: actionlib's of the modules in ROS 2's graph, and ROS 2's in the gateway's graph."""

from __future__ import annotations

import asyncio
import uuid as uuids
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RmpaError
from rmpa.gateway import limits
from rmpa.gateway.ros2 import action_messages as messages
from rmpa.gateway.ros2.action_messages import CancelCode, GoalId, GoalState, Ros1Status, Ros2Status
from rmpa.gateway.ros2.conversion import PART, ActionPair, ConversionError, action_name
from rmpa.gateway.ros2.format import EntityKind, Ros2Attachment, Ros2Durability, Ros2Qos, data_key
from rmpa.gateway.ros2.graph import SITE, valid_name
from rmpa.gateway.ros2.services import SERVICE_NEEDS
from rmpa.gateway.ros2.shown_action import KINDS, Goals, JoinedAction, ShownAction, find_types
from rmpa.gateway.rules import ForeignSource, SourceKind
from rmpa.gateway.zenoh.config import ZenohQos

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.gateway.ros2.format import Ros2Endpoint
    from rmpa.gateway.ros2.services import Ros2Context
    from rmpa.gateway.rules import MeshSource
    from rmpa.gateway.zenoh.config import ArrivedQuery
    from rmpa.gateway.zenoh.threads import QueuedPublisher
    from rmpa.ros.wire.tcpros import Buffer
    from rmpa.runtime.loop import SystemClock

# Seconds for an action server of ROS 1 to connect to the gateway's topics; then a goal is refused.
_ROS2_ACTION_READY: Final = 5.0

# The node that publishes goals and cancellations for all clients of ROS 2, below ``/rmpa/ros2``.
_NODE: Final = "/action_clients"
_LATCHED: Final = Ros2Qos(durability=Ros2Durability.TRANSIENT_LOCAL, depth=1)
_SEND: Final = f"{PART}send_goal"
_OF_SERVER: Final = ("status", "feedback", "result")
_OF_CLIENTS: Final = ("goal", "cancel")
# The topics of an action of ROS 1, and their types or the ends of their types.
_TYPES: Final = {
    "goal": "ActionGoal",
    "cancel": "actionlib_msgs/GoalID",
    "status": "actionlib_msgs/GoalStatusArray",
    "feedback": "ActionFeedback",
    "result": "ActionResult",
}


# Clients of ROS 2, and an actionlib server of ROS 1.


@dataclass(slots=True)
class _SentToRos1:
    id: GoalId
    uuid: bytes
    # When the goal is given up, unless the server shows it before; afterwards, when it is forgotten.
    deadline: float
    # The request ``send_goal`` that is not answered yet.
    asked: ArrivedQuery | None
    status: Ros1Status = Ros1Status.PENDING
    # Requests ``get_result`` that are not answered yet.
    waiting: list[ArrivedQuery] = field(default_factory=list)
    # The result of ROS 1 once it has come.
    result: bytes | None = None
    # Whether the server's status has named it.
    listed: bool = False

    @property
    def ended(self) -> bool:
        return self.result is not None


class GoalsToRos1(Goals):
    """The goals of one action.

    Args:
        pair: The action's types.
        out: Answers the requests, and has what is told to both sides published.
        clock: Both clocks.
    """

    def __init__(self, pair: ActionPair, out: OfferedAction, clock: SystemClock) -> None:
        super().__init__(pair, clock)
        self._out = out
        # By the id in ROS 1, which is the text of the UUID.
        self._goals: dict[str, _SentToRos1] = {}

    # --- from the clients of ROS 2 --------------------------------------------------------------------------------

    def send_goal(self, query: ArrivedQuery) -> None:
        """A client calls ``send_goal``."""
        uuid, cdr = messages.split_uuid(query.payload)
        body, name, stamp = self.pair.goal.to_ros1(cdr), _name(uuid), self._clock.wall_ns()
        if name in self._goals or len(self._goals) >= limits.ROS2_GOALS_MAX:
            self._out.answer(query, messages.send_goal_response(stamp, accepted=False))
            return
        goal_id = GoalId(name, *divmod(stamp, 10**9))
        self._goals[name] = _SentToRos1(goal_id, uuid, self._clock.now() + limits.ROS2_ACCEPT_TIMEOUT, query)
        self._out.tell_ros1("goal", messages.ros1_message(stamp, goal_id.serialize(), body))

    def get_result(self, query: ArrivedQuery) -> None:
        """A client calls ``get_result``; of a goal that is not known the status is UNKNOWN, as rcl answers."""
        uuid, _ = messages.split_uuid(query.payload)
        goal = self._goals.get(_name(uuid))
        if goal is None:
            self._out.answer(query, self.pair.result_to_ros2(Ros2Status.UNKNOWN, self.pair.no_result))
        elif sum(len(each.waiting) for each in self._goals.values()) >= limits.ROS2_GOALS_MAX:
            query.reply_error("too many clients wait for results")
        else:
            goal.waiting.append(query)
            if goal.ended:
                self._give_result(goal)

    def cancel_goal(self, query: ArrivedQuery) -> None:
        """A client calls ``cancel_goal``: one goal, all up to a stamp, or all (action_msgs/CancelGoal)."""
        uuid, until = messages.parse_cancel_request(query.payload)
        every = uuid == messages.ALL_GOALS and until == (0, 0)
        asked = [goal for goal in self._goals.values() if every or goal.uuid == uuid or goal.id.stamp <= until]
        open_goals = [goal for goal in asked if not goal.ended]
        for goal in open_goals:
            # With a stamp ROS 1 would cancel all older goals too.
            self._out.tell_ros1("cancel", GoalId(goal.id.id).serialize())
        code = CancelCode.NONE
        if uuid != messages.ALL_GOALS and not open_goals:
            code = CancelCode.GOAL_ENDED if asked else CancelCode.UNKNOWN_GOAL
        self._out.answer(query, messages.cancel_response(code, [(goal.uuid, goal.id) for goal in open_goals]))

    # --- from the server of ROS 1 ---------------------------------------------------------------------------------

    def status(self, raw: Buffer) -> None:
        """The server publishes its status; a goal that it named before, and names no more, is lost."""
        listed, changed = messages.parse_states(raw), False
        for each in listed:
            changed |= self._take_state(each)
        if changed:
            self._tell_states()
        named = {each.goal.id for each in listed}
        for goal in list(self._goals.values()):
            if goal.id.id in named:
                goal.listed = True
            elif goal.listed and not goal.ended:
                self._end(goal, Ros1Status.LOST, self.pair.no_result)

    def feedback(self, raw: Buffer) -> None:
        """The server publishes feedback."""
        state, body = messages.parse_outcome(raw)
        goal = self._goals.get(state.goal.id)
        if goal is not None and not goal.ended:
            if self._take_state(state):
                self._tell_states()
            self._out.tell_ros2("feedback", messages.with_uuid(goal.uuid, self.pair.feedback.to_ros2(body)))

    def result(self, raw: Buffer) -> None:
        """The server publishes a result."""
        state, body = messages.parse_outcome(raw)
        goal = self._goals.get(state.goal.id)
        if goal is not None and not goal.ended:
            self._end(goal, state.status, body)

    def server_gone(self) -> None:
        """The server is gone: all goals end as aborted."""
        for goal in [goal for goal in self._goals.values() if not goal.ended]:
            self._end(goal, Ros1Status.LOST, self.pair.no_result)

    # --- time ------------------------------------------------------------------------------------------------------

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is to be called; ``None``: not."""
        times = [goal.deadline for goal in self._goals.values() if goal.asked is not None or goal.ended]
        return min(times, default=None)

    def handle_timer(self, now: float) -> None:
        """Give up goals that the server does not show, and forget results that were kept long enough."""
        for name, goal in list(self._goals.items()):
            if goal.deadline > now or (goal.asked is None and not goal.ended):
                continue
            if goal.asked is not None:
                goal.asked.reply_error("the action server of ROS 1 does not show the goal")
                self._out.tell_ros1("cancel", GoalId(name).serialize())
            del self._goals[name]
            for query in goal.waiting:
                query.reply_error("the goal is not known any more")

    # --- inside ----------------------------------------------------------------------------------------------------

    def _take_state(self, state: GoalState) -> bool:
        """Take in one goal's state; return whether it has changed."""
        goal = self._goals.get(state.goal.id)
        if goal is None or goal.ended:
            return False
        if state.status is Ros1Status.REJECTED:
            self._end(goal, state.status, self.pair.no_result)
            return True
        self._accept(goal, accepted=True)
        if state.status not in messages.UNDER_WAY or goal.status is state.status:
            return False  # an end is told with its result
        goal.status = state.status
        return True

    def _accept(self, goal: _SentToRos1, *, accepted: bool) -> None:
        query, goal.asked = goal.asked, None
        if query is not None:
            self._out.answer(query, messages.send_goal_response(self._clock.wall_ns(), accepted=accepted))

    def _end(self, goal: _SentToRos1, status: Ros1Status, body: bytes) -> None:
        self._accept(goal, accepted=status is not Ros1Status.REJECTED)
        goal.status, goal.result, goal.deadline = status, body, self._clock.now() + limits.ROS2_RESULT_KEPT
        self._tell_states()
        self._give_result(goal)

    def _give_result(self, goal: _SentToRos1) -> None:
        waiting, goal.waiting = goal.waiting, []
        for query in waiting:
            try:
                self._out.answer(query, self.pair.result_to_ros2(messages.TO_ROS2[goal.status], goal.result or b""))
            except ConversionError as error:
                query.reply_error(str(error))

    def _tell_states(self) -> None:
        states = (
            (goal.uuid, goal.id, messages.TO_ROS2[goal.status]) for goal in self._goals.values() if goal.asked is None
        )
        self._out.tell_ros2("status", messages.ros2_states(states))


def _name(uuid: bytes) -> str:
    return str(uuids.UUID(bytes=uuid))


class OfferedAction(JoinedAction):
    """Offers one actionlib server to ROS 2.

    Args:
        context: What the parts share.
        name: The action's name in the gateway's graph, and in ROS 2.
        ros1: ``package/Name`` of the action.
        server: The server's topics by *status*, *feedback* and *result*.
    """

    _goals: GoalsToRos1 | None

    def __init__(self, context: Ros2Context, name: str, ros1: str, server: Mapping[str, MeshSource]) -> None:
        self.ros1 = ros1
        self.server = dict(server)
        self._connected: set[str] = set()
        self._ready = asyncio.Event()
        self._publishers: dict[str, tuple[QueuedPublisher, bytes]] = {}
        super().__init__(context, name, name, server["result"].proxy, _NODE)

    def close(self) -> None:
        """The server is gone: goals under way end as aborted, and all is taken back."""
        super().close()
        self.finish()

    def tell_ros2(self, topic: str, message: bytes) -> None:
        """Publish a message for ROS 2."""
        publisher, gid = self._publishers[topic]
        publisher.put(message, self._attachment(gid))

    def answer(self, query: ArrivedQuery, response: bytes) -> None:
        """Answer a request; its attachment is repeated, as rmw_zenoh does."""
        try:
            asked = Ros2Attachment.parse(query.attachment)
        except RmpaError as error:
            query.reply_error(str(error))
            return
        attachment = Ros2Attachment(asked.sequence, self._clock.wall_ns(), asked.gid)
        query.reply(query.key, response, attachment.serialize())
        query.finish()

    # --- inside ---------------------------------------------------------------------------------------------------

    async def _join(self) -> None:
        context = self._context
        if not valid_name(self._name):
            context.say(self.here, "ROS 2 does not allow the name of this action")
            return
        try:
            kinds = await find_types(*(f"{self.ros1}{kind}" for kind in KINDS))
            pair = ActionPair(kinds, context.mapping.action(self.ros1), context.types)
            topics = await find_types(f"{self.ros1}ActionGoal", "actionlib_msgs/GoalID")
        except RmpaError as error:
            context.say(self.here, f"ROS 2 does not see this action: {error}")
            return
        if self._closed:
            return
        self._begin(GoalsToRos1(pair, self, self._clock))
        for part, kind in zip(_OF_CLIENTS, topics, strict=True):
            self._show(part, kind.describe(), partial(self._demand, part))
        for part in ("send_goal", "get_result", "cancel_goal"):
            key = data_key(context.settings.ros2.domain, f"{self._name}{PART}{part}", *pair.types[part])
            # Before its token, which clients wait for.
            take = self._send_goal if part == "send_goal" else partial(self._request, part)
            self._declared.append(context.session.queryable(key, take, SERVICE_NEEDS))
            self._declare(self._server, EntityKind.SERVICE, part)
        for part, qos, cache in (("feedback", Ros2Qos(), 0), ("status", _LATCHED, 1)):
            endpoint = self._declare(self._server, EntityKind.PUBLISHER, part, qos)
            publisher = context.session.publisher(endpoint.endpoint.key(), ZenohQos(cache=cache), lambda _: None)
            self._declared.append(publisher)
            self._publishers[part] = publisher, endpoint.gid

    def _demand(self, part: str, wanted: bool) -> None:
        (self._connected.add if wanted else self._connected.discard)(part)
        self._judge_ready()

    def _judge_ready(self) -> None:
        """Whether the server hears goals: its topics are listened to, and it listens to ours."""
        heard = [tap for tap in self._taps.values() if tap.description is not None]
        whole = len(heard) == len(_OF_SERVER) and len(self._connected) == len(_OF_CLIENTS)
        (self._ready.set if whole else self._ready.clear)()

    def _changed(self, _value: object) -> None:
        asyncio.get_running_loop().call_soon(self._judge_ready)

    def _send_goal(self, query: ArrivedQuery) -> None:
        """Listen to the server from the first goal on, and pass the goal on once the server listens too."""
        for part, source in self.server.items():
            if source not in self._taps:
                self._tap(source, part, self._changed)
        self._judge_ready()
        self._context.spawn(self._send_when_ready(query))

    async def _send_when_ready(self, query: ArrivedQuery) -> None:
        try:
            async with asyncio.timeout(_ROS2_ACTION_READY):
                await self._ready.wait()
        except TimeoutError:
            query.reply_error("the action server of ROS 1 does not listen to goals")
            return
        self._request("send_goal", query)

    def _request(self, service: str, query: ArrivedQuery) -> None:
        if self._goals is None or self._closed:
            query.reply_error("the action server of ROS 1 is gone")
            return
        try:
            getattr(self._goals, service)(query)
        except RmpaError as error:
            query.reply_error(str(error))
        self._arm()


class Ros2Actions:
    """Joins actions both ways. It takes all topics and services of actions, so that no other part carries them."""

    def __init__(self, context: Ros2Context) -> None:
        self._context = context
        # The topics of servers and clients of ROS 1 by action, and what part each is.
        self._topics: dict[str, dict[MeshSource, str]] = {}
        self._offered: dict[str, OfferedAction] = {}
        self._shown: dict[str, ShownAction] = {}
        # Actions whose server is gone, the last of each name: their topics stay for a moment.
        self._leaving: dict[str, ShownAction] = {}

    def mesh_source(self, source: MeshSource, *, there: bool) -> bool:
        """Take a topic of an action."""
        name, _, part = source.here.rpartition("/")
        if source.kind is not SourceKind.TOPIC or not name or not source.type.endswith(_TYPES.get(part, "\0")):
            return False
        topics = self._topics.setdefault(name, {})
        if there:
            topics[source] = part
        else:
            topics.pop(source, None)
        if part in _OF_SERVER:
            self._offer(name)
        for shown in self._shown.values():
            if shown.here == name and part in _OF_CLIENTS:
                shown.follow(self._clients(name))
        if not topics:
            del self._topics[name]
        return True

    def endpoint(self, endpoint: Ros2Endpoint, *, there: bool) -> bool:
        """Take a service or topic of an action; its *send_goal* stands for the server."""
        if PART not in endpoint.name:
            return False
        if endpoint.kind is EntityKind.SERVICE and endpoint.name.endswith(_SEND):
            name = endpoint.name.removesuffix(_SEND)
            shown = self._shown.get(name)
            if there and shown is None:
                self._show(name, endpoint)
            elif not there and shown is not None and shown.server == endpoint:
                shown.close()
                self._leaving[name] = self._shown.pop(name)
                # The next server of this name takes its place.
                if (other := next(self._context.ros2.at(endpoint.name, EntityKind.SERVICE), None)) is not None:
                    self._show(name, other)
        return True

    def close(self) -> None:
        """Take back all actions of both sides."""
        for action in (*self._offered.values(), *self._shown.values()):
            action.close()
        for shown in (*self._shown.values(), *self._leaving.values()):
            shown.finish()
        self._offered.clear()
        self._shown.clear()

    # --- inside -----------------------------------------------------------------------------------------------------

    def _clients(self, name: str) -> set[MeshSource]:
        return {source for source, part in self._topics.get(name, {}).items() if part in _OF_CLIENTS}

    def _offer(self, name: str) -> None:
        """Offer the first server of a name that has all its topics."""
        servers: dict[str, dict[str, MeshSource]] = {}
        for source, part in self._topics[name].items():
            if part in _OF_SERVER:
                servers.setdefault(source.proxy, {})[part] = source
        whole = [parts for parts in servers.values() if len(parts) == len(_OF_SERVER)]
        if name in self._offered and self._offered[name].server not in whole:
            self._offered.pop(name).close()
        if name in self._offered or not whole or len(self._offered) >= limits.ROS2_ACTIONS_MAX:
            return
        result = whole[0]["result"]
        ros1 = action_name(result.type, "ActionResult")
        if self._context.rules.outgoing_to(SITE, result.module, result.name).allowed and ros1:
            self._offered[name] = OfferedAction(self._context, name, ros1, whole[0])

    def _show(self, name: str, endpoint: Ros2Endpoint) -> None:
        if len(self._shown) >= limits.ROS2_ACTIONS_MAX:
            return
        if (before := self._leaving.pop(name, None)) is not None:
            before.finish()
        source = ForeignSource(SourceKind.SERVICE, SITE, "", endpoint.node.name, name, "*")
        decision = self._context.rules.incoming(source)
        if decision.allowed:
            self._shown[name] = ShownAction(self._context, endpoint, name, decision.name)
            self._shown[name].follow(self._clients(decision.name))

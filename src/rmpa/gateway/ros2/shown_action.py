"""Actions of ROS 2 in the gateway's graph, and what both directions of actions share."""

from __future__ import annotations

import asyncio
import hashlib
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from rmpa.core.errors import RemoteProtocolError, RmpaError
from rmpa.gateway import limits
from rmpa.gateway.ros2 import action_messages as messages
from rmpa.gateway.ros2.action_messages import CancelCode, GoalId, GoalState, Ros1Status, Ros2Status
from rmpa.gateway.ros2.conversion import PART, ActionPair, ConversionError, NoConversion
from rmpa.gateway.ros2.format import EntityKind, Ros2Attachment, Ros2Qos
from rmpa.gateway.ros2.graph import SITE
from rmpa.gateway.ros2.pairs import derive_ros1
from rmpa.gateway.ros2.types import TypePair
from rmpa.gateway.rules import ForeignSource, SourceKind
from rmpa.ros.types.definitions import Specification, known_specifications
from rmpa.ros.types.find import find_message_type
from rmpa.ros.types.messages import MessageType
from rmpa.runtime.loop import MachineTimer, SystemClock

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.gateway.foreign import ProxiedTopic, TopicTap
    from rmpa.gateway.ros2.format import Ros2Endpoint
    from rmpa.gateway.ros2.graph import OwnEndpoint
    from rmpa.gateway.ros2.services import Ros2Context
    from rmpa.gateway.rules import MeshSource
    from rmpa.gateway.zenoh.session import Declaration
    from rmpa.gateway.zenoh.threads import QueuedPublisher
    from rmpa.ros.wire.tcpros import Buffer, TopicDescription

# Seconds between two messages of an action's status in ROS 1; actionlib's ``status_frequency`` is 5 Hz, and its
# clients count a server as lost after 5 s without one.
_ROS2_STATUS_PERIOD: Final = 0.2
# Seconds of one goal of an action at a server of ROS 2: a day. A server that dies ends its goals at once.
_ROS2_GOAL_TIMEOUT: Final = 86_400.0
# Seconds for which an action's topics stay in ROS 1's graph once its server is gone: its last results leave.
_ROS2_LAST_RESULTS: Final = 1.0

# What the definition of an action is made of.
KINDS: Final = ("Goal", "Result", "Feedback")


class Goals:
    """The goals of one action, in one direction: a machine without I/O.

    What takes a message raises ``RemoteProtocolError`` for one that is malformed, and ``ConversionError`` for one
    that does not fit the other side's type.

    Args:
        pair: The action's types.
        clock: Both clocks.
    """

    def __init__(self, pair: ActionPair, clock: SystemClock) -> None:
        self.pair = pair
        self._clock = clock

    def server_gone(self) -> None:
        """The server is gone: all goals end as aborted."""
        raise NotImplementedError

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is to be called; ``None``: not."""
        raise NotImplementedError

    def handle_timer(self, now: float) -> None:
        """Do what is due."""
        raise NotImplementedError


class JoinedAction:
    """An action of one side, as that of a server at the other one.

    Args:
        context: What the parts share.
        name: The action's name in ROS 2.
        here: Its name in the gateway's graph.
        server: The server's node in the gateway's graph or ROS 2's.
        shown: The node that publishes its topics for ROS 1, below ``/rmpa/ros2``.
    """

    # More than twelve fields: the action's names, what was declared at either side, and its goals with their timer.

    def __init__(self, context: Ros2Context, name: str, here: str, server: str, shown: str) -> None:
        self.here = here
        self._context = context
        self._name = name
        self._server = server
        self._shown = shown
        self._clock = SystemClock()
        self._goals: Goals | None = None
        self._timer: MachineTimer | None = None
        self._topics: dict[str, ProxiedTopic] = {}
        self._taps: dict[MeshSource, TopicTap] = {}
        self._declared: list[Declaration | OwnEndpoint | QueuedPublisher] = []
        self._sequence = 0
        self._closed = False
        context.spawn(self._join())

    def close(self) -> None:
        """The server is gone: goals under way end as aborted, and all is taken back but the topics for ROS 1."""
        self._closed = True
        self._context.say(self.here, "")
        if self._goals is not None:
            self._goals.server_gone()
        if self._timer is not None:
            self._timer.close()
        for each in (*self._declared, *self._taps.values()):
            each.close()

    def finish(self) -> None:
        """Take its topics out of ROS 1's graph."""
        for topic in self._topics.values():
            topic.close()
        self._topics.clear()

    def tell_ros1(self, topic: str, message: bytes) -> None:
        """Publish a message for ROS 1."""
        if topic in self._topics:
            self._topics[topic].publish(message)

    async def _join(self) -> None:
        """Find the types, and join the action if they are a pair."""
        raise NotImplementedError

    def _begin(self, goals: Goals) -> None:
        self._goals = goals
        self._timer = MachineTimer(goals.next_timer, goals.handle_timer)

    def _show(self, part: str, header: TopicDescription, on_demand: Callable[[bool], None]) -> None:
        source = ForeignSource(SourceKind.TOPIC, SITE, "", self._shown, f"{self.here}/{part}", header.type)
        self._topics[part] = self._context.graph.show_topic(source, on_demand)
        self._topics[part].describe(header)

    def _declare(self, node: str, kind: EntityKind, part: str, qos: Ros2Qos | None = None) -> OwnEndpoint:
        assert self._goals is not None  # noqa: S101 - nothing is declared before
        name, types = f"{self._name}{PART}{part}", self._goals.pair.types[part]
        made = self._context.nodes.declare(node, kind, name, *types, qos or Ros2Qos())
        self._declared.append(made)
        return made

    def _tap(self, source: MeshSource, part: str, changed: Callable[[object], None]) -> None:
        """Listen to a topic of ROS 1, as the node that publishes the others."""
        listener = f"/rmpa/{SITE}{self._shown}"
        self._taps[source] = self._context.graph.tap(
            source, partial(self._take, part), changed, changed, listener=listener
        )

    def _take(self, part: str, message: Any) -> None:
        """Take a message of a topic, by the method of the goals with its name."""
        if self._goals is None or self._closed:
            return
        try:
            getattr(self._goals, part)(message)
        except RmpaError as error:
            self._context.say(f"{self.here} (messages)", str(error))
        self._arm()

    def _arm(self) -> None:
        if self._timer is not None and not self._closed:
            self._timer.arm()

    def _attachment(self, gid: bytes) -> bytes:
        self._sequence += 1
        return Ros2Attachment(self._sequence, self._clock.wall_ns(), gid).serialize()


async def find_types(*names: str) -> list[MessageType]:
    """Find types of ROS 1; raises ``RmpaError`` if a definition is missing."""
    return [await asyncio.to_thread(find_message_type, name) for name in names]


# Clients of ROS 1, and a server of ROS 2.


@dataclass(slots=True)
class _SentToRos2:
    id: GoalId
    uuid: bytes
    status: Ros1Status = Ros1Status.PENDING
    text: str = ""
    cancelled: bool = False
    ended: float | None = None

    @property
    def state(self) -> GoalState:
        return GoalState(self.id, self.status, self.text)


class GoalsToRos2(Goals):
    """The goals of one action.

    Args:
        pair: The action's types.
        out: Asks the server, which ``answered`` and ``failed`` follow, and has what is told to clients published.
        clock: Both clocks.
    """

    def __init__(self, pair: ActionPair, out: ShownAction, clock: SystemClock) -> None:
        super().__init__(pair, clock)
        self._out = out
        self._goals: dict[bytes, _SentToRos2] = {}
        self._next_status: float | None = None

    # --- from the clients of ROS 1 -------------------------------------------------------------------------------

    def goal(self, raw: Buffer) -> None:
        """A client publishes an ``ActionGoal``."""
        asked, body = messages.parse_goal(raw)
        stamp = self._clock.wall_ns()
        # A server makes up an id and a stamp that are missing, as actionlib's do.
        name = asked.id or f"/rmpa-{len(self._goals)}-{stamp}"
        asked = GoalId(name, *(divmod(stamp, 10**9) if asked.stamp == (0, 0) else asked.stamp))
        uuid = hashlib.sha256(name.encode()).digest()[: messages.UUID_BYTES]
        if uuid in self._goals:
            return
        goal = _SentToRos2(asked, uuid)
        if len(self._goals) >= limits.ROS2_GOALS_MAX:
            self._end(goal, Ros1Status.REJECTED, f"{len(self._goals)} goals are known")
            return
        self._goals[uuid] = goal
        try:
            self._out.ask("send_goal", uuid, messages.with_uuid(uuid, self.pair.goal.to_ros2(body)))
        except ConversionError as error:
            self._end(goal, Ros1Status.REJECTED, str(error))

    def cancel(self, raw: Buffer) -> None:
        """A client publishes a ``GoalID``: one goal, all up to a stamp, or all (wiki.ros.org/actionlib)."""
        asked = messages.parse_cancel(raw)
        for goal in self._goals.values():
            older = asked.stamp != (0, 0) and goal.id.stamp <= asked.stamp
            if goal.ended is None and (goal.id.id == asked.id or older or asked == GoalId()) and not goal.cancelled:
                goal.cancelled = True
                if goal.status is not Ros1Status.PENDING:
                    self._out.ask("cancel_goal", goal.uuid, messages.cancel_request(goal.uuid))

    # --- from the server of ROS 2 --------------------------------------------------------------------------------

    def answered(self, service: str, uuid: bytes, response: bytes) -> None:
        """The server has answered ``send_goal``, ``get_result`` or ``cancel_goal``; late answers are ignored."""
        goal = self._goals.get(uuid)
        if goal is None or goal.ended is not None:
            return
        if service == "send_goal":
            self._accepted(goal, accepted=messages.is_accepted(response))
        elif service == "get_result":
            self._result(goal, response)
        elif messages.cancel_code(response) == CancelCode.NONE:
            goal.status = Ros1Status.PREEMPTING
            self._tell_states()
        else:
            goal.cancelled = False  # it may be cancelled again

    def failed(self, service: str, uuid: bytes, text: str) -> None:
        """The server did not answer: the goal ends, or may be cancelled again."""
        goal = self._goals.get(uuid)
        if goal is None or goal.ended is not None:
            return
        if service == "cancel_goal":
            goal.cancelled = False
        else:
            self._end(goal, Ros1Status.ABORTED, text)

    def server_gone(self) -> None:
        """The server is gone: all goals end as aborted."""
        for uuid in list(self._goals):
            self.failed("", uuid, "the action server of ROS 2 is gone")

    def feedback(self, raw: Buffer) -> None:
        """The server publishes feedback."""
        uuid, cdr = messages.split_uuid(raw)
        goal = self._goals.get(uuid)
        if goal is not None and goal.ended is None:
            self._tell("feedback", goal, self.pair.feedback.to_ros1(cdr))

    def status(self, raw: Buffer) -> None:
        """The server publishes its status: of goals under way ROS 1 is told that they are being preempted."""
        for uuid, status in messages.parse_ros2_states(raw):
            goal = self._goals.get(uuid)
            if status is Ros2Status.CANCELING and goal is not None and goal.status is Ros1Status.ACTIVE:
                goal.status = Ros1Status.PREEMPTING
                self._tell_states()

    # --- time -----------------------------------------------------------------------------------------------------

    def show_status(self, *, wanted: bool) -> None:
        """Begin or stop to publish the status five times a second."""
        self._next_status = self._clock.now() if wanted else None

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is to be called; ``None``: not."""
        return self._next_status

    def handle_timer(self, now: float) -> None:
        """Publish the status, and forget goals that ended a while ago."""
        kept = limits.ROS2_GOAL_KEPT
        for uuid in [u for u, goal in self._goals.items() if goal.ended is not None and goal.ended + kept <= now]:
            del self._goals[uuid]
        if self._next_status is not None and self._next_status <= now:
            self._next_status = now + _ROS2_STATUS_PERIOD
            self._tell_states()

    # --- inside ---------------------------------------------------------------------------------------------------

    def _accepted(self, goal: _SentToRos2, *, accepted: bool) -> None:
        if not accepted:
            self._end(goal, Ros1Status.REJECTED, "the server rejects the goal")
            return
        goal.status = Ros1Status.ACTIVE
        self._tell_states()
        self._out.ask("get_result", goal.uuid, messages.with_uuid(goal.uuid, b"\x00\x01\x00\x00"))
        if goal.cancelled:
            self._out.ask("cancel_goal", goal.uuid, messages.cancel_request(goal.uuid))

    def _result(self, goal: _SentToRos2, response: bytes) -> None:
        try:
            number, body = self.pair.result_to_ros1(response)
            status = messages.TO_ROS1[Ros2Status(number)]
        except (ConversionError, ValueError) as error:
            self._end(goal, Ros1Status.ABORTED, str(error))
            return
        self._end(goal, Ros1Status.LOST if status in messages.UNDER_WAY else status, "", body)

    def _tell_states(self) -> None:
        states = (goal.state for goal in self._goals.values())
        self._out.tell_ros1("status", messages.ros1_states(self._clock.wall_ns(), states))

    def _end(self, goal: _SentToRos2, status: Ros1Status, text: str, body: bytes | None = None) -> None:
        goal.status, goal.text, goal.ended = status, text, self._clock.now()
        self._tell_states()
        self._tell("result", goal, self.pair.no_result if body is None else body)

    def _tell(self, topic: str, goal: _SentToRos2, body: bytes) -> None:
        self._out.tell_ros1(topic, messages.ros1_message(self._clock.wall_ns(), goal.state.serialize(), body))


class ShownAction(JoinedAction):
    """Shows one action server of ROS 2 to actionlib's clients.

    Args:
        context: What the parts share.
        server: The server's endpoint *send_goal*.
        name: The action's name in ROS 2.
        here: Its name in the gateway's graph.
    """

    _goals: GoalsToRos2 | None

    def __init__(self, context: Ros2Context, server: Ros2Endpoint, name: str, here: str) -> None:
        self.server = server
        self._clients: set[MeshSource] = set()
        self._callers: dict[str, OwnEndpoint] = {}
        self._leaving: asyncio.TimerHandle | None = None
        super().__init__(context, name, here, server.node.name, server.node.name)

    def follow(self, clients: set[MeshSource]) -> None:
        """The topics *goal* and *cancel* of its clients are these now."""
        self._clients = clients
        if self._goals is None or self._closed:
            return
        for source in self._taps.keys() - clients:
            self._taps.pop(source).close()
        for source in clients - self._taps.keys():
            self._tap(source, source.here.rpartition("/")[2], _ignore)
        if clients and "feedback" not in self._callers:  # from the first client on
            for part in ("feedback", "status"):
                self._callers[part] = self._declare(self._context.nodes.own_name, EntityKind.SUBSCRIPTION, part)
                key, take = self._callers[part].endpoint.key(), partial(self._take, part)
                self._declared.append(
                    self._context.session.subscribe(key, lambda sample, take=take: take(sample.payload))  # type: ignore[misc]
                )

    def close(self) -> None:
        """The server is gone: goals under way end as aborted, then the topics go."""
        super().close()
        # The last results have to leave before their publishers.
        self._leaving = asyncio.get_running_loop().call_later(_ROS2_LAST_RESULTS, self.finish)

    def finish(self) -> None:
        """Take its topics out of the graph, once it is closed."""
        if self._leaving is not None:
            self._leaving.cancel()
        super().finish()

    def ask(self, service: str, uuid: bytes, request: bytes) -> None:
        """Call a service of the server, and tell the goals what comes of it."""
        if self._goals is not None and not self._closed:
            self._context.spawn(self._ask(self._goals, service, uuid, request))

    # --- inside ----------------------------------------------------------------------------------------------------

    async def _join(self) -> None:
        try:
            pair = await self._find_pair()
            headers = [kind.describe() for kind in await find_types("actionlib_msgs/GoalStatusArray")]
            headers += await self._outcome_headers(pair)
        except RmpaError as error:
            self._context.say(self.here, f"the action of ROS 2's node {self._server} is not shown: {error}")
            return
        if self._closed:
            return
        goals = GoalsToRos2(pair, self, self._clock)
        self._begin(goals)

        def wanted(there: bool) -> None:
            if not self._closed:
                goals.show_status(wanted=there)
                self._arm()

        for part, header in zip(("status", "feedback", "result"), headers, strict=True):
            self._show(part, header, wanted if part == "status" else _ignore)
        self.follow(self._clients)

    @staticmethod
    async def _outcome_headers(pair: ActionPair) -> list[TopicDescription]:
        """The headers of an action's feedback and result; made where this machine has no definition."""
        try:
            return [
                kind.describe() for kind in await find_types(f"{pair.ros1}ActionFeedback", f"{pair.ros1}ActionResult")
            ]
        except RmpaError:
            return [_wrapped(pair.ros1, "Feedback", pair.feedback.ros1), _wrapped(pair.ros1, "Result", pair.result)]

    async def _find_pair(self) -> ActionPair:
        """The types; the server's node is asked for what is not known here.

        Raises:
            RmpaError: The types are no pair, or ROS 2's are not known.
        """
        context, server = self._context, self.server
        ros2 = server.type.removesuffix("_SendGoal")
        ros1 = context.mapping.ros1_type(ros2)
        rule = context.mapping.action(ros1)
        if rule.name != ros2:
            rule = TypePair(ros2)
        known: list[MessageType] = []
        try:
            known = await find_types(*(f"{ros1}{kind}" for kind in KINDS))
            pair = ActionPair(known, rule, context.types)
            if pair.types["send_goal"][1] == server.type_hash:
                return pair
            problem = f"{ros2} has another definition there than {ros1} here: its type hash differs"
        except RmpaError as error:
            problem = str(error)
        own = {f"{ros2}_{kind}": f"{ros1}{kind}" for kind in KINDS}
        try:
            fields = await context.asker.learn(
                (server.name, EntityKind.SERVICE),
                (f"{self._name}{PART}get_result", EntityKind.SERVICE),
                (f"{self._name}{PART}feedback", EntityKind.PUBLISHER),
                of=server,
            )
            types = context.types.variant(fields)
            kinds = known or [
                derive_ros1(types.store, each, lambda it: own.get(it) or context.ros1_name(it)) for each in own
            ]
            return ActionPair(kinds, rule, types)
        except RmpaError as error:
            raise NoConversion(f"{problem}; {error}") from error
        except KeyError as error:
            raise NoConversion(f"{problem}; {ros2} has no form in ROS 1: {error}") from error

    async def _ask(self, goals: GoalsToRos2, service: str, uuid: bytes, request: bytes) -> None:
        if service not in self._callers:
            self._callers[service] = self._declare(self._context.nodes.own_name, EntityKind.CLIENT, service)
        caller = self._callers[service]
        try:
            answers = await self._context.session.get(
                caller.endpoint.key(),
                request,
                self._attachment(caller.gid),
                timeout=_ROS2_GOAL_TIMEOUT if service == "get_result" else limits.ROS2_CALL_TIMEOUT,
                all_complete=True,
            )
            answer = next((answer for answer in answers if answer.ok), None)
            if answer is None:
                text = answers[0].payload.decode(errors="replace") if answers else "it is gone"
                raise RemoteProtocolError(f"the action server of ROS 2 gave no answer to {service}: {text}")
            goals.answered(service, uuid, answer.payload)
        except RmpaError as error:
            goals.failed(service, uuid, str(error))
        self._arm()


def _wrapped(ros1: str, part: str, kind: MessageType) -> TopicDescription:
    """The message of actionlib around a feedback or result, as its genaction.py makes it."""
    name = f"{ros1}Action{part}"
    text = f"Header header\nactionlib_msgs/GoalStatus status\n{kind.name} {part.lower()}\n"
    known = {**known_specifications("std_msgs/Header"), **known_specifications("actionlib_msgs/GoalStatus")}
    return MessageType(name, {**known, **kind.specifications, name: Specification.parse(name, text)}).describe()


def _ignore(_value: object) -> None:
    """Nothing is to be done."""

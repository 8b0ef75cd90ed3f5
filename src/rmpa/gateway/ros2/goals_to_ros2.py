"""Goals of actionlib's clients at an action server of ROS 2: what ROS 1's clients see as their server. No I/O.

A goal's id, any text in ROS 1, becomes 16 bytes of its SHA-256. The states go as ros1_bridge's users expect: accepted
is active, canceling is preempting, canceled is preempted.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rmpa.gateway import limits
from rmpa.gateway.ros2.action_messages import (
    TO_ROS1,
    UUID_BYTES,
    GoalId,
    GoalState,
    Ros1Status,
    Ros2Status,
    cancel_request,
    parse_cancel,
    parse_goal,
    parse_ros2_states,
    ros1_message,
    ros1_states,
    split_uuid,
    with_uuid,
)
from rmpa.gateway.ros2.conversion import ConversionError

if TYPE_CHECKING:
    from rmpa.gateway.ros2.action_pair import ActionPair
    from rmpa.ros.wire.tcpros import Buffer


@dataclass(frozen=True, slots=True)
class AskServer:
    """A request for the server; ``answered`` or ``failed`` tells how it went.

    Args:
        service: ``send_goal``, ``get_result`` or ``cancel_goal``.
        uuid: The goal's id.
        request: The request as CDR.
    """

    service: str
    uuid: bytes
    request: bytes


@dataclass(frozen=True, slots=True)
class TellClients:
    """A message of ROS 1 for the clients.

    Args:
        topic: ``status``, ``feedback`` or ``result``.
        message: The message.
    """

    topic: str
    message: bytes


@dataclass(slots=True)
class _Goal:
    id: GoalId
    uuid: bytes
    status: Ros1Status = Ros1Status.PENDING
    text: str = ""
    cancelled: bool = False
    ended: float | None = None

    @property
    def state(self) -> GoalState:
        return GoalState(self.id, self.status, self.text)


@dataclass(slots=True)
class GoalsToRos2:
    """The goals of one action; events are collected until ``take``.

    Args:
        pair: The action's types.
    """

    pair: ActionPair
    _goals: dict[bytes, _Goal] = field(default_factory=dict)
    _events: list[AskServer | TellClients] = field(default_factory=list)
    _next_status: float | None = None

    def take(self) -> list[AskServer | TellClients]:
        """The events since the last call, in order."""
        events, self._events = self._events, []
        return events

    @property
    def active(self) -> int:
        """Goals that have not ended."""
        return sum(goal.ended is None for goal in self._goals.values())

    # --- from the clients of ROS 1 -------------------------------------------------------------------------------

    def goal(self, raw: Buffer, stamp: int, now: float) -> None:
        """A client publishes an ``ActionGoal``.

        Args:
            raw: The message.
            stamp: The wall clock, nanoseconds since 1970.
            now: The monotonic clock, seconds.

        Raises:
            RemoteProtocolError: It is malformed.
        """
        goal_id, body = parse_goal(raw)
        if not goal_id.id:  # a server makes up an id then, as actionlib's do
            goal_id = GoalId(f"/rmpa-{len(self._goals)}-{stamp}", goal_id.secs, goal_id.nsecs)
        if goal_id.stamp == (0, 0):
            goal_id = GoalId(goal_id.id, *divmod(stamp, 10**9))
        uuid = hashlib.sha256(goal_id.id.encode()).digest()[:UUID_BYTES]
        if uuid in self._goals:
            return
        goal = _Goal(goal_id, uuid)
        if len(self._goals) >= limits.ROS2_GOALS_MAX:
            text = f"{len(self._goals)} goals are known"
            self._end(goal, Ros1Status.REJECTED, text, self.pair.no_result, stamp, now)
            return
        self._goals[uuid] = goal
        try:
            self._events.append(AskServer("send_goal", uuid, with_uuid(uuid, self.pair.goal.to_ros2(body))))
        except ConversionError as error:
            self._end(goal, Ros1Status.REJECTED, str(error), self.pair.no_result, stamp, now)

    def cancel(self, raw: Buffer) -> None:
        """A client publishes a ``GoalID``: one goal, all up to a stamp, or all (wiki.ros.org/actionlib).

        Raises:
            RemoteProtocolError: It is malformed.
        """
        asked = parse_cancel(raw)
        for goal in self._goals.values():
            older = asked.stamp != (0, 0) and goal.id.stamp <= asked.stamp
            if goal.ended is None and (goal.id.id == asked.id or older or asked == GoalId()) and not goal.cancelled:
                goal.cancelled = True
                if goal.status is not Ros1Status.PENDING:
                    self._cancel(goal)

    # --- from the server of ROS 2 --------------------------------------------------------------------------------

    def accepted(self, uuid: bytes, stamp: int, now: float, *, accepted: bool) -> None:
        """The server has answered ``send_goal``."""
        goal = self._goals.get(uuid)
        if goal is None or goal.ended is not None:
            return
        if not accepted:
            self._end(goal, Ros1Status.REJECTED, "the server rejects the goal", self.pair.no_result, stamp, now)
            return
        goal.status = Ros1Status.ACTIVE
        self._status(stamp)
        self._events.append(AskServer("get_result", uuid, with_uuid(uuid, b"\x00\x01\x00\x00")))
        if goal.cancelled:
            self._cancel(goal)

    def result(self, uuid: bytes, raw: bytes, stamp: int, now: float) -> None:
        """The server has answered ``get_result``."""
        goal = self._goals.get(uuid)
        if goal is None or goal.ended is not None:
            return
        try:
            number, body = self.pair.result_to_ros1(raw)
            status = TO_ROS1[Ros2Status(number)]
        except (ConversionError, ValueError) as error:
            self._end(goal, Ros1Status.ABORTED, str(error), self.pair.no_result, stamp, now)
            return
        self._end(goal, status if status.ended else Ros1Status.LOST, "", body, stamp, now)

    def cancelling(self, uuid: bytes, stamp: int, *, agreed: bool) -> None:
        """The server has answered ``cancel_goal``; a goal that it goes on with may be cancelled again."""
        goal = self._goals.get(uuid)
        if goal is not None and goal.ended is None:
            goal.cancelled = agreed
            if agreed:
                goal.status = Ros1Status.PREEMPTING
                self._status(stamp)

    def failed(self, uuid: bytes, text: str, stamp: int, now: float) -> None:
        """The server did not answer ``send_goal`` or ``get_result``: the goal ends."""
        goal = self._goals.get(uuid)
        if goal is not None and goal.ended is None:
            self._end(goal, Ros1Status.ABORTED, text, self.pair.no_result, stamp, now)

    def server_gone(self, stamp: int, now: float) -> None:
        """The server is gone: all goals end as aborted."""
        for uuid in list(self._goals):
            self.failed(uuid, "the action server of ROS 2 is gone", stamp, now)

    def feedback(self, raw: Buffer, stamp: int) -> None:
        """The server publishes feedback.

        Raises:
            RemoteProtocolError: It is malformed.
            ConversionError: It does not fit ROS 1's type.
        """
        uuid, cdr = split_uuid(raw)
        goal = self._goals.get(uuid)
        if goal is not None and goal.ended is None:
            message = ros1_message(stamp, goal.state.serialize(), self.pair.feedback.to_ros1(cdr))
            self._events.append(TellClients("feedback", message))

    def states(self, raw: Buffer, stamp: int) -> None:
        """The server publishes its status: of goals under way ROS 1 is told that they are being preempted.

        Raises:
            RemoteProtocolError: It is malformed.
        """
        for uuid, status in parse_ros2_states(raw):
            goal = self._goals.get(uuid)
            if status is Ros2Status.CANCELING and goal is not None and goal.status is Ros1Status.ACTIVE:
                goal.status = Ros1Status.PREEMPTING
                self._status(stamp)

    # --- time -----------------------------------------------------------------------------------------------------

    def show_status(self, now: float, *, wanted: bool) -> None:
        """Begin or stop to publish the status five times a second."""
        self._next_status = now if wanted else None

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is to be called; ``None``: not."""
        return self._next_status

    def handle_timer(self, stamp: int, now: float) -> None:
        """Publish the status, and forget goals that ended a while ago."""
        kept = limits.ROS2_GOAL_KEPT
        for uuid in [u for u, goal in self._goals.items() if goal.ended is not None and goal.ended + kept <= now]:
            del self._goals[uuid]
        if self._next_status is not None and self._next_status <= now:
            self._next_status = now + limits.ROS2_STATUS_PERIOD
            self._status(stamp)

    # --- inside ---------------------------------------------------------------------------------------------------

    def _cancel(self, goal: _Goal) -> None:
        self._events.append(AskServer("cancel_goal", goal.uuid, cancel_request(goal.uuid)))

    def _status(self, stamp: int) -> None:
        states = ros1_states(stamp, (goal.state for goal in self._goals.values()))
        self._events.append(TellClients("status", states))

    def _end(self, goal: _Goal, status: Ros1Status, text: str, body: bytes, stamp: int, now: float) -> None:
        goal.status, goal.text, goal.ended = status, text, now
        self._status(stamp)
        self._events.append(TellClients("result", ros1_message(stamp, goal.state.serialize(), body)))

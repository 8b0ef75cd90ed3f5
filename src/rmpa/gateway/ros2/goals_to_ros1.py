"""Goals of ROS 2's action clients at an actionlib server: what ROS 2's clients see as their server. No I/O.

ROS 1 has no answer to a goal: the first status that names it is taken as one. A client of ROS 2 waits for the answer
to ``get_result``, which is given once the result is published.
"""

from __future__ import annotations

import uuid as uuids
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rmpa.gateway import limits
from rmpa.gateway.ros2.action_messages import (
    ALL_GOALS,
    TO_ROS2,
    CancelCode,
    GoalId,
    GoalState,
    Ros1Status,
    Ros2Status,
    cancel_response,
    parse_cancel_request,
    parse_outcome,
    parse_states,
    ros1_message,
    ros2_states,
    send_goal_response,
    split_uuid,
    with_uuid,
)
from rmpa.gateway.ros2.conversion import ConversionError

if TYPE_CHECKING:
    from rmpa.gateway.ros2.action_pair import ActionPair
    from rmpa.ros.wire.tcpros import Buffer


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to a request of a client; a request has one answer.

    Args:
        request: The request's number.
        response: The response as CDR; ``None``: the call fails.
        error: Why it fails.
    """

    request: int
    response: bytes | None
    error: str = ""


@dataclass(frozen=True, slots=True)
class TellServer:
    """A message of ROS 1 for the server.

    Args:
        topic: ``goal`` or ``cancel``.
        message: The message.
    """

    topic: str
    message: bytes


@dataclass(frozen=True, slots=True)
class TellRos2:
    """A message for ROS 2.

    Args:
        topic: ``feedback`` or ``status``.
        message: The message as CDR.
    """

    topic: str
    message: bytes


@dataclass(slots=True)
class _Goal:
    id: GoalId
    uuid: bytes
    deadline: float
    """When the goal is given up, unless the server shows it before; afterwards, when it is forgotten."""
    status: Ros1Status = Ros1Status.PENDING
    asked: int | None = None
    """The request ``send_goal`` that is not answered yet."""
    waiting: list[int] = field(default_factory=list)
    """Requests ``get_result`` that are not answered yet."""
    result: bytes | None = None
    """The result of ROS 1 once it has come."""
    listed: bool = False
    """Whether the server's status has named it."""

    @property
    def ended(self) -> bool:
        return self.result is not None


@dataclass(slots=True)
class GoalsToRos1:
    """The goals of one action; events are collected until ``take``.

    Args:
        pair: The action's types.
    """

    pair: ActionPair
    _goals: dict[bytes, _Goal] = field(default_factory=dict)
    _by_id: dict[str, _Goal] = field(default_factory=dict)
    _events: list[Answer | TellServer | TellRos2] = field(default_factory=list)

    def take(self) -> list[Answer | TellServer | TellRos2]:
        """The events since the last call, in order."""
        events, self._events = self._events, []
        return events

    @property
    def active(self) -> int:
        """Goals that have not ended."""
        return sum(not goal.ended for goal in self._goals.values())

    # --- from the clients of ROS 2 --------------------------------------------------------------------------------

    def send_goal(self, request: int, raw: Buffer, stamp: int, now: float) -> None:
        """A client calls ``send_goal``.

        Args:
            request: A number for the answer.
            raw: The request as CDR.
            stamp: The wall clock, nanoseconds since 1970.
            now: The monotonic clock, seconds.

        Raises:
            RemoteProtocolError: It is malformed.
            ConversionError: The goal does not fit ROS 1's type.
        """
        uuid, cdr = split_uuid(raw)
        body = self.pair.goal.to_ros1(cdr)
        if uuid in self._goals or len(self._goals) >= limits.ROS2_GOALS_MAX:
            self._events.append(Answer(request, send_goal_response(stamp, accepted=False)))
            return
        goal_id = GoalId(str(uuids.UUID(bytes=uuid)), *divmod(stamp, 10**9))
        goal = _Goal(goal_id, uuid, now + limits.ROS2_ACCEPT_TIMEOUT, asked=request)
        self._goals[uuid] = self._by_id[goal_id.id] = goal
        self._events.append(TellServer("goal", ros1_message(stamp, goal_id.serialize(), body)))

    def get_result(self, request: int, raw: Buffer) -> None:
        """A client calls ``get_result``; of a goal that is not known the status is UNKNOWN, as rcl answers.

        Raises:
            RemoteProtocolError: It is malformed.
        """
        uuid, _ = split_uuid(raw)
        goal = self._goals.get(uuid)
        if goal is None:
            unknown = self.pair.result_to_ros2(Ros2Status.UNKNOWN, self.pair.no_result)
            self._events.append(Answer(request, unknown))
            return
        goal.waiting.append(request)
        if goal.ended:
            self._give_result(goal)

    def cancel_goal(self, request: int, raw: Buffer) -> None:
        """A client calls ``cancel_goal``: one goal, all up to a stamp, or all (action_msgs/CancelGoal).

        Raises:
            RemoteProtocolError: It is malformed.
        """
        uuid, until = parse_cancel_request(raw)
        if uuid == ALL_GOALS:
            asked = [goal for goal in self._goals.values() if until == (0, 0) or goal.id.stamp <= until]
        else:
            asked = [goal for goal in self._goals.values() if goal.uuid == uuid or goal.id.stamp <= until]
        open_goals = [goal for goal in asked if not goal.ended]
        for goal in open_goals:
            # With a stamp ROS 1 would cancel all older goals too.
            self._events.append(TellServer("cancel", GoalId(goal.id.id).serialize()))
        code = CancelCode.NONE
        if uuid != ALL_GOALS and not open_goals:
            code = CancelCode.GOAL_ENDED if asked else CancelCode.UNKNOWN_GOAL
        cancelled = [(goal.uuid, goal.id) for goal in open_goals]
        self._events.append(Answer(request, cancel_response(code, cancelled)))

    # --- from the server of ROS 1 ---------------------------------------------------------------------------------

    def states(self, raw: Buffer, stamp: int, now: float) -> None:
        """The server publishes its status. A goal that it named before, and names no more, is lost, as in actionlib.

        Raises:
            RemoteProtocolError: It is malformed.
        """
        changed, named = False, set()
        for state in parse_states(raw):
            changed |= self._state(state, stamp, now)
            named.add(state.goal.id)
        if changed:
            self._tell_states()
        for goal in list(self._goals.values()):
            if goal.id.id in named:
                goal.listed = True
            elif goal.listed and not goal.ended:
                self._end(goal, Ros1Status.LOST, self.pair.no_result, stamp, now)

    def feedback(self, raw: Buffer, stamp: int, now: float) -> None:
        """The server publishes feedback.

        Raises:
            RemoteProtocolError: It is malformed.
            ConversionError: It does not fit ROS 2's type.
        """
        state, body = parse_outcome(raw)
        goal = self._by_id.get(state.goal.id)
        if goal is not None and not goal.ended:
            if self._state(state, stamp, now):
                self._tell_states()
            message = with_uuid(goal.uuid, self.pair.feedback.to_ros2(body))
            self._events.append(TellRos2("feedback", message))

    def result(self, raw: Buffer, stamp: int, now: float) -> None:
        """The server publishes a result.

        Raises:
            RemoteProtocolError: It is malformed.
        """
        state, body = parse_outcome(raw)
        goal = self._by_id.get(state.goal.id)
        if goal is not None and not goal.ended:
            self._end(goal, state.status, body, stamp, now)

    def server_gone(self, stamp: int, now: float) -> None:
        """The server is gone: all goals end as aborted."""
        for goal in [goal for goal in self._goals.values() if not goal.ended]:
            self._end(goal, Ros1Status.LOST, self.pair.no_result, stamp, now)

    # --- time ------------------------------------------------------------------------------------------------------

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is to be called; ``None``: not."""
        times = [goal.deadline for goal in self._goals.values() if goal.asked is not None or goal.ended]
        return min(times, default=None)

    def handle_timer(self, now: float) -> None:
        """Give up goals that the server does not show, and forget results that were kept long enough."""
        for goal in list(self._goals.values()):
            if goal.deadline > now or (goal.asked is None and not goal.ended):
                continue
            if goal.asked is not None:
                self._events.append(Answer(goal.asked, None, "the action server of ROS 1 does not show the goal"))
                self._events.append(TellServer("cancel", GoalId(goal.id.id).serialize()))
            self._forget(goal)

    # --- inside ----------------------------------------------------------------------------------------------------

    def _forget(self, goal: _Goal) -> None:
        del self._goals[goal.uuid], self._by_id[goal.id.id]
        for request in goal.waiting:
            self._events.append(Answer(request, None, "the goal is not known any more"))

    def _state(self, state: GoalState, stamp: int, now: float) -> bool:
        """Take in one goal's state; return whether it has changed."""
        goal = self._by_id.get(state.goal.id)
        if goal is None or goal.ended:
            return False
        if state.status is Ros1Status.REJECTED:
            self._end(goal, state.status, self.pair.no_result, stamp, now)
            return True
        self._accept(goal, stamp)
        if state.status.ended or goal.status is state.status:
            return False  # an end is told with its result
        goal.status = state.status
        return True

    def _accept(self, goal: _Goal, stamp: int, *, accepted: bool = True) -> None:
        if goal.asked is not None:
            self._events.append(Answer(goal.asked, send_goal_response(stamp, accepted=accepted)))
            goal.asked = None

    def _end(self, goal: _Goal, status: Ros1Status, body: bytes, stamp: int, now: float) -> None:
        self._accept(goal, stamp, accepted=status is not Ros1Status.REJECTED)
        goal.status, goal.result, goal.deadline = status, body, now + limits.ROS2_RESULT_KEPT
        self._tell_states()
        self._give_result(goal)

    def _give_result(self, goal: _Goal) -> None:
        waiting, goal.waiting = goal.waiting, []
        for request in waiting:
            try:
                made = self.pair.result_to_ros2(TO_ROS2[goal.status], goal.result or b"")
                self._events.append(Answer(request, made))
            except ConversionError as error:
                self._events.append(Answer(request, None, str(error)))

    def _tell_states(self) -> None:
        states = ((goal.uuid, goal.id, TO_ROS2[goal.status]) for goal in self._goals.values() if goal.asked is None)
        self._events.append(TellRos2("status", ros2_states(states)))

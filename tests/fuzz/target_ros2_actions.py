"""Fuzz target: messages of actions of both sides, and the machines that take them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rmpa.core.errors import RmpaError
from rmpa.gateway.ros2.goals import (
    GoalId,
    GoalState,
    GoalsToRos1,
    GoalsToRos2,
    Ros1Status,
    Ros2Status,
    cancel_request,
    parse_ros2_states,
    parse_states,
    ros1_message,
    ros1_states,
    ros2_states,
    with_uuid,
)
from rmpa.gateway.ros2.pairs import ActionPair
from rmpa.gateway.ros2.types import Ros2Types, TypePair
from rmpa.ros.types.messages import MessageType
from rmpa.runtime.loop import SystemClock

if TYPE_CHECKING:
    from collections.abc import Callable

_JAZZY = Ros2Types("jazzy")
_PARTS = [MessageType(f"actionlib/Test{part}") for part in ("Goal", "Result", "Feedback")]
_PAIR = ActionPair(_PARTS, TypePair("actionlib/action/Test"), _JAZZY)
_UUID = bytes(range(16))
_GOAL = GoalId("goal", (1, 2))
_STATE = GoalState(_GOAL, Ros1Status.ACTIVE, "text")

SEEDS: list[bytes] = [
    b"",
    ros1_message(5, _GOAL.serialize(), b"\5\0\0\0"),
    _GOAL.serialize(),
    ros1_message(5, _STATE.serialize(), b"\5\0\0\0"),
    ros1_states(5, [_STATE, _STATE]),
    with_uuid(_UUID, b"\0\1\0\0\5\0\0\0"),
    cancel_request(_UUID),
    ros2_states([(_UUID, _GOAL, Ros2Status.EXECUTING), (_UUID, _GOAL, Ros2Status.ABORTED)]),
    _PAIR.result_to_ros2(4, b"\7\0\0\0"),
]


class _Out:
    """Counts what the goals do."""

    done = 0

    def tell_ros1(self, *_: object) -> None:
        self.done += 1

    tell_ros2 = ask = answer = tell_ros1


class _Query:
    """The request of a client."""

    def __init__(self, payload: bytes) -> None:
        self.payload = payload

    def reply_error(self, _text: str) -> None:
        pass


def fuzz(data: bytes) -> None:
    """What is read is written as it was; machines take all bytes, or refuse them with a documented error."""
    query: Any = _Query(data)
    out: Any = _Out()
    to_ros2, to_ros1 = GoalsToRos2(out, _PAIR, SystemClock()), GoalsToRos1(out, _PAIR, SystemClock())
    takes: list[Callable[[Any], object]] = [
        to_ros2.goal, to_ros2.cancel, to_ros2.feedback, to_ros2.status, to_ros1.status, to_ros1.feedback,
        to_ros1.result, lambda raw: to_ros2.answered("get_result", _UUID, raw),
    ]  # fmt: skip
    for take, message in (
        *((take, data) for take in takes),
        *((take, query) for take in (to_ros1.send_goal, to_ros1.get_result, to_ros1.cancel_goal)),
    ):
        try:
            take(message)
        except RmpaError as error:
            if not str(error).isprintable():
                raise AssertionError("an error's text is not safe to log") from error
    if out.done > 12:
        raise AssertionError("one message made many")
    _round_trips(data)


def _round_trips(data: bytes) -> None:
    try:
        states = parse_states(data)
    except RmpaError:
        states = []
    if states and parse_states(ros1_states(1, states)) != states:
        raise AssertionError("states of ROS 1 do not survive")
    try:
        found = parse_ros2_states(data)
    except RmpaError:
        return
    again = ros2_states((uuid, GoalId(), status) for uuid, status in found)
    if parse_ros2_states(again) != found:
        raise AssertionError("states of ROS 2 do not survive")

"""Actions of ROS 1 and ROS 2: their messages, and the machines of both directions, one behind the other."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import pytest

from rmpa.gateway import limits
from rmpa.gateway.ros2.goals import (
    ALL_GOALS,
    GoalId,
    GoalsToRos1,
    GoalsToRos2,
    Ros1Status,
    Ros2Status,
    cancel_request,
    cancel_response,
    parse_outcome,
    parse_ros2_states,
    parse_states,
    send_goal_response,
    with_uuid,
)
from rmpa.gateway.ros2.pairs import CANCEL_TYPE, ActionPair, TypeMapping
from rmpa.gateway.ros2.types import Ros2Types, TypePair
from rmpa.ros.types.messages import MessageType
from rmpa.runtime.loop import SystemClock

JAZZY = Ros2Types("jazzy")
TEST = [MessageType(f"actionlib/Test{part}") for part in ("Goal", "Result", "Feedback")]
PAIR = ActionPair(TEST, TypePair("actionlib/action/Test"), JAZZY)
UUID = bytes(range(16))
STAMP = 1_700_000_000_500_000_000
GOAL = MessageType("actionlib/TestActionGoal")
RESULT = MessageType("actionlib/TestActionResult")
FEEDBACK = MessageType("actionlib/TestActionFeedback")
STATES = MessageType("actionlib_msgs/GoalStatusArray")


def cdr(name: str, **values: Any) -> bytes:
    return bytes(JAZZY.store.serialize_cdr(JAZZY.store.types[name](**values), name))


def read(name: str, raw: bytes) -> Any:
    return JAZZY.store.deserialize_cdr(raw, name)


def goal_message(name: str = "g1", number: int = 5) -> bytes:
    return GOAL.serialize(GOAL.make({"goal_id": {"id": name}, "goal": {"goal": number}}))


def of_goal(name: str, status: Ros1Status) -> dict[str, Any]:
    return {"goal_id": {"id": name}, "status": int(status)}


def result_message(name: str, status: Ros1Status, number: int) -> bytes:
    return RESULT.serialize(RESULT.make({"status": of_goal(name, status), "result": {"result": number}}))


def states_message(name: str, status: Ros1Status) -> bytes:
    return STATES.serialize(STATES.make({"status_list": [of_goal(name, status)]}))


# --- messages ------------------------------------------------------------


def test_fibonacci_of_the_tutorials_is_that_of_example_interfaces() -> None:
    rule = TypeMapping().counterpart("actionlib_tutorials/Fibonacci", "action")
    assert rule.name == "example_interfaces/action/Fibonacci"
    texts = {"Goal": "int32 order\n", "Result": "int32[] sequence\n", "Feedback": "int32[] sequence\n"}
    kinds = [MessageType.learn(f"actionlib_tutorials/Fibonacci{part}", text) for part, text in texts.items()]
    pair = ActionPair(kinds, rule, JAZZY)
    result = kinds[1].serialize(kinds[1].make({"sequence": [0, 1, 1]}))
    made = pair.result_to_ros2(Ros2Status.SUCCEEDED, result)
    response = read("example_interfaces/action/Fibonacci_GetResult_Response", made)
    assert (response.status, list(response.result.sequence)) == (4, [0, 1, 1])
    assert pair.result_to_ros1(made) == (4, result)
    assert (pair.ros1, pair.name) == ("actionlib_tutorials/Fibonacci", rule.name)


# --- the machines ------------------------------------------------------------


@dataclass
class Query:
    """A request of a client of ROS 2."""

    payload: bytes
    response: bytes = b""
    error: str = ""

    def reply_error(self, text: str) -> None:
        self.error = text


@dataclass
class Out(SystemClock):
    """What the goals do, and their clock."""

    time: float = 0.0
    told: list[tuple[str, bytes]] = field(default_factory=list)
    """Messages for ROS 1 and ROS 2, by topic."""
    asked: list[tuple[str, bytes, bytes]] = field(default_factory=list)
    """Requests for the server of ROS 2: service, goal and request."""

    def tell_ros1(self, topic: str, message: bytes) -> None:
        self.told.append((topic, message))

    tell_ros2 = tell_ros1

    def ask(self, service: str, uuid: bytes, request: bytes) -> None:
        self.asked.append((service, uuid, request))

    def answer(self, query: Any, response: bytes) -> None:
        assert not query.response
        query.response = response

    def now(self) -> float:
        return self.time

    def wall_ns(self) -> int:
        return STAMP

    def take(self, topic: str) -> list[bytes]:
        """The messages of a topic; all are forgotten."""
        told, self.told = self.told, []
        return [message for each, message in told if each == topic]

    def request(self, service: str) -> tuple[bytes, bytes]:
        """The goal and the request of the first call of a service; all are forgotten."""
        asked, self.asked = self.asked, []
        return next((uuid, request) for each, uuid, request in asked if each == service)


def goals_of(machine: type[GoalsToRos1 | GoalsToRos2]) -> tuple[Any, Out]:
    """The goals of one direction, as of any type: their requests are those of a test; and what they do."""

    out: Any = Out()
    return machine(out, PAIR, out), out


def to_ros2() -> tuple[Any, Out]:
    return goals_of(GoalsToRos2)


def to_ros1() -> tuple[Any, Out]:
    return goals_of(GoalsToRos1)


# --- clients of ROS 1, a server of ROS 2 ------------------------------------------------------------


ACCEPTED, REJECTED = (send_goal_response(STAMP, accepted=yes) for yes in (True, False))


def states_of(out: Out) -> list[Ros1Status]:
    return [state.status for each in out.take("status") for state in parse_states(each)]


def results_of(out: Out) -> list[tuple[Ros1Status, str, bytes]]:
    return [(state.status, state.text, body) for state, body in map(parse_outcome, out.take("result"))]


def begun(goals: Any, out: Out) -> bytes:
    """A goal that the server has accepted."""
    goals.goal(goal_message())
    uuid, _ = out.request("send_goal")
    goals.answered("send_goal", uuid, ACCEPTED)
    assert out.request("get_result")[0] == uuid
    out.told.clear()
    return uuid


def response(status: Ros2Status, number: int = 8) -> bytes:
    result = JAZZY.store.types["actionlib/action/Test_Result"](number)
    return cdr("actionlib/action/Test_GetResult_Response", status=int(status), result=result)


def test_a_goal_of_ros1_is_sent_accepted_and_ends_with_its_result() -> None:
    goals, out = to_ros2()
    goals.goal(goal_message(number=5))
    uuid, request = out.request("send_goal")
    assert read("actionlib/action/Test_SendGoal_Request", request).goal.goal == 5
    goals.goal(goal_message())
    assert not out.asked, "the same goal again"
    goals.answered("send_goal", uuid, ACCEPTED)
    assert states_of(out) == [Ros1Status.ACTIVE]
    assert out.request("get_result")[1][4:] == uuid
    goals.feedback(with_uuid(uuid, b"\0\1\0\0\3\0\0\0"))
    (told,) = out.take("feedback")
    assert FEEDBACK.deserialize(told).feedback.feedback == 3
    goals.answered("get_result", uuid, response(Ros2Status.SUCCEEDED))
    assert results_of(out) == [(Ros1Status.SUCCEEDED, "", b"\x08\0\0\0")]


@pytest.mark.parametrize(
    ("status", "wanted"),
    [
        (Ros2Status.ABORTED, Ros1Status.ABORTED), (Ros2Status.CANCELED, Ros1Status.PREEMPTED),
        (Ros2Status.UNKNOWN, Ros1Status.LOST), (Ros2Status.EXECUTING, Ros1Status.LOST),
    ],
)  # fmt: skip
def test_other_ends_of_a_goal_are_ros1s(status: Ros2Status, wanted: Ros1Status) -> None:
    goals, out = to_ros2()
    goals.answered("get_result", begun(goals, out), response(status))
    assert results_of(out)[0][0] is wanted


def test_a_goal_that_the_server_rejects_or_does_not_answer_ends() -> None:
    goals, out = to_ros2()
    for name in ("a", "b"):
        goals.goal(goal_message(name))
    first, second = (uuid for _, uuid, _ in out.asked)
    goals.answered("send_goal", first, REJECTED)
    assert results_of(out)[0][0] is Ros1Status.REJECTED
    goals.server_gone()
    assert [(status, "gone" in text) for status, text, _ in results_of(out)] == [(Ros1Status.ABORTED, True)]
    out.asked.clear()
    goals.answered("send_goal", second, ACCEPTED)
    assert not out.told
    assert not out.asked, "an answer that comes late"


@pytest.mark.parametrize("cancel", [GoalId(), GoalId("g1"), GoalId("", (2**32 - 1, 0))])
def test_a_cancellation_waits_for_the_acceptance(cancel: GoalId) -> None:
    goals, out = to_ros2()
    goals.goal(goal_message())
    uuid, _ = out.request("send_goal")
    goals.cancel(cancel.serialize())
    assert not out.asked
    goals.answered("send_goal", uuid, ACCEPTED)
    assert out.request("cancel_goal") == (uuid, cancel_request(uuid))
    out.told.clear()
    goals.answered("cancel_goal", uuid, cancel_response(0, [(uuid, GoalId())]))
    assert states_of(out) == [Ros1Status.PREEMPTING]


def test_a_cancellation_that_the_server_refuses_may_be_asked_for_again() -> None:
    goals, out = to_ros2()
    uuid = begun(goals, out)
    for _ in range(2):
        goals.cancel(GoalId("g1").serialize())
        assert out.request("cancel_goal")[0] == uuid
        goals.answered("cancel_goal", uuid, cancel_response(1, []))
    goals.cancel(GoalId("g1").serialize())
    goals.failed("cancel_goal", uuid, "no answer")
    assert not results_of(out), "it goes on"


def test_another_goals_cancellation_does_not_end_a_goal() -> None:
    goals, out = to_ros2()
    begun(goals, out)
    goals.cancel(GoalId("other").serialize())
    assert not out.asked


def test_the_status_is_published_five_times_a_second_while_it_is_wanted() -> None:
    goals, out = to_ros2()
    assert goals.next_timer() is None
    out.time = 10.0
    goals.show_status(wanted=True)
    assert goals.next_timer() == 10.0
    goals.handle_timer(10.0)
    assert len(out.take("status")) == 1
    assert goals.next_timer() == 10.2
    uuid = begun(goals, out)
    out.time = 11.0
    goals.answered("get_result", uuid, response(Ros2Status.SUCCEEDED))
    out.told.clear()
    goals.handle_timer(11.0 + limits.ROS2_GOAL_KEPT)
    assert states_of(out) == [], "it ended long ago"


# --- clients of ROS 2, a server of ROS 1 ------------------------------------------------------------


def sent_to_ros1(goals: Any, out: Out) -> tuple[str, Query]:
    """Send a goal; return its id in ROS 1, and the request."""
    query = Query(with_uuid(UUID, b"\0\1\0\0\5\0\0\0"))
    goals.send_goal(query)
    (told,) = out.take("goal")
    message = GOAL.deserialize(told)
    assert message.goal.goal == 5
    return str(message.goal_id.id), query


def result_of(goals: Any, uuid: bytes = UUID) -> Query:
    query = Query(with_uuid(uuid, b"\0\1\0\0"))
    goals.get_result(query)
    return query


def test_a_goal_of_ros2_is_accepted_by_the_first_status_and_ends_with_its_result() -> None:
    goals, out = to_ros1()
    name, sent = sent_to_ros1(goals, out)
    assert name == "00010203-0405-0607-0809-0a0b0c0d0e0f"
    waiting = result_of(goals)
    assert not sent.response
    goals.status(states_message(name, Ros1Status.ACTIVE))
    assert (sent.response, waiting.response) == (ACCEPTED, b"")
    assert list(map(parse_ros2_states, out.take("status"))) == [[(UUID, Ros2Status.EXECUTING)]]
    out.time = 1.0
    goals.result(result_message(name, Ros1Status.SUCCEEDED, 8))
    assert waiting.response == response(Ros2Status.SUCCEEDED)
    assert result_of(goals).response == response(Ros2Status.SUCCEEDED), "it is kept for a while"
    goals.handle_timer(1.0 + limits.ROS2_RESULT_KEPT)
    assert result_of(goals).response == response(Ros2Status.UNKNOWN, 0)


def test_clients_that_wait_for_a_result_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "ROS2_GOALS_MAX", 3)
    goals, out = to_ros1()
    sent_to_ros1(goals, out)
    assert [result_of(goals).error for _ in range(4)] == ["", "", "", "too many clients wait for results"]


def test_a_rejected_goal_is_not_accepted_and_one_that_is_not_shown_fails() -> None:
    goals, out = to_ros1()
    name, sent = sent_to_ros1(goals, out)
    goals.status(states_message(name, Ros1Status.REJECTED))
    assert sent.response == REJECTED
    goals, out = to_ros1()
    _, sent = sent_to_ros1(goals, out)
    assert goals.next_timer() == limits.ROS2_ACCEPT_TIMEOUT
    goals.handle_timer(limits.ROS2_ACCEPT_TIMEOUT)
    assert "does not show the goal" in sent.error
    assert goals.next_timer() is None


def test_cancellations_of_ros2_name_their_goals() -> None:
    goals, out = to_ros1()
    name, _ = sent_to_ros1(goals, out)
    goals.status(states_message(name, Ros1Status.ACTIVE))
    cases: list[tuple[bytes, int, list[bytes]]] = [(UUID, 0, [UUID]), (ALL_GOALS, 0, [UUID]), (b"x" * 16, 2, [])]
    for uuid, code, cancelled in cases:
        query = Query(cancel_request(uuid))
        out.told.clear()
        goals.cancel_goal(query)
        assert out.take("cancel") == [GoalId(name).serialize() for _ in cancelled]
        made = read(f"{CANCEL_TYPE}_Response", query.response)
        assert (made.return_code, [bytes(each.goal_id.uuid) for each in made.goals_canceling]) == (code, cancelled)


def test_a_goal_that_vanishes_from_the_status_of_its_server_is_lost() -> None:
    """As in actionlib: the server was started again, or has forgotten the goal without a result."""
    goals, out = to_ros1()
    name, _ = sent_to_ros1(goals, out)
    waiting = result_of(goals)
    goals.status(states_message("another", Ros1Status.ACTIVE))
    assert not out.told, "it has not come there yet"
    goals.status(states_message(name, Ros1Status.ACTIVE))
    assert not waiting.response
    goals.status(states_message("another", Ros1Status.ACTIVE))
    assert waiting.response == response(Ros2Status.ABORTED, 0)
    out.told.clear()
    goals.status(states_message("another", Ros1Status.ACTIVE))
    assert not out.told, "once"

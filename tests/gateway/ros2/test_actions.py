"""Actions of ROS 1 and ROS 2: their messages, and the machines of both directions, one behind the other."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rmpa.gateway import limits
from rmpa.gateway.ros2.action_messages import (
    ALL_GOALS,
    GoalId,
    GoalState,
    Ros1Status,
    Ros2Status,
    cancel_request,
    parse_outcome,
    parse_ros2_states,
    parse_states,
    ros1_message,
    ros2_states,
    send_goal_response,
    with_uuid,
)
from rmpa.gateway.ros2.action_pair import CANCEL_TYPE, ActionPair
from rmpa.gateway.ros2.goals_to_ros1 import Answer, GoalsToRos1, TellServer
from rmpa.gateway.ros2.goals_to_ros2 import AskServer, GoalsToRos2, TellClients
from rmpa.gateway.ros2.mapping import ActionRule, TypeMapping
from rmpa.gateway.ros2.types import Ros2Types
from rmpa.ros.types.messages import MessageType

JAZZY = Ros2Types("jazzy")
TEST = [MessageType(f"actionlib/Test{part}") for part in ("Goal", "Result", "Feedback")]
PAIR = ActionPair(TEST[0], TEST[1], TEST[2], ActionRule("actionlib/action/Test"), JAZZY)
UUID = bytes(range(16))
STAMP = 1_700_000_000_500_000_000
GOAL = MessageType("actionlib/TestActionGoal")
RESULT = MessageType("actionlib/TestActionResult")
FEEDBACK = MessageType("actionlib/TestActionFeedback")


def cdr(name: str, **values: Any) -> bytes:
    return bytes(JAZZY.store.serialize_cdr(JAZZY.store.types[name](**values), name))


def read(name: str, raw: bytes) -> Any:
    return JAZZY.store.deserialize_cdr(raw, name)


def goal_message(name: str = "g1", number: int = 5) -> bytes:
    return GOAL.serialize(GOAL.make({"goal_id": {"id": name}, "goal": {"goal": number}}))


def result_message(name: str, status: Ros1Status, number: int) -> bytes:
    return RESULT.serialize(
        RESULT.make({"status": {"goal_id": {"id": name}, "status": int(status)}, "result": {"result": number}})
    )


def states_message(name: str, status: Ros1Status) -> bytes:
    kind = MessageType("actionlib_msgs/GoalStatusArray")
    return kind.serialize(kind.make({"status_list": [{"goal_id": {"id": name}, "status": int(status)}]}))


# --- messages ------------------------------------------------------------


def test_the_messages_of_ros2_are_those_of_its_types() -> None:
    types = JAZZY.store.types
    stamp = types["builtin_interfaces/msg/Time"](1_700_000_000, 500_000_000)
    uuid = types["unique_identifier_msgs/msg/UUID"](np.frombuffer(UUID, np.uint8))
    assert send_goal_response(STAMP, accepted=True) == cdr(
        "actionlib/action/Test_SendGoal_Response", accepted=True, stamp=stamp
    )
    goal = read("actionlib/action/Test_SendGoal_Request", with_uuid(UUID, b"\0\1\0\0\7\0\0\0"))
    assert (bytes(goal.goal_id.uuid), goal.goal.goal) == (UUID, 7)
    info = types["action_msgs/msg/GoalInfo"](uuid, types["builtin_interfaces/msg/Time"](0, 0))
    assert cancel_request(UUID) == cdr(f"{CANCEL_TYPE}_Request", goal_info=info)
    made = ros2_states([(UUID, GoalId("a", 3, 4), status) for status in Ros2Status])
    listed = read("action_msgs/msg/GoalStatusArray", made).status_list
    assert [(bytes(each.goal_info.goal_id.uuid), each.goal_info.stamp.sec, each.status) for each in listed] == [
        (UUID, 3, int(status)) for status in Ros2Status
    ]
    assert parse_ros2_states(made) == [(UUID, status) for status in Ros2Status]


def test_the_messages_of_ros1_are_those_of_its_types() -> None:
    state = GoalState(GoalId("goal é", 5, 6), Ros1Status.ABORTED, "it is hot")
    plain = RESULT.to_plain(RESULT.deserialize(ros1_message(STAMP, state.serialize(), b"\7\0\0\0")))
    assert plain["result"] == {"result": 7}
    assert plain["status"] == {
        "goal_id": {"stamp": {"secs": 5, "nsecs": 6}, "id": "goal é"}, "status": 4, "text": "it is hot",
    }  # fmt: skip
    found, body = parse_outcome(result_message("x", Ros1Status.SUCCEEDED, 9))
    assert (found.goal.id, found.status, body) == ("x", Ros1Status.SUCCEEDED, b"\x09\0\0\0")
    assert parse_states(states_message("x", Ros1Status.ACTIVE)) == [GoalState(GoalId("x"), Ros1Status.ACTIVE)]


def test_fibonacci_of_the_tutorials_is_that_of_example_interfaces() -> None:
    rule = TypeMapping().action("actionlib_tutorials/Fibonacci")
    assert rule.name == "example_interfaces/action/Fibonacci"
    kinds = [
        MessageType.learn(f"actionlib_tutorials/Fibonacci{part}", text)
        for part, text in (
            ("Goal", "int32 order\n"),
            ("Result", "int32[] sequence\n"),
            ("Feedback", "int32[] sequence\n"),
        )
    ]
    pair = ActionPair(kinds[0], kinds[1], kinds[2], rule, JAZZY)
    result = kinds[1].serialize(kinds[1].make({"sequence": [0, 1, 1]}))
    made = pair.result_to_ros2(Ros2Status.SUCCEEDED, result)
    response = read("example_interfaces/action/Fibonacci_GetResult_Response", made)
    assert (response.status, list(response.result.sequence)) == (4, [0, 1, 1])
    assert pair.result_to_ros1(made) == (4, result)
    assert pair.messages[0] == "actionlib_tutorials/FibonacciActionGoal"


# --- clients of ROS 1, a server of ROS 2 ------------------------------------------------------------


def states_of(events: list[Any]) -> list[Ros1Status]:
    told = [each for each in events if isinstance(each, TellClients) and each.topic == "status"]
    return [state.status for each in told for state in parse_states(each.message)]


def results_of(events: list[Any]) -> list[tuple[Ros1Status, str, bytes]]:
    told = [each for each in events if isinstance(each, TellClients) and each.topic == "result"]
    return [(state.status, state.text, body) for state, body in (parse_outcome(each.message) for each in told)]


def asked(events: list[Any], service: str) -> AskServer:
    return next(each for each in events if isinstance(each, AskServer) and each.service == service)


def begun(machine: GoalsToRos2) -> AskServer:
    """A goal that the server has accepted."""
    machine.goal(goal_message(), STAMP, 0.0)
    sent = asked(machine.take(), "send_goal")
    machine.accepted(sent.uuid, STAMP, 0.1, accepted=True)
    return asked(machine.take(), "get_result")


def response(status: Ros2Status, number: int = 8) -> bytes:
    result = JAZZY.store.types["actionlib/action/Test_Result"](number)
    return cdr("actionlib/action/Test_GetResult_Response", status=int(status), result=result)


def test_a_goal_of_ros1_is_sent_accepted_and_ends_with_its_result() -> None:
    machine = GoalsToRos2(PAIR)
    machine.goal(goal_message(number=5), STAMP, 0.0)
    sent = asked(machine.take(), "send_goal")
    assert read("actionlib/action/Test_SendGoal_Request", sent.request).goal.goal == 5
    machine.goal(goal_message(), STAMP, 0.0)
    assert not machine.take(), "the same goal again"
    machine.accepted(sent.uuid, STAMP, 0.1, accepted=True)
    events = machine.take()
    assert states_of(events) == [Ros1Status.ACTIVE]
    assert asked(events, "get_result").request[4:] == sent.uuid
    machine.feedback(with_uuid(sent.uuid, b"\0\1\0\0\3\0\0\0"), STAMP)
    (told,) = machine.take()
    assert isinstance(told, TellClients)
    assert FEEDBACK.deserialize(told.message).feedback.feedback == 3
    machine.result(sent.uuid, response(Ros2Status.SUCCEEDED), STAMP, 1.0)
    assert results_of(machine.take()) == [(Ros1Status.SUCCEEDED, "", b"\x08\0\0\0")]
    assert machine.active == 0


@pytest.mark.parametrize(
    ("status", "wanted"), [(Ros2Status.ABORTED, Ros1Status.ABORTED), (Ros2Status.CANCELED, Ros1Status.PREEMPTED)]
)
def test_other_ends_of_a_goal_are_ros1s(status: Ros2Status, wanted: Ros1Status) -> None:
    machine = GoalsToRos2(PAIR)
    machine.result(begun(machine).uuid, response(status), STAMP, 1.0)
    assert results_of(machine.take())[0][0] is wanted


def test_a_goal_that_the_server_rejects_or_does_not_answer_ends() -> None:
    machine = GoalsToRos2(PAIR)
    for name in ("a", "b"):
        machine.goal(goal_message(name), STAMP, 0.0)
    first, second = (each.uuid for each in machine.take() if isinstance(each, AskServer))
    machine.accepted(first, STAMP, 0.1, accepted=False)
    assert results_of(machine.take())[0][0] is Ros1Status.REJECTED
    machine.server_gone(STAMP, 0.2)
    assert [(status, "gone" in text) for status, text, _ in results_of(machine.take())] == [
        (Ros1Status.ABORTED, True)
    ]
    machine.accepted(second, STAMP, 0.3, accepted=True)
    assert not machine.take(), "an answer that comes late"


@pytest.mark.parametrize("cancel", [GoalId(), GoalId("g1"), GoalId("", 2**32 - 1, 0)])
def test_a_cancellation_waits_for_the_acceptance(cancel: GoalId) -> None:
    machine = GoalsToRos2(PAIR)
    machine.goal(goal_message(), STAMP, 0.0)
    (sent,) = machine.take()
    machine.cancel(cancel.serialize())
    assert not machine.take()
    assert isinstance(sent, AskServer)
    machine.accepted(sent.uuid, STAMP, 0.1, accepted=True)
    assert asked(machine.take(), "cancel_goal").request == cancel_request(sent.uuid)
    machine.cancelling(sent.uuid, STAMP, agreed=True)
    assert states_of(machine.take()) == [Ros1Status.PREEMPTING]


def test_another_goals_cancellation_does_not_end_a_goal() -> None:
    machine = GoalsToRos2(PAIR)
    begun(machine)
    machine.cancel(GoalId("other").serialize())
    assert not machine.take()


def test_the_status_is_published_five_times_a_second_while_it_is_wanted() -> None:
    machine = GoalsToRos2(PAIR)
    assert machine.next_timer() is None
    machine.show_status(10.0, wanted=True)
    assert machine.next_timer() == 10.0
    machine.handle_timer(STAMP, 10.0)
    assert [each.topic for each in machine.take() if isinstance(each, TellClients)] == ["status"]
    assert machine.next_timer() == 10.2
    uuid = begun(machine).uuid
    machine.result(uuid, response(Ros2Status.SUCCEEDED), STAMP, 11.0)
    machine.take()
    machine.handle_timer(STAMP, 11.0 + limits.ROS2_GOAL_KEPT)
    assert states_of(machine.take()) == [], "it ended long ago"


# --- clients of ROS 2, a server of ROS 1 ------------------------------------------------------------


def sent_to_ros1(machine: GoalsToRos1, request: int = 1) -> str:
    """Send a goal; return its id in ROS 1."""
    machine.send_goal(request, with_uuid(UUID, b"\0\1\0\0\5\0\0\0"), STAMP, 0.0)
    (told,) = machine.take()
    assert isinstance(told, TellServer)
    message = GOAL.deserialize(told.message)
    assert message.goal.goal == 5
    return str(message.goal_id.id)


def answers(events: list[Any]) -> dict[int, bytes | None]:
    return {each.request: each.response for each in events if isinstance(each, Answer)}


def test_a_goal_of_ros2_is_accepted_by_the_first_status_and_ends_with_its_result() -> None:
    machine = GoalsToRos1(PAIR)
    name = sent_to_ros1(machine)
    assert name == "00010203-0405-0607-0809-0a0b0c0d0e0f"
    machine.get_result(2, with_uuid(UUID, b"\0\1\0\0"))
    assert not machine.take()
    machine.states(states_message(name, Ros1Status.ACTIVE), STAMP, 0.1)
    events = machine.take()
    assert answers(events) == {1: send_goal_response(STAMP, accepted=True)}
    assert [parse_ros2_states(each.message) for each in events if not isinstance(each, Answer)] == [
        [(UUID, Ros2Status.EXECUTING)]
    ]
    machine.result(result_message(name, Ros1Status.SUCCEEDED, 8), STAMP, 1.0)
    assert answers(machine.take()) == {2: response(Ros2Status.SUCCEEDED)}
    machine.get_result(3, with_uuid(UUID, b"\0\1\0\0"))
    assert answers(machine.take()) == {3: response(Ros2Status.SUCCEEDED)}, "it is kept for a while"
    machine.handle_timer(1.0 + limits.ROS2_RESULT_KEPT)
    machine.get_result(4, with_uuid(UUID, b"\0\1\0\0"))
    assert answers(machine.take()) == {4: response(Ros2Status.UNKNOWN, 0)}


def test_a_result_without_a_status_before_it_answers_both_requests() -> None:
    machine = GoalsToRos1(PAIR)
    name = sent_to_ros1(machine)
    machine.get_result(2, with_uuid(UUID, b"\0\1\0\0"))
    machine.result(result_message(name, Ros1Status.ABORTED, 8), STAMP, 1.0)
    assert answers(machine.take()) == {
        1: send_goal_response(STAMP, accepted=True), 2: response(Ros2Status.ABORTED),
    }  # fmt: skip


def test_a_rejected_goal_is_not_accepted_and_one_that_is_not_shown_fails() -> None:
    machine = GoalsToRos1(PAIR)
    machine.states(states_message(sent_to_ros1(machine), Ros1Status.REJECTED), STAMP, 0.1)
    assert answers(machine.take()) == {1: send_goal_response(STAMP, accepted=False)}
    machine = GoalsToRos1(PAIR)
    sent_to_ros1(machine)
    assert machine.next_timer() == limits.ROS2_ACCEPT_TIMEOUT
    machine.handle_timer(limits.ROS2_ACCEPT_TIMEOUT)
    assert answers(machine.take()) == {1: None}
    assert machine.next_timer() is None


def test_cancellations_of_ros2_name_their_goals() -> None:
    machine = GoalsToRos1(PAIR)
    name = sent_to_ros1(machine)
    machine.states(states_message(name, Ros1Status.ACTIVE), STAMP, 0.1)
    machine.take()
    for request, uuid in ((5, UUID), (6, ALL_GOALS)):
        machine.cancel_goal(request, cancel_request(uuid))
        events = machine.take()
        assert [each.message for each in events if isinstance(each, TellServer)] == [GoalId(name).serialize()]
        made = answers(events)[request]
        assert made is not None
        cancelled = read(f"{CANCEL_TYPE}_Response", made)
        assert (cancelled.return_code, [bytes(each.goal_id.uuid) for each in cancelled.goals_canceling]) == (
            0,
            [UUID],
        )
    machine.cancel_goal(7, cancel_request(b"x" * 16))
    made = answers(machine.take())[7]
    assert made is not None
    assert read(f"{CANCEL_TYPE}_Response", made).return_code == 2, "it is not known"


def test_a_server_of_ros1_that_is_gone_aborts_its_goals() -> None:
    machine = GoalsToRos1(PAIR)
    name = sent_to_ros1(machine)
    machine.states(states_message(name, Ros1Status.ACTIVE), STAMP, 0.1)
    machine.get_result(2, with_uuid(UUID, b"\0\1\0\0"))
    machine.take()
    machine.server_gone(STAMP, 1.0)
    assert answers(machine.take()) == {2: response(Ros2Status.ABORTED, 0)}


def test_a_goal_that_vanishes_from_the_status_of_its_server_is_lost() -> None:
    """As in actionlib: the server was started anew, or has forgotten the goal without a result."""
    machine = GoalsToRos1(PAIR)
    name = sent_to_ros1(machine)
    machine.get_result(2, with_uuid(UUID, b"\0\1\0\0"))
    machine.states(states_message("another", Ros1Status.ACTIVE), STAMP, 0.1)
    assert machine.take() == [], "it has not come there yet"
    machine.states(states_message(name, Ros1Status.ACTIVE), STAMP, 0.2)
    machine.take()
    machine.states(states_message("another", Ros1Status.ACTIVE), STAMP, 0.3)
    events = machine.take()
    assert answers(events) == {2: response(Ros2Status.ABORTED, 0)}
    assert machine.active == 0
    machine.states(states_message("another", Ros1Status.ACTIVE), STAMP, 0.4)
    assert machine.take() == [], "once"

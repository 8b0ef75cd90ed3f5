"""An action type of ROS 1 and its counterpart in ROS 2: the types that rosidl makes of it, and their conversions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from rosbags.interfaces import Nodetype

from rmpa.gateway.ros2.conversion import Conversion, NoConversion
from rmpa.ros.types.definitions import Specification
from rmpa.ros.types.messages import MessageType

if TYPE_CHECKING:
    from rmpa.gateway.ros2.mapping import ActionRule
    from rmpa.gateway.ros2.types import Ros2Types

PART: Final = "/_action/"
"""Stands between an action's name and those of its services and topics in ROS 2."""
CANCEL_TYPE: Final = "action_msgs/srv/CancelGoal"
STATUS_TYPE: Final = "action_msgs/msg/GoalStatusArray"
_UUID: Final = (Nodetype.NAME, "unique_identifier_msgs/msg/UUID")
_TIME: Final = (Nodetype.NAME, "builtin_interfaces/msg/Time")
_INFO: Final = (Nodetype.NAME, "action_msgs/msg/GoalInfo")


class ActionTypes:
    """The names and hashes of the types of one action of ROS 2, ``package/action/Name``."""

    def __init__(self, name: str, types: Ros2Types) -> None:
        self.name = name
        self.send_goal = f"{name}_SendGoal"
        self.get_result = f"{name}_GetResult"
        self.feedback = f"{name}_FeedbackMessage"
        own: dict[str, Any] = {part: (Nodetype.NAME, f"{name}_{part}") for part in ("Goal", "Result", "Feedback")}
        types.define_service(
            self.send_goal,
            [("goal_id", _UUID), ("goal", own["Goal"])],
            [("accepted", (Nodetype.BASE, ("bool", 0))), ("stamp", _TIME)],
        )
        types.define_service(
            self.get_result,
            [("goal_id", _UUID)],
            [("status", (Nodetype.BASE, ("int8", 0))), ("result", own["Result"])],
        )
        types.define(self.feedback, [("goal_id", _UUID), ("feedback", own["Feedback"])])
        types.define_service(
            CANCEL_TYPE,
            [("goal_info", _INFO)],
            [("return_code", (Nodetype.BASE, ("int8", 0))), ("goals_canceling", (Nodetype.SEQUENCE, (_INFO, 0)))],
        )
        self.hashes: Final = {
            kind: types.type_hash(kind)
            for kind in (self.send_goal, self.get_result, self.feedback, CANCEL_TYPE, STATUS_TYPE)
        }


class ActionPair:
    """Converts goals, results and feedback of one action type.

    Args:
        goal: ROS 1's goal, without its wrapping.
        result: ROS 1's result.
        feedback: ROS 1's feedback.
        rule: Its counterpart, ``package/action/Name``, and the fields if a mapping file lists them.
        types: ROS 2's types; the action's are learnt from ROS 1's fields if they are not known.

    Raises:
        NoConversion: The types are no pair.
    """

    def __init__(
        self, goal: MessageType, result: MessageType, feedback: MessageType, rule: ActionRule, types: Ros2Types
    ) -> None:
        self.ros1 = goal.name.removesuffix("Goal")
        """``package/Name`` of ROS 1."""
        parts = {"Goal": goal, "Result": result, "Feedback": feedback}
        if rule.has_fields and f"{rule.name}_Goal" not in types:
            raise NoConversion(
                f"the rule of {self.ros1} maps fields to {rule.name}, whose definition is not known here"
            )
        for part, kind in parts.items():
            own = f"{rule.name}_{part}"
            types.learn({name: each for name, each in kind.specifications.items() if name != kind.name})
            types.define_as(own, kind.specifications[kind.name])
        self.types = ActionTypes(rule.name, types)
        self.goal = Conversion(goal, f"{rule.name}_Goal", types, rule.goal)
        """Converts goals, without the id."""
        self.feedback = Conversion(feedback, f"{rule.name}_Feedback", types, rule.feedback)
        """Converts feedback, without the id."""
        self.result: Final = result
        """ROS 1's result."""
        wrapped = f"{self.ros1}GetResultResponse"
        both = Specification.parse(wrapped, f"int8 status\n{result.name} result\n")
        paths = rule.result and {"status": "status", **{f"result.{a}": f"result.{b}" for a, b in rule.result.items()}}
        known = {**result.specifications, wrapped: both}
        self._result = Conversion(MessageType(wrapped, known), f"{self.types.get_result}_Response", types, paths)
        self._no_result = result.serialize(result.make(None))
        self.messages: Final = (f"{self.ros1}ActionGoal", f"{self.ros1}ActionResult", f"{self.ros1}ActionFeedback")
        """The types of ROS 1's topics *goal*, *result* and *feedback*."""

    @property
    def no_result(self) -> bytes:
        """A result of ROS 1 without values, for goals that have none."""
        return self._no_result

    def result_to_ros2(self, status: int, result: bytes) -> bytes:
        """``GetResult_Response``.

        Raises:
            ConversionError: The result does not fit ROS 2's type.
        """
        return self._result.to_ros2(bytes((status,)) + result)

    def result_to_ros1(self, raw: bytes) -> tuple[int, bytes]:
        """Status and result of a ``GetResult_Response``.

        Raises:
            ConversionError: The bytes are no such response.
        """
        made = self._result.to_ros1(raw)
        return made[0], made[1:]


def action_name(type_name: str, part: str) -> str:
    """``package/Name`` of the action that has a topic of this type of ROS 1; empty for none."""
    return type_name.removesuffix(part) if type_name.endswith(part) and not type_name.endswith(f"/{part}") else ""

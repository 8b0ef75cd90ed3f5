"""An action type of ROS 1 and its counterpart in ROS 2: the types that rosidl makes of it, and their conversions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from rosbags.interfaces import Nodetype

from rmpa.gateway.ros2.conversion import Conversion, NoConversion
from rmpa.ros.types.definitions import Specification
from rmpa.ros.types.messages import MessageType

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rmpa.gateway.ros2.mapping import ActionRule
    from rmpa.gateway.ros2.types import Ros2Types

PART: Final = "/_action/"
"""Stands between an action's name and those of its services and topics in ROS 2."""
CANCEL_TYPE: Final = "action_msgs/srv/CancelGoal"
STATUS_TYPE: Final = "action_msgs/msg/GoalStatusArray"
_UUID: Final = ("goal_id", (Nodetype.NAME, "unique_identifier_msgs/msg/UUID"))
_TIME: Final = ("stamp", (Nodetype.NAME, "builtin_interfaces/msg/Time"))
_INFO: Final = (Nodetype.NAME, "action_msgs/msg/GoalInfo")


class ActionPair:
    """Converts goals, results and feedback of one action type.

    Args:
        kinds: ROS 1's goal, result and feedback, without their wrapping.
        rule: Its counterpart, ``package/action/Name``, and the fields if a mapping file lists them.
        types: ROS 2's types; the action's are learnt from ROS 1's fields if they are not known.

    Raises:
        NoConversion: The types are no pair.
    """

    def __init__(self, kinds: Sequence[MessageType], rule: ActionRule, types: Ros2Types) -> None:
        goal, result, feedback = kinds
        self.name: Final = rule.name
        """``package/action/Name`` of ROS 2."""
        self.ros1: Final = goal.name.removesuffix("Goal")
        """``package/Name`` of ROS 1."""
        if rule.has_fields and f"{rule.name}_Goal" not in types:
            raise NoConversion(
                f"the rule of {self.ros1} maps fields to {rule.name}, whose definition is not known here"
            )
        for part, kind in zip(("Goal", "Result", "Feedback"), kinds, strict=True):
            types.learn({name: each for name, each in kind.specifications.items() if name != kind.name})
            types.define_as(f"{rule.name}_{part}", kind.specifications[kind.name])
        self.types: Final = _define(rule.name, types)
        """The type of each service and topic in ROS 2, and its hash."""
        self.goal: Final = Conversion(goal, f"{rule.name}_Goal", types, rule.goal)
        """Converts goals, without the id."""
        self.feedback: Final = Conversion(feedback, f"{rule.name}_Feedback", types, rule.feedback)
        """Converts feedback, without the id."""
        self.result: Final = result
        """ROS 1's result."""
        wrapped = f"{self.ros1}GetResultResponse"
        both = Specification.parse(wrapped, f"int8 status\n{result.name} result\n")
        paths = rule.result and {"status": "status", **{f"result.{a}": f"result.{b}" for a, b in rule.result.items()}}
        known = {**result.specifications, wrapped: both}
        self._result = Conversion(MessageType(wrapped, known), f"{rule.name}_GetResult_Response", types, paths)
        self.no_result: Final = result.serialize(result.make(None))
        """A result of ROS 1 without values, for goals that have none."""

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


def _define(name: str, types: Ros2Types) -> dict[str, tuple[str, str]]:
    """Define the types of one action of ROS 2, as rosidl_parser does."""
    own: dict[str, Any] = {part: (Nodetype.NAME, f"{name}_{part}") for part in ("Goal", "Result", "Feedback")}
    number = (Nodetype.BASE, ("int8", 0))
    sent = [("accepted", (Nodetype.BASE, ("bool", 0))), _TIME]
    types.define_service(f"{name}_SendGoal", [_UUID, ("goal", own["Goal"])], sent)
    types.define_service(f"{name}_GetResult", [_UUID], [("status", number), ("result", own["Result"])])
    types.define(f"{name}_FeedbackMessage", [_UUID, ("feedback", own["Feedback"])])
    cancelled = [("return_code", number), ("goals_canceling", (Nodetype.SEQUENCE, (_INFO, 0)))]
    types.define_service(CANCEL_TYPE, [("goal_info", _INFO)], cancelled)
    kinds = {
        "send_goal": f"{name}_SendGoal",
        "get_result": f"{name}_GetResult",
        "cancel_goal": CANCEL_TYPE,
        "feedback": f"{name}_FeedbackMessage",
        "status": STATUS_TYPE,
    }
    return {part: (kind, types.type_hash(kind)) for part, kind in kinds.items()}


def action_name(type_name: str, part: str) -> str:
    """``package/Name`` of the action that has a topic of this type of ROS 1; empty for none."""
    return type_name.removesuffix(part) if type_name.endswith(part) and not type_name.endswith(f"/{part}") else ""

"""Finds the types of an action on this machine, or learns them from its server in ROS 2."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from rmpa.gateway.ros2.action_pair import PART, ActionPair
from rmpa.gateway.ros2.conversion import NoConversion
from rmpa.gateway.ros2.derived import derive_ros1
from rmpa.gateway.ros2.tokens import EntityKind
from rmpa.ros.types.definitions import Specification, known_specifications
from rmpa.ros.types.find import find_message_type
from rmpa.ros.types.messages import MessageType

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from rmpa.gateway.ros2.io.part import Ros2Context
    from rmpa.gateway.ros2.mapping import ActionRule
    from rmpa.gateway.ros2.tokens import Ros2Endpoint
    from rmpa.ros.wire.tcpros import TopicDescription


_PARTS: Final = ("Goal", "Result", "Feedback")


async def find_parts(name: str) -> list[MessageType]:
    """Find goal, result and feedback of ``package/Name``.

    Raises:
        RmpaError: A definition is missing.
    """
    return [await asyncio.to_thread(find_message_type, f"{name}{part}") for part in _PARTS]


async def find_action(context: Ros2Context, name: str, rule: ActionRule) -> ActionPair:
    """Find goal, result and feedback of ``package/Name``, and pair them with ROS 2's.

    Raises:
        RmpaError: A definition is missing, or the types are no pair.
    """
    goal, result, feedback = await find_parts(name)
    return ActionPair(goal, result, feedback, rule, context.types)


async def learn_action(
    context: Ros2Context, server: Ros2Endpoint, ros1: str, rule: ActionRule, known: Sequence[MessageType] = ()
) -> ActionPair:
    """Make the pair of an action from what the node of its server in ROS 2 says of its types.

    Args:
        context: What the parts share.
        server: The server's endpoint *send_goal*.
        ros1: ``package/Name`` of ROS 1.
        rule: ``package/action/Name`` of ROS 2, and fields if a mapping file lists them.
        known: Goal, result and feedback of ROS 1 if this machine has them; else they are derived.

    Raises:
        RmpaError: The node does not describe them, or the types are no pair.
    """
    name = server.name.removesuffix(f"{PART}send_goal")
    fields = await context.asker.learn(
        (server.name, EntityKind.SERVICE),
        (f"{name}{PART}get_result", EntityKind.SERVICE),
        (f"{name}{PART}feedback", EntityKind.PUBLISHER),
        of=server,
    )
    types = context.types.variant(fields)
    own = {f"{rule.name}_{part}": f"{ros1}{part}" for part in _PARTS}
    try:
        kinds = known or [
            derive_ros1(types.store, each, lambda it: own.get(it) or context.ros1_name(it)) for each in own
        ]
        return ActionPair(kinds[0], kinds[1], kinds[2], rule, types)
    except KeyError as error:
        raise NoConversion(f"{rule.name} has no form in ROS 1: {error}") from error


def learnt_topics(pair: ActionPair) -> list[TopicDescription]:
    """The headers of feedback and result of an action of which this machine has no definition."""
    return [
        _wrapped(f"{pair.ros1}Action{part}", kind).describe()
        for part, kind in (("Feedback", pair.feedback.ros1), ("Result", pair.result))
    ]


def _wrapped(name: str, kind: MessageType) -> MessageType:
    """The message of actionlib around a feedback or result, as its genaction.py makes it."""
    text = f"Header header\nactionlib_msgs/GoalStatus status\n{kind.name} {name.rpartition('Action')[2].lower()}\n"
    known = {**known_specifications("std_msgs/Header"), **known_specifications("actionlib_msgs/GoalStatus")}
    return MessageType(name, {**known, **kind.specifications, name: Specification.parse(name, text)})


async def find_topics(kinds: Iterable[str]) -> list[TopicDescription]:
    """The headers of topics of types that this machine knows.

    Raises:
        RmpaError: A definition is missing.
    """
    return [(await asyncio.to_thread(find_message_type, kind)).describe() for kind in kinds]

"""Finds the types of an action on this machine."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from rmpa.gateway.ros2.action_pair import ActionPair
from rmpa.ros.types.find import find_message_type

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rmpa.gateway.ros2.io.part import Ros2Context
    from rmpa.gateway.ros2.mapping import ActionRule
    from rmpa.ros.wire.tcpros import TopicDescription


async def find_action(context: Ros2Context, name: str, rule: ActionRule) -> ActionPair:
    """Find goal, result and feedback of ``package/Name``, and pair them with ROS 2's.

    Raises:
        RmpaError: A definition is missing, or the types are no pair.
    """
    goal, result, feedback = [
        await asyncio.to_thread(find_message_type, f"{name}{part}") for part in ("Goal", "Result", "Feedback")
    ]
    return ActionPair(goal, result, feedback, rule, context.types)


async def find_topics(kinds: Iterable[str]) -> list[TopicDescription]:
    """The headers of topics of types that this machine knows.

    Raises:
        RmpaError: A definition is missing.
    """
    return [(await asyncio.to_thread(find_message_type, kind)).describe() for kind in kinds]
